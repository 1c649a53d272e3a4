"""Submission files of the benchmark at https://www.visuallocalization.net/submission/.

A line is `name qw qx qy qz tx ty tz`, cam_from_world. Names of Aachen Day-Night are those of the
files, without folders; names of RobotCar Seasons have the camera before them, `rear/TIME.jpg`. A
query without a line counts as not localized.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath

from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.poses import write_poses


def _name_in_aachen(name: PurePosixPath) -> str:
    return name.name


def _name_in_robotcar(name: PurePosixPath) -> str:
    if name.parent.name != "rear":
        raise ConfigError(f"{name} is not CONDITION/rear/TIME.jpg: only these are judged")
    return f"rear/{name.stem}.jpg"


BENCHMARKS: dict[str, Callable[[PurePosixPath], str]] = {
    "aachen": _name_in_aachen,
    "robotcar": _name_in_robotcar,
}


def write_submission(benchmark: str, poses: Mapping[str, Rigid3], out: Path) -> None:
    """Write cam_from_world of queries, by their names in the data set, in a benchmark's form."""
    if benchmark not in BENCHMARKS:
        raise ConfigError(f"there is no benchmark {benchmark!r}; use {' or '.join(BENCHMARKS)}")
    submitted: dict[str, Rigid3] = {}
    for name, cam_from_world in poses.items():
        short = BENCHMARKS[benchmark](PurePosixPath(name))
        if short in submitted:
            raise ConfigError(f"two poses are of an image {short}; leave one out")
        submitted[short] = cam_from_world
    write_poses(out, submitted)
