"""What every importer gives: images with cameras and poses, in our conventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.images import read_size
from trigpoint.rigid import Rigid3, quaternion_from_rotation
from trigpoint_db.poses import Query

_HEADER_BYTES = 1 << 18  # of an image file; the size stands behind a thumbnail, or a profile
_MAX_SKEW = 1e-3  # of a rotation printed with a few digits


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of the survey: its camera and where it stood."""

    name: str
    camera: Camera
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class Dataset:
    """Images to map and images to localize, all of them in `images`.

    That is a folder, and names are relative to it, or a recording as `read_frame` takes it.

    Cameras have the pixel convention of `trigpoint.camera`; poses are cam_from_world with x to the
    right, y down, z ahead, in the unit of the data set. `truth` has the poses of those queries that
    have a public one. `num_unposed` images are in neither: their poses are not known.
    """

    images: Path
    mapped: list[PosedImage]
    queries: list[Query] = field(default_factory=list)
    truth: dict[str, Rigid3] = field(default_factory=dict)
    num_unposed: int = 0

    @classmethod
    def from_split(
        cls, images: Path, mapped: list[PosedImage], tested: Sequence[PosedImage]
    ) -> Dataset:
        """Make one where all poses are known: those of `tested` are the truth of the queries."""
        queries = [Query(image.name, image.camera) for image in tested]
        return cls(images, mapped, queries, {image.name: image.cam_from_world for image in tested})


def pose_from_matrix(where: str, values: Sequence[float]) -> Rigid3:
    """Make a transform of the 16 values of a 4 x 4 matrix, row by row; `where` is for messages."""
    if len(values) != 16:
        raise ConfigError(f"{where}: a 4 x 4 matrix has 16 numbers, not {len(values)}")
    matrix = np.array(values, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise ConfigError(f"{where}: the pose is not finite")
    R, t = matrix[:3, :3], matrix[:3, 3]
    skew = np.abs(R @ R.T - np.eye(3)).max()
    if skew > _MAX_SKEW or np.linalg.det(R) < 0 or tuple(matrix[3]) != (0, 0, 0, 1):
        raise ConfigError(
            f"{where}: the matrix is no rigid transform: its upper left has to be a rotation and "
            "its last row 0 0 0 1"
        )
    return Rigid3.from_quaternion(quaternion_from_rotation(R), t)


def read_image_size(path: Path) -> tuple[int, int]:
    """Read the width and height in px of a JPEG or PNG file, decoding nothing."""
    try:
        with path.open("rb") as file:
            return read_size(file.read(_HEADER_BYTES))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except SourceError as error:
        raise ConfigError(f"{path}: {error}") from error
