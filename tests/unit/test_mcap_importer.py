"""Maps from recordings: a flight through a rendered room, recorded as ROS 2 and Foxglove do."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from tests.unit import slam_layouts as layouts
from tests.unit.conftest import Run
from tests.unit.layouts import POSES, View, check_truth
from tests.unit.slam_layouts import BODY_FROM_CAM, START_NS, moved, write_foxglove, write_ros
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError, SourceError, TrigpointError
from trigpoint.images import read_gray
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint_db.build import build_map, read_frame
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.importers.registry import find_format, read_dataset
from trigpoint_db.recording import RecordedImage, write_recording

CAMERA = Camera("OPENCV", 320, 240, (250.0, 252.0, 158.2, 121.7, -0.1, 0.03, 0.002, -0.001))
TOPIC = "/camera/image"
MS = 10**6
DELAY_NS = 30 * MS  # from capture to arrival
START = POSES[0].inverse() @ BODY_FROM_CAM.inverse()  # world_from_body
# The camera hangs on a link in between.
BODY_FROM_LINK = Rigid3.from_quaternion([0.8, 0.1, 0.2, -0.3], [0.1, 0.2, 0.3])
LINK_FROM_CAM = BODY_FROM_LINK.inverse() @ BODY_FROM_CAM
WORLD_FROM_ODOM = Rigid3.from_quaternion([0.9, 0.0, 0.1, 0.4], [3.0, -2.0, 0.1])
NUMBERS = " ".join(map(str, [*BODY_FROM_CAM.t, *BODY_FROM_CAM.quaternion]))

Messages = list[tuple[str, str, Any, int]]


@dataclass(frozen=True)
class Flight:
    """Image files taken at `times_ns`, and what they show."""

    files: list[Path]
    times_ns: list[int]
    views: list[View]

    def check(self, dataset: Dataset, indices: Iterable[int]) -> None:
        names = [f"{TOPIC}/{self.times_ns[i] + DELAY_NS}" for i in indices]
        assert [image.name for image in dataset.mapped] == names
        check_truth(dataset.mapped, dict(zip(names, (self.views[i] for i in indices), strict=True)))
        assert dataset.num_unposed == len(self.files) - len(names)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Four images half a second apart; the body moves at constant speed."""
    folder = tmp_path_factory.mktemp("flight")
    times_ns = [START_NS + i * 500 * MS for i in range(4)]
    poses = [body(time_ns) @ BODY_FROM_CAM for time_ns in times_ns]
    names = [f"{i}.png" for i in range(4)]
    views = layouts.film(folder, CAMERA, names, poses)
    return Flight([folder / name for name in names], times_ns, [views[name] for name in names])


def body(time_ns: int) -> Rigid3:
    """Return world_from_body."""
    return moved(START, (time_ns - START_NS) * 1e-9)


def times_of_poses(end_ms: int = 1600) -> list[int]:
    """Every 90 ms, from before the first image to after the last, unless it ends sooner."""
    return [START_NS + ms * MS for ms in range(-40, end_ms, 90)]


def ros_images(flight: Flight, frame_id: str = "optical") -> Messages:
    images: Messages = [
        (TOPIC, "sensor_msgs/msg/Image", layouts.ros_image(file, time_ns, frame_id),
         time_ns + DELAY_NS)
        for file, time_ns in zip(flight.files, flight.times_ns, strict=True)
    ]  # fmt: skip
    info = layouts.ros_camera_info(CAMERA, START_NS)
    return [("/camera/camera_info", "sensor_msgs/msg/CameraInfo", info, START_NS), *images]


def ros_tf(
    topic: str, parent: str, child: str, transforms: Iterable[tuple[int, Rigid3]]
) -> Messages:
    return [
        (topic, "tf2_msgs/msg/TFMessage",
         {"transforms": [layouts.ros_transform(time_ns, parent, child, transform)]}, time_ns)
        for time_ns, transform in transforms
    ]  # fmt: skip


