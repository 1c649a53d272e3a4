"""Error and time by the number of anchors: the paper's figure "ksweep".

Images of a map are localized against all others, with the 2, 3, 5 ... that look most alike. As in
the paper each anchor has a relative pose, for stage 1, and matches, for the final pose.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Localized, Lost, Reason, Result
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import MutualNearestNeighbors
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import Query, average_poses, estimate_relative_poses, match_anchors
from trigpoint_db.experiments.sets import choose, identify, open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import markdown, median, number
from trigpoint_db.figures import make_figure, save_figure, scale_logarithmically
from trigpoint_db.importers.base import Dataset

T = TypeVar("T")
Estimate = tuple[Rigid3, int] | Reason | Result

NUM_ANCHORS = (2, 3, 5, 10, 20, 50, 100, 150)
LEAST_SQUARES, ROBUST = "stage 1, least squares", "stage 1, robust"
FINAL, ALL_REFINED = "final", "final, all anchors refined"
ESTIMATES = {
    LEAST_SQUARES: "tab:orange",
    ROBUST: "tab:red",
    FINAL: "tab:blue",
    ALL_REFINED: "tab:cyan",
}
MATCHING, RELATIVE_POSES, AVERAGING = "matching", "relative poses", "averaging"
TIMES = (MATCHING, RELATIVE_POSES, AVERAGING, FINAL, ALL_REFINED)


def measure(
    sets: Mapping[str, Dataset], network: FeatureModel, max_queries: int, store: Store
) -> dict[str, Any]:
    """Sweep over the number of anchors for some images of each set."""
    for name, dataset in sets.items():
        if len(dataset.mapped) < 3:
            raise ConfigError(f"{name} has {len(dataset.mapped)} images; the sweep needs 3")
    chosen = {
        name: choose(range(len(dataset.mapped)), max_queries) for name, dataset in sets.items()
    }
    settings = {"network": network.identity.name, "anchors": list(NUM_ANCHORS)}
    store.begin("anchors", settings | {"images": chosen} | identify(network, sets))
    rows = []
    for name, dataset in sets.items():
        keys = [f"{name}: {index}" for index in chosen[name]]
        if not all(key in store for key in keys):
            index_of = dict(zip(keys, chosen[name], strict=True))
            with open_map(store.folder / "maps", name, dataset, network) as reader:
                for key in store.each(keys, name):
                    store[key] = sweep(reader, network, index_of[key])
        units = [store[key] for key in keys]
        rows += [
            {
                "set": name,
                "num_images": len(keys),
                "num_anchors": num_anchors,
                **summarize([unit[place] for unit in units]),
            }
            for place, num_anchors in enumerate(reachable(len(dataset.mapped)))
        ]
    return {**settings, "rows": rows}


def reachable(num_mapped: int) -> list[int]:
    """List the numbers of anchors that an image of a map can have; the last may be all others."""
    return sorted({min(num_anchors, num_mapped - 1) for num_anchors in NUM_ANCHORS})


def sweep(reader: MapReader, network: FeatureModel, index: int) -> list[dict[str, Any]]:
    """Localize one image with ever more anchors: errors, None where lost, and milliseconds."""
    counts = reachable(len(reader))
    options = LocalizerOptions(num_relative_poses=counts[-1])
    features, image = reader.features(index), reader.anchor(index)
    found, _ = reader.search(features.global_descriptor, counts[-1] + 1, options.anchor_diversity)
    anchors = [reader.anchor(other) for other in found.tolist() if other != index]
    query: Query | None = None
    views, relative = np.zeros(0, dtype=np.intp), Rigid3.stack([])
    ms = {MATCHING: 0.0, RELATIVE_POSES: 0.0}
    steps = []
    for begin, end in pairwise((0, *counts)):
        more, took = timed(
            match_anchors,
            image.camera,
            features,
            anchors[begin:end],
            MutualNearestNeighbors(),
            network.long_side_px,
        )
        ms[MATCHING] += took
        query = query.joined(more) if query else more
        (chosen, poses), took = timed(estimate_relative_poses, more, options)
        ms[RELATIVE_POSES] += took
        views = np.append(views, begin + chosen)
        relative = Rigid3(np.append(relative.R, poses.R, 0), np.append(relative.t, poses.t, 0))
        estimates: dict[str, tuple[Estimate, float]] = {
            LEAST_SQUARES: timed(
                average_poses,
                query.views[views],
                relative,
                replace(options, center="least_squares"),
            ),
            ROBUST: timed(average_poses, query.views[views], relative, options),
        }
        for label, num_refined in ((FINAL, options.num_refined_anchors), (ALL_REFINED, end)):
            refining = Localizer(network, reader, replace(options, num_refined_anchors=num_refined))
            solution, took = timed(refining.solve, query)
            estimates[label] = solution.result, took
        took_by = {label: took for label, (_, took) in estimates.items()}
        steps.append(
            {
                "errors": {
                    label: error_of(estimate, image.cam_from_world)
                    for label, (estimate, _) in estimates.items()
                },
                "ms": {**ms, AVERAGING: took_by.pop(ROBUST), **took_by},
            }
        )
    return steps


def timed(function: Callable[..., T], *arguments: Any) -> tuple[T, float]:
    """Call it: its result, and the milliseconds."""
    start = time.perf_counter()
    result = function(*arguments)
    return result, 1e3 * (time.perf_counter() - start)


def error_of(estimate: Estimate, truth: Rigid3) -> float | None:
    """Return the distance of the centers; None without a pose."""
    if isinstance(estimate, Reason | Lost):
        return None
    pose = estimate.cam_from_world if isinstance(estimate, Localized) else estimate[0]
    return float(np.linalg.norm(pose.center - truth.center))


def summarize(steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Take medians over images: of the errors, lost ones among them, and of the times."""
    errors = {label: [step["errors"][label] for step in steps] for label in ESTIMATES}
    return {
        "medians": {label: median(values) for label, values in errors.items()},
        "num_lost": {label: values.count(None) for label, values in errors.items()},
        "ms": {label: median([step["ms"][label] for step in steps]) for label in TIMES},
    }


