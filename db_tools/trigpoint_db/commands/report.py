"""The command `trigpoint-db report`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint_db.build import check_files
from trigpoint_db.commands.coverage import Apart, Probes, Up, measure, read_direction
from trigpoint_db.coverage import Coverage
from trigpoint_db.evaluate import evaluate, read_truth
from trigpoint_db.gaps import suggest_poses
from trigpoint_db.poses import read_poses, read_queries
from trigpoint_db.report.cases import Drawing, draw_probes, draw_queries
from trigpoint_db.report.page import Section, check_page, write_page
from trigpoint_db.report.results import read_results
from trigpoint_db.report.sections import (
    coverage_sections,
    error_section,
    map_section,
    outcome_section,
    path_section,
    timing_section,
)
from trigpoint_db.terminal import Json, Model, Retrieval

app = typer.Typer()
MAX_WANTED = 30


@app.command()
def report(
    out: Annotated[Path, typer.Option("--out", "-o", help="The page (.html).")],
    map_: Annotated[
        Path | None, typer.Argument(metavar="[MAP]", help="Without --results: report on this map.")
    ] = None,
    results: Annotated[
        Path | None, typer.Option(help="Report on these: what `localize --results` wrote.")
    ] = None,
    poses: Annotated[Path | None, typer.Option(help="What `localize --poses` wrote.")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="A COLMAP model's folder, or a pose file.")
    ] = None,
    queries: Annotated[
        Path | None, typer.Option(help="The queries' cameras, to draw their matches.")
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder of images, to draw some with their matches.")
    ] = None,
    map_images: Annotated[
        Path | None, typer.Option(help="Folder of the map's images, where it is another.")
    ] = None,
    probes: Probes = None,
    apart: Apart = None,
    up: Up = None,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Write one page, that needs no other file, on a map or on results."""
    check_page(out, *(path for path in (map_, results, poses, truth, queries) if path is not None))
    if results is not None:
        refuse("a MAP; with --results leave it out", probes=probes, apart=apart)
        if poses is None or truth is None:
            raise ConfigError("a report on --results needs --poses and --truth beside them")
        drawn = draw_with(map_, queries, images, map_images, model, retrieval)
        title, sections = results.name, report_results(results, poses, truth, up, drawn)
    elif map_ is not None:
        refuse("--results; give them, too", poses=poses, truth=truth, queries=queries)
        folder = map_images or images
        title = map_.name
        sections = report_map(map_, folder, probes, apart, up, model, retrieval)
    else:
        raise ConfigError("there is nothing to report on: give a MAP, or --results")
    write_page(out, title, sections)
    if as_json:
        print(json.dumps({"report": str(out), "bytes": out.stat().st_size}))
    else:
        print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


def refuse(what: str, **options: object) -> None:
    """Refuse options that are for a report on something else."""
    for name, value in options.items():
        if value is not None:
            raise ConfigError(f"--{name} is for a report on {what}")


def draw_with(
    map_: Path | None,
    queries: Path | None,
    images: Path | None,
    map_images: Path | None,
    model: str,
    retrieval: Path | None,
) -> Drawing | None:
    """Collect what it takes to draw queries; None where nothing of it is given."""
    if all(given is None for given in (map_, queries, images, map_images)):
        return None
    if map_ is None or queries is None or images is None:
        raise ConfigError("to draw matches of queries give MAP, --queries and --images")
    cameras = {query.name: query for query in read_queries(queries)}
    return Drawing(map_, images, map_images or images, model, retrieval, cameras)


def describe_map(map_: Path, images: Path | None) -> Section:
    """Say what a map is; its images have to be in their folder, where they are to be drawn."""
    with MapReader.open(map_) as reader:
        if images is not None:
            check_files(reader.names(), images)
        return map_section(reader, map_.stat().st_size)


def report_map(
    map_: Path,
    images: Path | None,
    probes: int | None,
    apart: float | None,
    up: str | None,
    model: str,
    retrieval: Path | None,
) -> list[Section]:
    """Report on a map: what it is, where it is strong, and how its images were localized."""
    about = describe_map(map_, images)
    coverage, gaps = measure(map_, probes, apart, up, model, retrieval)
    wanted = suggest_poses(coverage, gaps, MAX_WANTED)
    sections = [about, *coverage_sections(coverage, gaps, wanted), *probe_sections(coverage)]
    if images is not None:
        sections.append(draw_probes(coverage, Drawing(map_, images, images, model, retrieval)))
    return sections


def probe_sections(coverage: Coverage) -> list[Section]:
    """Say how the images of a map were localized without their surroundings."""
    sections = [
        error_section(
            np.nan_to_num([probe.position_error for probe in coverage.probes], nan=np.inf),
            np.nan_to_num([probe.rotation_error_deg for probe in coverage.probes], nan=np.inf),
            "Of the map's own images, each against the map without what is near it.",
        ),
    ]
    if stage_ms := [probe.stage_ms for probe in coverage.probes if probe.stage_ms]:
        text = "Of solving for the pose, from the matches with all anchors at once."
        sections.append(timing_section(stage_ms, text))
    return sections


def report_results(
    path: Path, poses: Path, truth: Path, up: str | None, drawn: Drawing | None
) -> list[Section]:
    """Report on results of `localize`."""
    results, about = read_results(path), list[Section]()
    if drawn is not None:
        check_files((result.name for result in results), drawn.images)
        about = [describe_map(drawn.map_, drawn.map_images)]
    estimates, reference = read_poses(poses), read_truth(truth)
    evaluation = evaluate(estimates, reference, [result.name for result in results])
    sections = [
        *about,
        outcome_section(results),
        path_section(estimates, reference, evaluation, None if up is None else read_direction(up)),
        error_section(
            evaluation.position_errors_m,
            evaluation.rotation_errors_deg,
            "Of all queries; those without a pose count as failures.",
        ),
    ]
    if stage_ms := [result.stage_ms for result in results if result.stage_ms]:
        sections.append(timing_section(stage_ms, "Of each query."))
    if drawn is not None:
        sections.append(draw_queries(results, evaluation, drawn))
    return sections
