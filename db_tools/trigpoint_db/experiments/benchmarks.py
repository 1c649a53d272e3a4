"""The scenes of the public benchmarks, from the folders that their owners offer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from trigpoint.errors import ConfigError
from trigpoint_db.build import check_files
from trigpoint_db.experiments.sets import read_splits
from trigpoint_db.importers import aachen, cambridge, robotcar, seven_scenes
from trigpoint_db.importers.base import Dataset
from trigpoint_db.poses import Query

SEVEN_SCENES = {
    "chess": "Chess",
    "fire": "Fire",
    "heads": "Heads",
    "office": "Office",
    "pumpkin": "Pumpkin",
    "redkitchen": "Kitchen",
    "stairs": "Stairs",
}
CAMBRIDGE = {
    "GreatCourt": "Court",
    "KingsCollege": "King's",
    "OldHospital": "Hospital",
    "ShopFacade": "Shop",
    "StMarysChurch": "St.Mary's",
}
NIGHTS = ("night", "night-rain")  # conditions of RobotCar Seasons
PSEUDO_TRUTH = Path("pgt") / "sfm" / "7scenes"  # in a checkout of its owners' repository
KITCHEN = "7scenes_redkitchen"


@dataclass(frozen=True, eq=False)
class Scene:
    """What is mapped together.

    Parameters
    ----------
    label : str
        What tells it from all others.
    variant : str
        Of one place there may be several: by the poses used, or by the split.
    dataset : Dataset
    column_of : callable
        The column of the published table that a query counts in.
    """

    label: str
    variant: str
    dataset: Dataset
    column_of: Callable[[Query], str]


@dataclass(frozen=True)
class Benchmark:
    """A data set with a published table.

    Parameters
    ----------
    title : str
    table : str
        The name of the published table.
    read : callable
        `read(root, names)`: the scenes of these names, or all.
    submits : str, optional
        Whose form of submission the poses are written in, where the truth is not public.
    """

    title: str
    table: str
    read: Callable[[Path, Sequence[str]], list[Scene]]
    submits: str | None = None


def read_benchmark(name: str, root: Path, names: Sequence[str] = ()) -> list[Scene]:
    """Read scenes of a benchmark, and see that all of their images are there."""
    scenes = BENCHMARKS[name].read(root, names)
    for scene in scenes:
        data = scene.dataset
        for images in (data.mapped, data.queries):
            if not images:
                raise ConfigError(f"{root}: {scene.label} has no images to map, or none to query")
            check_files((image.name for image in images), data.images)
    return scenes


def _read_seven_scenes(root: Path, names: Sequence[str]) -> list[Scene]:
    """Read each scene with the Kinect's poses and, where `PSEUDO_TRUTH` is beside, those by SfM."""
    scenes = []
    pseudo_truth = root / PSEUDO_TRUTH
    for folder, column in _find_scenes(root, SEVEN_SCENES, names, seven_scenes.detect):
        column_of = _always(column)
        scenes.append(
            Scene(f"{folder.name}, Kinect", "Kinect", seven_scenes.read(folder), column_of)
        )
        if pseudo_truth.is_dir():
            dataset = seven_scenes.read(folder, poses=pseudo_truth)
            scenes.append(Scene(f"{folder.name}, SfM", "SfM", dataset, column_of))
    return scenes


def _read_cambridge(root: Path, names: Sequence[str]) -> list[Scene]:
    return [
        Scene(folder.name, "", cambridge.read(folder), _always(column))
        for folder, column in _find_scenes(root, CAMBRIDGE, names, cambridge.detect)
    ]


def _read_aachen(root: Path, names: Sequence[str]) -> list[Scene]:
    _refuse_names("Aachen Day-Night", names)
    if not aachen.detect(root):
        raise ConfigError(f"{root} is not the folder of Aachen Day-Night v1.1: it has no 3D-models")
    is_night = "query/night/"
    return [
        Scene(
            "aachen",
            "",
            aachen.read(root),
            lambda query: "Night" if query.name.startswith(is_night) else "Day",
        )
    ]


def _read_robotcar(root: Path, names: Sequence[str]) -> list[Scene]:
    _refuse_names("RobotCar Seasons", names)
    if not robotcar.detect(root):
        raise ConfigError(f"{root} is not the folder of RobotCar Seasons: it has no 3D-models")
    return [
        Scene(
            "robotcar",
            "",
            robotcar.read(root),
            lambda query: "Night" if query.name.split("/")[0] in NIGHTS else "Day",
        )
    ]


def _read_kitchen(data: Path, names: Sequence[str]) -> list[Scene]:
    """Read one sequence of RedKitchen, split in two ways."""
    _refuse_names("the sequence of RedKitchen", names)
    if not (data / KITCHEN).is_dir():
        raise ConfigError(f"{data} has no {KITCHEN} with images/, sparse/ and lists of the splits")
    splits = read_splits(data, KITCHEN)
    column_of = _always(SEVEN_SCENES["redkitchen"])
    return [
        Scene(
            label,
            "whole stretches" if label.endswith("block") else "every fifth image",
            dataset,
            column_of,
        )
        for label, dataset in splits.items()
    ]


def _find_scenes(
    root: Path, known: dict[str, str], names: Sequence[str], detect: Callable[[Path], bool]
) -> list[tuple[Path, str]]:
    """Find scenes in the folder that holds them; all that are there, where none is named."""
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"there is no scene {unknown[0]!r}; use {', '.join(known)}")
    found = [(root / name, column) for name, column in known.items() if not names or name in names]
    there = [(folder, column) for folder, column in found if detect(folder)]
    if not there or (names and len(there) < len(found)):
        missing = next(folder for folder, _ in found if not detect(folder))
        raise ConfigError(
            f"{missing} holds no scene; --root is the folder with {', '.join(known)} in it"
        )
    return there


def _refuse_names(title: str, names: Sequence[str]) -> None:
    if names:
        raise ConfigError(f"{title} is one scene; leave --scene out")


def _always(column: str) -> Callable[[Query], str]:
    return lambda _: column


BENCHMARKS = {
    "7scenes": Benchmark("7-Scenes", "7scenes", _read_seven_scenes),
    "cambridge": Benchmark("Cambridge Landmarks", "cambridge", _read_cambridge),
    "aachen": Benchmark("Aachen Day-Night v1.1", "aachen", _read_aachen, "aachen"),
    "robotcar": Benchmark("RobotCar Seasons", "robotcar", _read_robotcar, "robotcar"),
    "redkitchen": Benchmark("A sequence of 7-Scenes' RedKitchen", "7scenes", _read_kitchen),
}
