"""The query's pose from latent points (paper, E2): robust, weighted, with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, rotate, rotation_from_vector

Array = NDArray[np.float64]

MIN_POINTS = 4
PRIOR_DOF = 6.0  # observations' worth of trust in the expected noise: few points may fit too well
CAUCHY = 2.0  # where Cauchy's loss bends, in standard deviations


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose, how sure it is, and the points that agree with it.

    Parameters
    ----------
    cam_from_world : Rigid3
    covariance : (6, 6) float64
        Of (dc, dtheta) as `trigpoint.frame.Localized` defines them.
    inliers : (M,) bool
        Points within the threshold.
    """

    cam_from_world: Rigid3
    covariance: Array
    inliers: NDArray[np.bool_]


def reprojection(
    cam_from_world: Rigid3, points3d: Array, points2d: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Residuals of image points and their Jacobians.

    Parameters
    ----------
    cam_from_world : Rigid3
        Of one camera, or of each point's (M,).
    points3d : (M, 3) float64
    points2d : (M, 2) float64
        Normalised image points.

    Returns
    -------
    residuals : (M, 2) float64
        Projection minus observation.
    by_pose : (M, 2, 6) float64
        By (dc, dtheta): center c + dc, world_from_cam rotation exp(dtheta) R^T.
    by_point : (M, 2, 3) float64
    in_front : (M,) bool
        Residuals and Jacobians of the others mean nothing.
    """
    R = cam_from_world.R
    from_center = points3d - cam_from_world.center
    Y = rotate(R, from_center)
    in_front = Y[:, 2] > 0
    z = np.where(in_front, Y[:, 2], 1.0)
    xy = Y[:, :2] / z[:, None]
    by_point = (R[..., :2, :] - xy[:, :, None] * R[..., 2:, :]) / z[:, None, None]
    by_pose = np.empty((len(Y), 2, 6))
    by_pose[:, :, :3] = -by_point
    # by_point @ skew(from_center): the cross product of its rows with that vector.
    a, c = by_point, from_center[:, None]
    by_pose[:, :, 3] = a[:, :, 1] * c[:, :, 2] - a[:, :, 2] * c[:, :, 1]
    by_pose[:, :, 4] = a[:, :, 2] * c[:, :, 0] - a[:, :, 0] * c[:, :, 2]
    by_pose[:, :, 5] = a[:, :, 0] * c[:, :, 1] - a[:, :, 1] * c[:, :, 0]
    return xy - points2d, by_pose, by_point, in_front


def perturb(cam_from_world: Rigid3, delta: Array) -> Rigid3:
    """Apply errors (dc, dtheta) (..., 6): center c + dc, rotation R exp(-dtheta)."""
    R = cam_from_world.R @ rotation_from_vector(-delta[..., 3:])
    return Rigid3.from_center(R, cam_from_world.center + delta[..., :3])


def refine_pose(
    cam_from_world: Rigid3,
    points3d: Array,
    points2d: Array,
    *,
    point_covariance: Array,
    sigma: float,
    max_error: float,
    num_iterations: int = 15,
) -> RefinedPose | None:
    """Minimise the robust reprojection error of latent points over the pose.

    E2 (paper, eq. 15), with residuals whitened by S_j = sigma^2 (I + J_j C_j J_j^T), C_j being the
    point's covariance for unit image noise, so that a point of uncertain depth counts for what it
    is worth; and with Cauchy's loss, cut off at `max_error`. Levenberg-Marquardt.

    Parameters
    ----------
    cam_from_world : Rigid3
        Start.
    points3d : (M, 3) float64
        Latent points in the world.
    points2d : (M, 2) float64
        Their keypoints in the query, normalised.
    point_covariance : (M, 3, 3) float64
        As `triangulate` gives it.
    sigma : float
        Expected standard deviation of the image noise, in the units of the image points.
    max_error : float
        Points farther than this from their projection are outliers.

    Returns
    -------
    RefinedPose or None
        None where fewer than four points are left or they do not determine the pose. The covariance
        is the inverse information matrix, scaled by the measured residuals and, where these are
        few, by what `sigma` promises.
    """

    def evaluate(pose: Rigid3) -> tuple[float, Array, Array, Array, NDArray[np.bool_]]:
        r, J, by_point, in_front = reprojection(pose, points3d, points2d)
        whiten = inverse_cholesky(
            np.eye(2) + by_point @ point_covariance @ np.swapaxes(by_point, 1, 2)
        )
        distance = np.sqrt((r**2).sum(axis=1))
        inliers = in_front & (distance < max_error)
        r = rotate(whiten, r) / sigma
        J = whiten @ J / sigma
        # An outlier costs what a point on the threshold costs, were it certain.
        square = np.where(inliers, (r**2).sum(axis=1), (max_error / sigma) ** 2)
        return float(np.log1p(square / CAUCHY**2).sum()), r, J, square, inliers

    damping = 1e-4
    cost, r, J, square, inliers = evaluate(cam_from_world)
    for _ in range(num_iterations):
        H, g, _ = _normal_equations(r, J, square, inliers)
        if inliers.sum() < MIN_POINTS or not is_determined(H):
            return None
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g).astype(np.float64, copy=False)
        candidate = perturb(cam_from_world, step)
        new = evaluate(candidate)
        if new[0] <= cost:
            converged = cost - new[0] < 1e-3 * (1 + cost)
            cam_from_world, (cost, r, J, square, inliers) = candidate, new
            damping = max(damping / 10, 1e-9)
            if converged:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    H, _, weight = _normal_equations(r, J, square, inliers)
    if inliers.sum() < MIN_POINTS or not is_determined(H):
        return None
    dof = max(2 * weight.sum() - 6, 0.0)
    variance = (float((weight * square).sum()) + PRIOR_DOF) / (dof + PRIOR_DOF)
    covariance = np.linalg.inv(H) * variance
    return RefinedPose(cam_from_world, (covariance + covariance.T) / 2, inliers)


def _normal_equations(
    r: Array, J: Array, square: Array, inliers: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Return normal matrix (6, 6), gradient (6,) and the points' weights (M,), by Cauchy's loss."""
    weight = np.where(inliers, 1 / (1 + square / CAUCHY**2), 0.0)
    root = np.sqrt(weight)[:, None]
    flat = np.reshape(J * root[:, :, None], (-1, 6))
    return flat.T @ flat, flat.T @ (r * root).ravel(), weight


def is_determined(H: Array) -> bool:
    """Say whether the normal matrix is regular, whatever the unit of length is."""
    scale = np.sqrt(np.diag(H))
    return bool((scale > 0).all() and np.linalg.cond(H / np.outer(scale, scale)) < 1e12)


def inverse_cholesky(S: Array) -> Array:
    """Whitening matrices W (M, 2, 2) with W S W^T = I, in closed form."""
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    l11 = np.sqrt(a)
    l21 = b / l11
    l22 = np.sqrt(np.maximum(c - l21**2, np.finfo(float).tiny))
    W = np.zeros_like(S)
    W[:, 0, 0] = 1 / l11
    W[:, 1, 0] = -l21 / (l11 * l22)
    W[:, 1, 1] = 1 / l22
    return W
