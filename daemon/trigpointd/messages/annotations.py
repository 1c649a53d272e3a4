"""What a viewer draws on a frame's image: keypoints, and the verdict where there is no pose."""

from __future__ import annotations

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.frame import Failed, Frame, Localized, Result, Support
from trigpointd.sources.base import BadFrame

_GREEN = Color(r=0.1, g=0.9, b=0.5, a=1.0)  # agrees with a pose that was given
_YELLOW = Color(r=0.95, g=0.9, b=0.25, a=1.0)  # agrees with one that was refused
_RED = Color(r=0.85, g=0.3, b=0.1, a=1.0)  # does not agree
_SHADE = Color(a=0.6)
_UNKNOWN_HEIGHT_PX = 480  # of a frame that cannot be read
_MAX_TEXT = 90
# How protobuf writes an element of `PointsAnnotation.points`: key and length, then x and y.
_POINT = np.dtype([("key", "u1", 2), ("x_key", "u1"), ("x", "<f8"), ("y_key", "u1"), ("y", "<f8")])
_KEYS = np.array(((PointsAnnotation.POINTS_FIELD_NUMBER << 3 | 2, 18), 0x09, 0, 0x11, 0), _POINT)


def annotate(frame: Frame | BadFrame, result: Result | Failed) -> ImageAnnotations:
    """Draw what a result rests on, and say why there is none."""
    camera = frame.camera if isinstance(frame, Frame) else None
    text_px = (camera.height if camera else _UNKNOWN_HEIGHT_PX) / 30
    message = ImageAnnotations()
    support = None if isinstance(result, Failed) else result.support
    if camera is not None and support is not None:
        color = _GREEN if isinstance(result, Localized) else _YELLOW
        message.points.extend(_keypoints(camera, support, color, text_px / 8))
    if not isinstance(result, Localized):
        text = TextAnnotation(
            position=Point2(x=3 * text_px, y=3 * text_px),
            text=f"{result.reason}: {result.detail}"[:_MAX_TEXT],
            font_size=text_px,
            text_color=_YELLOW,
            background_color=_SHADE,
        )
        message.texts.append(text)
    for annotation in (*message.points, *message.texts):
        annotation.timestamp.FromNanoseconds(frame.time_ns)
    return message


def _keypoints(
    camera: Camera, support: Support, color: Color, radius_px: float
) -> tuple[PointsAnnotation, PointsAnnotation]:
    """Dots on the keypoints that agree; lines from the others to where their points project."""
    rays = np.column_stack([support.points2d, np.ones(len(support.points2d))])
    keypoints = camera.project(rays)
    projected = camera.project(support.cam_from_world.apply(support.points3d))
    off = ~support.inliers & np.isfinite(projected).all(axis=1)
    dots = PointsAnnotation(type=PointsAnnotation.POINTS, outline_color=color, thickness=radius_px)
    _add_points(dots, keypoints[support.inliers])
    lines = PointsAnnotation(
        type=PointsAnnotation.LINE_LIST, outline_color=_RED, thickness=radius_px / 2
    )
    _add_points(lines, np.hstack([keypoints[off], projected[off]]).reshape(-1, 2))
    return dots, lines


def _add_points(annotation: PointsAnnotation, points_px: NDArray[np.float64]) -> None:
    """Add points (N, 2), all at once; Foxglove counts from the corner of the top-left pixel."""
    encoded = np.full(len(points_px), _KEYS)
    encoded["x"], encoded["y"] = points_px.T + 0.5
    annotation.MergeFromString(encoded.tobytes())
