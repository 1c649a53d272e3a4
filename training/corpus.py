"""The corpus: every picture with its teachers' keypoints and descriptors, made once and kept.

Teachers see the upright, clean picture; the network will see warped and spoilt ones and is asked
for the same answers. Pictures that show one place of a rendered world are stored one after the
other, with depth and pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from training import scenes
from training.scenes import View
from training.teachers import STRIDE, Teachers
from trigpoint.rigid import Rigid3

NUM_DRAWINGS = 240
NUM_PHOTO_WORLDS = 170
NUM_ROOMS, PLACES_A_ROOM = 3, 12

Group = tuple[int, Callable[[], Sequence[NDArray[np.uint8] | View]]]


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of the corpus.

    `image` (H, W) uint8, `descriptors` (H / 4, W / 4, 192) int8, `keypoints` (N, 2) float32 x, y,
    best first. For rendered ones also `depth` (H, W) and the pose.
    """

    image: NDArray[np.uint8]
    descriptors: NDArray[np.int8]
    keypoints: NDArray[np.float32]
    depth: NDArray[np.float32] | None = None
    cam_from_world: Rigid3 | None = None

    def teach(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Sample the teachers' descriptors at x, y (N, 2) in px: (N, 192), unit length."""
        rows, columns = self.descriptors.shape[:2]
        x = np.clip((points[:, 0] + 0.5) / STRIDE - 0.5, 0, columns - 1.001)
        y = np.clip((points[:, 1] + 0.5) / STRIDE - 0.5, 0, rows - 1.001)
        x0, y0 = x.astype(np.intp), y.astype(np.intp)
        fx, fy = ((v - v0).astype(np.float32)[:, None] for v, v0 in ((x, x0), (y, y0)))
        d = self.descriptors
        top = d[y0, x0] * (1 - fx) + d[y0, x0 + 1] * fx
        bottom = d[y0 + 1, x0] * (1 - fx) + d[y0 + 1, x0 + 1] * fx
        mixed = top * (1 - fy) + bottom * fy
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


def make_corpus(folder: Path, photographs: Path, teachers: Teachers, seed: int) -> None:
    """Make the pictures and ask the teachers; goes on where it was interrupted."""
    if (folder / "complete").exists():
        return
    index = 0
    for count, make in track(list(_groups(photographs, seed)), "corpus"):
        entries = [folder / f"{index + i:05d}" for i in range(count)]
        index += count
        if all(entry.exists() for entry in entries):
            continue
        for entry, picture in zip(entries, make(), strict=True):
            view = picture if isinstance(picture, View) else None
            image = view.image if view else picture
            half_made = entry.with_suffix(".new")
            half_made.mkdir(parents=True, exist_ok=True)
            rng = np.random.default_rng((seed, int(entry.name)))
            np.save(half_made / "image.npy", image)
            np.save(half_made / "descriptors.npy", teachers.describe(image))
            np.save(half_made / "keypoints.npy", teachers.detect(image, rng))
            if view:
                pose = view.cam_from_world
                np.save(half_made / "depth.npy", view.depth)
                np.save(half_made / "pose.npy", np.c_[pose.R, pose.t])
                np.save(half_made / "place.npy", view.place)
            if not entry.exists():
                half_made.rename(entry)
    (folder / "complete").touch()


def _groups(photographs: Path, seed: int) -> Iterator[Group]:
    """Yield for each group of pictures their number and the function that makes them."""
    rng = np.random.default_rng((seed, 1))
    photos = list(scenes.photographs(photographs))
    drawings = [scenes.drawing(rng) for _ in range(NUM_DRAWINGS)]
    for picture in photos + drawings:
        yield 1, partial(list, [picture])
    textures = photos + drawings[::4]
    for place in range(NUM_PHOTO_WORLDS):
        yield scenes.VIEWS, partial(scenes.views_of_photo_world, textures, seed, place)
    for room in range(NUM_ROOMS):
        for number in range(PLACES_A_ROOM):
            place = NUM_PHOTO_WORLDS + room * PLACES_A_ROOM + number
            # Rooms of the demo have small seeds; these are others.
            yield scenes.VIEWS, partial(scenes.views_of_room, 1000 + room, place)


def load_corpus(folder: Path) -> tuple[list[Picture], list[list[Picture]]]:
    """Read all into memory: the flat pictures, and the groups of views of one place."""
    flat: list[Picture] = []
    places: dict[int, list[Picture]] = {}
    for entry in sorted(path for path in folder.iterdir() if path.name.isdigit()):
        arrays = [np.load(entry / f"{name}.npy") for name in ("image", "descriptors", "keypoints")]
        if not (entry / "depth.npy").exists():
            flat.append(Picture(*arrays))
            continue
        pose = np.load(entry / "pose.npy")
        depth = np.load(entry / "depth.npy")
        view = Picture(*arrays, depth, Rigid3(pose[:, :3], pose[:, 3]))
        places.setdefault(int(np.load(entry / "place.npy")), []).append(view)
    return flat, list(places.values())


def collect_taught(folder: Path) -> NDArray[np.float32]:
    """Sample the teachers' descriptors at keypoints of the whole corpus: (M, 192)."""
    flat, places = load_corpus(folder)
    pictures = flat + [view for views in places for view in views]
    samples = [picture.teach(picture.keypoints[:100].astype(np.float64)) for picture in pictures]
    return np.concatenate(samples)
