"""One rotation of the query from the rotations relative to several anchors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, quaternion_from_rotation, rotation_from_quaternion

Array = NDArray[np.float64]


def average_rotations(R: Array, weights: Array | None = None) -> Array:
    """Return the rotation with the least sum of squared chordal distances (paper, eq. 8).

    argmin over R(q) of  sum_k w_k |R(q) - R_k|_F^2  is the eigenvector of  sum_k w_k q_k q_k^T
    for the largest eigenvalue (Markley et al., "Averaging Quaternions", 2007). q_k and -q_k, the
    same rotation, give the same term.

    Parameters
    ----------
    R : (K, 3, 3) float64
        Rotations, one at least: for the query R_qk R_k, each anchor's estimate.
    weights : (K,) float64, optional
        Not negative; 1 if absent.

    Returns
    -------
    (3, 3) float64
        The mean rotation. It is not unique where the two largest eigenvalues are equal, as for
        two rotations 180 degrees apart; then one of the minima is returned.
    """
    if weights is None:
        weights = np.ones(len(R))
    q = quaternion_from_rotation(R)
    eigenvectors = np.linalg.eigh((weights[:, None] * q).T @ q)[1]
    return rotation_from_quaternion(eigenvectors[:, -1])


def average_pairs(q: Array) -> Array:
    """Mean rotations, as quaternions (P, 4), of pairs (P, 2, 4).

    For two, the eigenvector of `average_rotations` is the normalised sum under equal signs.
    """
    sign = np.copysign(1.0, np.sum(q[:, 0] * q[:, 1], axis=1, keepdims=True))
    total = q[:, 0] + sign * q[:, 1]
    mean: Array = total / np.linalg.norm(total, axis=1, keepdims=True)
    return mean


def quaternion_angles(q1: Array, q2: Array) -> Array:
    """Angles (P, K) in radians between rotations given as unit quaternions (P, 4) and (K, 4)."""
    angles: Array = 2 * np.arccos(np.minimum(np.abs(q1 @ q2.T), 1))
    return angles


def average_rotations_govindu(anchors_from_world: Rigid3, query_from_anchors: Rigid3) -> Array:
    """Return the least squares solution of Q_kq q_q = q_k (paper, eq. 6; Govindu, 2001).

    Every Q_kq is orthogonal, so the stacked equations are solved by the mean of Q_kq^T q_k, which
    is then normalised. For comparison: it averages quaternions as vectors of R^4.

    Parameters
    ----------
    anchors_from_world : Rigid3 (K,)
        Poses of the anchors, one at least; only the rotations are used.
    query_from_anchors : Rigid3 (K,)
        Relative poses; only the rotations are used.

    Returns
    -------
    (3, 3) float64
        The rotation of query_from_world.

    Notes
    -----
    q_k and -q_k are the same rotation, but the equation holds for one of them only, and summing
    estimates of opposite signs cancels them. The signs are those that agree with the estimate
    to which all others are nearest, which depends neither on their order nor on their signs.
    """
    Q_kq = _left_multiplication(query_from_anchors.inverse().quaternion)
    estimates = np.einsum("kji,kj->ki", Q_kq, anchors_from_world.quaternion)
    likeness = estimates @ estimates.T
    medoid = np.argmax(np.abs(likeness).sum(axis=1))
    signs = np.copysign(1.0, likeness[medoid])
    return rotation_from_quaternion(signs @ estimates)


def _left_multiplication(q: Array) -> Array:
    """Matrices (..., 4, 4) of quaternions (..., 4): Q(q) p is the product q p (paper, eq. 7)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
