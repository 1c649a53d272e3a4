"""A map of points, and PnP: what hloc does (Sarlin et al., "From Coarse to Fine", CVPR 2019).

hloc triangulates the points of the whole map beforehand; here COLMAP triangulates those of the
frame's anchors from their matches with each other and their poses, and the frame is localized by
the points that its keypoints match. Needs pycolmap, the extra `colmap`.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pycolmap

from trigpoint.camera import Camera
from trigpoint.frame import Reason
from trigpoint.geometry.epipolar import essential_matrix, sampson_error
from trigpoint.models.matching import Matchable
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint_db.methods.matched import Matched

# hloc's and COLMAP's defaults.
MAX_EPIPOLAR_ERROR_PX = 4.0
MAX_TRIANGULATION_ERROR_PX = 4.0
MIN_TRIANGULATION_ANGLE_DEG = 1.5
MAX_PNP_ERROR_PX = 12.0
MIN_POINTS = 4


def estimate_pose(matched: Matched, _: LocalizerOptions) -> Rigid3 | Reason:
    """Solve for the pose from the anchors' points, by COLMAP's LO-RANSAC and refinement."""
    anchors = triangulate_anchors(matched)
    pairs = set()  # the frame's keypoint, point: both may be in several
    for image_id, matches in enumerate(matched.query.matches, 1):
        points2d = anchors.images[image_id].points2D
        for keypoint, place in matches.tolist():
            if points2d[place].has_point3D():
                pairs.add((keypoint, points2d[place].point3D_id))
    if len(pairs) < MIN_POINTS:
        return Reason.FEW_MATCHES
    keypoints, points = zip(*sorted(pairs), strict=True)
    found = pycolmap.estimate_and_refine_absolute_pose(
        matched.features.keypoints[list(keypoints)] + 0.5,
        np.array([anchors.points3D[point].xyz for point in points]),
        to_pycolmap(matched.camera),
        {"ransac": {"max_error": MAX_PNP_ERROR_PX, "random_seed": 0}},
    )
    if found is None:
        return Reason.FEW_INLIERS
    pose = found["cam_from_world"]
    return Rigid3(pose.rotation.matrix(), np.array(pose.translation))


def triangulate_anchors(matched: Matched) -> Any:
    """Make a pycolmap.Reconstruction of the anchors: images 1 to K, and the points they share.

    As in COLMAP's triangulation of a model whose poses are known, with one bundle adjustment.
    """
    pycolmap.logging.minloglevel = 2  # it reports on each
    reconstruction, graph = pycolmap.Reconstruction(), pycolmap.CorrespondenceGraph()
    for image_id, anchor in enumerate(matched.anchors, 1):
        reconstruction.add_camera_with_trivial_rig(to_pycolmap(anchor.camera, image_id))
        keypoints = anchor.keypoints.astype(np.float64) + 0.5
        image = pycolmap.Image(anchor.name, keypoints, camera_id=image_id, image_id=image_id)
        pose = anchor.cam_from_world
        reconstruction.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose.R), pose.t)
        )
        graph.add_image(image_id, len(keypoints))
    calibrated = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    for (a, b), matches in match_each_other(matched).items():
        geometry = pycolmap.TwoViewGeometry(inlier_matches=matches, config=calibrated)
        graph.add_two_view_geometry(a + 1, b + 1, geometry)
    graph.finalize()
    points = pycolmap.ObservationManager(reconstruction, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, reconstruction, points)
    options = pycolmap.IncrementalTriangulatorOptions()
    adjusted = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.images:
        triangulator.triangulate_image(options, image_id)
        adjusted.add_image(image_id)
        adjusted.set_constant_cam_intrinsics(image_id)
        adjusted.set_constant_rig_from_world_pose(image_id)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    limits = MAX_TRIANGULATION_ERROR_PX, MIN_TRIANGULATION_ANGLE_DEG
    points.filter_all_points3D(*limits)
    quietly = pycolmap.BundleAdjustmentOptions(print_summary=False)
    pycolmap.create_default_bundle_adjuster(quietly, adjusted, reconstruction).solve()
    points.filter_all_points3D(*limits)
    return reconstruction


def match_each_other(matched: Matched) -> dict[tuple[int, int], np.ndarray[Any, Any]]:
    """Match each anchor with each other: matches (M, 2) near the epipolar lines of their poses."""
    anchors = matched.anchors
    matchable = [Matchable.of(anchor, anchor.camera) for anchor in anchors]
    points = [anchor.camera.normalize(anchor.keypoints) for anchor in anchors]
    matches = {}
    for a, b in combinations(range(len(anchors)), 2):
        pairs, _ = matched.matcher.match(matchable[a], matchable[b])
        b_from_a = anchors[b].cam_from_world @ anchors[a].cam_from_world.inverse()
        errors = sampson_error(
            essential_matrix(b_from_a), points[a][pairs[:, 0]], points[b][pairs[:, 1]]
        )
        focal_px = min(anchors[a].camera.focal_px, anchors[b].camera.focal_px)
        matches[a, b] = pairs[np.abs(errors) < MAX_EPIPOLAR_ERROR_PX / focal_px].astype(np.uint32)
    return matches


def to_pycolmap(camera: Camera, camera_id: int = 1) -> Any:
    """Make COLMAP's camera of ours."""
    return pycolmap.Camera(
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.to_colmap(),
        camera_id=camera_id,
    )
