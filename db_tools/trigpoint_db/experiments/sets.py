"""Posed images that experiments measure on: folders with both splits, and public data sets."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError, TrigpointError
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map, check_files, is_taken_so, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.importers import cambridge, seven_scenes
from trigpoint_db.importers.base import Dataset
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.importers.registry import read_dataset
from trigpoint_db.poses import read_names
from trigpoint_db.terminal import track, track_calibration

T = TypeVar("T")
SPLITS = {"": "", ", block": "_block"}  # how they are named in tables, and in the files' names


def read_splits(data: Path, pattern: str = "*") -> dict[str, Dataset]:
    """Read the sets in a folder, each with its splits: `map.txt` and `queries.txt`, `*_block.txt`.

    Each is a folder with `images/` and a COLMAP model in `sparse/`, of a name like `pattern`.
    """
    found = {}
    for folder in find_sets(data, pattern):
        posed = read_model(folder / "sparse")
        for label, suffix in SPLITS.items():
            names = folder / f"map{suffix}.txt", folder / f"queries{suffix}.txt"
            if all(path.is_file() for path in names):
                mapped, tested = (select_images(posed, read_names(path)) for path in names)
                for path, listed in zip(names, (mapped, tested), strict=True):
                    if not listed:
                        raise ConfigError(f"{path} names no images")
                check_files((image.name for image in (*mapped, *tested)), folder / "images")
                found[folder.name + label] = Dataset.from_split(folder / "images", mapped, tested)
    if not found:
        raise ConfigError(f"no set in {data} has map.txt and queries.txt, the names of a split")
    return found


def read_wholes(data: Path) -> dict[str, Dataset]:
    """Read the same sets, with all of their images in the map and no queries."""
    return {
        f"{folder.name}, whole": Dataset(folder / "images", read_model(folder / "sparse"))
        for folder in find_sets(data)
    }


def read_scenes(root: Path) -> dict[str, Dataset]:
    """Read the scenes of 7-Scenes or Cambridge Landmarks in a folder, or the one that it is."""
    if not root.is_dir():
        raise ConfigError(f"there is no folder {root}")
    folders = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    scenes = {
        folder.resolve().name: read_dataset(folder)
        for folder in folders
        if seven_scenes.detect(folder) or cambridge.detect(folder)
    }
    if not scenes:
        raise ConfigError(
            f"{root} holds no scene of 7-Scenes or Cambridge Landmarks; docs/maps.md says how "
            "they are unpacked"
        )
    return scenes


def find_sets(data: Path, pattern: str = "*") -> list[Path]:
    """List the folders of sets."""
    folders = sorted(path.parent for path in data.glob(f"{pattern}/sparse") if path.is_dir())
    if not folders:
        raise ConfigError(
            f"{data} holds no sets; each is a folder with images/, a COLMAP model in sparse/, "
            "and map.txt and queries.txt"
        )
    return folders


def fingerprint(dataset: Dataset) -> str:
    """Return a hash of all that results depend on: the folder, names, cameras and poses."""
    poses = {image.name: image.cam_from_world for image in dataset.mapped} | dict(dataset.truth)
    digest = hashlib.sha256(str(dataset.images.resolve()).encode())
    cameras = [(image.name, image.camera) for image in dataset.mapped]
    for name, camera in [*cameras, *((query.name, query.camera) for query in dataset.queries)]:
        digest.update(f"{name} {camera.to_text()}\n".encode())
    for name, pose in poses.items():
        digest.update(name.encode() + pose.R.tobytes() + pose.t.tobytes())
    return digest.hexdigest()


def identify(network: FeatureModel, sets: Mapping[str, Dataset]) -> dict[str, Any]:
    """Say in a run's settings which network and which data it is of."""
    data = {name: fingerprint(dataset) for name, dataset in sets.items()}
    return {"sha256": network.identity.sha256, "data": data}


@contextmanager
def open_map(
    folder: Path, name: str, dataset: Dataset, network: FeatureModel
) -> Iterator[MapReader]:
    """Open the map of a data set that is in a folder, or made there; one half made goes on."""
    path = folder / f"{name.replace(', ', '_')}_{network.identity.sha256[:8]}.tpmap"
    if not is_map_of(path, dataset, network):
        folder.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        images = dataset.mapped
        tracked = track(images, f"{name}: map", len(images))
        build_map(path, tracked, dataset.images, network, resume=True)
    with MapReader.open(path) as reader:
        is_calibrated = reader.pose_noise is not None
    if not is_calibrated:
        calibrate_map(path, network, track_calibration)
    with MapReader.open(path, network.identity) as reader:
        yield reader


def is_map_of(path: Path, dataset: Dataset, network: FeatureModel) -> bool:
    """Say whether there is a map of these images, cameras and poses, by this network."""
    if not path.is_file():
        return False
    try:
        with MapReader.open(path, network.identity) as reader:
            return reader.names() == [image.name for image in dataset.mapped] and all(
                is_taken_so(image, *reader.view(i)) for i, image in enumerate(dataset.mapped)
            )
    except TrigpointError:
        return False


def choose(items: Sequence[T], num: int) -> list[T]:
    """Choose so many items at the most, by a fixed seed, and keep their order."""
    chosen = np.random.default_rng(0).permutation(len(items))[:num]
    return [items[place] for place in sorted(chosen.tolist())]
