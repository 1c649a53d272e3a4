"""Two-view error: how far a match lies from the epipolar geometry of a relative pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, skew

Array = NDArray[np.float64]


def essential_matrix(b_from_a: Rigid3) -> Array:
    """E = [t]x R, (..., 3, 3): x_b^T E x_a = 0 for a true match."""
    E: Array = skew(b_from_a.t) @ b_from_a.R
    return E


def homogeneous(points: Array) -> Array:
    """Append a one: (..., 2) to (..., 3)."""
    return np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)


def sampson_error(E: Array, points_a: Array, points_b: Array) -> Array:
    """Signed first-order distance of matches to the epipolar geometry (Sampson 1982).

    Parameters
    ----------
    E : (3, 3) or (N, 3, 3) float64
        Essential matrix b from a, one for all or one a match; of any scale.
    points_a, points_b : (N, 2) float64
        Normalised image points.

    Returns
    -------
    (N,) float64
        x_b^T E x_a / sqrt((E x_a)_1^2 + (E x_a)_2^2 + (E^T x_b)_1^2 + (E^T x_b)_2^2), in the
        units of the points; 0 where the denominator vanishes (a point on both epipoles).
    """
    # Over the points at once: see `points_last`.
    E = np.moveaxis(E, (-2, -1), (0, 1)) if E.ndim == 3 else E[..., None]
    (xa, ya), (xb, yb) = np.ascontiguousarray(points_a.T), np.ascontiguousarray(points_b.T)
    line_b = E[:, 0] * xa + E[:, 1] * ya + E[:, 2]
    line_a = E[0, :2] * xb + E[1, :2] * yb + E[2, :2]
    algebraic = line_b[0] * xb + line_b[1] * yb + line_b[2]
    gradient = np.sqrt((line_b[:2] ** 2).sum(axis=0) + (line_a**2).sum(axis=0))
    error: Array = algebraic / np.maximum(gradient, np.finfo(float).tiny)
    return error
