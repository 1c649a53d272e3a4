"""ROS 2 messages as bytes: CDR (XCDR1), each field aligned to its size after a 4-byte header."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import SourceError
from trigpoint.rigid import Rigid3

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_ENCODING = f"application/cdr;{POSE_TYPE}"  # of a Zenoh sample
# The type in MCAP's `ros2msg`: its definition, then those of all that it is made of.
_RULE = "=" * 80
POSE_SCHEMA = f"""\
std_msgs/Header header
geometry_msgs/PoseWithCovariance pose
{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{_RULE}
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
{_RULE}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_RULE}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_NS = 10**9


@dataclass(frozen=True, eq=False)
class PoseStamped:
    """A pose as it was published; `covariance` is ROS's, as in `trigpoint.frame.Localized`."""

    time_ns: int
    frame_id: str
    world_from_body: Rigid3
    covariance: NDArray[np.float64]


def encode_pose(
    time_ns: int, frame_id: str, world_from_body: Rigid3, covariance: NDArray[np.float64]
) -> bytes:
    """Write a PoseWithCovarianceStamped; `frame_id` names the world frame."""
    sec, nanosec = divmod(time_ns, _NS)
    text = frame_id.encode() + b"\0"
    head = struct.pack("<iII", sec, nanosec, len(text)) + text
    w, x, y, z = world_from_body.quaternion
    numbers = struct.pack("<43d", *world_from_body.t, x, y, z, w, *covariance.ravel())
    return _LITTLE_ENDIAN + head + bytes(-len(head) % 8) + numbers


def decode_pose(data: bytes) -> PoseStamped:
    """Read a PoseWithCovarianceStamped."""
    reader = CdrReader(data)
    time_ns, frame_id = reader.header()
    x, y, z, qx, qy, qz, qw = reader.numbers("d", 7)
    covariance = np.reshape(reader.numbers("d", 36), (6, 6))
    if not np.isfinite([x, y, z]).all():
        raise SourceError(f"a pose message's position ({x}, {y}, {z}) is no place")
    if not 0.5 < qx * qx + qy * qy + qz * qz + qw * qw < 2.0:
        raise SourceError(f"a pose message's quaternion ({qx}, {qy}, {qz}, {qw}) is no rotation")
    pose = Rigid3.from_quaternion((qw, qx, qy, qz), (x, y, z))
    return PoseStamped(time_ns, frame_id, pose, covariance)


class CdrReader:
    """Reads the fields of one message in their order."""

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (b"\0\0", b"\0\1"):
            raise SourceError(f"a message that starts with {data[:4].hex() or 'nothing'} is no CDR")
        self._data = data
        self._byte_order = "<" if data[1] else ">"
        self._offset = 4

    def numbers(self, code: str, count: int) -> tuple[Any, ...]:
        """Read `count` numbers of one of `struct`'s format codes."""
        size = struct.calcsize("<" + code)
        start = self._offset + (4 - self._offset) % size
        try:
            values = struct.unpack_from(f"{self._byte_order}{count}{code}", self._data, start)
        except struct.error:
            raise self._cut_short() from None
        self._offset = start + count * size
        return values

    def uint32(self) -> int:
        """Read one number, or the length of a sequence."""
        value: int = self.numbers("I", 1)[0]
        return value

    def octets(self) -> bytes:
        """Read a sequence of bytes."""
        length = self.uint32()
        octets = self._data[self._offset : self._offset + length]
        if len(octets) != length:
            raise self._cut_short()
        self._offset += length
        return octets

    def string(self) -> str:
        """Read a string; some writers give an empty one no terminator."""
        try:
            return self.octets().removesuffix(b"\0").decode()
        except UnicodeDecodeError as error:
            raise SourceError(f"a CDR message's text cannot be read: {error}") from error

    def header(self) -> tuple[int, str]:
        """Read a std_msgs/Header: nanoseconds and the frame's name."""
        (sec,) = self.numbers("i", 1)
        return sec * _NS + self.uint32(), self.string()

    def _cut_short(self) -> SourceError:
        return SourceError(f"a CDR message of {len(self._data)} bytes is cut short")
