"""nerfstudio's, instant-ngp's and NeRF's transforms.json.

https://docs.nerf.studio/quickstart/data_conventions.html; what instant-ngp makes of it is in its
src/nerf_loader.cu. `transform_matrix` takes a camera's coordinates to the world's; the camera is
OpenGL's: x to the right, y up, looking along -z. Principal points are COLMAP's: the top-left pixel
centre is at (0.5, 0.5), and without cx and cy they are the middle of the image. Intrinsics stand at
the top, or with a frame, which then count, as focal lengths or as angles of view.

nerfstudio turns (and may scale) the world it is given, and notes `applied_transform` and
`applied_scale`: these are undone, so that a map has the coordinates of the survey. What
instant-ngp's colmap2nerf does to the world it does not note.

NeRF's synthetic scenes are in transforms_train.json, _val and _test, name files without a suffix,
and know their images' size from these. The images of val and test, there and where nerfstudio lists
them, are queries.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, PosedImage, pose_from_matrix, read_image_size

_SUFFIXES = (".png", ".jpg", ".jpeg")  # instant-ngp's first, in its order
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_FISHEYE = "OPENCV_FISHEYE"
_FOREIGN_LENSES = ("ftheta_p0", "latlong", "equirectangular")  # instant-ngp's own
_OPENGL_FROM_OPENCV = Rigid3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


def detect(root: Path) -> bool:
    """Say whether `root` is such a file, or a folder with one."""
    return root.suffix == ".json" or (root.is_dir() and _find_file(root) is not None)


def read(root: Path) -> Dataset:
    """Read the file `root`, or those of the folder `root`."""
    path = _find_file(root) if root.is_dir() else root
    if path is None:
        raise ConfigError(f"there is no transforms.json or transforms_train.json in {root}")
    splits = [path]
    if path.name == "transforms_train.json":
        others = (path.with_name(f"transforms_{split}.json") for split in ("val", "test"))
        splits += [other for other in others if other.is_file()]
    images: dict[str, PosedImage] = {}
    queries: set[str] = set()
    for split in splits:
        file = _File(split)
        frames = list(file.images())
        for image in frames:
            if image.name in images:
                raise ConfigError(f"{split}: {image.name} is there twice; remove one")
            images[image.name] = image
        queries |= file.held_out() if split is path else {image.name for image in frames}
    unknown = queries - images.keys()
    if unknown:
        raise ConfigError(f"{path}: {min(unknown)} is listed for val or test but has no frame")
    mapped, tested = images.keys() - queries, images.keys() & queries
    return Dataset.from_split(
        path.parent, [images[name] for name in sorted(mapped)], [images[n] for n in sorted(tested)]
    )


def _find_file(folder: Path) -> Path | None:
    names = ("transforms.json", "transforms_train.json")
    return next((folder / name for name in names if (folder / name).is_file()), None)


class _File:
    """One file, and the images in its folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._contents = json.loads(path.read_bytes())
        except OSError as error:
            raise ConfigError(f"cannot read {path}: {error.strerror}") from error
        except json.JSONDecodeError as error:
            raise ConfigError(f"{path}:{error.lineno}: it is not JSON: {error.msg}") from error
        except (UnicodeDecodeError, RecursionError) as error:
            raise ConfigError(f"cannot read {path}: it is not JSON") from error
        frames = self._contents.get("frames") if isinstance(self._contents, dict) else None
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise ConfigError(f"{path}: there is no list of frames; it is no transforms.json")
        self._frames: list[dict[str, Any]] = frames
        self._size: tuple[int, int] | None = None  # of images whose frames do not tell it

    def images(self) -> Iterator[PosedImage]:
        """Yield the frames as posed images."""
        survey_from_world, scale = self._read_world()
        for number, frame in enumerate(self._frames):
            where = f"{self._path}: frame {number}"
            name = self._find_image(where, frame.get("file_path"))
            where += f" ({name})"
            world_from_opengl = pose_from_matrix(where, _rows(frame.get("transform_matrix")))
            world_from_cam = world_from_opengl @ _OPENGL_FROM_OPENCV
            world_from_cam = Rigid3(world_from_cam.R, world_from_cam.t / scale)
            camera = self._camera(where, name, frame)
            yield PosedImage(name, camera, (survey_from_world @ world_from_cam).inverse())

    def held_out(self) -> set[str]:
        """Return the names that nerfstudio lists for validation and tests."""
        listed: set[str] = set()
        for key in ("val_filenames", "test_filenames"):
            names = self._contents.get(key, [])
            if not isinstance(names, list):
                raise ConfigError(f"{self._path}: {key} has to be a list of names")
            listed.update(self._find_image(f"{self._path}: {key}", name) for name in names)
        return listed

    def _read_world(self) -> tuple[Rigid3, float]:
        """Read what nerfstudio has done to the world: the inverse of it, and the scale."""
        scale = _get(str(self._path), self._contents, "applied_scale", 1.0)
        if scale <= 0:
            raise ConfigError(f"{self._path}: the applied_scale {scale} has to be positive")
        if (rows := self._contents.get("applied_transform")) is None:
            return Rigid3.identity(), scale
        where = f"{self._path}: applied_transform"
        return pose_from_matrix(where, _rows(rows)).inverse(), scale

    def _find_image(self, where: str, name: object) -> str:
        """Return the name of a file that is there, with the suffix that it may lack."""
        if not isinstance(name, str) or not name:
            raise ConfigError(f"{where}: file_path has to be the name of an image, not {name!r}")
        name = str(PurePosixPath(name.replace("\\", "/")))  # without a ./ in front
        folder = self._path.parent
        if (folder / name).is_file():
            return name
        return next((name + s for s in _SUFFIXES if (folder / (name + s)).is_file()), name)

    def _camera(self, where: str, name: str, frame: Mapping[str, Any]) -> Camera:
        both = {**self._contents, **frame}
        if {"w", "h"} <= both.keys():
            size = int(_get(where, both, "w")), int(_get(where, both, "h"))
        else:
            size = self._size = self._size or read_image_size(self._path.parent / name)
        width, height = size
        fx = _focal_px(where, frame, "x", width) or _focal_px(where, self._contents, "x", width)
        fy = _focal_px(where, frame, "y", height) or _focal_px(where, self._contents, "y", height)
        if fx is None and fy is None:
            raise ConfigError(f"{where}: neither fl_x nor camera_angle_x tells the focal length")
        cx, cy = _get(where, both, "cx", width / 2), _get(where, both, "cy", height / 2)
        model, distortion = _lens(where, both)
        try:
            focal = [value for value in (fx, fy) if value is not None]
            return Camera.from_colmap(
                model, width, height, (focal[0], focal[-1], cx, cy, *distortion)
            )
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error


