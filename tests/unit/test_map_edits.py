"""Maps merged, split, compacted and compared, while readers have them open."""

import os
from contextlib import closing, suppress
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from tests.unit.maps import MODEL, add, make_features, make_map, make_pose, require_image
from tests.unit.test_database_processes import other_process, read_line, tell
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import compact_map, install_map, new_map
from trigpoint.database.snapshot import require_in_place
from trigpoint.database.writer import MapWriter, keep_writers_out
from trigpoint.errors import ConfigError, DatabaseError
from trigpoint.frame import ModelIdentity, PoseNoise, Session
from trigpoint.rigid import Rigid3
from trigpoint_db.maps import (
    compare_maps,
    count_sessions,
    find_session,
    leave_out,
    merge_maps,
    remove_images,
    split_map,
)

WINTER = Session("winter", date(2026, 1, 10))
NOISE = PoseNoise(0.01, 0.002, 0.001, 0.0001)


def make_part(path: Path, indices: range, session: Session | None = None) -> Path:
    with MapWriter.create(path, MODEL) as writer:
        for index in indices:
            add(writer, index, session=session)
        writer.set_pose_noise(NOISE)
    return path


def require_same_image(found: MapReader, expected: MapReader, name: str, prefix: str = "") -> None:
    i, j = found.names().index(prefix + name), expected.names().index(name)
    a, b = found.record(i), expected.record(j)
    assert (a.name, a.features, a.session) == (prefix + name, b.features, b.session)
    assert a.row.numbers.tolist() == b.row.numbers.tolist()
    x, y = found.anchor(i), expected.anchor(j)
    assert x.camera == y.camera
    np.testing.assert_array_equal(x.cam_from_world.R, y.cam_from_world.R)
    np.testing.assert_array_equal(x.cam_from_world.t, y.cam_from_world.t)
    np.testing.assert_array_equal(x.keypoints, y.keypoints)


def test_a_merged_map_has_the_images_and_the_sessions_of_both(tmp_path: Path) -> None:
    a = make_part(tmp_path / "a.tpmap", range(250), WINTER)
    b = make_part(tmp_path / "b.tpmap", range(250, 270))
    assert merge_maps(a, b, tmp_path / "c.tpmap") == 270
    with (
        MapReader.open(tmp_path / "c.tpmap") as merged,
        MapReader.open(a) as first,
        MapReader.open(b) as second,
    ):
        assert merged.verify() == []
        assert merged.pose_noise is None
        assert count_sessions(merged) == {WINTER: 250, None: 20}
        for index in (0, 249, 250, 269):
            require_image(merged, index)
            of = first if index < 250 else second
            require_same_image(merged, of, f"folder/{index}.png")
            (found,), _ = merged.search(make_features(index).global_descriptor, 1)
            assert found == index


def test_names_in_both_maps_are_an_error_unless_one_gets_a_prefix(tmp_path: Path) -> None:
    a = make_part(tmp_path / "a.tpmap", range(4), WINTER)
    b = make_part(tmp_path / "b.tpmap", range(3, 6), WINTER)
    with pytest.raises(ConfigError, match=r"1 names are in both maps, such as 'folder/3.png'"):
        merge_maps(a, b, tmp_path / "c.tpmap")
    assert not list(tmp_path.glob("c.tpmap*"))
    assert merge_maps(a, b, tmp_path / "c.tpmap", prefix="new/") == 7
    with MapReader.open(tmp_path / "c.tpmap") as merged, MapReader.open(b) as second:
        assert merged.verify() == []
        assert merged.sessions == (WINTER,)
        require_same_image(merged, second, "folder/3.png", "new/")


def test_maps_of_different_networks_are_not_merged_nor_is_a_map_overwritten(tmp_path: Path) -> None:
    a = make_map(tmp_path / "a.tpmap", 1)
    b = tmp_path / "b.tpmap"
    MapWriter.create(b, ModelIdentity("other", "1" * 64, 16, 32)).close()
    with pytest.raises(DatabaseError, match="made with model 'other'"):
        merge_maps(a, b, tmp_path / "c.tpmap")
    c = make_part(tmp_path / "c.tpmap", range(1, 2))
    before = b.read_bytes()
    with pytest.raises(DatabaseError, match="exists; name another file"):
        merge_maps(a, c, b)
    assert b.read_bytes() == before


