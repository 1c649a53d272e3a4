from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit.synthetic_rays import (
    Scene,
    make_scene,
    random_directions,
    random_relative_poses,
    random_rotations,
    random_scene,
)
from trigpoint.geometry.anchor_ransac import AnchorConsensus, NoConsensus, find_consensus
from trigpoint.geometry.center_averaging import average_centers, center_directions
from trigpoint.rigid import (
    Rigid3,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_vector,
)

Array = NDArray[np.float64]

quick = settings(max_examples=25)
seeds = st.integers(0, 2**32 - 1)
MAX_ERROR_RAD = float(np.deg2rad(5))


def consensus(scene: Scene) -> AnchorConsensus | NoConsensus:
    return find_consensus(
        scene.anchors_from_world,
        scene.query_from_anchors,
        max_direction_error_rad=MAX_ERROR_RAD,
        max_rotation_error_rad=MAX_ERROR_RAD,
    )


def agreed(scene: Scene) -> AnchorConsensus:
    result = consensus(scene)
    assert isinstance(result, AnchorConsensus)
    return result


def with_opposite_direction(scene: Scene, index: NDArray[np.intp]) -> Scene:
    relative = scene.query_from_anchors[index]
    return scene.with_relative_poses(index, Rigid3(relative.R, -relative.t))


def with_wrong_rotation(scene: Scene, index: NDArray[np.intp]) -> Scene:
    """Turn the query about its own center: T_kq stays."""
    turn = Rigid3(rotation_from_vector(np.array([0, 0, 0.5])), np.zeros(3))
    return scene.with_relative_poses(index, turn @ scene.query_from_anchors[index])


def with_direction_in_world(scene: Scene, k: int, direction: Array) -> Scene:
    """Let anchor k see the query in a given direction; its rotation stays."""
    R_qk = scene.query_from_anchors.R[k]
    T_kq = scene.anchors_from_world.R[k] @ direction
    return scene.with_relative_poses(np.array(k), Rigid3(R_qk, -R_qk @ T_kq))


@quick
@given(seeds, st.integers(3, 15))
def test_exact_relative_poses_agree_on_the_exact_pose(seed: int, num: int) -> None:
    scene = random_scene(np.random.default_rng(seed), num)
    result = agreed(scene)
    assert result.inliers.all()
    np.testing.assert_allclose(result.center, scene.query_from_world.center, atol=1e-9)
    np.testing.assert_allclose(result.R, scene.query_from_world.R, atol=1e-12)


@pytest.mark.parametrize("num_outliers", [0, 4, 8, 14])
def test_the_inliers_are_those_with_right_relative_poses(num_outliers: int) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        scene = random_scene(rng, 20, rotation_noise_rad=0.005, direction_noise_rad=0.005)
        outliers = rng.permutation(20)[:num_outliers]
        scene = scene.with_relative_poses(outliers, random_relative_poses(rng, num_outliers))
        result = agreed(scene)
        np.testing.assert_array_equal(np.flatnonzero(~result.inliers), np.sort(outliers))
        assert rotation_angle(result.R @ scene.query_from_world.R.T) < 0.02
        assert np.linalg.norm(result.center - scene.query_from_world.center) < 0.05


