"""Localization in maps made with each network, as in `benchmarks/accuracy.py`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.accuracy import localize
from benchmarks.models.poses import SETS
from benchmarks.models.scores import markdown
from benchmarks.models.surveys import Survey
from trigpoint.frame import Localized
from trigpoint.models.features import FeatureModel
from trigpoint_db.evaluate import evaluate
from trigpoint_db.poses import read_queries

SPLITS = ("", "_block")
NUM_ANCHORS = 20

CAPTION = f"""Position errors with {NUM_ANCHORS} anchors, in metres for 7scenes_redkitchen, else
in the model's units; failures count as infinite."""


def measure(
    network: FeatureModel, surveys: Sequence[Survey], folders: Sequence[Path]
) -> dict[str, Any]:
    """Measure position errors of both splits of every set: the statistics of `trigpoint-db`."""
    found = {}
    for survey, folder in zip(surveys, folders, strict=True):
        if survey.name not in SETS:
            continue
        truth = dict(zip(survey.names, survey.cam_from_world, strict=True))
        for split in SPLITS:
            queries = read_queries(folder / f"queries{split}.txt")
            images = folder / "images"
            outcomes = localize(folder, split, {images: queries}, network, NUM_ANCHORS)[images]
            poses = {
                outcome.name: outcome.result.cam_from_world
                for outcome in outcomes
                if isinstance(outcome.result, Localized)
            }
            names = [query.name for query in queries]
            statistics = evaluate(poses, truth, names).to_json()
            found[survey.name + split.replace("_", ", ")] = statistics
    return found


def tabulate(results: dict[str, dict[str, Any]]) -> str:
    """Lay out medians and 90th percentiles, in the sets' units, failures being infinite."""
    rows = []
    for split in next(iter(results.values())):
        for name, found in results.items():
            statistics = found[split]
            errors = (statistics["median_position_m"], statistics["p90_position_m"])
            count = f"{statistics['num_localized']} of {statistics['num_queries']}"
            shown = ("inf" if error is None else f"{error:.4f}" for error in errors)
            rows.append([split, name, count, *shown])
    header = ["set", "", "localized", "median", "90th percentile"]
    return markdown(header, rows, num_words=2)
