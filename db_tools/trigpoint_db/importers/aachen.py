"""Aachen Day-Night v1.1 (Zhang et al., IJCV 2021), as the benchmark offers it.

    3D-models/aachen_v_1_1/    cameras.bin, images.bin; or aachen_v_1_1.nvm with
                               database_intrinsics_v1_1.txt, in the form of a query list
    images_upright/            db/, sequences/, query/day/, query/night/; or in images/
    queries/                   day_time_queries_with_intrinsics.txt, night_time_...

The truth of the queries is not public: `trigpoint-db submit aachen` writes what is submitted.
"""

from __future__ import annotations

from pathlib import Path

from trigpoint.errors import ConfigError
from trigpoint_db.importers import colmap
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.importers.nvm import read_nvm
from trigpoint_db.poses import read_queries

_MODEL = Path("3D-models") / "aachen_v_1_1"


def detect(root: Path) -> bool:
    """Say whether `root` is the folder of the data set."""
    return (root / _MODEL).is_dir()


def read(root: Path, *, images: Path | None = None) -> Dataset:
    """Read the data set in `root`, whose images may be elsewhere."""
    if images is None:
        candidates = (root / "images_upright", root / "images" / "images_upright")
        images = next((folder for folder in candidates if folder.is_dir()), candidates[0])
    model = root / _MODEL
    mapped = colmap.read_model(model) if colmap.detect(model) else _read_nvm(model)
    lists = (
        root / "queries" / f"{time}_time_queries_with_intrinsics.txt" for time in ("day", "night")
    )
    return Dataset(images, mapped, [query for path in lists for query in read_queries(path)])


def _read_nvm(model: Path) -> list[PosedImage]:
    """Read the poses of the NVM file, whose focal lengths and distortion the list refines."""
    nvm, intrinsics = model / "aachen_v_1_1.nvm", model / "database_intrinsics_v1_1.txt"
    cameras = {query.name: query.camera for query in read_queries(intrinsics)}
    posed = read_nvm(nvm)
    for name, image in posed.items():
        if name not in cameras:
            raise ConfigError(f"{image.where}: {intrinsics} has no camera of {name}")
    return [PosedImage(name, cameras[name], posed[name].cam_from_world) for name in sorted(posed)]
