"""TUM RGB-D: colour images and the motion capture's poses, of Sturm et al. 2012.

The layout is that of https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: `rgb.txt` with
`time file` lines, `groundtruth.txt` with `time tx ty tz qx qy qz qw`, where the optical centre of
the colour camera was (x to the right, z ahead), at about 100 Hz. Times are seconds with decimals.
Images before the first pose, after the last, or in a gap of the motion capture are left out.

The cameras are those of the same page, in OpenCV's pixel convention. The images of the third are
undistorted already; none fits ROS's default of 525 px, which some loaders take.
"""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint_db.importers.base import Dataset
from trigpoint_db.importers.trajectory import MAX_GAP_S, TimedImage, Trajectory, place_images
from trigpoint_db.poses import pose_from_numbers, read_entries

# k3 is the fifth of OpenCV's coefficients.
CAMERAS = {
    "freiburg1": Camera(
        "FULL_OPENCV",
        640,
        480,
        (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0.0, 0.0, 0.0),
    ),
    "freiburg2": Camera(
        "FULL_OPENCV",
        640,
        480,
        (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172, 0.0, 0.0, 0.0),
    ),
    "freiburg3": Camera("PINHOLE", 640, 480, (535.4, 539.2, 320.1, 247.6)),
}
_NS = 10**9


def detect(root: Path) -> bool:
    """Say whether `root` is a sequence."""
    return (root / "rgb.txt").is_file() and (root / "groundtruth.txt").is_file()


def read(root: Path, *, camera: str | None = None, max_gap: float = MAX_GAP_S) -> Dataset:
    """Read the sequence in `root`, whose name tells the camera if `camera` does not.

    `camera` is freiburg1, freiburg2, freiburg3, or text as `Camera.from_text` takes it; `max_gap`
    is in seconds.
    """
    taken_with = _find_camera(root, camera)
    path = root / "rgb.txt"
    images = []
    for where, line in read_entries(path):
        time, _, name = line.partition(" ")
        if not name:
            raise ConfigError(f"{where}: expected 'time file', not {line[:80]!r}")
        images.append(TimedImage(_time_ns(where, time), name.strip(), taken_with))
    if not images:
        raise ConfigError(f"{path} names no images")
    times_ns = np.array([image.time_ns for image in images])
    world_from_cam, found = _read_truth(root / "groundtruth.txt").at(times_ns, max_gap)
    mapped = place_images(str(path), images, world_from_cam, found)
    return Dataset(root, mapped, num_unposed=len(images) - len(mapped))


def _find_camera(root: Path, camera: str | None) -> Camera:
    if camera is not None:
        return CAMERAS.get(camera) or Camera.from_text(camera)
    named = re.findall(r"fr(?:eiburg)?([123])(?:[_/]|$)", str(root.resolve()))
    if not named:
        raise ConfigError(
            f"the name of {root} does not tell the camera of the sequence; say "
            f"--camera {', '.join(CAMERAS)} or 'MODEL width height params...'"
        )
    return CAMERAS[f"freiburg{named[-1]}"]


def _read_truth(path: Path) -> Trajectory:
    times_ns, poses = [], []
    for where, line in read_entries(path):
        time, *words = line.split()
        try:
            tx, ty, tz, qx, qy, qz, qw = (float(word) for word in words)
        except ValueError:
            raise ConfigError(
                f"{where}: expected 'time tx ty tz qx qy qz qw', not {line[:80]!r}"
            ) from None
        times_ns.append(_time_ns(where, time))
        poses.append(pose_from_numbers(where, (qw, qx, qy, qz, tx, ty, tz)))
    if not poses:
        raise ConfigError(f"{path} holds no poses")
    return Trajectory.from_poses(str(path), times_ns, poses)


def _time_ns(where: str, seconds: str) -> int:
    """Read seconds with decimals, of which a float would lose the last."""
    try:
        time_ns = int(Decimal(seconds) * _NS)
    except (InvalidOperation, ValueError, OverflowError):
        time_ns = -1
    if not 0 <= time_ns < 2**63:
        raise ConfigError(f"{where}: {seconds!r} is no time in seconds")
    return time_ns
