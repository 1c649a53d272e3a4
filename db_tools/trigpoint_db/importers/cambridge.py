"""Cambridge Landmarks (Kendall et al., ICCV 2015): buildings filmed by phone, a folder for each.

`dataset_train.txt` and `dataset_test.txt` have three lines of heading, then `name x y z w p q r`:
the camera's POSITION in the world, and the rotation from world to camera as a quaternion. The
focal lengths and the distortion stand in `reconstruction.nvm` only, by the names that the images
had as JPEG. Images that it does not have cannot be used, nor those that it placed kilometres away
(ACE leaves them out as well).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np

from trigpoint.errors import ConfigError
from trigpoint_db.importers.base import Dataset, PosedImage, read_image_size
from trigpoint_db.importers.nvm import NvmCamera, read_nvm
from trigpoint_db.poses import pose_from_center, read_lines, read_rows

_HEADING_LINES = 3
_FARTHEST_M = 10_000.0


def detect(root: Path) -> bool:
    """Say whether `root` is the folder of a scene."""
    return (root / "dataset_train.txt").is_file()


def read(root: Path, *, images: Path | None = None) -> Dataset:
    """Read the scene in `root`; the images are there, too, or in `images`."""
    folder = root if images is None else images
    cameras = {
        _stem(name): camera for name, camera in read_nvm(root / "reconstruction.nvm").items()
    }
    mapped, tested = (
        list(_read_list(root / f"dataset_{split}.txt", folder, cameras))
        for split in ("train", "test")
    )
    return Dataset.from_split(folder, mapped, tested)


def _read_list(path: Path, folder: Path, cameras: Mapping[str, NvmCamera]) -> Iterator[PosedImage]:
    lines = read_lines(path)
    heading = [line for _, line in islice(lines, _HEADING_LINES)]
    if not heading or not heading[0].startswith("Visual Landmark Dataset"):
        raise ConfigError(
            f"{path}:1: expected 'Visual Landmark Dataset V1' and two more lines of heading"
        )
    entries = ((where, line) for where, line in lines if line)
    for where, name, values in read_rows(entries, "name x y z w p q r"):
        cam_from_world = pose_from_center(where, values[3:], values[:3])
        if _stem(name) in cameras and np.abs(cam_from_world.t).max() < _FARTHEST_M:
            camera = cameras[_stem(name)].to_camera(*read_image_size(folder / name))
            yield PosedImage(name, camera, cam_from_world)


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
