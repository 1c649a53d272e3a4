from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.unit.synthetic_rays import (
    Scene,
    random_relative_poses,
    random_rotations,
    random_scene,
)
from trigpoint.geometry.rotation_averaging import average_rotations, average_rotations_govindu
from trigpoint.rigid import rotation_angle, rotation_from_vector

Array = NDArray[np.float64]
Average = Callable[[Scene], Array]

quick = settings(max_examples=30)
seeds = st.integers(0, 2**32 - 1)


def markley(scene: Scene) -> Array:
    return average_rotations(scene.query_from_anchors.R @ scene.anchors_from_world.R)


def govindu(scene: Scene) -> Array:
    return average_rotations_govindu(scene.anchors_from_world, scene.query_from_anchors)


both_averages = pytest.mark.parametrize("average", [markley, govindu])


@both_averages
@quick
@given(seed=seeds, num=st.integers(1, 20))
def test_exact_relative_rotations_give_the_exact_rotation(
    average: Average, seed: int, num: int
) -> None:
    scene = random_scene(np.random.default_rng(seed), num)
    np.testing.assert_allclose(average(scene), scene.query_from_world.R, atol=1e-12)


@both_averages
@quick
@given(seed=seeds)
def test_the_rotation_turns_with_the_world(average: Average, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 8, rotation_noise_rad=0.2)
    R = random_rotations(rng, 1)[0]
    moved = scene.in_other_world(1.0, R, np.zeros(3))
    np.testing.assert_allclose(average(moved), average(scene) @ R.T, atol=1e-12)


@both_averages
@quick
@given(seed=seeds)
def test_the_order_of_the_anchors_does_not_matter(average: Average, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 8, rotation_noise_rad=0.2)
    scene = scene.with_relative_poses(np.arange(3), random_relative_poses(rng, 3))
    shuffled = scene.subset(rng.permutation(8))
    np.testing.assert_allclose(average(shuffled), average(scene), atol=1e-12)


@quick
@given(seed=seeds)
def test_quaternions_of_both_signs_average_as_the_rotations_they_are(seed: int) -> None:
    # Near a half turn, rotations a little apart have canonical quaternions of opposite signs.
    rng = np.random.default_rng(seed)
    half_turn = rotation_from_vector(np.array([0, 0, np.pi]))
    R = rotation_from_vector(rng.normal(size=(20, 3)) * 0.05) @ half_turn
    assert rotation_angle(average_rotations(R) @ half_turn.T) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_govindus_equations_hold_for_quaternions_of_both_signs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 30, rotation_noise_rad=0.05)
    # Random poses: w >= 0 makes the signs of the estimates differ, and some would cancel.
    R_k = Rotation.from_matrix(scene.anchors_from_world.R)
    R_qk = Rotation.from_matrix(scene.query_from_anchors.R)
    canonical = [r.as_quat(canonical=True) for r in (R_qk, R_k)]
    estimates = (Rotation.from_quat(canonical[0]) * Rotation.from_quat(canonical[1])).as_quat()
    signs = np.sign(estimates @ estimates[0])
    assert set(signs) == {-1.0, 1.0}
    mean = Rotation.from_quat((signs[:, None] * estimates).sum(axis=0))
    np.testing.assert_allclose(govindu(scene), mean.as_matrix(), atol=1e-12)


@quick
@given(seeds)
def test_no_other_rotation_has_less_squared_chordal_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, weights = random_rotations(rng, 6), rng.uniform(0, 1, 6)
    mean = average_rotations(R, weights)

    def cost(rotation: Array) -> float:
        return float(weights @ np.sum((rotation - R) ** 2, axis=(1, 2)))

    for step in rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-2, 0.5, (20, 1)):
        assert cost(rotation_from_vector(step) @ mean) >= cost(mean) - 1e-12


@quick
@given(seeds)
def test_the_weighted_mean_is_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = rotation_from_vector(rng.normal(size=(7, 3)) * 0.4) @ random_rotations(rng, 1)
    weights = rng.uniform(0.1, 1, 7)
    expected = Rotation.from_matrix(R).mean(weights=weights).as_matrix()
    np.testing.assert_allclose(average_rotations(R, weights), expected, atol=1e-9)


def test_rotations_a_half_turn_apart_still_give_a_rotation() -> None:
    mean = average_rotations(np.stack([np.eye(3), np.diag([1.0, -1, -1])]))
    np.testing.assert_allclose(mean @ mean.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(mean) == pytest.approx(1.0)


def test_more_anchors_give_a_better_rotation() -> None:
    medians = []
    for num in (1, 4, 16, 64):
        scenes = [
            random_scene(np.random.default_rng(seed), num, rotation_noise_rad=0.05)
            for seed in range(30)
        ]
        errors = [rotation_angle(markley(s) @ s.query_from_world.R.T) for s in scenes]
        medians.append(np.median(errors))
    ratios = np.divide(medians[:-1], medians[1:])
    assert np.all(ratios > 1.4)  # 2 where errors are independent