def test_a_box_keeps_the_cameras_within_it(tmp_path: Path) -> None:
    path = make_part(tmp_path / "a.tpmap", range(60), WINTER)
    centers = np.array([make_pose(index).center for index in range(60)])
    low, high = np.percentile(centers, 20, axis=0), np.percentile(centers, 80, axis=0)
    inside = ((centers >= low) & (centers <= high)).all(axis=1)
    assert 3 < inside.sum() < 57
    count = split_map(path, [*low, *high], tmp_path / "b.tpmap")
    with MapReader.open(tmp_path / "b.tpmap") as part, MapReader.open(path) as whole:
        assert part.verify() == []
        assert count == len(part)
        assert part.names() == [f"folder/{index}.png" for index in np.flatnonzero(inside)]
        assert (part.pose_noise, part.sessions) == (NOISE, (WINTER,))
        for name in part.names():
            require_same_image(part, whole, name)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((0, 0, 0, -1, 1, 1), "is empty"),
        ((0, 0, 0, float("nan"), 1, 1), "is empty"),
        ((1e6, 0, 0, 2e6, 1, 1), "no camera of .* they are from"),
    ],
)
def test_a_box_without_a_camera_makes_no_map(
    tmp_path: Path, box: tuple[float, ...], message: str
) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with pytest.raises(ConfigError, match=message):
        split_map(path, box, tmp_path / "b.tpmap")
    assert not list(tmp_path.glob("b.tpmap*"))


def test_a_session_is_removed_as_a_whole(tmp_path: Path) -> None:
    path = make_part(tmp_path / "a.tpmap", range(5))
    with MapWriter.open(path, MODEL) as writer:
        for index in (5, 6):
            add(writer, index, session=WINTER)
    assert find_session(path, "winter") == ["folder/5.png", "folder/6.png"]
    remove_images(path, find_session(path, "winter"))
    with MapReader.open(path) as reader:
        assert sorted(reader.names()) == [f"folder/{index}.png" for index in range(5)]
    with pytest.raises(ConfigError, match="has no session 'summer'; it has winter"):
        find_session(path, "summer")


