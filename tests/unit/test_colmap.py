"""COLMAP models: text as its documentation shows it, binary from a writer of our own."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trigpoint.camera import PARAMETERS, Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3, rotation_from_vector
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model, write_model

quick = settings(max_examples=25)

CAMERAS_TEXT = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 2
1 SIMPLE_PINHOLE 640 480 525.505 320 240
7 OPENCV 576 1024 733.5 733.25 295.5 514.5 0.05 -0.08 -0.001 0.0002
"""
# The second and the third image have no points, and the third has no line for them.
IMAGES_TEXT = """\
# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 3, mean observations per image: 1
12 0.5 0.5 0.5 0.5 1 2 3 7 left/b  two.jpg
2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1
3 -2 0 0 0 -0.25 1e-3 0 1 left/a.jpg

40 0 1 0 0 0 0 0 1 right/#c.jpg
"""
IMAGE_LINE = "1 1 0 0 0 0 0 0 1 a.jpg"

Image = tuple[int, tuple[float, ...], int, bytes, int]  # id, pose, camera id, name, num_points2D
ROWS: list[Image] = [
    (12, (0.5, 0.5, 0.5, 0.5, 1, 2, 3), 7, b"left/b  two.jpg", 3),
    (3, (-2, 0, 0, 0, -0.25, 1e-3, 0), 1, b"left/a.jpg", 0),
    (40, (0, 1, 0, 0, 0, 0, 0), 1, b"right/#c.jpg", 1000),
]
SIMPLE_PINHOLE = (1, 0, 640, 480, (525.505, 320.0, 240.0))
OPENCV = (7, 4, 576, 1024, (733.5, 733.25, 295.5, 514.5, 0.05, -0.08, -0.001, 0.0002))


def pack_cameras(*cameras: tuple[int, int, int, int, tuple[float, ...]]) -> bytes:
    """Write cameras.bin as COLMAP's documentation lays it out."""
    data = struct.pack("<Q", len(cameras))
    for camera_id, model_id, width, height, params in cameras:
        data += struct.pack("<IiQQ", camera_id, model_id, width, height)
        data += struct.pack(f"<{len(params)}d", *params)
    return data


def pack_images(*images: Image) -> bytes:
    """Write images.bin likewise, each with some 2D points."""
    data = struct.pack("<Q", len(images))
    for image_id, pose, camera_id, name, num_points in images:
        data += struct.pack("<I7dI", image_id, *pose, camera_id) + name + b"\0"
        data += struct.pack("<Q", num_points)
        for i in range(num_points):
            data += struct.pack("<ddQ", 10.5 + i, 20.25, 2**64 - 1 if i % 2 else i)
    return data


def write_text_files(folder: Path, cameras: str = CAMERAS_TEXT, images: str = IMAGES_TEXT) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(cameras, encoding="utf-8")
    (folder / "images.txt").write_text(images, encoding="utf-8")
    return folder


