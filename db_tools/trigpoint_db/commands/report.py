"""The command `trigpoint-db report`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor, quantize_descriptors
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.output import check_output
from trigpoint.rigid import Rigid3
from trigpoint.stages import match_anchors
from trigpoint_db.build import check_files, read_frame
from trigpoint_db.commands.survey import Apart, Probes, Up, measure, read_direction
from trigpoint_db.coverage import APART, Coverage, Probe, view_distance
from trigpoint_db.evaluate import Evaluation, evaluate, read_truth
from trigpoint_db.gaps import suggest_poses
from trigpoint_db.leave_one_out import localize_without
from trigpoint_db.poses import Query, read_poses, read_queries
from trigpoint_db.report.matches import Case, draw_case
from trigpoint_db.report.page import Section, write_page
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
MAX_REFUSED = 2  # refused queries that are shown


@app.command()
def report(
    out: Annotated[Path, typer.Option("--out", "-o", help="The page (HTML).")],
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
    probes: Probes = 100,
    apart: Apart = APART,
    up: Up = None,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Write one page, that needs no other file, on a map or on results."""
    inputs = (map_, results, poses, truth, queries)
    check_output(out, *(path for path in inputs if path is not None))
    if results is not None:
        if poses is None or truth is None:
            raise ConfigError("a report on --results needs --poses and --truth beside them")
        drawn = None
        if images is not None:
            if map_ is None or queries is None:
                raise ConfigError("to draw matches of queries give MAP, --queries and --images")
            drawn = Drawing(map_, images, map_images or images, model, retrieval)
        title, sections = report_results(results, poses, truth, queries, up, drawn)
    elif map_ is not None:
        for option, path in (("poses", poses), ("truth", truth), ("queries", queries)):
            if path is not None:
                raise ConfigError(f"--{option} is for a report on --results; give them, too")
        folder = map_images or images
        drawn = None if folder is None else Drawing(map_, folder, folder, model, retrieval)
        coverage, gaps = measure(map_, probes, apart, up, model, retrieval)
        wanted = suggest_poses(coverage, gaps, MAX_WANTED)
        with MapReader.open(map_) as reader:
            sections = [map_section(reader, map_.stat().st_size)]
        sections += coverage_sections(coverage, gaps, wanted)
        sections += report_probes(coverage, drawn)
        title = map_.name
    else:
        raise ConfigError("there is nothing to report on: give a MAP, or --results")
    write_page(out, title, sections)
    if as_json:
        print(json.dumps({"report": str(out), "bytes": out.stat().st_size}))
    else:
        print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


@dataclass(frozen=True)
class Drawing:
    """What it takes to draw images with their matches."""

    map_: Path
    images: Path
    map_images: Path
    model: str
    retrieval: Path | None

    def open(self) -> tuple[MapReader, FeatureModel]:
        """Open the map and its network."""
        network = FeatureModel.load(self.model, retrieval=self.retrieval)
        return MapReader.open(self.map_, network.identity), network


def report_probes(coverage: Coverage, drawn: Drawing | None) -> list[Section]:
    """Report on a map: how its images were localized without their surroundings."""
    sections = [
        error_section(
            np.array([_or_infinite(probe.position_error) for probe in coverage.probes]),
            np.array([_or_infinite(probe.rotation_error_deg) for probe in coverage.probes]),
            "Of the map's own images, each against the map without what is near it.",
        ),
    ]
    if stage_ms := [probe.stage_ms for probe in coverage.probes if probe.stage_ms]:
        text = "Of solving for the pose, from the matches with all anchors at once."
        sections.append(timing_section(stage_ms, text))
    if drawn is None:
        return sections
    shown = choose_shown([_or_infinite(probe.position_error) for probe in coverage.probes])
    reader, network = drawn.open()
    pictures = []
    with reader:
        localizer = Localizer(network, reader)
        for title, place in shown:
            case = _held_out_case(title, coverage, coverage.probes[place], localizer, drawn)
            pictures += [] if case is None else draw_case(case, network.long_side_px)
    return [*sections, Section("Some images and their anchors", pictures=pictures)]


def _held_out_case(
    title: str, coverage: Coverage, probe: Probe, localizer: Localizer, drawn: Drawing
) -> Case | None:
    distances = view_distance(
        coverage.images_from_world, probe.cam_from_world, coverage.median_depth
    )
    near = np.flatnonzero(distances < coverage.apart).tolist()
    held_out = localize_without(localizer, probe.index, near)
    if held_out is None:
        return None
    names = [held_out.image.name, *(anchor.name for anchor in held_out.anchors)]
    check_files(names, drawn.map_images)
    return Case(
        f"{title}, {probe.outcome}",
        held_out.image,
        localizer.reader.features(probe.index),
        drawn.map_images,
        held_out.anchors,
        drawn.map_images,
        held_out.query,
        held_out.solution,
    )


