"""hloc's files: what is read, what is written, and what is refused with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.frame import Prior
from trigpoint.rigid import Rigid3, rotation_from_vector
from trigpoint_db.poses import (
    Query,
    read_names,
    read_poses,
    read_priors,
    read_queries,
    sort_names,
    write_poses,
)

quick = settings(max_examples=40)
poses = st.builds(
    lambda rotvec, t: Rigid3(rotation_from_vector(np.array(rotvec)), np.array(t)),
    st.tuples(*[st.floats(-4, 4)] * 3),
    st.tuples(*[st.floats(-1e6, 1e6)] * 3),
)
names = st.text("ab/ é_.-17", min_size=1, max_size=8).filter(lambda name: name == name.strip())


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_names_are_read_in_their_order_without_comments_and_blank_lines(tmp_path: Path) -> None:
    path = write(tmp_path / "map.txt", "# images\nb.jpg\n\n  a and b.jpg \r\né/#1.jpg")
    assert read_names(path) == ["b.jpg", "a and b.jpg", "é/#1.jpg"]


def test_the_names_of_queries_are_those_of_their_images(tmp_path: Path) -> None:
    text = "a 1.jpg PINHOLE 640 480 500 501 320.5 240.5\nb.jpg SIMPLE_PINHOLE 640 480 5 3 2\n"
    path = write(tmp_path / "queries.txt", text)
    assert read_names(path) == ["a 1.jpg", "b.jpg"] == [query.name for query in read_queries(path)]


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    assert read_names(write(tmp_path / "map.txt", "\ufeffa.jpg\n")) == ["a.jpg"]


def test_queries_come_with_cameras_in_our_pixel_convention(tmp_path: Path) -> None:
    path = write(
        tmp_path / "queries.txt",
        "# name, model, size, parameters\n"
        "b/2.jpg SIMPLE_PINHOLE 640 480 525.5 320 240\n\n"
        "a 1.jpg\tPINHOLE  640 480 500 501 320.5 240.5\n",
    )
    assert read_queries(path) == [
        Query("b/2.jpg", Camera("SIMPLE_PINHOLE", 640, 480, (525.5, 319.5, 239.5))),
        Query("a 1.jpg", Camera("PINHOLE", 640, 480, (500, 501, 320, 240))),
    ]


@given(st.tuples(*[st.floats(1, 1e4)] * 4), names)
@quick
def test_a_query_written_as_text_reads_back(
    tmp_path_factory: pytest.TempPathFactory, params: tuple[float, ...], name: str
) -> None:
    camera = Camera("PINHOLE", 640, 480, params)
    path = write(tmp_path_factory.mktemp("q") / "queries.txt", f"{name} {camera.to_text()}\n")
    (query,) = read_queries(path)
    assert (query.name, query.camera.model, query.camera.width) == (name, "PINHOLE", 640)
    np.testing.assert_allclose(query.camera.params, params, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("b.jpg", "expected 'name MODEL width height params...', not 'b.jpg'"),
        ("b.jpg 640 480 500 320 240", "expected 'name MODEL"),
        ("b.jpg PINHOLE 640.5 480 500 500 320 240", "expected 'name MODEL"),
        ("PINHOLE 640 480 500 500 320 240", "expected 'name MODEL"),
        ("b.jpg PINHOLE 640 480 500 500 320", "takes 4 parameters"),
        ("b.jpg PINHOLE 640 480 500 500 320 x", "cannot read a camera"),
        ("b.jpg PINHOLE 640 480 500 500 320 inf", "must be finite"),
        ("b.jpg FOV 640 480 500 500 320 240 0.9", "'FOV' is not known"),
        ("a.jpg PINHOLE 640 480 500 500 320 240", "a.jpg is in this file twice"),
    ],
)
def test_an_error_in_queries_names_its_line(tmp_path: Path, line: str, message: str) -> None:
    text = f"a.jpg PINHOLE 640 480 500 500 320 240\n\n{line}\n"
    with pytest.raises(ConfigError, match=rf"queries\.txt:3: .*{message}"):
        read_queries(write(tmp_path / "queries.txt", text))


def test_poses_are_cam_from_world_with_w_first(tmp_path: Path) -> None:
    path = write(tmp_path / "poses.txt", "# comment\n\na b.jpg 0.5 0.5 0.5 0.5 1 2 3\n")
    ((name, pose),) = read_poses(path).items()
    assert name == "a b.jpg"
    np.testing.assert_allclose(pose.apply(np.array([4.0, 5, 6])), [7, 6, 8], atol=1e-15)


def test_a_quaternion_of_another_length_is_normalised(tmp_path: Path) -> None:
    (pose,) = read_poses(write(tmp_path / "poses.txt", "a 0 -3 0 0 1 2 3")).values()
    np.testing.assert_allclose(pose.R, np.diag([1.0, -1, -1]), atol=1e-15)


@given(st.dictionaries(names, poses, max_size=5))
@quick
def test_written_poses_read_back(
    tmp_path_factory: pytest.TempPathFactory, written: dict[str, Rigid3]
) -> None:
    path = tmp_path_factory.mktemp("poses") / "poses.txt"
    write_poses(path, written)
    read = read_poses(path)
    assert list(read) == sort_names(written)
    for name, pose in written.items():
        np.testing.assert_allclose(read[name].R, pose.R, atol=1e-14)
        np.testing.assert_array_equal(read[name].t, pose.t)


def test_equal_poses_make_equal_files(tmp_path: Path) -> None:
    a = Rigid3(rotation_from_vector(np.array([0.1, 0.2, 0.3])), np.array([0.1, 1e-20, 1 / 3]))
    b = Rigid3(a.R.copy(), a.t.copy())
    write_poses(tmp_path / "one.txt", {"10": a, "9": b})
    write_poses(tmp_path / "two.txt", {"9": a, "10": b})
    text = (tmp_path / "one.txt").read_bytes()
    assert text == (tmp_path / "two.txt").read_bytes()
    assert [line.split()[0] for line in text.splitlines()] == [b"9", b"10"]
    assert text.endswith(b" 0.1 1e-20 0.3333333333333333\n")


def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path: Path) -> None:
    path = write(tmp_path / "poses.txt", "before")
    (tmp_path / "poses.txt.partial").mkdir()  # where the new one would be written first
    with pytest.raises(ConfigError, match=r"cannot write .*poses\.txt"):
        write_poses(path, {"a": Rigid3.identity()})
    assert path.read_text() == "before"


def test_nothing_but_the_file_is_left_behind(tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.txt", {"a": Rigid3.identity()})
    assert [path.name for path in tmp_path.iterdir()] == ["poses.txt"]


@pytest.mark.parametrize("name", ["", " a", "a\n", "a\rb", "#a", "\ud800", "\ufeffa", "\x1b[2J"])
def test_a_name_that_would_not_read_back_is_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=r"cannot stand in .*poses\.txt; rename"):
        write_poses(tmp_path / "poses.txt", {"ok": Rigid3.identity(), name: Rigid3.identity()})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("b 1 0 0 0 1 2", "expected 'name qw qx qy qz tx ty tz', not 'b 1 0 0 0 1 2'"),
        ("1 0 0 0 1 2 3", "expected 'name qw"),
        ("b 1 0 0 0 1 2 z", "expected 'name qw"),
        ("b 0 0 0 0 1 2 3", "quaternion 0.0 0.0 0.0 0.0 is not one of a rotation"),
        ("b OPENCV 640 480 733.6 733.6 319.5 239.5 0 0 0 0", "is not one of a rotation"),
        ("b 1e-300 0 0 0 1 2 3", "is not one of a rotation"),
        ("b nan 0 0 0 1 2 3", "is not finite"),
        ("b 1 0 0 0 1 2 -inf", "is not finite"),
        ("a 1 0 0 0 1 2 3", "a is in this file twice"),
    ],
)
def test_an_error_in_poses_names_its_line(tmp_path: Path, line: str, message: str) -> None:
    path = write(tmp_path / "poses.txt", f"# poses\na 1 0 0 0 1 2 3\n\n{line}\n")
    with pytest.raises(ConfigError, match=rf"poses\.txt:4: .*{message}"):
        read_poses(path)


def test_a_name_twice_in_a_list_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"map\.txt:2: a is in this file twice"):
        read_names(write(tmp_path / "map.txt", "a\na\n"))


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*missing\.txt: No such file"):
        read_names(tmp_path / "missing.txt")
    with pytest.raises(ConfigError, match=r"cannot read .*: Is a directory"):
        read_poses(tmp_path)
    (tmp_path / "latin.txt").write_bytes("é".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"latin\.txt: it is not UTF-8"):
        read_queries(tmp_path / "latin.txt")


def test_names_sort_by_value_where_all_are_integers() -> None:
    assert sort_names(["10", "9", "-1"]) == ["-1", "9", "10"]
    assert sort_names(["10", "9", "a"]) == ["10", "9", "a"]
    assert sort_names([]) == []


def test_priors_are_positions_with_a_radius_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "priors.txt", "# GPS\na b.jpg 1 -2.5 3e2 10\nc.jpg 0 0 0 0.5\n")
    assert read_priors(path) == {
        "a b.jpg": Prior((1.0, -2.5, 300.0), 10.0),
        "c.jpg": Prior((0.0, 0.0, 0.0), 0.5),
    }


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a 1 2 3", "expected 'name x y z radius'"),
        ("a 1 2 x 4", "expected 'name x y z radius'"),
        ("a 1 2 3 0", "a radius above 0"),
        ("a 1 2 nan 1", "three numbers"),
        ("b 1 2 3 4", "twice"),
    ],
)
def test_an_error_in_priors_names_its_line(tmp_path: Path, line: str, message: str) -> None:
    path = write(tmp_path / "priors.txt", f"b 1 2 3 4\n{line}\n")
    with pytest.raises(ConfigError, match=f"priors.txt:2: .*{message}"):
        read_priors(path)


def test_names_are_kept_as_cameras_and_screens_give_them(tmp_path: Path) -> None:
    names = ["Screenshot 10.20.30\u202fAM.png", "a\u200db.jpg", "a\u2028b.jpg"]
    poses = dict.fromkeys(names, Rigid3.identity())
    write_poses(tmp_path / "poses.txt", poses)
    assert sorted(read_poses(tmp_path / "poses.txt")) == sorted(names)


def test_a_name_with_numbers_in_it_is_no_camera(tmp_path: Path) -> None:
    name = "Trip IMG 20240101 123456 copy.jpg"
    other = "b.jpg FOV 640 480 500 500 320 240 0.9"  # of COLMAP; its name is all that is asked for
    assert read_names(write(tmp_path / "map.txt", f"{name}\n{other}\n")) == [name, "b.jpg"]
