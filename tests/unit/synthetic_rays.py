"""Synthetic anchors that see one query, with known poses and measured errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, rotate, rotation_from_quaternion, rotation_from_vector

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """What the anchors know, and the truth."""

    anchors_from_world: Rigid3
    query_from_anchors: Rigid3  # unit translations
    query_from_world: Rigid3

    def subset(self, index: NDArray[np.generic]) -> Scene:
        """Choose or reorder anchors."""
        return replace(
            self,
            anchors_from_world=self.anchors_from_world[index],
            query_from_anchors=self.query_from_anchors[index],
        )

    def in_other_world(self, scale: float, R: Array, t: Array) -> Scene:
        """Move the world by the similarity x' = scale R x + t."""

        def moved(cam_from_world: Rigid3) -> Rigid3:
            center = scale * rotate(R, cam_from_world.center) + t
            return Rigid3.from_center(cam_from_world.R @ R.T, center)

        return replace(
            self,
            anchors_from_world=moved(self.anchors_from_world),
            query_from_world=moved(self.query_from_world),
        )

    def with_relative_poses(self, index: NDArray[np.generic], relative: Rigid3) -> Scene:
        """Replace some relative poses."""
        R, t = self.query_from_anchors.R.copy(), self.query_from_anchors.t.copy()
        R[index], t[index] = relative.R, relative.t
        return replace(self, query_from_anchors=Rigid3(R, t))


def random_rotations(rng: np.random.Generator, num: int) -> Array:
    return rotation_from_quaternion(rng.normal(size=(num, 4)))


def random_directions(rng: np.random.Generator, num: int) -> Array:
    v = rng.normal(size=(num, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def random_relative_poses(rng: np.random.Generator, num: int) -> Rigid3:
    """Relative poses that are wrong altogether."""
    return Rigid3(random_rotations(rng, num), random_directions(rng, num))


def make_scene(
    anchor_centers: Array,
    query_center: Array,
    rng: np.random.Generator,
    *,
    rotation_noise_rad: float = 0.0,
    direction_noise_rad: float = 0.0,
) -> Scene:
    """Turn cameras at random and compute their relative poses, with Gaussian errors.

    The errors are those of anchors_from_query: R_kq is turned by a rotation vector of
    `rotation_noise_rad` an axis, T_kq by another of `direction_noise_rad`, independently.
    """
    num = len(anchor_centers)
    query_from_world = Rigid3.from_center(random_rotations(rng, 1)[0], query_center)
    anchors_from_world = Rigid3.from_center(random_rotations(rng, num), anchor_centers)
    exact = anchors_from_world @ query_from_world.inverse()
    noisy = Rigid3(
        rotation_from_vector(rng.normal(size=(num, 3)) * rotation_noise_rad) @ exact.R,
        rotate(rotation_from_vector(rng.normal(size=(num, 3)) * direction_noise_rad), exact.t),
    ).inverse()
    distance = np.linalg.norm(noisy.t, axis=1, keepdims=True)
    return Scene(anchors_from_world, Rigid3(noisy.R, noisy.t / distance), query_from_world)


def random_scene(
    rng: np.random.Generator,
    num_anchors: int,
    *,
    rotation_noise_rad: float = 0.0,
    direction_noise_rad: float = 0.0,
) -> Scene:
    """Anchors in a box of side 2 about the origin, the query in the middle half of it."""
    return make_scene(
        rng.uniform(-1, 1, (num_anchors, 3)),
        rng.uniform(-0.5, 0.5, 3),
        rng,
        rotation_noise_rad=rotation_noise_rad,
        direction_noise_rad=direction_noise_rad,
    )
