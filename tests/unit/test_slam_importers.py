"""TUM, EuRoC, transforms.json and kapture, written from a rendered room, come back as they were."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit.layouts import POSES, View, check_truth
from tests.unit.slam_layouts import (
    kapture_pose,
    write_euroc,
    write_instant_ngp,
    write_kapture,
    write_nerf_synthetic,
    write_nerfstudio,
    write_tum,
)
from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.importers.registry import find_format, read_dataset

FR1 = Camera(
    "FULL_OPENCV", 640, 480,
    (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0, 0, 0),
)  # fmt: skip
EUROC = Camera(
    "OPENCV", 752, 480,
    (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)  # fmt: skip
LENS = Camera("OPENCV", 320, 240, (250.0, 252.0, 158.2, 121.7, -0.1, 0.03, 0.002, -0.001))
FISHEYE = Camera(
    "OPENCV_FISHEYE", 320, 240, (160.0, 161.0, 157.5, 120.1, 0.01, -0.02, 0.003, 0.001)
)
PINHOLE = Camera("PINHOLE", 320, 240, (260.0, 262.0, 161.0, 117.0))

Sequence = tuple[Path, dict[str, View]]


@pytest.fixture(scope="module")
def tum(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    root = tmp_path_factory.mktemp("tum") / "rgbd_dataset_freiburg1_room"
    return root, write_tum(root, FR1)


@pytest.fixture(scope="module")
def euroc(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    root = tmp_path_factory.mktemp("euroc") / "V1_01_easy"
    return root, write_euroc(root, EUROC)


@pytest.fixture(scope="module")
def nerfstudio(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    root = tmp_path_factory.mktemp("nerfstudio")
    return root, write_nerfstudio(root, PINHOLE)


@pytest.fixture(scope="module")
def kapture(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    root = tmp_path_factory.mktemp("kapture")
    return root, write_kapture(root, [LENS, PINHOLE], posed=2)


def copy_of(root: Path, to: Path) -> Path:
    """Copy a data set, but for its images, to do harm to it."""
    for path in root.rglob("*"):
        if path.suffix in (".csv", ".json", ".txt", ".yaml"):
            copy = to / path.relative_to(root)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    return to


def check(dataset: Dataset, views: Mapping[str, View], mapped: set[str], tested: set[str]) -> None:
    assert {image.name for image in dataset.mapped} == mapped
    assert {query.name for query in dataset.queries} == tested
    check_truth(dataset.mapped, views)
    cameras = {query.name: query.camera for query in dataset.queries}
    truth = [PosedImage(name, cameras[name], pose) for name, pose in dataset.truth.items()]
    check_truth([*dataset.mapped, *truth], views)
    for name in (*mapped, *tested):
        assert (dataset.images / name).is_file()


def edited(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_tum_has_poses_between_those_of_the_motion_capture_and_none_in_its_gaps(
    tum: Sequence,
) -> None:
    root, views = tum
    assert find_format(root) == "tum"
    dataset = read_dataset(root)
    names = sorted(views)
    # One is before the first pose, one in the part without any.
    check(dataset, views, {names[1], names[2], names[4], names[5]}, set())
    assert dataset.num_unposed == 2
    assert {image.camera for image in dataset.mapped} == {FR1}


def test_a_longer_gap_is_bridged_where_it_is_allowed(tum: Sequence) -> None:
    root, views = tum
    check(read_dataset(root, max_gap=1.0), views, set(sorted(views)[1:]), set())
    with pytest.raises(ConfigError, match=r"rgb\.txt: none of the 6 images .* --max-gap"):
        read_dataset(root, max_gap=0.01)


def test_the_camera_of_tum_is_that_of_the_folder_or_as_said(tum: Sequence, tmp_path: Path) -> None:
    room = copy_of(tum[0], tmp_path / "room")
    with pytest.raises(ConfigError, match="tell the camera of the sequence; say --camera freib"):
        read_dataset(room)
    third = read_dataset(room, camera="freiburg3").mapped[0].camera
    assert third == Camera("PINHOLE", 640, 480, (535.4, 539.2, 320.1, 247.6))
    own = read_dataset(room, camera="SIMPLE_PINHOLE 640 480 500 320 240").mapped[0].camera
    assert own == Camera("SIMPLE_PINHOLE", 640, 480, (500, 319.5, 239.5))
    with pytest.raises(ConfigError, match="cannot read a camera from 'freiburg4'"):
        read_dataset(room, camera="freiburg4")


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("rgb.txt", "1305031110.1", r"rgb\.txt:10: expected 'time file'"),
        ("rgb.txt", "1e999 rgb/a.png", r"rgb\.txt:10: '1e999' is no time"),
        ("rgb.txt", "-1 rgb/a.png", r"rgb\.txt:10: '-1' is no time"),
        ("rgb.txt", "soon rgb/a.png", r"rgb\.txt:10: 'soon' is no time"),
        ("groundtruth.txt", "1305031110.1 1 2 3 0 0 0", r"groundtruth\.txt:21: expected 'time tx"),
        ("groundtruth.txt", "1305031110.1 1 2 x 0 0 0 1", r"groundtruth\.txt:21: expected 'time"),
        ("groundtruth.txt", "1305031110.1 1 2 3 0 0 0 0", r":21: the quaternion .* is not one"),
        ("groundtruth.txt", "1305031110.1 1 nan 3 0 0 0 1", r":21: the pose .* is not finite"),
        ("groundtruth.txt", "nan 1 2 3 0 0 0 1", r":21: 'nan' is no time"),
        ("groundtruth.txt", "1305031104.3200 1 2 3 0 0 0 1", r"two different poses at 13050311043"),
    ],
)
def test_a_line_of_tum_that_cannot_be_read_is_named(
    tum: Sequence, tmp_path: Path, file: str, line: str, message: str
) -> None:
    root = copy_of(tum[0], tmp_path / "fr1_room")
    (root / file).write_text((root / file).read_text() + line + "\n")
    with pytest.raises(ConfigError, match=message) as caught:
        read_dataset(root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("file", ["rgb.txt", "groundtruth.txt"])
def test_a_file_of_tum_without_a_line_is_an_error(tum: Sequence, tmp_path: Path, file: str) -> None:
    copy_of(tum[0], tmp_path)
    (tmp_path / file).write_text("# nothing\n")
    with pytest.raises(ConfigError, match=rf"{file} (names|holds) no"):
        read_dataset(tmp_path, camera="freiburg1")


@pytest.mark.parametrize("place", [".", "mav0", "mav0/cam0"])
def test_euroc_has_the_camera_and_not_the_body(euroc: Sequence, place: str) -> None:
    root, views = euroc
    assert find_format(root / place) == "euroc"
    dataset = read_dataset(root / place)
    names = sorted(views)
    check(dataset, views, set(names[1:]), set())  # the first is before the first pose
    assert dataset.num_unposed == 1
    assert {image.camera for image in dataset.mapped} == {EUROC}


def test_euroc_with_a_fisheye(tmp_path: Path) -> None:
    views = write_euroc(tmp_path, FISHEYE)
    assert read_dataset(tmp_path).mapped[0].camera == FISHEYE
    check_truth(read_dataset(tmp_path).mapped, views)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cam0/data.csv", ",1305031102676538567.png", "", r"data\.csv:3: expected 'time,file'"),
        ("cam0/data.csv", "1305031102676538567,", "1.5,", r"data\.csv:3: '1.5' is no time"),
        ("cam0/sensor.yaml", "pinhole", "omni", "a camera of the model 'omni'"),
        ("cam0/sensor.yaml", "radial-tangential", "fov", "with the distortion 'fov' is not"),
        ("cam0/sensor.yaml", "[752, 480]", "[752]", "resolution has to be a list of 2 numbers"),
        ("cam0/sensor.yaml", "[752, 480]", "[0, 480]", "camera size 0 x 480 is not usable"),
        ("cam0/sensor.yaml", "458.654", "wide", "intrinsics has to be a list of 4 numbers"),
        ("cam0/sensor.yaml", "-0.999880929698", "0.3", "T_BS: the matrix is no rigid transform"),
        ("cam0/sensor.yaml", "T_BS", "T_SB", "T_BS: data has to be a list of 16 numbers"),
        ("cam0/sensor.yaml", "[752, 480]", "[752, 480", "cannot read .*yaml: it is not YAML"),
        (
            "state_groundtruth_estimate0/data.csv",
            "1305031102180304000,",
            "",
            r":2: '-.*' is no time",
        ),
        ("state_groundtruth_estimate0/data.csv", "4000,", "4000,x,", r":2: expected 'time,px"),
    ],
)
def test_what_is_wrong_in_euroc_is_named(
    euroc: Sequence, tmp_path: Path, file: str, old: str, new: str, message: str
) -> None:
    copy_of(euroc[0], tmp_path)
    edited(tmp_path / "mav0" / file, old, new)
    with pytest.raises(ConfigError, match=message) as caught:
        read_dataset(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("camera", "scale"),
    [(LENS, 1.0), (FISHEYE, 1.0), (PINHOLE, 2.5)],
    ids=["lens", "fish", "scale"],
)
def test_nerfstudio_comes_back_to_the_world_of_the_survey(
    camera: Camera, scale: float, tmp_path: Path
) -> None:
    views = write_nerfstudio(tmp_path, camera, scale)
    assert find_format(tmp_path) == "transforms"
    dataset = read_dataset(tmp_path)
    check(dataset, views, set(views), set())
    assert {image.camera.model for image in dataset.mapped} == {camera.model}


def test_images_that_nerfstudio_holds_out_are_queries(nerfstudio: Sequence) -> None:
    root, views = nerfstudio
    names, path = sorted(views), root / "held_out.json"
    contents = json.loads((root / "transforms.json").read_text())
    contents |= {"train_filenames": names[:2], "val_filenames": [], "test_filenames": names[2:]}
    path.write_text(json.dumps(contents))
    check(read_dataset(path), views, set(names[:2]), set(names[2:]))
    contents["test_filenames"] = ["images/none.png"]
    path.write_text(json.dumps(contents))
    with pytest.raises(ConfigError, match=r"none\.png is listed for val or test but has no frame"):
        read_dataset(path)


def test_instant_ngp_has_intrinsics_of_each_frame_and_paths_without_suffix(tmp_path: Path) -> None:
    views = write_instant_ngp(tmp_path, [LENS, FISHEYE, PINHOLE])
    dataset = read_dataset(tmp_path / "transforms.json")
    check(dataset, views, {"images/0.png", "images/1.jpg", "images/2.png"}, set())


def test_nerf_synthetic_has_an_angle_of_view_and_the_size_of_its_images(tmp_path: Path) -> None:
    views = write_nerf_synthetic(tmp_path)
    assert find_format(tmp_path) == "transforms"
    mapped = {name for name in views if name.startswith("train")}
    dataset = read_dataset(tmp_path)
    check(dataset, views, mapped, set(views) - mapped)
    assert set(dataset.truth) == set(views) - mapped


Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("frames"), "there is no list of frames"),
        (lambda c: c.update(frames=[1]), "there is no list of frames"),
        (lambda c: c["frames"].append(c["frames"][0]), r"images/frame_00001\.png is there twice"),
        (lambda c: c["frames"][1].pop("file_path"), "frame 1: file_path has to be"),
        (
            lambda c: c["frames"][1].pop("transform_matrix"),
            r"frame 1 \(images/frame_00002\.png\): ",
        ),
        (lambda c: c["frames"][1]["transform_matrix"][0].pop(), "frame 1 .* 16 numbers"),
        (lambda c: c["frames"][1]["transform_matrix"][0].append("a"), "frame 1 .* 16 numbers"),
        (
            lambda c: c["frames"][1]["transform_matrix"][3].__setitem__(3, 0.01),
            "frame 1 .* 0 0 0 1",
        ),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, np.nan), "not finite"),
        (lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(0, "a"), "not finite"),
        (lambda c: c["applied_transform"][0].__setitem__(0, -1.0), "applied_transform: the matrix"),
        (lambda c: c.update(applied_scale=0), "applied_scale 0.0 has to be positive"),
        (lambda c: c.update(applied_scale="big"), "applied_scale has to be a number, not 'big'"),
        (lambda c: c.update(fl_x="wide"), r"frame 0 .*: fl_x has to be a number"),
        (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "frame 0 .*: neither fl_x nor camera_angle_x"),
        (lambda c: c.update(x_fov=180), "frame 0 .* rad is no angle of view"),
        (lambda c: c.update(camera_model="EQUIRECTANGULAR"), "a EQUIRECTANGULAR lens are not"),
        (lambda c: c.update(ftheta_p0=0.1), "images of a ftheta_p0 lens are not supported"),
        (lambda c: c.update(k4=0.1), "k4 of a lens that is no fisheye"),
        (lambda c: c.update(w=0), "frame 0 .*: camera size 0 x 240 is not usable"),
        (lambda c: c.update(test_filenames="a"), "test_filenames has to be a list of names"),
    ],
)
def test_what_is_wrong_in_a_transforms_file_is_named(
    nerfstudio: Sequence, tmp_path: Path, change: Change, message: str
) -> None:
    path = copy_of(nerfstudio[0], tmp_path) / "transforms.json"
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents))
    with pytest.raises(ConfigError, match=message) as caught:
        read_dataset(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{\n'a'}", r"transforms\.json:2: it is not JSON"),
        ("[" * 100_000, "it is not JSON"),
        ("[]", "there is no list of frames"),
        ("\0", "it is not JSON"),
    ],
)
def test_what_is_no_json_is_said(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_dataset(tmp_path)


def test_kapture_has_poses_of_rigs_on_rigs(kapture: Sequence) -> None:
    root, views = kapture
    assert find_format(root) == "kapture"
    unposed = {"mapping/left/00002.png", "mapping/right/00002.png"}
    dataset = read_dataset(root)
    check(dataset, views, set(views) - unposed, unposed)
    assert dataset.truth == {}


def test_a_kapture_of_two_has_queries_and_their_truth(kapture: Sequence, tmp_path: Path) -> None:
    root, mapped = kapture
    (tmp_path / "mapping").symlink_to(root)
    asked = write_kapture(tmp_path / "query", [PINHOLE, FISHEYE], posed=2)
    assert find_format(tmp_path) == "kapture"
    dataset = read_dataset(tmp_path)
    views = {f"mapping/sensors/records_data/{name}": view for name, view in mapped.items()}
    posed = {name for name in views if "00002" not in name}
    queries = {f"query/sensors/records_data/{name}": view for name, view in asked.items()}
    check(dataset, views | queries, posed, set(queries))
    assert dataset.num_unposed == 2
    assert len(dataset.truth) == len(queries) - 2


def test_kapture_images_of_an_uncalibrated_camera_are_left_out_or_named(
    kapture: Sequence, tmp_path: Path
) -> None:
    sensors = copy_of(kapture[0], tmp_path) / "sensors"
    records, cameras = sensors / "records_camera.txt", sensors / "sensors.txt"
    cameras.write_text(cameras.read_text() + "web, , camera, UNKNOWN_CAMERA, 640, 480\n")
    records.write_text(records.read_text() + "99, web, web/a.jpg\n")
    assert read_dataset(tmp_path).num_unposed == 1
    trajectories = sensors / "trajectories.txt"
    trajectories.write_text(trajectories.read_text() + f"99, web, {kapture_pose(POSES[0])}\n")
    with pytest.raises(ConfigError, match=r"records_camera\.txt:9: the camera web is an UNKNOWN"):
        read_dataset(tmp_path)


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("sensors.txt", "left, , camera, PINHOLE, 1, 1, 1, 1, 0, 0", "8: the sensor left is in"),
        ("sensors.txt", "web, , camera, FOV, 1, 1, 1, 1, 0, 0, 0", "8: camera model 'FOV'"),
        ("sensors.txt", "web, , camera", "8: cannot read a camera from ''"),
        ("sensors.txt", "web, ", "8: expected 'sensor_device_id, name, sensor_type', not 'web,'"),
        ("records_camera.txt", "0, left", "9: expected 'timestamp, device_id, image_path'"),
        ("records_camera.txt", "0, web, a.jpg", "9: there is no camera web in"),
        ("records_camera.txt", "0, gps1, a.jpg", "9: there is no camera gps1 in"),
        ("records_camera.txt", "0, left, alone.png", r"9: alone\.png is in this file twice"),
        ("records_camera.txt", "0.5, left, a.jpg", "9: the timestamp '0.5' is not an integer"),
        ("trajectories.txt", "7, phone, 1, 0, 0, 0, 0, 0, 0", "5: phone has two poses at 7"),
        ("trajectories.txt", "8, phone, 1, 0, 0, 0, 0, 0", "5: expected 'timestamp, device_id, qw"),
        ("trajectories.txt", "8, phone, 1, 0, 0, x, 0, 0, 0", "5: expected qw, qx"),
        ("trajectories.txt", "8, phone, 0, 0, 0, 0, 0, 0, 0", "5: the quaternion"),
        ("trajectories.txt", "8, phone, 1, 0, 0, 0, inf, 0, 0", "5: the pose .* not finite"),
        ("rigs.txt", "car, left, 1, 0, 0, 0, 0, 0", "6: expected 'rig_device_id, sensor_device"),
    ],
)
def test_a_line_of_kapture_that_cannot_be_read_is_named(
    kapture: Sequence, tmp_path: Path, file: str, line: str, message: str
) -> None:
    path = copy_of(kapture[0], tmp_path) / "sensors" / file
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(ConfigError, match=rf"{file}:{message}") as caught:
        read_dataset(tmp_path)
    assert "\n" not in str(caught.value)


def test_rigs_that_sit_on_one_another_lead_nowhere(kapture: Sequence, tmp_path: Path) -> None:
    rigs = copy_of(kapture[0], tmp_path) / "sensors" / "rigs.txt"
    rigs.write_text(rigs.read_text() + "rig, car, 1, 0, 0, 0, 0, 0, 0\n")
    assert len(read_dataset(tmp_path).queries) == 2  # the place that the car has no pose of


def test_the_check_of_these_tests_notices_a_clock_that_is_off(
    tum: Sequence, tmp_path: Path
) -> None:
    """By 10 ms, in which the camera moves 3 mm."""
    root, views = tum
    copy_of(root, tmp_path)
    rows = [f"{float(name[4:-4]) + 0.01:.6f} {name}" for name in sorted(views)]
    (tmp_path / "rgb.txt").write_text("\n".join(rows))
    images = read_dataset(tmp_path, camera="freiburg1").mapped
    assert len(images) > 1
    with pytest.raises(AssertionError):
        check_truth(images, views)
