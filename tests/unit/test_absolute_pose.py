import numpy as np
import pytest

from tests.unit.scenes import generator, make_scene
from tests.unit.test_relative_pose import BACKENDS
from trigpoint.geometry.absolute_pose import estimate_absolute_pose
from trigpoint.geometry.backend import Backend
from trigpoint.rigid import rotation_angle


@pytest.mark.parametrize("backend", BACKENDS)
def test_pose_is_found_among_outliers(backend: Backend) -> None:
    scene = make_scene("absolute pose", num_points=200)
    rng = generator("absolute pose noise")
    points2d = scene.points2d[0] + rng.normal(0, 1e-3, (200, 2))
    points2d[:80] = rng.uniform(-0.4, 0.4, (80, 2))
    order = rng.permutation(200)
    pose = estimate_absolute_pose(
        scene.points3d[order], points2d[order], max_error=4e-3, backend=backend
    )
    truth = scene.views_from_world[0]
    assert pose is not None
    assert np.linalg.norm(pose.center - truth.center) < 0.03
    assert np.degrees(rotation_angle(pose.R @ truth.R.T)) < 0.4


@pytest.mark.parametrize("backend", BACKENDS)
def test_pose_is_the_same_every_time(backend: Backend) -> None:
    scene = make_scene("absolute repeat")
    points2d = scene.points2d[0] + generator("absolute repeat noise").normal(0, 1e-3, (100, 2))
    first, second = (
        estimate_absolute_pose(scene.points3d, points2d, max_error=3e-3, backend=backend)
        for _ in range(2)
    )
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.R, second.R)
    np.testing.assert_array_equal(first.t, second.t)


@pytest.mark.parametrize("backend", BACKENDS)
def test_too_few_points_give_no_pose(backend: Backend) -> None:
    scene = make_scene("absolute few", num_points=4)
    assert (
        estimate_absolute_pose(scene.points3d, scene.points2d[0], max_error=1e-3, backend=backend)
        is None
    )
