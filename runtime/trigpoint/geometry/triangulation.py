"""N-view triangulation of latent points (paper, E1 and Proposition 2), batched over points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.epipolar import essential_matrix, homogeneous, sampson_error
from trigpoint.rigid import Rigid3, rotate

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points in views, in the order of the points.

    Parameters
    ----------
    point : (P,) int
        Which point, rising; the points that occur need not be consecutive.
    view : (P,) int
        Which view.
    xy : (P, 2) float64
        Where, in normalised image coordinates.
    px : (P,) float64
        The size of a pixel there: views differ in focal length, and so in how fine they see.
    """

    point: Index
    view: Index
    xy: Array
    px: Array

    def __len__(self) -> int:
        return len(self.point)

    def __getitem__(self, index: slice | NDArray[np.generic]) -> Tracks:
        return Tracks(self.point[index], self.view[index], self.xy[index], self.px[index])

    def groups(self) -> tuple[Index, Index]:
        """Return the points that occur (M,) and where each one's observations start (M,)."""
        return self.point[self._starts], self._starts

    @cached_property
    def _starts(self) -> Index:
        is_first = np.ones(len(self), bool)
        np.not_equal(self.point[1:], self.point[:-1], out=is_first[1:])
        return np.flatnonzero(is_first)

    @cached_property
    def lengths(self) -> Index:
        """How many observations each point has (M,)."""
        return np.diff(self._starts, append=len(self))

    @classmethod
    def concatenate(cls, parts: Sequence[Tracks]) -> Tracks:
        """Put tracks together, by point; the observations of one point in the order of the parts.

        At least one part.
        """
        joined = cls(
            np.concatenate([part.point for part in parts]),
            np.concatenate([part.view for part in parts]),
            np.concatenate([part.xy for part in parts]),
            np.concatenate([part.px for part in parts]),
        )
        return joined[np.argsort(joined.point, kind="stable")]

    def of_length(self, min_length: int) -> Tracks:
        """Keep the points with at least so many observations."""
        return self[np.repeat(self.lengths >= min_length, self.lengths)]

    def in_groups_of(self, min_length: int, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Of the observations kept (P,), say which are of points that keep at least so many."""
        num_kept = (
            np.add.reduceat(kept.astype(np.intp), self._starts) if len(self) else self.lengths
        )
        return kept & np.repeat(num_kept >= min_length, self.lengths)


@dataclass(frozen=True, eq=False)
class LatentPoints:
    """Triangulated points.

    Parameters
    ----------
    point : (M,) int
        Which points of the tracks.
    points3d : (M, 3) float64
        In the world.
    covariance : (M, 3, 3) float64
        For image noise of one pixel; scale by the variance of the noise in px^2.
    tracks : Tracks
        The observations they agree with, two at least for each.
    """

    point: Index
    points3d: Array
    covariance: Array
    tracks: Tracks


def intersect_rays(views_from_world: Rigid3, tracks: Tracks) -> Array:
    """Points (M, 3) nearest to all their rays: a linear first estimate.

    For each point the solution of sum (I - d d^T) X = sum (I - d d^T) c, as in Proposition 1, with
    weights 1 / px^2. Rays that are nearly parallel give a point far away, not an error.
    """
    return _solve_rays(_ray_equations(views_from_world, tracks), tracks)


def _ray_equations(views_from_world: Rigid3, tracks: Tracks) -> Array:
    """Say what each ray adds to its point's equations (P, 3, 5): I - d d^T, (I - d d^T) c, c."""
    R = views_from_world.R[tracks.view]
    d = rotate(np.swapaxes(R, 1, 2), homogeneous(tracks.xy))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    c = views_from_world.center[tracks.view]
    normal = (np.eye(3) - d[:, :, None] * d[:, None, :]) / tracks.px[:, None, None] ** 2
    return np.concatenate([normal, rotate(normal, c)[:, :, None], c[:, :, None]], axis=2)


def _solve_rays(equations: Array, tracks: Tracks) -> Array:
    total = np.add.reduceat(equations, tracks.groups()[1])
    A, b = total[:, :, :3], total[:, :, 3:4]
    mean = total[:, :, 4:] / tracks.lengths[:, None, None]
    # Parallel rays leave A singular along themselves: a tiny pull to the mean center settles it.
    pull = 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None]
    solution: Array = np.linalg.solve(A + pull * np.eye(3), b + pull * mean)[:, :, 0]
    return solution


