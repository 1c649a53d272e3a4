"""Synthetic views of synthetic points, with truth. The generator is keyed by the caller's name."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, rotation_from_vector

Array = NDArray[np.float64]


def generator(key: str) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(key.encode()))


@dataclass(frozen=True)
class Scene:
    points3d: Array  # (M, 3)
    views_from_world: Rigid3  # (V,)
    points2d: Array  # (V, M, 2), exact


def make_scene(key: str, num_points: int = 100, num_views: int = 4) -> Scene:
    """Points around the origin, views five units away, a unit or so apart, looking at them."""
    rng = generator(key)
    points3d = rng.uniform(-1.5, 1.5, (num_points, 3))
    R = rotation_from_vector(rng.uniform(-0.25, 0.25, (num_views, 3)))
    centers = np.column_stack([rng.uniform(-1.5, 1.5, (num_views, 2)), np.full(num_views, -5.0)])
    views = Rigid3.from_center(R, centers)
    return Scene(points3d, views, project(views, points3d))


def project(views_from_world: Rigid3, points3d: Array) -> Array:
    """Normalised image points (V, M, 2)."""
    cam = np.einsum("vij,mj->vmi", views_from_world.R, points3d) + views_from_world.t[:, None]
    xy: Array = cam[..., :2] / cam[..., 2:]
    return xy


def numeric_jacobian(function: Callable[[Array], Array], at: Array, step: float = 1e-6) -> Array:
    """Central differences of a function of a vector, derivatives along the last axis."""
    columns = [
        (function(at + step * unit) - function(at - step * unit)) / (2 * step)
        for unit in np.eye(len(at))
    ]
    return np.stack(columns, axis=-1)
