"""COLMAP's sparse models, text and binary: the cameras and the posed images of them.

The layout is that of https://colmap.github.io/format.html. The rigs and frames that newer versions
write beside are not needed: every image still has its own cam_from_world.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trigpoint.camera import PARAMETERS, Camera
from trigpoint.errors import ConfigError
from trigpoint.output import write_atomically
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.poses import (
    format_numbers,
    is_writable,
    pose_from_numbers,
    read_lines,
)

# COLMAP's camera models; the place in the list is the number that the binary files hold.
_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
)
_POINT2D_BYTES = 24  # x, y: float64; point3D_id: uint64


@dataclass(frozen=True, eq=False)
class _ImageEntry:
    """An image as the file has it; `where` is for messages."""

    where: str
    name: str
    camera_id: int
    cam_from_world: Rigid3


def detect(root: Path) -> bool:
    """Say whether `root` holds a model, or is a folder of one."""
    return root.is_dir() and _find_files(root) is not None


def read(root: Path, *, images: Path | None = None) -> Dataset:
    """Read the model in `root`; the images are in `images`, by default `root`/images."""
    images = root / "images" if images is None else images
    if not images.is_dir():
        raise ConfigError(f"there is no folder {images}; say where the images are: --images")
    return Dataset(images, read_model(root))


def read_model(folder: Path) -> list[PosedImage]:
    """Read the images of the model in `folder`, its `sparse` or `sparse/0`, sorted by name."""
    cameras_path, images_path = _find_model(folder)
    binary = cameras_path.suffix == ".bin"
    cameras: dict[int, Camera] = {}
    for where, camera_id, camera in (_cameras_binary if binary else _cameras_text)(cameras_path):
        if camera_id in cameras:
            raise ConfigError(f"{where}: camera {camera_id} is in this file twice")
        cameras[camera_id] = camera
    images: dict[str, PosedImage] = {}
    for entry in (_images_binary if binary else _images_text)(images_path):
        if entry.camera_id not in cameras:
            raise ConfigError(
                f"{entry.where}: image {entry.name} has camera {entry.camera_id}, "
                f"which is not in {cameras_path}"
            )
        if entry.name in images:
            raise ConfigError(f"{entry.where}: image {entry.name} is in this file twice")
        camera = cameras[entry.camera_id]
        images[entry.name] = PosedImage(entry.name, camera, entry.cam_from_world)
    return [images[name] for name in sorted(images)]


def require_no_model(folder: Path) -> None:
    """Refuse, before any work is done, a folder that a model cannot be written to."""
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise ConfigError(f"{nearest} is no folder; name a new one for the model")
    if not os.access(nearest, os.W_OK):
        raise ConfigError(f"cannot write to {nearest}: permission denied")
    names = [
        f"{part}{kind}" for part in ("cameras", "images", "points3D") for kind in (".txt", ".bin")
    ]
    if any((folder / name).exists() for name in names):
        raise ConfigError(f"{folder} holds a COLMAP model already; name another folder")


def write_model(folder: Path, images: Iterable[PosedImage]) -> None:
    """Write a text model without points, sorted by name; equal cameras become one."""
    images = sorted(images, key=lambda image: image.name)
    camera_ids: dict[Camera, int] = {}
    lines, previous = [], None
    for image_id, image in enumerate(images, 1):
        if not is_writable(image.name) or image.name == previous:
            raise ConfigError(
                f"cannot write the image name {image.name!r} to {folder}: names have to be "
                "different, of valid Unicode, with no space at either end"
            )
        previous = image.name
        camera_id = camera_ids.setdefault(image.camera, len(camera_ids) + 1)
        pose = format_numbers(*image.cam_from_world.quaternion, *image.cam_from_world.t)
        lines.append(f"{image_id} {pose} {camera_id} {image.name}\n\n")
    cameras = [
        f"{camera_id} {camera.model} {camera.width} {camera.height} "
        f"{format_numbers(*camera.to_colmap())}\n"
        for camera, camera_id in camera_ids.items()
    ]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from error
    write_atomically(folder / "cameras.txt", "".join(cameras))
    write_atomically(folder / "points3D.txt", "")  # COLMAP does not open a model without it
    write_atomically(folder / "images.txt", "".join(lines))


def _find_model(folder: Path) -> tuple[Path, Path]:
    """Return the files of the cameras and of the images; like COLMAP, binary ones first."""
    if not folder.is_dir():
        raise ConfigError(f"there is no folder {folder}; give that of a COLMAP model")
    files = _find_files(folder)
    if files is None:
        raise ConfigError(
            f"there is no COLMAP model in {folder}, its sparse or sparse/0: it is cameras.bin and "
            "images.bin, or cameras.txt and images.txt"
        )
    return files


def _find_files(folder: Path) -> tuple[Path, Path] | None:
    for candidate in (folder, folder / "sparse", folder / "sparse" / "0"):
        for suffix in (".bin", ".txt"):
            cameras, images = candidate / f"cameras{suffix}", candidate / f"images{suffix}"
            if cameras.is_file() and images.is_file():
                return cameras, images
    return None


def _cameras_text(path: Path) -> Iterator[tuple[str, int, Camera]]:
    for where, line in read_lines(path):
        if not line or line.startswith("#"):
            continue
        camera_id, *camera = line.split(maxsplit=1)
        try:
            yield where, int(camera_id), Camera.from_text("".join(camera))
        except ValueError:
            raise ConfigError(
                f"{where}: expected 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...', not {line[:80]!r}"
            ) from None
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error


def _images_text(path: Path) -> Iterator[_ImageEntry]:
    lines = read_lines(path)
    for where, line in lines:
        if not line or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)  # the name, the last, may hold spaces
        try:
            _, camera_id, name = int(words[0]), int(words[8]), words[9]
            values = [float(word) for word in words[1:8]]
        except (ValueError, IndexError):
            raise ConfigError(
                f"{where}: expected 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME', "
                f"not {line[:80]!r}"
            ) from None
        yield _ImageEntry(where, name, camera_id, pose_from_numbers(where, values))
        # The line after an image's is its points', also where it is empty: that one counts.
        where_points, points = next(lines, ("", ""))
        if not _is_points2d(points):
            raise ConfigError(
                f"{where_points}: expected the 2D points of {name} as 'X Y POINT3D_ID ...', or "
                f"an empty line if it has none, not {points[:80]!r}"
            )


def _is_points2d(line: str) -> bool:
    words = line.split()
    return not words or (len(words) % 3 == 0 and words[-1].removeprefix("-").isdecimal())


def _cameras_binary(path: Path) -> Iterator[tuple[str, int, Camera]]:
    file = _BinaryFile(path)
    (num_cameras,) = file.unpack("Q")
    for _ in range(num_cameras):
        camera_id, model_id, width, height = file.unpack("IiQQ")
        where = f"{path}: camera {camera_id}"
        model = _MODELS[model_id] if 0 <= model_id < len(_MODELS) else f"number {model_id}"
        params = file.unpack(f"{len(PARAMETERS.get(model, ()))}d")
        try:
            yield where, camera_id, Camera.from_colmap(model, width, height, params)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error


def _images_binary(path: Path) -> Iterator[_ImageEntry]:
    file = _BinaryFile(path)
    (num_images,) = file.unpack("Q")
    for _ in range(num_images):
        image_id, *values, camera_id = file.unpack("I7dI")
        where = f"{path}: image {image_id}"
        name = file.read_string()
        yield _ImageEntry(where, name, camera_id, pose_from_numbers(where, values))
        (num_points2d,) = file.unpack("Q")
        file.skip(num_points2d * _POINT2D_BYTES)


class _BinaryFile:
    """Little-endian values one after another; mapped, so that what is skipped is not read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        try:
            with path.open("rb") as file:
                empty = path.stat().st_size == 0  # which cannot be mapped
                self._data = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise ConfigError(f"cannot read {path}: {error.strerror}") from error

    def unpack(self, layout: str) -> tuple[Any, ...]:
        start = self._offset
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self._data, start)

    def read_string(self) -> str:
        """Read up to the next zero byte."""
        start = self._offset
        end = self._data.find(b"\0", start)
        self.skip(end + 1 - start if end >= 0 else len(self._data))
        try:
            return self._data[start:end].decode()
        except UnicodeDecodeError as error:
            raise ConfigError(
                f"{self._path}: the name {self._data[start:end][:80]!r} is not UTF-8 text"
            ) from error

    def skip(self, num_bytes: int) -> None:
        self._offset += num_bytes
        if self._offset > len(self._data):
            raise ConfigError(f"{self._path} is cut off: it ends at byte {len(self._data)}")
