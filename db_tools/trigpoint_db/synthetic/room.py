"""A furnished room, 6 m x 6 m x 2.6 m; the world's origin is in the middle of the floor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from trigpoint_db.synthetic import furniture, materials
from trigpoint_db.synthetic.furniture import Box
from trigpoint_db.synthetic.lighting import light_on
from trigpoint_db.synthetic.textures import Image, Material, as_gray, texels
from trigpoint_db.synthetic.world import Surface, World

Array = NDArray[np.float64]

WIDTH_M, HEIGHT_M = 6.0, 2.6
_LIGHT_GRID_M = 0.1
_GAMMA = 2.2
_LAMP_SIZE_M = np.array([1.2, 0.3, 0.04])
_UP = np.array([0.0, 0.0, 1.0])
_RIGHT = np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Face:
    """A rectangle before it is painted: its centre, its normal and the direction to its right."""

    center: Array
    normal: Array
    right: Array
    width: float
    height: float
    material: Material

    @property
    def down(self) -> Array:
        """Unit vector (3,) to the bottom."""
        return np.cross(self.right, self.normal)

    def points(self, rows: int, columns: int) -> Array:
        """Centres (rows, columns, 3) of a grid of equal parts."""
        s = ((np.arange(columns) + 0.5) / columns - 0.5) * self.width
        t = ((np.arange(rows) + 0.5) / rows - 0.5) * self.height
        grid: Array = self.center + s[:, None] * self.right + t[:, None, None] * self.down
        return grid


@lru_cache(maxsize=2)
def make_room(seed: int = 0) -> World:
    """Furnish a room; another seed gives other textures and things in other places.

    It takes seconds and the result is kept, so that each worker of a process pool can call this
    for every picture rather than be sent the world. Spawn such workers: OpenCV hangs after a fork.
    """
    rng = np.random.default_rng(seed)
    boxes = _furnish(rng)
    lamps = [_lamp(x, y) for x in (-1.4, 1.4) for y in (-1.4, 1.4)]
    cubes = np.array([_cube_from_world(box) for box in boxes])
    faces = _shell(rng) + [face for box in boxes + lamps for face in _faces(box)]
    faces = [face for face in faces if not _covered(face, cubes)]
    textures = [face.material(rng, _shape(face)) for face in faces]
    textures = _illuminated(faces, textures, lamps, cubes)
    return World(tuple(map(_surface, faces, textures)))


def _furnish(rng: Generator) -> list[Box]:
    """Put furniture against the walls, into the corners and into the middle."""
    half, quarter = WIDTH_M / 2, np.pi / 2
    groups = (furniture.bookcase, furniture.desk, furniture.sofa, furniture.door)
    boxes = [
        box.moved(offset=(0, -half, 0)).moved(k * quarter)
        for k, group in enumerate(rng.permutation(4))
        for box in groups[group](rng)
    ]
    corner = (half - 0.42, half - 0.42, 0)
    for k in rng.permutation(4)[:3]:
        stack = furniture.crates(rng)
        boxes += [b.moved(offset=corner).moved(k * quarter) for b in stack]
    turn = rng.uniform(0, 2 * np.pi)
    boxes += [b.moved(turn) for b in furniture.pillar(rng, HEIGHT_M)]
    aside = rng.uniform(0.95, 1.1)
    boxes += [b.moved(0.3, (aside, 0, 0)).moved(turn + 0.4) for b in furniture.table(rng)]
    beam = np.array([0.14, WIDTH_M, 0.12])
    boxes += [
        Box(np.array([x, 0, HEIGHT_M - beam[2] / 2]), beam, materials.wood)
        for x in (-2.2, rng.uniform(-0.3, 0.3), 2.2)
    ]
    return boxes


def _lamp(x: float, y: float) -> Box:
    return Box(np.array([x, y, HEIGHT_M - _LAMP_SIZE_M[2] / 2]), _LAMP_SIZE_M, materials.lamp)


def _shell(rng: Generator) -> list[Face]:
    """Floor, ceiling and four walls of different materials, seen from inside."""
    covers = [materials.bricks, materials.plaster, materials.wallpaper, materials.tiles]
    covers.append(materials.panelling)
    half, middle = WIDTH_M / 2, HEIGHT_M / 2
    walls = []
    for k, cover in enumerate(rng.permutation(5)[:4]):
        inwards = np.round([np.sin(-k * np.pi / 2), np.cos(k * np.pi / 2), 0])
        center = middle * _UP - half * inwards
        walls.append(
            Face(center, inwards, np.cross(_UP, inwards), WIDTH_M, HEIGHT_M, covers[cover])
        )
    floor = Face(np.zeros(3), _UP, _RIGHT, WIDTH_M, WIDTH_M, materials.planks)
    ceiling = Face(HEIGHT_M * _UP, -_UP, _RIGHT, WIDTH_M, WIDTH_M, materials.ceiling_panels)
    return [floor, ceiling, *walls]


def _faces(box: Box) -> list[Face]:
    """Return the six sides of a box."""
    x, y, z = box.axes
    width, depth, height = box.size.tolist()
    front, top = box.front or box.sides, box.top or box.sides
    sides = (
        (y, depth, width, height, front),
        (-y, depth, width, height, box.sides),
        (x, width, depth, height, box.sides),
        (-x, width, depth, height, box.sides),
    )
    upright = [
        Face(box.center + n * thick / 2, n, np.cross(_UP, n), wide, high, material)
        for n, thick, wide, high, material in sides
    ]
    above = Face(box.center + z * height / 2, z, x, width, depth, top)
    below = Face(box.center - z * height / 2, -z, x, width, depth, box.sides)
    return [*upright, above, below]


def _cube_from_world(box: Box) -> Array:
    """Return the affine map (3, 4) that takes the inside of the box to the cube -1..1."""
    R = box.axes * (2 / box.size)[:, None]
    return np.column_stack([R, -R @ box.center])


def _covered(face: Face, cubes: Array) -> bool:
    """Whether a face lies against boxes or the walls all over, so that nobody can see it."""
    points = face.points(4, 4).reshape(-1, 3) + 0.004 * face.normal
    inside = np.abs(points @ cubes[:, :, :3].transpose(0, 2, 1) + cubes[:, None, :, 3]) < 1
    x, y, z = np.abs(points - [0, 0, HEIGHT_M / 2]).T * 2
    outdoors = (x > WIDTH_M) | (y > WIDTH_M) | (z > HEIGHT_M)
    return bool((inside.all(axis=2).any(axis=0) | outdoors).all())


def _shape(face: Face) -> tuple[int, int]:
    return texels(face.height), texels(face.width)


def _illuminated(
    faces: list[Face], textures: list[Image], lamps: list[Box], cubes: Array
) -> list[Image]:
    """Multiply gray levels by the light that falls on the faces, on a display's scale."""
    grids = [
        face.points(*(int(np.ceil(m / _LIGHT_GRID_M)) for m in (face.height, face.width)))
        for face in faces
    ]
    points = np.concatenate([grid.reshape(-1, 3) for grid in grids])
    normals = np.repeat([f.normal for f in faces], [g.size // 3 for g in grids], axis=0)
    along = np.array([-0.4, 0, 0.4])[:, None] * _RIGHT - 0.03 * _UP
    sources = np.concatenate([lamp.center + along for lamp in lamps])
    light = light_on(points, normals, sources, cubes) ** (1 / _GAMMA)
    ends = np.cumsum([g.size // 3 for g in grids])
    lit = []
    for face, texture, grid, part in zip(
        faces, textures, grids, np.split(light, ends[:-1]), strict=True
    ):
        if face.material is materials.lamp:
            lit.append(texture)
            continue
        size = (texture.shape[1], texture.shape[0])
        fine = np.asarray(cv2.resize(part.reshape(grid.shape[:2]).astype(np.float32), size))
        lit.append(as_gray(texture * fine))
    return lit


def _surface(face: Face, texture: Image) -> Surface:
    origin = face.center - face.right * face.width / 2 - face.down * face.height / 2
    return Surface.from_texture(origin, face.right, face.down, face.width, face.height, texture)
