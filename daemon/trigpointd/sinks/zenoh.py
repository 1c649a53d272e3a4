"""Poses and status to Zenoh subscribers, answers to those who ask."""

from __future__ import annotations

import asyncio
import contextlib
import logging

import zenoh

from trigpointd.config import ZenohConfig
from trigpointd.messages.cdr import POSE_ENCODING
from trigpointd.pipeline import Output
from trigpointd.request_queue import RequestQueue
from trigpointd.session import Link, make_settings
from trigpointd.sinks.queries import declare_queryables

_log = logging.getLogger(__name__)


class _Topic:
    """A key to publish on; who asks on it gets what was published last."""

    def __init__(self, key: str, encoding: zenoh.Encoding) -> None:
        self._key = key
        self._encoding = encoding
        self._last: bytes | None = None
        self.publisher: zenoh.Publisher | None = None

    def declare(self, session: zenoh.Session) -> None:
        # A slow subscriber must not hold up localization: what cannot be sent now is dropped.
        self.publisher = session.declare_publisher(self._key, encoding=self._encoding)
        session.declare_queryable(self._key, self._reply, complete=True)

    def put(self, payload: bytes) -> None:
        self._last = payload
        if self.publisher is not None:
            with contextlib.suppress(zenoh.ZError):  # closed: the link opens another session
                self.publisher.put(payload)

    def _reply(self, query: zenoh.Query) -> None:
        with query:
            if self._last is not None:
                query.reply(self._key, self._last, encoding=self._encoding)


class ZenohSink:
    """Publishes `<base>/pose`, `<base>/status` and the liveliness token `<base>/alive`.

    That nobody is there, or that the session is lost, is no reason not to localize: it never fails
    after its start, and publishes again as soon as it can.
    """

    def __init__(
        self, config: ZenohConfig, base_key: str, requests: RequestQueue | None = None
    ) -> None:
        self._base_key = base_key
        self._requests = requests
        self._pose = _Topic(f"{base_key}/pose", zenoh.Encoding(POSE_ENCODING))
        self._status = _Topic(f"{base_key}/status", zenoh.Encoding.APPLICATION_JSON)
        self._token: zenoh.LivelinessToken | None = None
        self._link = Link(make_settings(config), self._declare, _say)

    def _declare(self, session: zenoh.Session) -> None:
        self._pose.declare(session)
        self._status.declare(session)
        if self._requests is not None:
            declare_queryables(session, self._base_key, self._requests)
        self._token = session.liveliness().declare_token(f"{self._base_key}/alive")

    @property
    def problem(self) -> str:
        """Why nobody can receive poses, in a line; empty while all is well."""
        return self._link.problem

    async def wait_for_subscriber(self, timeout_s: float) -> None:
        """Wait until somebody subscribes to the poses, at most `timeout_s`; 0 does not wait."""
        publisher = self._pose.publisher
        if timeout_s == 0 or publisher is None:
            return
        loop, matched = asyncio.get_running_loop(), asyncio.Event()

        def changed(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                loop.call_soon_threadsafe(matched.set)

        listener = publisher.declare_matching_listener(changed)
        try:
            # The listener tells changes only. At run time this is an object, not the bool it says.
            if not publisher.matching_status.matching:  # type: ignore[attr-defined]
                await asyncio.wait_for(matched.wait(), timeout_s)
        except TimeoutError:
            _log.warning("nobody has subscribed to the poses in %g s; going on", timeout_s)
        finally:
            listener.undeclare()  # type: ignore[no-untyped-call]

    def publish(self, output: Output) -> None:
        """Send what is known of one frame."""
        if output.pose is not None:
            self._pose.put(output.pose)
        self._status.put(output.status)

    def close(self) -> None:
        """Answer what has been asked, and leave the network."""
        if self._requests is not None:
            self._requests.close()
        if self._token is not None:  # subscribers see it go after the last pose
            self._token.undeclare()  # type: ignore[no-untyped-call]
        self._link.close()


def _say(problem: str) -> None:
    if problem:
        _log.warning("%s; publishing once it can be reached", problem)
    else:
        _log.info("Zenoh is there; publishing")
