"""The body's covariance is what a sample of camera poses gives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trigpoint.rigid import Rigid3
from trigpointd.messages.pose import body_pose

CAM_FROM_WORLD = Rigid3(Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix(), np.array([3.0, -2, 5]))
# Far off and turned: the lever arm and the extrinsic rotation both matter.
BODY_FROM_CAMERA = Rigid3(
    Rotation.from_rotvec([-0.9, 0.5, 1.6]).as_matrix(), np.array([1.5, -0.7, 2.0])
)


def random_covariance(rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a dense covariance with errors of about 2 cm and 1 degree."""
    A = rng.normal(size=(6, 6)) * np.repeat([0.01, 0.008], 3)[:, None]
    covariance: NDArray[np.float64] = A @ A.T
    return covariance


def test_the_body_pose_composes_the_mounting() -> None:
    world_from_body, _ = body_pose(CAM_FROM_WORLD, np.eye(6), BODY_FROM_CAMERA)
    point_body = np.array([0.3, -0.2, 0.9])
    in_cam = BODY_FROM_CAMERA.inverse().apply(point_body)
    assert np.allclose(CAM_FROM_WORLD.apply(world_from_body.apply(point_body)), in_cam)


def test_a_body_in_the_camera_has_the_cameras_covariance() -> None:
    rng = np.random.default_rng(1)
    covariance = random_covariance(rng)
    turned = Rigid3(BODY_FROM_CAMERA.R, np.zeros(3))
    assert np.allclose(body_pose(CAM_FROM_WORLD, covariance, turned)[1], covariance)


def test_the_body_covariance_is_that_of_a_sample() -> None:
    rng = np.random.default_rng(2)
    covariance = random_covariance(rng)
    world_from_body, predicted = body_pose(CAM_FROM_WORLD, covariance, BODY_FROM_CAMERA)

    count = 200_000
    errors = rng.multivariate_normal(np.zeros(6), covariance, count)
    turn = Rotation.from_rotvec(errors[:, 3:]).as_matrix()
    world_from_cam = Rigid3(turn @ CAM_FROM_WORLD.R.T, CAM_FROM_WORLD.center + errors[:, :3])
    sample = world_from_cam @ BODY_FROM_CAMERA.inverse()
    position_error = sample.t - world_from_body.t
    rotation_error = Rotation.from_matrix(sample.R @ world_from_body.R.T).as_rotvec()
    empirical = np.cov(np.hstack([position_error, rotation_error]), rowvar=False)

    # Standard error of a covariance's entries: sqrt((C_ii C_jj + C_ij^2) / N).
    variances = np.diag(predicted)
    standard_error = np.sqrt((np.outer(variances, variances) + predicted**2) / count)
    second_order = 0.002 * np.sqrt(np.outer(variances, variances))
    assert np.all(np.abs(empirical - predicted) < 5 * standard_error + second_order)
    # The lever arm is what makes the difference.
    assert not np.allclose(predicted[:3, :3], covariance[:3, :3], rtol=0.5)
