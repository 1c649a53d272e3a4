"""The query's pose, its latent points and the anchors' poses, refined together.

The paper takes the map's poses for exact. They are not: a survey drifts, and two of its poses agree
the less, the farther apart they were taken. Taken for exact, they bend the latent points, and the
query's pose with them, by more than all image noise does. Here each anchor's pose is a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.frame import PoseNoise
from trigpoint.geometry.pose_refinement import (
    CAUCHY,
    MIN_POINTS,
    PRIOR_DOF,
    RefinedPose,
    inverse_cholesky,
    is_determined,
    perturb,
    reprojection,
)
from trigpoint.geometry.triangulation import LatentPoints
from trigpoint.rigid import Rigid3, rotate

Array = NDArray[np.float64]


def refine_jointly(
    cam_from_world: Rigid3,
    views_from_world: Rigid3,
    latent: LatentPoints,
    points2d: Array,
    *,
    px: float,
    sigma_px: float,
    pose_noise: PoseNoise,
    max_error_px: float,
    num_iterations: int = 2,
) -> RefinedPose | None:
    """Refine a pose that is nearly right, with poses of the anchors that are nearly right.

    Minimises E1 + E2 (paper, eqs. 13 and 15) + the squared errors of the anchors' poses in units of
    `pose_noise`, over the query's pose, the points and the anchors' poses; Gauss-Newton. E1 and E2
    with Cauchy's loss. As in the paper the points follow from the anchors alone (variable
    projection, Golub and Pereyra 1973): they are eliminated with E1, and E2's residuals are
    whitened by the covariance that they leave, so that a wrong match in the query cannot pull its
    point along and so look right.

    Parameters
    ----------
    cam_from_world : Rigid3
        Start.
    views_from_world : Rigid3
        The anchors as the map has them (K,).
    latent : LatentPoints
        M points, triangulated from the anchors.
    points2d : (M, 2) float64
        Their keypoints in the query, normalised.
    px : float
        The normalised size of the query's pixel.
    sigma_px : float
        Expected standard deviation of keypoints.
    pose_noise : PoseNoise
        Zero for anchors that are exact.
    max_error_px : float
        Points farther than this from their projection are outliers.

    Returns
    -------
    RefinedPose or None
        None where the points do not determine the pose. The covariance is the query's block of the
        inverse of the whole information matrix: of the image noise, scaled by the measured
        residuals, and of the anchors' poses, which many points share.
    """
    distances = np.linalg.norm(views_from_world.center - cam_from_world.center, axis=1)
    problem = _Problem(
        views_from_world,
        pose_noise.std(distances),
        latent,
        points2d,
        px,
        sigma_px,
        max_error_px,
    )
    state = _State(cam_from_world, np.zeros((len(distances), 6)), latent.points3d)
    system = problem.linearize(state)
    for _ in range(num_iterations):
        if not system.is_determined():
            return None
        candidate = system.step(state)
        new = problem.linearize(candidate)
        if not new.cost <= system.cost:
            break
        state, system = candidate, new
    if not system.is_determined():
        return None
    return RefinedPose(state.cam_from_world, system.covariance(), system.inliers)


@dataclass(frozen=True, eq=False)
class _State:
    cam_from_world: Rigid3
    errors: Array  # (K, 6): of the anchors' poses, in their standard deviations
    points3d: Array  # (M, 3)


@dataclass(frozen=True, eq=False)
class _Points:
    """E1 with the points eliminated: how they follow the anchors, and what that asks of these."""

    covariance: Array  # (M, 3, 3)
    step: Array  # (M, 3): to the minimum of E1
    gain: Array  # (M, 3, 6K): a change u of the anchors' errors moves them by -gain u
    information: Array  # (6K, 6K)
    gradient: Array  # (6K,)
    square: Array  # (P,): of the residuals, in sigma
    weight: Array  # (P,)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations; the unknowns are the anchors' errors, then the query's (dc, dtheta)."""

    cost: float
    information: Array  # (6K + 6, 6K + 6): of the images; the prior is not in it
    gradient: Array  # (6K + 6,): with the prior's
    points: _Points
    inliers: NDArray[np.bool_]  # (M,)
    variance: float  # of the residuals: 1 where sigma_px is right

    def is_determined(self) -> bool:
        return self.inliers.sum() >= MIN_POINTS and is_determined(self.information[-6:, -6:])

    def step(self, state: _State) -> _State:
        normal = self.information + self._prior()
        step = np.linalg.solve(normal, -self.gradient).astype(np.float64, copy=False)
        return _State(
            perturb(state.cam_from_world, step[-6:]),
            state.errors + step[:-6].reshape(-1, 6),
            state.points3d + self.points.step - self.points.gain @ step[:-6],
        )

    def covariance(self) -> Array:
        inverse = np.linalg.inv(self.information / self.variance + self._prior())
        query = inverse[-6:, -6:].astype(np.float64, copy=False)
        return (query + query.T) / 2

    def _prior(self) -> Array:
        return np.diag(np.repeat([1.0, 0.0], [len(self.gradient) - 6, 6]))


