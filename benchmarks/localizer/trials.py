"""Frames that must not be localized, and frames spoilt in every way: how many poses are wrong.

Maps of real places and of rendered rooms are asked about frames of other places, of rooms that look
alike, and of their own place, blurred, covered, turned, dark, noisy. A map of two rooms that are
the same cannot tell which one a frame is of: it must give no pose.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.frame import Frame, Localized, Result, Statistics, summarize
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import build_map, read_frame, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import read_names, read_queries
from trigpoint_db.synthetic import flight_poses, make_room, render, survey_poses

Image = NDArray[np.uint8]
Generator = np.random.Generator

# A pose is wrong that is farther off than this, of the distance of what the frame shows, or turned.
WRONG_POSITION = 0.05
WRONG_ROTATION_DEG = 3.0

ROOM_SEEDS = (0, 1, 2, 3)
NUM_SURVEY, NUM_FLIGHT = 60, 40
NEXT_DOOR = np.array([60.0, 0.0, 0.0])  # where the second of two rooms that are the same lies


@dataclass(frozen=True)
class Trial:
    """One frame in one map."""

    map: str
    kind: str
    frame: str
    verdict: str
    position: float  # its error, of the distance of what the frame shows; inf: nothing is right
    rotation_deg: float
    statistics: Statistics

    @property
    def is_right(self) -> bool:
        """Whether the pose given is that of the frame."""
        return self.position < WRONG_POSITION and self.rotation_deg < WRONG_ROTATION_DEG

    @property
    def confidence(self) -> float:
        """The confidence in its pose."""
        return self.statistics.confidence

    @property
    def is_posed(self) -> bool:
        """Whether there is a pose, with whatever confidence."""
        return self.verdict == "LOCALIZED"

    @property
    def is_given(self) -> bool:
        """Whether the localizer gives a pose with its default options."""
        return self.is_posed and self.confidence >= LocalizerOptions().min_confidence


def black(image: Image, _: Generator) -> Image:
    """Take all light away."""
    return np.zeros_like(image)


def white(image: Image, _: Generator) -> Image:
    """Give too much light."""
    return np.full_like(image, 255)


def noise(image: Image, rng: Generator) -> Image:
    """Show nothing but noise."""
    return rng.integers(0, 256, image.shape).astype(np.uint8)


def blurred(image: Image, rng: Generator) -> Image:
    """Put it out of focus."""
    sigma = image.shape[1] / 640 * rng.uniform(2, 8)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def shaken(image: Image, rng: Generator) -> Image:
    """Move it while the shutter is open."""
    length = int(image.shape[1] / 640 * rng.uniform(10, 60)) | 1
    kernel = np.zeros((length, length), np.float32)
    kernel[length // 2] = 1 / length
    turn = cv2.getRotationMatrix2D((length / 2 - 0.5,) * 2, rng.uniform(0, 180), 1)
    kernel = cv2.warpAffine(kernel, turn, kernel.shape)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)


def half_covered(image: Image, rng: Generator) -> Image:
    """Hold a hand before the lens."""
    covered = image.copy()
    height, width = image.shape
    rows, columns = slice(None), slice(None)
    if rng.random() < 0.5:
        columns = slice(0, width // 2) if rng.random() < 0.5 else slice(width // 2, None)
    else:
        rows = slice(0, height // 2) if rng.random() < 0.5 else slice(height // 2, None)
    covered[rows, columns] = 20
    return covered


def mostly_covered(image: Image, rng: Generator) -> Image:
    """Leave a gap that shows a twelfth of the picture."""
    height, width = image.shape
    h, w = int(height * 0.3), int(width * 0.28)
    y, x = rng.integers(0, height - h), rng.integers(0, width - w)
    covered = np.full_like(image, 20)
    covered[y : y + h, x : x + w] = image[y : y + h, x : x + w]
    return covered


def dark(image: Image, rng: Generator) -> Image:
    """Make it night: few photons, much gain."""
    photons = image.astype(np.float64) ** 2.2 / 255**2.2 * rng.uniform(5, 30)
    seen = rng.poisson(photons) + rng.normal(0, 1, image.shape)
    return np.clip(seen / photons.max() * 255, 0, 255).astype(np.uint8)


def mirrored(image: Image, _: Generator) -> Image:
    """Show what no camera at that place can see."""
    return np.ascontiguousarray(image[:, ::-1])


def shuffled(image: Image, rng: Generator) -> Image:
    """Cut the picture into sixteen tiles and shuffle them."""
    tiles = [tile for row in np.array_split(image, 4) for tile in np.array_split(row, 4, axis=1)]
    height, width = image.shape[0] // 4, image.shape[1] // 4
    order = rng.permutation(16)
    rows = [
        np.hstack([tiles[order[4 * r + c]][:height, :width] for c in range(4)]) for r in range(4)
    ]
    out = np.zeros_like(image)
    out[: 4 * height, : 4 * width] = np.vstack(rows)
    return out


SPOILT: dict[str, Callable[[Image, Generator], Image]] = {
    function.__name__.replace("_", " "): function
    for function in (blurred, shaken, half_covered, mostly_covered, dark)
}
IMPOSSIBLE: dict[str, Callable[[Image, Generator], Image]] = {
    function.__name__: function for function in (black, white, noise, mirrored, shuffled)
}
# No camera sees these; they show what a verdict by the matches alone can do.
NOT_OF_THIS_WORLD = ("mirrored", "shuffled")
ROLLS_DEG = (30, 90, 180)


def rolled(frame: Frame, truth: Rigid3, degrees: float) -> tuple[Frame, Rigid3]:
    """Turn the camera about its axis; corners that it did not see are black."""
    camera = frame.camera
    if camera.distortion.any():
        K = (*camera.focals_px, camera.K[0, 2], camera.K[1, 2])
        camera = Camera("PINHOLE", camera.width, camera.height, K)
        frame = Frame(cv2.undistort(frame.image, camera.K, frame.camera.distortion), camera)
    angle = np.deg2rad(degrees)
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    H = camera.K @ R @ np.linalg.inv(camera.K)
    image = cv2.warpPerspective(frame.image, H, (camera.width, camera.height))
    roll = Rigid3(R, np.zeros(3))
    return Frame(np.asarray(image, np.uint8), camera, name=frame.name), roll @ truth


@dataclass(frozen=True, eq=False)
class Place:
    """A map, and frames whose poses in it are known.

    In a map of two places that are the same no pose is right.
    """

    name: str
    map: Path
    frames: list[tuple[Frame, Rigid3]]
    is_double: bool = False


def real_place(folder: Path, network: FeatureModel, scratch: Path) -> Place:
    """Map a set as its first split says, and take all its queries."""
    poses = {image.name: image for image in read_model(folder / "sparse")}
    path = scratch / f"{folder.name}.tpmap"
    survey = select_images(list(poses.values()), read_names(folder / "map.txt"))
    build_map(path, survey, folder / "images", network)
    calibrate_map(path, network)
    frames = [
        (
            read_frame(folder / "images", query.name, query.camera),
            poses[query.name].cam_from_world,
        )
        for query in read_queries(folder / "queries.txt")
    ]
    return Place(folder.name, path, frames)


def rendered_places(seed: int, network: FeatureModel, scratch: Path) -> Iterator[Place]:
    """Map a furnished room; and the same room twice, next door to itself."""
    world = make_room(seed)
    folder = scratch / f"room{seed}"
    folder.mkdir()
    flight = flight_poses(world, NUM_FLIGHT, seed)
    frames = [
        (Frame(render(world, CAMERA, flight[i], seed=9000 + i), CAMERA, name=f"{i}"), flight[i])
        for i in range(NUM_FLIGHT)
    ]
    survey = survey_poses(world, NUM_SURVEY, seed)
    images = []
    for copy in range(2):
        for i in range(NUM_SURVEY):
            name = f"{copy}-{i}.png"
            noise_seed = 1000 * (copy + 1) + i
            cv2.imwrite(str(folder / name), render(world, CAMERA, survey[i], seed=noise_seed))
            center = survey[i].center + copy * NEXT_DOOR
            images.append(PosedImage(name, CAMERA, Rigid3.from_center(survey[i].R, center)))
    for name, chosen in ((f"room {seed}", images[:NUM_SURVEY]), (f"rooms {seed}, {seed}", images)):
        path = scratch / f"{name}.tpmap"
        build_map(path, chosen, folder, network)
        yield Place(name, path, frames, is_double=len(chosen) > NUM_SURVEY)


def try_place(
    place: Place, others: Sequence[Place], network: FeatureModel, options: LocalizerOptions
) -> list[Trial]:
    """Ask a map about its own frames, in every state, and about those of other places."""
    trials = []
    with MapReader.open(place.map, network.identity) as reader:
        localizer = Localizer(network, reader, options)
        own = [localizer.localize(frame) for frame, _ in place.frames]
        depths = [r.statistics.depth for r in own if isinstance(r, Localized)]
        depth = float(np.median(depths)) if depths else 1.0

        def record(kind: str, name: str, result: Result, truth: Rigid3 | None) -> None:
            position = rotation_deg = np.inf
            if isinstance(result, Localized) and truth is not None:
                error = result.cam_from_world @ truth.inverse()
                apart = result.cam_from_world.center - truth.center
                position = float(np.linalg.norm(apart)) / depth
                rotation_deg = float(np.rad2deg(rotation_angle(error.R)))
            verdict, statistics = summarize(result), result.statistics
            trials.append(
                Trial(place.name, kind, name, verdict, position, rotation_deg, statistics)
            )

        kind = "of one of two same rooms" if place.is_double else "as it is"
        for (frame, truth), result in zip(place.frames, own, strict=True):
            record(kind, frame.name, result, None if place.is_double else truth)
        if place.is_double:
            return trials
        for other in others:
            for frame, _ in other.frames:
                record("of another place", frame.name, localizer.localize(frame), None)
        for number, (frame, truth) in enumerate(place.frames):
            rng = np.random.default_rng(number)
            for kind, spoil in (SPOILT | IMPOSSIBLE).items():
                spoilt = replace(frame, image=spoil(frame.image, rng))
                result = localizer.localize(spoilt)
                record(kind, frame.name, result, truth if kind in SPOILT else None)
            for degrees in ROLLS_DEG:
                turned, right = rolled(frame, truth, degrees)
                record(f"rolled {degrees} deg", frame.name, localizer.localize(turned), right)
    return trials


def run_trials(folders: Sequence[Path], options: LocalizerOptions, jobs: int = 2) -> list[Trial]:
    """Make all maps, and try every frame in every map."""
    network = FeatureModel.load(num_threads=jobs)
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        places = [real_place(folder, network, scratch) for folder in folders]
        for seed in ROOM_SEEDS:
            places += rendered_places(seed, network, scratch)
        with (scratch / "places.pickle").open("wb") as file:
            pickle.dump(places, file)
        arguments = (scratch / "places.pickle", options)
        with ProcessPoolExecutor(jobs, get_context("spawn"), _prepare, arguments) as pool:
            return [trial for found in pool.map(_try_one, range(len(places))) for trial in found]


def _prepare(path: Path, options: LocalizerOptions) -> None:
    cv2.setNumThreads(1)
    threadpoolctl.threadpool_limits(1, user_api="blas")
    with path.open("rb") as file:
        _state.update(places=pickle.load(file), options=options)
    _state["network"] = FeatureModel.load(num_threads=1)


def _try_one(index: int) -> list[Trial]:
    place = _state["places"][index]
    others = [p for p in _state["places"] if p.name != place.name and not p.is_double]
    return try_place(place, others, _state["network"], _state["options"])


_state: dict[str, Any] = {}  # of a process of the pool