def test_images_are_removed_all_or_none(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with pytest.raises(DatabaseError, match=r"holds no image 'folder/9.png'"):
        remove_images(path, ["folder/1.png", "folder/9.png"])
    with MapReader.open(path) as reader:
        assert len(reader) == 3


def test_a_compacted_map_is_smaller_and_the_same_under_a_reader_that_has_it_open(
    tmp_path: Path,
) -> None:
    path = make_part(tmp_path / "a.tpmap", range(200), WINTER)
    path.chmod(0o640)
    with MapReader.open(path) as reader:
        remove_images(path, [f"folder/{index}.png" for index in range(20, 200)])
        before = path.stat().st_size
        compact_map(path)
        assert path.stat().st_size < before / 5
        assert path.stat().st_mode & 0o777 == 0o640
        assert len(reader) == 200
        assert reader.verify() == []
        assert reader.refresh()
        assert len(reader) == 20
        assert (reader.verify(), reader.sessions, reader.pose_noise) == ([], (WINTER,), NOISE)
        for index in range(20):
            require_image(reader, index)
        with MapWriter.open(path, MODEL) as writer:
            add(writer, 20)
        assert reader.refresh()
        require_image(reader, 20)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tpmap", "a.tpmap-lock"]


@pytest.mark.parametrize("num_commits", [1, 2])
def test_a_copy_of_a_snapshot_can_be_read_and_written(tmp_path: Path, num_commits: int) -> None:
    path, copy = make_part(tmp_path / "a.tpmap", range(9)), tmp_path / "b.tpmap"
    for index in range(9, 8 + num_commits):
        with MapWriter.open(path, MODEL) as writer:
            add(writer, index)
    with MapReader.open(path) as reader, copy.open("wb") as file:
        reader.copy_to(file.fileno())
        num_images = len(reader)
    with MapWriter.open(copy, MODEL) as writer:
        writer.remove("folder/3.png")
        add(writer, 20)
    with MapReader.open(copy) as reader:
        assert (len(reader), reader.verify()) == (num_images, [])
        require_image(reader, 0)


def test_a_map_that_was_replaced_meanwhile_is_not_replaced_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, new = make_part(tmp_path / "a.tpmap", range(10)), make_part(tmp_path / "b", range(20))

    def keep_out_too_late(fd: int) -> None:
        monkeypatch.undo()
        compact_map(path)
        keep_writers_out(fd)

    monkeypatch.setattr("trigpoint.database.replacing.keep_writers_out", keep_out_too_late)
    with pytest.raises(DatabaseError, match="was replaced while it was being opened"):
        install_map(new, path)
    with MapReader.open(path) as reader:
        assert len(reader) == 10


def test_a_link_to_a_map_stays_one_when_the_map_is_compacted(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    path = make_map(tmp_path / "maps" / "a.tpmap", 3)
    link = tmp_path / "link.tpmap"
    link.symlink_to(path)
    inode = path.stat().st_ino
    compact_map(link)
    assert link.is_symlink()
    assert path.stat().st_ino != inode
    with MapReader.open(link) as reader:
        assert (len(reader), reader.verify()) == (3, [])


def test_a_map_in_the_hands_of_a_writer_is_not_compacted(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with MapWriter.open(path, MODEL), pytest.raises(DatabaseError, match="another writer"):
        compact_map(path)


def test_a_damaged_map_is_not_compacted(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 30)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    with pytest.raises(DatabaseError, match="is damaged and stays as it is"):
        compact_map(path)
    assert path.read_bytes() == data


def test_readers_of_other_processes_move_to_a_compacted_map_and_keep_their_snapshots_there(
    tmp_path: Path,
) -> None:
    """Both must end up with one lock file, or a writer would overwrite what one of them reads."""
    path = make_map(tmp_path / "a.tpmap", 40)
    with other_process("check-on-demand", path) as a, other_process("check-on-demand", path) as b:
        assert read_line(a) == read_line(b) == "40 images, no problems"
        compact_map(path)
        with MapReader.open(path) as newcomer:
            for reader in (a, b):
                tell(reader, "refresh")
                assert read_line(reader) == "40 images, no problems"
            for index in range(10):
                remove_images(path, [f"folder/{index}.png"])
            for reader in (a, b):
                tell(reader, "look")
                assert read_line(reader) == "40 images, no problems"
            assert newcomer.verify() == []
        for reader in (a, b):
            tell(reader, "refresh")
            assert read_line(reader) == "30 images, no problems"


def test_a_writer_that_waited_while_the_map_was_replaced_does_not_write_to_the_old_file(
    tmp_path: Path,
) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    fd = os.open(path, os.O_RDWR)
    compact_map(path)
    with pytest.raises(DatabaseError, match="was replaced while it was being opened"):
        require_in_place(path, fd)
    os.close(fd)


def test_what_is_added_just_before_a_map_is_rewritten_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_part(tmp_path / "a.tpmap", range(10))
    open_writer = MapWriter.open

    def open_too_late(path: Path, model: ModelIdentity) -> MapWriter:
        with closing(open_writer(path, model)) as other:
            add(other, 10)
            other.commit()
        return open_writer(path, model)

    monkeypatch.setattr(MapWriter, "open", open_too_late)
    assert leave_out(path, ["folder/3.png"]) == 10
    with MapReader.open(path) as reader:
        assert reader.names()[-1] == "folder/10.png"


def test_a_map_that_fails_half_way_leaves_nothing(tmp_path: Path) -> None:
    with suppress(KeyboardInterrupt), new_map(tmp_path / "a.tpmap", MODEL) as writer:
        add(writer, 0)
        writer.commit()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_difference_names_each_image_and_what_of_it_changed(tmp_path: Path) -> None:
    a = make_part(tmp_path / "a.tpmap", range(6))
    moved = make_pose(1)
    moved = Rigid3.from_center(moved.R, moved.center + np.array([3.0, 4.0, 0.0]))
    other = Camera("PINHOLE", 640, 480, (501.0, 510.0, 319.5, 239.5))
    with MapWriter.create(tmp_path / "b.tpmap", MODEL) as writer:
        add(writer, 5)
        add(writer, 1, cam_from_world=moved)
        add(writer, 2, features=make_features(99))
        add(writer, 3, camera=other)
        add(writer, 4, session=WINTER)
        add(writer, 7)
    found = compare_maps(a, tmp_path / "b.tpmap")
    assert (found.added, found.removed, found.num_same) == (["folder/7.png"], ["folder/0.png"], 1)
    assert {change.name[7]: change.what for change in found.changed} == {
        "1": ("pose",), "2": ("features",), "3": ("camera",), "4": ("session",),
    }  # fmt: skip
    by_name = {change.name: change for change in found.changed}
    assert by_name["folder/1.png"].distance == pytest.approx(5)
    assert by_name["folder/1.png"].angle_deg == pytest.approx(0, abs=1e-5)
    assert by_name["folder/4.png"].sessions == ("", "winter (2026-01-10)")


def test_a_map_does_not_differ_from_its_compacted_self(tmp_path: Path) -> None:
    a = make_part(tmp_path / "a.tpmap", range(10), WINTER)
    b = tmp_path / "b.tpmap"
    b.write_bytes(a.read_bytes())
    compact_map(b)
    found = compare_maps(a, b)
    assert (found.added, found.removed, found.changed, found.num_same) == ([], [], [], 10)
