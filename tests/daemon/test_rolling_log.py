"""Logs in parts, disks that fill up, and folders that come and go."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.logs import numbered, numbers_in, numbers_in_unfinished
from trigpoint.errors import ConfigError, SourceError
from trigpointd.config import LogConfig
from trigpointd.sinks.log_files import LogFiles
from trigpointd.sinks.rolling_log import RollingLog


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def open_log(tmp_path: Path, clock: Clock) -> Iterator[Callable[..., RollingLog]]:
    """Open logs named log.mcap, and close them afterwards."""
    with contextlib.ExitStack() as stack:

        def open_(*, required: bool = False, inputs: tuple[Path, ...] = (), **settings: Any) -> Any:
            config = LogConfig(**{"path": tmp_path / "log.mcap", **settings})
            log = RollingLog(config, "base", clock=clock, required=required, inputs=inputs)
            stack.callback(log.close)
            return log

        yield open_


def part(folder: Path, number: int) -> Path:
    return folder / f"log.{number:06d}.mcap"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_log_without_limits_is_one_file(
    tmp_path: Path, open_log: Callable[..., RollingLog], clock: Clock
) -> None:
    log = open_log()
    for i in range(30):
        log.write(numbered(i, 50_000))
        clock.now_s += 1000
    log.close()
    assert names(tmp_path) == ["log.mcap"]
    assert numbers_in(tmp_path / "log.mcap") == list(range(30))


def test_a_part_ends_when_it_is_large(tmp_path: Path, open_log: Callable[..., RollingLog]) -> None:
    log = open_log(max_part_mb=1)
    for i in range(35):
        log.write(numbered(i, 50_000))  # of 100 kB
    log.close()
    parts = [numbers_in(path) for path in sorted(tmp_path.iterdir())]
    assert list(chain(*parts)) == list(range(35))
    assert names(tmp_path) == [part(tmp_path, i + 1).name for i in range(len(parts))]
    assert len(parts) == 3
    sizes = [path.stat().st_size for path in sorted(tmp_path.iterdir())]
    assert all(1e6 <= size < 1.5e6 for size in sizes[:-1])  # a chunk and the index over


def test_a_part_ends_when_its_time_is_up(
    tmp_path: Path, open_log: Callable[..., RollingLog], clock: Clock
) -> None:
    log = open_log(max_part_s=10)
    for i in range(25):
        log.write(numbered(i))
        clock.now_s += 1
    log.close()
    parts = [numbers_in(path) for path in sorted(tmp_path.iterdir())]
    assert parts == [list(range(11)), list(range(11, 22)), [22, 23, 24]]


def test_a_restart_begins_another_part_after_all_others(
    tmp_path: Path, open_log: Callable[..., RollingLog]
) -> None:
    part(tmp_path, 41).write_bytes(b"old")
    log = open_log(max_part_s=10)
    log.write(numbered(0))
    log.close()
    assert names(tmp_path) == ["log.000041.mcap", "log.000042.mcap"]


def test_only_the_logs_own_names_are_its_own(tmp_path: Path) -> None:
    files = LogFiles(tmp_path / "a.b-%Y%m%d-%H%M%S.mcap")
    for name in ("a.b-20260102-030405.mcap", "a.b-20260102-030405.000007.mcap"):
        assert files.owns(tmp_path / name)
    for name in (
        "a.b-20260102-030405.recovered.mcap",
        "a.b-20260102-030405.7.mcap",
        "axb-20260102-030405.mcap",
        "my-a.b-20260102-030405.mcap",
        "a.b-20260102-030405.mcap.partial",
        "a.b-flight.mcap",
    ):
        assert not files.owns(tmp_path / name)
    assert not files.owns(tmp_path.parent / "a.b-20260102-030405.mcap")
    assert files.owns(files.unnumbered())
    assert files.owns(files.next_part())


def test_two_daemons_do_not_write_one_log(
    tmp_path: Path, open_log: Callable[..., RollingLog]
) -> None:
    open_log(path=tmp_path / "log-%S.mcap")
    with pytest.raises(ConfigError, match=r"another daemon is writing the log .*log-\d\d\.mcap"):
        open_log(path=tmp_path / "log-%S.mcap", max_part_mb=1)
    open_log(path=tmp_path / "other-%S.mcap")


def test_a_log_that_a_daemon_left_hinders_none(
    tmp_path: Path, open_log: Callable[..., RollingLog]
) -> None:
    open_log(max_part_mb=1).close()
    open_log(max_part_mb=1).close()
    assert len(names(tmp_path)) == 2


def test_an_input_is_not_taken_for_an_old_log(
    tmp_path: Path, open_log: Callable[..., RollingLog]
) -> None:
    recording = tmp_path / "log.000001.mcap"
    recording.write_bytes(b"precious")
    with pytest.raises(ConfigError, match=r"log\.000001\.mcap might be deleted"):
        open_log(inputs=(recording,), max_part_mb=1, min_free_mb=10)
    with pytest.raises(ConfigError, match="it is an input"):
        open_log(inputs=(recording,), path=recording, overwrite=True)
    assert recording.read_bytes() == b"precious"


def test_a_required_log_must_be_written_under_its_name(
    tmp_path: Path, open_log: Callable[..., RollingLog]
) -> None:
    with pytest.raises(ConfigError, match="there is no folder"):
        open_log(path=tmp_path / "missing" / "log.mcap", required=True)
    (tmp_path / "log.mcap").write_bytes(b"precious")
    with pytest.raises(ConfigError, match=r"log\.mcap exists"):
        open_log(required=True)
    assert (tmp_path / "log.mcap").read_bytes() == b"precious"


def test_a_folder_that_is_not_there_at_the_start_is_waited_for(
    tmp_path: Path, open_log: Callable[..., RollingLog], clock: Clock
) -> None:
    folder = tmp_path / "stick"
    log = open_log(path=folder / "log.mcap")
    log.write(numbered(0))
    assert "No such file" in log.problem
    folder.mkdir()
    clock.now_s += 1
    log.write(numbered(1))
    log.close()
    assert log.problem == ""
    assert numbers_in(folder / "log.000001.mcap") == [1]


def test_a_file_in_the_way_is_left_alone(
    tmp_path: Path, open_log: Callable[..., RollingLog]
) -> None:
    (tmp_path / "log.mcap").write_bytes(b"precious")
    log = open_log()  # as after a crash, or where the clock starts anew at each boot
    log.write(numbered(0))
    log.close()
    assert (tmp_path / "log.mcap").read_bytes() == b"precious"
    assert numbers_in(tmp_path / "log.000001.mcap") == [0]


def test_a_folder_that_vanishes_pauses_the_log_until_it_is_back(
    tmp_path: Path,
    open_log: Callable[..., RollingLog],
    clock: Clock,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder = tmp_path / "stick"
    folder.mkdir()
    log = open_log(path=folder / "log.mcap")
    log.write(numbered(0))
    shutil.rmtree(folder)
    for i in range(1, 100):
        clock.now_s += 1
        log.write(numbered(i))
    assert "No such file" in log.problem
    folder.mkdir()
    for i in range(100, 140):
        clock.now_s += 1
        log.write(numbered(i))
    assert log.problem == ""
    log.close()
    [written] = folder.iterdir()
    found = numbers_in(written)
    assert found == list(range(found[0], 140))
    assert 100 <= found[0] < 131  # the longest delay
    assert log.num_unlogged == found[0] - 2  # 0 and 1 were written, and deleted with the folder
    messages = [record.message for record in caplog.records]
    assert len(messages) == 2
    assert "recording pauses: the log" in messages[0]
    assert f"recording goes on in {written}; {log.num_unlogged} frames are missing" in messages[1]


@contextlib.contextmanager
def files_up_to(num_bytes: int) -> Iterator[None]:
    """Let no file grow beyond this; writing on fails as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_write_that_fails_pauses_the_log_and_is_said_once(
    tmp_path: Path,
    open_log: Callable[..., RollingLog],
    clock: Clock,
    caplog: pytest.LogCaptureFixture,
) -> None:
    log = open_log()
    with files_up_to(100):
        for i in range(50):
            clock.now_s += 1
            log.write(numbered(i, 1000))
        assert "File too large" in log.problem
        assert log.num_unlogged == 50
        assert names(tmp_path) == []  # no file without a message stays
    for i in range(50, 100):
        clock.now_s += 1
        log.write(numbered(i, 1000))
    log.close()
    [written] = tmp_path.iterdir()
    assert numbers_in(written) == list(range(log.num_unlogged, 100))
    assert [record.levelno for record in caplog.records] == [logging.ERROR, logging.WARNING]


