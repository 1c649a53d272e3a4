"""Our localizer and hloc on the same features, matches and retrieval, query by query in turn."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.localizer.hloc import Hloc, write_keypoints, write_matches
from trigpoint.database.reader import MapReader
from trigpoint.frame import Anchor, Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import Matchable, MutualNearestNeighbors
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint.stages import LocalizerOptions
from trigpoint_db.build import build_map, read_frame, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import read_names, read_queries

NUM_NEIGHBOURS = 20  # of each anchor, those with the most matches: hloc's map is made of these


@dataclass(frozen=True)
class Case:
    """One query, one method: errors (inf where there is no pose) and milliseconds."""

    method: str
    query: str
    position: float
    rotation_deg: float
    ms: float
    stage_ms: dict[str, float]


def compare(
    folder: Path, split: str, network: FeatureModel, options: LocalizerOptions, checkout: Path
) -> list[Case]:
    """Localize a split's queries with both."""
    poses = {image.name: image for image in read_model(folder / "sparse")}
    survey = select_images(list(poses.values()), read_names(folder / f"map{split}.txt"))
    cases = []
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        build_map(scratch / "map.tpmap", survey, folder / "images", network)
        calibrate_map(scratch / "map.tpmap", network)
        with MapReader.open(scratch / "map.tpmap", network.identity) as reader:
            anchors = {a.name: a for a in (reader.anchor(i) for i in range(len(reader)))}
            hloc = Hloc(checkout, scratch, list(anchors.values()), match_map(anchors))
            localizer = Localizer(network, reader, options, time.perf_counter)
            queries = read_queries(folder / f"queries{split}.txt")
            localizer.localize(
                read_frame(folder / "images" / queries[0].name, queries[0].camera, "warm-up")
            )
            for query in queries:
                truth = poses[query.name].cam_from_world
                frame = read_frame(folder / "images" / query.name, query.camera, query.name)
                start = time.perf_counter()
                result = localizer.localize(frame)
                ms = (time.perf_counter() - start) * 1e3
                pose = result.cam_from_world if isinstance(result, Localized) else None
                stage_ms = result.statistics.stage_ms
                cases.append(Case("Trigpoint", query.name, *errors(pose, truth), ms, stage_ms))

                features, ms_features = timed(network.extract, frame.image, options.max_keypoints)
                stage_ms = {"features": ms_features, "retrieval": stage_ms["retrieval"]}
                matches, stage_ms["matching"] = timed(
                    match_query,
                    Matchable.of(features, query.camera),
                    anchors,
                    result.statistics.anchors,
                )
                files = scratch / "query.h5", scratch / "query_matches.h5"
                write_keypoints(files[0], {query.name: features.keypoints})
                write_matches(files[1], {(query.name, anchor): m for anchor, m in matches.items()})
                camera = hloc.camera(query.camera.to_text())
                pose, stage_ms["pose"] = timed(
                    hloc.localize, query.name, camera, list(matches), *files
                )
                ms = sum(stage_ms.values())
                cases.append(Case("hloc", query.name, *errors(pose, truth), ms, stage_ms))
    return cases


def timed(function: Any, *arguments: Any) -> tuple[Any, float]:
    """Call it: its result, and the milliseconds."""
    start = time.perf_counter()
    result = function(*arguments)
    return result, (time.perf_counter() - start) * 1e3


def errors(estimate: Rigid3 | None, truth: Rigid3) -> tuple[float, float]:
    """Distance of the centers and angle of the rotations in degrees."""
    if estimate is None:
        return np.inf, np.inf
    distance = np.linalg.norm(estimate.center - truth.center)
    return float(distance), float(np.rad2deg(rotation_angle((estimate @ truth.inverse()).R)))


def match_map(anchors: dict[str, Anchor]) -> dict[tuple[str, str], NDArray[np.intp]]:
    """Match all anchors, and keep each one's matches with its best neighbours."""
    names = list(anchors)
    matcher = MutualNearestNeighbors()
    matchable = {name: Matchable.of(anchor, anchor.camera) for name, anchor in anchors.items()}
    matches = {
        (a, b): matcher.match(matchable[a], matchable[b])[0]
        for a, b in itertools.combinations(names, 2)
    }
    kept = set()
    for name in names:
        own = [pair for pair in matches if name in pair]
        kept.update(sorted(own, key=lambda pair: -len(matches[pair]))[:NUM_NEIGHBOURS])
    return {pair: matches[pair] for pair in matches if pair in kept}


def match_query(
    query: Matchable, anchors: dict[str, Anchor], retrieved: Sequence[str]
) -> dict[str, NDArray[np.intp]]:
    """Match a query with the anchors retrieved for it."""
    matcher = MutualNearestNeighbors()
    return {
        name: matcher.match(query, Matchable.of(anchors[name], anchors[name].camera))[0]
        for name in retrieved
    }
