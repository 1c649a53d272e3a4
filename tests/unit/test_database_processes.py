"""Maps between processes. Run as a program, this file is the other process of its tests."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.unit.maps import MODEL, add, make_map, require_image
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError


@contextmanager
def other_process(*words: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Run `main` below with these words."""
    command = [sys.executable, "-m", "tests.unit.test_database_processes", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        command,
        cwd=Path(__file__).parents[2],
        env=environment,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def read_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def tell(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    print(line, file=process.stdin, flush=True)


def test_a_reader_keeps_its_snapshot_while_another_process_writes(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with MapReader.open(path) as reader, other_process("add-on-demand", path) as writer:
        for expected in (4, 5, 6):
            tell(writer, "add")
            assert read_line(writer) == "committed"
            assert len(reader) == expected - 1
            assert reader.verify() == []
            assert reader.refresh() is True
            assert reader.refresh() is False
            assert len(reader) == expected
            require_image(reader, expected - 1)


def test_a_writer_that_is_closed_keeps_nobody_out_though_a_child_has_its_file(
    tmp_path: Path,
) -> None:
    path = make_map(tmp_path / "m.tpmap", 1)
    with MapWriter.open(path, MODEL):
        held = [Path("/proc/self/fd", fd.name) for fd in Path("/proc/self/fd").iterdir()]
        held = [fd for fd in held if fd.exists() and fd.samefile(path)]
        # As a process has them that was forked meanwhile, until it is another program.
        inherited = [os.dup(int(fd.name)) for fd in held]
    try:
        assert inherited
        MapWriter.open(path, MODEL).close()
    finally:
        for fd in inherited:
            os.close(fd)


def test_a_second_writer_is_turned_away(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 1)
    with other_process("add-on-demand", path) as writer:
        tell(writer, "add")
        read_line(writer)
        with pytest.raises(DatabaseError, match="another writer has it open"):
            MapWriter.open(path, MODEL)
    with MapWriter.open(path, MODEL), pytest.raises(DatabaseError, match="another writer"):
        MapWriter.open(path, MODEL)


def test_killing_a_writer_loses_no_committed_image(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 0)
    for _ in range(2):
        with other_process("add-forever", path) as writer:
            committed = max(int(read_line(writer)) for _ in range(20))
            writer.send_signal(signal.SIGKILL)
            assert writer.wait() == -signal.SIGKILL
        with MapReader.open(path) as reader:
            assert reader.verify() == []
            assert len(reader) >= committed
            for index in range(len(reader)):
                require_image(reader, index)


def test_a_commit_the_disk_refuses_keeps_what_was_committed(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with other_process("fill-the-disk", path) as writer:
        line = read_line(writer)
    assert line.startswith(f"{path}: cannot be written: ")
    with MapReader.open(path) as reader:
        assert (len(reader), reader.verify()) == (3, [])


def test_a_lock_file_in_use_by_the_map_that_was_here_before_is_named(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with other_process("add-on-demand", path) as user:
        for _ in range(3):
            tell(user, "add")
            read_line(user)
        make_map(tmp_path / "new.tpmap", 5).rename(path)
        with pytest.raises(DatabaseError, match="remove the lock file"):
            MapReader.open(path)
        path.with_name("a.tpmap-lock").unlink()
        with MapReader.open(path) as reader:
            assert (len(reader), reader.verify()) == (5, [])


@pytest.fixture
def public_folder() -> Iterator[Path]:
    """A folder that another user can get to; pytest's own are private."""
    with TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def test_a_map_in_a_read_only_folder_can_be_read_and_says_when_it_changed(
    public_folder: Path,
) -> None:
    path = make_map(public_folder / "a.tpmap", 3)
    path.with_name("a.tpmap-lock").unlink()
    with other_process("read-without-rights", path) as reader:
        assert read_line(reader) == "3 images"
        public_folder.chmod(0o755)
        for task, expected in (("look", "3"), ("look", "changed twice"), ("refresh", "6")):
            with MapWriter.open(path, MODEL) as writer:
                add(writer, len(writer))
            tell(reader, task)
            assert expected in read_line(reader)


def test_a_map_that_may_not_be_read_says_so(public_folder: Path) -> None:
    path = make_map(public_folder / "a.tpmap", 1)
    path.chmod(0)
    with other_process("read-without-rights", path) as reader:
        assert read_line(reader) == f"{path}: permission denied; change its owner or its mode"


def main(task: str, path: Path) -> None:
    """Do what a test wants of another process, and say so line by line."""
    if task == "read-without-rights":
        read_without_rights(path)
        return
    if task == "check-on-demand":
        check_on_demand(path)
        return
    with MapWriter.open(path, MODEL) as writer:
        if task == "add-forever":
            while True:
                for _ in range(3):
                    add(writer, len(writer))
                writer.commit()
                say(len(writer))
        if task == "fill-the-disk":
            limit = path.stat().st_size + 8192
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            for _ in range(20):
                add(writer, len(writer))
            try:
                writer.commit()
            except DatabaseError as error:
                say(error)
        if task == "add-on-demand":
            for _ in sys.stdin:
                add(writer, len(writer))
                writer.commit()
                say("committed")


def read_without_rights(path: Path) -> None:
    if os.geteuid() == 0:
        os.setuid(65_534)
    else:
        path.parent.chmod(0o555)
    try:
        with MapReader.open(path, MODEL) as reader:
            say(f"{len(reader.names())} images")
            for line in sys.stdin:
                if line == "refresh\n":
                    reader.refresh()
                try:
                    say(f"{len(reader.names())} images")
                except DatabaseError as error:
                    say(error)
    except DatabaseError as error:
        say(error)


def check_on_demand(path: Path) -> None:
    with MapReader.open(path) as reader:
        say(f"{len(reader)} images, {reader.verify() or 'no problems'}")
        for line in sys.stdin:
            if line == "refresh\n":
                reader.refresh()
            say(f"{len(reader)} images, {reader.verify() or 'no problems'}")


def say(what: object) -> None:
    sys.stdout.write(f"{what}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))


def test_threads_open_and_close_one_map(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)

    def look(_: int) -> int:
        with MapReader.open(path) as reader:
            return len(reader)

    with ThreadPoolExecutor(6) as threads:  # one opens it as another closes it
        assert set(threads.map(look, range(3000))) == {3}
