"""Images and calibrations as Foxglove (protobuf) and ROS 2 (CDR) send them.

Both put the centre of the top-left pixel at (0, 0), as Trigpoint does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpoint.images import decode_gray
from trigpointd.messages.cdr import CdrReader

_NS = 10**9
_MAX_TIME_NS = 2**31 * _NS  # what ROS 2's stamps, and so our poses', can hold
# Bytes a pixel and which of them is the luma.
_LUMA = {
    "mono8": (1, 0),
    "8UC1": (1, 0),
    "nv12": (1, 0),  # the luma plane comes first
    "nv21": (1, 0),
    "yuv422": (2, 1),
    "uyvy": (2, 1),
    "yuv422_yuy2": (2, 0),
    "yuyv": (2, 0),
}
# Bytes a pixel and OpenCV's conversion.
_COLOR = {
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2GRAY),
}
_ENCODINGS = _LUMA | _COLOR
_PINHOLE_MODELS = ("", "plumb_bob", "rational_polynomial")
_FISHEYE_MODELS = ("kannala_brandt", "equidistant", "fisheye")


@dataclass(frozen=True, eq=False)
class Image:
    """An image message; its pixels are still as they were sent.

    Without an `encoding` the data are a compressed file, else rows of `step` bytes.
    """

    time_ns: int  # of capture; 0 where the sender gives none
    frame_id: str
    data: bytes
    encoding: str | None = None
    width: int = 0
    height: int = 0
    step: int = 0

    def __post_init__(self) -> None:
        check_time(self.time_ns)

    def gray(self) -> NDArray[np.uint8]:
        """Decode the pixels to gray levels (height, width)."""
        return self._from_file() if self.encoding is None else self._from_rows(self.encoding)

    def _from_file(self) -> NDArray[np.uint8]:
        return decode_gray(self.data)

    def _from_rows(self, encoding: str) -> NDArray[np.uint8]:
        if encoding not in _ENCODINGS:
            raise SourceError(
                f"image encoding {encoding!r} is not supported; send one of "
                f"{', '.join(sorted(_ENCODINGS))} or a compressed image"
            )
        depth, how = _ENCODINGS[encoding]
        used, needed = self.width * depth, self.height * self.step
        if self.step < used or len(self.data) < needed or not self.width * self.height:
            raise SourceError(
                f"a raw {encoding} image of {self.width} x {self.height} px with rows of "
                f"{self.step} bytes does not fit its {len(self.data)} bytes"
            )
        rows = np.frombuffer(self.data, np.uint8, needed).reshape(self.height, self.step)
        pixels = rows[:, :used].reshape(self.height, self.width, depth)
        if encoding in _LUMA:
            return np.ascontiguousarray(pixels[..., how])
        return cv2.cvtColor(pixels, how).astype(np.uint8, copy=False)


@dataclass(frozen=True)
class Calibration:
    """A calibration message, in the fields that Foxglove and ROS have in common."""

    frame_id: str
    width: int
    height: int
    distortion_model: str
    D: Sequence[float]
    K: Sequence[float]
    P: Sequence[float]

    def camera(self, *, rectified: bool = False) -> Camera:
        """Return the intrinsics of the images, or of the rectified ones: P, without distortion."""
        K = _camera_matrix(self.P, 4) if rectified else _camera_matrix(self.K, 3)
        model, distortion = ("PINHOLE", ()) if rectified else _lens(self.distortion_model, self.D)
        params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion)
        try:
            return Camera(model, self.width, self.height, tuple(float(p) for p in params))
        except ConfigError as error:
            raise SourceError(f"a calibration cannot be used: {error}") from error


def check_time(time_ns: int) -> None:
    """Refuse a time that a pose's stamp cannot hold."""
    if not 0 <= time_ns < _MAX_TIME_NS:
        raise SourceError(f"the capture time {time_ns} ns is out of range")


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


def is_rectified(topic: str) -> bool:
    """Whether ROS's naming says that the images of a topic are rectified: `image_rect*`."""
    return any(part.startswith("image_rect") for part in topic.split("/"))


def _camera_matrix(numbers: Sequence[float], columns: int) -> NDArray[np.float64]:
    """Return the left 3 x 3 of a matrix of three rows."""
    if len(numbers) not in (0, 3 * columns):
        raise SourceError(f"a camera matrix has {len(numbers)} numbers instead of {3 * columns}")
    K = np.reshape(numbers or np.zeros(3 * columns), (3, columns))[:, :3]
    if K[0, 0] == 0 or np.array_equal(K, np.eye(3)):
        raise SourceError(
            "the camera was never calibrated: its camera matrix is zero or the identity; "
            "calibrate it and send the result"
        )
    if K[0, 1] != 0:
        raise SourceError(f"the camera matrix has a skew of {K[0, 1]}, which is not supported")
    return K


def _lens(model: str, D: Sequence[float]) -> tuple[str, Sequence[float]]:
    """Translate a distortion into one of our models and its distortion parameters."""
    first_eight = (*D, *[0.0] * 8)[:8]
    if model not in _PINHOLE_MODELS + _FISHEYE_MODELS or (model == "" and any(D)):
        raise SourceError(
            f"distortion model {model!r} is not supported; use one of "
            f"{', '.join(_PINHOLE_MODELS[1:] + _FISHEYE_MODELS)}, or none"
        )
    known = 4 if model in _FISHEYE_MODELS else 8
    if any(D[known:]):
        raise SourceError(
            f"the {model} distortion {tuple(D)} has more than {known} coefficients; calibrate with "
            "the others fixed at 0"
        )
    if model in _FISHEYE_MODELS:
        return "OPENCV_FISHEYE", first_eight[:4]
    if any(D[4:]):
        return "FULL_OPENCV", first_eight
    return ("OPENCV", first_eight[:4]) if any(D) else ("PINHOLE", ())


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
