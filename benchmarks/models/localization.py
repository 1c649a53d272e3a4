"""Localization in maps made with each network."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.models.poses import SETS
from benchmarks.models.surveys import Survey
from trigpoint.database.reader import MapReader
from trigpoint.frame import Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.evaluate import evaluate
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.localize import Outcome, localize_images
from trigpoint_db.poses import Query, read_names, read_queries

SPLITS = ("", "_block")

CAPTION = """Position errors, in metres for 7scenes_redkitchen, else
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
            outcomes = _localize(folder, split, queries, network)
            poses = {
                outcome.name: outcome.result.cam_from_world
                for outcome in outcomes
                if isinstance(outcome.result, Localized)
            }
            names = [query.name for query in queries]
            statistics = evaluate(poses, truth, names).to_json()
            found[survey.name + split.replace("_", ", ")] = statistics
    return found


def _localize(
    folder: Path, split: str, queries: Sequence[Query], network: FeatureModel
) -> list[Outcome]:
    survey = select_images(read_model(folder / "sparse"), read_names(folder / f"map{split}.txt"))
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "map.tpmap"
        build_map(path, survey, folder / "images", network)
        calibrate_map(path, network)
        with MapReader.open(path, network.identity) as reader:
            return list(localize_images(Localizer(network, reader), queries, folder / "images"))


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
