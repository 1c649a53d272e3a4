"""Retrieval with an index, in sessions and around a prior position."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.maps import CAMERA, MODEL, make_features, make_map, unit
from tests.unit.test_database_damage import alter_entry
from trigpoint.database import retrieval, schema
from trigpoint.database.codec import Profile
from trigpoint.database.index import build_index, cluster
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import compact_map
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError, DatabaseError
from trigpoint.frame import LocalFeatures, Prior, Session
from trigpoint.rigid import Rigid3
from trigpoint_db.maps import leave_out

NUM_IMAGES, NUM_PLACES = 300, 30
LATER = Session("later")


def described(descriptor: np.ndarray) -> LocalFeatures:
    nothing = make_features(0, 0)
    return LocalFeatures(nothing.keypoints, nothing.descriptors, nothing.scores, descriptor)


def descriptor(index: int) -> np.ndarray:
    """Ten images show the same place."""
    rng = np.random.default_rng(index)
    place = np.random.default_rng(10_000 + index % NUM_PLACES).standard_normal(MODEL.global_dim)
    return unit(place + 0.3 * rng.standard_normal(MODEL.global_dim))


def center(index: int) -> np.ndarray:
    """Places are 10 apart, their images within 1."""
    return np.array([10.0 * (index % NUM_PLACES), 0, np.random.default_rng(index).random()])


def is_later(index: int) -> bool:
    """A third of each place's images."""
    return index // NUM_PLACES % 3 == 0


def put(writer: MapWriter, index: int) -> None:
    writer.add(
        f"{index}",
        CAMERA,
        Rigid3.from_center(np.eye(3), center(index)),
        described(descriptor(index)),
        LATER if is_later(index) else None,
    )


