"""Furniture made of boxes.

A group is placed against a wall and says where its boxes are in the wall's own frame: x along
the wall from its middle, y from the wall into the room, z up from the floor, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from trigpoint_db.synthetic import materials
from trigpoint_db.synthetic.textures import Material

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Box:
    """A box: centre and size (3,) in metres, turned about z by `yaw_rad`, and what covers it."""

    center: Array
    size: Array
    sides: Material
    front: Material | None = None  # on the side towards +y, where it differs
    top: Material | None = None
    yaw_rad: float = 0.0

    @property
    def axes(self) -> Array:
        """The box's own axes (3, 3) in rows."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])

    def moved(self, yaw_rad: float = 0.0, offset: ArrayLike = (0, 0, 0)) -> Box:
        """Turn about the z axis of the frame, then shift."""
        turn = replace(self, yaw_rad=yaw_rad).axes.T
        center = turn @ self.center + np.asarray(offset, dtype=np.float64)
        return replace(self, center=center, yaw_rad=self.yaw_rad + yaw_rad)


def _box(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    sides: Material,
    front: Material | None = None,
    top: Material | None = None,
) -> Box:
    """Make a box from its limits."""
    limits = np.array([x, y, z])
    return Box(limits.mean(axis=1), limits[:, 1] - limits[:, 0], sides, front, top)


def _clutter(rng: Generator, x: tuple[float, float], y: tuple[float, float], z: float) -> list[Box]:
    """Stand small things in a row on a surface of height z, each turned a little."""
    things: list[Box] = []
    left = x[0]
    while True:
        width, depth, height = rng.uniform((0.08, 0.08, 0.05), (0.24, 0.2, 0.3))
        left += rng.uniform(0.03, 0.15)
        if left + width > x[1]:
            return things
        covers = (materials.cardboard, materials.photograph, materials.painted, materials.page)
        cover = covers[rng.integers(len(covers))]
        depth = min(depth, (y[1] - y[0]) * 0.9)
        middle = rng.uniform(y[0] + depth / 2, y[1] - depth / 2)
        center = np.array([left + width / 2, middle, z + height / 2])
        size = np.array([width, depth, height])
        things.append(Box(center, size, cover, yaw_rad=rng.uniform(-0.3, 0.3)))
        left += width


def bookcase(rng: Generator) -> list[Box]:
    """Make shelves of books and things, with a chest beside them."""
    left, right, depth, board = -2.0, rng.uniform(0.0, 0.3), 0.34, 0.03
    levels = np.linspace(0.08, rng.uniform(1.9, 2.1), 6)
    middle = rng.uniform(-1.2, -0.6)
    boxes = [_box((left, right), (0, 0.02), (0, levels[-1]), materials.wood)]
    boxes += [
        _box((x, x + board), (0.02, depth), (0, levels[-1] + board), materials.wood)
        for x in (left, middle, right - board)
    ]
    for bay in ((left + board, middle), (middle + board, right - board)):
        for bottom, top in zip(levels, np.append(levels[1:], np.nan), strict=True):
            boxes.append(_box(bay, (0.02, depth - 0.01), (bottom, bottom + board), materials.wood))
            if np.isnan(top):
                continue
            end = bay[0] + (bay[1] - bay[0]) * rng.choice((0.4, 0.7, 1.0))
            tall = bottom + board + (top - bottom - board) * rng.uniform(0.65, 0.95)
            reach = depth - rng.uniform(0.03, 0.12)
            spines = (materials.painted, materials.book_spines, materials.page)
            boxes.append(_box((bay[0], end), (0.02, reach), (bottom + board, tall), *spines))
            boxes += _clutter(rng, (end, bay[1]), (0.05, depth), bottom + board)
    chest = (right + 0.25, rng.uniform(1.7, 2.0))
    height = rng.uniform(0.7, 0.9)
    boxes.append(_box(chest, (0, 0.45), (0, height), materials.wood, materials.drawers))
    return boxes + _clutter(rng, chest, (0.05, 0.42), height) + _pictures(rng, chest, 1.35)


