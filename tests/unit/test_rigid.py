from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trigpoint.rigid import (
    Rigid3,
    quaternion_from_rotation,
    rotate,
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_vector,
    skew,
)

Array = NDArray[np.float64]

quick = settings(max_examples=40)
vectors = arrays(np.float64, 3, elements=st.floats(-10, 10))
batches = arrays(np.float64, (4, 3), elements=st.floats(-10, 10))


@quick
@given(batches, batches, batches)
def test_the_inverse_undoes(rotvecs: Array, t: Array, points: Array) -> None:
    b_from_a = Rigid3(rotation_from_vector(rotvecs), t)
    np.testing.assert_allclose(b_from_a.inverse().apply(b_from_a.apply(points)), points, atol=1e-12)
    np.testing.assert_allclose(b_from_a.inverse().inverse().t, t, atol=1e-12)


@quick
@given(vectors, vectors, vectors, vectors, vectors)
def test_composing_is_applying_one_after_the_other(
    r1: Array, t1: Array, r2: Array, t2: Array, point: Array
) -> None:
    b_from_a = Rigid3(rotation_from_vector(r1), t1)
    c_from_b = Rigid3(rotation_from_vector(r2), t2)
    np.testing.assert_allclose(
        (c_from_b @ b_from_a).apply(point), c_from_b.apply(b_from_a.apply(point)), atol=1e-11
    )


@quick
@given(batches, batches)
def test_the_center_is_the_point_that_maps_to_the_origin(rotvecs: Array, center: Array) -> None:
    cam_from_world = Rigid3.from_center(rotation_from_vector(rotvecs), center)
    np.testing.assert_allclose(cam_from_world.center, center, atol=1e-12)
    np.testing.assert_allclose(cam_from_world.apply(center), 0, atol=1e-12)


def test_the_identity_changes_nothing() -> None:
    points = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(Rigid3.identity().apply(points), points)


def test_one_transform_composes_with_a_batch_on_either_side() -> None:
    rng = np.random.default_rng(0)
    one = Rigid3(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    many = Rigid3(rotation_from_vector(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)))
    for k in range(5):
        np.testing.assert_allclose((one @ many)[k].t, (one @ many[k]).t, atol=1e-14)
        np.testing.assert_allclose((many @ one)[k].R, (many[k] @ one).R, atol=1e-14)


def test_a_stack_gives_back_what_went_in() -> None:
    rng = np.random.default_rng(0)
    singles = [Rigid3(rotation_from_vector(v), v) for v in rng.normal(size=(3, 3))]
    stack = Rigid3.stack(singles)
    assert len(stack) == 3
    np.testing.assert_array_equal(stack[1].R, singles[1].R)
    np.testing.assert_array_equal(stack[1:].t, [singles[1].t, singles[2].t])
    assert len(Rigid3.stack([])) == 0


@quick
@given(batches)
def test_rotation_vectors_and_quaternions_agree_with_scipy(rotvecs: Array) -> None:
    expected = Rotation.from_rotvec(rotvecs)
    R = rotation_from_vector(rotvecs)
    np.testing.assert_allclose(R, expected.as_matrix(), atol=1e-13)
    q = expected.as_quat(scalar_first=True)
    np.testing.assert_allclose(rotation_from_quaternion(3.0 * q), R, atol=1e-13)
    likeness = np.abs(np.sum(quaternion_from_rotation(R) * q, axis=1))
    np.testing.assert_allclose(likeness, 1, atol=1e-13)


@quick
@given(arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_both_signs_of_a_quaternion_are_one_rotation(q: Array) -> None:
    R = rotation_from_quaternion(q)
    np.testing.assert_array_equal(rotation_from_quaternion(-q), R)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(R)), R, atol=1e-14)
    assert quaternion_from_rotation(R)[0] >= 0


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, 0.8)])
def test_half_turns_have_a_quaternion(axis: tuple[float, float, float]) -> None:
    R = rotation_from_vector(np.pi * np.array(axis))
    q = quaternion_from_rotation(R)
    np.testing.assert_allclose(np.abs(q), np.abs((0.0, *axis)), atol=1e-15)


def test_a_transform_from_an_unnormalised_quaternion_is_rigid() -> None:
    b_from_a = Rigid3.from_quaternion([2, 0, 0, 2], [1, 2, 3])
    np.testing.assert_allclose(b_from_a.apply(np.array([1.0, 0, 0])), [1, 3, 3], atol=1e-15)
    np.testing.assert_allclose(b_from_a.quaternion, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, 3.0, np.pi - 1e-6, np.pi - 1e-12, np.pi])
def test_the_rotation_angle_is_accurate_from_zero_to_a_half_turn(angle: float) -> None:
    axes = np.random.default_rng(0).normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = rotation_angle(rotation_from_vector(angle * axes))
    np.testing.assert_allclose(angles, angle, atol=2e-15)


@quick
@given(vectors, vectors)
def test_skew_is_the_cross_product(u: Array, v: Array) -> None:
    np.testing.assert_allclose(rotate(skew(u), v), np.cross(u, v), atol=1e-13)
