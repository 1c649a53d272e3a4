"""Where a map is strong, thin or blind: its images are localized against the rest of it.

A frame is never taken where an image of the map was. So each image is localized without those that
are nearer to it than a frame may be expected to be to the nearest one: what is left is what such a
frame finds. Then more and more of its surroundings are left out, until it is lost: so far reach
the images there. How far apart two views are is one number, the `view_distance`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError
from trigpoint.frame import Localized, Lost, Reason, Result, Statistics, summarize
from trigpoint.localizer import Localizer
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.leave_one_out import localize_without
from trigpoint_db.overlap import NUM_SAMPLED, measure_depth
from trigpoint_db.sampling import spread_indices

Array = NDArray[np.float64]

APART = 0.2
WIDER = (2, 3, 4, 6)  # times that: to find out how far images reach
MIN_SEEN = 10  # inliers that an anchor sees, for it to count as one that agrees
ENOUGH_ANCHORS = 4
MAX_STD_RATIO = 0.02  # of the position, by the median depth
WRONG_SHARE = 0.05  # of the median depth: a pose that is off by more is wrong
WRONG_ANGLE_DEG = 10.0


class Grade(StrEnum):
    """What to expect of frames near an image."""

    STRONG = "strong"  # localized, by several anchors, with little uncertainty
    THIN = "thin"  # localized, but by few anchors, or with much uncertainty
    BLIND = "blind"  # refused, or localized wrong


GRADES = tuple(Grade)


@dataclass(frozen=True, eq=False)
class Probe:
    """An image of the map and how it was localized without its surroundings.

    Lengths are in the map's unit; those of a pose are nan where there was none.
    """

    index: int
    name: str
    cam_from_world: Rigid3  # as the map has it
    grade: Grade
    outcome: str  # LOCALIZED, WRONG_POSE, or the reason why not
    num_left_out: int
    num_anchors: int  # that agree
    depth: float
    position_error: float
    rotation_error_deg: float
    position_std: float  # along the axis of the largest
    stage_ms: dict[str, float]
    strong_reach: float  # view distance of the nearest image left when it was last strong
    reach: float  # and when it was last localized


@dataclass(frozen=True, eq=False)
class Coverage:
    """How well a map is covered.

    Parameters
    ----------
    probes : tuple of Probe
        The images that were tried.
    images_from_world : Rigid3
        cam_from_world of all images of the map (N,).
    median_depth : float
        Of what they show.
    apart : float
        How far a frame was taken to be from the nearest image, as a `view_distance`.
    up : (3,) float64
        Unit vector.
    """

    probes: tuple[Probe, ...]
    images_from_world: Rigid3
    median_depth: float
    apart: float
    up: Array

    @property
    def counts(self) -> dict[str, int]:
        """How many images have each grade."""
        found = Counter(probe.grade for probe in self.probes)
        return {grade.value: found[grade] for grade in GRADES}

    @property
    def axes(self) -> Array:
        """Two unit vectors (2, 3), to the right and to the top of a view from above."""
        return horizontal_axes(self.up)

    @property
    def probed(self) -> Rigid3:
        """cam_from_world of the images that were tried (P,)."""
        return Rigid3.stack(probe.cam_from_world for probe in self.probes)

    def distance_to_images(self, pose: Rigid3) -> float:
        """Return the view distance of a pose to the nearest image of the map."""
        return float(view_distance(self.images_from_world, pose, self.median_depth).min())

    def expect(self, pose: Rigid3) -> Grade:
        """Say what to expect of a frame, by how far images reach where the nearest probe was."""
        probe = self.probes[int(view_distance(self.probed, pose, self.median_depth).argmin())]
        distance = self.distance_to_images(pose)
        if distance <= self.apart:
            return probe.grade
        if distance <= probe.strong_reach:
            return Grade.STRONG
        return Grade.THIN if distance <= probe.reach else Grade.BLIND


def measure_coverage(
    localizer: Localizer,
    *,
    num_probes: int,
    apart: float = APART,
    up: Array | None = None,
    track: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Coverage:
    """Localize images of a map, spread over it, each without those that are near it.

    Parameters
    ----------
    localizer : Localizer
        On the map.
    num_probes : int
        At the most.
    apart : float
        Images with a smaller `view_distance` are left out.
    up : (3,) float64, optional
        By default what is up in the images, in the mean.
    track : callable, optional
        Shows progress.
    """
    reader = localizer.reader
    if len(reader) < 3:
        raise ConfigError(f"the map holds {len(reader)} images; its coverage takes three at least")
    poses = reader.poses()
    if up is None:
        up = mean_up(poses)
    long_side_px = localizer.model.long_side_px
    depth = measure_depth(reader, spread_indices(len(reader), NUM_SAMPLED), long_side_px)
    if np.isnan(depth):
        raise ConfigError(
            "no two images of the map show the same from different places: nothing can be "
            "localized with it"
        )
    names = reader.names()
    probes = tuple(
        _probe(localizer, index, names[index], poses, apart, depth)
        for index in track(spread_indices(len(reader), num_probes))
    )
    return Coverage(probes, poses, depth, apart, up)


def _probe(
    localizer: Localizer, index: int, name: str, poses: Rigid3, apart: float, depth: float
) -> Probe:
    """Localize an image without its surroundings, the closer ones, then wider ones as well."""
    pose = poses[index]
    distances = view_distance(poses, pose, depth)
    probe = wider = _localize_apart(localizer, index, name, pose, distances, apart, depth)
    for factor in WIDER:
        if wider.grade is Grade.BLIND:
            break
        wider = _localize_apart(localizer, index, name, pose, distances, apart * factor, depth)
        probe = replace(
            probe,
            strong_reach=max(probe.strong_reach, wider.strong_reach),
            reach=max(probe.reach, wider.reach),
        )
    return probe


def _localize_apart(
    localizer: Localizer,
    index: int,
    name: str,
    pose: Rigid3,
    distances: Array,
    apart: float,
    depth: float,
) -> Probe:
    """Localize an image of the map without those at a view distance (N,) below `apart`."""
    is_near = distances < apart
    held_out = localize_without(localizer, index, np.flatnonzero(is_near).tolist())
    result: Result = Lost(Reason.FEW_ANCHORS, Statistics())
    if held_out is not None:
        result = held_out.solution.result
    statistics = result.statistics
    depth = statistics.depth if statistics.depth > 0 else depth
    num_anchors = sum(count >= MIN_SEEN for count in statistics.anchor_inliers)
    grade, outcome = Grade.BLIND, summarize(result)
    position_error = angle_deg = position_std = np.nan
    if isinstance(result, Localized):
        found = result.cam_from_world
        position_error = float(np.linalg.norm(found.center - pose.center))
        angle_deg = float(np.rad2deg(rotation_angle(found.R @ pose.R.T)))
        position_std = float(np.sqrt(np.linalg.eigvalsh(result.covariance[:3, :3])[-1]))
        if position_error > WRONG_SHARE * depth or angle_deg > WRONG_ANGLE_DEG:
            outcome = "WRONG_POSE"
        elif num_anchors >= ENOUGH_ANCHORS and position_std <= MAX_STD_RATIO * depth:
            grade = Grade.STRONG
        else:
            grade = Grade.THIN
    reach = 0.0 if grade is Grade.BLIND else float(distances[~is_near].min())
    return Probe(
        index,
        name,
        pose,
        grade,
        outcome,
        num_left_out=int(is_near.sum()) - 1,
        num_anchors=num_anchors,
        depth=depth,
        position_error=position_error,
        rotation_error_deg=angle_deg,
        position_std=position_std,
        stage_ms=statistics.stage_ms,
        strong_reach=reach if grade is Grade.STRONG else 0.0,
        reach=reach,
    )


def view_distance(a: Rigid3, b: Rigid3, depth: float) -> Array:
    """Say how much of the view changes between poses: hypot(distance / depth, angle in radians).

    A step sideways by a share of the depth moves what is seen by as much as a turn by as many
    radians, and changes the angle under which it is seen by as much. Batches broadcast.
    """
    distances = np.linalg.norm(a.center - b.center, axis=-1)
    angles = rotation_angle(a.R @ np.swapaxes(b.R, -1, -2))
    apart: Array = np.hypot(distances / depth, angles)
    return apart


def mean_up(poses: Rigid3) -> Array:
    """Return what is up in the images in the mean, a unit vector (3,) in the world."""
    up: Array = -poses.R[:, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.1:
        raise ConfigError("the cameras have no common direction up; say what is up: --up X,Y,Z")
    return up / length


def horizontal_axes(up: Array) -> Array:
    """Return two unit vectors (2, 3) across `up`: right-handed, the first near the world's x."""
    x = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    right = x - (x @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)])


def summary(coverage: Coverage) -> dict[str, Any]:
    """Say in JSON's types what was found of each image."""
    return {
        "counts": coverage.counts,
        "median_depth": coverage.median_depth,
        "apart": coverage.apart,
        "up": coverage.up.tolist(),
        "images": [
            {
                "name": probe.name,
                "grade": probe.grade,
                "outcome": probe.outcome,
                "num_left_out": probe.num_left_out,
                "num_anchors": probe.num_anchors,
                "position_error": _finite(probe.position_error),
                "rotation_error_deg": _finite(probe.rotation_error_deg),
                "position_std": _finite(probe.position_std),
                "strong_reach": probe.strong_reach,
                "reach": probe.reach,
                "center": probe.cam_from_world.center.tolist(),
            }
            for probe in coverage.probes
        ],
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
