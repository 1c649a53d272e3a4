"""RobotCar Seasons (Sattler et al., CVPR 2018): a drive through Oxford, in ten conditions.

    3D-models/all-merged/all.nvm     poses of the condition overcast-reference, which is mapped
    images/CONDITION/rear/TIME.jpg   and left/, right/; the models call them .png
    intrinsics/rear_intrinsics.txt   lines `fx 400.0`, fy, cx, cy
    robotcar_v2_train.txt            of version 2: `CONDITION/rear/TIME.png` and a 4 x 4 matrix,
                                     world_from_cam, of some queries

Only the rear camera is evaluated, so only its images are mapped and localized. The other queries'
truth is not public: `trigpoint-db submit robotcar` writes what is submitted.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, PosedImage, pose_from_matrix
from trigpoint_db.importers.nvm import read_nvm
from trigpoint_db.poses import Query, read_entries, read_rows

_MODEL = Path("3D-models") / "all-merged" / "all.nvm"
_REFERENCE = "overcast-reference"
_SIDE_PX = 1024


def detect(root: Path) -> bool:
    """Say whether `root` is the folder of the data set."""
    return (root / _MODEL).is_file()


def read(root: Path, *, images: Path | None = None) -> Dataset:
    """Read the data set in `root`; queries are the images found of the other conditions."""
    images = root / "images" if images is None else images
    camera = _read_camera(root / "intrinsics" / "rear_intrinsics.txt")
    mapped = [
        PosedImage(_to_jpg(name), camera, image.cam_from_world)
        for name, image in sorted(read_nvm(root / _MODEL).items())
        if PurePosixPath(name).parent.name == "rear"
    ]
    names = (path.relative_to(images).as_posix() for path in images.glob("*/rear/*.jpg"))
    queries = [
        Query(name, camera) for name in sorted(names) if not name.startswith(f"{_REFERENCE}/")
    ]
    truth_path = root / "robotcar_v2_train.txt"
    truth = _read_truth(truth_path) if truth_path.is_file() else {}
    return Dataset(images, mapped, queries, truth)


def _read_camera(path: Path) -> Camera:
    """Read a pinhole's parameters, which COLMAP used as they are: in its pixel convention."""
    params: dict[str, float] = {}
    for where, line in read_entries(path):
        try:
            name, value = line.split()
            params[name] = float(value)
        except ValueError:
            raise ConfigError(
                f"{where}: expected 'fx 400.0' or the like, not {line[:80]!r}"
            ) from None
    try:
        pinhole = [params[name] for name in ("fx", "fy", "cx", "cy")]
        return Camera.from_colmap("PINHOLE", _SIDE_PX, _SIDE_PX, pinhole)
    except KeyError as error:
        raise ConfigError(f"{path} has no line '{error.args[0]} ...'") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _read_truth(path: Path) -> dict[str, Rigid3]:
    layout = " ".join(["name", *(f"m{row}{column}" for row in range(4) for column in range(4))])
    return {
        _to_jpg(name): pose_from_matrix(where, values).inverse()
        for where, name, values in read_rows(read_entries(path), layout)
    }


def _to_jpg(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(".jpg"))
