"""Small matrices and vectors of many points, and points in cameras: the points are the last axis.

Numpy's inner loops run over the last axis. Over thousands of points they are several times as fast
as over the three numbers of each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3

Array = NDArray[np.float64]


def multiply(A: Array, B: Array) -> Array:
    """Multiply matrices (a, k, M) by matrices (k, b, M): (a, b, M); an M of 1 is for all."""
    product: Array = A[:, 0, None] * B[0]
    for k in range(1, len(B)):
        product += A[:, k, None] * B[k]
    return product


def invert_symmetric(H: Array) -> Array:
    """Invert symmetric matrices (3, 3, M) by cofactors.

    As exact as their condition lets them: a condition of 1e12 leaves four digits.
    """
    (a, b, c), (_, d, e), (_, _, f) = H
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    inverse = np.stack([A, B, C, B, D, E, C, E, F]).reshape(3, 3, -1)
    inverse /= a * A + b * B + c * C
    return inverse


def inverse_cholesky(S: Array) -> Array:
    """Whitening matrices W (2, 2, M) with W S W^T = I, of covariances S (2, 2, M)."""
    l11 = np.sqrt(S[0, 0])
    l21 = S[0, 1] / l11
    l22 = np.sqrt(np.maximum(S[1, 1] - l21**2, np.finfo(float).tiny))
    return np.stack([1 / l11, np.zeros_like(l11), -l21 / (l11 * l22), 1 / l22]).reshape(2, 2, -1)


@dataclass(frozen=True, eq=False)
class Projection:
    """Points in cameras.

    Parameters
    ----------
    R : (3, 3, M) or (3, 3, 1) float64
        Rotations cam_from_world.
    from_center : (3, M) float64
        From the camera's center, in the world.
    xy : (2, M) float64
        Normalised image points.
    depth : (M,) float64
    in_front : (M,) bool
        The image points, depths and Jacobians of the others mean nothing.
    """

    R: Array
    from_center: Array
    xy: Array
    depth: Array
    in_front: NDArray[np.bool_]

    @cached_property
    def by_point(self) -> Array:
        """Jacobian of the image points by the points (2, 3, M)."""
        jacobian: Array = (self.R[:2] - self.xy[:, None] * self.R[2]) / self.depth
        return jacobian

    @cached_property
    def by_pose(self) -> Array:
        """Jacobian of the image points by (dc, dtheta) (2, 6, M).

        The center is c + dc, the rotation world_from_cam exp(dtheta) R^T.
        """
        a, (x, y, z) = self.by_point, self.from_center
        jacobian = np.empty((2, 6, len(x)))
        np.negative(a, out=jacobian[:, :3])
        # by_point @ skew(from_center): the cross product of its rows with that vector.
        jacobian[:, 3] = a[:, 1] * z - a[:, 2] * y
        jacobian[:, 4] = a[:, 2] * x - a[:, 0] * z
        jacobian[:, 5] = a[:, 0] * y - a[:, 1] * x
        return jacobian


def project(
    cam_from_world: Rigid3, points3d: Array, view: NDArray[np.intp] | None = None
) -> Projection:
    """Project points.

    Parameters
    ----------
    cam_from_world : Rigid3
        One camera, or several (K,).
    points3d : (M, 3) float64
        In the world.
    view : (M,) int, optional
        Which of several cameras.
    """
    if view is None:
        R, center = cam_from_world.R[..., None], cam_from_world.center[:, None]
    else:
        R = np.ascontiguousarray(np.moveaxis(cam_from_world.R, 0, -1))[:, :, view]
        center = np.ascontiguousarray(cam_from_world.center.T)[:, view]
    from_center = np.ascontiguousarray(points3d.T) - center
    x, y, z = multiply(R, from_center[:, None])[:, 0]
    in_front = z > 0
    depth = np.where(in_front, z, 1.0)
    return Projection(R, from_center, np.stack([x, y]) / depth, depth, in_front)
