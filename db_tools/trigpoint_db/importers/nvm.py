"""VisualSFM's NVM files (http://ccwu.me/vsfm/doc.html#nvm): the cameras of the first model.

A camera is a line `name focal qw qx qy qz cx cy cz radial 0`: the rotation from world to camera,
the camera's CENTER in the world, and the radial distortion d of an image point m, relative to the
image's centre and divided by the focal length. VisualSFM takes the distortion off the point,

    u = m (1 + d |m|^2),

where COLMAP and OpenCV put it on, m = u (1 + k1 |u|^2 + k2 |u|^4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.poses import pose_from_center, read_entries, read_rows

_MAX_FIT_ERROR_PX = 0.5


@dataclass(frozen=True, eq=False)
class NvmCamera:
    """A camera as the file has it; `where` is for messages."""

    where: str
    focal_px: float
    radial: float
    cam_from_world: Rigid3

    def to_camera(self, width: int, height: int) -> Camera:
        """Make a camera of images of this size, whose centre is the principal point."""
        try:
            return _radial_camera(self.focal_px, self.radial, width, height)
        except ConfigError as error:
            raise ConfigError(f"{self.where}: {error}") from error


def read_nvm(path: Path) -> dict[str, NvmCamera]:
    """Read the cameras of the first model, which is the largest, by the names of their images."""
    entries = read_entries(path)
    where, line = next(entries, (str(path), ""))
    if not line.startswith("NVM_V3"):
        raise ConfigError(f"{where}: expected 'NVM_V3', the head of an NVM file, not {line[:80]!r}")
    where, line = next(entries, (str(path), ""))
    if not line.isdecimal():
        raise ConfigError(f"{where}: expected the number of cameras, not {line[:80]!r}")
    cameras: dict[str, NvmCamera] = {}
    layout = "name focal qw qx qy qz cx cy cz radial 0"
    for where, name, values in read_rows(islice(entries, int(line)), layout):
        focal, radial = values[0], values[8]
        cam_from_world = pose_from_center(where, values[1:5], values[5:8])
        cameras[name.removeprefix("./")] = NvmCamera(where, focal, radial, cam_from_world)
    if len(cameras) != int(line):
        raise ConfigError(f"{path} is cut off: it has {len(cameras)} of its {line} cameras")
    return cameras


@lru_cache(maxsize=1024)
def _radial_camera(focal_px: float, radial: float, width: int, height: int) -> Camera:
    """Fit k1 and k2 to the inverse of VisualSFM's model, over the image up to its corners."""
    if not (0 < focal_px < math.inf and math.isfinite(radial)):
        raise ConfigError(f"the focal length {focal_px} or the distortion {radial} is not usable")
    distorted = np.linspace(0, np.hypot(width, height) / 2 / focal_px, 200)
    undistorted = distorted * (1 + radial * distorted**2)
    powers = undistorted[:, None] ** (3, 5)
    k1_k2 = np.linalg.lstsq(powers, distorted - undistorted)[0]
    error_px = focal_px * np.abs(undistorted + powers @ k1_k2 - distorted).max()
    if not error_px < _MAX_FIT_ERROR_PX:
        raise ConfigError(
            f"the radial distortion {radial} at a focal length of {focal_px} px is too strong for "
            f"an image of {width} x {height} px"
        )
    params = (focal_px, width / 2, height / 2, *k1_k2)
    return Camera.from_colmap("RADIAL", width, height, params)
