"""Recordings made of image files, read by mcap's own reader."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.recording import RecordedImage, write_recording

START_NS = 1_700_000_000 * 10**9
CAMERA = Camera("OPENCV", 32, 24, (30, 31, 15.5, 11.5, 0.1, -0.02, 0.003, -0.004))


def write_images(folder: Path, count: int, suffix: str = ".png") -> list[Path]:
    """Write images of different gray levels."""
    paths = [folder / f"{i:03d}{suffix}" for i in range(count)]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((24, 32), 10 * i, np.uint8))
    return paths


def read(path: Path) -> list[tuple[str, int, Any]]:
    """Read topic, log time and decoded message of a whole recording."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]


def test_a_recording_holds_the_files_as_they_are_at_their_times(tmp_path: Path) -> None:
    paths = write_images(tmp_path, 2, ".png") + write_images(tmp_path, 1, ".JPG")
    out = tmp_path / "out.mcap"
    images = [RecordedImage(path, CAMERA) for path in paths]
    assert write_recording(out, images, rate_hz=4) == 3
    found = [(time, m) for topic, time, m in read(out) if topic == "/camera/image"]
    assert [time - START_NS for time, _ in found] == [0, 250_000_000, 500_000_000]
    assert [m.timestamp.ToNanoseconds() for _, m in found] == [time for time, _ in found]
    assert [m.data for _, m in found] == [path.read_bytes() for path in paths]
    assert [m.format for _, m in found] == ["png", "png", "jpeg"]


def test_a_calibration_precedes_each_change_of_the_camera(tmp_path: Path) -> None:
    fisheye = Camera("OPENCV_FISHEYE", 32, 24, (30, 31, 15.5, 11.5, 0.1, 0.2, 0.3, 0.4))
    rational = Camera("FULL_OPENCV", 32, 24, (30, 31, 15.5, 11.5, *range(1, 9)))
    paths = write_images(tmp_path, 5)
    cameras = [CAMERA, CAMERA, fisheye, CAMERA, rational]
    out = tmp_path / "out.mcap"
    write_recording(out, map(RecordedImage, paths, cameras))
    found = read(out)
    kinds = [topic.removeprefix("/camera/")[0] for topic, _, _ in found]
    assert "".join(kinds) == "ciicicici"
    first, second, third, fourth = (m for topic, _, m in found if topic == "/camera/calibration")
    assert first.distortion_model == third.distortion_model == "plumb_bob"
    assert list(first.D) == [0.1, -0.02, 0.003, -0.004, 0]
    assert list(first.K) == [30, 0, 15.5, 0, 31, 11.5, 0, 0, 1]
    assert (first.width, first.height) == (32, 24)
    assert second.distortion_model == "kannala_brandt"
    assert list(second.D) == [0.1, 0.2, 0.3, 0.4]
    assert fourth.distortion_model == "rational_polynomial"
    assert list(fourth.D) == [1, 2, 3, 4, 5, 6, 7, 8]


def test_the_truth_is_where_the_camera_stood(tmp_path: Path) -> None:
    cam_from_world = Rigid3.from_quaternion([0.5, -0.1, 0.7, 0.2], [1.0, 2.0, 3.0])
    [path] = write_images(tmp_path, 1)
    out = tmp_path / "out.mcap"
    write_recording(out, [RecordedImage(path, CAMERA, cam_from_world)])
    [truth] = [m for topic, _, m in read(out) if topic == "/truth"]
    p, q = truth.pose.position, truth.pose.orientation
    world_from_cam = Rigid3.from_quaternion([q.w, q.x, q.y, q.z], [p.x, p.y, p.z])
    assert np.allclose(world_from_cam.t, cam_from_world.center)
    assert np.allclose(world_from_cam.R, cam_from_world.R.T)


def test_the_same_images_give_the_same_bytes(tmp_path: Path) -> None:
    images = [RecordedImage(path, CAMERA, Rigid3.identity()) for path in write_images(tmp_path, 3)]
    write_recording(tmp_path / "a.mcap", images)
    write_recording(tmp_path / "b.mcap", images)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_failure_leaves_nothing_half_written(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    [path] = write_images(tmp_path, 1)

    def interrupted() -> Iterator[RecordedImage]:
        yield RecordedImage(path, CAMERA)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_recording(out, interrupted())
    assert [p.name for p in tmp_path.iterdir()] == ["000.png"]


@pytest.mark.parametrize(
    ("name", "complaint"), [("missing.png", "missing.png"), ("image.tiff", "convert it")]
)
def test_an_image_that_cannot_be_recorded_is_named(
    tmp_path: Path, name: str, complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        write_recording(tmp_path / "out.mcap", [RecordedImage(tmp_path / name, CAMERA)])
    assert list(tmp_path.iterdir()) == []


def test_a_recording_of_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no images"):
        write_recording(tmp_path / "out.mcap", [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan")])
def test_a_rate_must_be_positive(tmp_path: Path, rate_hz: float) -> None:
    with pytest.raises(ConfigError, match="not possible"):
        write_recording(tmp_path / "out.mcap", [], rate_hz=rate_hz)


@pytest.mark.parametrize("name", ["missing/out.mcap", "file/out.mcap"])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=name):
        write_recording(tmp_path / name, [])