def desk(rng: Generator) -> list[Box]:
    """Make a desk with a monitor under a white board and a shelf, and a chair."""
    left, right, depth, top = -1.1, rng.uniform(0.6, 0.9), 0.72, 0.74
    plate = _box((left, right), (0.02, depth), (top - 0.03, top), materials.wood)
    legs = [
        _box((x, x + 0.05), (y, y + 0.05), (0, top - 0.03), materials.painted)
        for x in (left + 0.02, right - 0.07)
        for y in (0.05, depth - 0.08)
    ]
    unit = _box(
        (right - 0.6, right - 0.1), (0.06, 0.66), (0, 0.62), materials.painted, materials.drawers
    )
    screen = rng.uniform(-0.75, -0.45)
    monitor = [
        _box(
            (screen, screen + 0.6),
            (0.2, 0.24),
            (top + 0.1, top + 0.5),
            materials.painted,
            materials.screen,
        ),
        _box((screen + 0.24, screen + 0.36), (0.16, 0.3), (top, top + 0.1), materials.painted),
        _box((screen + 0.05, screen + 0.5), (0.42, 0.56), (top, top + 0.025), materials.page),
    ]
    x = rng.uniform(-0.7, -0.2)
    chair = [
        _box((x, x + 0.42), (0.6, 1.02), (0.42, 0.48), materials.fabric),
        _box((x, x + 0.42), (1.02, 1.07), (0.42, 0.92), materials.fabric),
        _box((x + 0.17, x + 0.25), (0.78, 0.86), (0.04, 0.42), materials.painted),
        _box((x, x + 0.42), (0.79, 0.85), (0, 0.04), materials.painted),
        _box((x + 0.18, x + 0.24), (0.6, 1.02), (0, 0.035), materials.painted),
    ]
    board = _box((-0.9, 0.5), (0, 0.03), (1.3, 2.1), materials.painted, materials.whiteboard)
    shelf = _box((0.75, 1.9), (0, 0.25), (1.4, 1.43), materials.wood)
    clutter = _clutter(rng, (screen + 0.65, right), (0.1, 0.5), top)
    clutter += _clutter(rng, (0.75, 1.9), (0.02, 0.24), 1.43)
    bin_ = _box((1.3, 1.65), (0.1, 0.42), (0, 0.45), materials.cardboard)
    return [plate, *legs, unit, *monitor, *chair, board, shelf, *clutter, bin_]


def sofa(rng: Generator) -> list[Box]:
    """Make a sofa below pictures, and a side table."""
    left, right = -1.7, rng.uniform(0.2, 0.5)
    cloth = materials.fabric
    boxes = [
        _box((left + 0.1, right - 0.1), (0.06, 0.84), (0.1, 0.36), cloth),
        _box((left + 0.1, right - 0.1), (0.06, 0.3), (0.36, 0.82), cloth),
        _box((left, left + 0.18), (0.05, 0.88), (0.08, 0.6), cloth),
        _box((right - 0.18, right), (0.05, 0.88), (0.08, 0.6), cloth),
    ]
    seats = np.linspace(left + 0.18, right - 0.18, 4)
    boxes += [
        _box((a + 0.01, b - 0.01), (0.3, 0.87), (0.36, 0.46 + rng.uniform(-0.02, 0.02)), cloth)
        for a, b in pairwise(seats)
    ]
    for x in rng.choice(seats[:-1], 2, replace=False) + 0.3:
        cushion = Box(np.array([x, 0.4, 0.64]), np.array([0.4, 0.12, 0.36]), materials.rug)
        boxes.append(replace(cushion, yaw_rad=rng.uniform(-0.3, 0.3)))
    boxes += [
        _box((0.9, 1.5), (0.1, 0.6), (0.48, 0.51), materials.wood),
        _box((1.15, 1.25), (0.3, 0.4), (0, 0.48), materials.painted),
    ]
    boxes += _clutter(rng, (0.9, 1.5), (0.12, 0.58), 0.51)
    return boxes + _pictures(rng, (left, right), 1.2) + _pictures(rng, (0.7, 2.0), 1.15)


