"""Relative poses of wide-baseline pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from benchmarks.models.methods import BASELINE, Features, Method
from benchmarks.models.scores import (
    area,
    gains,
    markdown,
    standard_error,
    standard_error_of_ratio,
)
from benchmarks.models.surveys import Survey
from trigpoint.geometry.backend import NORMALIZED_CAMERA
from trigpoint.rigid import rotation_angle

Array = NDArray[np.float64]

SETS = ("fox", "tnt_truck", "7scenes_redkitchen")
THRESHOLDS_DEG = (5, 10, 20)
NUM_SEEDS = 5  # RANSAC is run so often: its own noise is a point of AUC
MAX_ERROR_PX = 1.5
MIN_MATCHES = 8
FAILED_DEG = 180.0

CAPTION = f"""Pairs with a parallax of 15 to 50 degrees and an overlap above 0.3, from the poses
and median depths; images of 640 px, 1024 keypoints, mutual nearest neighbours (for RootSIFT also a
ratio below 0.8), PoseLib. AUC of the larger of the errors of rotation and of the translation's
direction, mean of {NUM_SEEDS} seeds of RANSAC; +- is the standard error over pairs, of the ratio
by a paired bootstrap. {FAILED_DEG:.0f} degrees where there are fewer than {MIN_MATCHES} matches."""

Pairs = dict[str, list[tuple[int, int]]]


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched points (M, 2) in px of two images of a survey, best first."""

    a: Array
    b: Array


def match(method: Method, survey: Survey, features: Features, pair: tuple[int, int]) -> Matches:
    """Match two images as they are."""
    a, b = (features.of(survey, index) for index in pair)
    matches = method.match(a, b)
    return Matches(a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]])


def pose_errors(survey: Survey, pair: tuple[int, int], matches: Matches) -> list[float]:
    """Errors of the relative pose in degrees, one for each seed of RANSAC.

    The larger of the angles between the rotations and between the translations' directions, the
    latter without their sign.
    """
    i, j = pair
    a, b = survey.normalize(i, matches.a), survey.normalize(j, matches.b)
    valid = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if valid.sum() < MIN_MATCHES:
        return [FAILED_DEG] * NUM_SEEDS
    truth = survey.cam_from_world[j] @ survey.cam_from_world[i].inverse()
    direction = truth.t / np.linalg.norm(truth.t)
    errors = []
    for seed in range(NUM_SEEDS):
        options = {
            "max_epipolar_error": MAX_ERROR_PX / survey.focal_px(i),
            "max_iterations": 3000,
            "seed": seed,
        }
        pose, _ = poselib.estimate_relative_pose(
            a[valid], b[valid], NORMALIZED_CAMERA, NORMALIZED_CAMERA, options, {}
        )
        rotation = np.rad2deg(rotation_angle(truth.R.T @ pose.R))
        cosine = abs(direction @ pose.t) / max(np.linalg.norm(pose.t), 1e-12)
        translation = np.rad2deg(np.arccos(np.clip(cosine, 0, 1)))
        errors.append(round(float(max(rotation, translation)), 4))
    return errors


def measure(features: Features, surveys: Sequence[Survey], pairs: Pairs) -> dict[str, Any]:
    """Pose errors of all pairs of every set: lists (pairs, seeds)."""
    return {
        survey.name: [
            pose_errors(survey, pair, match(features.method, survey, features, pair))
            for pair in pairs[survey.name]
        ]
        for survey in surveys
        if survey.name in SETS and pairs[survey.name]
    }


def tabulate(results: dict[str, dict[str, Any]]) -> str:
    """Lay out AUC with standard errors, and against the baseline, by set and over all sets."""
    sets = list(next(iter(results.values())))
    everything = {
        name: {**found, "all": [errors for pairs in found.values() for errors in pairs]}
        for name, found in results.items()
    }
    rows = []
    for name in [*sets, "all"]:
        baseline = everything.get(BASELINE, {}).get(name)
        for method, found in everything.items():
            errors = np.array(found[name])
            steady = gains(errors, 10).mean(axis=1)
            row = [name, method, str(len(errors))]
            row += [f"{area(errors, t):.1f}" for t in THRESHOLDS_DEG]
            row += [f"{standard_error(steady):.1f}"]
            if baseline is None:
                row += ["-", "-"]
            else:
                other = gains(np.array(baseline), 10).mean(axis=1)
                row.append(f"{steady.mean() / other.mean():.3f}")
                row.append(f"{standard_error_of_ratio(steady, other):.3f}")
            rows.append(row)
    header = ["set", "", "pairs", "AUC@5", "AUC@10", "AUC@20", "+-@10", "@10 / E64's", "+-"]
    return markdown(header, rows, num_words=2)
