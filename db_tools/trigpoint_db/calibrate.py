"""Measure how well the poses of a map agree with each other, by localizing its own images.

Some images, spread over the map, are localized against the others; once against all of them, and
again without those that were taken just before and after, so that the nearest anchor is as far away
as it is for a frame between two surveys. Of the noises on a grid, the one under which the errors
are likeliest is the map's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import PoseNoise
from trigpoint.geometry.pose_refinement import RefinedPose
from trigpoint.geometry.triangulation import LatentPoints
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import MutualNearestNeighbors
from trigpoint.rigid import Rigid3
from trigpoint.stages import (
    LocalizerOptions,
    Query,
    find_latent_points,
    judge,
    match_anchors,
    refine,
    refine_with_anchors,
    solve_latent_points,
)

NUM_IMAGES = 24
MAX_POINTS = 250  # of a trial: enough to tell, and quick
GAPS = (0, 8, 24)  # images left out on either side
MIN_TRIALS = 10
POSITION = tuple(0.0005 * 2**k for k in range(8))  # to 6 % of the distance
ROTATION_RAD = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
STUDENT_DOF = 4.0  # errors have long tails: those of wrong poses must not set the noise


@dataclass(frozen=True, eq=False)
class Trial:
    """One image of the map, localized against others up to the last refinement."""

    truth: Rigid3
    query: Query
    latent: LatentPoints
    start: Rigid3

    def refine(self, options: LocalizerOptions, noise: PoseNoise) -> RefinedPose | None:
        """Do the last refinement."""
        return refine_with_anchors(self.query, self.latent, self.start, options, noise)


def calibrate_map(
    path: Path, model: FeatureModel, track: Callable[[list[int]], Iterable[int]] = iter
) -> PoseNoise | None:
    """Measure the noise of a map's poses and write it into the map; `track` shows progress."""
    with MapReader.open(path, model.identity) as reader:
        spread = np.linspace(0, len(reader), NUM_IMAGES, endpoint=False).astype(int)
        images = np.unique(spread).tolist() if len(reader) else []
        noise = measure_pose_noise(reader, LocalizerOptions(), model.long_side_px, track(images))
    with MapWriter.open(path, model.identity) as writer:
        writer.set_pose_noise(noise)
    return noise


def measure_pose_noise(
    reader: MapReader, options: LocalizerOptions, long_side_px: int, images: Iterable[int]
) -> PoseNoise | None:
    """Measure the noise of a map's poses; None where too few images could be localized."""
    trials = [
        trial
        for index in images
        for gap in GAPS
        if (trial := _try_image(reader, options, long_side_px, index, gap)) is not None
    ]
    if len(trials) < MIN_TRIALS:
        return None
    costs: dict[tuple[int, int], float] = {}

    def cost(cell: tuple[int, int]) -> float:
        if cell not in costs:
            noise = PoseNoise(POSITION[cell[0]], ROTATION_RAD[cell[1]])
            costs[cell] = float(np.mean([_surprise(trial, options, noise) for trial in trials]))
        return costs[cell]

    best, previous = (3, 2), None
    while best != previous:
        previous = best
        best = min(((row, best[1]) for row in range(len(POSITION))), key=cost)
        best = min(((best[0], column) for column in range(len(ROTATION_RAD))), key=cost)
    return PoseNoise(POSITION[best[0]], ROTATION_RAD[best[1]])


def _try_image(
    reader: MapReader, options: LocalizerOptions, long_side_px: int, index: int, gap: int
) -> Trial | None:
    features, image = reader.features(index), reader.anchor(index)
    near = 2 * gap + 1
    found, _ = reader.search(
        features.global_descriptor, options.num_anchors + near, options.anchor_diversity
    )
    others = found[np.abs(found - index) > gap][: options.num_anchors]
    if len(others) < 2:
        return None
    anchors = [reader.anchor(int(other)) for other in others]
    query = match_anchors(image.camera, features, anchors, MutualNearestNeighbors(), long_side_px)
    latent = find_latent_points(query, options)
    if len(latent.point) < options.min_inliers:
        return None
    start = solve_latent_points(query, latent, options)
    if start is None:
        return None
    latent, refined = refine(query, start, options)
    if refined is None or judge(latent, refined, options) is not None:
        return None
    return Trial(image.cam_from_world, query, _thin_out(latent), refined.cam_from_world)


def _thin_out(latent: LatentPoints) -> LatentPoints:
    kept = np.unique(np.linspace(0, len(latent.point) - 1, MAX_POINTS).astype(int))
    point = latent.point[kept]
    tracks = latent.tracks[np.isin(latent.tracks.point, point)]
    return LatentPoints(point, latent.points3d[kept], latent.covariance[kept], tracks)


def _surprise(trial: Trial, options: LocalizerOptions, noise: PoseNoise) -> float:
    """Negative log-likelihood of an error, Student's t for center and rotation each."""
    refined = trial.refine(options, noise)
    if refined is None:
        return 0.0
    pose, C = refined.cam_from_world, refined.covariance
    dtheta = Rotation.from_matrix(trial.truth.R.T @ pose.R).as_rotvec()
    return _student(trial.truth.center - pose.center, C[:3, :3]) + _student(dtheta, C[3:, 3:])


def _student(error: NDArray[np.float64], C: NDArray[np.float64]) -> float:
    square = error @ np.linalg.solve(C, error)
    spread = np.linalg.slogdet(C)[1] / 2
    return float(spread + (STUDENT_DOF + 3) / 2 * np.log1p(square / STUDENT_DOF))