@quick
@given(seeds)
def test_a_consensus_has_the_most_votes_of_all_pairs(seed: int) -> None:
    """Compare with one pair after the other, in other formulas; no anchor is near the query."""
    rng = np.random.default_rng(seed)
    centers = 3 * random_directions(rng, 8)
    scene = make_scene(
        centers, 0.1 * rng.normal(size=3), rng, rotation_noise_rad=0.05, direction_noise_rad=0.05
    )
    scene = scene.with_relative_poses(np.arange(3), random_relative_poses(rng, 3))
    R = scene.query_from_anchors.R @ scene.anchors_from_world.R
    d = center_directions(scene.anchors_from_world, scene.query_from_anchors)
    most = 0
    for pair in map(list, itertools.combinations(range(8), 2)):
        middle = average_centers(centers[pair], d[pair])
        if middle is None or rotation_angle(R[pair[1]] @ R[pair[0]].T) > MAX_ERROR_RAD:
            continue
        half = np.linalg.svd(R[pair].sum(axis=0))
        mean = half[0] @ half[2]  # the chordal mean
        towards = middle - centers
        sines = np.linalg.norm(np.cross(towards, d), axis=1)
        votes = np.arctan2(sines, np.sum(towards * d, axis=1)) <= MAX_ERROR_RAD
        votes &= rotation_angle(R @ mean.T) <= MAX_ERROR_RAD
        crossing = np.linalg.norm(np.cross(*d[pair])) > np.sin(np.deg2rad(1.5))
        if crossing and votes[pair].all():
            most = max(most, int(votes.sum()))
    result = consensus(scene)
    if most == 0:
        assert result is NoConsensus.DISAGREEMENT
    else:
        assert isinstance(result, AnchorConsensus)
        assert result.inliers.sum() == most


@quick
@given(seeds)
def test_the_order_of_the_anchors_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 10, rotation_noise_rad=0.02, direction_noise_rad=0.02)
    scene = scene.with_relative_poses(np.arange(3), random_relative_poses(rng, 3))
    order = rng.permutation(10)
    result, shuffled = agreed(scene), agreed(scene.subset(order))
    np.testing.assert_array_equal(shuffled.inliers, result.inliers[order])
    np.testing.assert_allclose(shuffled.center, result.center, atol=1e-12)
    assert {int(order[k]) for k in shuffled.pair} == set(result.pair)


@quick
@given(seeds, st.floats(1e-3, 1e3))
def test_the_consensus_moves_with_the_world(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, 10, rotation_noise_rad=0.02, direction_noise_rad=0.02)
    R, t = random_rotations(rng, 1)[0], scale * rng.normal(size=3)
    result, moved = agreed(scene), agreed(scene.in_other_world(scale, R, t))
    assert moved.pair == result.pair
    np.testing.assert_array_equal(moved.inliers, result.inliers)
    np.testing.assert_allclose(moved.center, scale * R @ result.center + t, atol=1e-9 * scale)
    np.testing.assert_allclose(moved.R, result.R @ R.T, atol=1e-12)


@quick
@given(seeds, st.integers(2, 10))
def test_whatever_the_relative_poses_a_consensus_includes_its_own_pair(seed: int, num: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, num)
    relative = Rigid3(scene.query_from_anchors.R, random_directions(rng, num))
    result = consensus(scene.with_relative_poses(np.arange(num), relative))
    if isinstance(result, AnchorConsensus):
        assert result.pair[0] < result.pair[1]
        assert result.inliers[list(result.pair)].all()
    else:
        assert result is NoConsensus.DISAGREEMENT


def test_two_anchors_agree_though_their_quaternions_have_opposite_signs() -> None:
    # Near a half turn, rotations a little apart have canonical quaternions of opposite signs.
    half_turn = rotation_from_vector(np.array([0, 0, np.pi]))
    opposite = 0
    for seed in range(20):
        scene = random_scene(np.random.default_rng(seed), 2, rotation_noise_rad=0.01)
        scene = scene.in_other_world(1.0, half_turn.T @ scene.query_from_world.R, np.zeros(3))
        q = quaternion_from_rotation(scene.query_from_anchors.R @ scene.anchors_from_world.R)
        opposite += int(q[0] @ q[1] < 0)
        result = agreed(scene)
        assert result.inliers.all()
        assert rotation_angle(result.R @ half_turn.T) < 0.05
    assert opposite > 0


def test_an_anchor_that_sees_the_query_behind_itself_is_an_outlier() -> None:
    scene = random_scene(np.random.default_rng(0), 6)
    result = agreed(with_opposite_direction(scene, np.array([2])))
    np.testing.assert_array_equal(np.flatnonzero(~result.inliers), [2])


