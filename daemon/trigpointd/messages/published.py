"""Pose and status of an output as messages, as logs and live views have them."""

from __future__ import annotations

from trigpointd.messages.cdr import POSE_SCHEMA, POSE_TYPE
from trigpointd.pipeline import Output
from trigpointd.sources.base import Channel, Message

_STATUS_SCHEMA = b'{"type": "object"}'


class Published:
    """What is published of outputs, under a base key."""

    def __init__(self, base_key: str) -> None:
        self._pose = Channel(f"{base_key}/pose", "cdr", POSE_TYPE, "ros2msg", POSE_SCHEMA.encode())
        self._status = Channel(
            f"{base_key}/status", "json", "trigpoint.Status", "jsonschema", _STATUS_SCHEMA
        )

    def of(self, output: Output) -> list[Message]:
        """Return the pose, where there is one, and the status."""
        time_ns = output.captured.log_time_ns
        status = Message(self._status, output.status, time_ns, time_ns)
        if output.pose is None:
            return [status]
        return [Message(self._pose, output.pose, time_ns, time_ns), status]