def write_binary_files(
    folder: Path,
    cameras: bytes = pack_cameras(OPENCV, SIMPLE_PINHOLE),
    images: bytes = pack_images(*ROWS),
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(images)
    return folder


def check_model(images: list[PosedImage]) -> None:
    """Compare with what the texts above say."""
    a, b, c = images
    assert [image.name for image in images] == ["left/a.jpg", "left/b  two.jpg", "right/#c.jpg"]
    assert a.camera == c.camera == Camera("SIMPLE_PINHOLE", 640, 480, (525.505, 319.5, 239.5))
    assert b.camera.params == (733.5, 733.25, 295.0, 514.0, 0.05, -0.08, -0.001, 0.0002)
    np.testing.assert_allclose(a.cam_from_world.R, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(a.cam_from_world.t, [-0.25, 1e-3, 0])
    # (0.5, 0.5, 0.5, 0.5) turns x into y, y into z and z into x.
    np.testing.assert_allclose(b.cam_from_world.apply(np.array([4, 5, 6])), [7, 6, 8], atol=1e-15)
    np.testing.assert_allclose(c.cam_from_world.R, np.diag([1, -1, -1]), atol=1e-15)


def test_a_text_model_is_read_with_its_comments_and_empty_lines(tmp_path: Path) -> None:
    check_model(read_model(write_text_files(tmp_path)))


def test_windows_line_ends_make_no_difference(tmp_path: Path) -> None:
    model = write_text_files(
        tmp_path, CAMERAS_TEXT.replace("\n", "\r\n"), IMAGES_TEXT.replace("\n", "\r\n")
    )
    check_model(read_model(model))


def test_a_binary_model_is_read_and_its_2d_points_are_skipped(tmp_path: Path) -> None:
    check_model(read_model(write_binary_files(tmp_path)))


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_a_model_is_found_where_colmap_puts_it(tmp_path: Path, place: str) -> None:
    (tmp_path / "sparse").mkdir()
    write_text_files(tmp_path / place)
    check_model(read_model(tmp_path))


def test_binary_files_come_before_text_files(tmp_path: Path) -> None:
    write_text_files(tmp_path, "not a camera", "not an image")
    check_model(read_model(write_binary_files(tmp_path)))


def test_half_a_binary_model_is_no_model(tmp_path: Path) -> None:
    (write_text_files(tmp_path) / "cameras.bin").write_bytes(b"")
    check_model(read_model(tmp_path))


def test_other_files_of_a_model_are_not_looked_at(tmp_path: Path) -> None:
    for name in ("rigs.bin", "frames.bin", "points3D.bin", "project.ini"):
        (tmp_path / name).write_bytes(b"?")
    check_model(read_model(write_binary_files(tmp_path)))


@pytest.mark.parametrize(
    ("model_id", "model"),
    [
        (0, "SIMPLE_PINHOLE"),
        (1, "PINHOLE"),
        (2, "SIMPLE_RADIAL"),
        (3, "RADIAL"),
        (4, "OPENCV"),
        (5, "OPENCV_FISHEYE"),
        (6, "FULL_OPENCV"),
    ],
)
def test_every_camera_model_has_colmaps_number(tmp_path: Path, model_id: int, model: str) -> None:
    params = tuple(
        {"cx": 320.5, "cy": 240.5}.get(name, 500.0 if name.startswith("f") else 0.01 * i)
        for i, name in enumerate(PARAMETERS[model])
    )
    camera = (1, model_id, 640, 480, params)
    pose = (1.0, 0, 0, 0, 0, 0, 0)
    write_binary_files(tmp_path, pack_cameras(camera), pack_images((1, pose, 1, b"a", 0)))
    assert read_model(tmp_path)[0].camera == Camera.from_colmap(model, 640, 480, params)


def test_an_empty_model_has_no_images(tmp_path: Path) -> None:
    assert read_model(write_text_files(tmp_path / "text", "", "")) == []
    empty = struct.pack("<Q", 0)
    assert read_model(write_binary_files(tmp_path / "binary", empty, empty)) == []


def test_a_folder_without_a_model_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no folder .*missing"):
        read_model(tmp_path / "missing")
    with pytest.raises(ConfigError, match=r"no COLMAP model in .*its sparse or sparse/0"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1", "cannot read a camera"),
        ("one PINHOLE 640 480 500 500 320 240", "expected 'CAMERA_ID MODEL"),
        ("1 PINHOLE 640 480 500 500 320", "takes 4 parameters"),
        ("1 PINHOLE 640 480 500 500 320 nan", "must be finite"),
        ("1 FOV 640 480 500 500 320 240 0.9", "'FOV' is not known; use one of SIMPLE_PINHOLE, PIN"),
        ("7 PINHOLE 640 480 500 500 320 240", "camera 7 is in this file twice"),
    ],
)
def test_an_error_in_cameras_txt_names_its_line(tmp_path: Path, line: str, message: str) -> None:
    write_text_files(tmp_path, CAMERAS_TEXT + line)
    with pytest.raises(ConfigError, match=rf"cameras\.txt:6: .*{message}") as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 1 0 0 0 0 0 0 1", "expected 'IMAGE_ID QW"),
        ("1 1 0 0 0 0 0 zero 1 a.jpg", "expected 'IMAGE_ID QW"),
        ("1 1 0 0 0 0 0 0 0.5 a.jpg", "expected 'IMAGE_ID QW"),
        ("1 0 0 0 0 1 2 3 1 a.jpg", "quaternion 0.0 0.0 0.0 0.0 is not one of a rotation"),
        ("1 1e300 0 0 0 1 2 3 1 a.jpg", "is not one of a rotation"),
        ("1 1 0 0 nan 1 2 3 1 a.jpg", "is not finite"),
        ("1 1 0 0 0 1 inf 3 1 a.jpg", "is not finite"),
        ("1 1 0 0 0 0 0 0 2 a.jpg", r"image a\.jpg has camera 2, which is not in .*cameras\.txt"),
        ("1 1 0 0 0 0 0 0 1 left/a.jpg", "image left/a.jpg is in this file twice"),
    ],
)
def test_an_error_in_images_txt_names_its_line(tmp_path: Path, line: str, message: str) -> None:
    write_text_files(tmp_path, images=IMAGES_TEXT + "\n" + line)
    with pytest.raises(ConfigError, match=rf"images\.txt:11: .*{message}") as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["b.jpg", "b and c.jpg", "17"])
