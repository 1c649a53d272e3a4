"""`trigpoint-db` as its users meet it: what it prints, and what it says of bad input."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import lmdb
import pytest

from tests.conftest import Demo
from tests.unit.conftest import Run
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.models.features import FeatureModel
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.colmap import read_model, write_model
from trigpoint_db.poses import read_poses


@pytest.fixture
def place(demo: Demo, tmp_path: Path) -> Path:
    """A survey of a dozen images, with its COLMAP model, to do harm to."""
    images = read_model(demo.folder / "sparse")[:12]
    (tmp_path / "images").mkdir()
    for image in images:
        shutil.copy(demo.folder / "survey" / image.name, tmp_path / "images")
    write_model(tmp_path / "sparse", images)
    lines = [f"{image.name} {CAMERA.to_text()}\n" for image in images]
    (tmp_path / "queries.txt").write_text("".join(lines[:3]))
    return tmp_path


def build(place: Path, name: str = "m.tpmap", *more: object) -> list[object]:
    return ["build", place / name, place, *more]


def add(place: Path, *more: object) -> list[object]:
    return ["add", *build(place, "m.tpmap", *more)[1:]]


def test_from_images_to_numbers(run: Run, place: Path) -> None:
    code, out, _ = run(*build(place, "m.tpmap", "--json"))
    assert code == 0
    assert json.loads(out)["num_images_added"] == 12
    code, out, _ = run(
        "localize", place / "m.tpmap", "--images", place / "images",
        "--queries", place / "queries.txt", "--poses", place / "poses.txt",
        "--results", place / "results.jsonl", "--anchors", 10, "--json",
    )  # fmt: skip
    assert code == 0
    assert json.loads(out) == {"num_queries": 3, "outcomes": {"LOCALIZED": 3}}
    results = [json.loads(line) for line in (place / "results.jsonl").read_text().splitlines()]
    assert all(6 <= result["num_anchors"] <= 10 for result in results)
    code, out, _ = run(
        "evaluate", "--poses", place / "poses.txt", "--truth", place / "sparse",
        "--queries", place / "queries.txt", "--json",
    )  # fmt: skip
    assert code == 0
    # The queries are in the map: what is left is the noise of its own keypoints.
    assert json.loads(out)["median_position_m"] < 0.01


def test_info_and_verify_speak_json_too(run: Run, demo: Demo) -> None:
    code, out, _ = run("info", demo.map, "--json")
    assert code == 0
    assert json.loads(out)["num_images"] == 140
    code, out, _ = run("verify", demo.map, "--json")
    assert code == 0
    assert json.loads(out)["problems"] == []


def test_verify_finds_what_was_altered(run: Run, demo: Demo, tmp_path: Path) -> None:
    data = bytearray(demo.map.read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "altered.tpmap").write_bytes(data)
    code, out, _ = run("verify", tmp_path / "altered.tpmap")
    assert code == 1
    assert "damaged" in out or "checksum" in out


def test_images_are_added_to_a_map_once(run: Run, place: Path) -> None:
    names = [image.name for image in read_model(place / "sparse")]
    (place / "first.txt").write_text("\n".join(names[:5]))
    (place / "rest.txt").write_text("\n".join(names[5:]))
    assert run(*build(place, "m.tpmap", "--list", place / "first.txt"))[0] == 0
    assert run(*add(place, "--list", place / "rest.txt"))[0] == 0
    code, _, err = run(*add(place))
    assert code == 1
    assert "already" in err
    assert run(*add(place, "--skip-existing"))[0] == 0
    _, out, _ = run("info", place / "m.tpmap", "--json")
    assert json.loads(out)["num_images"] == 12


def test_an_existing_map_is_not_overwritten(run: Run, place: Path) -> None:
    assert run(*build(place))[0] == 0
    before = (place / "m.tpmap").read_bytes()
    code, _, err = run(*build(place))
    assert code == 1
    assert "exists" in err
    assert (place / "m.tpmap").read_bytes() == before


def test_a_corrupt_image_leaves_no_half_made_map(run: Run, place: Path) -> None:
    image = sorted((place / "images").glob("*.jpg"))[6]
    image.write_bytes(b"not a picture")
    code, _, err = run(*build(place))
    assert code == 1
    assert str(image) in err
    assert "\n" not in err
    assert not list(place.glob("m.tpmap*"))


def test_missing_images_are_counted_before_any_work(run: Run, place: Path) -> None:
    for image in sorted((place / "images").glob("*.jpg"))[3:5]:
        image.unlink()
    code, _, err = run(*build(place))
    assert code == 1
    assert "2 images are missing" in err


def test_a_corrupt_query_does_not_cost_the_others(run: Run, place: Path) -> None:
    assert run(*build(place))[0] == 0
    names = [line.split()[0] for line in (place / "queries.txt").read_text().splitlines()]
    (place / "images" / names[1]).write_bytes(b"\xff\xd8 not a picture")
    code, _, err = run(
        "localize", place / "m.tpmap", "--images", place / "images",
        "--queries", place / "queries.txt", "--poses", place / "poses.txt",
        "--results", place / "results.jsonl",
    )  # fmt: skip
    assert code == 1
    assert "1 queries failed" in err
    assert set(read_poses(place / "poses.txt")) == {names[0], names[2]}
    results = [json.loads(line) for line in (place / "results.jsonl").read_text().splitlines()]
    assert results[1]["reason"] == "BAD_FRAME"


def test_a_recording_needs_cameras_for_its_images(run: Run, place: Path) -> None:
    out = place / "r.mcap"
    code, _, err = run("record", out, "--images", place / "images")
    assert code == 1
    assert "--camera" in err
    code, _, err = run("record", out, "--images", place / "images", "--camera", "THIN_PRISM 1 1 1")
    assert code == 1
    assert "'THIN_PRISM' is not known" in err
    assert not out.exists()


def test_what_a_killed_command_left_is_removed_by_the_next(run: Run, place: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    leftover = place / f"s.tpmap.{ended.pid}.partial"
    leftover.write_bytes(b"half a map")
    of_another = place / f"s.tpmap.{os.getppid()}.partial"
    of_another.write_bytes(b"half a map")
    assert run(*build(place))[0] == 0
    everywhere = "--box=-9,-9,-9,9,9,9"
    assert run("split", place / "m.tpmap", everywhere, "-o", place / "s.tpmap")[0] == 0
    assert not leftover.exists()
    assert of_another.exists()


@pytest.mark.parametrize("at", ["the file", "LMDB's pages", "the first commit"])
def test_a_build_killed_before_its_first_image_is_begun_anew(
    run: Run, place: Path, model: FeatureModel, at: str
) -> None:
    partial = place / "m.tpmap.partial"
    if at == "the file":
        partial.touch()
    elif at == "LMDB's pages":
        lmdb.open(str(partial), subdir=False).close()
    else:
        MapWriter.create(partial, model.identity).close()
    assert run(*build(place))[0] == 0
    assert not list(place.glob("m.tpmap.*"))


def test_sigterm_leaves_nothing_half_built(run: Run, place: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "trigpoint_db.cli", *map(str, build(place))],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    while process.poll() is None and not list(place.glob("m.tpmap.partial")):
        time.sleep(0.01)
    process.terminate()
    process.wait(20)
    assert not (place / "m.tpmap").exists()
    assert run(*build(place))[0] == 0  # without --resume
    assert not list(place.glob("m.tpmap.*"))


def test_no_map_is_made_of_what_is_all_left_out(run: Run, place: Path) -> None:
    (place / "one.txt").write_text("000000.jpg\n")
    code, _, err = run(*build(place, "m.tpmap", "--list", place / "one.txt", "--select"))
    assert code == 1
    assert "would leave out all 1 images" in err
    assert not (place / "m.tpmap").exists()
    resumed = build(place, "m.tpmap", "--list", place / "one.txt", "--resume")
    assert run(*resumed)[0] == 0


def test_an_empty_list_makes_no_map(run: Run, place: Path) -> None:
    (place / "none.txt").write_text("# nothing\n")
    code, _, err = run(*build(place, "m.tpmap", "--list", place / "none.txt"))
    assert code == 1
    assert "no images to map" in err


def test_inputs_and_devices_are_not_written_over(run: Run, place: Path) -> None:
    assert run(*build(place))[0] == 0
    asked = ["localize", place / "m.tpmap", "--images", place / "images"]
    asked += ["--queries", place / "queries.txt", "--poses"]
    image = place / "images" / "000000.jpg"
    before = (place / "queries.txt").read_bytes(), image.read_bytes()
    for output, said in (
        (place / "queries.txt", "it is an input"),
        (image, "it is an input"),
        (place / "m.tpmap", "it is an input"),
        (Path("/dev/null"), "not a regular file"),
        (place / "nowhere" / "poses.txt", "there is no folder"),
    ):
        code, _, err = run(*asked, output)
        assert code == 1
        assert said in err
        code, _, err = run(*asked, place / "p.txt", "--results", output)
        assert code == 1
        assert said in err
    assert ((place / "queries.txt").read_bytes(), image.read_bytes()) == before
    assert Path("/dev/null").is_char_device()
    assert run("verify", place / "m.tpmap")[0] == 0


def test_a_recording_is_not_overwritten(run: Run, place: Path) -> None:
    asked = ["record", place / "r.mcap", "--images", place / "images"]
    asked += ["--queries", place / "queries.txt"]
    assert run(*asked)[0] == 0
    before = (place / "r.mcap").read_bytes()
    code, _, err = run(*asked)
    assert code == 1
    assert "exists" in err
    assert (place / "r.mcap").read_bytes() == before


def test_the_demo_keeps_a_folder_of_other_things(run: Run, place: Path) -> None:
    code, _, err = run("demo", place)
    assert code == 1
    assert "holds no demo" in err


def test_nothing_is_sent_home(demo: Demo, tmp_path: Path) -> None:
    """onnxruntime collects usage data unless it is told not to before it is imported."""
    done = subprocess.run(
        [sys.executable, "-m", "trigpoint_db.cli", "info", str(demo.map)],
        env={**os.environ, "HOME": str(tmp_path)}, capture_output=True, check=True,
    )  # fmt: skip
    assert done.stderr == b""
    assert list(tmp_path.iterdir()) == []


def test_a_compact_map_is_built_and_added_to(run: Run, place: Path) -> None:
    names = [image.name for image in read_model(place / "sparse")]
    for path, part in (("first.txt", names[:8]), ("others.txt", names[8:])):
        (place / path).write_text("\n".join(part))
    first = build(place, "m.tpmap", "--list", place / "first.txt", "--profile", "compact")
    assert run(*first)[0] == 0
    assert run(*add(place, "--list", place / "others.txt"))[0] == 0
    facts = json.loads(run("info", place / "m.tpmap", "--json")[1])
    assert (facts["profile"], facts["num_images"]) == ("compact", 12)
    assert facts["bytes"] < 12 * 30_000


def test_queries_are_localized_around_prior_positions(run: Run, place: Path) -> None:
    assert run(*build(place))[0] == 0
    images = read_model(place / "sparse")[:2]
    centers = [
        image.cam_from_world.center + offset for image, offset in zip(images, (0, 500), strict=True)
    ]
    lines = [f"{i.name} {x} {y} {z} 5\n" for i, (x, y, z) in zip(images, centers, strict=True)]
    (place / "priors.txt").write_text("".join(lines))
    arguments = [
        "localize", place / "m.tpmap", "--images", place / "images",
        "--queries", place / "queries.txt", "--poses", place / "poses.txt", "--json",
    ]  # fmt: skip
    code, out, _ = run(*arguments, "--priors", place / "priors.txt")
    assert code == 0
    assert json.loads(out)["outcomes"] == {"LOCALIZED": 2, "FEW_ANCHORS": 1}
    assert list(read_poses(place / "poses.txt")) == [
        images[0].name,
        read_model(place / "sparse")[2].name,
    ]
    (place / "priors.txt").write_text("other.jpg 0 0 0 1\n")
    code, _, err = run(*arguments, "--priors", place / "priors.txt")
    assert code == 1
    assert "names none of the images" in err


def test_resume_does_what_is_left_after_the_mapping(
    run: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    asked = build(place, "m.tpmap", "--select", "--density", "10%", "--json")
    code, out, _ = run(*asked)
    assert code == 0
    whole = json.loads(out)
    assert 2 <= whole["num_images_added"] < 12
    (place / "m.tpmap").rename(place / "whole.tpmap")
    with monkeypatch.context() as stopped:
        stopped.setattr("trigpoint_db.commands.build.calibrate_map", interrupt)
        code, _, err = run(*asked)
        assert code == 130
        assert "goes on with --resume" in err
    assert not (place / "m.tpmap").exists()
    code, out, _ = run(*asked, "--resume")
    assert code == 0
    assert json.loads(out)["num_images_added"] == whole["num_images_added"]
    with MapReader.open(place / "m.tpmap") as a, MapReader.open(place / "whole.tpmap") as b:
        assert (a.names(), a.pose_noise) == (b.names(), b.pose_noise)
    assert not list(place.glob("m.tpmap.*"))


def test_add_says_how_it_goes_on(run: Run, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    (place / "first.txt").write_text("000000.jpg\n000005.jpg\n")
    assert run(*build(place, "m.tpmap", "--list", place / "first.txt"))[0] == 0
    monkeypatch.setattr("trigpoint_db.commands.build.calibrate_map", interrupt)
    code, _, err = run(*add(place, "--skip-existing", "--select"))
    assert code == 130
    assert "goes on with --skip-existing; `trigpoint-db select` finds what it should" in err
    with MapReader.open(place / "m.tpmap") as reader:
        assert reader.verify() == []


def test_what_cannot_be_written_is_said_before_the_work(
    run: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = SimpleNamespace(access=lambda *_: False, W_OK=os.W_OK)  # as for who is not root
    monkeypatch.setattr("trigpoint.output.os", nothing)
    asked = ["localize", "no.tpmap", "--images", place, "--queries", place / "queries.txt"]
    code, _, err = run(*asked, "--poses", place / "p.txt")
    assert (code, "p.txt: permission denied" in err) == (1, True)


def test_one_file_is_not_written_twice_and_no_input_is(run: Run, place: Path) -> None:
    assert run(*build(place))[0] == 0
    priors = place / "priors.txt"
    priors.write_text("000000.jpg 0 0 0 1\n")
    asked = ["localize", place / "m.tpmap", "--images", place / "images"]
    asked += ["--queries", place / "queries.txt", "--priors", priors, "--poses"]
    code, _, err = run(*asked, place / "p.txt", "--results", place / "p.txt")
    assert (code, "it is named twice" in err) == (1, True)
    code, _, err = run(*asked, priors)
    assert (code, "it is an input" in err) == (1, True)
    assert priors.read_text() == "000000.jpg 0 0 0 1\n"
