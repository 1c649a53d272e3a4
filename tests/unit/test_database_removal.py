"""Images leave a map, and what stays is as if they had never been in it."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.maps import MODEL, add, make_features, make_map, require_image
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError


def require_images(path: Path, expected: set[int]) -> None:
    with MapReader.open(path) as reader:
        assert reader.verify() == []
        assert sorted(reader.names()) == sorted(f"folder/{index}.png" for index in expected)
        for index, name in enumerate(reader.names()):
            made_of = int(name.removeprefix("folder/").removesuffix(".png"))
            anchor = reader.anchor(index)
            assert anchor.name == name
            (found,), _ = reader.search(make_features(made_of).global_descriptor, 1)
            assert found == index


@settings(max_examples=40)
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(["add", "remove", "commit", "reopen"]), st.integers(0, 11)),
        max_size=25,
    )
)
def test_any_sequence_of_changes_leaves_what_was_added_and_not_removed(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    path = make_map(tmp_path_factory.mktemp("map") / "a.tpmap", 4)
    expected = set(range(4))
    writer = MapWriter.open(path, MODEL)
    for step, index in steps:
        if step == "add" and index not in expected:
            add(writer, index)
            expected.add(index)
        elif step == "remove" and index in expected:
            writer.remove(f"folder/{index}.png")
            expected.remove(index)
        elif step == "commit":
            writer.commit()
        elif step == "reopen":
            writer.commit()
            writer.close()
            writer = MapWriter.open(path, MODEL)
    with writer:
        assert len(writer) == len(expected)
    require_images(path, expected)


@pytest.mark.parametrize("num_images", [256, 257, 300])
def test_images_are_removed_across_the_end_of_a_retrieval_block(
    tmp_path: Path, num_images: int
) -> None:
    path = make_map(tmp_path / "a.tpmap", num_images)
    gone = {0, 3, 255, num_images - 1}
    with MapWriter.open(path, MODEL) as writer:
        for index in gone:
            writer.remove(f"folder/{index}.png")
    require_images(path, set(range(num_images)) - gone)
    with MapWriter.open(path, MODEL) as writer:
        for index in gone:
            add(writer, index)
    require_images(path, set(range(num_images)))


def test_a_reader_keeps_its_snapshot_while_images_are_removed(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 8)
    with MapReader.open(path) as reader:
        with MapWriter.open(path, MODEL) as writer:
            for index in range(7):
                writer.remove(f"folder/{index}.png")
                writer.commit()
        for index in range(8):
            require_image(reader, index)
        assert reader.refresh()
        assert reader.names() == ["folder/7.png"]


def test_an_exchange_of_one_image_for_another_is_a_change(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 2)
    with MapReader.open(path) as reader:
        with MapWriter.open(path, MODEL) as writer:
            writer.remove("folder/0.png")
            add(writer, 7)
        assert reader.refresh()
    require_images(path, {1, 7})


@pytest.mark.parametrize("name", ["folder/9.png", "", "a" * 501])
def test_a_name_that_is_not_there_is_an_error_and_changes_nothing(
    tmp_path: Path, name: str
) -> None:
    path = make_map(tmp_path / "a.tpmap", 2)
    before = path.read_bytes()
    with pytest.raises(DatabaseError, match=r"holds no image|has \d+ bytes"):
        MapWriter.open(path, MODEL).remove(name)
    assert path.read_bytes() == before


@pytest.mark.parametrize("in_one_commit", [True, False])
def test_many_images_that_come_and_go_leave_a_map_that_opens(
    tmp_path: Path, in_one_commit: bool
) -> None:
    """LMDB does not write pages that one commit takes and frees again, not even at the end."""
    path = make_map(tmp_path / "a.tpmap", 3)
    with MapWriter.open(path, MODEL) as writer:
        for index in range(3, 40):
            add(writer, index, features=make_features(index, 1000))
        if not in_one_commit:
            writer.commit()
        for index in range(3, 40):
            writer.remove(f"folder/{index}.png")
    require_images(path, {0, 1, 2})


def test_the_space_of_removed_images_is_used_again(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 120)
    for _ in range(20):
        with MapWriter.open(path, MODEL) as writer:
            writer.remove("folder/7.png")
        with MapWriter.open(path, MODEL) as writer:
            add(writer, 7)
    size = path.stat().st_size
    fresh = make_map(tmp_path / "b.tpmap", 120)
    assert size < 1.5 * fresh.stat().st_size
    require_images(path, set(range(120)))


def test_a_map_that_loses_many_images_at_once_can_be_written_again(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 300)
    with MapWriter.open(path, MODEL) as writer:
        for index in range(100):
            writer.remove(f"folder/{index}.png")
    with MapWriter.open(path, MODEL) as writer:
        add(writer, 300)
    require_images(path, set(range(100, 301)))
