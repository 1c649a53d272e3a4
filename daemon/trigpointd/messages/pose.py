"""The pose of the body that carries the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3, rotate, skew


def body_pose(
    cam_from_world: Rigid3, covariance: NDArray[np.float64], body_from_camera: Rigid3
) -> tuple[Rigid3, NDArray[np.float64]]:
    """Carry a camera's pose and its covariance over to the body it is mounted on.

    With the lever arm l = R_world_from_cam t_cam_from_body, the body's origin in the camera's
    frame turned into the world's axes, and the error (dc, dtheta) of `Localized.covariance`, the
    body's origin errs to first order by dc + dtheta x l and its rotation by the same dtheta.

    Parameters
    ----------
    cam_from_world : Rigid3
        The camera's pose.
    covariance : (6, 6) float64
        Of (dc, dtheta), in the world's axes, as in `Localized`.
    body_from_camera : Rigid3
        How the camera is mounted.

    Returns
    -------
    world_from_body : Rigid3
        The body's pose.
    covariance : (6, 6) float64
        Of the body's error, in the same order and axes.
    """
    world_from_cam = cam_from_world.inverse()
    cam_from_body = body_from_camera.inverse()
    J = np.eye(6)
    J[:3, 3:] = -skew(rotate(world_from_cam.R, cam_from_body.t))
    return world_from_cam @ cam_from_body, J @ covariance @ J.T
