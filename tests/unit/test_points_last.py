import numpy as np

from tests.unit.scenes import generator, make_scene, numeric_jacobian
from trigpoint.geometry.points_last import inverse_cholesky, invert_symmetric, multiply, project
from trigpoint.geometry.pose_refinement import perturb
from trigpoint.rigid import rotate


def last(matrices: np.ndarray) -> np.ndarray:
    return np.moveaxis(matrices, 0, -1)


def test_products_are_those_of_each_points_matrices() -> None:
    rng = generator("multiply")
    A, B = rng.normal(size=(50, 2, 3)), rng.normal(size=(50, 3, 4))
    np.testing.assert_allclose(multiply(last(A), last(B)), last(A @ B), atol=1e-12)
    np.testing.assert_allclose(multiply(last(A[:1]), last(B)), last(A[0] @ B), atol=1e-12)


def test_cofactors_invert_as_lapack_does() -> None:
    A = generator("invert").normal(size=(50, 3, 3))
    H = A @ np.swapaxes(A, 1, 2) * np.logspace(-12, 12, 50)[:, None, None]
    product = np.moveaxis(invert_symmetric(last(H)), -1, 0) @ H
    np.testing.assert_allclose(product, np.tile(np.eye(3), (50, 1, 1)), atol=1e-6)


def test_whitening_leaves_the_unit_matrix() -> None:
    A = generator("whiten").normal(size=(50, 2, 2))
    S = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(2)
    W = inverse_cholesky(last(S))
    white = multiply(multiply(W, last(S)), np.swapaxes(W, 0, 1))
    np.testing.assert_allclose(white, last(np.tile(np.eye(2), (50, 1, 1))), atol=1e-9)


def test_points_project_onto_their_keypoints() -> None:
    scene = make_scene("reprojection")
    seen = project(scene.views_from_world[0], scene.points3d)
    assert seen.in_front.all()
    np.testing.assert_allclose(seen.xy.T, scene.points2d[0], atol=1e-12)
    view = np.arange(len(scene.points3d)) % len(scene.views_from_world)
    seen = project(scene.views_from_world, scene.points3d, view)
    np.testing.assert_allclose(seen.xy.T, scene.points2d[view, np.arange(len(view))], atol=1e-12)


def test_a_point_behind_its_camera_is_not_in_front() -> None:
    pose = make_scene("behind").views_from_world[0]
    behind = pose.inverse().apply(np.array([[0.1, 0.2, -3.0], [0.1, 0.2, 3.0]]))
    np.testing.assert_array_equal(project(pose, behind).in_front, [False, True])


def test_jacobians_equal_the_numeric_ones() -> None:
    scene = make_scene("reprojection jacobian", num_points=10)
    views = perturb(scene.views_from_world, np.array([0.05, -0.03, 0.04, 0.01, -0.02, 0.01]))
    view = np.arange(10) % len(views)
    seen = project(views, scene.points3d, view)

    def turned(delta: np.ndarray) -> np.ndarray:
        return project(perturb(views, delta), scene.points3d, view).xy

    expected = np.swapaxes(numeric_jacobian(turned, np.zeros(6)), 1, 2)
    np.testing.assert_allclose(seen.by_pose, expected, atol=1e-7)

    def moved(step: np.ndarray) -> np.ndarray:
        return project(views, scene.points3d + step, view).xy

    expected = np.swapaxes(numeric_jacobian(moved, np.zeros(3)), 1, 2)
    np.testing.assert_allclose(seen.by_point, expected, atol=1e-7)
    in_view = rotate(views.R[view], scene.points3d) + views.t[view]
    np.testing.assert_allclose(seen.depth, in_view[:, 2])
