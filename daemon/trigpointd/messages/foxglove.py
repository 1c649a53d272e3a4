"""Foxglove's messages of a camera that sends none, so that a log of it replays."""

from __future__ import annotations

from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap_protobuf.schema import build_file_descriptor_set

from trigpoint.camera import Camera
from trigpoint.camera_messages import Image
from trigpoint.frame import Frame
from trigpointd.sources.base import Channel, Message

CAMERA_FRAME = "camera"
_DISTORTION = {"OPENCV_FISHEYE": "kannala_brandt", "FULL_OPENCV": "rational_polynomial"}


def make_channel(topic: str, kind: Any) -> Channel:
    """Describe a topic for messages of a kind of Foxglove's."""
    schema = build_file_descriptor_set(kind).SerializeToString()
    return Channel(topic, "protobuf", kind.DESCRIPTOR.full_name, "protobuf", schema)


_CALIBRATION = make_channel("/camera/calibration", CameraCalibration)
_RAW = make_channel("/camera/image", RawImage)
_COMPRESSED = make_channel("/camera/image", CompressedImage)


def calibration_message(camera: Camera, log_time_ns: int) -> Message:
    """Write a camera's intrinsics."""
    model, distortion = "plumb_bob", [*camera.distortion, 0.0]  # with k3
    if camera.model in _DISTORTION:
        model, distortion = _DISTORTION[camera.model], list(camera.distortion)
    message = CameraCalibration(
        frame_id=CAMERA_FRAME,
        width=camera.width,
        height=camera.height,
        distortion_model=model,
        D=distortion,
        K=camera.K.ravel(),
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[*camera.K[0], 0, *camera.K[1], 0, *camera.K[2], 0],
    )
    message.timestamp.FromNanoseconds(log_time_ns)
    return Message(_CALIBRATION, message.SerializeToString(), log_time_ns, log_time_ns)


def image_message(image: Image, log_time_ns: int, sequence: int) -> Message:
    """Write an image: a JPEG file where it has no encoding, else its rows."""
    channel, message = _COMPRESSED, CompressedImage(format="jpeg", data=image.data)
    if image.encoding is not None:
        channel, message = (
            _RAW,
            RawImage(
                encoding=image.encoding,
                width=image.width,
                height=image.height,
                step=image.step,
                data=image.data,
            ),
        )
    message.frame_id = CAMERA_FRAME
    message.timestamp.FromNanoseconds(image.time_ns)
    return Message(channel, message.SerializeToString(), log_time_ns, log_time_ns, sequence)


def gray_image(frame: Frame) -> Image:
    """Return the gray levels of a frame: all that a replay needs of its pixels."""
    height, width = frame.image.shape
    data = frame.image.tobytes()
    return Image(frame.time_ns, CAMERA_FRAME, data, "mono8", width, height, width)