def ros_static(where: str = "/tf_static") -> Messages:
    return [
        *ros_tf(where, "base_link", "camera_link", [(START_NS, BODY_FROM_LINK)]),
        *ros_tf(where, "camera_link", "optical", [(START_NS, LINK_FROM_CAM)]),
    ]


def ros_odometry(times_ns: Iterable[int], topic: str = "/odom") -> Messages:
    def message(time_ns: int) -> dict[str, Any]:
        zero = layouts.xyz(np.zeros(3))
        pose = {"pose": layouts.ros_pose(body(time_ns)), "covariance": [0.0] * 36}
        twist = {"twist": {"linear": zero, "angular": zero}, "covariance": [0.0] * 36}
        head = layouts.header(time_ns, "odom")
        return {"header": head, "child_frame_id": "base_link", "pose": pose, "twist": twist}

    return [(topic, "nav_msgs/msg/Odometry", message(t), t) for t in times_ns]


def ros_poses(times_ns: Iterable[int], *, covariance: bool = False) -> Messages:
    kind = "PoseWithCovarianceStamped" if covariance else "PoseStamped"

    def message(time_ns: int) -> dict[str, Any]:
        pose = layouts.ros_pose(body(time_ns))
        whole = {"pose": pose, "covariance": [0.0] * 36} if covariance else pose
        return {"header": layouts.header(time_ns, "map"), "pose": whole}

    return [("/pose", f"geometry_msgs/msg/{kind}", message(t), t) for t in times_ns]


def test_ros_odometry_and_static_transforms(flight: Flight, tmp_path: Path) -> None:
    messages = [*ros_images(flight), *ros_static(), *ros_odometry(times_of_poses())]
    path = write_ros(tmp_path / "a.mcap", messages)
    assert find_format(path) == "mcap"
    flight.check(read_dataset(path), range(4))


def test_ros_transforms_from_map_to_camera(flight: Flight, tmp_path: Path) -> None:
    times = times_of_poses()
    odom = WORLD_FROM_ODOM.inverse()
    messages = [
        *ros_images(flight, "/optical"),  # as ROS 1 wrote it
        *ros_static(),
        *ros_tf("/tf", "odom", "base_link", [(t, odom @ body(t)) for t in times]),
        *ros_tf("/tf", "map", "odom", [(t + MS, WORLD_FROM_ODOM) for t in times]),
        *ros_tf("/tf", "map", "other_robot", [(t, odom) for t in times]),
    ]
    path = write_ros(tmp_path / "a.mcap", messages)
    flight.check(read_dataset(path), range(4))
    with pytest.raises(ConfigError, match="transforms say where the camera sits; leave out --mou"):
        read_dataset(path, mount=NUMBERS)


def test_a_transform_sent_once_is_static(flight: Flight, tmp_path: Path) -> None:
    messages = [*ros_images(flight), *ros_static("/tf"), *ros_odometry(times_of_poses())]
    flight.check(read_dataset(write_ros(tmp_path / "a.mcap", messages)), range(4))


@pytest.mark.parametrize("covariance", [False, True])
def test_ros_poses_need_to_be_told_what_they_are_of(
    flight: Flight, tmp_path: Path, covariance: bool
) -> None:
    poses = ros_poses(times_of_poses(), covariance=covariance)
    path = write_ros(tmp_path / "a.mcap", [*ros_images(flight), *ros_static(), *poses])
    with pytest.raises(
        ConfigError, match=r"poses on /pose do not say of what they are; .* --mount"
    ):
        read_dataset(path)
    flight.check(read_dataset(path, mount=NUMBERS), range(4))
    flight.check(read_dataset(path, mount="base_link"), range(4))


def foxglove_images(flight: Flight) -> list[tuple[str, Any, int]]:
    images = [
        (TOPIC, layouts.foxglove_image(file, time_ns), time_ns + DELAY_NS)
        for file, time_ns in zip(flight.files, flight.times_ns, strict=True)
    ]
    return [("/camera/calibration", layouts.foxglove_calibration(CAMERA, START_NS), 0), *images]