def test_rays_that_meet_behind_their_anchors_do_not_agree() -> None:
    scene = random_scene(np.random.default_rng(0), 6)
    behind = with_opposite_direction(scene, np.arange(6))
    assert consensus(behind) is NoConsensus.DISAGREEMENT


def test_an_anchor_with_a_wrong_rotation_alone_is_an_outlier() -> None:
    scene = with_wrong_rotation(random_scene(np.random.default_rng(0), 6), np.array([4]))
    np.testing.assert_array_equal(np.flatnonzero(~agreed(scene).inliers), [4])


def test_rays_that_pass_each_other_afar_do_not_agree() -> None:
    scene = make_scene(np.array([[-3.0, 0, 0], [0, -3, 1]]), np.zeros(3), np.random.default_rng(0))
    scene = with_direction_in_world(scene, 0, np.array([1.0, 0, 0]))
    assert isinstance(
        consensus(with_direction_in_world(scene, 1, np.array([0, 1.0, 0]))), NoConsensus
    )
    # A gap of 0.4 m at 3 m is 3.8 degrees to each side of its midpoint.
    near = make_scene(np.array([[-3.0, 0, 0], [0, -3, 0.4]]), np.zeros(3), np.random.default_rng(0))
    near = with_direction_in_world(near, 0, np.array([1.0, 0, 0]))
    result = agreed(with_direction_in_world(near, 1, np.array([0, 1.0, 0])))
    np.testing.assert_allclose(result.center, [0, 0, 0.2], atol=1e-12)


@pytest.mark.parametrize("num", [0, 1])
def test_fewer_than_two_anchors_do_not_agree(num: int) -> None:
    scene = random_scene(np.random.default_rng(0), 2).subset(np.arange(num))
    assert consensus(scene) is NoConsensus.DISAGREEMENT


def test_anchors_without_a_common_rotation_do_not_agree() -> None:
    rng = np.random.default_rng(0)
    scene = random_scene(rng, 6)
    relative = Rigid3(random_rotations(rng, 6), scene.query_from_anchors.t)
    assert consensus(scene.with_relative_poses(np.arange(6), relative)) is NoConsensus.DISAGREEMENT


@pytest.mark.parametrize("along", [(1.0, 2, 4, 7), (-1.0, -2, 3, 7)], ids=["behind", "between"])
def test_anchors_on_one_line_with_the_query_are_degenerate(along: tuple[float, ...]) -> None:
    centers = np.outer(along, [0.6, 0, 0.8])
    scene = make_scene(centers, np.zeros(3), np.random.default_rng(0), direction_noise_rad=0.002)
    assert consensus(scene) is NoConsensus.DEGENERATE


def test_parallel_rays_from_different_places_are_degenerate() -> None:
    rng = np.random.default_rng(0)
    scene = random_scene(rng, 5)
    for k in range(5):
        scene = with_direction_in_world(scene, k, np.array([0, 0, 1.0]))
    assert consensus(scene) is NoConsensus.DEGENERATE


def test_anchors_at_one_place_are_degenerate() -> None:
    centers = np.tile([5e5, 0.2, 0.3], (4, 1))
    rng = np.random.default_rng(0)
    scene = make_scene(centers, centers[0] + 1, rng, direction_noise_rad=0.1)
    assert consensus(scene) is NoConsensus.DEGENERATE


def test_a_line_of_anchors_is_degenerate_though_a_wrong_rotation_crosses_it() -> None:
    rng = np.random.default_rng(0)
    centers = np.array([[1.0, 0, 0], [2, 0, 0], [4, 0, 0], [0, 3, 0]])
    scene = make_scene(centers, np.zeros(3), rng)
    assert isinstance(consensus(scene), AnchorConsensus)
    assert consensus(with_wrong_rotation(scene, np.array([3]))) is NoConsensus.DEGENERATE


@pytest.mark.parametrize(("angle_deg", "crosses"), [(1.4, False), (1.6, True), (178.6, False)])
def test_rays_cross_above_the_least_angle(angle_deg: float, crosses: bool) -> None:
    angle = np.deg2rad(angle_deg)
    centers = np.array([[1.0, 0, 0], [np.cos(angle), np.sin(angle), 0]])
    result = consensus(make_scene(centers, np.zeros(3), np.random.default_rng(0)))
    assert isinstance(result, AnchorConsensus) == crosses