def test_a_model_whose_empty_lines_were_dropped_is_an_error(tmp_path: Path, name: str) -> None:
    write_text_files(tmp_path, images=f"{IMAGE_LINE}\n2 1 0 0 0 0 0 0 1 {name}\n")
    with pytest.raises(ConfigError, match=r"images\.txt:2: expected the 2D points of a\.jpg"):
        read_model(tmp_path)


def test_text_in_another_encoding_is_an_error(tmp_path: Path) -> None:
    (write_text_files(tmp_path) / "images.txt").write_bytes("é".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"images\.txt: it is not UTF-8"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("model_id", "model"),
    [
        (7, "FOV"),
        (8, "SIMPLE_RADIAL_FISHEYE"),
        (9, "RADIAL_FISHEYE"),
        (10, "THIN_PRISM_FISHEYE"),
        (17, "EQUIRECTANGULAR"),
        (18, "number 18"),
        (-1, "number -1"),
    ],
)
def test_a_foreign_binary_camera_model_is_named(tmp_path: Path, model_id: int, model: str) -> None:
    write_binary_files(tmp_path, pack_cameras((5, model_id, 640, 480, (500.0,) * 12)))
    with pytest.raises(ConfigError, match=rf"cameras\.bin: camera 5: .*'{model}' .*OPENCV_FISHEYE"):
        read_model(tmp_path)


def test_binary_files_cut_off_anywhere_are_errors(tmp_path: Path) -> None:
    cameras, images = pack_cameras(OPENCV, SIMPLE_PINHOLE), pack_images(*ROWS[:2])
    for end in range(len(cameras)):
        write_binary_files(tmp_path, cameras[:end], images)
        with pytest.raises(ConfigError, match=rf"cameras\.bin is cut off: it ends at byte {end}$"):
            read_model(tmp_path)
    for end in range(len(images)):
        write_binary_files(tmp_path, cameras, images[:end])
        with pytest.raises(ConfigError, match=rf"images\.bin is cut off: it ends at byte {end}$"):
            read_model(tmp_path)


