"""Robust relative pose of two calibrated views: five points in RANSAC, then refinement.

Two back ends: PoseLib's LO-RANSAC, and OpenCV's USAC followed by our own minimisation of the
Sampson error.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.backend import NORMALIZED_CAMERA, Backend, poselib
from trigpoint.geometry.epipolar import essential_matrix, homogeneous, sampson_error
from trigpoint.rigid import Rigid3, rotation_from_vector, skew

Array = NDArray[np.float64]

MIN_MATCHES = 6  # five determine the pose, one more tells whether it is right


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Pose of view b relative to view a; the translation has length 1, its scale is unknown."""

    b_from_a: Rigid3
    inliers: NDArray[np.bool_]


def estimate_relative_pose(
    points_a: Array, points_b: Array, *, max_error: float, backend: Backend | None = None
) -> RelativePose | None:
    """Estimate the relative pose from matches with outliers.

    Parameters
    ----------
    points_a, points_b : (N, 2) float64
        Matched points, best match first (PoseLib samples progressively, PROSAC).
    max_error : float
        Inlier threshold on the Sampson error, in the units of the points (px / focal length).
    backend : Backend, optional
        The best one installed by default.

    Returns
    -------
    RelativePose or None
        None where fewer than `MIN_MATCHES` matches agree. Deterministic.
    """
    if len(points_a) < MIN_MATCHES:
        return None
    if (backend or Backend.best()) is Backend.POSELIB:
        b_from_a = _poselib(points_a, points_b, max_error)
    else:
        b_from_a = _opencv(points_a, points_b, max_error)
    if b_from_a is None:
        return None
    inliers = np.abs(sampson_error(essential_matrix(b_from_a), points_a, points_b)) < max_error
    return RelativePose(b_from_a, inliers) if inliers.sum() >= MIN_MATCHES else None


def _poselib(points_a: Array, points_b: Array, max_error: float) -> Rigid3 | None:
    options = {
        "max_epipolar_error": max_error,
        "min_iterations": 30,
        "max_iterations": 1000,
        "progressive_sampling": True,
        "seed": 0,
    }
    pose, info = poselib.estimate_relative_pose(
        points_a, points_b, NORMALIZED_CAMERA, NORMALIZED_CAMERA, options, {}
    )
    length = np.linalg.norm(pose.t)
    if info["num_inliers"] < MIN_MATCHES or not length > 0:
        return None
    return Rigid3(np.array(pose.R), np.array(pose.t) / length)


def _opencv(points_a: Array, points_b: Array, max_error: float) -> Rigid3 | None:
    E, _ = cv2.findEssentialMat(points_a, points_b, np.eye(3), cv2.USAC_ACCURATE, 0.9999, max_error)
    if E is None or E.shape != (3, 3):
        return None
    kept = np.abs(sampson_error(np.asarray(E), points_a, points_b)) < max_error
    if kept.sum() < MIN_MATCHES:
        return None
    _, R, t, _ = cv2.recoverPose(E, points_a[kept], points_b[kept], np.eye(3))
    return refine_relative_pose(
        Rigid3(np.asarray(R), np.asarray(t, np.float64).ravel()),
        points_a,
        points_b,
        max_error=max_error,
    )


def sampson_jacobian(b_from_a: Rigid3, points_a: Array, points_b: Array) -> tuple[Array, Array]:
    """Sampson errors and their Jacobian by the five degrees of freedom of a relative pose.

    Parameters
    ----------
    b_from_a : Rigid3
        With a translation of length 1.
    points_a, points_b : (N, 2) float64
        Matched points.

    Returns
    -------
    errors : (N,) float64
    jacobian : (N, 5) float64
        By w (3) in R exp([w]x), and by u (2) in t + B u, B spanning the plane normal to t
        (`tangent_basis`).
    """
    a, b = homogeneous(points_a), homogeneous(points_b)
    E = essential_matrix(b_from_a)
    dE = np.concatenate([E @ skew(np.eye(3)), skew(tangent_basis(b_from_a.t).T) @ b_from_a.R])
    line_b, line_a = a @ E.T, b @ E
    algebraic = (b * line_b).sum(axis=1)
    norm = np.sqrt((line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1))
    norm = np.maximum(norm, np.finfo(float).tiny)
    dline_b = np.einsum("kij,nj->nki", dE, a)
    dline_a = np.einsum("kij,ni->nkj", dE, b)
    dalgebraic = np.einsum("nki,ni->nk", dline_b, b)
    dsquare = np.einsum("nki,ni->nk", dline_b[..., :2], line_b[:, :2])
    dsquare += np.einsum("nki,ni->nk", dline_a[..., :2], line_a[:, :2])
    jacobian = dalgebraic / norm[:, None] - (algebraic / norm**3)[:, None] * dsquare
    return algebraic / norm, jacobian


def tangent_basis(direction: Array) -> Array:
    """Two orthonormal columns (3, 2) normal to a direction (3,)."""
    return np.linalg.svd(direction[None])[2][1:].T


def refine_relative_pose(
    b_from_a: Rigid3,
    points_a: Array,
    points_b: Array,
    *,
    max_error: float,
    num_iterations: int = 20,
) -> Rigid3:
    """Minimise the Sampson error of the matches over rotation and direction of translation.

    Levenberg-Marquardt on the truncated (max_error) Cauchy cost of `sampson_jacobian`'s errors.
    Parameters are those of `estimate_relative_pose`; the start must be near the solution.
    """
    damping = 1e-3

    def cost(errors: Array) -> float:
        return float(np.log1p(np.minimum((errors / max_error) ** 2, 1) * 4).sum())

    errors, J = sampson_jacobian(b_from_a, points_a, points_b)
    for _ in range(num_iterations):
        weight = np.where(np.abs(errors) < max_error, 1 / (1 + 4 * (errors / max_error) ** 2), 0)
        H = np.einsum("n,ni,nj->ij", weight, J, J)
        H[np.diag_indices(5)] *= 1 + damping
        step = -np.linalg.lstsq(H, J.T @ (weight * errors), rcond=None)[0]
        t = b_from_a.t + tangent_basis(b_from_a.t) @ step[3:]
        candidate = Rigid3(b_from_a.R @ rotation_from_vector(step[:3]), t / np.linalg.norm(t))
        new_errors, new_J = sampson_jacobian(candidate, points_a, points_b)
        if cost(new_errors) < cost(errors):
            b_from_a, errors, J, damping = candidate, new_errors, new_J, damping / 10
        else:
            damping *= 10
        if np.linalg.norm(step) < 1e-10:
            break
    return b_from_a
