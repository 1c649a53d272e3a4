"""Maps that are copied over, cut short or filled with other bytes while they are open."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.maps import MODEL, add, make_features, make_map, require_image
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError

NUM_COMMITS = 4  # of the map that is open


def make_committed(path: Path, num_images: int, num_commits: int) -> Path:
    """Make a map of so many commits, the first being that of the empty map."""
    with MapWriter.create(path, MODEL) as writer:
        for index in range(num_images):
            add(writer, index)
            if index < num_commits - 2:
                writer.commit()
    return path


def read_all(reader: MapReader) -> None:
    reader.names()
    reader.search(make_features(1).global_descriptor, 3)
    for index in range(len(reader)):
        reader.anchor(index)


def tick(path: Path) -> None:
    """Let the file system's clock go on: it is as coarse as 10 ms, and tests are faster."""
    before_ns = path.stat().st_ctime_ns
    while path.stat().st_ctime_ns == before_ns:
        os.utime(path)


def copy(source: Path, path: Path) -> None:
    """Copy a file over another one, which is empty in between, as `cp` does."""
    tick(path)
    shutil.copyfile(source, path)


def overwrite(path: Path, octets: bytes) -> None:
    """Write other bytes, the file being long enough all the time, as `rsync --inplace` does."""
    tick(path)
    with path.open("r+b") as file:
        file.write(octets)
        file.truncate()


@pytest.mark.parametrize("num_commits", range(NUM_COMMITS - 2, NUM_COMMITS + 4))
@pytest.mark.parametrize("is_cut", [True, False])
def test_a_map_copied_over_the_open_one_is_taken_up(
    tmp_path: Path, num_commits: int, is_cut: bool
) -> None:
    path = make_committed(tmp_path / "a.tpmap", 30, NUM_COMMITS)
    other = make_committed(tmp_path / "b.tpmap", 12, num_commits)
    with MapReader.open(path) as reader:
        read_all(reader)
        copy(other, path) if is_cut else overwrite(path, other.read_bytes())
        assert reader.refresh() is True
        assert (len(reader), reader.verify()) == (12, [])
        require_image(reader, 11)
        assert reader.refresh() is False
        with MapWriter.open(path, MODEL) as writer:
            add(writer, 12)
        assert reader.refresh() is True
        require_image(reader, 12)


@pytest.mark.parametrize("num_commits", [NUM_COMMITS - 1, NUM_COMMITS, NUM_COMMITS + 1])
def test_what_is_read_of_a_map_copied_over_is_an_error_and_never_of_both(
    tmp_path: Path, num_commits: int
) -> None:
    path = make_committed(tmp_path / "a.tpmap", 30, NUM_COMMITS)
    other = make_committed(tmp_path / "b.tpmap", 12, num_commits)
    with MapReader.open(path) as reader:
        read_all(reader)
        overwrite(path, other.read_bytes())
        with pytest.raises(DatabaseError, match=r"damaged|overwritten|cut short"):
            reader.anchor(3)


@pytest.mark.parametrize("num_commits", range(NUM_COMMITS - 2, NUM_COMMITS + 4))
def test_a_map_of_another_model_copied_over_the_open_one_leaves_none(
    tmp_path: Path, num_commits: int
) -> None:
    path = make_committed(tmp_path / "a.tpmap", 3, NUM_COMMITS)
    good = path.read_bytes()
    wider = replace(MODEL, name="wider", descriptor_dim=32, global_dim=64)
    other = tmp_path / "b.tpmap"
    with MapWriter.create(other, wider) as writer:
        for index in range(num_commits - 1):
            add(writer, index, features=make_features(index, model=wider))
            writer.commit()
    with MapReader.open(path) as reader:
        read_all(reader)
        overwrite(path, other.read_bytes())
        for _ in range(2):
            with pytest.raises(DatabaseError, match="made with model 'wider'"):
                reader.refresh()
            with pytest.raises(DatabaseError, match=r"damaged|overwritten"):
                reader.anchor(1)
        overwrite(path, good)
        reader.refresh()
        require_image(reader, 2)


@pytest.mark.parametrize("left", [0, 100, 5000, 20_000])
@pytest.mark.parametrize("in_place", [True, False])
def test_after_a_map_was_cut_short_a_good_one_is_taken_up(
    tmp_path: Path, left: int, in_place: bool
) -> None:
    path = make_map(tmp_path / "a.tpmap", 20)
    good = make_map(tmp_path / "good.tpmap", 5)
    with MapReader.open(path) as reader:
        read_all(reader)
        os.truncate(path, left)
        for _ in range(2):
            with pytest.raises(DatabaseError, match=r"a\.tpmap: (cut short|not a Trigpoint map)"):
                reader.refresh()
            with pytest.raises(DatabaseError, match="cut short while open"):
                reader.anchor(3)
        copy(good, path) if in_place else good.rename(path)
        assert reader.refresh() is True
        assert (len(reader), reader.verify()) == (5, [])


def test_random_bytes_written_over_an_open_map_never_pass_for_features(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 20)
    good, failures = path.read_bytes(), 0
    with MapReader.open(path) as reader:
        expected = [reader.anchor(index).descriptors for index in range(20)]
        for case in range(20):
            rng, octets = np.random.default_rng(case), bytearray(good)
            start = int(rng.integers(len(good)))
            octets[start : start + 20_000] = rng.bytes(min(20_000, len(good) - start))
            overwrite(path, bytes(octets))
            for index in range(20):
                try:
                    found = reader.anchor(index).descriptors
                except DatabaseError:
                    failures += 1
                else:
                    np.testing.assert_array_equal(found, expected[index])
            overwrite(path, good)
            reader.refresh()
            assert reader.verify() == []
    assert failures > 20


def add_images() -> None:
    """Add three images, each in a commit, as another process."""
    for _ in range(3):
        with MapWriter.open(Path(sys.argv[1]), MODEL) as writer:
            add(writer, len(writer))


def test_a_lock_file_that_was_removed_hides_no_commit(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 2)
    with MapReader.open(path) as reader:
        path.with_name("a.tpmap-lock").unlink()
        program = "from tests.unit.test_database_overwritten import add_images; add_images()"
        subprocess.run(
            [sys.executable, "-c", program, path],
            cwd=Path(__file__).parents[2],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            check=True,
        )
        assert reader.refresh() is True
        assert len(reader) == 5
