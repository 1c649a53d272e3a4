"""The localizer beside other methods, on the same features, anchors and matches."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trigpoint.errors import ConfigError
from trigpoint.frame import Localized, Lost
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import read_frame
from trigpoint_db.experiments.averaging import describe_choice
from trigpoint_db.experiments.ratios import draw_ratios
from trigpoint_db.experiments.sets import choose, identify, open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import geometric_mean, markdown, median, number
from trigpoint_db.importers.base import Dataset
from trigpoint_db.methods.baseline import Baseline, Estimate
from trigpoint_db.methods.matched import Matched, match_frame
from trigpoint_db.methods.registry import MethodName, load_method
from trigpoint_db.poses import Query

OURS = MethodName.LATENT_POINTS
ABOUT = {
    MethodName.RETRIEVAL: "the pose of the anchor that looks most alike",
    MethodName.MIDPOINT: (
        "the midpoint of two anchors' rays, of the pair that most relative poses agree with "
        "(Zhou et al., ICRA 2020)"
    ),
    MethodName.TRANSLATION_AVERAGING: "eq. 5 in closed form, of the relative poses that agree",
    MethodName.RELATIVE_POSES: (
        "stage 1 of the paper alone, of all anchors: Proposition 1 and rotation averaging"
    ),
    MethodName.MAP_PNP: (
        "the anchors' points triangulated by COLMAP, then PnP by COLMAP, as hloc has it"
    ),
    MethodName.LATENT_POINTS: "the localizer, which alone refuses poses that it is not sure of",
}
COLORS = dict(
    zip(
        map(str, MethodName),
        ("tab:gray", "tab:olive", "tab:orange", "tab:red", "tab:green", "tab:blue"),
        strict=True,
    )
)
WON = {"median": "median position error", "p90": "90th percentile", "median_deg": "rotation error"}
MISSING = f"{MethodName.MAP_PNP} is not here: pycolmap was not installed (extra `colmap`)."


def measure(
    sets: Mapping[str, Dataset],
    network: FeatureModel,
    num_anchors: int,
    max_queries: int,
    store: Store,
) -> dict[str, Any]:
    """Localize queries of each set with every method that is installed."""
    names = [name for name in MethodName if name == OURS or is_installed(name)]
    settings = {
        "network": network.identity.name,
        "num_anchors": num_anchors,
        "max_queries": max_queries,
        "methods": [str(name) for name in names],
    }
    queries = {name: choose(dataset.queries, max_queries) for name, dataset in sets.items()}
    keys = {name: [f"{name}: {query.name}" for query in chosen] for name, chosen in queries.items()}
    store.begin("methods", settings | {"queries": keys} | identify(network, sets))
    options = LocalizerOptions(num_anchors=num_anchors, first_anchors=num_anchors)
    for name, dataset in sets.items():
        if all(key in store for key in keys[name]):
            continue
        by_key = dict(zip(keys[name], queries[name], strict=True))
        with open_map(store.folder / "maps", name, dataset, network) as reader:
            localizer = Localizer(network, reader, options, time.perf_counter)
            for key in store.each(keys[name], name):
                store[key] = localize_by_each(localizer, names, dataset, by_key[key])
    rows = [
        {
            "set": name,
            "num_queries": len(dataset.queries),
            "num_chosen": len(queries[name]),
            "methods": {
                method: summarize([store[key][method] for key in keys[name]]) for method in names
            },
        }
        for name, dataset in sets.items()
    ]
    return {**settings, "rows": rows}


def is_installed(name: MethodName) -> bool:
    """Say whether a method other than the localizer has what it needs."""
    try:
        load_method(name)
    except ConfigError:
        return False
    return True


def localize_by_each(
    localizer: Localizer, names: list[MethodName], dataset: Dataset, query: Query
) -> dict[str, dict[str, float | None]]:
    """Return by method its errors, None where it is lost, and the milliseconds after matching."""
    matched = match_frame(localizer, read_frame(dataset.images, query.name, query.camera))
    truth, found = dataset.truth[query.name], {}
    for name in names:
        start = time.perf_counter()
        pose = None if isinstance(matched, Lost) else solve(localizer, name, matched)
        ms = 1e3 * (time.perf_counter() - start)
        found[str(name)] = errors_of(pose, truth) | {"ms": ms}
    return found


def solve(localizer: Localizer, name: MethodName, matched: Matched) -> Rigid3 | None:
    """Solve for the pose; None where there is none, or the localizer refuses it."""
    if name == OURS:
        result: Any = localizer.solve(matched.query).result
    else:
        result = Baseline(name, localizer).solve(matched)
    return result.cam_from_world if isinstance(result, Localized | Estimate) else None


def errors_of(pose: Rigid3 | None, truth: Rigid3) -> dict[str, float | None]:
    """Return the distance of the centers and the angle of the rotations."""
    if pose is None:
        return {"position": None, "rotation_deg": None}
    return {
        "position": float(np.linalg.norm(pose.center - truth.center)),
        # Images of one rig may have the same rotation, but for its last digits.
        "rotation_deg": round(math.degrees(rotation_angle((pose @ truth.inverse()).R)), 6),
    }


def summarize(found: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Take percentiles over queries, failures among them, and count these."""
    position, rotation_deg, ms = (
        [query[key] for query in found] for key in ("position", "rotation_deg", "ms")
    )
    return {
        "median": median(position),
        "p90": median(position, 90),
        "median_deg": median(rotation_deg),
        "num_lost": position.count(None),
        "ms": median(ms),
    }


