"""RANSAC over pairs of anchors (paper, step ii): which relative poses agree on one query pose.

Two anchors are the fewest that fix a pose: their rays meet in the query's center, and each gives
its rotation R_qk R_k. All pairs are tried, so nothing here is random.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.center_averaging import center_directions
from trigpoint.geometry.rotation_averaging import average_pairs, quaternion_angles
from trigpoint.rigid import Rigid3, quaternion_from_rotation, rotation_from_quaternion

Array = NDArray[np.float64]

MIN_ANGLE_RAD = math.radians(1.5)


@dataclass(frozen=True, eq=False)
class AnchorConsensus:
    """The pose that most anchors agree on.

    Parameters
    ----------
    inliers : (K,) bool
        The anchors that agree with it, two at least.
    center : (3,) float64
        The query's center in the world, from the pair alone.
    R : (3, 3) float64
        The rotation of query_from_world, from the pair alone.
    pair : (int, int)
        The anchors that proposed it.
    """

    inliers: NDArray[np.bool_]
    center: Array
    R: Array
    pair: tuple[int, int]


class NoConsensus(Enum):
    """Why there is no such pose."""

    DISAGREEMENT = "fewer than two anchors agree on a pose"
    DEGENERATE = "the anchors see the query along one line, or stand at one place"


def find_consensus(
    anchors_from_world: Rigid3,
    query_from_anchors: Rigid3,
    *,
    max_direction_error_rad: float,
    max_rotation_error_rad: float,
    min_angle_rad: float = MIN_ANGLE_RAD,
) -> AnchorConsensus | NoConsensus:
    """Return the pose, of those that pairs of anchors propose, with the most votes.

    A pair proposes the midpoint between its lines c_k + lambda d_k and the mean of its rotations
    R_qk R_k. Anchor k votes for a proposal (c, R) if its ray points there, angle(d_k, c - c_k) <=
    max_direction_error_rad, which a center behind it never satisfies, and its rotation agrees,
    angle(R_qk R_k, R) <= max_rotation_error_rad. Proposals without the votes of their own pair
    are dropped. A tie goes to the least sum of errors, each as a fraction of its threshold and 1
    at most.

    Parameters
    ----------
    anchors_from_world : Rigid3 (K,)
        Poses (R_k, T_k) of the anchors.
    query_from_anchors : Rigid3 (K,)
        Relative poses (R_qk, T_qk); the translations may have any length but zero.
    max_direction_error_rad, max_rotation_error_rad : float
        Between 0 and pi / 2. The latter also bounds how much a pair's two rotations differ.
    min_angle_rad : float
        Rays closer than this to parallel (or opposed) cross nowhere in particular, and their
        pair proposes nothing.

    Returns
    -------
    AnchorConsensus or NoConsensus
        `DEGENERATE` if there are pairs that agree on the rotation but none whose rays cross, so
        that the center is free along a line. `DISAGREEMENT` if no pair agrees on the rotation,
        or none votes for its own proposal; so too for fewer than two anchors.

    Notes
    -----
    An anchor at the query's own place sees it in no direction, and that of its relative pose is
    arbitrary. So an anchor nearer to the winning center than that is certain
    (max_direction_error_rad times the mean distance of the proposing pair) is an inlier by its
    rotation alone: its line passes as near as it stands, which does averaging no harm. But it
    does not vote by its rotation alone, or wrong centers amid many anchors would win.

    Where all rays but one lie on one line, that one alone decides where on it the center is.
    """
    centers = anchors_from_world.center
    directions = center_directions(anchors_from_world, query_from_anchors)
    q = quaternion_from_rotation(query_from_anchors.R @ anchors_from_world.R)

    pairs = np.stack(np.triu_indices(len(centers), k=1), axis=1)
    pairs = pairs[quaternion_angles(q, q)[tuple(pairs.T)] <= max_rotation_error_rad]
    if len(pairs) == 0:
        return NoConsensus.DISAGREEMENT
    pairs = pairs[_rays_cross(centers[pairs], directions[pairs], min_angle_rad)]
    if len(pairs) == 0:
        return NoConsensus.DEGENERATE
    midpoints, ranges = _meet(centers[pairs], directions[pairs])
    q_pairs = average_pairs(q[pairs])

    towards = midpoints[:, None] - centers
    distances = np.linalg.norm(towards, axis=2)
    cosines = np.einsum("pki,ki->pk", towards, directions) / np.where(distances > 0, distances, 1)
    direction_errors = np.arccos(np.clip(cosines, -1, 1)) / max_direction_error_rad
    rotation_errors = quaternion_angles(q_pairs, q) / max_rotation_error_rad
    votes = (direction_errors <= 1) & (rotation_errors <= 1)
    # A pair among its own voters is in front of both and keeps the inliers from being colinear.
    supported = np.take_along_axis(votes, pairs, axis=1).all(axis=1)
    if not supported.any():
        return NoConsensus.DISAGREEMENT
    costs = np.minimum(direction_errors, 1) + np.minimum(rotation_errors, 1)
    best = np.lexsort((costs.sum(axis=1), -votes.sum(axis=1), ~supported))[0]

    near = distances[best] < max_direction_error_rad * ranges[best].mean()
    return AnchorConsensus(
        inliers=votes[best] | (near & (rotation_errors[best] <= 1)),
        center=midpoints[best],
        R=rotation_from_quaternion(q_pairs[best]),
        pair=(int(pairs[best, 0]), int(pairs[best, 1])),
    )


def _rays_cross(centers: Array, directions: Array, min_angle_rad: float) -> NDArray[np.bool_]:
    """Which pairs of rays (P, 2, 3), (P, 2, 3) are far from parallel and from different places."""
    sines = np.linalg.norm(np.cross(directions[:, 0], directions[:, 1]), axis=1)
    baselines = np.linalg.norm(centers[:, 1] - centers[:, 0], axis=1)
    rounding = 1e-12 * np.abs(centers).max()
    crossing: NDArray[np.bool_] = (sines >= math.sin(min_angle_rad)) & (baselines > rounding)
    return crossing


def _meet(centers: Array, directions: Array) -> tuple[Array, Array]:
    """Midpoints (P, 3) between pairs of lines, and where on both they are nearest, (P, 2).

    The latter are the lambdas for which c_1 + lambda_1 d_1 - c_2 - lambda_2 d_2 is orthogonal
    to d_1 and to d_2.
    """
    d1, d2 = directions[:, 0], directions[:, 1]
    baseline = centers[:, 1] - centers[:, 0]
    along1, along2 = np.sum(d1 * baseline, axis=1), np.sum(d2 * baseline, axis=1)
    cosine = np.sum(d1 * d2, axis=1)
    squared_sine = np.sum(np.cross(d1, d2) ** 2, axis=1)
    lambdas = np.stack([along1 - cosine * along2, cosine * along1 - along2], axis=1)
    lambdas /= squared_sine[:, None]
    midpoints: Array = (centers + lambdas[:, :, None] * directions).mean(axis=1)
    return midpoints, lambdas