def test_an_anchor_at_the_querys_place_agrees_by_its_rotation() -> None:
    rng = np.random.default_rng(0)
    centers = np.vstack([random_directions(rng, 5), [[0.01, 0, 0]]])
    scene = make_scene(centers, np.zeros(3), rng)
    scene = with_direction_in_world(scene, 5, np.array([1.0, 0, 0]))  # away from it
    assert agreed(scene).inliers.all()
    assert not agreed(with_wrong_rotation(scene, np.array([5]))).inliers[5]


def test_anchors_amid_which_a_wrong_center_lies_do_not_vote_for_it() -> None:
    # Two anchors wrongly see the query amid four others, which see it 3 m farther on.
    crowd = np.array([[0.05, 0, 0], [-0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]])
    witness = np.array([[4.0, 3, 1]])
    wrong = np.array([[2.0, 0, 0], [0, 0, -2]])
    query = np.array([0, 3.0, 0])
    scene = make_scene(np.vstack([crowd, witness, wrong]), query, np.random.default_rng(0))
    scene = with_direction_in_world(scene, 5, np.array([-1.0, 0, 0]))
    scene = with_direction_in_world(scene, 6, np.array([0, 0, 1.0]))
    result = agreed(scene)
    np.testing.assert_array_equal(np.flatnonzero(result.inliers), [0, 1, 2, 3, 4])
    np.testing.assert_allclose(result.center, query, atol=1e-9)


def test_an_anchor_exactly_at_the_proposed_center_is_no_division_by_zero() -> None:
    centers = np.array([[-3.0, 0, 0], [0, -3, 0], [0, 0, 0]])
    directions = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    upright = np.tile(np.eye(3), (3, 1, 1))
    scene = Scene(Rigid3(upright, -centers), Rigid3(upright, -directions), Rigid3.identity())
    result = agreed(scene)
    np.testing.assert_array_equal(result.center, [0, 0, 0])
    assert result.inliers.all()


def test_a_pair_that_does_not_vote_for_its_own_proposal_is_none_whoever_else_votes() -> None:
    # Four anchors on one line, seeing along it; 4 and 5 pass it at 1 on either side, so that the
    # midpoint of their rays lies on it; 6 and 7 meet elsewhere.
    along = np.array([[-9.0, 0, 0], [-7, 0, 0], [-5, 0, 0], [-3, 0, 0]])
    passing = np.array([[0, -3.0, 1], [0, 3, -1]])
    meeting = np.array([[0, 47.0, 80], [3, 50, 80]])
    centers = np.vstack([along, passing, meeting])
    scene = make_scene(centers, np.array([0, 50.0, 80]), np.random.default_rng(0))
    axes = np.array([[1.0, 0, 0]] * 4 + [[0.1, 1, 0], [0.1, -1, 0]])
    for k, axis in enumerate(axes / np.linalg.norm(axes, axis=1, keepdims=True)):
        scene = with_direction_in_world(scene, k, axis)
    result = agreed(scene)
    assert result.pair == (6, 7)
    np.testing.assert_array_equal(np.flatnonzero(result.inliers), [6, 7])


def test_of_equal_votes_the_smaller_errors_win() -> None:
    # Anchors 0 and 1 meet exactly, 2 and 3 pass each other at a tenth of their distance.
    centers = np.array([[-3.0, 0, 0], [0, -3, 0], [-3, 0, 50], [0, -3, 50.3]])
    scene = make_scene(centers, np.zeros(3), np.random.default_rng(0))
    for k, direction in enumerate(np.array([[1.0, 0, 0], [0, 1, 0]] * 2)):
        scene = with_direction_in_world(scene, k, direction)
    assert agreed(scene).pair == (0, 1)
    assert agreed(scene.subset(np.array([2, 3, 0, 1]))).pair == (2, 3)
