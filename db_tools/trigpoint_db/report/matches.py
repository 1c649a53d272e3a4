"""An image beside one of its anchors, with the keypoints that they share."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import SourceError
from trigpoint.frame import Anchor, LocalFeatures
from trigpoint.localizer import Solution
from trigpoint.stages import Query
from trigpoint_db.build import read_frame
from trigpoint_db.overlap import verify_pair
from trigpoint_db.report.page import Picture

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

HEIGHT_PX = 420  # of what is drawn
GAP_PX = 8
JPEG_QUALITY = 78
MAX_DRAWN = 150  # matches: with more, no line can be told from the others
NUM_ANCHORS = 2  # drawn for each image


@dataclass(frozen=True, eq=False)
class Case:
    """An image that was localized, or not, and what with.

    `image` has its camera and keypoints; `folder` and `anchor_folder` hold the image files.
    """

    title: str
    image: Anchor
    features: LocalFeatures
    folder: Path
    anchors: list[Anchor]
    anchor_folder: Path
    query: Query
    solution: Solution


def draw_case(case: Case, long_side_px: int) -> list[Picture]:
    """Draw the anchors that share the most with an image: what agrees with the pose is joined.

    Where no pose was given, it is what agrees with one relative pose of the two.
    """
    if case.solution.refined is None:
        shared = [_verified(case, anchor, long_side_px) for anchor in case.anchors]
        what = "matches agree with a relative pose of the two; that makes no pose yet"
    else:
        shared = [_inliers(case, k) for k in range(len(case.anchors))]
        what = "of the points that agree with the pose are seen in both"
    best = sorted(range(len(shared)), key=lambda k: -len(shared[k][0]))[:NUM_ANCHORS]
    left = read_frame(case.folder, case.image.name, case.image.camera).image
    pictures = []
    for k in best:
        anchor, (points, others) = case.anchors[k], shared[k]
        right = read_frame(case.anchor_folder, anchor.name, anchor.camera).image
        text = f"{case.title}: {case.image.name} and its anchor {anchor.name}: {len(points)} {what}"
        jpeg = draw_pair(left, right, points, others)
        pictures.append(Picture(base64.b64encode(jpeg).decode(), text))
    return pictures


def _verified(case: Case, anchor: Anchor, long_side_px: int) -> tuple[Array, Array]:
    matches = verify_pair(case.features, case.image, anchor, long_side_px).matches
    points, others = case.image.keypoints[matches[:, 0]], anchor.keypoints[matches[:, 1]]
    return points.astype(np.float64), others.astype(np.float64)


def _inliers(case: Case, k: int) -> tuple[Array, Array]:
    """Return pixels (M, 2) of the pose's inliers that anchor k sees, in the image and in it."""
    refined, latent = case.solution.refined, case.solution.seen
    assert refined is not None
    assert latent is not None
    tracks = latent.tracks
    chosen = np.repeat(refined.inliers, tracks.lengths) & (tracks.view == k)
    points = case.image.keypoints[tracks.point[chosen]].astype(np.float64)
    rays = np.column_stack([tracks.xy[chosen], np.ones(chosen.sum())])
    return points, case.anchors[k].camera.project(rays)


def draw_pair(left: Image, right: Image, points: Array, others: Array) -> bytes:
    """Return a JPEG of two gray images side by side, with matches (M, 2) px joined by lines."""
    sides = [_scaled(image) for image in (left, right)]
    widths = [side.shape[1] for side in sides]
    gap = np.full((HEIGHT_PX, GAP_PX), 128, np.uint8)
    canvas = cv2.cvtColor(np.hstack([sides[0], gap, sides[1]]), cv2.COLOR_GRAY2BGR)
    lines = canvas.copy()
    step = max(1, -(-len(points) // MAX_DRAWN))
    pairs = zip(points[::step], others[::step], strict=True)
    hues = np.linspace(30, 225, len(points[::step])).astype(np.uint8)  # bright ones
    colors = cv2.applyColorMap(hues, cv2.COLORMAP_TURBO).reshape(-1, 3).tolist()
    shift = (widths[0] + GAP_PX, 0)
    for (point, other), color in zip(pairs, colors, strict=True):
        a = _place(point, HEIGHT_PX / left.shape[0])
        b = _place(other, HEIGHT_PX / right.shape[0], shift)
        cv2.line(lines, a, b, color, 1, cv2.LINE_AA)
        for end in (a, b):
            cv2.circle(canvas, end, 3, color, -1, cv2.LINE_AA)
    blended = cv2.addWeighted(lines, 0.45, canvas, 0.55, 0)
    encoded, data = cv2.imencode(".jpg", blended, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise SourceError("a picture of matches cannot be encoded")
    return data.tobytes()


def _scaled(image: Image) -> Image:
    width = max(1, round(image.shape[1] * HEIGHT_PX / image.shape[0]))
    size = (width, HEIGHT_PX)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _place(point: Array, zoom: float, shift: tuple[int, int] = (0, 0)) -> tuple[int, int]:
    x, y = np.round((point + 0.5) * zoom - 0.5).astype(int)
    return int(x) + shift[0], int(y) + shift[1]
