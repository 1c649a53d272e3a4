import numpy as np

from tests.unit.scenes import generator, make_scene
from trigpoint.geometry.pose_refinement import perturb, refine_pose
from trigpoint.rigid import Rigid3, rotation_angle, rotation_from_vector

SIGMA = 1e-3


def off(pose: Rigid3) -> Rigid3:
    return perturb(pose, np.array([0.05, -0.03, 0.04, 0.01, -0.02, 0.01]))


def errors(estimate: Rigid3, truth: Rigid3) -> np.ndarray:
    """The error (dc, dtheta) as the covariance describes it."""
    dR = truth.R.T @ estimate.R  # exp(dtheta) world_from_cam estimate = truth
    dtheta = np.array([dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]]) / 2
    return np.concatenate([truth.center - estimate.center, dtheta])


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
        sigma=SIGMA, max_error=0.1,
    )  # fmt: skip
    assert refined is not None
    assert np.linalg.norm(refined.center - truth.center) < 1e-7
    assert rotation_angle(refined.R @ truth.R.T) < 1e-7


def test_outliers_do_not_move_the_pose() -> None:
    scene = make_scene("refine outliers")
    rng = generator("refine outliers noise")
    truth = scene.views_from_world[0]
    points2d = scene.points2d[0] + rng.normal(0, SIGMA, (100, 2))
    points2d[:30] += rng.uniform(0.05, 0.3, (30, 2))
    refined = refine_pose(
        off(truth), scene.points3d, points2d,
        sigma=SIGMA, max_error=0.02,
    )  # fmt: skip
    assert refined is not None
    assert np.linalg.norm(refined.center - truth.center) < 0.01


def test_points_that_determine_no_pose_give_none() -> None:
    scene = make_scene("refine degenerate")
    truth = scene.views_from_world[0]
    line = np.linspace([-1, 0, 0], [1, 0, 0], 100)  # colinear: free to turn about the line
    in_cam = truth.apply(line)
    assert (
        refine_pose(
            truth, line, in_cam[:, :2] / in_cam[:, 2:],
            sigma=SIGMA, max_error=0.1,
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
            sigma=SIGMA, max_error=0.1,
        )
        is None
    )  # fmt: skip
