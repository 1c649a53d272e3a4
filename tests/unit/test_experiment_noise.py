"""The synthetic experiment: what it draws, what it makes of curves, and that it runs as a whole."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.unit.conftest import Run
from trigpoint_db.experiments import noise
from trigpoint_db.experiments.store import Store, read_result

CENTER, TRANSLATION = slice(0, 2), slice(2, 4)


@pytest.mark.parametrize(("perturbed", "origin"), noise.SETUPS)
def test_without_noise_every_method_is_exact(perturbed: str, origin: float) -> None:
    assert noise.run_trials(5, perturbed, "both", 0.0, origin).max() < 1e-6


def test_the_center_does_not_depend_on_rotations_nor_on_the_origin() -> None:
    turned = noise.run_trials(5, "(R_kq, T_kq)", "rotation", 2.0, 3.0)
    assert turned[:, CENTER].max() < 1e-6
    assert turned[:, TRANSLATION].min() > 0.1
    here, far = (
        noise.run_trials(5, "(R_kq, T_kq)", "both", 2.0, origin) for origin in (0.0, 100.0)
    )
    np.testing.assert_allclose(far[:, CENTER], here[:, CENTER], rtol=1e-6)
    assert np.median(far[:, TRANSLATION]) > 10 * np.median(here[:, TRANSLATION])


def test_at_the_query_the_origin_makes_both_closed_forms_one() -> None:
    errors = noise.run_trials(5, "(R_kq, T_kq)", "translation", 2.0, noise.AT_QUERY)
    columns = dict(zip(noise.METHODS, errors.T, strict=True))
    np.testing.assert_allclose(columns[noise.OURS], columns[noise.CLOSED_FORM], rtol=1e-9)


def curve(*medians: float) -> list[dict[str, float]]:
    return [{"median": median} for median in medians]


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [
        (curve(1, 2, 3), curve(2, 4, 6), noise.HOLDS),
        (curve(1, 2, 3), curve(2, 4, 4.5), "better at all, the gap does not grow steadily"),
        (curve(1, 2, 3), curve(2, 1, 6), "better at 2 of 3"),
        (curve(1, 2, 3), curve(0.5, 1, 1), "worse at all"),
        (curve(1, 2, 3), curve(1, 2 + 1e-9, 3), "the same"),
    ],
)
def test_the_claim_is_judged_by_the_curves(
    ours: list[dict[str, float]], theirs: list[dict[str, float]], verdict: str
) -> None:
    levels = [{"ours": a, "theirs": b} for a, b in zip(ours, theirs, strict=True)]
    assert noise.compare(levels, "ours", "theirs") == verdict


def test_the_interval_holds_the_median_and_narrows_with_more_trials() -> None:
    errors = np.random.default_rng(0).normal(10, 1, 6400)
    few, many = noise.summarize(errors[:100]), noise.summarize(errors)
    for summary in (few, many):
        assert summary["low"] <= summary["median"] <= summary["high"]
    assert many["high"] - many["low"] < 0.3 * (few["high"] - few["low"])


def test_the_command_measures_prints_and_draws(tmp_path: Path, run: Run) -> None:
    code, out, _ = run("experiment", "noise", "--output", tmp_path, "--trials", 20)
    assert code == 0
    result = read_result(tmp_path / "noise.json")
    assert len(result["levels"]) == len(noise.SETUPS) * len(noise.NOISES) * len(noise.NOISE_DEG)
    assert out.strip() == noise.write_table(result)
    picture = cv2.imread(str(tmp_path / "noise.png"))
    assert picture is not None
    assert picture.std() > 5


def test_a_result_is_the_same_after_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(noise, "NOISE_DEG", (1.0, 2.0))
    whole = noise.measure(20, Store(tmp_path / "whole"))
    work, calls = noise.run_trials, itertools.count()

    def interrupted(*arguments: object) -> object:
        if next(calls) == 3:
            raise KeyboardInterrupt
        return work(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(noise, "run_trials", interrupted)
    with pytest.raises(KeyboardInterrupt):
        noise.measure(20, Store(tmp_path / "again"))
    assert noise.measure(20, Store(tmp_path / "again")) == whole
    rows = (*whole["levels"], *whole["origins"])
    units = {tuple(row[k] for k in ("perturbed", "noise", "noise_deg", "origin")) for row in rows}
    assert next(calls) == len(units) + 1  # the interrupted one twice
