"""The query's camera center from the directions in which the anchors see it.

Anchor k, at c_k, puts the query on the line c_k + lambda d_k with d_k = R_k^T T_kq / |T_kq|
(paper, eq. 9); the center is the point nearest to all lines (Proposition 1). The query's
rotation takes no part, and the world's origin, axes and unit do not matter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, rotate

Array = NDArray[np.float64]

# Lines whose directions spread less than this (rms about their common one) fix no point: the
# directions themselves are not known better.
_MIN_SPREAD_RAD = math.radians(0.25)


def center_directions(anchors_from_world: Rigid3, query_from_anchors: Rigid3) -> Array:
    """Return the directions in which the anchors see the query (paper, eq. 9).

    d_k = R_k^T T_kq / |T_kq| with T_kq = -R_qk^T T_qk.

    Parameters
    ----------
    anchors_from_world : Rigid3 (K,)
        Poses (R_k, T_k) of the anchors.
    query_from_anchors : Rigid3 (K,)
        Relative poses (R_qk, T_qk); the translations may have any length but zero.

    Returns
    -------
    (K, 3) float64
        Unit vectors from each anchor towards the query, in the world's axes.
    """
    towards_query = rotate(np.swapaxes(anchors_from_world.R, -1, -2), query_from_anchors.center)
    directions: Array = towards_query / np.linalg.norm(towards_query, axis=-1, keepdims=True)
    return directions


def average_centers(
    centers: Array, directions: Array, weights: Array | None = None
) -> Array | None:
    """Return the point with the least sum of squared distances to the lines (Proposition 1).

    It solves  sum_k w_k P_k c = sum_k w_k P_k c_k  with  P_k = I - d_k d_k^T.

    Parameters
    ----------
    centers : (K, 3) float64
        The anchors' centers c_k in the world, or any points of the lines.
    directions : (K, 3) float64
        Unit directions d_k; their sign does not matter.
    weights : (K,) float64, optional
        Not negative; 1 if absent.

    Returns
    -------
    (3,) float64 or None
        The center in the world. None if the lines fix no point: fewer than two of them, or all
        nearly parallel, as when anchors and query lie on one line. What decides is the smallest
        eigenvalue of sum_k w_k P_k over sum_k w_k: the mean squared sine of the angles between
        the lines and the direction they have most in common.

    Notes
    -----
    Lines through one place meet there. So anchors at one place "find" the query at that place
    if their directions differ: right if it stands there, and otherwise their directions differ
    by errors alone.
    """
    if weights is None:
        weights = np.ones(len(centers))
    spread = np.linalg.eigvalsh(_projectors(directions, weights).sum(axis=0))[0]
    if spread <= math.sin(_MIN_SPREAD_RAD) ** 2 * weights.sum():
        return None
    return nearest_point_to_lines(centers, directions, weights)


def average_centers_robust(
    centers: Array, directions: Array, *, num_iterations: int = 50, tolerance: float = 1e-3
) -> Array | None:
    """Return the point with the least sum of angles, not of squared distances, from the lines.

    It is the directions that err, all alike, and some altogether. A direction's error moves its
    line in proportion to the anchor's distance, so that by squared distances the far anchors
    dominate, the more anchors the more so, and a single wrong one moves the center at will.
    Minimises  sum_k sqrt(s_k^2 + eps^2)  with the sines  s_k = |P_k (c - c_k)| / |c - c_k|  by
    iteratively reweighted least squares (Weiszfeld, 1937), from the point with the least sum of
    distances, which is a single one, and that from Proposition 1. A step holds the ranges
    |c - c_k|, so that it settles near the minimum: of random cases 0.3 % have a point close by that
    is better by more than the rounding.

    Parameters
    ----------
    centers, directions : (K, 3) float64
        As in `average_centers`.
    num_iterations : int
        Reweighted solutions at most, of both sums; the last one counts if they have not settled.
    tolerance : float
        What rounds off the cost where it is zero: eps in radians, and for distances as a fraction
        of the rms distance of the anchors from their centroid. A step below a tenth of that is the
        last.

    Returns
    -------
    (3,) float64 or None
        The center in the world; None where `average_centers` gives None.
    """
    center = average_centers(centers, directions)
    if center is None:
        return None
    resolution = tolerance * math.sqrt(centers.var(axis=0).sum())
    if resolution == 0.0:  # anchors at one place: every line goes through it
        return center
    for by_angle in (False, True):
        for _ in range(num_iterations):
            previous = center
            distances = line_distances(center, centers, directions)
            if by_angle:
                ranges = np.maximum(np.linalg.norm(center - centers, axis=1), resolution)
                weights = 1.0 / (ranges * np.hypot(distances, tolerance * ranges))
            else:
                weights = 1.0 / np.hypot(distances, resolution)
            center = nearest_point_to_lines(centers, directions, weights)
            if math.dist(center, previous) < 0.1 * resolution:
                break
    return center


def nearest_point_to_lines(points: Array, directions: Array, weights: Array) -> Array:
    """Solve Proposition 1 for lines (K, 3), (K, 3) known to fix a point (3,)."""
    projectors = _projectors(directions, weights)
    origin = points.mean(axis=0)  # the world's may be too far away for rounding errors
    moments = rotate(projectors, points - origin).sum(axis=0)
    nearest: Array = origin + np.linalg.solve(projectors.sum(axis=0), moments)
    return nearest


def line_distances(point: Array, points: Array, directions: Array) -> Array:
    """Distances (K,) of a point (3,) from lines through points (K, 3)."""
    offsets = point - points
    along = np.sum(offsets * directions, axis=1, keepdims=True)
    distances: Array = np.linalg.norm(offsets - along * directions, axis=1)
    return distances


def _projectors(directions: Array, weights: Array) -> Array:
    """w_k (I - d_k d_k^T): what is left of a vector across the line, weighted; (K, 3, 3)."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return weights[:, None, None] * across