def report_results(
    path: Path,
    poses: Path,
    truth: Path,
    queries: Path | None,
    up: str | None,
    drawn: Drawing | None,
) -> tuple[str, list[Section]]:
    """Report on results of `localize`: a title and sections."""
    results = read_results(path)
    estimates, reference = read_poses(poses), read_truth(truth)
    evaluation = evaluate(estimates, reference, [result["name"] for result in results])
    sections = [
        outcome_section(results),
        path_section(estimates, reference, evaluation, None if up is None else read_direction(up)),
        error_section(
            evaluation.position_errors_m,
            evaluation.rotation_errors_deg,
            "Of all queries; those without a pose count as failures.",
        ),
    ]
    if stage_ms := [result["stage_ms"] for result in results if result.get("stage_ms")]:
        sections.append(timing_section(stage_ms, "Of each query."))
    if drawn is None or queries is None:
        return path.name, sections
    cameras = {query.name: query for query in read_queries(queries)}
    pictures = []
    reader, network = drawn.open()
    with reader:
        sections.insert(0, map_section(reader, drawn.map_.stat().st_size))
        localizer = Localizer(network, reader)
        index_of = {name: index for index, name in enumerate(reader.names())}
        for title, place in choose_shown(evaluation.position_errors_m.tolist()):
            result = results[place]
            if result["name"] not in cameras:
                raise ConfigError(f"{queries} does not name {result['name']!r}, a query of {path}")
            title = f"{title}, {describe_error(result, evaluation, place)}"
            case = _query_case(title, cameras[result["name"]], result, index_of, localizer, drawn)
            pictures += [] if case is None else draw_case(case, network.long_side_px)
    sections.append(Section("Some queries and their anchors", pictures=pictures))
    return path.name, sections


def _query_case(
    title: str,
    query: Query,
    result: Mapping[str, Any],
    index_of: Mapping[str, int],
    localizer: Localizer,
    drawn: Drawing,
) -> Case | None:
    """Match a query again with the anchors that it was localized with."""
    names = result.get("anchors", [])
    if len(names) < 2:
        return None
    if missing := [name for name in names if name not in index_of]:
        raise ConfigError(f"{drawn.map_} does not hold the anchor {missing[0]!r}: another map?")
    check_files(names, drawn.map_images)
    frame = read_frame(drawn.images, query.name, query.camera)
    features = localizer.model.extract(frame.image, localizer.options.max_keypoints)
    anchors = [localizer.reader.anchor(index_of[name]) for name in names]
    matched = match_anchors(
        query.camera, features, anchors, localizer.matcher, localizer.model.long_side_px
    )
    image = Anchor(
        query.name,
        query.camera,
        Rigid3.identity(),
        features.keypoints,
        quantize_descriptors(features.descriptors),
    )
    return Case(
        title,
        image,
        features,
        drawn.images,
        anchors,
        drawn.map_images,
        matched,
        localizer.solve(matched),
    )


def read_results(path: Path) -> list[dict[str, Any]]:
    """Read the lines that `localize --results` writes."""
    results = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"cannot read {path}: it is not UTF-8 text") from error
    for number, line in enumerate(lines, 1):
        try:
            result = json.loads(line)
            results.append({"name": str(result["name"]), "reason": result["reason"]} | result)
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(
                f"{path}:{number}: {line[:80]!r} is no result of `trigpoint-db localize --results`"
            ) from error
    if not results:
        raise ConfigError(f"{path} holds no results")
    return results


def choose_shown(errors: Sequence[float]) -> list[tuple[str, int]]:
    """Choose the best, the median and the worst image, and some refused: titles and indices."""
    order = np.argsort(errors, kind="stable")
    found = [int(i) for i in order if np.isfinite(errors[i])]
    refused = [int(i) for i in order if not np.isfinite(errors[i])]
    chosen = []
    if found:
        places = {"the best": 0, "the median": len(found) // 2, "the worst": len(found) - 1}
        chosen += [(title, found[place]) for title, place in places.items()]
    return chosen + [("refused", i) for i in refused[:MAX_REFUSED]]


def describe_error(result: Mapping[str, Any], evaluation: Evaluation, place: int) -> str:
    """Say how far a query is off, or why it has no pose."""
    if result["reason"] is not None:
        return str(result["reason"])
    position, angle = evaluation.position_errors_m[place], evaluation.rotation_errors_deg[place]
    return f"off by {position:.2g} and {angle:.2g} degrees"


def _or_infinite(error: float) -> float:
    return error if np.isfinite(error) else np.inf