@pytest.fixture
def indexed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A map with an index of which a search looks at a tenth."""
    path = tmp_path / "a.tpmap"
    with MapWriter.create(path, MODEL) as writer:
        for index in range(NUM_IMAGES):
            put(writer, index)
    num_lists = build_index(path)
    monkeypatch.setattr(retrieval, "NUM_PROBED", num_lists // 10)
    return path


def exact(indices: list[int], query: np.ndarray, k: int) -> list[int]:
    """The images that are most like a query, of those made of `indices`."""
    return sorted(indices, key=lambda index: -float(descriptor(index) @ query))[:k]


def search(reader: MapReader, query: np.ndarray, k: int, **options: object) -> list[int]:
    names = reader.names()
    found, similarities = reader.search(query, k, **options)  # type: ignore[arg-type]
    assert (np.diff(similarities) <= 0).all()
    for index, similarity in zip(found.tolist(), similarities, strict=True):
        assert similarity == pytest.approx(descriptor(int(names[index])) @ query, abs=0.02)
    return [int(names[index]) for index in found.tolist()]


def recall(
    reader: MapReader,
    there: list[int],
    k: int = 8,
    places: Sequence[int] = range(NUM_PLACES),
    **options: object,
) -> float:
    shares = []
    for place in places:
        query = descriptor(NUM_IMAGES * 10 + place)
        found = search(reader, query, k, **options)
        assert len(found) == min(k, len(there))
        shares.append(len(set(found) & set(exact(there, query, k))) / len(found))
    return float(np.mean(shares))


def test_an_index_finds_what_a_scan_does(indexed: Path) -> None:
    with MapReader.open(indexed) as reader:
        assert reader.has_index
        assert reader.verify() == []
        assert recall(reader, list(range(NUM_IMAGES))) > 0.95


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_an_index_of_which_all_is_looked_at_finds_exactly_what_a_scan_does(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "scanned.tpmap"
    copy = path.with_name("indexed.tpmap")
    if not path.exists():
        make_map(path, 300)
        copy.write_bytes(path.read_bytes())
        assert build_index(copy) > retrieval.NUM_PROBED
    query = make_features(seed).global_descriptor
    with MapReader.open(path) as a, MapReader.open(copy) as b:
        (found, similarities), (same, alike) = (reader.search(query, 300) for reader in (a, b))
    np.testing.assert_array_equal(found, same)
    np.testing.assert_allclose(similarities, alike, atol=1e-6)


def test_images_come_and_go_after_the_index_was_made(indexed: Path) -> None:
    rng = np.random.default_rng(0)
    there = list(range(NUM_IMAGES))
    with MapWriter.open(indexed, MODEL) as writer:
        for step in range(60):
            if step % 3 == 0:
                put(writer, NUM_IMAGES + step)
                there.append(NUM_IMAGES + step)
            else:
                writer.remove(f"{there.pop(rng.integers(len(there)))}")
    with MapReader.open(indexed) as reader:
        assert reader.verify() == []
        assert len(reader) == len(there)
        assert recall(reader, there) > 0.95
        # Each is found by itself, wherever it lies now.
        found = [search(reader, descriptor(index), 1) for index in there]
        assert found == [[index] for index in there]


def test_a_map_emptied_of_what_the_index_knew_is_searched_as_if_it_had_none(indexed: Path) -> None:
    with MapWriter.open(indexed, MODEL) as writer:
        for index in range(NUM_IMAGES):
            writer.remove(f"{index}")
        for index in range(3):
            put(writer, index)
    with MapReader.open(indexed) as reader:
        assert reader.verify() == []
        assert sorted(search(reader, descriptor(0), 10)) == [0, 1, 2]


def test_lists_are_looked_at_until_there_are_enough_images_that_may_come(indexed: Path) -> None:
    with MapReader.open(indexed) as reader:
        of_session = [index for index in range(NUM_IMAGES) if not is_later(index)]
        assert recall(reader, of_session, exclude=["later"]) > 0.95
        query = descriptor(1)
        assert len(search(reader, query, 250, exclude=["later"])) == len(of_session)


def test_a_diverse_search_goes_on_with_an_index(indexed: Path) -> None:
    query = descriptor(NUM_IMAGES * 10)
    with MapReader.open(indexed) as reader:
        alike, diverse = (reader.search(query, 20, d)[0].tolist() for d in (0.0, 0.9))
    assert alike[0] == diverse[0]
    assert len(set(diverse)) == 20
    assert set(alike) != set(diverse)


@pytest.mark.parametrize("max_scanned", [0, 50_000])
def test_a_prior_position_leaves_the_images_around_it(
    indexed: Path, monkeypatch: pytest.MonkeyPatch, max_scanned: int
) -> None:
    monkeypatch.setattr(retrieval, "MAX_SCANNED", max_scanned)
    prior = Prior((20.0, 0, 0), 15)
    inside = [index for index in range(NUM_IMAGES) if index % NUM_PLACES in (1, 2, 3)]
    with MapReader.open(indexed) as reader:
        assert recall(reader, inside, places=(1, 2, 3), prior=prior) > 0.95
        assert search(reader, descriptor(0), 5, prior=Prior((-100, 0, 0), 50)) == []


@pytest.mark.parametrize("numbers", [((0, 0, np.nan), 1), ((0, 0, 0), 0), ((0, 0, 0), np.inf)])
def test_a_prior_position_that_is_none_is_an_error(
    numbers: tuple[tuple[float, float, float], float],
) -> None:
    with pytest.raises(ConfigError, match="three numbers and a radius above 0"):
        Prior(*numbers)


def test_compacting_makes_the_index_anew_or_takes_it_away(indexed: Path) -> None:
    with MapWriter.open(indexed, MODEL) as writer:
        for index in range(100):
            writer.remove(f"{index}")
    there = list(range(100, NUM_IMAGES))
    for wanted, has_index in ((None, True), (False, False), (True, True)):
        compact_map(indexed, index=wanted)
        with MapReader.open(indexed) as reader:
            assert (reader.has_index, reader.verify()) == (has_index, [])
            assert recall(reader, there) > 0.95
    compact_map(indexed, profile=Profile.COMPACT)
    with MapReader.open(indexed) as reader:
        assert (reader.profile, reader.has_index) == (Profile.COMPACT, True)
        assert reader.sessions == (LATER,)


def test_a_map_keeps_profile_index_and_mode_when_images_are_left_out(indexed: Path) -> None:
    compact_map(indexed, profile=Profile.COMPACT)
    indexed.chmod(0o640)
    with MapReader.open(indexed) as reader:
        generation = reader.generation
        assert leave_out(indexed, ["0", "7"]) == NUM_IMAGES - 2
        assert reader.refresh()
        assert reader.verify() == []
        assert (reader.profile, reader.has_index) == (Profile.COMPACT, True)
        assert reader.generation > generation
        assert recall(reader, [i for i in range(NUM_IMAGES) if i not in (0, 7)]) > 0.9
    assert indexed.stat().st_mode & 0o777 == 0o640


def test_a_small_map_gets_no_index_unless_it_is_asked_for(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    compact_map(path)
    with MapReader.open(path) as reader:
        assert not reader.has_index


def test_an_empty_map_gets_no_index(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 0)
    compact_map(path, index=True)
    with MapReader.open(path) as reader:
        assert (reader.has_index, reader.verify()) == (False, [])


def test_readers_keep_their_snapshot_while_an_index_is_written(indexed: Path) -> None:
    with MapReader.open(indexed) as reader:
        query = descriptor(5)
        before = search(reader, query, 20)
        with MapWriter.open(indexed, MODEL) as writer:
            for index in range(50):
                writer.remove(f"{index}")
        build_index(indexed)
        assert search(reader, query, 20) == before
        assert reader.refresh()
        assert set(search(reader, query, 20)).isdisjoint(range(50))


@pytest.mark.parametrize(
    ("key", "payload", "problem"),
    [
        (schema.CENTROIDS_KEY, None, "the centroids of the index is missing"),
        (schema.list_key(3), None, "list 3 of the index is missing"),
        (schema.list_key(3), b"", "the index does not have 300 rows once each"),
        (schema.CENTROIDS_KEY, bytes(2 * 32), "the index has 1 centroids"),
    ],
)
def test_verify_finds_what_is_wrong_with_an_index(
    indexed: Path, key: bytes, payload: bytes | None, problem: str
) -> None:
    alter_entry(indexed, key, payload)
    with MapReader.open(indexed) as reader:
        assert any(problem in found for found in reader.verify())
    if payload is None:
        with MapReader.open(indexed) as reader, pytest.raises(DatabaseError, match="missing"):
            reader.search(descriptor(0), 300)


def test_clusters_are_found_again() -> None:
    rng = np.random.default_rng(0)
    true = unit(rng.standard_normal((12, 32)))
    samples = unit(np.repeat(true, 50, axis=0) + 0.05 * rng.standard_normal((600, 32)))
    rng.shuffle(samples)
    centroids = cluster(samples, 24)
    assert (true @ centroids.T).max(axis=1).min() > 0.98
    np.testing.assert_allclose(np.linalg.norm(centroids, axis=1), 1, rtol=1e-5)
