"""The stages between features and verdict, each a function of the one before.

Image points are undistorted and normalised; thresholds come in px of the image as the network sees
it and are multiplied by `Query.px`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.errors import ModelError
from trigpoint.frame import Anchor, LocalFeatures, PoseNoise, Reason, Support
from trigpoint.geometry.absolute_pose import estimate_absolute_pose
from trigpoint.geometry.anchor_ransac import AnchorConsensus, NoConsensus, find_consensus
from trigpoint.geometry.center_averaging import (
    average_centers,
    average_centers_robust,
    center_directions,
)
from trigpoint.geometry.epipolar import essential_matrix, sampson_error
from trigpoint.geometry.joint_refinement import RefinedPose, refine_jointly
from trigpoint.geometry.points_last import project
from trigpoint.geometry.pose_refinement import refine_pose
from trigpoint.geometry.relative_pose import estimate_relative_pose
from trigpoint.geometry.rotation_averaging import average_rotations
from trigpoint.geometry.triangulation import LatentPoints, Tracks, keep_agreeing, triangulate_robust
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import Matchable, Matcher, MutualNearestNeighbors
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_SAMPLED = 600  # latent points for a hypothesis: with more its error is the same
# Of a map that does not say: better too large.
UNMEASURED = PoseNoise(0.0, 0.005, 0.001, 0.0)


@dataclass(frozen=True, eq=False)
class Query:
    """The query's keypoints and their matches in the anchors.

    Parameters
    ----------
    points : (N, 2) float64
        The query's keypoints.
    px : float
        The normalised size of a pixel, of the image as the network saw it.
    views : Rigid3
        The anchors' cam_from_world (K,).
    views_px : (K,) float64
        The same of their pixels.
    tracks : Tracks
        All matches: point is the query's keypoint, view the anchor, xy the place in the anchor.
    matches : list of (M, 2) int
        By anchor: query's keypoint, anchor's keypoint; best first.
    anchor_points : list of (M, 2) float64
        By anchor: where its matched keypoints are, in the order of `matches`.
    num_matcher_failures : int
        Anchors for which the matcher failed; these have mutual nearest neighbours.
    """

    points: Array
    px: float
    views: Rigid3
    views_px: Array
    tracks: Tracks
    matches: list[Index]
    anchor_points: list[Array]
    num_matcher_failures: int

    def joined(self, other: Query) -> Query:
        """Add the anchors that the same keypoints are matched with in another query."""
        theirs = replace(other.tracks, view=other.tracks.view + len(self.views))
        return Query(
            self.points,
            self.px,
            Rigid3(
                np.concatenate([self.views.R, other.views.R]),
                np.concatenate([self.views.t, other.views.t]),
            ),
            np.concatenate([self.views_px, other.views_px]),
            Tracks.concatenate([self.tracks, theirs]),
            self.matches + other.matches,
            self.anchor_points + other.anchor_points,
            self.num_matcher_failures + other.num_matcher_failures,
        )


def extract_turned(
    model: FeatureModel, image: NDArray[np.uint8], max_keypoints: int, turned_deg: int
) -> LocalFeatures:
    """Extract features of an image turned counterclockwise by a multiple of 90 degrees.

    The keypoints are given in px of the image as it is.
    """
    turns = turned_deg // 90
    features = model.extract(np.ascontiguousarray(np.rot90(image, turns)), max_keypoints)
    x, y = features.keypoints.T
    right, bottom = image.shape[1] - 1, image.shape[0] - 1
    back = ((x, y), (right - y, x), (right - x, bottom - y), (y, bottom - x))[turns]
    return replace(features, keypoints=np.stack(back, axis=1))


def match_anchors(
    camera: Camera,
    features: LocalFeatures,
    anchors: Sequence[Anchor],
    matcher: Matcher,
    long_side_px: int,
) -> Query:
    """Match the query's features with each anchor's and normalise what matched."""
    points = camera.normalize(features.keypoints)
    seen = np.asarray(np.isfinite(points).all(axis=1))
    matches: list[Index] = []
    anchor_points: list[Array] = []
    num_failures = 0
    query = Matchable.of(features, camera)
    fallback = MutualNearestNeighbors()
    for anchor in anchors:
        other = Matchable.of(anchor, anchor.camera)
        try:
            pairs, _ = matcher.match(query, other)
        except ModelError:  # a network that does not run on these features: do without
            pairs, _ = fallback.match(query, other)
            num_failures += 1
        xy = anchor.camera.normalize(anchor.keypoints[pairs[:, 1]])
        usable = seen[pairs[:, 0]] & np.isfinite(xy).all(axis=1)
        matches.append(pairs[usable])
        anchor_points.append(xy[usable])
    point = np.concatenate(matches)[:, 0]
    view = np.repeat(np.arange(len(anchors)), [len(match) for match in matches])
    order = np.argsort(point, kind="stable")
    views_px = np.array([pixel_size(anchor.camera, long_side_px) for anchor in anchors])
    xy = np.concatenate(anchor_points)[order]
    tracks = Tracks(point[order], view[order], xy, views_px[view[order]])
    return Query(
        points,
        pixel_size(camera, long_side_px),
        Rigid3.stack(anchor.cam_from_world for anchor in anchors),
        views_px,
        tracks,
        matches,
        anchor_points,
        num_failures,
    )


def pixel_size(camera: Camera, long_side_px: int) -> float:
    """Return the normalised size of a pixel of an image that was scaled to fit the network."""
    zoom = max(1.0, max(camera.width, camera.height) / long_side_px)
    return zoom / camera.focal_px


def mean_px(query: Query, views: Index) -> Array:
    """Return the size of a pixel between the query and views: their quadratic mean."""
    mean: Array = np.sqrt((query.px**2 + query.views_px[views] ** 2) / 2)
    return mean


def estimate_relative_poses(query: Query, options: LocalizerOptions) -> tuple[Index, Rigid3]:
    """Relative poses of the query and the anchors with the most matches (paper, section II).

    Returns
    -------
    chosen : (C,) int
        The anchors that gave one, best first.
    query_from_anchors : Rigid3
        Their relative poses (C,), with translations of length 1.
    """
    by_matches = np.argsort([-len(match) for match in query.matches], kind="stable")
    chosen, poses = [], []
    for k in by_matches[: options.num_relative_poses]:
        pose = estimate_relative_pose(
            query.anchor_points[k],
            query.points[query.matches[k][:, 0]],
            max_error=options.max_epipolar_error_px * float(mean_px(query, k)),
        )
        if pose is not None and pose.inliers.sum() >= options.min_relative_inliers:
            chosen.append(k)
            poses.append(pose.b_from_a)
    return np.array(chosen, dtype=np.intp), Rigid3.stack(poses)


def agree_on_pose(
    anchors_from_world: Rigid3, query_from_anchors: Rigid3, options: LocalizerOptions
) -> AnchorConsensus | Reason:
    """Find the pose that most anchors agree on, by RANSAC over pairs of them."""
    consensus = find_consensus(
        anchors_from_world,
        query_from_anchors,
        max_direction_error_rad=np.deg2rad(options.max_direction_error_deg),
        max_rotation_error_rad=np.deg2rad(options.max_rotation_error_deg),
        min_angle_rad=np.deg2rad(options.min_ray_angle_deg),
    )
    if consensus is NoConsensus.DEGENERATE:
        return Reason.DEGENERATE_ANCHORS
    return Reason.FEW_ANCHORS if isinstance(consensus, NoConsensus) else consensus


def find_consistent(
    anchors_from_world: Rigid3, query_from_anchors: Rigid3, options: LocalizerOptions
) -> tuple[Rigid3, Rigid3] | Reason:
    """Keep the anchors, and their relative poses, that agree on one pose."""
    consensus = agree_on_pose(anchors_from_world, query_from_anchors, options)
    if isinstance(consensus, Reason):
        return consensus
    return anchors_from_world[consensus.inliers], query_from_anchors[consensus.inliers]


def average_poses(
    anchors_from_world: Rigid3, query_from_anchors: Rigid3, options: LocalizerOptions
) -> tuple[Rigid3, int] | Reason:
    """Stage 1 of the paper: RANSAC over anchor pairs, center averaging, rotation averaging.

    Returns the query's cam_from_world and how many anchors agree on it, or why there is none.
    """
    consistent = find_consistent(anchors_from_world, query_from_anchors, options)
    if isinstance(consistent, Reason):
        return consistent
    anchors, relative = consistent
    average = average_centers_robust if options.center == "robust" else average_centers
    center = average(anchors.center, center_directions(anchors, relative))
    if center is None:
        return Reason.DEGENERATE_ANCHORS
    return Rigid3.from_center(average_rotations(relative.R @ anchors.R), center), len(anchors)


def find_latent_points(query: Query, options: LocalizerOptions) -> LatentPoints:
    """Latent points of all matches, by their linear estimate: that is enough for a hypothesis."""
    limit = options.max_ray_error_px
    tracks = keep_agreeing(query.views, query.tracks, max_error_px=limit)
    return triangulate_robust(query.views, tracks, max_error_px=limit, num_iterations=0)


def solve_latent_points(
    query: Query, latent: LatentPoints, options: LocalizerOptions
) -> Rigid3 | None:
    """Latent points first: the query's pose by P3P in LO-RANSAC, with no relative pose at all."""
    # The more anchors agree on a point, the likelier it is right: sampled first.
    order = np.argsort(-latent.tracks.lengths, kind="stable")[:MAX_SAMPLED]
    return estimate_absolute_pose(
        latent.points3d[order],
        query.points[latent.point[order]],
        max_error=options.max_hypothesis_error_px * query.px,
    )