@dataclass(frozen=True, eq=False)
class _Problem:
    views_from_world: Rigid3
    view_std: Array  # (K, 6)
    latent: LatentPoints
    points2d: Array
    px: float
    sigma_px: float
    max_error_px: float

    def linearize(self, state: _State) -> _System:
        """Add E2, the query's keypoints against the points where E1 puts them, to E1."""
        points = self._eliminate_points(state)
        r, by_pose, by_point, in_front = reprojection(
            state.cam_from_world, state.points3d, self.points2d
        )
        r = r + rotate(by_point, points.step)
        sigma = self.sigma_px * self.px
        whiten = inverse_cholesky(
            sigma**2 * np.eye(2) + by_point @ points.covariance @ np.swapaxes(by_point, 1, 2)
        )
        inliers = in_front & ((r**2).sum(axis=1) < (self.max_error_px * self.px) ** 2)
        r = rotate(whiten, r)
        limit = (self.max_error_px / self.sigma_px) ** 2
        square = np.where(inliers, (r**2).sum(axis=1), limit)
        weight = np.where(inliers, 1 / (1 + square / CAUCHY**2), 0.0)
        J = whiten @ np.concatenate([-by_point @ points.gain, by_pose], axis=2)
        root = np.sqrt(weight)[:, None]
        J = np.reshape(J * root[:, :, None], (2 * len(r), -1))

        information, gradient = J.T @ J, J.T @ (r * root).ravel()
        information[:-6, :-6] += points.information
        gradient[:-6] += points.gradient + state.errors.ravel()
        squares = np.concatenate([points.square, square])
        cost = CAUCHY**2 * np.log1p(squares / CAUCHY**2).sum() + (state.errors**2).sum()
        weights = np.concatenate([points.weight, weight])
        dof = max(2 * weights.sum() - 3 * len(r) - 6, 0.0)
        variance = ((weights * squares).sum() + PRIOR_DOF) / (dof + PRIOR_DOF)
        return _System(float(cost), information, gradient, points, inliers, float(variance))

    def _eliminate_points(self, state: _State) -> _Points:
        """Linearise E1 about the state."""
        tracks = self.latent.tracks
        num_views, num_points = len(self.view_std), len(self.points2d)
        _, starts = tracks.groups()
        index = np.repeat(np.arange(num_points), tracks.lengths)
        error: Array = state.errors * self.view_std
        views = perturb(self.views_from_world, error)[tracks.view]
        r, A, B, in_front = reprojection(views, state.points3d[index], tracks.xy)
        sigma = self.sigma_px * tracks.px
        square = np.where(in_front, (r**2).sum(axis=1) / sigma**2, 1e12)
        weight = 1 / (1 + square / CAUCHY**2)
        root = (np.sqrt(weight) / sigma)[:, None, None]
        by_error: Array = A * (root * self.view_std[tracks.view][:, None, :])
        B = B * root
        rows = np.concatenate([B, by_error, r[:, :, None] * root], axis=2)  # (P, 2, 3 + 6 + 1)
        # What each observation adds to its point's equations: the sum over its two rows.
        products = B[:, 0, :, None] * rows[:, 0, None, :] + B[:, 1, :, None] * rows[:, 1, None, :]

        sums = np.add.reduceat(products[:, :, [0, 1, 2, 9]], starts)
        H, g = sums[:, :, :3], sums[:, :, 3]
        trace = np.trace(H, axis1=1, axis2=2)  # rays that are nearly parallel leave H singular
        C = invert_symmetric(H + (1e-9 * (trace + np.median(trace)))[:, None, None] * np.eye(3))
        step = -rotate(C, g)
        mixed = np.zeros((num_points, 3, num_views, 6))
        mixed[index, :, tracks.view] = products[:, :, 3:9]
        gain = C @ mixed.reshape(num_points, 3, -1)

        flat = mixed.reshape(3 * num_points, -1)
        information = -flat.T @ gain.reshape(flat.shape)
        gradient = flat.T @ step.ravel()
        for view in range(num_views):
            block = slice(6 * view, 6 * view + 6)
            own = rows[tracks.view == view, :, 3:].reshape(-1, 7)
            sums = own[:, :6].T @ own
            information[block, block] += sums[:, :6]
            gradient[block] += sums[:, 6]
        return _Points(C, step, gain, information, gradient, square, weight)


def invert_symmetric(H: Array) -> Array:
    """Invert symmetric matrices (M, 3, 3) by cofactors: five times as fast as LAPACK one by one.

    As exact as their condition lets them; 1e9 here, by the floor on the diagonal.
    """
    a, b, c, d, e, f = (H[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    inverse = np.stack([A, B, C, B, D, E, C, E, F], axis=1).reshape(-1, 3, 3)
    return inverse / (a * A + b * B + c * C)[:, None, None]
