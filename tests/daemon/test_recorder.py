"""The log's thread: nobody waits for a disk, but for who asked to."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.logs import numbered, numbers_in
from trigpointd.config import LogConfig
from trigpointd.sinks.recorder import Recorder
from trigpointd.sinks.rolling_log import RollingLog

NUM_BYTES = 1_000_000
QUEUE = 32  # outputs of so many bytes that may wait


class Disk:
    """A clock that stands still while the disk hangs, and holds up the log's thread with it."""

    def __init__(self) -> None:
        self.responds = threading.Event()
        self.asked = threading.Event()
        self.responds.set()

    def __call__(self) -> float:
        self.asked.set()
        self.responds.wait()
        return time.monotonic()

    def hang(self) -> None:
        self.asked.clear()
        self.responds.clear()


@pytest.fixture(autouse=True)
def _slow_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trigpointd.sinks.recorder._CLOSE_S", 60.0)


@pytest.fixture
def disk() -> Iterator[Disk]:
    disk = Disk()
    yield disk
    disk.responds.set()


def make(path: Path, disk: Disk, *, lossless: bool = False) -> Recorder:
    return Recorder(RollingLog(LogConfig(path=path), "base", clock=disk), lossless=lossless)


def test_what_is_published_is_in_the_log(tmp_path: Path, disk: Disk) -> None:
    recorder = make(tmp_path / "log.mcap", disk)
    for i in range(100):
        recorder.publish(numbered(i, 1000))
    recorder.close()
    assert numbers_in(tmp_path / "log.mcap") == list(range(100))
    assert (recorder.problem, recorder.num_unlogged) == ("", 0)


def test_a_disk_that_hangs_costs_frames_of_the_log_alone(
    tmp_path: Path, disk: Disk, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = make(tmp_path / "log.mcap", disk)
    disk.hang()
    for i in range(2 * QUEUE):
        recorder.publish(numbered(i, NUM_BYTES // 2))  # returns, though nothing is written
    assert recorder.problem == "the disk is too slow"
    dropped = recorder.num_unlogged
    assert QUEUE - 2 < dropped <= QUEUE + 1
    disk.responds.set()
    recorder.close()
    assert (recorder.problem, recorder.num_unlogged) == ("", dropped)
    assert numbers_in(tmp_path / "log.mcap") == list(range(2 * QUEUE - dropped))
    assert [record.message for record in caplog.records] == [
        "the disk is too slow for the log; frames are left out of it",
        f"{dropped} frames are not in the log",
    ]


def test_a_replay_waits_for_the_disk(tmp_path: Path, disk: Disk) -> None:
    recorder = make(tmp_path / "log.mcap", disk, lossless=True)
    disk.hang()

    def publish() -> None:
        for i in range(2 * QUEUE):
            recorder.publish(numbered(i, NUM_BYTES // 2))

    publishing = threading.Thread(target=publish)
    publishing.start()
    assert disk.asked.wait(60)
    assert publishing.is_alive()
    disk.responds.set()
    publishing.join()
    recorder.close()
    assert numbers_in(tmp_path / "log.mcap") == list(range(2 * QUEUE))


def test_a_disk_that_hangs_does_not_hold_up_the_end(
    tmp_path: Path,
    disk: Disk,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("trigpointd.sinks.recorder._CLOSE_S", 0.1)
    recorder = make(tmp_path / "log.mcap", disk)
    disk.hang()
    recorder.publish(numbered(0))
    recorder.close()
    assert "too slow to finish the log; `trigpoint-db recover` can" in caplog.text


def test_what_waits_is_flushed_though_nothing_follows(tmp_path: Path) -> None:
    config = LogConfig(path=tmp_path / "log.mcap", flush_s=0.01)
    recorder = Recorder(RollingLog(config, "base"))
    before = (tmp_path / "log.mcap").stat().st_size
    recorder.publish(numbered(0))
    deadline_s = time.monotonic() + 60
    while (tmp_path / "log.mcap").stat().st_size == before:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    recorder.close()
