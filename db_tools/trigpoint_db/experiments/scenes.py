"""The paper's main tables: scenes of public data sets, ours beside what it and others published."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint_db.evaluate import THRESHOLDS, evaluate
from trigpoint_db.experiments.benchmarks import BENCHMARKS, Scene
from trigpoint_db.experiments.published import PublishedRow, PublishedTable, load_published
from trigpoint_db.experiments.scene_notes import write_notes
from trigpoint_db.experiments.sets import open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.figures import make_figure, save_figure, scale_logarithmically
from trigpoint_db.localize import localize_images
from trigpoint_db.submit import write_submission


def measure(
    name: str, scenes: Sequence[Scene], model: FeatureModel, num_anchors: int, store: Store
) -> dict[str, Any]:
    """Map scenes of a benchmark, localize their queries and compare with the public poses.

    Maps are kept in the store's folder, to go on with. Where the benchmark judges submissions, the
    file for it is written there, too.
    """
    settings = {
        "model": model.identity.sha256,
        "num_anchors": num_anchors,
        "scenes": {scene.label: str(scene.dataset.images.resolve()) for scene in scenes},
    }
    store.begin(name, settings)
    for scene in scenes:
        _localize_scene(scene, model, num_anchors, store)
    submits = BENCHMARKS[name].submits
    if submits is not None:
        poses: dict[str, Rigid3] = {}
        for scene in scenes:
            poses |= _read_found(scene, store)
        write_submission(submits, poses, store.folder / f"{name}_submission.txt")
    return {
        "benchmark": name,
        "model": model.identity.name,
        "num_anchors": num_anchors,
        "parts": [part for scene in scenes for part in _evaluate_scene(scene, store)],
    }


def _localize_scene(scene: Scene, model: FeatureModel, num_anchors: int, store: Store) -> None:
    """Localize the queries that are not in the store yet."""
    data, options = scene.dataset, LocalizerOptions(num_anchors=num_anchors)
    queries = {_unit(scene, query.name): query for query in data.queries}
    if all(unit in store for unit in queries):
        return
    with open_map(store.folder / "maps", scene.label, data, model) as reader:
        localizer = Localizer(model, reader, options)
        for unit in store.each(list(queries), f"{scene.label}: localizing"):
            (outcome,) = localize_images(localizer, [queries[unit]], data.images)
            pose = outcome.cam_from_world
            store[unit] = (
                outcome.summarize()
                if pose is None
                else [*pose.quaternion.tolist(), *pose.t.tolist()]
            )


def _unit(scene: Scene, query: str) -> str:
    return f"{scene.label}: {query}"


def _read_found(scene: Scene, store: Store) -> dict[str, Rigid3]:
    """Return cam_from_world of the queries that were localized, by name."""
    found = {query.name: store[_unit(scene, query.name)] for query in scene.dataset.queries}
    return {
        name: Rigid3.from_quaternion(value[:4], value[4:])
        for name, value in found.items()
        if isinstance(value, list)
    }


def _evaluate_scene(scene: Scene, store: Store) -> list[dict[str, Any]]:
    """Describe what came of the queries, those of each column of the table by themselves."""
    found, columns = _read_found(scene, store), defaultdict[str, list[str]](list)
    for query in scene.dataset.queries:
        columns[scene.column_of(query)].append(query.name)
    parts = []
    for column, names in columns.items():
        judged = [name for name in names if name in scene.dataset.truth]
        part: dict[str, Any] = {
            "column": column,
            "variant": scene.variant,
            "num_mapped": len(scene.dataset.mapped),
            "num_queries": len(names),
            "num_localized": sum(name in found for name in names),
            "num_judged": len(judged),
        }
        if judged:
            known = {name: found[name] for name in judged if name in found}
            evaluation = evaluate(known, scene.dataset.truth, judged)
            report = evaluation.to_json()
            part |= {key: report[key] for key in ("median_rotation_deg", "median_position_m")}
            part["recalls"] = list(evaluation.recalls)
        parts.append(part)
    return parts


def write_table(result: Mapping[str, Any]) -> str:
    """Write our rows under the published ones, then what else is known of ours, then notes."""
    benchmark = BENCHMARKS[result["benchmark"]]
    table = load_published()[benchmark.table]
    columns = _columns(result, table)
    rows = [
        [row.group or "", row.title, *(row.cells[table.columns.index(c)] or "-" for c in columns)]
        for row in table.rows
    ]
    for variant, cells in _our_cells(result, table).items():
        title = f"Trigpoint, {variant}" if variant else "Trigpoint"
        rows.append(["", f"**{title}**", *(cells[column] or "-" for column in columns)])
    introduction = (
        f"{benchmark.title}: {table.cells}. Rows above ours are quoted from the paper, its table "
        f"`{table.label}`. Ours: network `{result['model']}`, {result['num_anchors']} anchors; a "
        "query without a pose counts as infinitely wrong."
    )
    return "\n\n".join(
        [
            introduction,
            markdown(["", "pipeline", *columns], rows, num_words=2),
            _write_details(result),
            *write_notes(result, table),
            *_compare(result, table),
        ]
    )


def _columns(result: Mapping[str, Any], table: PublishedTable) -> list[str]:
    """All columns of the published table, or the one where ours is a part of a single scene."""
    if result["benchmark"] == "redkitchen":
        return sorted({part["column"] for part in result["parts"]})
    return list(table.columns)


def _our_cells(
    result: Mapping[str, Any], table: PublishedTable
) -> dict[str, dict[str, str | None]]:
    """Write our cells in the form of the table, by variant; the average is that of all scenes."""
    cells: dict[str, dict[str, str | None]] = {}
    errors = defaultdict[str, list[list[float]]](list)
    for part in result["parts"]:
        row = cells.setdefault(part["variant"], dict.fromkeys(table.columns))
        if "Average" not in table.columns:
            recalls = part.get("recalls")
            if recalls is not None:
                row[part["column"]] = "/".join(f"{100 * recall:.1f}" for recall in recalls)
        elif (medians := _medians(part)) is not None:
            row[part["column"]] = _format_medians(medians)
            errors[part["variant"]].append(medians)
    for variant, known in errors.items():
        if len(known) == len(table.columns) - 1:
            cells[variant]["Average"] = _format_medians(np.mean(known, axis=0).tolist())
    return cells


def _medians(part: Mapping[str, Any]) -> list[float] | None:
    """Return degrees and metres; None where half of the queries or more have no pose."""
    deg, m = part.get("median_rotation_deg"), part.get("median_position_m")
    return None if deg is None or m is None else [deg, m]


def _format_medians(medians: Sequence[float]) -> str:
    return f"{medians[0]:.2f}/{medians[1]:.3f}"


def _write_details(result: Mapping[str, Any]) -> str:
    rows = []
    for part in result["parts"]:
        medians, recalls = _medians(part), part.get("recalls")
        row = [" ".join(filter(None, (part["column"], part["variant"])))]
        row += [str(part["num_mapped"]), str(part["num_queries"])]
        row.append(f"{100 * part['num_localized'] / part['num_queries']:.1f}")
        row.append(str(part["num_judged"]))
        row += ["-", "-"] if medians is None else [f"{medians[0]:.3f}", f"{medians[1]:.4f}"]
        row += [f"{100 * r:.1f}" for r in recalls] if recalls else ["-"] * len(THRESHOLDS)
        rows.append(row)
    levels = [f"{m:g} m, {deg:g} deg (%)" for m, deg in THRESHOLDS]
    header = ["Trigpoint", "mapped", "queries", "localized (%)", "with public pose"]
    return markdown([*header, "median deg", "median m", *levels], rows)


def _compare(result: Mapping[str, Any], table: PublishedTable) -> list[str]:
    """Count the scenes in which ours is below what is printed for the paper."""
    if "Average" not in table.columns or result["benchmark"] == "redkitchen":
        return []
    paper, sentences = table.row("Ours"), []
    for variant in dict.fromkeys(part["variant"] for part in result["parts"]):
        parts = [part for part in result["parts"] if part["variant"] == variant]
        below = np.zeros(2, int)
        for part in parts:
            published = paper.numbers(table.columns.index(part["column"]))
            medians = _medians(part)
            if medians is not None and published is not None:
                below += np.less(medians, published)
        label = f"Trigpoint, {variant}," if variant else "Trigpoint"
        sentences.append(
            f"{label} is below the paper's printed median in {below[1]} of {len(parts)} scenes in "
            f"metres and {below[0]} in degrees."
        )
    return [" ".join(sentences)]


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw what the table says: a line for each pipeline, a color for each column."""
    table = load_published()[BENCHMARKS[result["benchmark"]].table]
    columns = _columns(result, table)
    rows = [
        *table.rows,
        *(
            PublishedRow(None, f"Trigpoint {variant}".strip(), (), tuple(cells.values()))
            for variant, cells in _our_cells(result, table).items()
        ),
    ]
    places = [table.columns.index(column) for column in columns]
    rows = [row for row in rows if any(row.numbers(place) for place in places)]
    is_share = "Average" not in table.columns
    quantities = [f"% within {m:g} m" for m, _ in THRESHOLDS] if is_share else ["degrees", "metres"]
    figure = make_figure(8.0, 0.22 * len(rows) + 1.2)
    panels = figure.subplots(1, len(quantities), sharey=True)
    for panel, (axes, quantity) in enumerate(zip(panels, quantities, strict=True)):
        for place in places:
            points = [
                (numbers[panel], y) for y, row in enumerate(rows) if (numbers := row.numbers(place))
            ]
            label = table.columns[place]
            axes.plot(*zip(*points, strict=True), "o", color=f"C{place}", alpha=0.8, label=label)
        if is_share:
            axes.set_xlim(-3, 103)
        else:
            scale_logarithmically(axes)
        axes.set_xlabel(quantity)
        axes.grid(color="0.5", alpha=0.2)
        axes.axhline(sum(row in table.rows for row in rows) - 0.5, color="0.5", linewidth=0.8)
    panels[0].set_yticks(range(len(rows)), [row.title for row in rows])
    panels[0].invert_yaxis()
    if len(columns) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize="small")
    save_figure(figure, path)