def write_table(result: Mapping[str, Any]) -> str:
    """Write errors and times by method, and which method has the smallest."""
    methods, rows = result["methods"], result["rows"]
    parts = [
        f"`trigpoint-db localize --method`, on the same features (`{result['network']}`), "
        f"{result['num_anchors']} anchors, all at once, and matches, so that only what is done "
        "with these differs."
        + describe_choice(result)
        + "\n\n"
        + "\n".join(f"- `{name}`: {ABOUT[MethodName(name)]}." for name in methods)
    ]
    if MethodName.MAP_PNP not in methods:
        parts.append(MISSING)
    for title, key in (
        ("Median position errors, failures among them (their number in brackets)", "median"),
        ("90th percentiles of the same", "p90"),
        ("Median rotation errors in degrees", "median_deg"),
    ):
        cells = [
            [row["set"], *(_cell(row["methods"][name], key) for name in methods)] for row in rows
        ]
        ratios = [geometric_mean(ratio(row, name, key) for row in rows) for name in methods]
        cells.append([f"over that of {OURS}", *(number(mean) for mean in ratios)])
        parts.append(f"{title}:\n\n" + markdown(["set", *methods], cells))
    parts.append(
        "The last rows are geometric means of ratios, where both numbers are finite and not zero."
        "\n\n" + "\n".join(describe_best(rows, key, what) for key, what in WON.items())
    )
    times = [median([row["methods"][name]["ms"] for row in rows]) for name in methods]
    parts.append(
        "Times after the matching in ms, medians over the sets of the medians over queries:\n\n"
        + markdown(["", *methods], [["ms", *(number(ms) for ms in times)]])
    )
    return "\n\n".join(parts)


def describe_best(rows: list[Mapping[str, Any]], key: str, what: str) -> str:
    """Say in how many rows each method has the smallest error."""
    won: dict[str, int] = {}
    for row in rows:
        known = {name: m[key] for name, m in row["methods"].items() if m[key] is not None}
        if known:
            best = min(known, key=lambda name: known[name])
            won[best] = won.get(best, 0) + 1
    ranking = sorted(won.items(), key=lambda item: -item[1])
    return (
        f"- Smallest {what}: "
        + ", ".join(f"{name} in {count} of {len(rows)} rows" for name, count in ranking)
        + "."
    )


def ratio(row: Mapping[str, Any], name: str, key: str) -> float | None:
    """Return a method's error over that of the localizer."""
    error, reference = row["methods"][name][key], row["methods"][OURS][key]
    return error / reference if error and reference else None


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw the median position errors over that of the localizer, set by set."""
    rows = result["rows"]
    ratios = {name: [ratio(row, name, "median") for row in rows] for name in result["methods"]}
    draw_ratios(path, [row["set"] for row in rows], ratios, COLORS, OURS)


def _cell(summary: Mapping[str, Any], key: str) -> str:
    lost = f" ({summary['num_lost']})" if key == "median" and summary["num_lost"] else ""
    return number(summary[key]) + lost
