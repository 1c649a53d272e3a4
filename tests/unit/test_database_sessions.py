"""The surveys that a map's images are of, and what retrieval makes of them."""

from collections.abc import Collection
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.maps import MODEL, add, make_features, make_map
from trigpoint.database.ranking import PREFERENCE
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import Session

WINTER = Session("winter", date(2026, 1, 10))
SUMMER = Session("summer", date(2026, 7, 1))
SESSIONS = (None, WINTER, SUMMER)


def session_of(index: int) -> Session | None:
    return SESSIONS[index % 3]


def make_map_of_sessions(path: Path, num_images: int) -> Path:
    with MapWriter.create(path, MODEL) as writer:
        for index in range(num_images):
            add(writer, index, session=session_of(index))
    return path


def test_every_image_has_the_session_it_was_added_with(tmp_path: Path) -> None:
    path = make_map_of_sessions(tmp_path / "a.tpmap", 300)
    spring = Session("spring")
    with MapWriter.open(path, MODEL) as writer:
        add(writer, 300, session=WINTER)
        add(writer, 301, session=spring)
    with MapReader.open(path) as reader:
        assert reader.sessions == (WINTER, SUMMER, spring)
        expected = [*map(session_of, range(300)), WINTER, spring]
        assert reader.sessions_by_index() == expected
        assert reader.verify() == []


def test_sessions_of_one_name_and_different_dates_are_different(tmp_path: Path) -> None:
    dates = (date(2026, 1, 1), date(2026, 1, 2), None)
    with MapWriter.create(tmp_path / "a.tpmap", MODEL) as writer:
        for index, day in enumerate(dates):
            add(writer, index, session=Session("office", day))
    with MapReader.open(tmp_path / "a.tpmap") as reader:
        assert [str(session) for session in reader.sessions_by_index()] == [
            "office (2026-01-01)", "office (2026-01-02)", "office",
        ]  # fmt: skip
        query = make_features(0).global_descriptor
        assert len(reader.search(query, 3, exclude=["office"])[0]) == 0


def test_an_image_that_takes_the_place_of_a_removed_one_keeps_its_session(tmp_path: Path) -> None:
    path = make_map_of_sessions(tmp_path / "a.tpmap", 300)
    gone = {0, 10, 256, 299}
    with MapWriter.open(path, MODEL) as writer:
        for index in gone:
            writer.remove(f"folder/{index}.png")
    with MapReader.open(path) as reader:
        found = dict(zip(reader.names(), reader.sessions_by_index(), strict=True))
        assert reader.verify() == []
    assert found == {f"folder/{i}.png": session_of(i) for i in set(range(300)) - gone}


@settings(max_examples=40)
@given(
    seed=st.integers(0, 999),
    k=st.integers(1, 60),
    prefer=st.sets(st.sampled_from(["winter", "summer", "unknown"])),
    exclude=st.sets(st.sampled_from(["winter", "summer", "unknown"])),
)
def test_a_search_in_sessions_equals_one_image_by_image(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    k: int,
    prefer: Collection[str],
    exclude: Collection[str],
) -> None:
    path = tmp_path_factory.getbasetemp() / "sessions.tpmap"
    if not path.exists():
        make_map_of_sessions(path, 300)
    query = make_features(seed).global_descriptor
    with MapReader.open(path) as reader:
        order, cosines = reader.search(query, 300)
        found, similarities = reader.search(query, k, prefer=prefer, exclude=exclude)
    scores = {}
    for index, cosine in zip(order.tolist(), cosines.tolist(), strict=True):
        session = session_of(index)
        name = "" if session is None else session.name
        if name not in exclude:
            scores[index] = cosine + PREFERENCE * (name in prefer)
    expected = sorted(scores, key=lambda index: -scores[index])[:k]
    np.testing.assert_allclose(
        [scores[i] for i in found.tolist()], [scores[i] for i in expected], atol=1e-6
    )
    by_index = dict(zip(order.tolist(), cosines.tolist(), strict=True))
    assert similarities.tolist() == [by_index[index] for index in found.tolist()]


def test_a_preferred_image_comes_first_of_two_alike_but_not_before_a_much_better_one(
    tmp_path: Path,
) -> None:
    query, other = np.eye(32, dtype=np.float32)[:2]
    cosines = (0.9, 0.65, 0.6)  # the last one is preferred
    with MapWriter.create(tmp_path / "a.tpmap", MODEL) as writer:
        for index, cosine in enumerate(cosines):
            row = np.float32(cosine) * query + np.float32((1 - cosine**2) ** 0.5) * other
            features = replace(make_features(index), global_descriptor=row)
            add(writer, index, features=features, session=WINTER if index == 2 else SUMMER)
    with MapReader.open(tmp_path / "a.tpmap") as reader:
        assert reader.search(query, 3)[0].tolist() == [0, 1, 2]
        assert reader.search(query, 3, prefer=["winter"])[0].tolist() == [0, 2, 1]


def test_a_diverse_search_leaves_out_excluded_images_too(tmp_path: Path) -> None:
    path = make_map_of_sessions(tmp_path / "a.tpmap", 90)
    query = make_features(4).global_descriptor
    with MapReader.open(path) as reader:
        found, _ = reader.search(query, 90, 0.3, exclude=["winter"])
    assert sorted(found.tolist()) == [index for index in range(90) if index % 3 != 1]


@pytest.mark.parametrize("name", ["", "a" * 101, "two\nlines"])
def test_a_name_that_no_session_can_have_is_an_error(name: str) -> None:
    with pytest.raises(ConfigError, match="1 to 100 printable characters"):
        Session(name)


def test_a_map_without_sessions_says_so(tmp_path: Path) -> None:
    with MapReader.open(make_map(tmp_path / "a.tpmap", 2)) as reader:
        assert reader.sessions == ()
        assert reader.sessions_by_index() == [None, None]
