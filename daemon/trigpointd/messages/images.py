"""Images and calibrations as Foxglove (protobuf) and ROS 2 (CDR) send them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

from trigpoint.camera import Camera
from trigpoint.camera_messages import Calibration, Image
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpointd.messages.cdr import CdrReader

_NS = 10**9


def to_frame(image: Image, camera: Camera, time_ns: int, name: str) -> Frame:
    """Decode an image that must have its calibration's size."""
    try:
        return Frame(image.gray(), camera, time_ns, name)
    except ConfigError as error:
        raise SourceError(str(error)) from error


def parse_image(message_encoding: str, schema_name: str, data: bytes) -> Image:
    """Read an image message of one of `IMAGE_TYPES`."""
    try:
        return _IMAGE_PARSERS[message_encoding, schema_name](data)
    except DecodeError as error:
        raise SourceError(f"a {schema_name} message cannot be read: {error}") from error


def parse_calibration(message_encoding: str, schema_name: str, data: bytes) -> Calibration:
    """Read a calibration message of one of `CALIBRATION_TYPES`."""
    try:
        return _CALIBRATION_PARSERS[message_encoding, schema_name](data)
    except DecodeError as error:
        raise SourceError(f"a {schema_name} message cannot be read: {error}") from error


def _foxglove_time_ns(timestamp: Any) -> int:
    return int(timestamp.seconds * _NS + timestamp.nanos)


def _foxglove_compressed(data: bytes) -> Image:
    message: CompressedImage = CompressedImage.FromString(data)
    return Image(_foxglove_time_ns(message.timestamp), message.frame_id, message.data)


def _foxglove_raw(data: bytes) -> Image:
    message: RawImage = RawImage.FromString(data)
    return Image(
        _foxglove_time_ns(message.timestamp),
        message.frame_id,
        message.data,
        message.encoding,
        message.width,
        message.height,
        message.step,
    )


def _foxglove_calibration(data: bytes) -> Calibration:
    m: CameraCalibration = CameraCalibration.FromString(data)
    return Calibration(
        m.frame_id, m.width, m.height, m.distortion_model, list(m.D), list(m.K), list(m.P)
    )


def _ros_compressed(data: bytes) -> Image:
    reader = CdrReader(data)
    time_ns, frame_id = reader.header()
    reader.string()  # the format, which the data tell as well
    return Image(time_ns, frame_id, reader.octets())


def _ros_raw(data: bytes) -> Image:
    reader = CdrReader(data)
    time_ns, frame_id = reader.header()
    height, width, encoding = reader.uint32(), reader.uint32(), reader.string()
    reader.numbers("B", 1)  # is_bigendian: all supported encodings are of single bytes
    step = reader.uint32()
    return Image(time_ns, frame_id, reader.octets(), encoding, width, height, step)


def _ros_calibration(data: bytes) -> Calibration:
    reader = CdrReader(data)
    _, frame_id = reader.header()
    height, width, model = reader.uint32(), reader.uint32(), reader.string()
    D, K = reader.numbers("d", reader.uint32()), reader.numbers("d", 9)
    reader.numbers("d", 9)  # R, the rotation of a stereo rectification
    return Calibration(frame_id, width, height, model, D, K, reader.numbers("d", 12))


_IMAGE_PARSERS: dict[tuple[str, str], Callable[[bytes], Image]] = {
    ("protobuf", "foxglove.CompressedImage"): _foxglove_compressed,
    ("protobuf", "foxglove.RawImage"): _foxglove_raw,
    ("cdr", "sensor_msgs/msg/CompressedImage"): _ros_compressed,
    ("cdr", "sensor_msgs/msg/Image"): _ros_raw,
}
_CALIBRATION_PARSERS: dict[tuple[str, str], Callable[[bytes], Calibration]] = {
    ("protobuf", "foxglove.CameraCalibration"): _foxglove_calibration,
    ("cdr", "sensor_msgs/msg/CameraInfo"): _ros_calibration,
}
# Message encoding and schema name of what can be read.
IMAGE_TYPES = frozenset(_IMAGE_PARSERS)
CALIBRATION_TYPES = frozenset(_CALIBRATION_PARSERS)
