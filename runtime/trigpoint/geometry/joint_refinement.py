"""The query's pose, its latent points and the anchors' poses, refined together.

The paper takes the map's poses for exact. They are not: a survey drifts, and two of its poses agree
the less, the farther apart they were taken. Taken for exact, they bend the latent points, and the
query's pose with them, by more than all image noise does. Here each anchor's pose is a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trigpoint.frame import PoseNoise
from trigpoint.geometry.points_last import (
    Projection,
    inverse_cholesky,
    invert_symmetric,
    multiply,
    project,
)
from trigpoint.geometry.pose_refinement import (
    CAUCHY,
    MIN_POINTS,
    is_determined,
    perturb,
)
from trigpoint.geometry.triangulation import LatentPoints
from trigpoint.rigid import Rigid3

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PRIOR_DOF = 6.0  # observations' worth of trust in the expected noise: few points may fit too well


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose, how sure it is, and the points that agree with it.

    Parameters
    ----------
    cam_from_world : Rigid3
    points3d : (M, 3) float64
        The latent points.
    covariance : (6, 6) float64
        Of (dc, dtheta) as `trigpoint.frame.Localized` defines them.
    inliers : (M,) bool
        Points within the threshold.
    point_covariance : (M, 3, 3) float64
        Of the points, as the anchors alone determine them; huge, never infinite, where their rays
        are near parallel.
    """

    cam_from_world: Rigid3
    points3d: Array
    covariance: Array
    inliers: NDArray[np.bool_]
    point_covariance: Array


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
) -> RefinedPose | None:
    """Refine a pose that is nearly right, with poses of the anchors that are nearly right.

    Minimises E1 + E2 (paper, eqs. 13 and 15) + the squared errors of the anchors' poses in units of
    `pose_noise`, over the query's pose, the points and the anchors' poses; two Gauss-Newton steps.
    E1 and E2 with Cauchy's loss. As in the paper the points follow from the anchors alone (variable
    projection, Golub and Pereyra 1973): they are eliminated with E1, and E2's residuals are
    whitened by the covariance that they leave, so that a wrong match in the query cannot pull its
    point along and so look right.

    Parameters
    ----------
    cam_from_world : Rigid3
        Start.
    views_from_world : Rigid3
        The anchors as the map has them (K,); each sees some of the points.
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
        None where fewer than four points agree or they do not determine the pose. The covariance is
        the query's block of the inverse of the whole information matrix: of the image noise, scaled
        by the measured residuals, and of the anchors' poses, which many points share.
    """
    distances = np.linalg.norm(views_from_world.center - cam_from_world.center, axis=1)
    problem = _Problem(
        views_from_world, pose_noise.std(distances), latent, points2d, px, sigma_px, max_error_px
    )
    start = _State(cam_from_world, np.zeros((len(distances), 6)), latent.points3d)
    first = problem.linearize(start)
    if not first.is_determined():
        return None
    second = problem.linearize(first.step())
    if not second.is_determined():
        return None
    end = second.step()
    inliers = problem.find_inliers(end)
    if inliers.sum() < MIN_POINTS:
        return None
    return RefinedPose(
        end.cam_from_world,
        end.points3d,
        second.covariance(),
        inliers,
        second.points.unbounded_covariance(),
    )


@dataclass(frozen=True, eq=False)
class _State:
    cam_from_world: Rigid3
    errors: Array  # (K, 6): of the anchors' poses, in their standard deviations
    points3d: Array  # (M, 3)


