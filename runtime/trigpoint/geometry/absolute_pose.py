"""Robust pose of a camera from points known in the world: P3P in RANSAC.

PoseLib's LO-RANSAC, or OpenCV's RANSAC; both draw the same samples every time.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.geometry.backend import NORMALIZED_CAMERA, Backend, poselib
from trigpoint.rigid import Rigid3

Array = NDArray[np.float64]

MIN_POINTS = 5  # three determine the pose up to four solutions, one chooses, one tells


def estimate_absolute_pose(
    points3d: Array, points2d: Array, *, max_error: float, backend: Backend | None = None
) -> Rigid3 | None:
    """Estimate cam_from_world from matches with outliers.

    Parameters
    ----------
    points3d : (N, 3) float64
        In the world, best first.
    points2d : (N, 2) float64
        Normalised image points.
    max_error : float
        Inlier threshold on the reprojection error, in the units of the image points.
    backend : Backend, optional
        The best one installed by default.

    Returns
    -------
    Rigid3 or None
        None where fewer than `MIN_POINTS` points agree. Deterministic.
    """
    if len(points3d) < MIN_POINTS:
        return None
    if (backend or Backend.best()) is Backend.POSELIB:
        return _poselib(points3d, points2d, max_error)
    return _opencv(points3d, points2d, max_error)


def _poselib(points3d: Array, points2d: Array, max_error: float) -> Rigid3 | None:
    options = {
        "max_reproj_error": max_error,
        "min_iterations": 20,
        "max_iterations": 2000,
        "progressive_sampling": True,
        "seed": 0,
    }
    refinement = {"max_iterations": 5}  # a start for ours is enough
    pose, info = poselib.estimate_absolute_pose(
        points2d, points3d, NORMALIZED_CAMERA, options, refinement
    )
    if info["num_inliers"] < MIN_POINTS:
        return None
    return Rigid3(np.array(pose.R), np.array(pose.t))


def _opencv(points3d: Array, points2d: Array, max_error: float) -> Rigid3 | None:
    origin = points3d.mean(axis=0)  # far from it OpenCV loses digits
    found, rotation_vector, t, inliers = cv2.solvePnPRansac(
        points3d - origin,
        points2d,
        np.eye(3),
        np.zeros(4),
        iterationsCount=2000,
        reprojectionError=max_error,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None or len(inliers) < MIN_POINTS:
        return None
    R, _ = cv2.Rodrigues(rotation_vector)
    cam_from_origin = Rigid3(np.asarray(R, np.float64), np.asarray(t, np.float64).ravel())
    return Rigid3(cam_from_origin.R, cam_from_origin.apply(-origin))
