"""The paper's main tables, end to end on rendered scenes in the layouts of the public data sets."""

from __future__ import annotations

import json
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.unit.conftest import Run
from tests.unit.layouts import (
    View,
    write_cambridge,
    write_pseudo_truth,
    write_robotcar,
    write_seven_scenes,
)
from tests.unit.posed_sets import write_set
from trigpoint.models.features import FeatureModel
from trigpoint_db.experiments.benchmarks import read_benchmark
from trigpoint_db.experiments.scenes import draw, measure, write_table
from trigpoint_db.experiments.store import Store, read_result
from trigpoint_db.poses import read_poses

draws = pytest.mark.skipif(find_spec("matplotlib") is None, reason="needs trigpoint[plots]")
pytestmark = draws  # every command draws what it has measured


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """7-Scenes as its owners offer it, one scene of it, with both ground truths."""
    root = tmp_path_factory.mktemp("7scenes")
    views = write_seven_scenes(root / "chess")
    (root / "pgt" / "sfm").mkdir(parents=True)
    write_pseudo_truth(root / "pgt" / "sfm" / "7scenes", "chess", list(views))
    return root


@pytest.fixture(scope="session")
def tiny() -> FeatureModel:
    return FeatureModel.load("tiny")


def rows_of(table: str, title: str) -> list[list[str]]:
    rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines())
    return [row for row in rows if title in row]


def test_7_scenes_is_judged_by_both_ground_truths(run: Run, rooms: Path, tmp_path: Path) -> None:
    code, out, err = run(
        "experiment", "7scenes", "--root", rooms, "--output", tmp_path, "--model", "tiny", "--json"
    )
    assert code == 0, err
    parts = json.loads(out)["parts"]
    assert [(part["column"], part["variant"]) for part in parts] == [
        ("Chess", "Kinect"),
        ("Chess", "SfM"),
    ]
    for part in parts:
        counts = [part[f"num_{what}"] for what in ("mapped", "queries", "localized", "judged")]
        assert counts == [3, 3, 3, 3]
        assert 0 < part["median_position_m"] < 0.03
        assert part["recalls"] == [1.0, 1.0, 1.0]
    table = write_table(read_result(tmp_path / "7scenes.json"))
    assert rows_of(table, "the paper")[0][2] == "0.68/0.02"
    ours = rows_of(table, "**Trigpoint, SfM**")[0]
    assert ours[2] == f"{parts[1]['median_rotation_deg']:.2f}/{parts[1]['median_position_m']:.3f}"
    assert ours[3:] == ["-"] * 7  # the average is of all scenes or of none
    assert "DenseVLAD+Inter. and GeM have the same numbers for Pumpkin, Kitchen, Stairs" in table
    assert (tmp_path / "7scenes.png").stat().st_size > 0
    code, _, err = run("experiment", "page", tmp_path, tmp_path / "docs")
    assert code == 0, err
    assert (
        f"## 7-Scenes\n\n![7-Scenes](images/experiments/7scenes.png)\n\n{table}"
        in (tmp_path / "docs" / "experiments.md").read_text()
    )


def test_cambridge_has_the_scale_of_its_owners(run: Run, tmp_path: Path) -> None:
    write_cambridge(tmp_path / "data" / "ShopFacade")
    code, out, err = run(
        "experiment", "cambridge", "--root", tmp_path / "data", "--scene", "ShopFacade",
        "--output", tmp_path, "--model", "tiny",
    )  # fmt: skip
    assert code == 0, err
    (part,) = read_result(tmp_path / "cambridge.json")["parts"]
    assert (part["column"], part["num_mapped"], part["num_queries"]) == ("Shop", 3, 2)
    assert part["median_position_m"] < 0.03  # of a room metres wide
    assert "degrees/metres for both data sets" in out
    assert rows_of(out, "the paper")[0][2:] == [
        "0.05/0.09", "0.09/0.07", "0.20/0.11", "0.10/0.02", "0.09/0.03", "0.11/0.06",
    ]  # fmt: skip


def test_aachen_is_written_for_submission(
    run: Run, town: tuple[Path, dict[str, View]], tmp_path: Path
) -> None:
    root, views = town
    code, out, err = run(
        "experiment", "aachen", "--root", root, "--output", tmp_path, "--model", "tiny"
    )
    assert code == 0, err
    parts = {part["column"]: part for part in read_result(tmp_path / "aachen.json")["parts"]}
    assert [parts[time]["num_queries"] for time in ("Day", "Night")] == [2, 1]
    assert all(part["num_judged"] == 0 and "recalls" not in part for part in parts.values())
    submitted = read_poses(tmp_path / "aachen_submission.txt")
    assert len(submitted) == sum(part["num_localized"] for part in parts.values()) > 0
    queries = {Path(name).name: view for name, view in views.items() if "query" in name}
    for name, cam_from_world in submitted.items():
        assert cam_from_world.center == pytest.approx(queries[name].cam_from_world.center, abs=0.05)
    assert "The true poses of 3 of the 3 queries are not public" in out
    assert "The paper counts 4,328 reference images, and 3 are mapped here" in out


def test_robotcar_is_judged_where_a_pose_is_public(run: Run, tmp_path: Path) -> None:
    write_robotcar(tmp_path / "data")
    code, out, err = run(
        "experiment", "robotcar", "--root", tmp_path / "data", "--output", tmp_path,
        "--model", "tiny",
    )  # fmt: skip
    assert code == 0, err
    parts = {part["column"]: part for part in read_result(tmp_path / "robotcar.json")["parts"]}
    assert [parts[time]["num_judged"] for time in ("Day", "Night")] == [1, 0]
    assert parts["Day"]["recalls"] == [1.0, 1.0, 1.0]
    assert rows_of(out, "**Trigpoint**")[0][2:] == ["100.0/100.0/100.0", "-"]
    assert "Ours is judged on the 1 queries with a public pose" in out
    assert "rear/1418721355046418.jpg" in read_poses(tmp_path / "robotcar_submission.txt")


