"""How well a network's features match: on warped images, and for poses on images with poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from trigpoint.geometry.relative_pose import estimate_relative_pose
from trigpoint.models.local import Extraction, FeatureNetwork
from trigpoint.models.matching import match_mutual
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.quantize.pairs import View, Warped

Array = NDArray[np.float64]

MAX_ERROR_PX = 3.0  # of a right match, and where the AUC of corners ends
MAX_EPIPOLAR_ERROR_PX = 1.5  # the localizer's
MAX_POSE_ERROR_DEG = 10.0  # where the AUC of poses ends
_SAME_PX = 1.0  # two networks' keypoints are the same


@dataclass(frozen=True, eq=False)
class Matched:
    """What two feature sets of each of P pairs came to."""

    correct: Array  # (P,) matches within MAX_ERROR_PX of the truth
    visible: Array  # (P,) keypoints of the first image that the second one shows
    corner_score: Array  # (P,) 1 - error of the homography's corners / MAX_ERROR_PX, at least 0


def match_warped(
    pairs: Sequence[Warped], features: Sequence[tuple[Extraction, Extraction]]
) -> Matched:
    """Match the features of warped pairs and compare with the homographies."""
    rows = [_match(pair, *both) for pair, both in zip(pairs, features, strict=True)]
    return Matched(*np.array(rows, np.float64).reshape(-1, 3).T)


def _match(pair: Warped, first: Extraction, second: Extraction) -> tuple[float, float, float]:
    height, width = pair.second.shape
    truth = _apply(pair.second_from_first, first.keypoints)
    visible = ((truth >= 0) & (truth <= (width - 1, height - 1))).all(axis=1)
    matches, _ = match_mutual(first.descriptors, second.descriptors)
    error = np.linalg.norm(truth[matches[:, 0]] - second.keypoints[matches[:, 1]], axis=1)
    score = 0.0
    if len(matches) >= 4:
        points = first.keypoints[matches[:, 0]], second.keypoints[matches[:, 1]]
        H, _ = cv2.findHomography(*points, cv2.USAC_MAGSAC, MAX_ERROR_PX)
        if H is not None:
            corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
            off = _apply(np.asarray(H), corners) - _apply(pair.second_from_first, corners)
            score = max(0.0, 1 - float(np.linalg.norm(off, axis=1).mean()) / MAX_ERROR_PX)
    return float((error < MAX_ERROR_PX).sum()), float(visible.sum()), score


def _apply(H: Array, points: NDArray[np.floating]) -> Array:
    mapped: Array = np.c_[points, np.ones(len(points))] @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def score_poses(model: FeatureNetwork, pairs: Sequence[tuple[View, View]]) -> Array:
    """Return 1 - error / MAX_POSE_ERROR_DEG, at least 0, of the relative pose of each pair (P,).

    The error is the larger of those of the rotation and of the translation's direction; the mean
    is the area under the curve of recall over the error, up to MAX_POSE_ERROR_DEG.
    """
    views = {id(view): view for pair in pairs for view in pair}
    features = {key: model.extract(view.frame.image) for key, view in views.items()}
    return np.array(
        [
            _score_pose((a, features[id(a)]), (b, features[id(b)]), model.long_side_px)
            for a, b in pairs
        ]
    )


def _score_pose(
    first: tuple[View, Extraction], second: tuple[View, Extraction], long_side_px: int
) -> float:
    (a, features_a), (b, features_b) = first, second
    matches, _ = match_mutual(features_a.descriptors, features_b.descriptors)
    xy_a = a.frame.camera.normalize(features_a.keypoints[matches[:, 0]])
    xy_b = b.frame.camera.normalize(features_b.keypoints[matches[:, 1]])
    usable = np.isfinite(xy_a).all(axis=1) & np.isfinite(xy_b).all(axis=1)
    px = np.mean([_pixel_size(view, long_side_px) for view in (a, b)])
    pose = estimate_relative_pose(
        xy_a[usable], xy_b[usable], max_error=MAX_EPIPOLAR_ERROR_PX * float(px)
    )
    if pose is None:
        return 0.0
    error = np.degrees(_pose_error(pose.b_from_a, b.cam_from_world @ a.cam_from_world.inverse()))
    return max(0.0, 1 - float(error) / MAX_POSE_ERROR_DEG)


def _pixel_size(view: View, long_side_px: int) -> float:
    camera = view.frame.camera
    zoom = max(1.0, max(camera.width, camera.height) / long_side_px)
    return zoom / camera.focal_px


def _pose_error(estimate: Rigid3, truth: Rigid3) -> float:
    turned = float(rotation_angle(estimate.R @ truth.R.T))
    a, b = estimate.t, truth.t
    return max(turned, float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@dataclass(frozen=True)
class Agreement:
    """How alike a network's features are to another's, of the same images."""

    repeatability: float  # share of the keypoints that the other has within a pixel
    displacement: float  # mean distance to the nearest keypoint / MAX_ERROR_PX, at most 1
    cosine: float  # mean of the descriptors of the same keypoints
    global_cosine: float | None  # mean of the global descriptors, where there are any

    @property
    def damage(self) -> float:
        """One number for all of it, 0 where nothing differs."""
        turned = 0.0 if self.global_cosine is None else 1 - self.global_cosine
        return self.displacement + (1 - self.cosine) + turned


def compare(ours: Sequence[Extraction], others: Sequence[Extraction]) -> Agreement:
    """Compare features of the same images, image by image."""
    distances, cosines, globals_ = [], [], []
    for a, b in zip(ours, others, strict=True):
        if not len(b.keypoints):
            distances.append(np.full(len(a.keypoints), np.inf))
            continue
        distance, nearest = cKDTree(b.keypoints).query(a.keypoints)
        distances.append(distance)
        same = distance < _SAME_PX
        cosines.append((a.descriptors[same] * b.descriptors[nearest[same]]).sum(axis=1))
        if a.global_descriptor is not None and b.global_descriptor is not None:
            globals_.append(float(a.global_descriptor @ b.global_descriptor))
    distance, cosine = np.concatenate(distances), np.concatenate([*cosines, []])
    return Agreement(
        repeatability=float(np.mean(distance < _SAME_PX)) if len(distance) else 0.0,
        displacement=float(np.minimum(distance / MAX_ERROR_PX, 1).mean()) if len(distance) else 1.0,
        cosine=float(cosine.mean()) if len(cosine) else 0.0,
        global_cosine=float(np.mean(globals_)) if globals_ else None,
    )