def test_foxglove_poses(flight: Flight, tmp_path: Path) -> None:
    poses = [("/pose", layouts.foxglove_pose_in_frame(t, body(t)), t) for t in times_of_poses()]
    path = write_foxglove(tmp_path / "a.mcap", [*foxglove_images(flight), *poses])
    flight.check(read_dataset(path, mount=NUMBERS), range(4))


@pytest.mark.parametrize("together", [False, True])
def test_foxglove_transforms(flight: Flight, tmp_path: Path, together: bool) -> None:
    static = layouts.foxglove_transform(START_NS, "base_link", "optical", BODY_FROM_CAM)
    moving = [layouts.foxglove_transform(t, "map", "base_link", body(t)) for t in times_of_poses()]
    messages: list[Any] = [static, *moving]
    if together:
        messages = [layouts.foxglove_transforms(messages)]
    sent = [("/tf", message, START_NS + i) for i, message in enumerate(messages)]
    path = write_foxglove(tmp_path / "a.mcap", [*foxglove_images(flight), *sent])
    flight.check(read_dataset(path), range(4))


def test_our_own_recordings_with_truth_are_maps(flight: Flight, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    images = [
        RecordedImage(file, CAMERA, view.cam_from_world)
        for file, view in zip(flight.files, flight.views, strict=True)
    ]
    write_recording(path, images)
    dataset = read_dataset(path, mount="0 0 0 1 0 0 0")
    names = [image.name for image in dataset.mapped]
    check_truth(dataset.mapped, dict(zip(names, flight.views, strict=True)))


def test_images_without_poses_near_them_are_left_out(flight: Flight, tmp_path: Path) -> None:
    times = [t for t in times_of_poses(1200) if not START_NS + 400 * MS < t < START_NS + 700 * MS]
    path = write_ros(
        tmp_path / "a.mcap", [*ros_images(flight), *ros_static(), *ros_odometry(times)]
    )
    flight.check(read_dataset(path), [0, 2])
    flight.check(read_dataset(path, max_gap=0.5), [0, 1, 2])


def test_a_calibration_holds_until_the_next(flight: Flight, tmp_path: Path) -> None:
    info, *images = ros_images(flight)
    later = Camera("PINHOLE", 320, 240, (260.0, 260.0, 160.0, 120.0))
    second = layouts.ros_camera_info(later, flight.times_ns[2])
    messages = [*images[:2], info, (*info[:2], second, flight.times_ns[2]), *images[2:]]
    messages = [*messages, *ros_static(), *ros_odometry(times_of_poses())]
    dataset = read_dataset(write_ros(tmp_path / "a.mcap", messages))
    assert [image.camera for image in dataset.mapped] == [CAMERA, CAMERA, later, later]


def test_one_of_several_cameras_and_sources_of_poses(flight: Flight, tmp_path: Path) -> None:
    odometry = ros_odometry(times_of_poses())
    still = [("/wheels", kind, odometry[0][2], time_ns) for _, kind, _, time_ns in odometry[:1]]
    second = [("/second/image", *rest) for _, *rest in ros_images(flight)[1:]]
    path = write_ros(
        tmp_path / "a.mcap", [*ros_images(flight), *second, *ros_static(), *odometry, *still]
    )
    with pytest.raises(
        ConfigError, match="images on /camera/image, /second/image; name one with -"
    ):
        read_dataset(path)
    with pytest.raises(ConfigError, match=r"poses on /odom, /wheels; name one with --pose-topic"):
        read_dataset(path, image_topic=TOPIC)
    flight.check(read_dataset(path, image_topic=TOPIC, pose_topic="/odom"), range(4))
    with pytest.raises(ConfigError, match="has no images on /odom, but on /camera"):
        read_dataset(path, image_topic="/odom")
    with pytest.raises(ConfigError, match="none of the 4 images lies between two poses"):
        read_dataset(path, image_topic=TOPIC, pose_topic="/wheels")


def test_topics_without_messages_are_no_choice(flight: Flight, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        for kind, encoding in (("nav_msgs/msg/Odometry", "ros2msg"), ("sensor_msgs/Image", "idl")):
            schema = writer.register_schema(kind, encoding, b"")
            writer.register_channel("/silent", "cdr", schema)
        writer.register_channel("/nothing known", "json", 0)
        writer.add_message(3, 0, b"{}", 0)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(ConfigError, match=r"a\.mcap has no images of a known type"):
        read_dataset(path)
    with pytest.raises(ConfigError, match=r"a\.mcap has no images of a known type"):
        read_dataset(path, image_topic="/silent")


def test_a_map_is_built_from_a_recording_as_from_its_files(
    flight: Flight, tmp_path: Path, run: Run, model: FeatureModel
) -> None:
    messages = [*ros_images(flight), *ros_static(), *ros_odometry(times_of_poses(1200))]
    path = write_ros(tmp_path / "a.mcap", messages)
    code, out, err = run("build", tmp_path / "m.tpmap", path, "--max-gap", 0.15)
    assert code == 0, err
    assert "3 images added, 1 without a pose left out" in out
    posed = [
        PosedImage(file.name, CAMERA, view.cam_from_world)
        for file, view in zip(flight.files[:3], flight.views, strict=False)
    ]
    build_map(tmp_path / "files.tpmap", posed, flight.files[0].parent, model)
    with (
        MapReader.open(tmp_path / "m.tpmap") as from_recording,
        MapReader.open(tmp_path / "files.tpmap") as from_files,
    ):
        for i in range(3):
            a, b = from_recording.anchor(i), from_files.anchor(i)
            assert a.name == f"{TOPIC}/{flight.times_ns[i] + DELAY_NS}"
            assert a.camera == b.camera
            np.testing.assert_array_equal(a.keypoints, b.keypoints)
            np.testing.assert_array_equal(a.descriptors, b.descriptors)
            np.testing.assert_allclose(a.cam_from_world.R, b.cam_from_world.R, atol=1e-9)


def test_images_of_a_recording_are_read_by_name(flight: Flight, tmp_path: Path) -> None:
    path = write_foxglove(tmp_path / "a.mcap", foxglove_images(flight))
    for file, time_ns in zip(flight.files, flight.times_ns, strict=True):
        frame = read_frame(path, f"{TOPIC}/{time_ns + DELAY_NS}", CAMERA)
        np.testing.assert_array_equal(frame.image, read_gray(file))
    for name in (f"{TOPIC}/7", "/camera/calibration/0", TOPIC, "image.png"):
        with pytest.raises(SourceError, match=f"has no image {name}$"):
            read_frame(path, name, CAMERA)


def wrong(flight: Flight) -> dict[str, Messages]:
    """Return recordings by what is wrong with them."""
    info, *images = ros_images(flight)
    static, odometry = ros_static(), ros_odometry(times_of_poses())
    poses = [*static, *odometry]
    uncalibrated = layouts.ros_camera_info(CAMERA, START_NS) | {"k": [0.0] * 9}
    topic, kind, second, time_ns = odometry[2]
    zero = layouts.ros_pose(body(START_NS)) | {"orientation": dict.fromkeys("xyzw", 0.0)}
    no_rotation = second | {"pose": second["pose"] | {"pose": zero}}
    another = odometry[3][2] | {"header": second["header"]}
    nan = Rigid3(np.eye(3), np.array([0, np.nan, 0]))
    return {
        "no images": [info, *poses],
        "no poses": [info, *images, *static],
        "no calibration": [*images, *poses],
        "not calibrated": [(*info[:2], uncalibrated, START_NS), *images, *poses],
        "two at once": [info, *images, images[0], *poses],
        "two frames": [info, *images, (*ros_images(flight, "other")[1][:3], 7), *poses],
        "no way": [info, *images, *odometry],
        "two parents": [info, *images, *poses, *ros_tf("/tf", "map", "optical", [(7, START)])],
        "a circle": [info, *images, *poses, *ros_tf("/tf", "optical", "base_link", [(7, START)])],
        "no rotation": [info, *images, *poses, (topic, kind, no_rotation, time_ns)],
        "no place": [info, *images, *poses, *ros_tf("/tf", "a", "b", [(5, nan)])],
        "two poses": [info, *images, *poses, (topic, kind, another, time_ns)],
    }


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no images", "has no images of a known type"),
        ("no poses", "has no poses of a known type"),
        ("no calibration", "no calibration for the images on /camera/image"),
        ("not calibrated", "the camera was never calibrated"),
        ("two at once", "two images on /camera/image arrived at 1305031102205304000 ns"),
        ("two frames", "the images on /camera/image are of 2 frames"),
        ("no way", "no transforms lead from base_link to the frame of the images"),
        (
            "two parents",
            "the frame optical sits on map and, at .* ns on /tf_static, on camera_link",
        ),
        ("a circle", "the frame .* sits on itself"),
        ("no rotation", "the pose on /odom at 1305031102315304000 ns: the quaternion .* not one"),
        ("no place", "the transform of b at 5 ns: the pose .* is not finite"),
        ("two poses", "there are two different poses at 1305031102315304000 ns"),
    ],
)
def test_what_is_wrong_in_a_recording_is_said(
    flight: Flight, tmp_path: Path, what: str, said: str
) -> None:
    path = write_ros(tmp_path / "a.mcap", wrong(flight)[what])
    with pytest.raises(TrigpointError, match=rf"a\.mcap.*{said}") as caught:
        read_dataset(path)
    assert "\n" not in str(caught.value)


