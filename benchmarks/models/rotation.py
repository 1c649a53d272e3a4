"""Relative poses where the second image is turned in its plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.models.methods import NUM_KEYPOINTS, Features
from benchmarks.models.poses import Matches, Pairs, pose_errors
from benchmarks.models.scores import area
from benchmarks.models.surveys import LONG_SIDE_PX, Survey, shrink
from trigpoint.frame import LocalFeatures
from trigpoint_db.experiments.tables import markdown

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

SETS = ("tnt_truck", "7scenes_redkitchen")
PAIRS_A_SET = 20
ANGLES_DEG = (0, 15, 30, 45, 60, 90, 135, 180)
PASSES_DEG = (0, 90, 180, 270)

CAPTION = f"""Relative pose, AUC@10, of at most {PAIRS_A_SET} pairs each of
{" and ".join(SETS)}, the
second image turned in its plane; both scaled to a diagonal of {LONG_SIDE_PX} px. "4 passes" also
tries the second image turned by 90, 180 and 270 degrees, and keeps the turn with the most
matches."""


def measure(features: Features, surveys: Sequence[Survey], pairs: Pairs) -> dict[str, Any]:
    """Pose errors (pairs, seeds) by angle, with one pass and, where it is asked for, with four."""
    method = features.method
    variants: dict[str, tuple[int, ...]] = {method.name: (0,)}
    if method.turned:
        variants[f"{method.name}, 4 passes"] = PASSES_DEG
    errors: dict[str, Any] = {name: {angle: [] for angle in ANGLES_DEG} for name in variants}
    for survey in surveys:
        if survey.name not in SETS:
            continue
        every = max(1, len(pairs[survey.name]) // PAIRS_A_SET)
        for pair in pairs[survey.name][::every][:PAIRS_A_SET]:
            a, b = (_shrink_to_diagonal(survey.images[index]) for index in pair)
            features_a = _extract(features, survey.images[pair[0]], a, np.eye(2, 3))
            for angle in ANGLES_DEG:
                found = {
                    extra: _match(features, features_a, survey.images[pair[1]], b, angle, extra)
                    for extra in (PASSES_DEG if method.turned else (0,))
                }
                for name, passes in variants.items():
                    best = max((found[extra] for extra in passes), key=lambda m: len(m.a))
                    errors[name][angle].append(pose_errors(survey, pair, best))
    return errors if errors[method.name][0] else {}


def turn(image: Image, angle_deg: float) -> tuple[Image, Array]:
    """Turn an image about its centre, on a canvas that holds it all.

    Returns
    -------
    turned : (H, W) uint8
    image_from_turned : (2, 3) float64
        Affine, in px.
    """
    height, width = image.shape
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    R = np.array([[c, -s], [s, c]])
    canvas = np.round(np.abs(R) @ (width, height)).astype(int)
    centre, new_centre = (np.array([width, height]) - 1) / 2, (canvas - 1) / 2
    image_from_turned = np.column_stack([R.T, centre - R.T @ new_centre])
    turned = cv2.warpAffine(
        image,
        image_from_turned,
        tuple(int(side) for side in canvas),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderValue=float(image.mean()),
    )
    return np.asarray(turned, np.uint8), image_from_turned


def _shrink_to_diagonal(image: Image) -> Image:
    """Scale to a diagonal of LONG_SIDE_PX: however it is turned, all methods take it as it is."""
    return shrink(image, int(LONG_SIDE_PX * max(image.shape) / np.hypot(*image.shape)))


def _match(
    features: Features, a: LocalFeatures, original: Image, small: Image, angle: float, extra: float
) -> Matches:
    """Match features with an image turned by an angle, and once more by that of a pass."""
    turned, small_from_turned = turn(small, angle)
    again, turned_from_again = turn(turned, extra)
    small_from_again = small_from_turned @ np.vstack([turned_from_again, (0, 0, 1)])
    b = _extract(features, original, again, small_from_again, small.shape)
    matches = features.method.match(a, b)
    return Matches(a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]])


def _extract(
    features: Features,
    original: Image,
    turned: Image,
    small_from_turned: Array,
    small_shape: tuple[int, ...] | None = None,
) -> LocalFeatures:
    """Extract features of a turned image; the keypoints are those in the original."""
    found = features.extractor.extract(turned, NUM_KEYPOINTS)
    small = found.keypoints @ small_from_turned[:, :2].T + small_from_turned[:, 2]
    zoom = np.divide(original.shape[::-1], (small_shape or turned.shape)[::-1])
    keypoints = ((small + 0.5) * zoom - 0.5).astype(np.float32)
    return LocalFeatures(keypoints, found.descriptors, found.scores, found.global_descriptor)


def tabulate(results: dict[str, dict[str, Any]]) -> str:
    """Lay out AUC@10 by angle."""
    rows = [
        [name, str(len(by_angle[0])), *(f"{area(errors, 10):.1f}" for errors in by_angle.values())]
        for found in results.values()
        for name, by_angle in found.items()
    ]
    return markdown(["", "pairs", *(f"{angle} deg" for angle in ANGLES_DEG)], rows)
