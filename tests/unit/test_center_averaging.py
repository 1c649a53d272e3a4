from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit.synthetic_rays import make_scene, random_directions, random_rotations, random_scene
from trigpoint.geometry.center_averaging import (
    average_centers,
    average_centers_robust,
    center_directions,
    line_distances,
)
from trigpoint.rigid import Rigid3, rotate

Array = NDArray[np.float64]
Average = Callable[[Array, Array], Array | None]

quick = settings(max_examples=30)
seeds = st.integers(0, 2**32 - 1)
both_averages = pytest.mark.parametrize("average", [average_centers, average_centers_robust])


def noisy_lines(rng: np.random.Generator, num: int, noise: float = 0.02) -> tuple[Array, Array]:
    scene = random_scene(rng, num, direction_noise_rad=noise)
    directions = center_directions(scene.anchors_from_world, scene.query_from_anchors)
    return scene.anchors_from_world.center, directions


def found(center: Array | None) -> Array:
    assert center is not None
    return center


@quick
@given(seeds)
def test_directions_point_from_the_anchors_to_the_query(seed: int) -> None:
    scene = random_scene(np.random.default_rng(seed), 5)
    towards = scene.query_from_world.center - scene.anchors_from_world.center
    directions = center_directions(scene.anchors_from_world, scene.query_from_anchors)
    np.testing.assert_allclose(
        directions, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-12
    )


def test_directions_do_not_depend_on_the_length_of_relative_translations() -> None:
    scene = random_scene(np.random.default_rng(0), 5)
    unit = scene.query_from_anchors
    longer = Rigid3(unit.R, unit.t * np.array([[0.1], [1], [2], [30], [400]]))
    np.testing.assert_allclose(
        center_directions(scene.anchors_from_world, longer),
        center_directions(scene.anchors_from_world, unit),
        atol=1e-14,
    )


def test_errors_of_relative_rotations_do_not_move_the_center() -> None:
    exact = random_scene(np.random.default_rng(0), 5)
    turned = random_scene(np.random.default_rng(0), 5, rotation_noise_rad=0.3)
    assert np.abs(turned.query_from_anchors.R - exact.query_from_anchors.R).max() > 0.1
    np.testing.assert_allclose(
        center_directions(turned.anchors_from_world, turned.query_from_anchors),
        center_directions(exact.anchors_from_world, exact.query_from_anchors),
        atol=1e-14,
    )


@both_averages
@quick
@given(seed=seeds, num=st.integers(2, 20))
def test_exact_lines_give_the_exact_center(average: Average, seed: int, num: int) -> None:
    rng = np.random.default_rng(seed)
    query, directions = rng.normal(size=3), random_directions(rng, num)
    centers = query - directions * rng.uniform(0.1, 10, (num, 1))
    np.testing.assert_allclose(found(average(centers, directions)), query, atol=1e-9)


