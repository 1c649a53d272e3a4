"""Frames of a recording: which sits on which, and where it was there over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.trajectory import Trajectory
from trigpoint_db.messages import Message, Recording, frame_of, stamp_ns
from trigpoint_db.poses import pose_from_numbers

# Messages of a pose in a frame, and where in them it is.
POSES: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: m.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: m.pose.pose,
    "nav_msgs/msg/Odometry": lambda m: m.pose.pose,
    "foxglove.PoseInFrame": lambda m: m.pose,
}
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "foxglove.FrameTransform", "foxglove.FrameTransforms")


@dataclass(frozen=True, eq=False)
class Joint:
    """How a frame sits on its parent: `parent_from_child` over time, or one for all times."""

    parent: str
    parent_from_child: Trajectory
    is_static: bool

    def at(self, times_ns: NDArray[np.int64], max_gap_s: float) -> tuple[Rigid3, NDArray[np.bool_]]:
        """Return parent_from_child (M,) at times (M,), and whether it is known (M,) there."""
        if self.is_static:
            last = np.full(len(times_ns), -1)  # which is the one that counts
            return self.parent_from_child.a_from_b[last], np.ones(len(times_ns), dtype=np.bool_)
        return self.parent_from_child.at(times_ns, max_gap_s)


def read_joints(where: str, recording: Recording) -> dict[str, Joint]:
    """Read the transforms on all topics, by child; `where` is for messages.

    A transform on tf_static, or one that was sent once, holds at all times.
    """
    parents: dict[str, str] = {}
    poses: dict[str, list[tuple[int, Rigid3]]] = {}
    moving: set[str] = set()
    for topic in recording.topics_of(TRANSFORMS):
        for transforms in recording.read(partial(_parse_transforms, where), [topic]):
            for time_ns, parent, child, parent_from_child in transforms:
                if parents.setdefault(child, parent) != parent:
                    raise ConfigError(
                        f"{where}: the frame {child} sits on {parents[child]} and, "
                        f"at {time_ns} ns on {topic}, on {parent}; a frame has one parent"
                    )
                poses.setdefault(child, []).append((time_ns, parent_from_child))
                if not topic.endswith("tf_static"):
                    moving.add(child)
    return {
        child: _joint(f"{where}: frame {child}", parents[child], found, child in moving)
        for child, found in poses.items()
    }


def _joint(where: str, parent: str, poses: list[tuple[int, Rigid3]], moving: bool) -> Joint:
    times_ns, transforms = zip(*poses, strict=True)
    trajectory = Trajectory.from_poses(where, times_ns, transforms)
    return Joint(parent, trajectory, is_static=not moving or len(trajectory.times_ns) == 1)


def _parse_transforms(where: str, message: Message) -> list[tuple[int, str, str, Rigid3]]:
    """Read time, parent, child and parent_from_child of what a message of `TRANSFORMS` holds."""
    content, found = message.content, []
    for each in getattr(content, "transforms", [content]):
        time_ns = stamp_ns(each) or message.log_time_ns
        is_ros = hasattr(each, "header")
        parent = frame_of(each) if is_ros else each.parent_frame_id.removeprefix("/")
        child = each.child_frame_id.removeprefix("/")
        values = each.transform if is_ros else each
        at = f"{where}: the transform of {child} at {time_ns} ns"
        found.append((time_ns, parent, child, _rigid(at, values.rotation, values.translation)))
    return found


def read_poses(where: str, recording: Recording, topic: str) -> tuple[Trajectory, str]:
    """Read world_from_body of a topic of `POSES`, and the frame of the body, where it is told."""
    times_ns, poses, bodies = zip(
        *recording.read(partial(_parse_pose, where), [topic]), strict=True
    )
    if len(set(bodies)) != 1:
        raise ConfigError(f"{where}: the poses on {topic} are of {len(set(bodies))} bodies")
    return Trajectory.from_poses(f"{where}: {topic}", times_ns, poses), bodies[0]


def _parse_pose(where: str, message: Message) -> tuple[int, Rigid3, str]:
    """Read time, world_from_body and the body's frame of a message of `POSES`."""
    pose = POSES[message.schema](message.content)
    at = f"{where}: the pose on {message.topic} at {message.time_ns} ns"
    body = getattr(message.content, "child_frame_id", "").removeprefix("/")
    return message.time_ns, _rigid(at, pose.orientation, pose.position), body


def _rigid(where: str, q: Any, t: Any) -> Rigid3:
    return pose_from_numbers(where, (q.w, q.x, q.y, q.z, t.x, t.y, t.z))


def chain(where: str, joints: dict[str, Joint], frame: str, end: str | None = None) -> list[Joint]:
    """Return the joints from a frame up to `end`, or to the frame that sits on none."""
    found: list[Joint] = []
    while frame != end and frame in joints:
        if len(found) == len(joints):
            raise ConfigError(f"{where}: the frame {frame} sits on itself")
        found.append(joints[frame])
        frame = joints[frame].parent
    if end not in (None, frame):
        raise ConfigError(f"{where}: no transforms lead from {end} to the frame of the images")
    return found


def join(
    joints: list[Joint], times_ns: NDArray[np.int64], max_gap_s: float
) -> tuple[Rigid3, NDArray[np.bool_]]:
    """Return a_from_b (M,) of joints from b up to a at times (M,), and whether it is known."""
    count = len(times_ns)
    a_from_b = Rigid3(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))
    found = np.ones(count, dtype=np.bool_)
    for joint in joints:
        parent_from_child, known = joint.at(times_ns, max_gap_s)
        a_from_b = parent_from_child @ a_from_b
        found &= known
    return a_from_b, found
