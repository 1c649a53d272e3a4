"""Poses and status to Zenoh subscribers, answers to those who ask."""

from __future__ import annotations

import asyncio
import json
import logging
import threading

import zenoh

from trigpoint.errors import ConfigError, SourceError
from trigpointd.config import ZenohConfig
from trigpointd.messages.cdr import POSE_ENCODING
from trigpointd.pipeline import Output
from trigpointd.request_queue import RequestQueue
from trigpointd.sinks.queries import declare_queryables
from trigpointd.sinks.tls import make_tls_settings

_MIN_MESSAGE_BYTES = 2**20
_PATIENCE = {  # of a client whose router is not there: without end, every other second
    "connect/timeout_ms": "-1",
    "connect/exit_on_failure": "false",
    "connect/retry": '{"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2}',
}

_log = logging.getLogger(__name__)


def make_settings(config: ZenohConfig) -> zenoh.Config:
    """Put the settings in Zenoh's form; an endpoint it cannot read is an error."""
    settings = zenoh.Config()
    settings.insert_json5("mode", json.dumps(config.mode))
    settings.insert_json5("scouting/multicast/enabled", json.dumps(config.multicast_scouting))
    for what, endpoints in (("listen", config.listen), ("connect", config.connect)):
        if not endpoints:  # an empty list would replace Zenoh's own default
            continue
        try:
            settings.insert_json5(f"{what}/endpoints", json.dumps(endpoints))
        except zenoh.ZError as error:
            raise ConfigError(
                f"zenoh.{what}: {', '.join(endpoints)} cannot be read; write an endpoint as "
                "tcp/127.0.0.1:7447"
            ) from error
    if config.listen:
        settings.insert_json5("listen/exit_on_failure", "true")
    # Larger messages are dropped on arrival; up to this, the sender of a request is told.
    max_bytes = max(4 * config.requests.max_payload_bytes, _MIN_MESSAGE_BYTES)
    settings.insert_json5("transport/link/rx/max_message_size", json.dumps(max_bytes))
    if config.tls is not None:
        if not config.listen:  # instead of Zenoh's default, a plain port
            settings.insert_json5("listen/endpoints", "[]")
        for path, value in make_tls_settings(config.tls).items():
            settings.insert_json5(path, json.dumps(value))
    return settings


def open_session(config: ZenohConfig) -> zenoh.Session:
    """Join the network; an endpoint that cannot be listened on is an error."""
    settings = make_settings(config)
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        endpoints = ", ".join((*config.listen, *config.connect)) or "any endpoint"
        raise ConfigError(
            f"cannot open a Zenoh session on {endpoints}: {_one_line(error)}; is the port in use "
            "by another program, or the address mistyped?"
        ) from error


def _one_line(error: zenoh.ZError) -> str:
    return " ".join(str(error).split(" at ")[0].split())


class _Topic:
    """A key to publish on; who asks on it gets what was published last."""

    def __init__(self, session: zenoh.Session, key: str, encoding: zenoh.Encoding) -> None:
        self._key = key
        self._encoding = encoding
        self._last: bytes | None = None
        # A slow subscriber must not hold up localization: what cannot be sent now is dropped.
        self.publisher = session.declare_publisher(key, encoding=encoding)
        session.declare_queryable(key, self._reply, complete=True)

    def put(self, payload: bytes) -> None:
        self._last = payload
        self.publisher.put(payload)

    def _reply(self, query: zenoh.Query) -> None:
        with query:
            if self._last is not None:
                query.reply(self._key, self._last, encoding=self._encoding)


class _Outlet:
    """All that is declared on a session."""

    def __init__(
        self, session: zenoh.Session, base_key: str, requests: RequestQueue | None
    ) -> None:
        self._session = session
        self.pose = _Topic(session, f"{base_key}/pose", zenoh.Encoding(POSE_ENCODING))
        self.status = _Topic(session, f"{base_key}/status", zenoh.Encoding.APPLICATION_JSON)
        if requests is not None:
            declare_queryables(session, base_key, requests)
        self._token = session.liveliness().declare_token(f"{base_key}/alive")

    def close(self) -> None:
        """Leave the network; subscribers see the token go after the last pose."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]


class ZenohSink:
    """Publishes `<base>/pose`, `<base>/status` and the liveliness token `<base>/alive`.

    A client whose router is not there is no reason not to localize: it joins once it is.
    """

    def __init__(
        self, config: ZenohConfig, base_key: str, requests: RequestQueue | None = None
    ) -> None:
        self._base_key = base_key
        self._requests = requests
        self._outlet: _Outlet | None = None
        self._lock = threading.Lock()
        self._is_closed = False
        settings = make_settings(config)
        try:
            self._outlet = _Outlet(open_session(config), base_key, requests)
        except ConfigError:
            if config.mode != "client":
                raise
            where = ", ".join(config.connect) or "any address"
            _log.warning("no Zenoh router answers at %s; publishing once one does", where)
            threading.Thread(target=self._join_later, args=[settings], daemon=True).start()

    def _join_later(self, settings: zenoh.Config) -> None:
        for path, value in _PATIENCE.items():
            settings.insert_json5(path, value)
        session = zenoh.open(settings)
        with self._lock:
            if self._is_closed:
                session.close()  # type: ignore[no-untyped-call]
            else:
                self._outlet = _Outlet(session, self._base_key, self._requests)
                _log.info("a Zenoh router is there; publishing")

    async def wait_for_subscriber(self, timeout_s: float) -> None:
        """Wait until somebody subscribes to the poses, at most `timeout_s`; 0 does not wait."""
        if timeout_s == 0 or self._outlet is None:
            return
        loop, matched = asyncio.get_running_loop(), asyncio.Event()
        publisher = self._outlet.pose.publisher

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
        outlet = self._outlet
        if outlet is None:
            return
        try:
            if output.pose is not None:
                outlet.pose.put(output.pose)
            outlet.status.put(output.status)
        except zenoh.ZError as error:
            raise SourceError(f"cannot publish over Zenoh: {_one_line(error)}") from error

    def close(self) -> None:
        """Answer what has been asked, and leave the network."""
        if self._requests is not None:
            self._requests.close()
        with self._lock:
            self._is_closed = True
            if self._outlet is not None:
                self._outlet.close()
