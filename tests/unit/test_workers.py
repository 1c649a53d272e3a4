"""Maps built by processes: the same bytes, whoever does the work and whatever befalls them."""

import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.unit.conftest import Run
from tests.unit.labor import (
    die_of_seven,
    die_once,
    lack_memory_once,
    open_file,
    raise_odd_error,
    square,
)
from tests.unit.surveys import make_survey
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import COMMIT_EVERY
from trigpoint.errors import ConfigError, DatabaseError, SourceError
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.extraction import Crew, NetworkFiles
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.workers import Processes, do_in_order

NUM_IMAGES = 2 * COMMIT_EVERY + 30
TIMEOUT_S = 60


class Survey:
    """Images and the map that one process makes of them."""

    def __init__(self, folder: Path, model: FeatureModel) -> None:
        self.folder = folder
        make_survey(folder, NUM_IMAGES)
        self.posed = read_model(folder / "sparse")  # as the command reads it
        self.images = folder / "images"
        self.network = NetworkFiles("tiny", None, model.identity)
        self.map = folder / "alone.tpmap"
        build_map(self.map, self.posed, self.images, model)


@pytest.fixture(scope="module")
def tiny() -> FeatureModel:
    return FeatureModel.load("tiny")


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory, tiny: FeatureModel) -> Survey:
    return Survey(tmp_path_factory.mktemp("survey"), tiny)


def test_the_map_of_two_processes_one_of_them_killed_is_that_of_one(
    survey: Survey, tiny: FeatureModel, tmp_path: Path
) -> None:
    def images() -> Iterator[PosedImage]:
        for index, image in enumerate(survey.posed):
            if index == NUM_IMAGES // 2:
                multiprocessing.active_children()[0].kill()
            yield image

    with Processes(2) as workers:
        crew = Crew(workers, survey.network)
        build_map(tmp_path / "m.tpmap", images(), survey.images, tiny, crew=crew)
    assert (tmp_path / "m.tpmap").read_bytes() == survey.map.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["m.tpmap"]


def test_results_come_in_order_and_few_are_in_work() -> None:
    given: list[int] = []

    def items() -> Iterator[int]:
        for number in range(40):
            given.append(number)
            yield number

    with Processes(2) as workers:
        results = do_in_order(square, items(), workers)
        for number in range(40):
            assert next(results) == number * number
            assert len(given) <= number + 1 + workers.max_in_work
        assert list(results) == []


def test_what_a_dead_process_had_to_do_is_done_again(tmp_path: Path) -> None:
    markers = [tmp_path / "a", tmp_path / "b"]
    with Processes(2) as workers:
        assert list(do_in_order(die_once, markers, workers)) == ["a", "b"]


def test_an_image_that_ends_every_process_is_named() -> None:
    with Processes(2) as workers:
        results = do_in_order(die_of_seven, range(5, 20), workers)
        assert [next(results), next(results)] == [5, 6]
        with pytest.raises(SourceError, match=r"^7: 3 processes ended while they worked on it"):
            next(results)


def test_an_error_that_no_pipe_takes_is_told(tmp_path: Path) -> None:
    with Processes(1) as workers:
        with pytest.raises(RuntimeError, match="cannot pickle"):
            workers.submit(open_file, tmp_path / "a").result()
        with pytest.raises(RuntimeError, match="OddError: b"):
            workers.submit(raise_odd_error, "b").result()
        with pytest.raises(FileNotFoundError, match="nowhere"):
            workers.submit(open_file, tmp_path / "nowhere" / "a").result()
        assert workers.submit(square, 3).result() == 9


def test_a_process_without_memory_ends(tmp_path: Path) -> None:
    with Processes(1) as workers:
        assert list(do_in_order(lack_memory_once, [tmp_path / "a"], workers)) == ["a"]


def require_same_records(path: Path, other: Path) -> None:
    """Both maps hold the same, in the same order."""
    with MapReader.open(path) as a, MapReader.open(other) as b:
        assert a.verify() == []
        assert (len(a), a.pose_noise, a.generation) == (len(b), b.pose_noise, b.generation)
        for index in range(len(a)):
            ours, theirs = a.record(index), b.record(index)
            assert (ours.name, ours.image, ours.features) == (
                theirs.name,
                theirs.image,
                theirs.features,
            )
            assert ours.row.numbers.tobytes() == theirs.row.numbers.tobytes()


def start_build(survey: Survey, map_: Path, *more: str) -> subprocess.Popen[str]:
    arguments = ["build", str(map_), str(survey.folder), "--model", "tiny", *more]
    return subprocess.Popen(
        [sys.executable, "-m", "trigpoint_db.cli", *arguments], stderr=subprocess.PIPE, text=True
    )


