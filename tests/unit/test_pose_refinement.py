import numpy as np

from tests.unit.scenes import generator, make_scene, numeric_jacobian
from trigpoint.geometry.pose_refinement import perturb, refine_pose, reprojection
from trigpoint.rigid import Rigid3, rotation_angle, rotation_from_vector

SIGMA = 1e-3


def certain(num_points: int) -> np.ndarray:
    return np.zeros((num_points, 3, 3))


def off(pose: Rigid3) -> Rigid3:
    return perturb(pose, np.array([0.05, -0.03, 0.04, 0.01, -0.02, 0.01]))


def errors(estimate: Rigid3, truth: Rigid3) -> np.ndarray:
    """The error (dc, dtheta) as the covariance describes it."""
    dR = truth.R.T @ estimate.R  # exp(dtheta) world_from_cam estimate = truth
    dtheta = np.array([dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]]) / 2
    return np.concatenate([truth.center - estimate.center, dtheta])


def test_residuals_vanish_at_the_truth() -> None:
    scene = make_scene("reprojection")
    residuals, _, _, in_front = reprojection(
        scene.views_from_world[0], scene.points3d, scene.points2d[0]
    )
    assert in_front.all()
    assert np.abs(residuals).max() < 1e-12


def test_jacobians_equal_the_numeric_ones() -> None:
    scene = make_scene("reprojection jacobian", num_points=10)
    pose = off(scene.views_from_world[0])
    _, by_pose, by_point, _ = reprojection(pose, scene.points3d, scene.points2d[0])

    def residuals(delta: np.ndarray) -> np.ndarray:
        return reprojection(perturb(pose, delta), scene.points3d, scene.points2d[0])[0]

    np.testing.assert_allclose(by_pose, numeric_jacobian(residuals, np.zeros(6)), atol=1e-7)

    def moved(step: np.ndarray) -> np.ndarray:
        return reprojection(pose, scene.points3d + step, scene.points2d[0])[0]

    np.testing.assert_allclose(by_point, numeric_jacobian(moved, np.zeros(3)), atol=1e-7)


def test_an_error_moves_the_center_and_turns_the_camera_in_the_world() -> None:
    pose = make_scene("perturb").views_from_world[0]
    delta = np.array([0.1, -0.2, 0.3, 0.02, -0.01, 0.03])
    moved = perturb(pose, delta)
    np.testing.assert_allclose(moved.center, pose.center + delta[:3], atol=1e-12)
    np.testing.assert_allclose(
        moved.inverse().R, rotation_from_vector(delta[3:]) @ pose.inverse().R, atol=1e-12
    )


def test_exact_points_give_the_exact_pose() -> None:
    scene = make_scene("refine exact")
    truth = scene.views_from_world[0]
    refined = refine_pose(
        off(truth), scene.points3d, scene.points2d[0],
        point_covariance=certain(100), sigma=SIGMA, max_error=0.1,
    )  # fmt: skip
    assert refined is not None
    assert np.linalg.norm(refined.cam_from_world.center - truth.center) < 1e-7
    assert rotation_angle(refined.cam_from_world.R @ truth.R.T) < 1e-7


def test_outliers_do_not_move_the_pose() -> None:
    scene = make_scene("refine outliers")
    rng = generator("refine outliers noise")
    truth = scene.views_from_world[0]
    points2d = scene.points2d[0] + rng.normal(0, SIGMA, (100, 2))
    points2d[:30] += rng.uniform(0.05, 0.3, (30, 2))
    refined = refine_pose(
        off(truth), scene.points3d, points2d,
        point_covariance=certain(100), sigma=SIGMA, max_error=0.02,
    )  # fmt: skip
    assert refined is not None
    assert not refined.inliers[:30].any()
    assert refined.inliers[30:].all()
    assert np.linalg.norm(refined.cam_from_world.center - truth.center) < 0.01


def test_covariance_predicts_the_scatter_of_the_pose() -> None:
    """Noise in the query's points and in the latent points, as told by their covariance."""
    scene = make_scene("refine scatter")
    rng = generator("refine scatter noise")
    truth = scene.views_from_world[0]
    A = rng.normal(0, 1.0, (100, 3, 3))
    point_covariance = A @ np.swapaxes(A, 1, 2)
    normalized = []
    for _ in range(300):
        points3d = scene.points3d + SIGMA * (A @ rng.normal(size=(100, 3, 1)))[:, :, 0]
        points2d = scene.points2d[0] + rng.normal(0, SIGMA, (100, 2))
        refined = refine_pose(
            truth, points3d, points2d,
            point_covariance=point_covariance, sigma=SIGMA, max_error=0.1,
        )  # fmt: skip
        assert refined is not None
        error = errors(refined.cam_from_world, truth)
        normalized.append(error @ np.linalg.solve(refined.covariance, error))
    assert 5.0 < np.mean(normalized) < 7.2  # six degrees of freedom


def test_an_uncertain_point_counts_for_less() -> None:
    scene = make_scene("refine weights")
    truth = scene.views_from_world[0]
    points3d = scene.points3d.copy()
    points3d[:50] += np.array([0.05, 0.0, 0.0])
    doubtful = certain(100)
    doubtful[:50] = np.eye(3) * (0.05 / SIGMA) ** 2

    def position_error(point_covariance: np.ndarray) -> float:
        refined = refine_pose(
            truth, points3d, scene.points2d[0],
            point_covariance=point_covariance, sigma=SIGMA, max_error=0.1,
        )  # fmt: skip
        assert refined is not None
        return float(np.linalg.norm(refined.cam_from_world.center - truth.center))

    assert position_error(doubtful) < 0.2 * position_error(certain(100))


def test_points_that_determine_no_pose_give_none() -> None:
    scene = make_scene("refine degenerate")
    truth = scene.views_from_world[0]
    line = np.linspace([-1, 0, 0], [1, 0, 0], 100)  # colinear: free to turn about the line
    in_cam = truth.apply(line)
    assert (
        refine_pose(
            truth, line, in_cam[:, :2] / in_cam[:, 2:],
            point_covariance=certain(100), sigma=SIGMA, max_error=0.1,
        )
        is None
    )  # fmt: skip


def test_points_behind_the_camera_give_none() -> None:
    scene = make_scene("refine behind")
    truth = scene.views_from_world[0]
    behind = truth.inverse().apply(-truth.apply(scene.points3d))
    assert (
        refine_pose(
            truth, behind, scene.points2d[0],
            point_covariance=certain(100), sigma=SIGMA, max_error=0.1,
        )
        is None
    )  # fmt: skip
