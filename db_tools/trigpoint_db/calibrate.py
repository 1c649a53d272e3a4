"""Measure how well the poses of a map agree with each other, by localizing its own images.

Some images, spread over the map, are localized against the others; once against all of them, and
again without those that were taken just before and after, so that the nearest anchor is as far away
as it is for a frame between two surveys. Of the noises on a grid, the one under which the errors
are likeliest is the map's.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import PoseNoise
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.stages import mean_distance
from trigpoint_db.leave_one_out import localize_without
from trigpoint_db.sampling import spread_indices

Array = NDArray[np.float64]

NUM_IMAGES = 32
GAPS = (0, 8, 24)  # images left out on either side
MIN_TRIALS = 10
# Grids of standard deviations: to 13 % of the anchors' distance, and 1.5 degrees.
POSITION = np.append(0.0, 0.0005 * 2.0 ** np.arange(9))
ROTATION_RAD = np.append(0.0, 0.0001 * 2.0 ** np.arange(9))
# What the map says of its noise so far refuses no pose.
OPTIONS = LocalizerOptions(generator="latent_points", max_position_std_ratio=1e5)
STUDENT_DOF = 4.0  # errors have long tails: those of wrong poses must not set the noise


@dataclass(frozen=True, eq=False)
class Trial:
    """One image of the map, localized against others."""

    error: Array  # (6,): (dc, dtheta), as of `Localized`
    covariance: Array  # (6, 6): without the map's noise
    distance: float  # of the anchors, in the mean


def calibrate_map(
    path: Path, model: FeatureModel, track: Callable[[list[int]], Iterable[int]] = iter
) -> PoseNoise | None:
    """Measure the noise of a map's poses and write it into the map; `track` shows progress."""
    with MapReader.open(path, model.identity) as reader:
        images = spread_indices(len(reader), NUM_IMAGES)
        noise = measure_pose_noise(Localizer(model, reader, OPTIONS), track(images))
    with MapWriter.open(path, model.identity) as writer:
        writer.set_pose_noise(noise)
    return noise


def measure_pose_noise(localizer: Localizer, images: Iterable[int]) -> PoseNoise | None:
    """Measure the noise of a map's poses; None where too few images could be localized."""
    trials = [
        trial
        for index in images
        for gap in GAPS
        if (trial := _try_image(localizer, index, gap)) is not None
    ]
    if len(trials) < MIN_TRIALS:
        return None
    errors = np.array([trial.error for trial in trials])
    covariances = np.array([trial.covariance for trial in trials])
    distances = np.array([trial.distance for trial in trials])
    parts = slice(0, 3), slice(3, 6)
    middle = float(np.median(distances))
    position, rotation = (
        _fit(errors[:, part], covariances[:, part, part], distances / middle, levels)
        for part, levels in zip(parts, (middle * POSITION, ROTATION_RAD), strict=True)
    )
    return PoseNoise(position[0], position[1] / middle, rotation[0], rotation[1] / middle)


def describe_noise(noise: PoseNoise | None) -> str:
    """Say for people how well the poses of a map agree."""
    if noise is None:
        return (
            "how well its poses agree is not known: too few of its images could be localized, or "
            "`trigpoint-db calibrate` has not been run since they came together"
        )
    if not any(astuple(noise)):
        return "its poses agree as well as can be measured"
    return (
        f"its poses agree to {noise.position:.2g} and {noise.position_drift * 100:.2g} % of their "
        f"distance, {np.rad2deg(noise.rotation_rad):.2g} degrees and "
        f"{np.rad2deg(noise.rotation_drift_rad):.2g} for each unit of it"
    )


def _fit(errors: Array, covariances: Array, distances: Array, levels: Array) -> tuple[float, float]:
    """Return the standard deviation at no distance, and what a unit of distance adds."""
    return min(
        itertools.product(levels.tolist(), levels.tolist()),
        key=lambda std: _surprise(errors, covariances, np.hypot(std[0], std[1] * distances)),
    )


def _try_image(localizer: Localizer, index: int, gap: int) -> Trial | None:
    near = range(max(0, index - gap), min(len(localizer.reader), index + gap + 1))
    held_out = localize_without(localizer, index, near)
    if held_out is None:
        return None
    solution = held_out.solution
    if solution.refined is None or solution.seen is None:
        return None
    truth, pose = held_out.truth, solution.refined.cam_from_world
    dtheta = Rotation.from_matrix(truth.R.T @ pose.R).as_rotvec()
    error = np.concatenate([truth.center - pose.center, dtheta])
    distance = mean_distance(held_out.query, solution.seen, pose)
    return Trial(error, solution.refined.covariance, distance)


def _surprise(errors: Array, covariances: Array, std: Array) -> float:
    """Negative log-likelihood of errors (T, 3), Student's t, with more noise std (T,) an axis."""
    C = covariances + std[:, None, None] ** 2 * np.eye(3)
    squares = np.einsum("ti,tij,tj->t", errors, np.linalg.inv(C), errors)
    spread = np.linalg.slogdet(C)[1] / 2
    return float((spread + (STUDENT_DOF + 3) / 2 * np.log1p(squares / STUDENT_DOF)).mean())
