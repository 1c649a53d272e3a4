import numpy as np
import pytest

from tests.unit.scenes import generator, make_scene, numeric_jacobian
from trigpoint.geometry.backend import Backend
from trigpoint.geometry.epipolar import essential_matrix, sampson_error
from trigpoint.geometry.relative_pose import (
    estimate_relative_pose,
    refine_relative_pose,
    sampson_jacobian,
    tangent_basis,
)
from trigpoint.rigid import Rigid3, rotation_angle, rotation_from_vector

BACKENDS = [
    pytest.param(
        Backend.POSELIB,
        marks=pytest.mark.skipif(Backend.best() is Backend.OPENCV, reason="PoseLib has no wheel"),
    ),
    Backend.OPENCV,
]
FOCAL_PX = 500.0


def relative_pose(views_from_world: Rigid3) -> Rigid3:
    b_from_a = views_from_world[1] @ views_from_world[0].inverse()
    return Rigid3(b_from_a.R, b_from_a.t / np.linalg.norm(b_from_a.t))


def errors_deg(estimate: Rigid3, truth: Rigid3) -> tuple[float, float]:
    direction = np.degrees(np.arccos(np.clip(estimate.t @ truth.t, -1, 1)))
    return float(np.degrees(rotation_angle(estimate.R @ truth.R.T))), float(direction)


def test_sampson_error_vanishes_at_the_truth() -> None:
    scene = make_scene("sampson")
    E = essential_matrix(relative_pose(scene.views_from_world))
    assert np.abs(sampson_error(E, *scene.points2d[:2])).max() < 1e-14


def test_sampson_error_is_the_distance_to_the_nearest_true_match_to_first_order() -> None:
    """Moving a match along the gradient by its error puts it on the epipolar geometry."""
    scene = make_scene("sampson distance")
    rng = generator("sampson distance noise")
    E = essential_matrix(relative_pose(scene.views_from_world))
    a, b = scene.points2d[:2] + rng.normal(0, 1e-3, scene.points2d[:2].shape)
    errors = sampson_error(E, a, b)
    algebraic = np.einsum("ni,ij,nj->n", np.c_[b, np.ones(len(b))], E, np.c_[a, np.ones(len(a))])
    gradient = np.c_[
        (np.c_[b, np.ones(len(b))] @ E)[:, :2], (np.c_[a, np.ones(len(a))] @ E.T)[:, :2]
    ]
    moved = np.c_[a, b] - (algebraic / (gradient**2).sum(1))[:, None] * gradient
    after = sampson_error(E, moved[:, :2], moved[:, 2:])
    assert np.abs(after).max() < 1e-2 * np.abs(errors).max()
    np.testing.assert_allclose(
        np.linalg.norm(moved - np.c_[a, b], axis=1), np.abs(errors), rtol=1e-9
    )


def test_sampson_jacobian_equals_the_numeric_one() -> None:
    scene = make_scene("sampson jacobian", num_points=20)
    pose = relative_pose(scene.views_from_world)
    a, b = scene.points2d[:2] + generator("jacobian noise").normal(0, 0.01, (2, 20, 2))

    def errors(step: np.ndarray) -> np.ndarray:
        t = pose.t + tangent_basis(pose.t) @ step[3:]
        moved = Rigid3(pose.R @ rotation_from_vector(step[:3]), t)
        return sampson_error(essential_matrix(moved), a, b)

    value, jacobian = sampson_jacobian(pose, a, b)
    np.testing.assert_allclose(value, errors(np.zeros(5)), atol=1e-15)
    np.testing.assert_allclose(jacobian, numeric_jacobian(errors, np.zeros(5)), atol=1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
def test_relative_pose_is_found_among_outliers(backend: Backend) -> None:
    """Half a pixel of noise, 40 % wrong matches: both back ends, the same data."""
    rng = generator("relative pose")
    angles = []
    for i in range(10):
        scene = make_scene(f"relative pose {i}", num_points=300)
        a, b = scene.points2d[:2] + rng.normal(0, 0.5 / FOCAL_PX, (2, 300, 2))
        wrong = np.arange(300) >= 180
        b[wrong] = rng.uniform(-0.4, 0.4, (wrong.sum(), 2))
        found = estimate_relative_pose(a, b, max_error=1.5 / FOCAL_PX, backend=backend)
        assert found is not None
        truth = relative_pose(scene.views_from_world)
        angles.append(errors_deg(found.b_from_a, truth))
        assert found.inliers[~wrong].mean() > 0.95
        assert found.inliers[wrong].mean() < 0.15
        assert abs(np.linalg.norm(found.b_from_a.t) - 1) < 1e-9
    rotation, translation = np.median(angles, axis=0)
    assert rotation < 0.25
    assert translation < 1.0


@pytest.mark.parametrize("backend", BACKENDS)
def test_relative_pose_is_the_same_every_time(backend: Backend) -> None:
    scene = make_scene("repeat", num_points=100)
    a, b = scene.points2d[:2] + generator("repeat noise").normal(0, 1e-3, (2, 100, 2))
    first, second = (
        estimate_relative_pose(a, b, max_error=3e-3, backend=backend) for _ in range(2)
    )
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.b_from_a.R, second.b_from_a.R)
    np.testing.assert_array_equal(first.b_from_a.t, second.b_from_a.t)


@pytest.mark.parametrize("backend", BACKENDS)
def test_unrelated_points_give_no_relative_pose_or_few_inliers(backend: Backend) -> None:
    rng = generator("unrelated")
    a, b = rng.uniform(-0.5, 0.5, (2, 40, 2))
    found = estimate_relative_pose(a, b, max_error=1e-3, backend=backend)
    assert found is None or found.inliers.sum() < 20


@pytest.mark.parametrize("backend", BACKENDS)
def test_too_few_matches_give_no_relative_pose(backend: Backend) -> None:
    scene = make_scene("few", num_points=5)
    assert estimate_relative_pose(*scene.points2d[:2], max_error=1e-3, backend=backend) is None


def test_refinement_returns_to_the_truth_from_nearby() -> None:
    scene = make_scene("refinement", num_points=60)
    truth = relative_pose(scene.views_from_world)
    t = truth.t + tangent_basis(truth.t) @ np.array([0.01, -0.02])
    start = Rigid3(
        truth.R @ rotation_from_vector(np.array([0.005, -0.004, 0.003])), t / np.linalg.norm(t)
    )
    refined = refine_relative_pose(start, *scene.points2d[:2], max_error=0.05)
    assert max(errors_deg(refined, truth)) < 1e-5


def test_refinement_ignores_outliers() -> None:
    scene = make_scene("refinement outliers", num_points=100)
    truth = relative_pose(scene.views_from_world)
    a, b = scene.points2d[:2].copy()
    b[:20] += 0.2
    refined = refine_relative_pose(truth, a, b, max_error=0.005)
    assert max(errors_deg(refined, truth)) < 0.05
