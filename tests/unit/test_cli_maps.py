"""The commands on maps in use: what they print, and what they say of bad input."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.writer import Writer

from tests.conftest import Demo
from tests.unit.conftest import Run
from tests.unit.maps import MODEL, add, make_map, make_pose
from tests.unit.test_latency import write_log
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import Session
from trigpointd.config import Config, LogConfig, McapConfig
from trigpointd.service import run as run_daemon


@pytest.fixture
def map_(tmp_path: Path) -> Path:
    """Six images, the last two of a session."""
    path = make_map(tmp_path / "m.tpmap", 4)
    with MapWriter.open(path, MODEL) as writer:
        for index in (4, 5):
            add(writer, index, session=Session("winter"))
    return path


def names(path: Path) -> list[str]:
    with MapReader.open(path) as reader:
        assert reader.verify() == []
        return sorted(reader.names())


def test_info_counts_the_images_of_each_session(run: Run, map_: Path) -> None:
    code, out, _ = run("info", map_, "--json")
    assert code == 0
    assert json.loads(out)["sessions"] == [
        {"name": "winter", "date": None, "num_images": 2},
        {"name": None, "date": None, "num_images": 4},
    ]
    code, out, _ = run("info", map_)
    assert code == 0
    assert "session winter" in out


def test_images_are_removed_by_name_by_list_and_by_session(run: Run, map_: Path) -> None:
    listed = map_.with_name("stale.txt")
    listed.write_text("folder/1.png\nfolder/2.png\n")
    asked = ["remove", map_, "folder/2.png", "--names", listed, "--session", "winter", "--json"]
    code, out, _ = run(*asked)
    assert code == 0
    assert json.loads(out)["num_images_removed"] == 4
    assert names(map_) == ["folder/0.png", "folder/3.png"]
    listed.write_text("")  # what `usage --unused` has found: nothing
    assert run("remove", map_, "--names", listed)[:2] == (0, f"{map_}: 0 images removed\n")
    for arguments, said in (
        ([], "there is nothing to remove"),
        (["folder/0.png", "folder/7.png"], "holds no image 'folder/7.png'"),
        (["--session", "summer"], "has no session 'summer'"),
    ):
        code, _, err = run("remove", map_, *arguments)
        assert code == 1
        assert said in err
        assert "\n" not in err
    assert names(map_) == ["folder/0.png", "folder/3.png"]


def test_maps_are_split_and_merged_again(run: Run, map_: Path) -> None:
    center = make_pose(3).center
    box = ",".join(str(c - 1e-6) for c in center) + "," + ",".join(str(c + 1e-6) for c in center)
    part, rest = map_.with_name("part.tpmap"), map_.with_name("rest.tpmap")
    code, out, _ = run("split", map_, f"--box={box}", "-o", part, "--json")
    assert (code, json.loads(out)["num_images"]) == (0, 1)
    rest.write_bytes(map_.read_bytes())
    assert run("remove", rest, "folder/3.png")[0] == 0
    merged = map_.with_name("merged.tpmap")
    code, out, _ = run("merge", rest, part, "-o", merged, "--json")
    assert (code, json.loads(out)["num_images"]) == (0, 6)
    code, out, _ = run("diff", map_, merged)
    assert (code, out) == (0, "0 added, 0 removed, 0 changed, 6 the same\n")
    code, _, err = run("merge", rest, part, "-o", merged)
    assert code == 1
    assert "exists; name another file" in err


@pytest.mark.parametrize("box", ["1,2,3", "a,b,c,d,e,f", ""])
def test_a_box_that_is_none_says_what_it_should_be(run: Run, map_: Path, box: str) -> None:
    code, _, err = run("split", map_, f"--box={box}", "-o", map_.with_name("part.tpmap"))
    assert code == 1
    assert "--box wants xmin,ymin,zmin,xmax,ymax,zmax" in err


def test_a_difference_is_a_line_an_image(run: Run, map_: Path) -> None:
    other = map_.with_name("other.tpmap")
    other.write_bytes(map_.read_bytes())
    with MapWriter.open(other, MODEL) as writer:
        writer.remove("folder/0.png")
        writer.remove("folder/4.png")
        add(writer, 4)
        add(writer, 9)
    code, out, _ = run("diff", map_, other)
    assert code == 0
    assert out.splitlines() == [
        "+ folder/9.png",
        "- folder/0.png",
        "~ folder/4.png: session none was winter",
        "1 added, 1 removed, 1 changed, 4 the same",
    ]
    code, out, _ = run("diff", map_, other, "--json")
    found = json.loads(out)
    assert (found["added"], found["removed"]) == (["folder/9.png"], ["folder/0.png"])
    assert found["changed"][0]["what"] == ["session"]


def test_a_map_is_compacted_in_place(run: Run, map_: Path) -> None:
    for index in range(4):
        assert run("remove", map_, f"folder/{index}.png")[0] == 0
    code, out, _ = run("compact", map_, "--json")
    assert code == 0
    sizes = json.loads(out)
    assert sizes["bytes"] == map_.stat().st_size < sizes["bytes_before"]
    assert names(map_) == ["folder/4.png", "folder/5.png"]
    code, _, err = run("compact", map_.with_name("none.tpmap"))
    assert code == 1
    assert "no such map" in err


def test_a_map_is_made_compact_and_gets_an_index(run: Run, map_: Path) -> None:
    assert run("compact", map_, "--profile", "compact", "--index")[0] == 0
    facts = json.loads(run("info", map_, "--json")[1])
    assert (facts["profile"], facts["has_index"]) == ("compact", True)
    assert run("compact", map_, "--no-index")[0] == 0
    facts = json.loads(run("info", map_, "--json")[1])
    assert (facts["profile"], facts["has_index"]) == ("compact", False)
    assert len(names(map_)) == 6
    code, _, err = run("compact", map_, "--profile", "standard")
    assert code == 1
    assert "does not come back; rebuild it" in err


def status(outcome: str, **inliers: int) -> dict[str, object]:
    """What a daemon says of a frame that was matched with some images of the map."""
    anchors = [f"folder/{name[1:]}.png" for name in inliers]
    of_each = list(inliers.values()) if outcome == "LOCALIZED" else []
    return {"status": outcome, "anchors": anchors, "anchor_inliers": of_each}


def test_usage_counts_frames_by_image_and_by_session(run: Run, map_: Path, tmp_path: Path) -> None:
    first = write_log(
        tmp_path / "first.mcap",
        status("LOCALIZED", _0=7, _1=0, _4=0),
        status("LOST", _0=0, _1=0),
        {"status": "FAILED", "reason": "BAD_FRAME"},
    )
    second = write_log(tmp_path / "second.mcap", status("LOCALIZED", _0=0, _1=0, _4=3))
    code, out, _ = run("usage", map_, first, second, "--min-frames", 2, "--json")
    assert code == 0
    found = json.loads(out)
    assert (found["num_frames"], found["num_unused"]) == (4, 1)
    by_image = {of["name"]: list(of.values())[1:] for of in found["images"]}
    assert by_image == {
        "folder/0.png": [3, 2, 1], "folder/1.png": [3, 2, 0], "folder/2.png": [0, 0, 0],
        "folder/3.png": [0, 0, 0], "folder/4.png": [2, 2, 1], "folder/5.png": [0, 0, 0],
    }  # fmt: skip
    by_session = {of["name"]: list(of.values())[1:] for of in found["sessions"]}
    assert by_session == {"": [6, 4, 1], "winter": [2, 2, 1]}
    code, out, _ = run("usage", map_, first, second)
    assert code == 0
    assert "4 frames; 3 images were not retrieved, 0 are without use" in out


def test_images_without_use_go_from_the_map_by_their_list(
    run: Run, map_: Path, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log.mcap", *[status("LOCALIZED", _0=7, _1=0)] * 10)
    cut = tmp_path / "cut.mcap"  # as a crash leaves it at its start
    cut.write_bytes(log.read_bytes()[:60])
    code, out, _ = run("usage", map_, log, cut, log, "--unused", "--min-frames", 10)
    assert (code, out) == (0, "folder/1.png\n")
    (tmp_path / "unused.txt").write_text(out)
    assert run("remove", map_, "--names", tmp_path / "unused.txt")[0] == 0
    assert "folder/1.png" not in names(map_)


def test_a_log_that_is_none_of_the_daemons_is_an_error(
    run: Run, map_: Path, tmp_path: Path
) -> None:
    with (tmp_path / "empty.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    write_log(tmp_path / "older.mcap", {"status": "LOCALIZED", "anchors": ["a"]})
    write_log(tmp_path / "list.mcap", [1])
    for name, said in (
        ("empty", "there is no status in"),
        ("older", "is not a status of this version's trigpointd"),
        ("list", "is not a status of this version's trigpointd"),
        ("none", "cannot read"),
    ):
        code, _, err = run("usage", map_, tmp_path / f"{name}.mcap")
        assert code == 1
        assert said in err
        assert "\n" not in err


def test_the_log_of_a_flight_says_which_images_were_of_use(
    run: Run, demo: Demo, tmp_path: Path
) -> None:
    log = tmp_path / "log.mcap"
    source = McapConfig(type="mcap", path=demo.recording)
    totals = run_daemon(Config(map=demo.map, source=source, log=LogConfig(path=log, frames=False)))
    code, out, _ = run("usage", demo.map, log, "--json")
    assert code == 0
    found = json.loads(out)
    num_localized = totals.outcomes["LOCALIZED"]
    assert (found["num_frames"], num_localized) == (16, 16)
    supported = [of["num_supported"] for of in found["images"]]
    assert 2 * num_localized <= sum(supported) <= 8 * num_localized  # the last refinement's
    assert sum(of["num_retrieved"] for of in found["images"]) >= 6 * 16


def test_names_are_shown_as_they_are(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "a.tpmap"
    with MapWriter.create(path, replace(MODEL, name="own[/a] [b]")) as writer:
        add(writer, 0, session=Session("floor[/2] [a]"))
    code, out, _ = run("info", path)
    assert code == 0
    assert "of session floor[/2] [a]" in out
    assert "own[/a] [b] (000000000000)" in out
