"""Camera models, under COLMAP's names.

The pixel convention inside Trigpoint is OpenCV's: the centre of the top-left pixel is (0, 0).
COLMAP and hloc put it at (0.5, 0.5); `Camera.from_colmap` and `Camera.to_colmap` are the only
places where the two meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError

Array = NDArray[np.float64]

# Parameters of each model, in COLMAP's order: f or fx fy, then cx cy, then distortion.
PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
# cv2.undistortPoints iterates to a fixed point: a few steps are enough near the axis, some
# hundred where a strong lens is nearly flat, at the corners of a 115 degree image.
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 400, 1e-12)
_MAX_ROUND_TRIP_ERROR_PX = 1e-3
MAX_SIDE_PX = 65_535


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Parameters
    ----------
    model : str
        One of `PARAMETERS`.
    width, height : int
        Image size in px.
    params : tuple of float
        In COLMAP's order; cx and cy in the convention of this module.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in PARAMETERS:
            raise ConfigError(
                f"camera model {self.model!r} is not known; use one of {', '.join(PARAMETERS)}"
            )
        names = PARAMETERS[self.model]
        if len(self.params) != len(names):
            raise ConfigError(
                f"camera model {self.model} takes {len(names)} parameters "
                f"({' '.join(names)}), not {len(self.params)}"
            )
        if not all(np.isfinite(self.params)) or min(self.focals_px) <= 0:
            raise ConfigError(
                f"camera parameters {self.params} are not usable: they must be finite and the "
                "focal length positive"
            )
        if not (1 <= self.width <= MAX_SIDE_PX and 1 <= self.height <= MAX_SIDE_PX):
            raise ConfigError(f"camera size {self.width} x {self.height} is not usable")

    @classmethod
    def from_colmap(cls, model: str, width: int, height: int, params: Sequence[float]) -> Camera:
        """Make one from COLMAP's numbers, whose top-left pixel centre is at (0.5, 0.5)."""
        return cls(model, width, height, tuple(float(p) for p in params)).shifted(-0.5)

    def to_colmap(self) -> tuple[float, ...]:
        """Return the parameters in COLMAP's pixel convention."""
        return self.shifted(0.5).params

    @classmethod
    def from_text(cls, text: str) -> Camera:
        """Parse `MODEL width height params...` as COLMAP and hloc write it."""
        words = text.split()
        try:
            model, width, height = words[0], int(words[1]), int(words[2])
            params = [float(word) for word in words[3:]]
        except (IndexError, ValueError):
            raise ConfigError(
                f"cannot read a camera from {text!r}; expected 'MODEL width height params...'"
            ) from None
        return cls.from_colmap(model, width, height, params)

    def to_text(self) -> str:
        """Write `MODEL width height params...` as COLMAP and hloc read it."""
        params = " ".join(f"{p:.10g}" for p in self.to_colmap())
        return f"{self.model} {self.width} {self.height} {params}"

    def shifted(self, offset_px: float) -> Camera:
        """Move the principal point by the same offset in x and y."""
        names = PARAMETERS[self.model]
        params = (
            p + offset_px if name in ("cx", "cy") else p
            for name, p in zip(names, self.params, strict=True)
        )
        return Camera(self.model, self.width, self.height, tuple(params))

    def _get(self, name: str) -> float:
        return self.params[PARAMETERS[self.model].index(name)]

    @property
    def focals_px(self) -> tuple[float, float]:
        """The focal lengths (fx, fy) in px."""
        if "f" in PARAMETERS[self.model]:
            return self._get("f"), self._get("f")
        return self._get("fx"), self._get("fy")

    @property
    def focal_px(self) -> float:
        """The mean focal length in px: divides a threshold in px into a normalised one."""
        return sum(self.focals_px) / 2

    @cached_property
    def K(self) -> Array:
        """The camera matrix (3, 3)."""
        fx, fy = self.focals_px
        return np.array([[fx, 0, self._get("cx")], [0, fy, self._get("cy")], [0, 0, 1.0]])

    @cached_property
    def distortion(self) -> Array:
        """OpenCV's vector: k1 k2 p1 p2, then FULL_OPENCV's k3 to k6; or the fisheye's k1 to k4."""
        names = PARAMETERS[self.model]
        whole = self.model in ("OPENCV_FISHEYE", "FULL_OPENCV")
        wanted = names[4:] if whole else ("k1", "k2", "p1", "p2")
        values = [self._get(name) if name in names else 0.0 for name in wanted]
        return np.array(values, dtype=np.float64)

    def normalize(self, points_px: NDArray[np.floating]) -> Array:
        """Undistort pixels (N, 2) into normalised image coordinates (N, 2) on the plane z = 1.

        Points outside the lens model's range come back as nan.
        """
        points = np.asarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
        if len(points) == 0:
            return np.empty((0, 2))
        if self.model == "OPENCV_FISHEYE":
            out = cv2.fisheye.undistortPoints(points, self.K, self.distortion)
        elif self.distortion.any():
            out = cv2.undistortPoints(points, self.K, self.distortion, criteria=_UNDISTORT)
        else:
            fx, fy = self.focals_px
            plain = (points[:, 0] - (self._get("cx"), self._get("cy"))) / (fx, fy)
            return np.where(np.isfinite(plain).all(axis=1, keepdims=True), plain, np.nan)
        normalized = np.asarray(out, dtype=np.float64).reshape(-1, 2)
        # Outside the model's range OpenCV returns a point all the same, one of another pixel.
        back = self.project(np.column_stack([normalized, np.ones(len(normalized))]))
        error_px = np.abs(back - points[:, 0]).max(axis=1)
        return np.where(error_px[:, None] < _MAX_ROUND_TRIP_ERROR_PX, normalized, np.nan)

    def project(self, points_cam: Array) -> Array:
        """Project points (N, 3) in the camera's frame to pixels (N, 2); nan behind the camera."""
        points = np.ascontiguousarray(points_cam, dtype=np.float64).reshape(-1, 1, 3)
        if len(points) == 0:
            return np.empty((0, 2))
        zero = np.zeros(3)
        if self.model == "OPENCV_FISHEYE":
            px = cv2.fisheye.projectPoints(points, zero, zero, self.K, self.distortion)[0]
        else:
            px = cv2.projectPoints(points, zero, zero, self.K, self.distortion)[0]
        behind = points[:, 0, 2] <= 0
        return np.where(behind[:, None], np.nan, np.asarray(px, np.float64).reshape(-1, 2))
