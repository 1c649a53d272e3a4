"""Poses and status to Zenoh subscribers."""

from __future__ import annotations

import asyncio
import json
import logging

import zenoh

from trigpoint.errors import ConfigError, SourceError
from trigpointd.config import ZenohConfig
from trigpointd.messages.cdr import POSE_ENCODING
from trigpointd.pipeline import Output

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


class ZenohSink:
    """Publishes `<base>/pose`, `<base>/status` and the liveliness token `<base>/alive`."""

    def __init__(self, config: ZenohConfig, base_key: str) -> None:
        self._session = open_session(config)
        self._token = self._session.liveliness().declare_token(f"{base_key}/alive")
        # A slow subscriber must not hold up localization: what cannot be sent now is dropped.
        self._pose = self._session.declare_publisher(
            f"{base_key}/pose", encoding=zenoh.Encoding(POSE_ENCODING)
        )
        self._status = self._session.declare_publisher(
            f"{base_key}/status", encoding=zenoh.Encoding.APPLICATION_JSON
        )

    async def wait_for_subscriber(self, timeout_s: float) -> None:
        """Wait until somebody subscribes to the poses, at most `timeout_s`; 0 does not wait."""
        if timeout_s == 0:
            return
        loop, matched = asyncio.get_running_loop(), asyncio.Event()

        def changed(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                loop.call_soon_threadsafe(matched.set)

        listener = self._pose.declare_matching_listener(changed)
        try:
            # The listener tells changes only. At run time this is an object, not the bool it says.
            if not self._pose.matching_status.matching:  # type: ignore[attr-defined]
                await asyncio.wait_for(matched.wait(), timeout_s)
        except TimeoutError:
            _log.warning("nobody has subscribed to the poses in %g s; going on", timeout_s)
        finally:
            listener.undeclare()  # type: ignore[no-untyped-call]

    def publish(self, output: Output) -> None:
        """Send what is known of one frame."""
        try:
            if output.pose is not None:
                self._pose.put(output.pose)
            self._status.put(output.status)
        except zenoh.ZError as error:
            raise SourceError(f"cannot publish over Zenoh: {_one_line(error)}") from error

    def close(self) -> None:
        """Leave the network; subscribers see the token go after the last pose."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
