"""The images that a report shows, and how they were localized."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor, quantize_descriptors
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint.stages import match_anchors
from trigpoint_db.build import read_frame
from trigpoint_db.coverage import Coverage, Probe, view_distance
from trigpoint_db.evaluate import Evaluation
from trigpoint_db.leave_one_out import localize_without
from trigpoint_db.poses import Query
from trigpoint_db.report.matches import Case, draw_case
from trigpoint_db.report.page import Section
from trigpoint_db.report.results import QueryResult

MAX_REFUSED = 2  # refused queries that are shown


@dataclass(frozen=True)
class Drawing:
    """What it takes to draw images with their matches."""

    map_: Path
    images: Path
    map_images: Path
    model: str
    retrieval: Path | None
    cameras: Mapping[str, Query] = field(default_factory=dict)  # of queries, by name

    def open(self) -> tuple[MapReader, FeatureModel]:
        """Open the map and its network."""
        network = FeatureModel.load(self.model, retrieval=self.retrieval)
        return MapReader.open(self.map_, network.identity), network


def draw_probes(coverage: Coverage, drawn: Drawing) -> Section:
    """Draw some images of a map with their matches."""
    shown = choose_shown([probe.position_error for probe in coverage.probes])
    reader, network = drawn.open()
    pictures = []
    with reader:
        localizer = Localizer(network, reader)
        for title, place in shown:
            case = _held_out_case(title, coverage, coverage.probes[place], localizer, drawn)
            pictures += [] if case is None else draw_case(case, network.long_side_px)
    return Section("Some images and their anchors", pictures=pictures)


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


def draw_queries(results: Sequence[QueryResult], evaluation: Evaluation, drawn: Drawing) -> Section:
    """Draw some queries with their matches."""
    pictures = []
    reader, network = drawn.open()
    with reader:
        localizer = Localizer(network, reader)
        index_of = {name: index for index, name in enumerate(reader.names())}
        for title, place in choose_shown(evaluation.position_errors_m.tolist()):
            result = results[place]
            if result.name not in drawn.cameras:
                raise ConfigError(f"--queries does not name {result.name!r}, one of the results")
            title = f"{title}, {describe_error(result, evaluation, place)}"
            case = _query_case(title, result, index_of, localizer, drawn)
            pictures += [] if case is None else draw_case(case, network.long_side_px)
    return Section("Some queries and their anchors", pictures=pictures)


def _query_case(
    title: str,
    result: QueryResult,
    index_of: Mapping[str, int],
    localizer: Localizer,
    drawn: Drawing,
) -> Case | None:
    """Match a query again with the anchors that it was localized with."""
    query, names = drawn.cameras[result.name], result.anchors
    if len(names) < 2:
        return None
    if missing := [name for name in names if name not in index_of]:
        raise ConfigError(f"{drawn.map_} does not hold the anchor {missing[0]!r}: another map?")
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


def describe_error(result: QueryResult, evaluation: Evaluation, place: int) -> str:
    """Say how far a query is off, or why it has no pose."""
    if result.reason is not None:
        return result.reason
    position, angle = evaluation.position_errors_m[place], evaluation.rotation_errors_deg[place]
    return f"off by {position:.2g} and {angle:.2g} degrees"