@both_averages
@quick
@given(seed=seeds, scale=st.floats(1e-3, 1e3))
def test_the_center_moves_with_the_world(average: Average, seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    centers, directions = noisy_lines(rng, 8)
    R, t = random_rotations(rng, 1)[0], scale * rng.normal(size=3)
    moved = found(average(scale * rotate(R, centers) + t, rotate(R, directions)))
    expected = scale * rotate(R, found(average(centers, directions))) + t
    np.testing.assert_allclose(moved, expected, atol=1e-6 * scale)


@both_averages
@quick
@given(seed=seeds)
def test_neither_order_nor_sign_of_the_lines_matters(average: Average, seed: int) -> None:
    rng = np.random.default_rng(seed)
    centers, directions = noisy_lines(rng, 8)
    order, signs = rng.permutation(8), rng.choice([-1.0, 1.0], (8, 1))
    shuffled = found(average(centers[order], (signs * directions)[order]))
    np.testing.assert_allclose(shuffled, found(average(centers, directions)), atol=1e-6)


@both_averages
def test_a_far_origin_costs_no_precision_even_where_lines_cross_at_one_degree(
    average: Average,
) -> None:
    rng = np.random.default_rng(0)
    directions = np.array([0.6, 0, 0.8]) + 0.02 * rng.normal(size=(8, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    query = np.array([5e6, -4e5, 100.0])
    centers = query - directions * rng.uniform(1, 3, (8, 1))
    np.testing.assert_allclose(found(average(centers, directions)), query, rtol=0, atol=1e-6)


@quick
@given(seeds)
def test_no_other_point_has_less_squared_distance_to_the_lines(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centers, directions = noisy_lines(rng, 6, noise=0.3)
    weights = rng.uniform(0, 1, 6)
    center = found(average_centers(centers, directions, weights))

    def cost(point: Array) -> float:
        return float(weights @ line_distances(point, centers, directions) ** 2)

    for step in rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-3, 1, (20, 1)):
        assert cost(center + step) > cost(center)
    h = 1e-5
    gradient = [(cost(center + h * e) - cost(center - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(gradient, 0, atol=1e-8)


def test_hardly_ever_a_point_nearby_has_notably_smaller_angles_to_the_lines() -> None:
    def finds_less(seed: int) -> bool:
        rng = np.random.default_rng(seed)
        centers, directions = noisy_lines(rng, 8, noise=0.1)
        center = found(average_centers_robust(centers, directions))

        def cost(point: Array) -> float:
            ranges = np.linalg.norm(point - centers, axis=1)
            return float((line_distances(point, centers, directions) / ranges).sum())

        steps = rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-3, -1.5, (20, 1))
        limit = cost(center) - 8 * 2e-3  # K eps, the rounding of the cost
        return any(cost(center + step) < limit for step in steps)

    assert sum(finds_less(seed) for seed in range(500)) <= 5  # 8 of 3,000


def test_more_anchors_do_not_harm_the_robust_center() -> None:
    """Far ones add little, but they take nothing away; by squared distances they do."""
    errors: dict[int, list[Array]] = {}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        # Anchors along a road: the more are taken, the farther away they are.
        along = np.linspace(0.2, 40, 100)[:, None] * rng.choice([-1, 1], (100, 1))
        centers = np.hstack([along, rng.normal(0, 1, (100, 2))])
        scene = make_scene(centers, np.array([0.0, 0.5, 0.5]), rng, direction_noise_rad=0.01)
        directions = center_directions(scene.anchors_from_world, scene.query_from_anchors)
        for num in (5, 20, 100):
            estimates = (
                found(average(centers[:num], directions[:num]))
                for average in (average_centers_robust, average_centers)
            )
            truth = scene.query_from_world.center
            errors.setdefault(num, []).append(
                np.array([np.linalg.norm(estimate - truth) for estimate in estimates])
            )
    (robust5, _), (robust20, squares20), (robust100, squares100) = (
        np.median(found, axis=0) for found in errors.values()
    )
    assert robust20 <= robust5
    assert robust100 <= 1.05 * robust20
    assert squares100 > 1.5 * squares20


def test_a_weight_of_two_is_a_line_given_twice() -> None:
    centers, directions = noisy_lines(np.random.default_rng(0), 5)
    twice = [0, 0, 1, 2, 3, 4]
    np.testing.assert_allclose(
        found(average_centers(centers, directions, np.array([2.0, 1, 1, 1, 1]))),
        found(average_centers(centers[twice], directions[twice])),
        atol=1e-12,
    )


def test_lines_that_pass_each_other_meet_half_way() -> None:
    centers = np.array([[-3.0, 0, 0], [0, 5, 2]])
    directions = np.array([[1.0, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(found(average_centers(centers, directions)), [0, 0, 1], atol=1e-14)


@pytest.mark.parametrize("num", [10, 20, 40])
def test_wrong_directions_harm_the_robust_center_little(num: int) -> None:
    errors = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scene = random_scene(rng, num, direction_noise_rad=0.01)
        directions = center_directions(scene.anchors_from_world, scene.query_from_anchors)
        directions[: 3 * num // 10] = random_directions(rng, 3 * num // 10)
        centers, truth = scene.anchors_from_world.center, scene.query_from_world.center
        estimates = [f(centers, directions) for f in (average_centers, average_centers_robust)]
        errors.append([np.linalg.norm(found(center) - truth) for center in estimates])
    least_squares, robust = np.median(errors, axis=0)
    assert robust < 0.02
    assert robust < least_squares / 5


@both_averages
@pytest.mark.parametrize("num", [0, 1])
def test_fewer_than_two_lines_fix_no_center(average: Average, num: int) -> None:
    assert average(np.ones((num, 3)), np.tile([0.0, 0, 1], (num, 1))) is None


def test_lines_without_weight_do_not_count() -> None:
    centers, directions = noisy_lines(np.random.default_rng(0), 3)
    assert average_centers(centers, directions, np.array([1.0, 0, 0])) is None
    np.testing.assert_allclose(
        found(average_centers(centers, directions, np.array([1.0, 1, 0]))),
        found(average_centers(centers[:2], directions[:2])),
        atol=1e-12,
    )


@both_averages
def test_parallel_lines_fix_no_center(average: Average) -> None:
    rng = np.random.default_rng(0)
    directions = np.tile([0.6, 0, 0.8], (6, 1)) * rng.choice([-1.0, 1.0], (6, 1))
    directions += 1e-4 * rng.normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert average(rng.normal(size=(6, 3)), directions) is None


@both_averages
def test_anchors_on_one_line_with_the_query_fix_no_center(average: Average) -> None:
    along = np.array([[-2.0], [-1], [0.5], [3]])
    scene = make_scene(along * [0.6, 0, 0.8], np.zeros(3), np.random.default_rng(0))
    directions = center_directions(scene.anchors_from_world, scene.query_from_anchors)
    assert average(scene.anchors_from_world.center, directions) is None


@both_averages
def test_anchors_at_one_place_find_the_query_at_that_place(average: Average) -> None:
    place = np.array([0.1, 0.2, 0.3])
    directions = random_directions(np.random.default_rng(0), 4)
    np.testing.assert_allclose(
        found(average(np.tile(place, (4, 1)), directions)), place, atol=1e-14
    )
