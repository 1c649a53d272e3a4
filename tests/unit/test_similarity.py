"""Frames of surveys brought together: what was moved by a known similarity comes back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trigpoint.geometry.similarity import (
    Similarity3,
    estimate_similarity,
    fit_similarity,
)
from trigpoint.rigid import Rigid3, rotation_angle, rotation_from_vector

SEEDS = st.integers(0, 2**32 - 1)


def make_similarity(rng: np.random.Generator) -> Similarity3:
    R = rotation_from_vector(rng.normal(0, 2, 3))
    return Similarity3(float(np.exp(rng.normal(0, 2))), R, rng.normal(0, 100, 3))


def make_cameras(rng: np.random.Generator, num: int) -> Rigid3:
    R = rotation_from_vector(rng.normal(0, 1, (num, 3)))
    return Rigid3.from_center(R, rng.normal(0, 5, (num, 3)))


def disturb(
    rng: np.random.Generator, poses: Rigid3, position_std: float, rotation_std_rad: float
) -> Rigid3:
    turns = rotation_from_vector(rng.normal(0, rotation_std_rad, (len(poses), 3)))
    centers = poses.center + rng.normal(0, position_std, (len(poses), 3))
    return Rigid3.from_center(turns @ poses.R, centers)


def require_equal(found: Similarity3 | None, truth: Similarity3, tolerance: float = 1e-9) -> None:
    assert found is not None
    assert abs(found.scale / truth.scale - 1) < tolerance
    assert rotation_angle(found.R @ truth.R.T) < tolerance
    extent = 100 + 10 * truth.scale
    np.testing.assert_allclose(found.t, truth.t, atol=tolerance * extent)


@settings(max_examples=50)
@given(seed=SEEDS)
def test_the_inverse_undoes_a_similarity_of_points_and_of_cameras(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b_from_a, cameras = make_similarity(rng), make_cameras(rng, 4)
    points = rng.normal(0, 5, (7, 3))
    back = b_from_a.inverse()
    np.testing.assert_allclose(back.apply(b_from_a.apply(points)), points, atol=1e-6)
    np.testing.assert_allclose(back.move(b_from_a.move(cameras)).t, cameras.t, atol=1e-6)


@settings(max_examples=50)
@given(seed=SEEDS)
def test_a_moved_camera_sees_moved_points_where_it_saw_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b_from_a, cameras = make_similarity(rng), make_cameras(rng, 3)
    points = rng.normal(0, 5, (3, 3))
    seen = b_from_a.move(cameras).apply(b_from_a.apply(points))
    np.testing.assert_allclose(seen, b_from_a.scale * cameras.apply(points), rtol=1e-6, atol=1e-6)


@settings(max_examples=100)
@given(seed=SEEDS, num=st.integers(2, 12))
def test_exact_poses_give_the_similarity_back(seed: int, num: int) -> None:
    rng = np.random.default_rng(seed)
    truth, cameras = make_similarity(rng), make_cameras(rng, num)
    std = truth.scale * rng.uniform(0.01, 1, num)
    found = fit_similarity(cameras, truth.move(cameras), position_std=std, rotation_std_rad=0.1)
    require_equal(found, truth)


@settings(max_examples=50)
@given(seed=SEEDS)
def test_cameras_on_a_line_are_enough_for_their_rotations_tell_the_turn_about_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, cameras = make_similarity(rng), make_cameras(rng, 6)
    line = np.linspace(-3, 3, 6)[:, None] * rng.normal(0, 1, 3)
    cameras = Rigid3.from_center(cameras.R, line)
    std = np.full(6, truth.scale)
    found = fit_similarity(cameras, truth.move(cameras), position_std=std, rotation_std_rad=0.01)
    require_equal(found, truth)


@settings(max_examples=30)
@given(seed=SEEDS)
def test_the_fit_is_the_least_sum_of_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, a = make_similarity(rng), make_cameras(rng, 8)
    b = disturb(rng, truth.move(a), 0.1 * truth.scale, 0.05)
    std = truth.scale * rng.uniform(0.05, 0.2, 8)
    found = fit_similarity(a, b, position_std=std, rotation_std_rad=0.05)
    assert found is not None

    def cost(scale: float, R: NDArray[np.float64], t: NDArray[np.float64]) -> float:
        moved = Similarity3(scale, R, t).move(a)
        squares = ((moved.center - b.center) ** 2).sum(axis=1) / std**2
        turned = ((moved.R - b.R) ** 2).sum(axis=(1, 2)) / (2 * 0.05**2)
        return float((squares + turned).sum())

    least = cost(found.scale, found.R, found.t)
    for _ in range(20):
        step = rng.normal(0, 1e-3, 7)
        R = rotation_from_vector(step[:3]) @ found.R
        other = cost(found.scale * (1 + step[3]), R, found.t + step[4:] * found.scale)
        assert other > least


@settings(max_examples=30)
@given(seed=SEEDS, num_wrong=st.integers(0, 12))
def test_wrong_poses_are_found_out_and_do_not_matter(seed: int, num_wrong: int) -> None:
    rng = np.random.default_rng(seed)
    truth, a = make_similarity(rng), make_cameras(rng, 30)
    b = disturb(rng, truth.move(a), 0.01 * truth.scale, 0.002)
    wrong = truth.move(make_cameras(rng, num_wrong))
    b = Rigid3(
        np.concatenate([wrong.R, b.R[num_wrong:]]), np.concatenate([wrong.t, b.t[num_wrong:]])
    )
    found = estimate_similarity(
        a, b, max_position_error=np.full(30, 0.1 * truth.scale), max_rotation_error_rad=0.02
    )
    assert found is not None
    assert found.inliers.tolist() == [False] * num_wrong + [True] * (30 - num_wrong)
    assert abs(found.b_from_a.scale / truth.scale - 1) < 0.005
    assert rotation_angle(found.b_from_a.R @ truth.R.T) < 0.004
    assert (found.position_errors[num_wrong:] < 0.06 * truth.scale).all()
    assert (found.rotation_errors_rad[num_wrong:] < 0.012).all()


@pytest.mark.parametrize("num", [0, 1])
def test_fewer_than_two_cameras_give_nothing(num: int) -> None:
    cameras = make_cameras(np.random.default_rng(0), num)
    ones = np.ones(num)
    assert fit_similarity(cameras, cameras, position_std=ones, rotation_std_rad=1.0) is None
    assert (
        estimate_similarity(cameras, cameras, max_position_error=ones, max_rotation_error_rad=1.0)
        is None
    )


def test_cameras_at_one_place_give_nothing() -> None:
    cameras = make_cameras(np.random.default_rng(0), 5)
    there = Rigid3.from_center(cameras.R, np.full((5, 3), 7.0))
    ones = np.ones(5)
    for a, b in ((there, cameras), (there, there)):
        assert fit_similarity(a, b, position_std=ones, rotation_std_rad=1.0) is None
        assert (
            estimate_similarity(a, b, max_position_error=ones, max_rotation_error_rad=1.0) is None
        )


def test_cameras_that_have_nothing_to_do_with_each_other_do_not_agree() -> None:
    rng = np.random.default_rng(3)
    found = estimate_similarity(
        make_cameras(rng, 20),
        make_cameras(rng, 20),
        max_position_error=np.full(20, 0.05),
        max_rotation_error_rad=0.02,
    )
    assert found is None or found.inliers.sum() <= 3