def door(rng: Generator) -> list[Box]:
    """Make a door, a radiator with its ribs, and posters."""
    x = rng.uniform(-1.8, -1.5)
    frame = materials.painted
    boxes = [
        _box((x, x + 0.9), (0, 0.02), (0, 2.03), materials.panelling),
        _box((x - 0.08, x), (0, 0.05), (0, 2.11), frame),
        _box((x + 0.9, x + 0.98), (0, 0.05), (0, 2.11), frame),
        _box((x, x + 0.9), (0, 0.05), (2.03, 2.11), frame),
        _box((x + 0.08, x + 0.2), (0.02, 0.07), (1.02, 1.06), frame),
    ]
    start = rng.uniform(0.2, 0.5)
    boxes.append(_box((start, start + 1.26), (0.03, 0.06), (0.14, 0.74), materials.enamel))
    boxes += [
        _box((rib, rib + 0.06), (0.06, 0.13), (0.12, 0.76), materials.enamel)
        for rib in start + 0.1 * np.arange(13)
    ]
    return boxes + _pictures(rng, (-0.4, 2.1), 1.1)


def _pictures(rng: Generator, x: tuple[float, float], bottom: float) -> list[Box]:
    """Hang pictures and posters side by side, standing off the wall by some centimetres."""
    hung: list[Box] = []
    left = x[0]
    while True:
        width, height = rng.uniform((0.35, 0.4), (0.65, 0.75))
        if left + width > x[1]:
            return hung
        low = bottom + rng.uniform(0, 0.3)
        front = (materials.photograph, materials.poster)[rng.integers(2)]
        limits = ((left, left + width), (0, rng.uniform(0.02, 0.06)), (low, low + height))
        hung.append(_box(*limits, materials.wood, front))
        left += width + rng.uniform(0.1, 0.25)


def crates(rng: Generator) -> list[Box]:
    """Make a stack of parcels, for a corner; centred on the origin."""
    stack, bottom = [], 0.0
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform((0.35, 0.3, 0.2), (0.55, 0.5, 0.4))
        center = np.array([*rng.uniform(-0.05, 0.05, 2), bottom + size[2] / 2])
        stack.append(Box(center, size, materials.cardboard, yaw_rad=rng.uniform(-0.4, 0.4)))
        bottom += size[2]
    return stack


def pillar(rng: Generator, height: float) -> list[Box]:
    """Make a pillar of bricks with notices on it; centred on the origin."""
    half = rng.uniform(0.15, 0.2)
    shaft = _box((-half, half), (-half, half), (0, height), materials.bricks)
    notice = _box((-0.1, 0.1), (half, half + 0.015), (1.2, 1.5), materials.painted, materials.page)
    back = _box((-0.12, 0.1), (half, half + 0.02), (1.0, 1.4), materials.painted, materials.poster)
    return [shaft, notice, back.moved(np.pi)]


def table(rng: Generator) -> list[Box]:
    """Make a table with things on it, on a rug; centred on the origin."""
    x, y, top = rng.uniform(0.5, 0.65), rng.uniform(0.35, 0.45), 0.72
    legs = [
        _box((a - 0.03, a + 0.03), (b - 0.03, b + 0.03), (0.01, top - 0.03), materials.wood)
        for a in (-x + 0.06, x - 0.06)
        for b in (-y + 0.06, y - 0.06)
    ]
    plate = _box((-x, x), (-y, y), (top - 0.03, top), materials.wood)
    carpet = _box((-x - 0.4, x + 0.4), (-y - 0.4, y + 0.4), (0, 0.01), materials.rug)
    things = _clutter(rng, (-x, x), (-y, -0.05), top) + _clutter(rng, (-x, x), (0.05, y), top)
    return [carpet, plate, *legs, *things]