def write_table(result: Mapping[str, Any]) -> str:
    """Write errors and times, and what more anchors bring."""
    parts = []
    for name, rows in by_set(result).items():
        errors = [
            [
                str(row["num_anchors"]),
                *(
                    number(row["medians"][label]) + _lost(row["num_lost"][label])
                    for label in ESTIMATES
                ),
                *(number(row["ms"][label]) for label in TIMES),
            ]
            for row in rows
        ]
        header = ["anchors", *ESTIMATES, *(f"{label} (ms)" for label in TIMES)]
        parts.append(
            f"{name}: {rows[0]['num_images']} images, chosen by a fixed seed, each against all "
            "others of the set. Median position errors, failures among them (their number in "
            "brackets), and median times. The final pose needs the matching, and neither the "
            "relative poses nor their average:\n\n"
            + markdown(header, errors)
            + "\n\n"
            + "\n".join(f"- {label}: {describe_gain(rows, label)}" for label in ESTIMATES)
        )
    parts.append(
        "The paper finds on Cambridge's Great Court that the error falls significantly up to about "
        '50 anchors and goes on falling with more (its figure "ksweep"); it gives no numbers.'
    )
    return "\n\n".join(parts)


def describe_gain(rows: Sequence[Mapping[str, Any]], label: str) -> str:
    """Say where the error is least, and what the anchors beyond 20 bring."""
    errors = {
        row["num_anchors"]: row["medians"][label]
        for row in rows
        if row["medians"][label] is not None
    }
    if not errors:
        return "no median."
    best = min(errors, key=lambda num_anchors: errors[num_anchors])
    text = f"least with {best} anchors"
    many = max(errors)
    if 20 in errors and many > 20:
        change = 100 * (errors[many] / errors[20] - 1)
        text += f"; with {many} in place of 20 the median changes by {change:+.0f} %"
    return text + "."


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw errors and times by the number of anchors, a row of panels for each."""
    sets = by_set(result)
    figure = make_figure(max(6, 4 * len(sets)), 6.5)
    panels = figure.subplots(2, len(sets), sharex=True, squeeze=False)
    for (top, bottom), (name, rows) in zip(panels.T, sets.items(), strict=True):
        numbers = [row["num_anchors"] for row in rows]
        for label, color in ESTIMATES.items():
            errors = [_or_nan(row["medians"][label]) for row in rows]
            top.plot(numbers, errors, marker=".", color=color, label=label)
        bottom.stackplot(
            numbers,
            [[row["ms"][label] for row in rows] for label in TIMES[:-1]],
            labels=TIMES[:-1],
            colors=("tab:gray", "tab:olive", "tab:pink", "tab:blue"),
        )
        top.set_title(name, fontsize="medium")
        scale_logarithmically(top, "y")
        for axes in (top, bottom):
            scale_logarithmically(axes)
            axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("median position error")
    panels[1][0].set_ylabel("ms, stage upon stage")
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    panels[1][0].legend(fontsize="small", loc="upper left")
    figure.supxlabel("anchors")
    save_figure(figure, path)


def by_set(result: Mapping[str, Any]) -> dict[str, list[Mapping[str, Any]]]:
    """Group the rows."""
    names = dict.fromkeys(row["set"] for row in result["rows"])
    return {name: [row for row in result["rows"] if row["set"] == name] for name in names}


def _lost(count: int) -> str:
    return f" ({count})" if count else ""


def _or_nan(error: float | None) -> float:
    return np.nan if error is None else error
