"""A survey with a frame of its own is brought into the frame of a map."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Demo
from tests.unit.conftest import Run
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import new_map
from trigpoint.geometry.similarity import Similarity3
from trigpoint.rigid import rotation_angle, rotation_from_vector
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model, write_model

MAP_FROM_SURVEY = Similarity3(
    3.7, rotation_from_vector(np.array([0.4, -1.1, 2.0])), np.array([12.0, -3.0, 40.0])
)


def take_away(images: list[PosedImage]) -> list[PosedImage]:
    """Give a survey a frame and a unit of its own."""
    away = MAP_FROM_SURVEY.inverse()
    return [replace(i, cam_from_world=away.move(i.cam_from_world)) for i in images]


@pytest.fixture(scope="module")
def halves(demo: Demo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of every other image, and the others as a survey of their own."""
    folder = tmp_path_factory.mktemp("halves")
    with (
        MapReader.open(demo.map) as reader,
        new_map(folder / "m.tpmap", reader.model) as writer,
    ):
        for index in range(0, len(reader), 2):
            record = reader.record(index)
            writer.add_record(record, record.name)
        writer.set_pose_noise(reader.pose_noise)
    write_model(folder / "survey", take_away(read_model(demo.folder / "sparse")[1::2]))
    return folder


def require_back(demo: Demo, aligned: list[PosedImage], tolerance_m: float) -> None:
    truth = {i.name: i.cam_from_world for i in read_model(demo.folder / "sparse")}
    for image in aligned:
        expected = truth[image.name]
        error = np.linalg.norm(image.cam_from_world.center - expected.center)
        assert error < tolerance_m
        turned = rotation_angle(image.cam_from_world.R @ expected.R.T)
        assert np.rad2deg(turned) < 0.2


def test_a_survey_comes_back_into_the_frame_of_the_map(
    run: Run, demo: Demo, halves: Path, tmp_path: Path
) -> None:
    asked = ["align", halves / "m.tpmap", halves / "survey", "--images", demo.folder / "survey"]
    code, out, _ = run(*asked, "-o", tmp_path / "aligned", "--sample", 24, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["num_tried"] == 24
    assert found["num_agreeing"] >= 20
    assert abs(found["scale"] / MAP_FROM_SURVEY.scale - 1) < 0.01
    aligned = read_model(tmp_path / "aligned")
    assert len(aligned) == 70
    require_back(demo, aligned, 0.02)
    code, _, err = run(*asked, "-o", tmp_path / "aligned")
    assert code == 1
    assert "holds a COLMAP model already" in err


def test_an_aligned_survey_can_be_added_at_once_as_a_session(
    run: Run, demo: Demo, halves: Path, tmp_path: Path
) -> None:
    map_ = tmp_path / "m.tpmap"
    map_.write_bytes((halves / "m.tpmap").read_bytes())
    write_model(tmp_path / "survey", read_model(halves / "survey")[:60:5])
    code, out, _ = run(
        "align", map_, tmp_path / "survey", "--images", demo.folder / "survey",
        "--apply", "--session", "spring", "--date", "2026-04-01",
    )  # fmt: skip
    assert code == 0
    assert "12 images of the survey" in out
    with MapReader.open(map_) as reader:
        assert (len(reader), reader.verify()) == (82, [])
        assert [str(session) for session in reader.sessions_by_index()[70:]] == [
            "spring (2026-04-01)"
        ] * 12
        added = [reader.anchor(index) for index in range(70, 82)]
    require_back(demo, [PosedImage(a.name, a.camera, a.cam_from_world) for a in added], 0.03)


def test_an_aligned_survey_is_added_in_parts_without_what_is_there(
    run: Run, demo: Demo, halves: Path, tmp_path: Path
) -> None:
    map_ = tmp_path / "m.tpmap"
    map_.write_bytes((halves / "m.tpmap").read_bytes())
    names = [image.name for image in read_model(halves / "survey")]
    asked = ["align", map_, halves / "survey", "--images", demo.folder / "survey", "--apply"]
    for part, num_added in ((names[:12], 12), (names[:15], 3)):
        (tmp_path / "part.txt").write_text("\n".join(part))
        code, out, _ = run(*asked, "--list", tmp_path / "part.txt", "--skip-existing")
        assert code == 0
        assert out.endswith(f"{map_}: {num_added} images of the survey added\n")
    with MapReader.open(map_) as reader:
        assert reader.names()[70:] == names[:15]


def test_poses_that_do_not_fit_together_are_refused(
    run: Run, demo: Demo, halves: Path, tmp_path: Path
) -> None:
    images = read_model(halves / "survey")[:60:5]
    poses = [image.cam_from_world for image in images]
    shuffled = [replace(images[i], cam_from_world=poses[(5 * i + 1) % 12]) for i in range(12)]
    write_model(tmp_path / "survey", shuffled)
    asked = ["align", halves / "m.tpmap", tmp_path / "survey", "--images", demo.folder / "survey"]
    code, _, err = run(*asked, "-o", tmp_path / "aligned")
    assert code == 1
    assert "localized images agree" in err
    assert "\n" not in err
    assert not (tmp_path / "aligned").exists()


def test_why_images_are_lost_is_said(run: Run, demo: Demo, halves: Path, tmp_path: Path) -> None:
    images = read_model(halves / "survey")[::7]
    halved = [replace(image, camera=replace(image.camera, width=64)) for image in images]
    write_model(tmp_path / "survey", halved)
    asked = ["align", halves / "m.tpmap", tmp_path / "survey", "--images", demo.folder / "survey"]
    code, _, err = run(*asked, "-o", tmp_path / "aligned")
    assert code == 1
    assert "0 of 10 images of the survey were localized in the map (BAD_FRAME: " in err


def test_what_is_asked_for_is_checked_before_any_work(
    run: Run, demo: Demo, halves: Path, tmp_path: Path
) -> None:
    asked = ["align", halves / "m.tpmap", halves / "survey", "--images", demo.folder / "survey"]
    for arguments, said in (
        ([], "give -o"),
        (["-o", tmp_path / "out", "--date", "2026-04-01"], "give its name with --session"),
        (["-o", halves / "survey"], "holds a COLMAP model already"),
        (["-o", halves / "m.tpmap"], "is no folder; name a new one"),
        (["-o", tmp_path / "out", "--pose-topic", "/pose"], "has no use for --pose-topic"),
    ):
        code, _, err = run(*asked, *arguments)
        assert code == 1
        assert said in err
    of_the_map = demo.folder / "sparse"
    code, _, err = run("align", halves / "m.tpmap", of_the_map, *asked[3:], "--apply")
    assert code == 1
    assert "holds 70 of 140 images already" in err