def test_a_sequence_of_redkitchen_is_split_in_two_ways(run: Run, tmp_path: Path) -> None:
    write_set(tmp_path / "data" / "7scenes_redkitchen", 10)
    code, out, err = run(
        "experiment", "redkitchen", "--data", tmp_path / "data", "--output", tmp_path,
        "--model", "tiny",
    )  # fmt: skip
    assert code == 0, err
    parts = read_result(tmp_path / "redkitchen.json")["parts"]
    assert [part["variant"] for part in parts] == ["every fifth image", "whole stretches"]
    assert all(part["num_localized"] == part["num_queries"] == 2 for part in parts)
    assert rows_of(out, "the paper") == [["", "the paper", "1.18/0.04"]]
    assert "ours are no rows of it" in out


class Interrupted(Store):
    """Somebody presses Ctrl-C after so many queries."""

    left = 2

    def __setitem__(self, key: str, value: Any) -> None:
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        super().__setitem__(key, value)


def test_an_interrupted_run_goes_on_where_it_was(
    rooms: Path, tiny: FeatureModel, tmp_path: Path
) -> None:
    scenes = read_benchmark("7scenes", rooms)
    with pytest.raises(KeyboardInterrupt):
        measure("7scenes", scenes, tiny, 20, Interrupted(tmp_path))
    units = tmp_path / "7scenes.jsonl"
    settings, first, second = units.read_text().splitlines()
    lost = json.loads(first) | {"value": "FEW_MATCHES"}  # what is there is not done again
    units.write_text("\n".join([settings, json.dumps(lost), second]) + "\n")
    (map_,) = (tmp_path / "maps").glob("*.tpmap")
    before = map_.stat().st_mtime_ns
    result = measure("7scenes", scenes, tiny, 20, Store(tmp_path))
    assert map_.stat().st_mtime_ns == before
    assert [part["num_localized"] for part in result["parts"]] == [2, 3]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["7scenes", "--scene", "cellar"], "there is no scene 'cellar'; use chess, fire, heads"),
        (["7scenes", "--scene", "fire"], "fire holds no scene; --root is the folder with chess"),
        (["cambridge"], "GreatCourt holds no scene; --root is the folder with GreatCourt"),
        (["aachen"], "is not the folder of Aachen Day-Night v1.1"),
        (["robotcar"], "is not the folder of RobotCar Seasons"),
    ],
)
def test_what_is_no_data_set_is_said_in_a_line(
    run: Run, rooms: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    code, _, err = run("experiment", *arguments, "--root", rooms, "--output", tmp_path)
    assert code == 1
    assert message in err
    assert "\n" not in err.strip()


def test_an_image_that_is_missing_is_found_before_any_work(
    run: Run, rooms: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "data" / "chess"
    scene.mkdir(parents=True)
    for name in ("TrainSplit.txt", "TestSplit.txt"):
        (scene / name).write_text((rooms / "chess" / name).read_text())
    for path in (rooms / "chess").glob("*/*.pose.txt"):
        (scene / path.parent.name).mkdir(exist_ok=True)
        (scene / path.parent.name / path.name).write_text(path.read_text())
    code, _, err = run("experiment", "7scenes", "--root", tmp_path / "data", "--output", tmp_path)
    assert code == 1
    assert "3 images are missing" in err


def make_result(benchmark: str, column: str, deg: float | None, m: float | None) -> dict[str, Any]:
    part = {
        "column": column, "variant": "", "num_mapped": 9, "num_queries": 4, "num_localized": 4,
        "num_judged": 4, "median_rotation_deg": deg, "median_position_m": m,
        "recalls": [0.25, 0.5, 1.0],
    }  # fmt: skip
    return {"benchmark": benchmark, "model": "x", "num_anchors": 20, "parts": [part]}


@pytest.mark.parametrize(
    ("deg", "m", "said"),
    [
        (0.01, 0.5, "in 0 of 1 scenes in metres and 1 in degrees"),
        (0.5, 0.01, "in 1 of 1 scenes in metres and 0 in degrees"),
        (None, None, "in 0 of 1 scenes in metres and 0 in degrees"),
    ],
)
def test_who_is_better_follows_from_the_numbers(
    deg: float | None, m: float | None, said: str
) -> None:
    table = write_table(make_result("cambridge", "King's", deg, m))
    assert f"Trigpoint is below the paper's printed median {said}" in table


def test_half_of_the_queries_lost_leaves_no_median() -> None:
    table = write_table(make_result("cambridge", "Court", None, None))
    assert rows_of(table, "**Trigpoint**")[0][2] == "-"
    assert rows_of(table, "Court")[1][5:] == ["-", "-", "25.0", "50.0", "100.0"]


@pytest.mark.parametrize(
    ("benchmark", "column"), [("7scenes", "Fire"), ("redkitchen", "Kitchen"), ("aachen", "Day")]
)
def test_pictures_are_small(tmp_path: Path, benchmark: str, column: str) -> None:
    path = tmp_path / "picture.png"
    draw(make_result(benchmark, column, 0.2, 0.01), path)
    assert re.match(rb"\x89PNG", path.read_bytes())
    assert path.stat().st_size < 150_000
