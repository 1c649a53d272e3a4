"""Images and calibrations in the fields that Foxglove's and ROS 2's messages have in common.

Both put the centre of the top-left pixel at (0, 0), as Trigpoint does.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.images import decode_gray

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


def choose_calibration(
    image_topic: str, topics: Collection[str], is_in_frame: Callable[[str], bool]
) -> str:
    """Return which calibration is that of the camera of an image topic.

    It lies in a namespace around the images (`/cam/camera_info` for `/cam/image_raw/compressed`),
    the innermost if there are several; where that leaves a choice, `is_in_frame` tells of a
    calibration's topic whether it has the images' frame_id.
    """
    path = _namespace(image_topic)
    around = {t: len(_namespace(t)) for t in topics if path[: len(_namespace(t))] == _namespace(t)}
    found = [t for t, depth in around.items() if depth == max(around.values())] or list(topics)
    if len(around) == 0 or len(found) > 1:
        found = [topic for topic in found if is_in_frame(topic)]
    if len(found) != 1:
        raise SourceError(
            f"no calibration for the images on {image_topic}, or more than one "
            f"(calibrations on: {', '.join(topics) or 'none'}); record the camera's "
            "sensor_msgs/msg/CameraInfo or foxglove.CameraCalibration in the images' namespace"
        )
    return found[0]


def _namespace(topic: str) -> list[str]:
    return topic.strip("/").split("/")[:-1]


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
