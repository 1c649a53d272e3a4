"""An MCAP recording with images and poses: ROS 2's messages or Foxglove's.

The poses come from one topic (PoseStamped, PoseWithCovarianceStamped, Odometry; PoseInFrame), or
from the transforms between frames (TFMessage; FrameTransform, FrameTransforms) as REP 105 and
https://docs.foxglove.dev/docs/sdk/schemas/frame-transform have them: they take coordinates in the
child's frame to the parent's. The frame_id of images is the camera's optical frame, x to the right,
y down, z ahead (REP 103). Poses are interpolated to the times at which images were taken.

Images are named by their topic and time of arrival; `read_frame` decodes them from the recording.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.camera_messages import Calibration, choose_calibration, is_rectified
from trigpoint.errors import ConfigError, SourceError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset
from trigpoint_db.importers.frames import (
    POSES,
    TRANSFORMS,
    Joint,
    chain,
    join,
    read_joints,
    read_poses,
)
from trigpoint_db.importers.trajectory import MAX_GAP_S, TimedImage, Trajectory, place_images
from trigpoint_db.messages import (
    CALIBRATIONS,
    IMAGES,
    Message,
    Recording,
    frame_of,
    image_name,
    parse_calibration,
)
from trigpoint_db.poses import pose_from_numbers


def detect(root: Path) -> bool:
    """Say whether `root` is a recording."""
    return root.suffix == ".mcap"


def read(
    root: Path,
    *,
    image_topic: str | None = None,
    pose_topic: str | None = None,
    mount: str | None = None,
    max_gap: float = MAX_GAP_S,
) -> Dataset:
    """Read the recording `root`.

    Parameters
    ----------
    root : Path
        A recording with an index.
    image_topic, pose_topic : str, optional
        Needed where the recording has several cameras or several sources of poses; one topic of
        transforms stands for all of them.
    mount : str, optional
        Where the camera sits on the body that the poses of a topic are of: `x y z qw qx qy qz`,
        which takes the camera's coordinates to the body's; or the body's frame, from which static
        transforms lead to the camera. An Odometry names that frame itself.
    max_gap : float
        Longest time in seconds between two poses that an image is placed between.
    """
    recording = Recording(root)
    topic = _choose(root, "image", recording.topics_of(IMAGES), image_topic)
    images, frame = _read_images(root, recording, topic)
    joints = _find_joints(root, recording, frame, pose_topic, mount)
    times_ns = np.array([image.time_ns for image in images])
    world_from_cam, found = join(joints, times_ns, max_gap)
    mapped = place_images(f"{root}: {topic}", images, world_from_cam, found)
    return Dataset(root, mapped, num_unposed=len(images) - len(mapped))


def _choose(root: Path, kind: str, topics: Sequence[str], wanted: str | None) -> str:
    listed = ", ".join(topics)
    if not topics:
        raise ConfigError(f"{root} has no {kind}s of a known type")
    if wanted is not None and wanted not in topics:
        raise ConfigError(f"{root} has no {kind}s on {wanted}, but on {listed}")
    if wanted is None and len(topics) > 1:
        raise ConfigError(f"{root} has {kind}s on {listed}; name one with --{kind}-topic")
    return wanted or topics[0]


def _read_images(root: Path, recording: Recording, topic: str) -> tuple[list[TimedImage], str]:
    """Read times, names and cameras of the images on a topic, and their frame."""
    cameras = _Cameras(root, recording, topic)
    images: dict[str, TimedImage] = {}
    frames: set[str] = set()
    for name, time_ns, log_time_ns, frame in recording.read(_parse_image, [topic]):
        if name in images:
            raise ConfigError(f"{root}: two images on {topic} arrived at {log_time_ns} ns")
        images[name] = TimedImage(time_ns, name, cameras.at(log_time_ns))
        frames.add(frame)
    if len(frames) != 1:
        raise ConfigError(f"{root}: the images on {topic} are of {len(frames)} frames")
    return list(images.values()), frames.pop()


def _parse_image(message: Message) -> tuple[str, int, int, str]:
    return image_name(message), message.time_ns, message.log_time_ns, frame_of(message.content)


def _parse_calibration(message: Message) -> tuple[int, Calibration]:
    return message.log_time_ns, parse_calibration(message)


class _Cameras:
    """The calibrations of the camera of an image topic: each holds until the next."""

    def __init__(self, root: Path, recording: Recording, image_topic: str) -> None:
        found = {
            topic: list(recording.read(_parse_calibration, [topic]))
            for topic in recording.topics_of(CALIBRATIONS)
        }

        def is_in_frame(topic: str) -> bool:
            *_, frame = next(recording.read(_parse_image, [image_topic]))
            return frame != "" and found[topic][0][1].frame_id == frame

        try:
            topic = choose_calibration(image_topic, found, is_in_frame)
            rectified = is_rectified(image_topic)
            self._cameras = [each.camera(rectified=rectified) for _, each in found[topic]]
        except SourceError as error:
            raise SourceError(f"{root}: {error}") from error
        self._times_ns = [time_ns for time_ns, _ in found[topic]]

    def at(self, time_ns: int) -> Camera:
        return self._cameras[max(bisect_right(self._times_ns, time_ns) - 1, 0)]


def _find_joints(
    root: Path, recording: Recording, frame: str, pose_topic: str | None, mount: str | None
) -> list[Joint]:
    """Return what leads from the frame of the images up to the world."""
    where = str(root)
    joints = read_joints(where, recording)
    up = chain(where, joints, frame)
    sources = recording.topics_of(POSES)
    transforms = [t for t in recording.topics_of(TRANSFORMS) if not t.endswith("tf_static")]
    if not all(joint.is_static for joint in up):
        sources += transforms[:1]
    source = _choose(root, "pose", sources, pose_topic)
    if source in transforms:
        if mount is not None:
            raise ConfigError(
                f"{root}: the transforms say where the camera sits; leave out --mount, or name a "
                "topic of poses with --pose-topic"
            )
        return up
    world_from_body, body = read_poses(where, recording, source)
    pose = Joint("world", world_from_body, is_static=False)
    if mount is not None and len(mount.split()) == 7:
        return [_read_mount(mount), pose]
    body = body if mount is None else mount
    if not body:
        raise ConfigError(
            f"{root}: the poses on {source} do not say of what they are; say where the camera sits "
            "on it: --mount 'x y z qw qx qy qz' (0 0 0 1 0 0 0 if it is the camera), or its frame"
        )
    on_body = chain(where, joints, frame, end=body)
    if not all(joint.is_static for joint in on_body):
        raise ConfigError(f"{root}: the camera {frame!r} moves on {body}; name another --mount")
    return [*on_body, pose]


def _read_mount(mount: str) -> Joint:
    try:
        x, y, z, *wxyz = (float(word) for word in mount.split())
    except ValueError:
        raise ConfigError(f"--mount takes x y z qw qx qy qz or a frame, not {mount!r}") from None
    body_from_cam = Rigid3.stack([pose_from_numbers("--mount", (*wxyz, x, y, z))])
    return Joint("body", Trajectory(np.zeros(1, dtype=np.int64), body_from_cam), is_static=True)
