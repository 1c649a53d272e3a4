"""Center averaging against translation averaging on real images: the paper's first table.

All methods average the very same relative poses: of the anchors that agree on a pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.frame import Reason
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import MutualNearestNeighbors
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import estimate_relative_poses, find_consistent, match_anchors
from trigpoint_db.build import read_frame
from trigpoint_db.experiments.noise import COLORS, DUELS, METHODS, OURS, estimate_centers
from trigpoint_db.experiments.published import load_published
from trigpoint_db.experiments.ratios import draw_ratios
from trigpoint_db.experiments.sets import choose, identify, open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import geometric_mean, markdown, median, number
from trigpoint_db.importers.base import Dataset
from trigpoint_db.poses import Query

# What the paper's columns are called by the folders of the scenes, as published.
PAPER_SCENES = {
    "chess": "Chess",
    "stairs": "Stairs",
    "KingsCollege": "King's",
    "StMarysChurch": "St.Mary's",
}
PAPER_KINDS = ("Translation", "Center")


def measure(
    sets: Mapping[str, Dataset],
    network: FeatureModel,
    num_anchors: int,
    max_queries: int,
    store: Store,
) -> dict[str, Any]:
    """Measure the errors of each method for the queries of each set."""
    options = LocalizerOptions(num_anchors=num_anchors, num_relative_poses=num_anchors)
    settings = {
        "network": network.identity.name,
        "num_anchors": num_anchors,
        "max_queries": max_queries,
    }
    queries = {name: choose(dataset.queries, max_queries) for name, dataset in sets.items()}
    keys = {name: [f"{name}: {query.name}" for query in chosen] for name, chosen in queries.items()}
    store.begin("averaging", settings | {"queries": keys} | identify(network, sets))
    for name, dataset in sets.items():
        if all(key in store for key in keys[name]):
            continue
        by_key = dict(zip(keys[name], queries[name], strict=True))
        with open_map(store.folder / "maps", name, dataset, network) as reader:
            for key in store.each(keys[name], name):
                store[key] = average(reader, network, dataset, by_key[key], options)
    rows = [
        {
            "set": name,
            "num_mapped": len(dataset.mapped),
            "num_queries": len(dataset.queries),
            "num_chosen": len(queries[name]),
            **summarize([store[key] for key in keys[name]]),
        }
        for name, dataset in sets.items()
    ]
    return {**settings, "rows": rows}


def average(
    reader: MapReader,
    network: FeatureModel,
    dataset: Dataset,
    query: Query,
    options: LocalizerOptions,
) -> dict[str, float] | None:
    """Return the position error of each method; None where no anchors agree."""
    frame = read_frame(dataset.images, query.name, query.camera)
    features = network.extract(frame.image, options.max_keypoints)
    found, _ = reader.search(
        features.global_descriptor, options.num_anchors, options.anchor_diversity
    )
    anchors = [reader.anchor(index) for index in found.tolist()]
    matched = match_anchors(
        query.camera, features, anchors, MutualNearestNeighbors(), network.long_side_px
    )
    chosen, relative = estimate_relative_poses(matched, options)
    consistent = find_consistent(matched.views[chosen], relative, options)
    if isinstance(consistent, Reason):
        return None
    return center_errors(*consistent, dataset.truth[query.name])


def center_errors(
    anchors: Rigid3, query_from_anchors: Rigid3, truth: Rigid3
) -> dict[str, float] | None:
    """Return how far each method's center is off; None where lines fix no center."""
    errors = {
        method: float(np.linalg.norm(center - truth.center))
        for method, center in estimate_centers(anchors, query_from_anchors).items()
        if center is not None
    }
    return errors if len(errors) == len(METHODS) else None


def summarize(errors: list[dict[str, float] | None]) -> dict[str, Any]:
    """Count the queries that have averages, and take the medians of these."""
    averaged = [query for query in errors if query is not None]
    medians = {method: median([query[method] for query in averaged]) for method in METHODS}
    return {"num_averaged": len(averaged), "medians": medians}


def write_table(result: Mapping[str, Any]) -> str:
    """Write the medians of each set, how the methods compare, and the paper's table."""
    rows = result["rows"]
    cells = [
        [
            row["set"],
            f"{row['num_averaged']} of {row['num_chosen']}",
            *(number(row["medians"][method]) for method in METHODS),
        ]
        for row in rows
    ]
    ratios = {method: geometric_mean(ratio(row, method) for row in rows) for method in METHODS}
    cells.append(["ratio, geometric mean", "", *(number(ratios[method]) for method in METHODS)])
    parts = [
        f"{result['num_anchors']} anchors, and a relative pose for each of them; those that agree "
        "on one pose are averaged, by each method the same. Median position errors of the queries "
        f"with an average; the last row compares them with {OURS}." + describe_choice(result),
        markdown(["set", "averaged", *METHODS], cells),
    ]
    compared = [row for row in rows if row["num_averaged"]]
    verdicts = [
        f"- {ours} has the smaller median than {theirs} in "
        f"{sum(is_better(row, ours, theirs) for row in compared)} of {len(compared)} rows."
        for ours, theirs in DUELS
    ]
    parts.append("\n".join(verdicts))
    by_set = {row["set"]: row for row in rows}
    published = load_published()["averaging"]
    quoted = {
        title: [f"{published.row(f'{kind} Averaging').cells[column]} cm" for kind in PAPER_KINDS]
        for column, title in enumerate(published.columns)
    }
    paper = [
        [title, *quoted[title], *_centimetres(by_set.get(folder))]
        for folder, title in PAPER_SCENES.items()
    ]
    parts.append(
        "The paper's own table (its first), and ours where `--root` gave these scenes:\n\n"
        + markdown(["scene", "paper: translation", "paper: center", *METHODS], paper)
    )
    return "\n\n".join(parts)


def describe_choice(result: Mapping[str, Any]) -> str:
    """Say where only some of the queries were taken."""
    some = any(row["num_chosen"] < row["num_queries"] for row in result["rows"])
    most = result["max_queries"]
    return f" At most {most} queries of each set, chosen by a fixed seed." if some else ""


def is_better(row: Mapping[str, Any], ours: str, theirs: str) -> bool:
    """Say whether one method's median is smaller than another's."""
    return bool(row["medians"][ours] < row["medians"][theirs])


def ratio(row: Mapping[str, Any], method: str) -> float | None:
    """Return a method's median over that of the paper's center averaging."""
    error, reference = row["medians"][method], row["medians"][OURS]
    return error / reference if error and reference else None


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw the ratios to center averaging, set by set."""
    rows = result["rows"]
    ratios = {method: [ratio(row, method) for row in rows] for method in COLORS}
    draw_ratios(path, [row["set"] for row in rows], ratios, COLORS, OURS)


def _centimetres(row: Mapping[str, Any] | None) -> list[str]:
    if row is None:
        return ["-"] * len(METHODS)
    errors = [row["medians"][method] for method in METHODS]
    return ["-" if error is None else f"{number(100 * error)} cm" for error in errors]
