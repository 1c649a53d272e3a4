"""The similarity between two frames, from cameras whose poses are known in both.

A survey by structure from motion has a frame and a unit of its own. Each of its images that is
localized in a map ties the two together: x_b = s R x_a + t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.rotation_averaging import (
    average_pairs,
    average_rotations,
    quaternion_angles,
)
from trigpoint.rigid import Rigid3, quaternion_from_rotation, rotate, rotation_from_quaternion

Array = NDArray[np.float64]

MIN_CAMERAS = 2  # two centers give the scale, rotations the rest
NUM_STEPS = 20  # scale and rotation in turns; each all but fixes the other
MAX_ROUNDS = 10  # of inliers and fit; both are the same again after two or three


@dataclass(frozen=True, eq=False)
class Similarity3:
    """A change of frame and of unit: x_b = scale R x_a + t.

    Parameters
    ----------
    scale : float
        Units of b in one of a; positive.
    R : (3, 3) float64
    t : (3,) float64
        In units of b.
    """

    scale: float
    R: Array
    t: Array

    def apply(self, points: Array) -> Array:
        """Transform points (..., 3)."""
        moved: Array = self.scale * rotate(self.R, points) + self.t
        return moved

    def inverse(self) -> Similarity3:
        """Return `a_from_b`."""
        return Similarity3(1 / self.scale, self.R.T, -(self.R.T @ self.t) / self.scale)

    def move(self, cam_from_a: Rigid3) -> Rigid3:
        """Return cam_from_b of cameras (...): their centers move and their rotations turn."""
        return Rigid3.from_center(cam_from_a.R @ self.R.T, self.apply(cam_from_a.center))


@dataclass(frozen=True, eq=False)
class SimilarityConsensus:
    """The similarity that most cameras agree on.

    Parameters
    ----------
    b_from_a : Similarity3
        Fitted to the inliers.
    inliers : (K,) bool
    position_errors : (K,) float64
        Distances between the centers in b and those of a, moved there; in units of b.
    rotation_errors_rad : (K,) float64
    """

    b_from_a: Similarity3
    inliers: NDArray[np.bool_]
    position_errors: Array
    rotation_errors_rad: Array


def fit_similarity(
    cam_from_a: Rigid3, cam_from_b: Rigid3, *, position_std: Array, rotation_std_rad: float
) -> Similarity3 | None:
    """Fit a similarity to the poses of cameras in two frames, by weighted least squares.

    argmin over s, R, t of  sum_k |c_bk - (s R c_ak + t)|^2 / sigma_k^2
    + |R_bk - R R_ak|_F^2 / (2 sigma_R^2),  R_ak and R_bk being the rotations world_from_cam. The
    first sum is that of Umeyama ("Least-Squares Estimation of Transformation Parameters Between Two
    Point Patterns", PAMI 1991, eq. 1), whose centroids and SVD give t and, with a given s, also R:
    the second sum adds to his covariance matrix. It keeps R determined where the centers lie on a
    line. s and R are found in turns, from Markley's mean of the rotations on.

    Parameters
    ----------
    cam_from_a, cam_from_b : Rigid3 (K,)
        The same cameras in both frames.
    position_std : (K,) float64
        Standard deviations of c_bk, in units of b.
    rotation_std_rad : float
        Of the rotations between both.

    Returns
    -------
    Similarity3 or None
        None for fewer than two cameras, or where their centers coincide in one of the frames.
    """
    if len(cam_from_a) < MIN_CAMERAS:
        return None
    weights = 1 / position_std**2
    mean_a, mean_b = (weights @ pose.center / weights.sum() for pose in (cam_from_a, cam_from_b))
    a, b = cam_from_a.center - mean_a, cam_from_b.center - mean_b
    spread = weights @ (a**2).sum(axis=1)
    extent = np.abs(cam_from_a.center).max() + np.abs(a).max()
    if spread <= weights.sum() * (1e-12 * extent) ** 2:
        return None
    covariance = (weights * b.T) @ a
    turns = _turns(cam_from_a, cam_from_b)
    R, scale = average_rotations(turns), 0.0
    for _ in range(NUM_STEPS):
        scale = float((R * covariance).sum() / spread)
        if scale <= 0:
            return None
        R = _nearest_rotation(scale * covariance + turns.sum(axis=0) / (2 * rotation_std_rad**2))
    return Similarity3(scale, R, mean_b - scale * R @ mean_a)


def estimate_similarity(
    cam_from_a: Rigid3,
    cam_from_b: Rigid3,
    *,
    max_position_error: Array,
    max_rotation_error_rad: float,
) -> SimilarityConsensus | None:
    """Estimate a similarity from poses of cameras in two frames, many of them wrong.

    RANSAC (Fischler and Bolles, 1981) over all pairs of cameras, so that nothing is random: the
    mean of a pair's rotations R_bk R_ak^T, the ratio of its distances and its midpoints propose a
    similarity; the cameras within both thresholds are its inliers. The proposal with the most, at a
    tie with the least errors, is fitted to its inliers, these are found again, and so on.

    Parameters
    ----------
    cam_from_a, cam_from_b : Rigid3 (K,)
        The same cameras in both frames. All pairs against all cameras: K up to some hundreds.
    max_position_error : (K,) float64
        In units of b.
    max_rotation_error_rad : float

    Returns
    -------
    SimilarityConsensus or None
        None where no two cameras agree, or all that do stand at one place.
    """
    q = quaternion_from_rotation(_turns(cam_from_a, cam_from_b))
    errors = max_position_error, max_rotation_error_rad
    inliers = _find_best_pair(cam_from_a.center, cam_from_b.center, q, *errors)
    found = None
    for _ in range(MAX_ROUNDS):
        b_from_a = fit_similarity(
            cam_from_a[inliers],
            cam_from_b[inliers],
            position_std=max_position_error[inliers],
            rotation_std_rad=max_rotation_error_rad,
        )
        if b_from_a is None:
            return None
        distances = np.linalg.norm(b_from_a.apply(cam_from_a.center) - cam_from_b.center, axis=1)
        angles = quaternion_angles(quaternion_from_rotation(b_from_a.R)[None], q)[0]
        before = inliers
        inliers = (distances <= max_position_error) & (angles <= max_rotation_error_rad)
        found = SimilarityConsensus(b_from_a, inliers, distances, angles)
        if (inliers == before).all():
            break
    return found if found is not None and inliers.sum() >= MIN_CAMERAS else None


def _find_best_pair(
    a: Array, b: Array, q: Array, max_position_error: Array, max_rotation_error_rad: float
) -> NDArray[np.bool_]:
    """Return which cameras agree with the pair that most agree with; none where all coincide."""
    pairs = np.stack(np.triu_indices(len(a), k=1), axis=1)
    lengths = [np.linalg.norm(c[pairs[:, 1]] - c[pairs[:, 0]], axis=1) for c in (a, b)]
    rounding = [1e-12 * np.abs(c).max(initial=0.0) for c in (a, b)]
    apart = (lengths[0] > rounding[0]) & (lengths[1] > rounding[1])
    pairs = pairs[apart]
    if len(pairs) == 0:
        return np.zeros(len(a), bool)
    q_pairs = average_pairs(q[pairs])
    R, scale = rotation_from_quaternion(q_pairs), lengths[1][apart] / lengths[0][apart]
    from_middle = a - a[pairs].mean(axis=1)[:, None]
    moved = scale[:, None, None] * np.einsum("pij,pkj->pki", R, from_middle)
    distances = np.linalg.norm(b - b[pairs].mean(axis=1)[:, None] - moved, axis=2)
    shares = distances / max_position_error, quaternion_angles(q_pairs, q) / max_rotation_error_rad
    agree = (shares[0] <= 1) & (shares[1] <= 1)
    costs = np.minimum(shares[0], 1) + np.minimum(shares[1], 1)
    best: NDArray[np.bool_] = agree[np.lexsort((costs.sum(axis=1), -agree.sum(axis=1)))[0]]
    return best


def _turns(cam_from_a: Rigid3, cam_from_b: Rigid3) -> Array:
    """Return each camera's estimate (K, 3, 3) of the rotation b_from_a."""
    turns: Array = np.swapaxes(cam_from_b.R, -1, -2) @ cam_from_a.R
    return turns


def _nearest_rotation(M: Array) -> Array:
    """Return the rotation R with the largest trace of R^T M (Umeyama, eq. 43)."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R: Array = U @ np.diag([1.0, 1.0, sign]) @ Vt
    return R
