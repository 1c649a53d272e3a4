"""7-Scenes (Shotton et al., CVPR 2013): rooms filmed with a Kinect, a folder for each scene.

`TrainSplit.txt` and `TestSplit.txt` name sequences; a frame is `seq-01/frame-000000.color.png` with
`.pose.txt`, a 4 x 4 matrix: world_from_cam of the DEPTH camera, as KinectFusion tracked it. The
colour camera sits beside it and has another focal length, 525 px in place of 585. Both are taken
into account as in the "D-SLAM" poses of Brachmann et al. (ICCV 2021) and in ACE, with a published
calibration of a Kinect, since the data set has none.

Brachmann et al. also give poses by structure from motion, and a focal length of each scene
(https://github.com/tsattler/visloc_pseudo_gt_limitations): lines `name qw qx qy qz tx ty tz f`,
cam_from_world of the colour camera, in `SCENE_train.txt` and `SCENE_test.txt` of one folder.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, PosedImage, pose_from_matrix
from trigpoint_db.poses import check_new, pose_from_numbers, read_entries, read_rows

_WIDTH, _HEIGHT = 640, 480
_FOCAL_PX = 525.0
# https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html
_COLOR_FROM_DEPTH = Rigid3(
    np.array(
        [
            [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03],
            [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03],
            [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01],
        ]
    ),
    np.array([-2.5558943178152542e-02, 1.0109636268061706e-04, 2.0318321729487039e-03]),
)


def detect(root: Path) -> bool:
    """Say whether `root` is the folder of a scene."""
    return (root / "TrainSplit.txt").is_file()


def read(root: Path, *, images: Path | None = None, poses: Path | None = None) -> Dataset:
    """Read the scene in `root`; `poses` is a folder of Brachmann et al.'s files."""
    if poses is None:
        mapped, tested = (list(_read_split(root / f"{s}Split.txt")) for s in ("Train", "Test"))
    else:
        scene = root.resolve().name
        mapped, tested = (list(_read_poses(poses / f"{scene}_{s}.txt")) for s in ("train", "test"))
    return Dataset.from_split(root if images is None else images, mapped, tested)


def _read_split(path: Path) -> Iterator[PosedImage]:
    """Read the Kinect's poses; frames on which it was lost, and whose pose is no number, go."""
    camera, sequences = _make_camera(_FOCAL_PX), set[str]()
    for where, line in read_entries(path):
        number = line.removeprefix("sequence")
        if not number.isdecimal():
            raise ConfigError(f"{where}: expected 'sequence1' or the like, not {line[:80]!r}")
        sequence = f"seq-{int(number):02}"
        check_new(where, sequence, sequences)
        sequences.add(sequence)
        files = sorted((path.parent / sequence).glob("frame-*.pose.txt"))
        if not files:
            folder = path.parent / sequence
            raise ConfigError(f"{where}: {folder} holds no frames; unzip {folder}.zip there")
        for file in files:
            matrix = _read_matrix(file)
            if all(map(math.isfinite, matrix)):
                world_from_depth = pose_from_matrix(str(file), matrix)
                name = f"{sequence}/{file.name.removesuffix('.pose.txt')}.color.png"
                yield PosedImage(name, camera, _COLOR_FROM_DEPTH @ world_from_depth.inverse())


def _read_matrix(path: Path) -> list[float]:
    values: list[float] = []
    for where, line in read_entries(path):
        try:
            # Windows wrote "1.#QNAN" and "-1.#INF".
            row = [math.nan if "#" in word else float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != 4:
            raise ConfigError(f"{where}: expected a row of a 4 x 4 matrix, not {line[:80]!r}")
        values += row
    return values


def _read_poses(path: Path) -> Iterator[PosedImage]:
    for where, name, values in read_rows(read_entries(path), "name qw qx qy qz tx ty tz f"):
        try:
            camera = _make_camera(values[7])
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
        yield PosedImage(name, camera, pose_from_numbers(where, values[:7]))


def _make_camera(focal_px: float) -> Camera:
    params = (focal_px, _WIDTH / 2, _HEIGHT / 2)
    return Camera.from_colmap("SIMPLE_PINHOLE", _WIDTH, _HEIGHT, params)
