"""Translation averaging: what the paper's center averaging is compared with.

With known relative poses up to scale, T_q = R_qk T_k + lambda_qk T_qk (paper, eq. 4): in the
query's frame T_q lies on lines through R_qk T_k along T_qk, and minimising eq. 5 is finding the
point nearest to them. The lines pass through points that the relative rotations have moved, by
the rotations' errors times |T_k|, so that the result depends on the world's origin and is the
worse the farther away that is. `center_averaging` has no such error.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.center_averaging import average_centers, nearest_point_to_lines
from trigpoint.rigid import Rigid3, rotate

Array = NDArray[np.float64]


def average_translations(anchors_from_world: Rigid3, query_from_anchors: Rigid3) -> Array | None:
    """Return the T_q with the least squared error in eq. 5, in closed form.

    Minimises  sum_k |[T_kq]x (T_k - R_kq T_q)|^2  with unit T_kq.

    Parameters
    ----------
    anchors_from_world : Rigid3 (K,)
        Poses (R_k, T_k) of the anchors.
    query_from_anchors : Rigid3 (K,)
        Relative poses (R_qk, T_qk); the translations may have any length but zero.

    Returns
    -------
    (3,) float64 or None
        T_q of query_from_world; None if the translations T_qk fix no point, as in
        `average_centers`.
    """
    return average_centers(*_translation_lines(anchors_from_world, query_from_anchors))


def average_translations_govindu(
    anchors_from_world: Rigid3,
    query_from_anchors: Rigid3,
    *,
    num_iterations: int = 50,
    tolerance: float = 1e-6,
) -> Array | None:
    """Return T_q by Govindu's iteration, which turns the errors of eq. 5 from lengths to angles.

    Each equation is divided by lambda_k = |T_k - R_kq T_q| of the last solution and solved again
    (Govindu, "Combining two-view constraints for motion estimation", 2001).

    Parameters
    ----------
    anchors_from_world, query_from_anchors : Rigid3 (K,)
        As in `average_translations`.
    num_iterations : int
        Solutions at most; the last one counts if they have not settled.
    tolerance : float
        A step below this fraction of the largest lambda_k is the last. No lambda_k is taken to
        be smaller than that fraction, so that an anchor at the query's own place keeps a finite
        weight.

    Returns
    -------
    (3,) float64 or None
        T_q of query_from_world; None where `average_translations` gives None.
    """
    points, directions = _translation_lines(anchors_from_world, query_from_anchors)
    T_q = average_centers(points, directions)
    if T_q is None:
        return None
    for _ in range(num_iterations):
        previous = T_q
        lambdas = np.linalg.norm(T_q - points, axis=1)
        resolution = tolerance * lambdas.max()
        T_q = nearest_point_to_lines(points, directions, np.maximum(lambdas, resolution) ** -2)
        if math.dist(T_q, previous) < resolution:
            break
    return T_q


def _translation_lines(
    anchors_from_world: Rigid3, query_from_anchors: Rigid3
) -> tuple[Array, Array]:
    """Points (K, 3) and unit directions (K, 3), in the query's frame, of lines through T_q."""
    T_qk = query_from_anchors.t
    directions = T_qk / np.linalg.norm(T_qk, axis=-1, keepdims=True)
    return rotate(query_from_anchors.R, anchors_from_world.t), directions