def test_a_mistake_of_ours_pauses_the_log_and_is_said_with_its_place(
    open_log: Callable[..., RollingLog], clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    log = open_log()
    log.write(dataclasses.replace(numbered(0), status=None))  # type: ignore[arg-type]
    assert "NoneType" in log.problem
    clock.now_s += 10
    log.write(numbered(1))
    assert log.problem == ""
    assert caplog.records[0].exc_info


def on_small_disk(folder: Path, scenario: Callable[[Path], None]) -> None:
    """Run a function of this module where a folder is a disk of 24 MB, in a process of its own."""
    program = f"from {__name__} import *; {scenario.__name__}(Path({str(folder)!r}))"
    script = f'mount -t tmpfs -o size=24m none {folder} || exit 77; exec "$0" -c "$1"'
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script, sys.executable, program],
        env={"PYTHONPATH": ":".join(path for path in sys.path if path), "PATH": "/usr/bin:/bin"},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip(f"a disk cannot be mounted here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr


def write_many(log: RollingLog, clock: Clock, numbers: range) -> None:
    """Write outputs of 100 kB, half a second apart."""
    for i in numbers:
        clock.now_s += 0.5
        log.write(numbered(i, 50_000))


def free_mb(folder: Path) -> float:
    return shutil.disk_usage(folder).free / 1e6


def fly_for_long(folder: Path) -> None:
    (folder / "log-flight.mcap").write_bytes(b"precious")
    (folder / "log.recovered.mcap").write_bytes(b"precious")
    clock = Clock()
    config = LogConfig(path=folder / "log.mcap", max_part_mb=2, min_free_mb=6)
    log = RollingLog(config, "base", clock=clock)
    write_many(log, clock, range(600))
    log.close()
    assert free_mb(folder) > 5
    assert (log.num_unlogged, log.problem) == (0, "")
    assert (folder / "log-flight.mcap").read_bytes() == b"precious"
    assert (folder / "log.recovered.mcap").read_bytes() == b"precious"
    found: list[int] = []
    for path in sorted(folder.glob("log.0*.mcap")):
        found += numbers_in(path)
    assert found == list(range(found[0], 600))  # the newest, without a gap
    assert 100 < len(found) < 200


def test_the_oldest_parts_make_room(tmp_path: Path) -> None:
    on_small_disk(tmp_path, fly_for_long)


def be_crowded_out(folder: Path) -> None:
    clock = Clock()
    config = LogConfig(path=folder / "log.mcap", max_part_mb=2, min_free_mb=6)
    log = RollingLog(config, "base", clock=clock)
    write_many(log, clock, range(30))
    others = folder / "others.bin"
    others.write_bytes(bytes(18_000_000))
    write_many(log, clock, range(30, 200))
    assert "less than" in log.problem
    assert "no older log to delete" in log.problem
    assert others.exists()
    [kept] = folder.glob("log.0*.mcap")  # what was written last
    assert numbers_in(kept)[-1] < 40
    others.unlink()
    write_many(log, clock, range(200, 300))
    assert log.problem == ""
    log.close()
    *_, newest = sorted(folder.glob("log.0*.mcap"))
    assert numbers_in(newest)[-1] == 299


def test_where_nothing_can_be_deleted_recording_pauses(tmp_path: Path) -> None:
    on_small_disk(tmp_path, be_crowded_out)


def fill_the_disk(folder: Path) -> None:
    clock = Clock()
    old = folder / "log.000001.mcap"
    old.write_bytes(b"precious")
    log = RollingLog(LogConfig(path=folder / "log.mcap"), "base", clock=clock)
    write_many(log, clock, range(300))
    assert "No space left" in log.problem
    log.close()
    assert old.read_bytes() == b"precious"  # without min_free_mb nothing is deleted
    unfinished = folder / "log.mcap"
    found = numbers_in_unfinished(unfinished)
    assert found == list(range(len(found)))
    assert len(found) >= 200
    unfinished.unlink()
    write_many(log, clock, range(300, 400))
    assert log.problem == ""
    log.close()
    logged = numbers_in(folder / "log.000002.mcap")
    assert logged == list(range(logged[0], 400))
    assert log.num_unlogged == 400 - len(found) - len(logged)


def test_a_disk_that_fills_up_pauses_the_log(tmp_path: Path) -> None:
    on_small_disk(tmp_path, fill_the_disk)


def begin_on_a_read_only_disk(folder: Path) -> None:
    def remount(how: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{how}", str(folder)], check=True)

    remount("ro")
    clock, config = Clock(), LogConfig(path=folder / "log.mcap")
    with pytest.raises(SourceError, match="Read-only file system"):
        RollingLog(config, "base", required=True)
    log = RollingLog(config, "base", clock=clock)
    write_many(log, clock, range(10))
    assert "Read-only file system" in log.problem
    remount("rw")
    write_many(log, clock, range(10, 100))
    log.close()
    assert log.problem == ""
    assert numbers_in(folder / "log.000001.mcap") == list(range(log.num_unlogged, 100))


def test_a_disk_that_cannot_be_written_at_the_start_is_waited_for(tmp_path: Path) -> None:
    on_small_disk(tmp_path, begin_on_a_read_only_disk)