def count_support(
    query: Query, latent: LatentPoints, cam_from_world: Rigid3, options: LocalizerOptions
) -> int:
    """Count latent points that a hypothesis projects onto their keypoints."""
    seen = project(cam_from_world, latent.points3d)
    distances = np.linalg.norm(seen.xy - query.points[latent.point].T, axis=0)
    return int((seen.in_front & (distances < options.max_hypothesis_error_px * query.px)).sum())


def follows_epipolar_lines(
    query: Query, cam_from_world: Rigid3, max_error_px: float
) -> NDArray[np.bool_]:
    """Say which matches (P,) are within `max_error_px` of the epipolar geometry of a pose."""
    E = essential_matrix(cam_from_world @ query.views.inverse())
    tracks = query.tracks
    errors = sampson_error(E[tracks.view], tracks.xy, query.points[tracks.point])
    near: NDArray[np.bool_] = np.abs(errors) < max_error_px * mean_px(query, tracks.view)
    return near


def refine(
    query: Query, cam_from_world: Rigid3, options: LocalizerOptions
) -> tuple[LatentPoints, RefinedPose | None]:
    """Stage 2 of the paper: guided matches, latent points (E1), pose (E2); then all together."""
    guided = follows_epipolar_lines(query, cam_from_world, options.max_guided_error_px)
    tracks = query.tracks[guided]
    num_matches = np.bincount(tracks.view, minlength=len(query.views))
    chosen = np.argsort(-num_matches, kind="stable")[: options.num_refined_anchors]
    tracks = tracks[np.isin(tracks.view, chosen)]
    latent = triangulate_robust(query.views, tracks, max_error_px=options.max_ray_error_px)
    if len(latent.point) == 0:
        return latent, None
    points2d = query.points[latent.point]
    sharper = refine_pose(
        cam_from_world,
        latent.points3d,
        points2d,
        sigma=options.keypoint_sigma_px * query.px,
        max_error=options.max_reprojection_error_px * query.px,
    )
    if sharper is None:
        return latent, None
    seeing, view = np.unique(latent.tracks.view, return_inverse=True)
    refined = refine_jointly(
        sharper,
        query.views[seeing],
        replace(latent, tracks=replace(latent.tracks, view=view)),
        points2d,
        px=query.px,
        sigma_px=options.keypoint_sigma_px,
        pose_noise=PoseNoise(
            position=0.0,
            position_drift=options.anchor_position_noise,
            rotation_rad=math.radians(options.anchor_rotation_noise_deg),
            rotation_drift_rad=0.0,
        ),
        max_error_px=options.max_reprojection_error_px,
    )
    return latent, refined


