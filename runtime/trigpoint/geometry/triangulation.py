"""N-view triangulation of latent points (paper, E1 and Proposition 2), batched over points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.epipolar import essential_matrix, sampson_error
from trigpoint.geometry.points_last import invert_symmetric, multiply, project
from trigpoint.rigid import Rigid3

Array = NDArray[np.float64]
Index = NDArray[np.intp]

NUM_LEADERS = 8


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
    points3d : (M, 3) float64
        In the world.
    tracks : Tracks
        The observations they agree with, two at least for each.
    """

    points3d: Array
    tracks: Tracks

    @property
    def point(self) -> Index:
        """Which points of the tracks (M,)."""
        return self.tracks.groups()[0]


def triangulate(
    views_from_world: Rigid3,
    tracks: Tracks,
    *,
    start: Array | None = None,
    num_iterations: int = 1,
) -> Array:
    """Triangulate every point from all its observations.

    Minimises E1 (paper, eq. 13): the sum of squared distances, in px, of a point's projections from
    its observations. That is the objective of Proposition 2, which writes it in
    the first view's point and depth: the third term of its sum must read rho^2 |g|^2 where the
    paper prints rho |g|^2, since |rho R g + T|^2 = rho^2 |g|^2 + |T|^2 + 2 rho g^T R^T T. Over
    X in the world it is the same minimum without singling out a view. Gauss-Newton.

    Parameters
    ----------
    views_from_world : Rigid3
        Poses of the views (V,).
    tracks : Tracks
        P observations of M points, each with two at least.
    start : (M, 3) float64, optional
        The points nearest to their rays by default.
    num_iterations : int

    Returns
    -------
    (M, 3) float64
        In the order of `tracks.groups()`; for parallel rays some far point.
    """
    X: Array = intersect_rays(views_from_world, tracks) if start is None else start
    _, starts = tracks.groups()
    for _ in range(num_iterations):
        seen = project(views_from_world, np.repeat(X, tracks.lengths, axis=0), tracks.view)
        rows = np.empty((2, 4, len(tracks)))  # by the point, residual
        rows[:, :3] = np.where(seen.in_front, seen.by_point / tracks.px, 0.0)
        rows[:, 3] = (seen.xy - tracks.xy.T) / tracks.px
        sums = np.add.reduceat(multiply(np.swapaxes(rows[:, :3], 0, 1), rows), starts, axis=-1)
        H, g = sums[:, :3], sums[:, 3:]
        # Parallel rays leave H singular: the point may then lie anywhere along them.
        floor = (1e-9 * np.trace(H) + 1e-100) * np.eye(3)[..., None]
        X = X - multiply(invert_symmetric(H + floor), g)[:, 0].T
    return X


def intersect_rays(views_from_world: Rigid3, tracks: Tracks) -> Array:
    """Points (M, 3) nearest to all their rays: a linear first estimate.

    For each point the solution of sum (I - d d^T) X = sum (I - d d^T) c, as in Proposition 1, with
    weights 1 / px^2. Rays that are nearly parallel give a point far away, not an error.
    """
    origin: Array = views_from_world.center.mean(axis=0)
    return origin + _solve_rays(_ray_equations(views_from_world, tracks, origin), tracks)


def _ray_equations(views_from_world: Rigid3, tracks: Tracks, origin: Array) -> Array:
    """Say what each ray adds to its point's equations (4, 3, P): I - d d^T, (I - d d^T) c."""
    R = np.ascontiguousarray(np.moveaxis(views_from_world.R, 0, -1))[:, :, tracks.view]
    x, y = tracks.xy.T
    d = R[0] * x + R[1] * y + R[2]
    d /= np.sqrt((d**2).sum(axis=0))
    c = np.ascontiguousarray((views_from_world.center - origin).T)[:, tracks.view]
    equations = np.empty((4, 3, len(tracks)))
    equations[:3] = (np.eye(3)[..., None] - d[:, None] * d) / tracks.px**2
    equations[3] = multiply(equations[:3], c[:, None])[:, 0]
    return equations


def _solve_rays(equations: Array, tracks: Tracks) -> Array:
    total = np.add.reduceat(equations, tracks.groups()[1], axis=-1)
    A, b = total[:3], total[3]
    # Parallel rays leave A singular along themselves: a tiny pull to the origin settles it.
    pull = 1e-9 * np.trace(A) * np.eye(3)[..., None]
    solution: Array = multiply(invert_symmetric(A + pull), b[:, None])[:, 0].T
    return solution


def keep_agreeing(views_from_world: Rigid3, tracks: Tracks, *, max_error_px: float) -> Tracks:
    """Keep, of each point, the observation that agrees with the most others, and these.

    Two observations agree that are within `max_error_px` of each other's epipolar lines. Where a
    point's observations are of two places, as in a repeated structure, those of one are left; from
    all of them together no point could be triangulated that is near any. One of the first
    `NUM_LEADERS` observations must be among them: in the views that come first.
    """
    tracks = tracks.of_length(2)
    if len(tracks) == 0:
        return tracks
    num, (_, starts), lengths = len(tracks), tracks.groups(), tracks.lengths
    # Each leader with those of its point that come after it.
    index = np.arange(num)
    rank = index - np.repeat(starts, lengths)
    following = np.where(rank < NUM_LEADERS, np.repeat(lengths, lengths) - rank - 1, 0)
    a = np.repeat(index, following)
    b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(following) - following, following)
    E = essential_matrix(views_from_world[:, None] @ views_from_world[None].inverse())
    errors = np.abs(sampson_error(E[tracks.view[b], tracks.view[a]], tracks.xy[a], tracks.xy[b]))
    agree = errors < max_error_px * np.sqrt((tracks.px[a] ** 2 + tracks.px[b] ** 2) / 2)
    a, b = a[agree], b[agree]

    votes = np.bincount(a, minlength=num) + np.bincount(b, minlength=num)
    votes[rank >= NUM_LEADERS] = -1
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
    origin = views_from_world.center.mean(axis=0)
    equations = _ray_equations(views_from_world, active, origin)
    settled, found = [active[:0]], [np.empty((0, 3))]
    while len(active):
        _, starts = active.groups()
        lengths = active.lengths
        X = origin + _solve_rays(equations, active)
        seen = project(views_from_world, np.repeat(X, lengths, axis=0), active.view)
        distances = np.sqrt(((seen.xy - active.xy.T) ** 2).sum(axis=0)) / active.px
        errors = np.where(seen.in_front, distances, np.inf)
        worst = np.maximum.reduceat(errors, starts)
        done = worst <= max_error_px
        found.append(X[done])
        done = np.repeat(done, lengths)
        settled.append(active[done])
        is_worst = errors == np.repeat(worst, lengths)
        left = active.in_groups_of(2, ~done & ~is_worst)
        active, equations = active[left], equations[:, :, left]
    order = np.argsort(np.concatenate([part.groups()[0] for part in settled]), kind="stable")
    start, kept = np.concatenate(found)[order], Tracks.concatenate(settled)
    X = triangulate(views_from_world, kept, start=start, num_iterations=num_iterations)
    return LatentPoints(X, kept)
