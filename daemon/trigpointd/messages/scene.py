"""What a viewer shows in the map: anchors, latent points, the path, and where the camera is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from numpy.typing import NDArray

from trigpoint.frame import Localized, Support
from trigpoint.rigid import Rigid3
from trigpointd.messages.cdr import PoseStamped

Array = NDArray[np.float64]

BODY_FRAME = "body"

_GREEN = Color(r=0.1, g=0.9, b=0.5, a=1.0)
_FAINT_GREEN = Color(r=0.1, g=0.9, b=0.5, a=0.3)
_GRAY = Color(r=0.6, g=0.6, b=0.6, a=0.7)
_BLUE = Color(r=0.35, g=0.7, b=0.9, a=1.0)
# A pyramid with its tip at a camera's center, of a depth of 1.
_PYRAMID = np.array([[0, 0, 0], [-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
_EDGES = np.array([0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1])
_PYRAMID_RATIO = 0.05  # of the depth of what the frame shows


def show_anchors(result: Localized, pose: PoseStamped) -> SceneUpdate:
    """Draw the anchors with their names and how many of the pose's inliers each gave.

    Those that gave any are green, with a line to the camera, the others gray.
    """
    support, statistics = result.support, result.statistics
    # A power of two, lest the anchors breathe from frame to frame.
    size = 2.0 ** np.round(np.log2(_PYRAMID_RATIO * statistics.depth))
    world_from_anchors = support.anchors_from_world.inverse()
    corners = world_from_anchors[:, None].apply(size * _PYRAMID)
    used = np.array(statistics.anchor_inliers) > 0
    pyramids = [
        _lines(
            corners[which].reshape(-1, 3),
            (_EDGES + len(_PYRAMID) * np.arange(which.sum())[:, None]).ravel().tolist(),
            color,
            width_px=1.5,
        )
        for which, color in ((used, _GREEN), (~used, _GRAY))
    ]
    ends = np.vstack([result.cam_from_world.center, world_from_anchors.t[used]])
    rays = [end for anchor in range(1, len(ends)) for end in (0, anchor)]
    names = [
        TextPrimitive(
            pose=_pose(center),
            billboard=True,
            font_size=11.0,
            scale_invariant=True,
            color=_GREEN if count else _GRAY,
            text=f"{name} ({count})",
        )
        for name, center, count in zip(
            statistics.anchors, world_from_anchors.t, statistics.anchor_inliers, strict=True
        )
    ]
    lines = [*pyramids, _lines(ends, rays, _FAINT_GREEN, width_px=1.0)]
    return SceneUpdate(entities=[_entity("anchors", pose, lines, names)])


def clear_scene(time_ns: int) -> SceneUpdate:
    """Take everything on a topic down."""
    deletion = SceneEntityDeletion(type=SceneEntityDeletion.ALL)
    deletion.timestamp.FromNanoseconds(time_ns)
    return SceneUpdate(deletions=[deletion])


def show_points(support: Support | None, frame_id: str, time_ns: int) -> PointCloud:
    """Show the latent points that agree with a pose; about its center, as float32 is not precise.

    None takes them down.
    """
    center, offsets = np.zeros(3), np.empty((0, 3))
    if support is not None:
        center = support.cam_from_world.center
        offsets = support.points3d[support.inliers] - center
    fields = [
        PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32)
        for i, name in enumerate("xyz")
    ]
    message = PointCloud(
        frame_id=frame_id,
        pose=_pose(center),
        point_stride=12,
        fields=fields,
        data=offsets.astype("<f4").tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    return message


def show_path(positions: Array, edges: Iterable[int], pose: PoseStamped) -> SceneUpdate:
    """Draw positions (N, 3) with lines between pairs of them."""
    line = _lines(positions, edges, _BLUE, width_px=2.0)
    return SceneUpdate(entities=[_entity("path", pose, [line])])


def place_camera(cam_from_world: Rigid3, camera_frame: str, pose: PoseStamped) -> FrameTransforms:
    """Say where the body is in the map, and the camera on the body."""
    transforms = [_transform(pose.world_from_body, pose.frame_id, BODY_FRAME, pose.time_ns)]
    if camera_frame not in ("", pose.frame_id, BODY_FRAME):
        body_from_camera = (cam_from_world @ pose.world_from_body).inverse()
        transforms.append(_transform(body_from_camera, BODY_FRAME, camera_frame, pose.time_ns))
    return FrameTransforms(transforms=transforms)


def _transform(parent_from_child: Rigid3, parent: str, child: str, time_ns: int) -> FrameTransform:
    pose = _pose(parent_from_child.t, parent_from_child.quaternion)
    message = FrameTransform(
        parent_frame_id=parent,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
    )
    message.timestamp.FromNanoseconds(time_ns)
    return message


def _entity(
    id_: str,
    pose: PoseStamped,
    lines: Sequence[LinePrimitive],
    texts: Sequence[TextPrimitive] = (),
) -> SceneEntity:
    # Without indices a viewer would take all points in turn.
    shown = [line for line in lines if line.indices]
    entity = SceneEntity(id=id_, frame_id=pose.frame_id, lines=shown, texts=texts)
    entity.timestamp.FromNanoseconds(pose.time_ns)
    return entity


def _lines(points: Array, edges: Iterable[int], color: Color, *, width_px: float) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitive.LINE_LIST,
        pose=_pose(np.zeros(3)),
        thickness=width_px,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=z) for x, y, z in points.tolist()],
        indices=edges,
        color=color,
    )


def _pose(position: Array, wxyz: Iterable[float] = (1.0, 0.0, 0.0, 0.0)) -> Pose:
    (x, y, z), (qw, qx, qy, qz) = position, wxyz
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