def find_support(query: Query, latent: LatentPoints, refined: RefinedPose) -> Support:
    """Gather what a refined pose rests on."""
    return Support(
        refined.cam_from_world,
        query.points[latent.point],
        refined.points3d,
        refined.inliers,
        query.views,
    )


def mean_distance(query: Query, latent: LatentPoints, cam_from_world: Rigid3) -> float:
    """Return the mean distance of the anchors that see the latent points."""
    centers = query.views[np.unique(latent.tracks.view)].center
    return float(np.linalg.norm(centers - cam_from_world.center, axis=1).mean())


def count_by_anchor(
    query: Query, latent: LatentPoints, inliers: NDArray[np.bool_]
) -> tuple[int, ...]:
    """Count for each anchor the latent points (M,), of those that are inliers, that it sees."""
    seen = latent.tracks.view[np.repeat(inliers, latent.tracks.lengths)]
    return tuple(np.bincount(seen, minlength=len(query.views)).tolist())


def calibrate_covariance(
    covariance: Array, distance: float, map_noise: PoseNoise, options: LocalizerOptions
) -> Array:
    """Add what all anchors have wrong together: the map's noise over their mean distance."""
    common = np.diag(map_noise.std(np.array([distance]))[0] ** 2)
    return options.covariance_scale * (covariance + common)