@dataclass(frozen=True, eq=False)
class _Points:
    """E1 with the points eliminated: how they follow the anchors, and what that asks of these."""

    normal: Array  # (3, 3, M)
    covariance: Array  # (3, 3, M): its inverse, within bounds where rays are nearly parallel
    step: Array  # (3, M): to the minimum of E1
    gain: Array  # (M, 3, 6K): a change u of the anchors' errors moves them by -gain u
    information: Array  # (6K, 6K)
    gradient: Array  # (6K,)
    square: Array  # (P,): of the residuals, in sigma
    weight: Array  # (P,)

    def unbounded_covariance(self) -> Array:
        """Return the covariance (M, 3, 3) as large as it is, where rays are nearly parallel too."""
        floor = (1e-12 * np.trace(self.normal) + 1e-100) * np.eye(3)[..., None]
        return np.moveaxis(invert_symmetric(self.normal + floor), -1, 0)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations; the unknowns are the anchors' errors, then the query's (dc, dtheta)."""

    state: _State
    information: Array  # (6K + 6, 6K + 6): of the images; the prior is not in it
    gradient: Array  # (6K + 6,): with the prior's
    points: _Points
    inliers: NDArray[np.bool_]  # (M,)
    variance: float  # of the residuals: 1 where sigma_px is right

    def is_determined(self) -> bool:
        return self.inliers.sum() >= MIN_POINTS and is_determined(self.information[-6:, -6:])

    def step(self) -> _State:
        state = self.state
        normal = self.information + self._prior()
        step = np.linalg.solve(normal, -self.gradient).astype(np.float64, copy=False)
        return _State(
            perturb(state.cam_from_world, step[-6:]),
            state.errors + step[:-6].reshape(-1, 6),
            state.points3d + self.points.step.T - self.points.gain @ step[:-6],
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

    @cached_property
    def index(self) -> Index:
        """Which of the points each observation is of (P,)."""
        return np.repeat(np.arange(len(self.points2d)), self.latent.tracks.lengths)

    @cached_property
    def by_view(self) -> list[Index]:
        """The observations of each view."""
        view = self.latent.tracks.view
        return [np.flatnonzero(view == k) for k in range(len(self.view_std))]

    def find_inliers(self, state: _State) -> NDArray[np.bool_]:
        seen = project(state.cam_from_world, state.points3d)
        return self._are_inliers(seen, seen.xy - self.points2d.T)

    def _are_inliers(self, seen: Projection, r: Array) -> NDArray[np.bool_]:
        near: NDArray[np.bool_] = (r**2).sum(axis=0) < (self.max_error_px * self.px) ** 2
        return near & seen.in_front

    def linearize(self, state: _State) -> _System:
        """Add E2, the query's keypoints against the points where E1 puts them, to E1."""
        points = self._eliminate_points(state)
        seen = project(state.cam_from_world, state.points3d)
        B = seen.by_point
        r = seen.xy - self.points2d.T + multiply(B, points.step[:, None])[:, 0]
        variance = (self.sigma_px * self.px) ** 2 * np.eye(2)[..., None]
        S = variance + multiply(multiply(B, points.covariance), np.swapaxes(B, 0, 1))
        inliers = self._are_inliers(seen, r)
        whiten = inverse_cholesky(S)
        r = multiply(whiten, r[:, None])[:, 0]
        limit = (self.max_error_px / self.sigma_px) ** 2
        square = np.where(inliers, (r**2).sum(axis=0), limit)
        weight = np.where(inliers, 1 / (1 + square / CAUCHY**2), 0.0)
        root = np.sqrt(weight)
        r, whiten = r * root, whiten * root
        by_error = np.moveaxis(multiply(whiten, -B), -1, 0) @ points.gain  # (M, 2, 6K)
        by_pose = np.moveaxis(multiply(whiten, seen.by_pose), -1, 0)
        J = np.concatenate([by_error, by_pose], axis=2).reshape(2 * len(weight), -1)

        information, gradient = J.T @ J, J.T @ r.T.ravel()
        information[:-6, :-6] += points.information
        gradient[:-6] += points.gradient + state.errors.ravel()
        squares = np.concatenate([points.square, square])
        weights = np.concatenate([points.weight, weight])
        dof = max(2 * weights.sum() - 3 * len(weight) - 6, 0.0)
        mean_square = ((weights * squares).sum() + PRIOR_DOF) / (dof + PRIOR_DOF)
        return _System(state, information, gradient, points, inliers, float(mean_square))

    def _eliminate_points(self, state: _State) -> _Points:
        """Linearise E1 about the state."""
        tracks, index = self.latent.tracks, self.index
        num_views, num_points = len(self.view_std), len(self.points2d)
        _, starts = tracks.groups()
        views = perturb(self.views_from_world, state.errors * self.view_std)
        seen = project(views, state.points3d[index], tracks.view)
        r = seen.xy - tracks.xy.T
        sigma = self.sigma_px * tracks.px
        square = np.where(seen.in_front, (r**2).sum(axis=0) / sigma**2, 1e12)
        weight = 1 / (1 + square / CAUCHY**2)
        root = np.sqrt(weight) / sigma
        rows = np.empty((2, 10, len(tracks)))  # by the point, by the anchor's error, residual
        rows[:, :3] = seen.by_point * root
        rows[:, 3:9] = seen.by_pose * (root * self.view_std.T[:, tracks.view])
        rows[:, 9] = r * root
        # What each observation adds to its point's equations: the sum over its two rows.
        products = multiply(np.swapaxes(rows[:, :3], 0, 1), rows)  # (3, 10, P)

        H = np.add.reduceat(products[:, :3], starts, axis=-1)
        g = np.add.reduceat(products[:, 9], starts, axis=-1)
        trace = np.trace(H)  # rays that are nearly parallel leave H singular
        C = invert_symmetric(H + 1e-9 * (trace + np.median(trace)) * np.eye(3)[..., None])
        step = -multiply(C, g[:, None])[:, 0]
        mixed = np.zeros((num_points, 3, num_views, 6))
        mixed[index, :, tracks.view] = np.moveaxis(products[:, 3:9], -1, 0)
        gain = np.moveaxis(C, -1, 0) @ mixed.reshape(num_points, 3, -1)

        flat = mixed.reshape(3 * num_points, -1)
        information = -flat.T @ gain.reshape(flat.shape)
        gradient = flat.T @ step.T.ravel()
        for view, own in enumerate(self.by_view):
            block = slice(6 * view, 6 * view + 6)
            of_view = np.swapaxes(rows[:, 3:, own], 0, 1).reshape(7, -1)
            sums = of_view @ of_view.T
            information[block, block] += sums[:6, :6]
            gradient[block] += sums[:6, 6]
        return _Points(H, C, step, gain, information, gradient, square, weight)
