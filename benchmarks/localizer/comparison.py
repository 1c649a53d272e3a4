"""Our localizer and hloc on the same features, matches and retrieval, query by query in turn."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trigpoint.database.reader import MapReader
from trigpoint.frame import Anchor, Frame, Localized, Result, Statistics
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import Matchable
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import build_map, read_frame, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.experiments.hloc import (
    Hloc,
    match_map,
    match_query,
    write_keypoints,
    write_matches,
)
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import read_names, read_queries

Array = NDArray[np.float64]

HLOC = "hloc"


@dataclass(frozen=True, eq=False)
class Case:
    """One query, one method.

    Parameters
    ----------
    method, query : str
    position, rotation_deg : float
        Errors; inf where there is no pose.
    squares : (float, float)
        Squared errors of center and rotation in units of the covariance; nan without one.
    ms : float
    stage_ms : dict
    num_anchors : int
        That were matched.
    """

    method: str
    query: str
    position: float
    rotation_deg: float
    squares: tuple[float, float]
    ms: float
    stage_ms: dict[str, float]
    num_anchors: int


def compare(
    folder: Path,
    split: str,
    network: FeatureModel,
    methods: Mapping[str, LocalizerOptions],
    checkout: Path | None,
) -> list[Case]:
    """Localize a split's queries with each of our methods, and with hloc if there is any.

    hloc gets the anchors of the first method, which must take all of them at once.
    """
    poses = {image.name: image for image in read_model(folder / "sparse")}
    survey = select_images(list(poses.values()), read_names(folder / f"map{split}.txt"))
    cases = []
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        build_map(scratch / "map.tpmap", survey, folder / "images", network)
        calibrate_map(scratch / "map.tpmap", network)
        with MapReader.open(scratch / "map.tpmap", network.identity) as reader:
            anchors = {a.name: a for a in (reader.anchor(i) for i in range(len(reader)))}
            hloc = None
            if checkout is not None:
                hloc = Hloc(checkout, scratch, list(anchors.values()), match_map(anchors))
            localizers = {
                name: Localizer(network, reader, options, time.perf_counter)
                for name, options in methods.items()
            }
            queries = read_queries(folder / f"queries{split}.txt")
            first = read_frame(folder / "images", queries[0].name, queries[0].camera)
            for localizer in localizers.values():
                localizer.localize(first)
            for query in queries:
                truth = poses[query.name].cam_from_world
                frame = read_frame(folder / "images", query.name, query.camera)
                results = {}
                for name, localizer in localizers.items():
                    results[name], ms = timed(localizer.localize, frame)
                    cases.append(_judge(name, results[name], truth, ms, frame.name))
                reference = results[next(iter(methods))].statistics
                if hloc is not None:
                    cases.append(
                        _run_hloc(hloc, network, frame, anchors, reference, truth, scratch)
                    )
    return cases


def _judge(name: str, result: Result, truth: Rigid3, ms: float, query: str) -> Case:
    statistics = result.statistics
    pose, squares = None, (np.nan, np.nan)
    if isinstance(result, Localized):
        pose = result.cam_from_world
        turn = Rotation.from_matrix(truth.R.T @ pose.R).as_rotvec()
        squares = (
            _square(truth.center - pose.center, result.covariance[:3, :3]),
            _square(turn, result.covariance[3:, 3:]),
        )
    found = errors(pose, truth)
    return Case(name, query, *found, squares, ms, statistics.stage_ms, statistics.num_anchors)


def _square(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def _run_hloc(
    hloc: Hloc,
    network: FeatureModel,
    frame: Frame,
    anchors: dict[str, Anchor],
    reference: Statistics,
    truth: Rigid3,
    scratch: Path,
) -> Case:
    """Localize with hloc on the same features, retrieval and matches."""
    features, ms_features = timed(network.extract, frame.image, 1024)
    stage_ms = {"features": ms_features, "retrieval": reference.stage_ms["retrieval"]}
    query = Matchable.of(features, frame.camera)
    matches, stage_ms["matching"] = timed(match_query, query, anchors, reference.anchors)
    files = scratch / "query.h5", scratch / "query_matches.h5"
    write_keypoints(files[0], {frame.name: features.keypoints})
    write_matches(files[1], {(frame.name, anchor): m for anchor, m in matches.items()})
    camera = hloc.camera(frame.camera.to_text())
    pose, stage_ms["pose"] = timed(hloc.localize, frame.name, camera, list(matches), *files)
    ms, unknown = sum(stage_ms.values()), (np.nan, np.nan)
    found = errors(pose, truth)
    return Case(HLOC, frame.name, *found, unknown, ms, stage_ms, len(matches))


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
