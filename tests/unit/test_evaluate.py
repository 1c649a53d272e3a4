"""Errors with known answers; failures count as failures."""

from __future__ import annotations

import io
import json
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from tests.unit.conftest import Run
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3, rotation_from_vector
from trigpoint_db.evaluate import Evaluation, evaluate, plot_paths
from trigpoint_db.poses import write_poses

quick = settings(max_examples=40)
draws = pytest.mark.skipif(find_spec("matplotlib") is None, reason="needs trigpoint[plots]")


def pose(center: tuple[float, float, float], yaw_deg: float = 0.0) -> Rigid3:
    R = rotation_from_vector(np.array([0.3, -0.4, 0.5]))  # any: errors do not depend on it
    return Rigid3.from_center(
        rotation_from_vector(np.deg2rad([0, 0, yaw_deg])) @ R, np.array(center)
    )


def with_errors(*errors: float) -> Evaluation:
    """Evaluate queries of given position errors in m and rotation errors ten times that in deg."""
    truth = {str(i): pose((i, 1, 2)) for i in range(len(errors))}
    estimates = {
        str(i): pose((i, 1, 2 + error), 10 * error)
        for i, error in enumerate(errors)
        if np.isfinite(error)
    }
    return evaluate(estimates, truth, list(truth))


def test_errors_are_the_distance_of_the_centers_and_the_angle_between_the_cameras() -> None:
    truth = {"a": pose((1, 2, 3)), "b": pose((0, 0, 0)), "c": pose((5, 5, 5))}
    estimates = {"a": pose((1, 5, -1), 30), "b": pose((0, 0, 0), -180), "other": pose((9, 9, 9))}
    evaluation = evaluate(estimates, truth, ["b", "a"])
    assert evaluation.names == ("b", "a")
    np.testing.assert_allclose(evaluation.position_errors_m, [0, 5], atol=1e-12)
    np.testing.assert_allclose(evaluation.rotation_errors_deg, [180, 30], atol=1e-9)


def test_a_query_without_an_estimate_has_infinite_errors() -> None:
    evaluation = with_errors(0.1, np.inf, 0.3)
    np.testing.assert_allclose(evaluation.position_errors_m, [0.1, np.inf, 0.3], atol=1e-12)
    np.testing.assert_allclose(evaluation.rotation_errors_deg, [1, np.inf, 3], atol=1e-9)
    assert (evaluation.num_queries, evaluation.num_localized) == (3, 2)


def test_medians_and_percentiles_are_over_all_queries() -> None:
    evaluation = with_errors(0.2, 0.1, np.inf, 0.4)
    assert evaluation.median_position_m == pytest.approx(0.3)  # of .1 .2 .4 inf
    assert evaluation.median_rotation_deg == pytest.approx(3)
    assert evaluation.p90_position_m == evaluation.p90_rotation_deg == np.inf
    assert evaluation.localized_median_position_m == pytest.approx(0.2)
    assert evaluation.localized_median_rotation_deg == pytest.approx(2)


def test_a_percentile_that_touches_a_failure_is_infinite() -> None:
    assert with_errors(0.1, 0.2, np.inf, np.inf).median_position_m == np.inf
    assert with_errors(0.1, 0.2, np.inf).median_position_m == pytest.approx(0.2)
    assert with_errors(*[0.1] * 10, np.inf).p90_position_m == pytest.approx(0.1)
    assert with_errors(*[0.1] * 9, np.inf).p90_position_m == np.inf


@given(st.lists(st.floats(0, 10), min_size=1, max_size=20))
@quick
def test_without_failures_percentiles_are_numpys(errors: list[float]) -> None:
    evaluation = with_errors(*errors)
    expected = np.percentile(evaluation.position_errors_m, [50, 90])
    found = (evaluation.median_position_m, evaluation.p90_position_m)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert evaluation.median_position_m == evaluation.localized_median_position_m


def test_recall_counts_failures_and_asks_for_both_errors() -> None:
    truth = {name: pose((0, 0, 0)) for name in "abcde"}
    estimates = {
        "a": pose((0.2, 0, 0), 1),
        "b": pose((0.2, 0, 0), 3),  # too much turned for the first level
        "c": pose((0.4, 0, 0), 1),  # too far for it
        "d": pose((1, 0, 0), 11),  # too much turned for any
    }
    assert evaluate(estimates, truth, list("abcde")).recalls == (0.2, 0.6, 0.6)


def test_where_nothing_is_localized_every_error_is_infinite() -> None:
    evaluation = with_errors(np.inf, np.inf)
    assert evaluation.median_position_m == evaluation.localized_median_position_m == np.inf
    assert evaluation.recalls == (0, 0, 0)


