"""Poses and status to Zenoh subscribers."""

from __future__ import annotations

import json
import time

import zenoh

from trigpoint.errors import ConfigError
from trigpointd.config import ZenohConfig
from trigpointd.messages.cdr import POSE_ENCODING
from trigpointd.pipeline import Output


def open_session(config: ZenohConfig) -> zenoh.Session:
    """Join the network; an endpoint that cannot be listened on is an error."""
    settings = zenoh.Config()
    settings.insert_json5("mode", json.dumps(config.mode))
    settings.insert_json5("scouting/multicast/enabled", json.dumps(config.multicast_scouting))
    try:
        # An empty list would replace Zenoh's own default, any free port.
        if config.listen:
            settings.insert_json5("listen/endpoints", json.dumps(config.listen))
            settings.insert_json5("listen/exit_on_failure", "true")
        if config.connect:
            settings.insert_json5("connect/endpoints", json.dumps(config.connect))
        return zenoh.open(settings)
    except zenoh.ZError as error:
        endpoints = ", ".join((*config.listen, *config.connect)) or "any"
        reason = " ".join(str(error).split(" at ")[0].split())
        raise ConfigError(
            f"cannot open a Zenoh session on {endpoints}: {reason}; is the port in use by another "
            "program, or the address mistyped?"
        ) from error


class ZenohSink:
    """Publishes `<base>/pose`, `<base>/status` and the liveliness token `<base>/alive`."""

    name = "zenoh"

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

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait until somebody subscribes to the poses; False if nobody did in time."""
        deadline_s = time.monotonic() + timeout_s
        while not self._pose.matching_status:
            if time.monotonic() > deadline_s:
                return False
            time.sleep(0.02)
        return True

    def publish(self, output: Output) -> None:
        """Send what is known of one frame."""
        if output.pose is not None:
            self._pose.put(output.pose)
        self._status.put(output.status)

    def close(self) -> None:
        """Leave the network; subscribers see the token go after the last pose."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
