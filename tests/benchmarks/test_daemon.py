"""The measurements of the daemon on a real process, for seconds."""

import re
import select
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.daemon import overhead, soak
from benchmarks.daemon.daemon import Setup
from benchmarks.daemon.film import FilmKernel
from tests.conftest import Demo
from trigpoint.errors import ConfigError
from trigpointd.sources.video_device import RawFrame, VideoDevice

TIMEOUT_S = 30


def make_film(folder: Path, num_frames: int) -> Path:
    folder.mkdir()
    for i in range(num_frames):
        (folder / str(i)).write_bytes(bytes([i]) * 64)
    return folder


def take(device: VideoDevice) -> RawFrame:
    """Wait for a frame as the source does."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        assert select.select([device], [], [], TIMEOUT_S)[0]
        if (frame := device.dequeue()) is not None:
            return frame
    raise AssertionError("no frame came")


def test_a_film_is_played_there_and_back_at_its_pace(tmp_path: Path) -> None:
    with VideoDevice(make_film(tmp_path / "film", 3), FilmKernel()) as device:
        device.configure("YUYV", 8, 4, fps=100)
        device.start()
        frames = [take(device) for _ in range(12)]
    numbers = [frame.sequence for frame in frames]
    assert numbers == sorted(set(numbers))
    there_and_back = [0, 1, 2, 1]
    assert [frame.data[0] for frame in frames] == [there_and_back[n % 4] for n in numbers]
    stamps_ns = [frame.monotonic_ns or 0 for frame in frames]
    np.testing.assert_allclose(np.diff(stamps_ns), np.diff(numbers) * 1e7, atol=1000)
    assert all(stamp_ns < time.monotonic_ns() for stamp_ns in stamps_ns)


def test_frames_that_nobody_takes_are_lost_but_counted(tmp_path: Path) -> None:
    with VideoDevice(make_film(tmp_path / "film", 3), FilmKernel()) as device:
        device.configure("YUYV", 8, 4, fps=1000)
        device.start()
        first = take(device)
        begin_ns = time.monotonic_ns()
        while time.monotonic_ns() < begin_ns + 50_000_000:
            pass
        later = [take(device).sequence for _ in range(6)]
    assert later[-1] - first.sequence > 6


def test_a_film_that_is_taken_away_is_a_camera_unplugged(tmp_path: Path) -> None:
    film = make_film(tmp_path / "film", 3)
    with VideoDevice(film, FilmKernel()) as device:
        device.configure("YUYV", 8, 4, fps=100)
        device.start()
        take(device)
        film.rename(tmp_path / "away")
        with pytest.raises(OSError, match="No such device"):
            take(device)
    with pytest.raises(FileNotFoundError):
        VideoDevice(film, FilmKernel())


def test_a_folder_of_something_else_is_not_emptied(demo: Demo, tmp_path: Path) -> None:
    (tmp_path / "letter").write_text("precious")
    with pytest.raises(ConfigError, match="holds something else; name another folder"):
        soak.make_setup(demo.folder, tmp_path, fps=10).prepare(7447)
    assert (tmp_path / "letter").read_text() == "precious"


@pytest.mark.slow
@pytest.mark.parametrize("pixel_format", ["YUYV", "MJPG"])
def test_the_parts_of_the_overhead_add_up(demo: Demo, tmp_path: Path, pixel_format: str) -> None:
    parts = overhead.measure(Setup(demo.folder, tmp_path / "run", pixel_format, 30.0, {}), 5)
    total = parts["capture to pose"]
    assert len(total) == 5
    assert all((parts[name] > 0).all() for name in overhead.PARTS)
    np.testing.assert_allclose(sum(parts[name] for name in overhead.PARTS), total)
    np.testing.assert_allclose(parts[overhead.OVERHEAD] + parts[overhead.LOCALIZER], total)
    assert overhead.tabulate(parts).count("\n") == len(parts) + 1


@pytest.mark.slow
def test_a_short_run_with_all_that_befalls_it(demo: Demo, tmp_path: Path) -> None:
    records = soak.run(soak.make_setup(demo.folder, tmp_path / "run", fps=30), seconds=9)
    assert records.outcomes["LOCALIZED"] > 0
    assert set(records.outcomes) == {"LOCALIZED", "NO_FRAMES"}  # the camera is unplugged at times
    assert records.events == {
        "request answered": 10,
        "camera unplugged": 2,
        "reload asked for": 2,
    }
    assert len(records.samples) >= soak.MIN_SAMPLES - 1
    assert all(sample["Rss"] > sample["Anonymous"] > 0 for sample in records.samples)
    text = soak.report(records)
    assert re.search(r"\| own memory \(anonymous, MB\) \| [\d.]+ \| [\d.]+ \| [+-]", text)
    assert "request answered: 10" in text
