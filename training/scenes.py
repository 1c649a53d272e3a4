"""What the network sees while it learns: photographs, drawings, and rendered worlds with depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.rigid import Rigid3
from trigpoint_db.synthetic import Surface, World, look_at, make_room, render, render_depth

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

HOLD_OUT = 10  # every so many-th photograph is kept for benchmarks/models.py
MIN_SIDE_PX = 320
DRAWING_PX = 512
CAMERA = Camera("PINHOLE", 512, 384, (400.0, 400.0, 255.5, 191.5))
VIEWS = 3  # of one place in a rendered world


@dataclass(frozen=True, eq=False)
class View:
    """A rendered picture: depth (H, W) along the axis, pose, and which place it shows."""

    image: Image
    depth: NDArray[np.float32]
    cam_from_world: Rigid3
    place: int


def photograph_paths(folder: Path, *, held_out: bool) -> list[Path]:
    """Return the photographs to train on, or those that no training sees."""
    paths = sorted(path for path in folder.iterdir() if path.suffix in (".jpg", ".png"))
    return [path for i, path in enumerate(paths) if (i % HOLD_OUT == 0) == held_out]


def photographs(folder: Path) -> Iterator[Image]:
    """Yield the photographs to train on, gray, whole and (where they are large) at half size."""
    for path in photograph_paths(folder, held_out=False):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or min(image.shape) < MIN_SIDE_PX:
            continue
        yield crop_to_stride(np.asarray(image, np.uint8))
        if min(image.shape) >= 2 * 256:
            half = cv2.resize(image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
            yield crop_to_stride(np.asarray(half, np.uint8))


def crop_to_stride(image: Image, stride: int = 32) -> Image:
    """Cut the right and lower edge to multiples of the stride."""
    height, width = (size // stride * stride for size in image.shape)
    return np.ascontiguousarray(image[:height, :width])


def drawing(rng: Generator) -> Image:
    """Draw shapes, lines, letters and checkerboards on noise or on plain ground."""
    size = DRAWING_PX
    ground = np.full((size, size), rng.uniform(0, 255), np.float32)
    if rng.random() < 0.6:
        ground[:] = 0
        for cell in (4, 8, 16, 32, 64, 128):
            grid = rng.standard_normal((2 * size // cell,) * 2).astype(np.float32)
            weight = cell ** rng.uniform(0.3, 1.0)
            ground += weight * cv2.resize(grid, (size, size), interpolation=cv2.INTER_CUBIC)
        ground = (ground - ground.min()) * (255 / max(float(np.ptp(ground)), 1e-6))
    image = ground.astype(np.uint8)
    for _ in range(rng.integers(10, 70)):
        _draw_one(image, rng)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.2)), np.uint8)


def _draw_one(image: Image, rng: Generator) -> None:
    size = len(image)
    gray, other = (int(g) for g in rng.integers(0, 256, 2))
    x, y = (int(v) for v in rng.integers(0, size, 2))
    reach = int(rng.integers(8, 110))
    kind = rng.integers(0, 5)
    if kind == 0:
        corners = np.add(rng.integers(-reach, reach + 1, (rng.integers(3, 7), 2)), (x, y))
        cv2.fillPoly(image, [corners.astype(np.int32)], gray, cv2.LINE_AA)
    elif kind == 1:
        axes = (reach, int(rng.integers(4, reach + 1)))
        thickness = -1 if rng.random() < 0.6 else int(rng.integers(1, 6))
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(image, (x, y), axes, turn, 0, 360, gray, thickness, cv2.LINE_AA)
    elif kind == 2:
        end = tuple(int(v) for v in rng.integers(0, size, 2))
        cv2.line(image, (x, y), end, gray, int(rng.integers(1, 7)), cv2.LINE_AA)
    elif kind == 3:
        text = "".join(chr(c) for c in rng.integers(33, 127, rng.integers(2, 10)))
        font, scale = int(rng.integers(0, 8)), float(rng.uniform(0.5, 2.5))
        cv2.putText(image, text, (x, y), font, scale, gray, int(rng.integers(1, 4)), cv2.LINE_AA)
    else:
        cell, count = int(rng.integers(5, 20)), int(rng.integers(2, 7))
        for i, j in np.ndindex(count, count):
            left, top = x + i * cell, y + j * cell
            shade = gray if (i + j) % 2 else other
            cv2.rectangle(image, (left, top), (left + cell - 1, top + cell - 1), shade, -1)


def photo_world(textures: list[Image], rng: Generator) -> World:
    """Hang photographs in space: a wall behind, boards before it at all depths and angles.

    The optical axes look along x; boards hide one another as things do.
    """
    surfaces = [_board(textures, rng, distance=8.0, width=22.0, tilt=0.15, beside=0.0)]
    for _ in range(rng.integers(4, 12)):
        distance = rng.uniform(2.2, 7.0)
        width = distance * rng.uniform(0.25, 0.8)
        beside = distance * rng.uniform(-0.55, 0.55)
        surfaces.append(_board(textures, rng, distance, width, tilt=0.9, beside=beside))
    return World(tuple(surfaces))


def _board(
    textures: list[Image],
    rng: Generator,
    distance: float,
    width: float,
    tilt: float,
    beside: float,
) -> Surface:
    texture = textures[rng.integers(len(textures))]
    texture = texture[:, ::-1] if rng.random() < 0.5 else texture
    height = width * texture.shape[0] / texture.shape[1]
    yaw, pitch = rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt) * 0.6
    # Facing the cameras: rows run towards -y, columns down, then turned.
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array(
        [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
    )
    u, v = turn @ (0.0, -1.0, 0.0), turn @ (0.0, 0.0, -1.0)
    middle = np.array([distance, beside, rng.uniform(-0.25, 0.25) * distance])
    origin = middle - u * width / 2 - v * height / 2
    return Surface.from_texture(origin, u, v, width, height, np.ascontiguousarray(texture))


def views_of_photo_world(textures: list[Image], seed: int, place: int) -> list[View]:
    """Render one world of boards from VIEWS places side by side."""
    rng = np.random.default_rng((seed, place))
    world = photo_world(textures, rng)
    target = np.array([rng.uniform(3.5, 6.5), rng.uniform(-1, 1), rng.uniform(-0.6, 0.6)])
    centers = rng.uniform((-1.0, -1.9, -1.0), (1.4, 1.9, 1.0), (VIEWS, 3))
    targets = target + rng.normal(0, 0.3, (VIEWS, 3))
    return _render_all(world, look_at(centers, targets), place)


def views_of_room(room: int, place: int) -> list[View]:
    """Render one place in a room from VIEWS sides."""
    rng = np.random.default_rng((room, place))
    world = make_room(room)
    low, high = world.limits
    while True:
        surface = world.surfaces[rng.integers(len(world.surfaces))]
        if min(surface.width, surface.height) < 0.15:
            continue
        target = surface.origin + surface.u * surface.width * rng.uniform(0.2, 0.8)
        target = target + surface.v * surface.height * rng.uniform(0.2, 0.8)
        centers = rng.uniform(low + 0.4, high - 0.4, (400, 3))
        sight = target - centers
        distance = np.linalg.norm(sight, axis=1)
        facing = -(sight / distance[:, None]) @ surface.normal
        fair = (distance > 0.9) & (distance < 3.8) & (facing > 0.5)
        if fair.sum() < VIEWS:
            continue
        free = centers[fair][world.clearance(centers[fair]) > 0.35]
        if len(free) >= VIEWS:
            break
    sight = (target - free) / np.linalg.norm(target - free, axis=1)[:, None]
    near = np.argsort(-(sight @ sight[0]))[: max(VIEWS, len(free) // 2)]
    chosen = free[np.append(near[:1], rng.choice(near[1:], VIEWS - 1, replace=False))]
    targets = target + rng.normal(0, 0.15, (VIEWS, 3))
    return _render_all(world, look_at(chosen, targets), place)


def _render_all(world: World, poses: Rigid3, place: int) -> list[View]:
    return [
        View(
            render(world, CAMERA, poses[i], seed=None),
            render_depth(world, CAMERA, poses[i]).astype(np.float32),
            poses[i],
            place,
        )
        for i in range(len(poses))
    ]