def test_json_has_null_for_what_is_infinite() -> None:
    found = json.loads(json.dumps(with_errors(0.125, np.inf).to_json(), allow_nan=False))
    assert (found["num_queries"], found["num_localized"]) == (2, 1)
    assert found["median_position_m"] is found["p90_rotation_deg"] is None
    assert found["localized_median_position_m"] == pytest.approx(0.125)
    assert found["recalls"][0] == {"position_m": 0.25, "rotation_deg": 2, "recall": 0.5}
    assert found["queries"]["0"]["rotation_error_deg"] == pytest.approx(1.25)
    assert found["queries"]["1"] == {"position_error_m": None, "rotation_error_deg": None}


def test_the_table_shows_the_statistics() -> None:
    console = Console(file=io.StringIO(), width=100)
    with_errors(0.125, 0.125, np.inf).print_table(console)
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    for shown in ("2 of 3 queries localized", "0.125", "1.25", "inf", "0.25 m, 2 deg", "66.7%"):
        assert shown in text


def test_queries_without_truth_are_an_error_that_lists_the_first() -> None:
    with pytest.raises(ConfigError, match=r"^4 of 5 queries have no true pose: b, c, d, \.\.\.$"):
        evaluate({}, {"a": pose((0, 0, 0))}, list("abcde"))


def test_no_queries_are_an_error() -> None:
    with pytest.raises(ConfigError, match="no queries"):
        evaluate({}, {}, [])


def test_estimates_under_other_names_are_an_error() -> None:
    with pytest.raises(ConfigError, match=r"none of the 1 estimates \(a\.png\) .*\(a\.jpg\)"):
        evaluate({"a.png": pose((0, 0, 0))}, {"a.jpg": pose((0, 0, 0))}, ["a.jpg"])


def circle(count: int) -> dict[str, Rigid3]:
    """Make poses along a circle, named by their times: as text they would sort otherwise."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return {
        str(i * 10**8): pose((3 * np.cos(angle), 2 * np.sin(angle), 1))
        for i, angle in enumerate(angles)
    }


@draws
@pytest.mark.parametrize(
    "truth",
    [circle(30), {"0": pose((1, 2, 3))}, {str(i): pose((0, i, 0)) for i in range(5)}],
    ids=["circle", "one pose", "line"],
)
def test_a_picture_is_drawn_of_any_path_and_any_outcome(
    tmp_path: Path, truth: dict[str, Rigid3]
) -> None:
    far = {name: pose((1000, 0, 0)) for name in truth}
    for name, estimates in {"exact": truth, "none": {}, "far": far}.items():
        plot_paths(estimates, truth, tmp_path / f"{name}.png")
        image = cv2.imread(str(tmp_path / f"{name}.png"))
        assert image is not None
        assert min(image.shape[:2]) > 500
        assert image.std() > 10


@draws
def test_the_picture_shows_errors_and_where_nothing_was_localized(tmp_path: Path) -> None:
    truth = circle(8)
    names = list(truth)
    estimates = {name: truth[name] for name in names[1:]}
    estimates[names[1]] = pose((0, 50, 0))
    plot_paths(estimates, truth, tmp_path / "paths.svg")
    text = (tmp_path / "paths.svg").read_text()
    # The letters are drawn as outlines, and the text stands beside as a comment.
    assert "<!-- 7 of 8 localized, median position error 0.0 mm -->" in text
    assert "<!-- not localized (1) -->" in text
    assert "<!-- estimate (7, 1 of them outside) -->" in text


@draws
def test_the_path_follows_the_times_that_are_its_names(tmp_path: Path) -> None:
    truth = circle(30)
    padded = {name.zfill(20): truth[name] for name in reversed(truth)}
    plot_paths({}, truth, tmp_path / "times.png")
    plot_paths({}, padded, tmp_path / "padded.png")
    times, other = (cv2.imread(str(tmp_path / f"{n}.png")) for n in ("times", "padded"))
    assert times is not None
    assert other is not None
    np.testing.assert_array_equal(times, other)


@draws
def test_a_picture_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot write .*paths\.png: there is no folder"):
        plot_paths({}, circle(3), tmp_path / "missing" / "paths.png")
    with pytest.raises(ConfigError, match=r"cannot draw .*paths\.xyz; name it .png"):
        plot_paths({}, circle(3), tmp_path / "paths.xyz")


def test_without_matplotlib_the_error_says_what_to_install(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match=r"pip install 'trigpoint\[plots\]'"):
        plot_paths({}, circle(3), tmp_path / "paths.png")
    write_poses(tmp_path / "poses.txt", circle(3))
    asked = ["--poses", tmp_path / "poses.txt", "--truth", tmp_path / "poses.txt"]
    code, out, said = run("evaluate", *asked, "--picture", tmp_path / "paths.png")
    assert (code, out) == (1, "")  # before anything is compared
    assert "pip install 'trigpoint[plots]'" in said


@draws
def test_the_picture_is_named_as_it_is(run: Run, tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.txt", circle(3))
    asked = ["--poses", tmp_path / "poses.txt", "--truth", tmp_path / "poses.txt"]
    (tmp_path / "a[").mkdir()
    code, out, _ = run("evaluate", *asked, "--picture", tmp_path / "a[" / "b].png")
    assert code == 0
    assert f"picture: {tmp_path}/a[/b].png" in out