def project_tracks(
    views_from_world: Rigid3, tracks: Tracks, points3d: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Residuals and Jacobians of every observation.

    Parameters
    ----------
    views_from_world : Rigid3
        The views (V,).
    tracks : Tracks
        P observations of M points.
    points3d : (M, 3) float64
        In the order of `tracks.groups()`.

    Returns
    -------
    residuals : (P, 2) float64
        Projection minus observation, in px.
    jacobians : (P, 2, 3) float64
        Of the projection by the point, in px.
    in_front : (P,) bool
    """
    X = np.repeat(points3d, tracks.lengths, axis=0)
    R = views_from_world.R[tracks.view]
    Y = rotate(R, X) + views_from_world.t[tracks.view]
    in_front = Y[:, 2] > 0
    z = np.where(in_front, Y[:, 2], 1.0)
    xy = Y[:, :2] / z[:, None]
    jacobians = (R[:, :2] - xy[:, :, None] * R[:, 2:]) / (z * tracks.px)[:, None, None]
    return (xy - tracks.xy) / tracks.px[:, None], jacobians, in_front


def triangulate(
    views_from_world: Rigid3, tracks: Tracks, *, num_iterations: int = 3
) -> tuple[Array, Array]:
    """Triangulate every point from all its observations.

    Minimises E1 (paper, eq. 13): the sum of squared distances, in px, of a point's projections from
    its observations. That is the objective of Proposition 2, which writes it in
    the first view's point and depth: the third term of its sum must read rho^2 |g|^2 where the
    paper prints rho |g|^2, since |rho R g + T|^2 = rho^2 |g|^2 + |T|^2 + 2 rho g^T R^T T. Over
    X in the world it is the same minimum without singling out a view. Gauss-Newton from
    `intersect_rays`, a step is kept where it lowers the point's cost, else it is halved.

    Parameters
    ----------
    views_from_world : Rigid3
        Poses of the views (V,).
    tracks : Tracks
        P observations of M points, each with two at least.
    num_iterations : int
        Gauss-Newton steps.

    Returns
    -------
    points3d : (M, 3) float64
        In the order of `tracks.groups()`; for parallel rays some far point.
    covariance : (M, 3, 3) float64
        Inverse of the normal matrix: the covariance for image noise of one pixel. Huge, never
        infinite, where the rays are near parallel.
    """
    _, starts = tracks.groups()
    X = intersect_rays(views_from_world, tracks)

    def evaluate(X: Array) -> tuple[Array, Array, Array]:
        r, J, in_front = project_tracks(views_from_world, tracks, X)
        squares = np.where(in_front, (r**2).sum(axis=1), 1e12)
        J = np.where(in_front[:, None, None], J, 0.0)
        H = np.add.reduceat(np.swapaxes(J, 1, 2) @ J, starts)
        g = np.add.reduceat((np.swapaxes(J, 1, 2) @ r[:, :, None])[:, :, 0], starts)
        return np.add.reduceat(squares, starts), H, g

    def regular(H: Array) -> Array:
        # Parallel rays leave H singular: the point may then lie anywhere along them.
        floor = 1e-12 * np.trace(H, axis1=1, axis2=2) + np.finfo(float).tiny
        regular: Array = H + floor[:, None, None] * np.eye(3)
        return regular

    cost, H, g = evaluate(X)
    size = np.ones(len(X))
    for _ in range(num_iterations):
        step = np.linalg.solve(regular(H), g[:, :, None])[:, :, 0]
        candidate = X - size[:, None] * step
        new_cost, new_H, new_g = evaluate(candidate)
        better = new_cost <= cost
        X = np.where(better[:, None], candidate, X)
        H = np.where(better[:, None, None], new_H, H)
        g = np.where(better[:, None], new_g, g)
        cost = np.minimum(cost, new_cost)
        size = np.where(better, 1.0, size / 2)
    return X, np.linalg.inv(regular(H)).astype(np.float64, copy=False)


def keep_agreeing(views_from_world: Rigid3, tracks: Tracks, *, max_error_px: float) -> Tracks:
    """Keep, of each point, the observation that agrees with the most others, and these.

    Two observations agree that are within `max_error_px` of each other's epipolar lines. Where a
    point's observations are of two places, as in a repeated structure, those of one are left; from
    all of them together no point could be triangulated that is near any.
    """
    tracks = tracks.of_length(2)
    if len(tracks) == 0:
        return tracks
    num, (_, starts), lengths = len(tracks), tracks.groups(), tracks.lengths
    # Each observation with those of its point that come after it.
    index = np.arange(num)
    following = np.repeat(starts + lengths, lengths) - index - 1
    a = np.repeat(index, following)
    b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(following) - following, following)
    pair = tracks.view[b] * len(views_from_world) + tracks.view[a]
    pairs, which = np.unique(pair, return_inverse=True)
    view_b, view_a = np.divmod(pairs, len(views_from_world))
    E = essential_matrix(views_from_world[view_b] @ views_from_world[view_a].inverse())
    errors = np.abs(sampson_error(E[which], tracks.xy[a], tracks.xy[b]))
    agree = errors < max_error_px * np.sqrt((tracks.px[a] ** 2 + tracks.px[b] ** 2) / 2)
    a, b = a[agree], b[agree]

    votes = np.bincount(a, minlength=num) + np.bincount(b, minlength=num)
    most = np.maximum.reduceat(votes, starts)
    candidates = np.flatnonzero(votes == np.repeat(most, lengths))
    leader = candidates[np.searchsorted(candidates, starts)]  # of each point, the first of them
    own_leader = np.repeat(leader, lengths)
    kept = np.zeros(num, bool)
    kept[leader] = True
    kept[b[own_leader[a] == a]] = True
    kept[a[own_leader[b] == b]] = True
    return tracks[kept]


def triangulate_robust(
    views_from_world: Rigid3, tracks: Tracks, *, max_error_px: float, num_iterations: int = 1
) -> LatentPoints:
    """Triangulate points whose observations may be wrong.

    The worst observation of a point is dropped, and the point triangulated again, while any is
    farther than `max_error_px` from its projection, or behind its view. A point ends with at least
    two observations or not at all. What is left is triangulated with `num_iterations`.
    """
    active = tracks.of_length(2)
    equations = _ray_equations(views_from_world, active)
    settled = [active[:0]]
    while len(active):
        _, starts = active.groups()
        lengths = active.lengths
        X = _solve_rays(equations, active)
        Y = views_from_world[active.view].apply(np.repeat(X, lengths, axis=0))
        in_front = Y[:, 2] > 0
        z = np.where(in_front, Y[:, 2], 1.0)
        r = Y[:, :2] / z[:, None] - active.xy
        errors = np.where(in_front, np.sqrt((r**2).sum(axis=1)) / active.px, np.inf)
        worst = np.maximum.reduceat(errors, starts)
        done = np.repeat(worst <= max_error_px, lengths)
        settled.append(active[done])
        is_worst = errors == np.repeat(worst, lengths)
        left = active.in_groups_of(2, ~done & ~is_worst)
        active, equations = active[left], equations[left]
    kept = Tracks.concatenate(settled)
    points3d, covariance = triangulate(views_from_world, kept, num_iterations=num_iterations)
    return LatentPoints(kept.groups()[0], points3d, covariance, kept)
