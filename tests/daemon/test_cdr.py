"""Our CDR is that of rosbags, an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from trigpoint.errors import SourceError
from trigpoint.rigid import Rigid3, rotation_angle
from trigpointd.messages.cdr import POSE_SCHEMA, POSE_TYPE, decode_pose, encode_pose

ROS = get_typestore(Stores.ROS2_HUMBLE)
finite = st.floats(-1e6, 1e6)
times = st.integers(0, 2**31 * 10**9 - 1)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
covariances = st.lists(finite, min_size=36, max_size=36).map(lambda c: np.reshape(c, (6, 6)))
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
poses = st.builds(
    lambda q, t: Rigid3.from_quaternion(q, np.array(t)), quaternions, st.tuples(*[finite] * 3)
)


def rosbags_message(
    time_ns: int, frame_id: str, pose: Rigid3, covariance: NDArray[np.float64]
) -> object:
    """Build the same message in rosbags' types."""
    types = ROS.types
    w, x, y, z = pose.quaternion
    stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
    position = types["geometry_msgs/msg/Point"](*pose.t)
    orientation = types["geometry_msgs/msg/Quaternion"](x, y, z, w)
    return types[POSE_TYPE](
        types["std_msgs/msg/Header"](stamp, frame_id),
        types["geometry_msgs/msg/PoseWithCovariance"](
            types["geometry_msgs/msg/Pose"](position, orientation), covariance.ravel()
        ),
    )


@given(times, names, poses, covariances)
@settings(max_examples=50)
def test_a_pose_has_the_bytes_that_rosbags_writes(
    time_ns: int, frame_id: str, pose: Rigid3, covariance: NDArray[np.float64]
) -> None:
    message = rosbags_message(time_ns, frame_id, pose, covariance)
    assert encode_pose(time_ns, frame_id, pose, covariance) == ROS.serialize_cdr(message, POSE_TYPE)


@given(times, names, poses, covariances, st.booleans())
@settings(max_examples=50)
def test_a_pose_that_rosbags_wrote_is_read_in_either_byte_order(
    time_ns: int,
    frame_id: str,
    pose: Rigid3,
    covariance: NDArray[np.float64],
    little_endian: bool,
) -> None:
    message = rosbags_message(time_ns, frame_id, pose, covariance)
    data = bytes(ROS.serialize_cdr(message, POSE_TYPE, little_endian=little_endian))
    decoded = decode_pose(data)
    assert (decoded.time_ns, decoded.frame_id) == (time_ns, frame_id)
    assert np.array_equal(decoded.world_from_body.t, pose.t)
    assert rotation_angle(decoded.world_from_body.R @ pose.R.T) < 1e-7
    assert np.array_equal(decoded.covariance, covariance)


def test_the_covariance_keeps_its_rows() -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    decoded = decode_pose(encode_pose(0, "map", Rigid3.identity(), covariance))
    assert np.array_equal(decoded.covariance, covariance)


def test_the_schema_is_the_one_that_rosbags_gives() -> None:
    assert ROS.generate_msgdef(POSE_TYPE, ros_version=2)[0] == POSE_SCHEMA


def test_a_pose_cut_short_anywhere_is_an_error_of_one_line() -> None:
    data = encode_pose(1, "map", Rigid3.identity(), np.eye(6))
    for length in range(len(data)):
        with pytest.raises(SourceError) as error:
            decode_pose(data[:length])
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("position", "value", "complaint"),
    [
        (1, b"\x07", "no CDR"),  # XCDR2 aligns otherwise
        (12, b"\xff\xff\xff\xff", "cut short"),  # the length of frame_id
        (16, b"\xff", "text"),
        (76, bytes(8), "no rotation"),  # the quaternion's w
    ],
)
def test_a_pose_with_a_wrong_byte_says_what_is_wrong(
    position: int, value: bytes, complaint: str
) -> None:
    data = bytearray(encode_pose(1, "map_frame", Rigid3.identity(), np.eye(6)))
    data[position : position + len(value)] = value
    with pytest.raises(SourceError, match=complaint):
        decode_pose(bytes(data))
