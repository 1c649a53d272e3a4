"""A world of textured rectangles, in metres, z up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CELL_M = 1.0  # surfaces are drawn in cells of this size, each at its own texture resolution


@dataclass(frozen=True, eq=False)
class Surface:
    """A flat rectangle with a texture, seen from its front only.

    Parameters
    ----------
    origin : (3,) float64
        The corner at the texture's top left, in metres in the world.
    u, v : (3,) float64
        Unit vectors along the texture's rows (to the right) and columns (down).
    width, height : float
        Extent along u and v in metres.
    pyramid : tuple of (rows, columns) uint8
        The texture, and its halves, quarters, ... against aliasing. Each covers the whole
        rectangle: the centre of the texel in column i of n lies at (i + 0.5) / n * width.
    """

    origin: Array
    u: Array
    v: Array
    width: float
    height: float
    pyramid: tuple[Image, ...]

    @classmethod
    def from_texture(
        cls, origin: Array, u: Array, v: Array, width: float, height: float, texture: Image
    ) -> Surface:
        """Make one, with the pyramid, from its finest texture."""
        pyramid = [texture]
        while min(pyramid[-1].shape) > 1:
            rows, columns = pyramid[-1].shape
            half = ((columns + 1) // 2, (rows + 1) // 2)
            smaller = cv2.resize(pyramid[-1], half, interpolation=cv2.INTER_AREA)
            pyramid.append(np.asarray(smaller, dtype=np.uint8))
        return cls(origin, u, v, float(width), float(height), tuple(pyramid))

    @property
    def normal(self) -> Array:
        """Unit vector (3,) towards those who see the front."""
        return np.cross(self.v, self.u)


@dataclass(frozen=True, eq=False)
class Cells:
    """Parts of surfaces, at most CELL_M wide and high.

    `surface` (C,) is the surface's index, `bounds` (C, 4) its part: left, right, top, bottom in
    metres along u and v; `corners` (C, 4, 3) in the world, in order around the part.
    """

    surface: NDArray[np.int64]
    bounds: Array
    corners: Array


@dataclass(frozen=True, eq=False)
class World:
    """Surfaces that hide one another; nothing is transparent."""

    surfaces: tuple[Surface, ...]

    @cached_property
    def origins(self) -> Array:
        """Origins (S, 3) of the surfaces."""
        return np.array([s.origin for s in self.surfaces])

    @cached_property
    def axes(self) -> Array:
        """u, v and the normal (S, 3, 3) of the surfaces, in rows."""
        return np.array([[s.u, s.v, s.normal] for s in self.surfaces])

    @cached_property
    def extents(self) -> Array:
        """Width and height (S, 2) of the surfaces in metres."""
        return np.array([[s.width, s.height] for s in self.surfaces])

    @cached_property
    def cells(self) -> Cells:
        """The surfaces cut into parts for drawing."""
        surface, bounds = [], []
        for index, (width, height) in enumerate(self.extents):
            s = np.linspace(0, width, int(np.ceil(width / CELL_M)) + 1)
            t = np.linspace(0, height, int(np.ceil(height / CELL_M)) + 1)
            left, top = (grid.ravel() for grid in np.meshgrid(s[:-1], t[:-1]))
            right, bottom = (grid.ravel() for grid in np.meshgrid(s[1:], t[1:]))
            bounds.append(np.stack([left, right, top, bottom], axis=-1))
            surface.append(np.full(len(left), index))
        owner, limits = np.concatenate(surface), np.concatenate(bounds)
        s_t = limits[:, [[0, 2], [1, 2], [1, 3], [0, 3]]]
        corners = self.origins[owner, None] + s_t @ self.axes[owner, :2]
        return Cells(owner, limits, corners)

    @cached_property
    def limits(self) -> Array:
        """Lowest and highest coordinates (2, 3) of all surfaces."""
        corners = self.cells.corners.reshape(-1, 3)
        return np.array([corners.min(axis=0), corners.max(axis=0)])

    def clearance(self, points: Array) -> Array:
        """Distances (N,) in metres from points (N, 3) to the nearest surface, < 0 behind it."""
        offset = (points @ self.axes.reshape(-1, 3).T).reshape(len(points), -1, 3)
        offset -= np.einsum("sij,sj->si", self.axes, self.origins)
        beside = offset[..., :2] - np.clip(offset[..., :2], 0, self.extents)
        height = offset[..., 2]
        distance = np.sqrt(np.square(beside).sum(axis=-1) + height**2)
        each, nearest = np.arange(len(points)), np.argmin(distance, axis=1)
        signed: Array = np.copysign(distance[each, nearest], height[each, nearest])
        return signed