def test_a_count_beyond_the_file_ends_with_the_file(tmp_path: Path) -> None:
    images = bytearray(pack_images(ROWS[1]))
    images[-8:] = struct.pack("<Q", 2**64 - 1)  # the number of 2D points
    write_binary_files(tmp_path, images=bytes(images))
    with pytest.raises(ConfigError, match="cut off"):
        read_model(tmp_path)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        ((1, (0, 0, 0, 0, 1, 2, 3), 1, b"a", 0), "image 1: the quaternion .*not one of a rotation"),
        ((1, (1, 0, 0, 0, np.nan, 2, 3), 1, b"a", 0), "image 1: .*not finite"),
        ((1, (1, 0, 0, 0, 1, 2, 3), 2, b"a", 0), "image 1: image a has camera 2"),
        ((1, (1, 0, 0, 0, 1, 2, 3), 1, b"\xff", 0), "is not UTF-8"),
        ((1, (1, 0, 0, 0, 1, 2, 3), 1, b"left/a.jpg", 0), "image left/a.jpg is in this file twice"),
    ],
)
def test_an_error_in_images_bin_names_the_image(tmp_path: Path, image: Image, message: str) -> None:
    write_binary_files(tmp_path, images=pack_images(ROWS[1], image))
    with pytest.raises(ConfigError, match=rf"images\.bin: .*{message}") as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


coordinates = st.floats(-1e3, 1e3)
cameras = st.builds(
    lambda focal, cx, cy: Camera("PINHOLE", 640, 480, (focal, focal + 1, cx, cy)),
    st.sampled_from([300.0, 512.125]),
    coordinates,
    coordinates,
)
poses = st.builds(
    lambda rotvec, t: Rigid3(rotation_from_vector(np.array(rotvec)), np.array(t)),
    st.tuples(*[st.floats(-4, 4)] * 3),
    st.tuples(*[coordinates] * 3),
)
names = st.text("ab/ #é_.1", min_size=1, max_size=8).filter(lambda name: name == name.strip())
models = st.lists(st.builds(PosedImage, names, cameras, poses), unique_by=lambda image: image.name)


@quick
@given(models)
def test_a_written_model_reads_back(
    tmp_path_factory: pytest.TempPathFactory, images: list[PosedImage]
) -> None:
    folder = tmp_path_factory.mktemp("model") / "sparse" / "0"
    write_model(folder, images)
    read = read_model(folder)
    for expected, image in zip(sorted(images, key=lambda i: i.name), read, strict=True):
        assert image.name == expected.name
        np.testing.assert_allclose(image.camera.params, expected.camera.params, atol=1e-12)
        R, t = expected.cam_from_world.R, expected.cam_from_world.t
        np.testing.assert_allclose(image.cam_from_world.R, R, atol=1e-14)
        np.testing.assert_array_equal(image.cam_from_world.t, t)


def test_equal_cameras_are_written_once(tmp_path: Path) -> None:
    one = Camera("PINHOLE", 640, 480, (500, 500, 319.5, 239.5))
    two = replace(one, width=641)
    pose = Rigid3.identity()
    images = [PosedImage(str(i), camera, pose) for i, camera in enumerate([one, two, replace(one)])]
    write_model(tmp_path, images)
    assert (tmp_path / "cameras.txt").read_text().splitlines() == [
        "1 PINHOLE 640 480 500.0 500.0 320.0 240.0",
        "2 PINHOLE 641 480 500.0 500.0 320.0 240.0",
    ]
    assert [image.camera for image in read_model(tmp_path)] == [one, two, one]


def test_a_written_model_is_complete_for_colmap(tmp_path: Path) -> None:
    write_model(tmp_path, [])
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == ["cameras.txt", "images.txt", "points3D.txt"]


@pytest.mark.parametrize("name", ["", " a", "a\nb", "a\0b", "twice"])
def test_a_name_that_would_not_read_back_is_not_written(tmp_path: Path, name: str) -> None:
    camera = Camera("PINHOLE", 640, 480, (500, 500, 319.5, 239.5))
    images = [PosedImage(n, camera, Rigid3.identity()) for n in ("twice", name)]
    with pytest.raises(ConfigError, match="cannot write the image name"):
        write_model(tmp_path, images)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"cannot write .*file/sparse"):
        write_model(tmp_path / "file" / "sparse", [])