def test_a_camera_that_moves_on_its_mount_is_said(flight: Flight, tmp_path: Path) -> None:
    gimbal = ros_tf("/tf", "base_link", "optical", [(t, BODY_FROM_CAM) for t in range(3)])
    messages = [*ros_images(flight), *gimbal, *ros_odometry(times_of_poses())]
    path = write_ros(tmp_path / "a.mcap", messages)
    with pytest.raises(ConfigError, match="the camera 'optical' moves on base_link; name another"):
        read_dataset(path, pose_topic="/odom")


@pytest.mark.parametrize("mount", ["1 2 3 1 0 0 x", "1 2 3 0 0 0 0", "gripper"])
def test_a_mount_that_is_none_is_said(flight: Flight, tmp_path: Path, mount: str) -> None:
    messages = [*ros_images(flight), *ros_static(), *ros_poses(times_of_poses())]
    path = write_ros(tmp_path / "a.mcap", messages)
    with pytest.raises(ConfigError, match=r"--mount|lead from gripper to the frame"):
        read_dataset(path, mount=mount)


Damage = Callable[[bytes], bytes]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: b"", "is empty"),
        (lambda data: b"no recording at all", "cannot be read"),
        (lambda data: data[: len(data) // 2], "try `trigpoint-db recover`"),
        (lambda data: data[:200] + bytes(200) + data[400:], "try `trigpoint-db recover`"),
    ],
)
def test_a_damaged_recording_is_said(
    flight: Flight, tmp_path: Path, damage: Damage, said: str
) -> None:
    path = write_ros(tmp_path / "a.mcap", [*ros_images(flight), *ros_odometry(times_of_poses())])
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(SourceError, match=said) as caught:
        read_dataset(path)
    assert "\n" not in str(caught.value)


def test_an_image_that_cannot_be_decoded_is_named(flight: Flight, tmp_path: Path) -> None:
    info, image, *_ = ros_images(flight)
    image[2]["encoding"] = "mono12"
    path = write_ros(tmp_path / "a.mcap", [info, image])
    name = f"{TOPIC}/{image[3]}"
    with pytest.raises(SourceError, match=rf"{name}: image encoding 'mono12' is not supported"):
        read_frame(path, name, CAMERA)
    small = Camera("PINHOLE", 32, 24, (25.0, 25.0, 15.5, 11.5))
    image[2]["encoding"] = "bgr8"
    path = write_ros(tmp_path / "b.mcap", [info, image])
    with pytest.raises(ConfigError, match=rf"b\.mcap: {name}: the image is 320 x 240"):
        read_frame(path, name, small)
