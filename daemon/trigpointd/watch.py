"""A subscriber: the last pose of each daemon at once, then the poses as they come."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass

import zenoh

from trigpoint.errors import ConfigError, SourceError
from trigpointd.messages.cdr import PoseStamped, decode_pose
from trigpointd.session import Link

_PATIENCE_S = 5.0  # without a word; then it is said that nothing has come


@dataclass(frozen=True)
class Received:
    """A pose and the key it came on."""

    key: str
    pose: PoseStamped


@contextmanager
def subscribe(
    settings: zenoh.Config, key: str, *, exit_with_daemon: bool = False
) -> Iterator[Iterator[Received | str]]:
    """Subscribe; yields the poses as they come, and a text for what is worth saying besides.

    Parameters
    ----------
    settings : zenoh.Config
        How to reach the network; what cannot be reached is said, and waited for.
    key : str
        Key expression, such as `trigpoint/**/pose`.
    exit_with_daemon : bool
        End when a daemon that publishes on the key has left.
    """
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise ConfigError(f"{key!r} is no key expression, such as trigpoint/**/pose") from error
    inbox = _Inbox(key, exit_with_daemon)
    with closing(Link(settings, inbox.declare, inbox.link_changed)):
        yield iter(inbox)


class _Inbox:
    """What has arrived; the thread that iterates is not Zenoh's."""

    def __init__(self, key: str, exit_with_daemon: bool) -> None:
        self._key = key
        self._exit_with_daemon = exit_with_daemon
        self._queue = queue.SimpleQueue[tuple[Received | str, bool] | None]()  # and if asked for

    def declare(self, session: zenoh.Session) -> None:
        # The token is undeclared after the last pose, on the same session: it cannot overtake.
        alive = self._key.removesuffix("/pose") + "/alive"

        def daemon_changed(token: zenoh.Sample) -> None:
            if token.kind == zenoh.SampleKind.PUT:
                session.get(str(token.key_expr).removesuffix("alive") + "pose", self._replied)
            elif self._exit_with_daemon:
                self._queue.put(None)

        session.declare_subscriber(self._key, lambda sample: self._put(_decode(sample)))
        session.liveliness().declare_subscriber(alive, daemon_changed, history=True)

    def _replied(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._put(_decode(reply.ok), asked_for=True)

    def link_changed(self, problem: str) -> None:
        self._put(f"{problem}; waiting" if problem else "connected")

    def __iter__(self) -> Iterator[Received | str]:
        """Decode what comes; of the last poses asked for, only what is newer than all shown."""
        shown: dict[str, int] = {}  # capture times by key
        timeout_s: float | None = _PATIENCE_S
        while (item := self._get(timeout_s)) is not None:
            (received, asked_for), timeout_s = item, None
            if isinstance(received, Received):
                time_ns, before = received.pose.time_ns, shown.get(received.key)
                if before is not None and (time_ns <= before if asked_for else time_ns == before):
                    continue
                shown[received.key] = time_ns
            yield received

    def _get(self, timeout_s: float | None) -> tuple[Received | str, bool] | None:
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return f"nothing has come on {self._key} in {_PATIENCE_S:g} s; waiting", False

    def _put(self, received: Received | str, *, asked_for: bool = False) -> None:
        self._queue.put((received, asked_for))


def _decode(sample: zenoh.Sample) -> Received | str:
    key = str(sample.key_expr)
    try:
        return Received(key, decode_pose(sample.payload.to_bytes()))
    except SourceError as error:
        return f"{key}: {error}"
