"""A subscriber: the poses of a daemon, as they come."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh

from trigpoint.errors import ConfigError, SourceError
from trigpointd.config import ZenohConfig
from trigpointd.messages.cdr import PoseStamped, decode_pose
from trigpointd.sinks.zenoh import open_session


@dataclass(frozen=True)
class Received:
    """A pose and the key it came on."""

    key: str
    pose: PoseStamped


@contextmanager
def subscribe(
    config: ZenohConfig, key: str, *, exit_with_daemon: bool = False
) -> Iterator[Iterator[Received | str]]:
    """Subscribe; yields the poses as they come, and for a message that is none a text.

    Parameters
    ----------
    config : ZenohConfig
        How to reach the network.
    key : str
        Key expression, such as `trigpoint/**/pose`.
    exit_with_daemon : bool
        End when a daemon that publishes on the key has left.
    """
    inbox: queue.SimpleQueue[zenoh.Sample | None] = queue.SimpleQueue()

    def daemon_changed(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            inbox.put(None)

    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise ConfigError(f"{key!r} is no key expression, such as trigpoint/**/pose") from error
    with open_session(config) as session:
        # The token is undeclared after the last pose, on the same session: it cannot overtake.
        alive = key.removesuffix("/pose") + "/alive"
        session.declare_subscriber(key, inbox.put)
        if exit_with_daemon:
            session.liveliness().declare_subscriber(alive, daemon_changed, history=True)
        yield (_decode(sample) for sample in iter(inbox.get, None))


def _decode(sample: zenoh.Sample) -> Received | str:
    key = str(sample.key_expr)
    try:
        return Received(key, decode_pose(sample.payload.to_bytes()))
    except SourceError as error:
        return f"{key}: {error}"