def _focal_px(where: str, level: Mapping[str, Any], axis: str, size_px: int) -> float | None:
    """Read a focal length as instant-ngp does: `x_fov` is in degrees, `camera_angle_x` is not."""
    if f"{axis}_fov" in level:
        angle_rad = math.radians(_get(where, level, f"{axis}_fov"))
    elif f"fl_{axis}" in level:
        return _get(where, level, f"fl_{axis}")
    elif f"camera_angle_{axis}" in level:
        angle_rad = _get(where, level, f"camera_angle_{axis}")
    else:
        return None
    if not 0 < angle_rad < math.pi:
        raise ConfigError(f"{where}: {angle_rad} rad is no angle of view")
    return size_px / 2 / math.tan(angle_rad / 2)


def _lens(where: str, values: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Return the model and its distortion, from what the file and the frame say."""
    model = values.get("camera_model", "OPENCV")
    foreign = [key for key in _FOREIGN_LENSES if values.get(key)]
    if foreign or model not in (*_PERSPECTIVE, _FISHEYE):
        raise ConfigError(
            f"{where}: images of a {foreign[0] if foreign else model} lens are not supported; "
            f"undistort them to one of {', '.join((*_PERSPECTIVE, _FISHEYE))}"
        )
    k1, k2, k3, k4, p1, p2 = (
        _get(where, values, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    if model == _FISHEYE or values.get("is_fisheye") is True:
        return _FISHEYE, (k1, k2, k3, k4)
    if k4 != 0:
        raise ConfigError(
            f"{where}: k4 of a lens that is no fisheye is not supported; fit a lens of k1 to k3, "
            "or say is_fisheye"
        )
    if k3 != 0:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())


def _get(where: str, values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where}: {key} has to be a number, not {value!r}")
    return float(value)


def _rows(matrix: object) -> list[float]:
    """Flatten a matrix of 4 rows, or of the 3 that count, for `pose_from_matrix` to judge."""
    rows = matrix if isinstance(matrix, list) else []
    values = [value for row in rows if isinstance(row, list) for value in row]
    numbers = [v if isinstance(v, int | float) else math.nan for v in values]
    return [*numbers, 0.0, 0.0, 0.0, 1.0] if len(numbers) == 12 else numbers
