"""Photographs warped by known homographies: how exact keypoints are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.models.methods import NUM_KEYPOINTS, Features
from benchmarks.models.scores import area
from benchmarks.models.surveys import LONG_SIDE_PX, shrink
from training.scenes import MIN_SIDE_PX, photograph_paths
from trigpoint.images import read_gray
from trigpoint_db.experiments.tables import markdown

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

WARPS = 3  # of each photograph
THRESHOLDS_PX = (1, 3, 5)
CORRECT_PX = 3.0
MIN_MATCHES = 9
FAILED_PX = 99.0

CAPTION = f"""Held-out photographs of at most {LONG_SIDE_PX} px, {WARPS} random homographies of
each: corners moved by up to 16 %, rotation up to 20 degrees, scale up to e^0.3, another exposure,
noise. AUC of the mean error of the corners, in px, by OpenCV's MAGSAC; the median localisation
error of correct matches ({CORRECT_PX:g} px); the matching score is their number over that of
shared keypoints."""


def warped_photographs(
    folder: Path, long_side_px: int = LONG_SIDE_PX
) -> Iterator[tuple[Image, Image, Array]]:
    """Yield held-out photographs, warped ones, and the homographies that lead there."""
    rng = np.random.default_rng(0)
    for path in photograph_paths(folder, held_out=True):
        photograph = read_gray(path)
        if min(photograph.shape) < MIN_SIDE_PX:
            continue
        image = shrink(photograph, long_side_px)
        for _ in range(WARPS):
            homography = _random_homography(image.shape[1], image.shape[0], rng)
            yield image, _photograph_again(image, homography, rng), homography


def _corners(width: int, height: int) -> Array:
    return np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)


def _random_homography(width: int, height: int, rng: Generator) -> Array:
    """Move every corner by up to 16 %, turn by up to 20 degrees, scale by up to e^0.3."""
    before = _corners(width, height)
    after = before + rng.uniform(-0.16, 0.16, (4, 2)) * (width, height)
    angle, scale = np.deg2rad(rng.uniform(-20, 20)), np.exp(rng.uniform(-0.3, 0.3))
    c, s = np.cos(angle), np.sin(angle)
    centre = before.mean(axis=0)
    after = (after - centre) @ np.array([[c, s], [-s, c]]) * scale + centre
    return cv2.getPerspectiveTransform(before.astype(np.float32), after.astype(np.float32))


def _photograph_again(image: Image, homography: Array, rng: Generator) -> Image:
    """Warp, change the exposure's curve, add noise."""
    warped = cv2.warpPerspective(image, homography, image.shape[::-1], flags=cv2.INTER_LINEAR)
    bent = (warped / 255.0) ** np.exp(rng.uniform(-0.4, 0.4)) * 255
    return np.clip(bent + rng.normal(0, 4, bent.shape), 0, 255).astype(np.uint8)


def measure(features: Features, photographs: Path) -> dict[str, list[float]]:
    """Measure corner error (px), localisation error (px) and matching score of every case."""
    cases = [_measure_case(features, *case) for case in warped_photographs(photographs)]
    corner_px, localisation_px, score = zip(*cases, strict=True)
    return {"corner_px": corner_px, "localisation_px": localisation_px, "score": score}


def _measure_case(
    features: Features, image: Image, warped: Image, truth: Array
) -> tuple[float, float | None, float]:
    a = features.extractor.extract(image, NUM_KEYPOINTS)
    b = features.extractor.extract(warped, NUM_KEYPOINTS)
    matches = features.method.match(a, b)
    expected = _transform(a.keypoints, truth)
    size = np.array(warped.shape[::-1])
    num_shared = int(((expected >= 0) & (expected <= size - 1)).all(axis=1).sum())
    errors = np.linalg.norm(expected[matches[:, 0]] - b.keypoints[matches[:, 1]], axis=1)
    correct = errors[errors < CORRECT_PX]
    localisation = float(np.median(correct)) if len(correct) else None
    corner = _corner_error(
        a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]], truth, _corners(*size)
    )
    return corner, localisation, len(correct) / max(num_shared, 1)


def _corner_error(a: Array, b: Array, truth: Array, corners: Array) -> float:
    """Mean distance in px of the corners under the estimated and the true homography."""
    if len(a) < MIN_MATCHES:
        return FAILED_PX
    estimate, _ = cv2.findHomography(a, b, cv2.USAC_MAGSAC, 2.0, maxIters=5000, confidence=0.9999)
    if estimate is None:
        return FAILED_PX
    difference = _transform(corners, estimate) - _transform(corners, truth)
    return float(np.linalg.norm(difference, axis=1).mean())


def _transform(points: NDArray[np.floating], homography: Array) -> Array:
    moved = cv2.perspectiveTransform(points.astype(np.float64)[None], homography)
    return np.asarray(moved, np.float64)[0]


def tabulate(results: dict[str, dict[str, Any]]) -> str:
    """Lay out AUC of the corners' errors and medians of the rest."""
    rows = []
    for name, found in results.items():
        localisation = [value for value in found["localisation_px"] if value is not None]
        rows.append(
            [
                name,
                str(len(found["corner_px"])),
                *(f"{area(found['corner_px'], t):.1f}" for t in THRESHOLDS_PX),
                f"{np.median(localisation):.2f}",
                f"{np.mean(found['score']):.2f}",
            ]
        )
    header = ["", "cases", *(f"AUC@{t}" for t in THRESHOLDS_PX)]
    return markdown([*header, "localisation (px)", "matching score"], rows)