def wait_until(is_true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not is_true():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


def num_committed(map_: Path) -> int:
    try:
        with MapReader.open(map_) as reader:
            return len(reader)
    except DatabaseError:  # not there yet
        return 0


def is_opening(map_: Path) -> bool:
    """Whether a process is just opening a map: stopped then, it would keep us waiting for ever."""
    fd = os.open(map_.parent, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def stop_in_the_middle(process: int, partial: Path) -> None:
    """Stop a build after its first commit; it runs for a moment at a time, to be caught early."""

    def is_stopped_in_time() -> bool:
        os.kill(process, signal.SIGSTOP)
        if not is_opening(partial) and num_committed(partial) >= COMMIT_EVERY:
            return True
        os.kill(process, signal.SIGCONT)
        return False

    wait_until(is_stopped_in_time)


def children_of(process: int) -> list[int]:
    listed = [path.read_text() for path in Path(f"/proc/{process}/task").glob("*/children")]
    return [int(child) for children in listed for child in children.split()]


def test_a_build_killed_in_the_middle_goes_on(
    survey: Survey, tiny: FeatureModel, run: Run, tmp_path: Path
) -> None:
    map_ = tmp_path / "m.tpmap"
    partial = tmp_path / "m.tpmap.partial"
    process = start_build(survey, map_, "--jobs", "2")
    stop_in_the_middle(process.pid, partial)
    children = children_of(process.pid)
    process.kill()
    process.communicate()
    assert len(children) >= 2
    wait_until(lambda: not any(Path(f"/proc/{child}").exists() for child in children))
    assert not map_.exists()

    code, _, err = run("build", map_, survey.folder, "--model", "tiny")
    assert code == 1
    assert "go on with --resume" in err
    build_map(map_, survey.posed, survey.images, tiny, resume=True)
    require_same_records(map_, survey.map)
    assert {path.name for path in tmp_path.iterdir()} <= {"m.tpmap", "m.tpmap-lock"}


@pytest.fixture
def with_ctrl_c() -> Iterator[None]:
    """A shell's `&` has what it starts ignore SIGINT, and so would a build that a test starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("with_ctrl_c")
def test_ctrl_c_ends_a_build_and_leaves_what_is_done(survey: Survey, tmp_path: Path) -> None:
    map_ = tmp_path / "m.tpmap"
    partial = tmp_path / "m.tpmap.partial"
    process = start_build(survey, map_, "--jobs", "2")
    stop_in_the_middle(process.pid, partial)
    children = children_of(process.pid)
    for pid in (process.pid, *children):  # as a terminal does
        os.kill(pid, signal.SIGINT)
    os.kill(process.pid, signal.SIGCONT)
    err = process.communicate(timeout=TIMEOUT_S)[1]
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert err.endswith("trigpoint-db: interrupted; the same command goes on with --resume\n")
    wait_until(lambda: not any(Path(f"/proc/{child}").exists() for child in children))
    with MapReader.open(partial) as reader:
        assert reader.verify() == []
        assert len(reader) % COMMIT_EVERY == 0


def test_only_the_same_build_goes_on(survey: Survey, tiny: FeatureModel, tmp_path: Path) -> None:
    map_ = tmp_path / "m.tpmap"

    def broken_off() -> Iterator[PosedImage]:
        yield from survey.posed[: COMMIT_EVERY + 1]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_map(map_, broken_off(), survey.images, tiny)
    assert num_committed(tmp_path / "m.tpmap.partial") == COMMIT_EVERY
    for images in (survey.posed[1:], survey.posed[: COMMIT_EVERY - 1]):
        with pytest.raises(ConfigError, match="was begun with other images"):
            build_map(map_, images, survey.images, tiny, resume=True)
    with pytest.raises(DatabaseError, match="made with model"):
        build_map(map_, survey.posed, survey.images, FeatureModel.load("base"), resume=True)
    assert build_map(map_, survey.posed, survey.images, tiny, resume=True) == NUM_IMAGES
    require_same_records(map_, survey.map)


def test_jobs_and_a_cluster_exclude_each_other(survey: Survey, run: Run, tmp_path: Path) -> None:
    build = ["build", tmp_path / "m.tpmap", survey.folder, "--model", "tiny", "--jobs", 2]
    code, _, err = run(*build, "--cluster", "tcp://127.0.0.1:1")
    assert code == 1
    assert "not both" in err
    assert list(tmp_path.iterdir()) == []


def test_a_cluster_without_the_extra_says_what_to_install(
    survey: Survey, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "trigpoint_db.cluster", raising=False)
    build = ["build", tmp_path / "m.tpmap", survey.folder, "--model", "tiny"]
    code, _, err = run(*build, "--cluster", "tcp://127.0.0.1:1")
    assert code == 1
    assert err == (
        "trigpoint-db: --cluster needs the extra `cluster`: pip install 'trigpoint[cluster]'"
    )
