"""Whether a pose may be used: everything that speaks against it, and how sure it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.frame import Reason
from trigpoint.geometry.joint_refinement import RefinedPose
from trigpoint.geometry.triangulation import LatentPoints, keep_agreeing
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint.stages import (
    Query,
    count_support,
    find_latent_points,
    follows_epipolar_lines,
    solve_latent_points,
)

Array = NDArray[np.float64]

# Poses nearer to each other than this are one pose, found twice.
SAME_PLACE = 0.1  # of the median depth
SAME_DIRECTION_DEG = 5.0
# Learnt by benchmarks/localizer/confidence.py.
CONFIDENCE = (-3.18, 2.10, -1.73)


@dataclass(frozen=True)
class Evidence:
    """What is known of a refined pose.

    Parameters
    ----------
    num_candidates : int
        Latent points of all matches, before any pose.
    num_points : int
        Latent points of the matches that agree with the hypothesis.
    num_inliers : int
        Those that agree with the pose.
    num_rivals : int
        Latent points that agree with another pose, and not with this one.
    spread_px : float
        Standard deviation of the inliers' places in the query's image, along the axis on which they
        spread the least.
    depth : float
        The inliers' median depth.
    depth_std_ratio : float
        The median standard deviation of their distances, as the anchors determine them, over the
        distance.
    std_ratio : float
        The position's standard deviation, but for what is wrong with the whole map, over the median
        depth.
    """

    num_candidates: int
    num_points: int
    num_inliers: int
    num_rivals: int
    spread_px: float
    depth: float
    depth_std_ratio: float
    std_ratio: float


def gather_evidence(
    query: Query,
    num_candidates: int,
    latent: LatentPoints,
    refined: RefinedPose,
    options: LocalizerOptions,
) -> Evidence:
    """Measure what a verdict is made of."""
    points = query.points[latent.point[refined.inliers]]
    least = float(np.linalg.eigvalsh(np.cov(points.T))[0])
    depths = refined.cam_from_world.apply(latent.points3d[refined.inliers])[:, 2]
    depth = float(np.median(depths))
    sight = latent.points3d[refined.inliers] - refined.cam_from_world.center
    squares = np.einsum("mi,mij,mj->m", sight, refined.point_covariance[refined.inliers], sight)
    depth_std = np.sqrt(np.maximum(squares, 0)) / (sight**2).sum(axis=1)
    num_inliers = len(points)
    return Evidence(
        num_candidates,
        len(latent.point),
        num_inliers,
        count_rivals(query, refined.cam_from_world, depth, num_inliers, options),
        math.sqrt(max(least, 0.0)) / query.px,
        depth,
        float(np.median(depth_std)),
        position_std(refined.covariance) / depth,
    )


def count_rivals(
    query: Query,
    cam_from_world: Rigid3,
    depth: float,
    num_inliers: int,
    options: LocalizerOptions,
) -> int:
    """Count the latent points that agree on another pose, of matches that this one cannot explain.

    In a repeated structure each anchor shows one of its copies, and so do the matches: those of the
    wrong copy agree among themselves as well as those of the right one.
    """
    explained = follows_epipolar_lines(query, cam_from_world, options.max_guided_error_px)
    limit, enough = options.max_ray_error_px, options.max_rival_ratio * num_inliers
    rest = keep_agreeing(query.views, query.tracks[~explained], max_error_px=limit)
    if len(rest.lengths) < enough:
        return 0
    other = replace(query, tracks=rest)
    latent = find_latent_points(other, options)
    if len(latent.point) < enough:
        return 0
    pose = solve_latent_points(other, latent, options)
    if pose is None or _is_same(pose, cam_from_world, depth):
        return 0
    return count_support(other, latent, pose, options)


def _is_same(a: Rigid3, b: Rigid3, depth: float) -> bool:
    angle = np.rad2deg(rotation_angle((a @ b.inverse()).R))
    distance = np.linalg.norm(a.center - b.center)
    return bool(distance < SAME_PLACE * depth and angle < SAME_DIRECTION_DEG)


def see_share(
    camera: Camera, cam_from_world: Rigid3, points3d: Array, max_distance: float
) -> float:
    """Return which share of points (M, 3) a camera sees, none of them farther than a distance."""
    points = cam_from_world.apply(points3d)
    x, y = camera.project(points).T  # nan behind it
    inside = (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
    return float((inside & (np.linalg.norm(points, axis=1) < max_distance)).mean())


def measure_confidence(evidence: Evidence) -> float:
    """Return the probability that a pose is right, 0 to 1.

    Logistic regression on the share of the latent points that agree with the pose, and on how well
    they determine its position. Nothing else that was tried made it better (ADR 12).
    """
    agreeing = math.log(evidence.num_inliers / evidence.num_candidates)
    z = CONFIDENCE[0] + CONFIDENCE[1] * agreeing + CONFIDENCE[2] * math.log(evidence.std_ratio)
    return 1 / (1 + math.exp(-z))


def judge(
    evidence: Evidence, confidence: float, covariance: Array, options: LocalizerOptions
) -> tuple[Reason, str] | None:
    """Say why a pose with this covariance must not be used, or None."""
    num_inliers = evidence.num_inliers
    if num_inliers < options.min_inliers:
        return Reason.FEW_INLIERS, f"{num_inliers} latent points agree"
    if evidence.num_rivals > options.max_rival_ratio * num_inliers:
        return (
            Reason.AMBIGUOUS,
            f"{num_inliers} latent points agree, and {evidence.num_rivals} on another pose",
        )
    if confidence < options.min_confidence:
        found = f"{num_inliers} of {evidence.num_candidates} latent points agree"
        return Reason.LOW_CONFIDENCE, f"{confidence:.2f}: {found}"
    if evidence.spread_px < options.min_spread_px:
        return Reason.CLUSTERED_INLIERS, f"within {evidence.spread_px:.0f} px of a line"
    if evidence.depth_std_ratio > options.max_depth_std_ratio:
        ratio = f"{evidence.depth_std_ratio:.0%}"
        return (
            Reason.DEGENERATE_ANCHORS,
            f"distances only to {ratio}: the anchors' rays are parallel",
        )
    std = position_std(covariance)
    limit = options.max_position_std_ratio * evidence.depth
    limit = min(limit, options.max_position_std_m or math.inf)
    if std > limit:
        return Reason.HIGH_UNCERTAINTY, f"position to {std:.3g}, the limit is {limit:.3g}"
    return None


def position_std(covariance: Array) -> float:
    """Return the largest standard deviation of a position, of a pose's covariance (6, 6)."""
    return math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
