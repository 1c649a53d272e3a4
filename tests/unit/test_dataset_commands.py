"""The commands on data sets: what `build` makes of a SOURCE, `queries`, `submit`, `datasets`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.unit.conftest import Run
from tests.unit.layouts import POSES, View, write_cambridge
from trigpoint_db.importers.colmap import write_model
from trigpoint_db.importers.registry import read_dataset
from trigpoint_db.poses import read_poses, read_queries, write_poses


def test_from_a_data_set_to_numbers(
    run: Run, scene: tuple[Path, dict[str, View]], tmp_path: Path
) -> None:
    root, _ = scene
    files = {name: tmp_path / name for name in ("m.tpmap", "queries.txt", "truth.txt", "poses.txt")}
    code, _, err = run("build", files["m.tpmap"], root, "--model", "tiny")
    assert code == 0, err
    code, out, _ = run(
        "queries", root, files["queries.txt"], "--truth", files["truth.txt"], "--json"
    )
    assert code == 0
    report = json.loads(out)
    assert report == {
        "queries": str(files["queries.txt"]), "images": str(root),
        "num_queries": 3, "num_true_poses": 3,
    }  # fmt: skip
    code, _, err = run(
        "localize", files["m.tpmap"], "--images", root, "--queries", files["queries.txt"],
        "--poses", files["poses.txt"], "--model", "tiny",
    )  # fmt: skip
    assert code == 0, err
    code, out, _ = run(
        "evaluate", "--poses", files["poses.txt"], "--truth", files["truth.txt"], "--json"
    )
    assert json.loads(out)["num_localized"] == 3
    assert json.loads(out)["median_position_m"] < 0.03


def test_queries_are_chosen_by_their_names(run: Run, town_copy: Path, tmp_path: Path) -> None:
    code, out, _ = run("queries", town_copy, tmp_path / "q.txt", "--select", "query/day/*")
    assert code == 0
    assert "2 queries, 0 true poses" in out
    assert len(read_queries(tmp_path / "q.txt")) == 2
    for more, said in (
        (["--select", "*.png"], "no queries like '*.png'"),
        (["--truth", tmp_path / "t.txt"], "no true poses"),
    ):
        code, _, err = run("queries", town_copy, tmp_path / "q.txt", *more)
        assert code == 1
        assert said in err


def test_what_is_of_the_data_set_is_not_written_over(run: Run, town_copy: Path) -> None:
    taken = next(path for path in town_copy.rglob("*") if path.is_file())
    before = taken.read_bytes()
    code, _, err = run("queries", town_copy, taken)
    assert code == 1
    assert "may be a file of the data set" in err
    assert taken.read_bytes() == before


@pytest.mark.parametrize(
    ("benchmark", "names", "submitted"),
    [
        ("aachen", ["query/day/nexus4/IMG_1.jpg", "query/night/2.jpg"], ["2.jpg", "IMG_1.jpg"]),
        ("robotcar", ["dawn/rear/7.png", "night/rear/9.jpg"], ["rear/7.jpg", "rear/9.jpg"]),
    ],
)
def test_submissions_have_the_names_of_the_benchmark(
    run: Run, tmp_path: Path, benchmark: str, names: list[str], submitted: list[str]
) -> None:
    poses, out = tmp_path / "poses.txt", tmp_path / "submission.txt"
    write_poses(poses, dict(zip(names, [POSES[0], POSES[1]], strict=True)))
    code, _, err = run("submit", benchmark, poses, "-o", out)
    assert code == 0, err
    assert list(read_poses(out)) == submitted
    first = out.read_text().splitlines()[0]
    of_first = POSES[names.index(next(n for n in names if Path(n).stem == Path(submitted[0]).stem))]
    written = [float(word) for word in first.split()[1:]]
    np.testing.assert_allclose(written, [*of_first.quaternion, *of_first.t])


@pytest.mark.parametrize(
    ("benchmark", "names", "message"),
    [
        ("kitti", ["a.jpg"], "there is no benchmark 'kitti'; use aachen or robotcar"),
        ("robotcar", ["dawn/left/7.jpg"], "dawn/left/7.jpg is not CONDITION/rear/TIME.jpg"),
        ("aachen", ["query/day/1.jpg", "query/night/1.jpg"], "two poses are of an image 1.jpg"),
    ],
)
def test_what_a_benchmark_does_not_take_is_not_written(
    run: Run, tmp_path: Path, benchmark: str, names: list[str], message: str
) -> None:
    write_poses(tmp_path / "poses.txt", dict.fromkeys(names, POSES[0]))
    code, _, err = run("submit", benchmark, tmp_path / "poses.txt", "-o", tmp_path / "out.txt")
    assert code == 1
    assert message in err
    assert not (tmp_path / "out.txt").exists()


def test_a_folder_of_two_formats_is_not_guessed(run: Run, tmp_path: Path) -> None:
    views = write_cambridge(tmp_path)
    write_model(tmp_path / "sparse", read_dataset(tmp_path).mapped)
    code, _, err = run("build", tmp_path / "m.tpmap", tmp_path)
    assert code == 1
    assert "could be colmap or cambridge; say --format colmap, cambridge" in err
    assert {i.name for i in read_dataset(tmp_path, "cambridge").mapped} <= set(views)


def test_what_has_no_format_is_said_with_all_of_them(run: Run, tmp_path: Path) -> None:
    for source, more, said in (
        (tmp_path / "missing", [], "there is no"),
        (tmp_path, [], "has no format that is known; say --format colmap, hloc, 7scenes"),
        (tmp_path, ["--format", "slam"], "there is no format 'slam'; use one of colmap"),
        (tmp_path, ["--format", "colmap", "--poses", tmp_path], "colmap has no use for --poses"),
    ):
        code, _, err = run("build", tmp_path / "m.tpmap", source, *more)
        assert code == 1
        assert said in err
        assert "\n" not in err


def test_public_sets_are_told_with_their_terms_and_commands(run: Run) -> None:
    code, out, _ = run("datasets", "--json")
    assert code == 0
    for public in json.loads(out):
        assert public["url"].startswith("https://")
        assert public["terms"]
    code, out, _ = run("datasets")
    assert code == 0
    assert "trigpoint-db build chess.tpmap chess" in out
