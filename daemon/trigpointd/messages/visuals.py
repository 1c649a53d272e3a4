"""What a viewer shows of outputs, beside pose and status: one place for the log and live views."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from trigpoint.frame import Localized
from trigpointd.messages.annotations import annotate
from trigpointd.messages.cdr import PoseStamped, decode_pose
from trigpointd.messages.foxglove import CAMERA_FRAME, make_channel
from trigpointd.messages.images import parse_calibration
from trigpointd.messages.scene import (
    clear_scene,
    place_camera,
    show_anchors,
    show_path,
    show_points,
)
from trigpointd.pipeline import Output
from trigpointd.sources.base import Captured, Message

PATH_STEP_NS = 200_000_000
PATH_STEPS = 600  # two minutes
PATH_PERIOD_NS = 10**9  # between two messages, each of which has all of it

_KINDS = {
    "annotations": ImageAnnotations,
    "anchors": SceneUpdate,
    "points": PointCloud,
    "path": SceneUpdate,
    "transforms": FrameTransforms,
}


class Visuals:
    """Draws outputs, one after the other.

    Topics, under the base key: `annotations` (keypoints on the image, and why there is no pose),
    `anchors` (those that the frame was matched with), `points` (the latent points that agree with
    the pose), `path` (of the body, the last two minutes), `transforms` (map to body to camera).
    """

    def __init__(self, base_key: str) -> None:
        self._channels = {
            name: make_channel(f"{base_key}/{name}", kind) for name, kind in _KINDS.items()
        }
        self._path = _Path()
        self._camera_frame = _CameraFrame()
        self._shown_in = ""  # the frame of the anchors and points that are to be seen

    def draw(self, output: Output) -> list[Message]:
        """Return the messages about an output; without a pose they take the last anchors down."""
        captured, result = output.captured, output.result
        drawn: dict[str, Any] = {"annotations": annotate(captured.frame, result)}
        if isinstance(result, Localized) and output.pose is not None:
            pose = decode_pose(output.pose)
            self._shown_in = pose.frame_id
            drawn["anchors"] = show_anchors(result, pose)
            drawn["points"] = show_points(result.support, pose.frame_id, pose.time_ns)
            camera_frame = self._camera_frame.of(captured)
            drawn["transforms"] = place_camera(result.cam_from_world, camera_frame, pose)
            if self._path.extend(pose):
                drawn["path"] = show_path(self._path.positions, self._path.edges, pose)
        else:
            self._path.interrupt()
            if self._shown_in:
                drawn["anchors"] = clear_scene(output.time_ns)
                drawn["points"] = show_points(None, self._shown_in, output.time_ns)
                self._shown_in = ""
        now_ns = captured.log_time_ns
        return [
            Message(self._channels[name], message.SerializeToString(), now_ns, now_ns)
            for name, message in drawn.items()
        ]


class _CameraFrame:
    """Knows the frame_id of the images that are shown."""

    def __init__(self) -> None:
        self._calibration: Message | None = None
        self._frame_id = CAMERA_FRAME

    def of(self, captured: Captured) -> str:
        message = captured.calibration
        if message is not self._calibration:
            self._calibration, self._frame_id = message, CAMERA_FRAME
            if message is not None:
                encoding, schema = message.channel.message_encoding, message.channel.schema_name
                self._frame_id = parse_calibration(encoding, schema, message.data).frame_id
        return self._frame_id


class _Path:
    """Where the body was in the last `PATH_STEPS`, with gaps where it was not known."""

    def __init__(self) -> None:
        self._steps: deque[tuple[NDArray[np.float64], bool]] = deque(maxlen=PATH_STEPS)
        self._is_connected = False  # to the step before
        self._frame_id = ""
        self._step_ns = self._shown_ns = -PATH_PERIOD_NS

    @property
    def positions(self) -> NDArray[np.float64]:
        """Its places (N, 3)."""
        return np.array([position for position, _ in self._steps])

    @property
    def edges(self) -> list[int]:
        """Which of them are connected, two by two."""
        steps = enumerate(self._steps)
        return [end for i, (_, connected) in steps if i and connected for end in (i - 1, i)]

    def interrupt(self) -> None:
        self._is_connected = False

    def extend(self, pose: PoseStamped) -> bool:
        """Go on to a pose, and say whether it is time to show the path."""
        if pose.frame_id != self._frame_id:
            self._steps.clear()
            self._frame_id = pose.frame_id
            self._step_ns = self._shown_ns = -PATH_PERIOD_NS
        if abs(pose.time_ns - self._step_ns) < PATH_STEP_NS:
            return False
        self._step_ns = pose.time_ns
        self._steps.append((pose.world_from_body.t, self._is_connected))
        self._is_connected = True
        if abs(pose.time_ns - self._shown_ns) < PATH_PERIOD_NS:
            return False
        self._shown_ns = pose.time_ns
        return True
