"""How much an image of a map shares with the others, and how far away it looks."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.database.reader import MapReader
from trigpoint.frame import Anchor, LocalFeatures
from trigpoint.geometry.relative_pose import estimate_relative_pose
from trigpoint.geometry.triangulation import Tracks, triangulate
from trigpoint.models.matching import Matchable, MutualNearestNeighbors
from trigpoint.rigid import Rigid3
from trigpoint.stages import pixel_size

Array = NDArray[np.float64]

MAX_ERROR_PX = 1.5  # of the image as the network sees it
NUM_NEIGHBORS = 5  # retrieved images that an image is compared with, at the most
NUM_SAMPLED = 40  # images whose depth tells that of the map
MIN_RAY_ANGLE_DEG = 1.0  # with less, a pair of images tells no depth


@dataclass(frozen=True, eq=False)
class TwoView:
    """Keypoints that two images share.

    Parameters
    ----------
    matches : (M, 2) int
        Index in the first image, in the second: those that agree with one relative pose.
    depth : float
        Their median depth in the first image, from the poses of the map; nan where the rays are
        nearly parallel.
    """

    matches: NDArray[np.intp]
    depth: float


def verify_pair(
    features: LocalFeatures | Anchor, image: Anchor, other: Anchor, long_side_px: int
) -> TwoView:
    """Match two images, and keep the matches that agree with one relative pose."""
    pairs, _ = MutualNearestNeighbors().match(
        Matchable.of(features, image.camera), Matchable.of(other, other.camera)
    )
    first = image.camera.normalize(image.keypoints[pairs[:, 0]])
    second = other.camera.normalize(other.keypoints[pairs[:, 1]])
    usable = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    pairs, first, second = pairs[usable], first[usable], second[usable]
    px = math.hypot(
        pixel_size(image.camera, long_side_px), pixel_size(other.camera, long_side_px)
    ) / math.sqrt(2)
    pose = estimate_relative_pose(first, second, max_error=MAX_ERROR_PX * px)
    if pose is None:
        return TwoView(pairs[:0], math.nan)
    kept = pose.inliers
    views = Rigid3.stack([image.cam_from_world, other.cam_from_world])
    return TwoView(pairs[kept], _median_depth(views, first[kept], second[kept], px))


def _median_depth(views: Rigid3, first: Array, second: Array, px: float) -> float:
    num = len(first)
    tracks = Tracks(
        np.repeat(np.arange(num), 2),
        np.tile(np.arange(2), num),
        np.stack([first, second], axis=1).reshape(-1, 2),
        np.full(2 * num, px),
    )
    points3d = triangulate(views, tracks)
    rays = points3d[:, None] - views.center
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    cosines = np.clip((rays[:, 0] * rays[:, 1]).sum(axis=1), -1, 1)
    if np.degrees(np.arccos(np.median(cosines))) < MIN_RAY_ANGLE_DEG:
        return math.nan
    depth = float(np.median(views[0].apply(points3d)[:, 2]))
    return depth if depth > 0 else math.nan


def find_neighbors(reader: MapReader, index: int, features: LocalFeatures) -> list[int]:
    """Return the images that look most like one of the map, best first, without itself."""
    found, _ = reader.search(features.global_descriptor, NUM_NEIGHBORS + 1)
    return [other for other in found.tolist() if other != index][:NUM_NEIGHBORS]


def measure_overlap(
    reader: MapReader, index: int, long_side_px: int, *, enough: int
) -> tuple[int, float]:
    """Return how many keypoints an image shares with the one that it shares the most with.

    Images that look alike are tried until one shares `enough`. The second number is the median
    depth of what is shared, nan where that is not known.
    """
    features, image = reader.features(index), reader.anchor(index)
    most, depth = 0, math.nan
    for other in find_neighbors(reader, index, features):
        shared = verify_pair(features, image, reader.anchor(other), long_side_px)
        if math.isnan(depth) or (len(shared.matches) > most and not math.isnan(shared.depth)):
            depth = shared.depth
        most = max(most, len(shared.matches))
        if most >= enough and not math.isnan(depth):
            break
    return most, depth


def measure_depth(reader: MapReader, indices: Iterable[int], long_side_px: int) -> float:
    """Return the median depth of what images of a map show, in its unit; nan if it is not known."""
    depths = [measure_overlap(reader, i, long_side_px, enough=1)[1] for i in indices]
    known = [depth for depth in depths if not math.isnan(depth)]
    return float(np.median(known)) if known else math.nan
