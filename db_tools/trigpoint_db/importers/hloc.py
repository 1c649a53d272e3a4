"""Lists in hloc's form: `name MODEL width height params...`, and poses of all or some of them.

Images with a pose in the other file, `name qw qx qy qz tx ty tz`, are mapped; the others are
queries.
"""

from __future__ import annotations

from pathlib import Path

from trigpoint.errors import ConfigError
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.poses import read_poses, read_queries


def detect(root: Path) -> bool:
    """Say whether `root` may be a list."""
    return root.is_file() and root.suffix == ".txt"


def read(root: Path, *, images: Path | None = None, poses: Path | None = None) -> Dataset:
    """Read the list `root`; the images are in `images` or in the folder of that name beside it."""
    if not root.is_file():
        raise ConfigError(f"{root} is no list of images; name a file")
    if poses is None:
        raise ConfigError(f"{root} is a list of images; name the file of their poses: --poses")
    listed, posed = read_queries(root), read_poses(poses)
    mapped = [PosedImage(q.name, q.camera, posed[q.name]) for q in listed if q.name in posed]
    queries = [query for query in listed if query.name not in posed]
    return Dataset(root.parent / "images" if images is None else images, mapped, queries)
