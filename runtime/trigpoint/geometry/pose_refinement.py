"""The query's pose from latent points (paper, E2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.points_last import project
from trigpoint.rigid import Rigid3, rotation_from_vector

Array = NDArray[np.float64]

MIN_POINTS = 4
CAUCHY = 2.0  # where Cauchy's loss bends, in standard deviations


def perturb(cam_from_world: Rigid3, delta: Array) -> Rigid3:
    """Apply errors (dc, dtheta) (..., 6): center c + dc, rotation R exp(-dtheta)."""
    R = cam_from_world.R @ rotation_from_vector(-delta[..., 3:])
    return Rigid3.from_center(R, cam_from_world.center + delta[..., :3])


def refine_pose(
    cam_from_world: Rigid3,
    points3d: Array,
    points2d: Array,
    *,
    sigma: float,
    max_error: float,
    num_iterations: int = 15,
) -> Rigid3 | None:
    """Minimise the robust reprojection error of latent points over the pose.

    E2 (paper, eq. 15) with Cauchy's loss, cut off at `max_error`. Levenberg-Marquardt.

    Parameters
    ----------
    cam_from_world : Rigid3
        Start.
    points3d : (M, 3) float64
        Latent points in the world.
    points2d : (M, 2) float64
        Their keypoints in the query, normalised.
    sigma : float
        Expected standard deviation of the image noise, in the units of the image points.
    max_error : float
        Points farther than this from their projection are outliers.

    Returns
    -------
    Rigid3 or None
        None where fewer than four points are left or they do not determine the pose.
    """
    observed = points2d.T

    def linearize(pose: Rigid3) -> tuple[float, Array, Array, int]:
        seen = project(pose, points3d)
        r = (seen.xy - observed) / sigma
        limit = (max_error / sigma) ** 2
        square = np.where(seen.in_front, (r**2).sum(axis=0), limit)
        cost = float(np.log1p(np.minimum(square, limit) / CAUCHY**2).sum())
        weight = np.where(square < limit, 1 / (1 + square / CAUCHY**2), 0.0)
        root = np.sqrt(weight)
        J = np.swapaxes(seen.by_pose * (root / sigma), 0, 1).reshape(6, -1)
        return cost, J @ J.T, J @ (r * root).ravel(), int((square < limit).sum())

    damping = 1e-4
    cost, H, g, num_inliers = linearize(cam_from_world)
    for _ in range(num_iterations):
        if num_inliers < MIN_POINTS or not is_determined(H):
            return None
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g).astype(np.float64, copy=False)
        candidate = perturb(cam_from_world, step)
        new = linearize(candidate)
        if new[0] <= cost:
            converged = cost - new[0] < 1e-3 * (1 + cost)
            cam_from_world, (cost, H, g, num_inliers) = candidate, new
            damping = max(damping / 10, 1e-9)
            if converged:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return cam_from_world if num_inliers >= MIN_POINTS and is_determined(H) else None


def is_determined(H: Array) -> bool:
    """Say whether the normal matrix is regular, whatever the unit of length is."""
    scale = np.sqrt(np.diag(H))
    return bool((scale > 0).all() and np.linalg.cond(H / np.outer(scale, scale)) < 1e12)
