from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit.synthetic_rays import Scene, make_scene, random_scene
from trigpoint.geometry.center_averaging import average_centers, center_directions
from trigpoint.geometry.rotation_averaging import average_rotations
from trigpoint.geometry.translation_averaging import (
    average_translations,
    average_translations_govindu,
)
from trigpoint.rigid import Rigid3, rotate, skew

Array = NDArray[np.float64]
Average = Callable[[Rigid3, Rigid3], Array | None]

quick = settings(max_examples=30)
seeds = st.integers(0, 2**32 - 1)
both_averages = pytest.mark.parametrize(
    "average", [average_translations, average_translations_govindu]
)


def eq5_residuals(scene: Scene, T_q: Array) -> Array:
    """[T_kq]x (T_k - R_kq T_q) as the paper writes it, (K, 3)."""
    query_in_anchors = scene.query_from_anchors.inverse()  # R_kq, unit T_kq
    lambdas = scene.anchors_from_world.t - rotate(query_in_anchors.R, T_q)
    return rotate(skew(query_in_anchors.t), lambdas)


def center_error(scene: Scene) -> float:
    directions = center_directions(scene.anchors_from_world, scene.query_from_anchors)
    center = average_centers(scene.anchors_from_world.center, directions)
    assert center is not None
    return float(np.linalg.norm(center - scene.query_from_world.center))


def translation_error(scene: Scene, T_q: Array | None) -> float:
    """Distance of centers, c = -R_q^T T_q, with Markley's rotation."""
    assert T_q is not None
    R_q = average_rotations(scene.query_from_anchors.R @ scene.anchors_from_world.R)
    return float(np.linalg.norm(-R_q.T @ T_q - scene.query_from_world.center))


def median_errors(noise_deg: float, origin_distance: float, num_trials: int = 100) -> Array:
    """Of center averaging, translation averaging, and Govindu's, over scenes of 10 anchors."""
    errors = []
    for seed in range(num_trials):
        scene = random_scene(
            np.random.default_rng(seed),
            10,
            rotation_noise_rad=np.deg2rad(noise_deg),
            direction_noise_rad=np.deg2rad(noise_deg),
        ).in_other_world(1.0, np.eye(3), np.array([origin_distance, 0, 0]))
        poses = scene.anchors_from_world, scene.query_from_anchors
        errors.append(
            [
                center_error(scene),
                translation_error(scene, average_translations(*poses)),
                translation_error(scene, average_translations_govindu(*poses)),
            ]
        )
    return np.asarray(np.median(errors, axis=0))


@both_averages
@quick
@given(seed=seeds, num=st.integers(2, 20))
def test_exact_relative_poses_give_the_exact_translation(
    average: Average, seed: int, num: int
) -> None:
    scene = random_scene(np.random.default_rng(seed), num)
    T_q = average(scene.anchors_from_world, scene.query_from_anchors)
    assert T_q is not None
    np.testing.assert_allclose(T_q, scene.query_from_world.t, atol=1e-8)


@quick
@given(seeds)
def test_no_other_translation_has_less_error_in_equation_5(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 6, rotation_noise_rad=0.1, direction_noise_rad=0.1)
    T_q = average_translations(scene.anchors_from_world, scene.query_from_anchors)
    assert T_q is not None

    def cost(translation: Array) -> float:
        return float(np.sum(eq5_residuals(scene, translation) ** 2))

    for step in rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-3, 1, (20, 1)):
        assert cost(T_q + step) > cost(T_q)


@quick
@given(seeds)
def test_govindus_translation_settles_where_each_equation_is_divided_by_its_lambda(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 12, rotation_noise_rad=0.02, direction_noise_rad=0.02)
    T_q = average_translations_govindu(
        scene.anchors_from_world, scene.query_from_anchors, num_iterations=1000
    )
    assert T_q is not None
    R_kq = scene.query_from_anchors.inverse().R
    lambdas = np.linalg.norm(scene.anchors_from_world.t - rotate(R_kq, T_q), axis=1)

    def cost(translation: Array) -> float:
        return float(np.sum((eq5_residuals(scene, translation) / lambdas[:, None]) ** 2))

    for step in rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-3, 0, (20, 1)):
        assert cost(T_q + step) > cost(T_q)


@both_averages
def test_anchors_on_one_line_with_the_query_fix_no_translation(average: Average) -> None:
    along = np.array([[-2.0], [-1], [0.5], [3]])
    scene = make_scene(along * [0.6, 0, 0.8], np.zeros(3), np.random.default_rng(0))
    assert average(scene.anchors_from_world, scene.query_from_anchors) is None


@both_averages
@pytest.mark.parametrize("num", [0, 1])
def test_fewer_than_two_anchors_fix_no_translation(average: Average, num: int) -> None:
    scene = random_scene(np.random.default_rng(0), 2).subset(np.arange(num))
    assert average(scene.anchors_from_world, scene.query_from_anchors) is None


def test_an_anchor_nearly_at_the_query_leaves_govindus_translation_finite() -> None:
    rng = np.random.default_rng(0)
    centers = rng.uniform(-1, 1, (6, 3))
    scene = make_scene(centers, centers[0] + 1e-9, rng, direction_noise_rad=0.01)
    T_q = average_translations_govindu(scene.anchors_from_world, scene.query_from_anchors)
    assert translation_error(scene, T_q) < 0.1


# The paper's figure on simulated noise: 10 anchors in a box of side 2, and the world's origin 3
# outside of it, on which translation averaging depends. Both kinds of noise are in the anchor's
# frame, where the error of a rotation leaves the direction to the query as it is.


def test_center_averaging_beats_translation_averaging_the_more_the_noisier() -> None:
    errors = np.array([median_errors(noise, origin_distance=3.0) for noise in (0.5, 1, 2, 5, 10)])
    center, closed_form, govindu = errors.T
    assert np.all(np.diff(center) > 0)
    for translation in (closed_form, govindu):
        assert np.all(translation > 1.3 * center)
        assert np.all(np.diff(translation - center) > 0)


def test_a_farther_origin_harms_translation_averaging_alone() -> None:
    near, middle, far = (median_errors(2.0, distance, num_trials=50) for distance in (0, 3, 10))
    np.testing.assert_allclose([middle[0], far[0]], near[0], rtol=1e-9)
    for method in (1, 2):
        assert near[method] < middle[method] < far[method]
        assert far[method] > 3 * near[method]


def test_with_the_origin_amid_the_anchors_govindus_weights_win() -> None:
    # Rotations hardly matter there, and errors are angles, which the division by lambda respects.
    center, closed_form, govindu = median_errors(2.0, origin_distance=0.0)
    assert closed_form == pytest.approx(center, rel=0.15)
    assert govindu < center
