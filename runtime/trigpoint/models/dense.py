"""The dense layout: keypoints and descriptors from maps over the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

NMS_SIZE = 5  # px of the network's input
MIN_CURVATURE = np.float32(1e-3)  # logits / px^2
BORDER = 4  # px in which the network has seen too little to tell a keypoint


def select_keypoints(
    score: Array32, max_keypoints: int, min_score: float
) -> tuple[Array32, Array32]:
    """Pick the strongest local maxima of a score map and refine them to sub-pixel.

    Parameters
    ----------
    score : (H, W) float32
        Logits.
    max_keypoints : int
        How many at the most.
    min_score : float
        A keypoint's logit is above this.

    Returns
    -------
    points : (N, 2) float32
        x, y in px, refined by a parabola through the neighbours in each direction.
    scores : (N,) float32
        Falling.
    """
    peaks = (score > min_score) & (
        score >= cv2.dilate(score, np.ones((NMS_SIZE, NMS_SIZE), np.uint8))
    )
    peaks[:BORDER] = peaks[-BORDER:] = False
    peaks[:, :BORDER] = peaks[:, -BORDER:] = False
    # Flat: in two dimensions numpy takes ten times as long to find them.
    width, flat = score.shape[1], score.ravel()
    at = np.flatnonzero(peaks)
    values = flat[at]
    dx, curvature_x = _parabola(flat[at - 1], values, flat[at + 1])
    dy, curvature_y = _parabola(flat[at - width], values, flat[at + width])
    # A plateau, such as a blank image gives, is no keypoint.
    pointed = np.flatnonzero(np.minimum(curvature_x, curvature_y) > MIN_CURVATURE)
    best = pointed[np.argsort(-values[pointed], kind="stable")[:max_keypoints]]
    y, x = np.divmod(at[best], width)
    points = np.stack([x + dx[best], y + dy[best]], axis=1)
    return points.astype(np.float32), values[best]


def _parabola(before: Array32, at: Array32, after: Array32) -> tuple[Array32, Array32]:
    """Offset in [-0.5, 0.5] of the top of a parabola through three neighbours; its curvature."""
    curvature = 2 * at - before - after
    offset = 0.5 * (after - before) / np.maximum(curvature, MIN_CURVATURE)
    return np.clip(offset, -0.5, 0.5), curvature


def sample_bilinear(values: Array32, points: Array32) -> Array32:
    """Interpolate a map (D, rows, columns) at x, y (N, 2) in its pixels, clamped at the edge.

    Returns (N, D). The map stays as it lies: turning it is dearer than four values of each channel.
    """
    dim, rows, columns = values.shape
    x = np.clip(points[:, 0], 0, columns - 1)
    y = np.clip(points[:, 1], 0, rows - 1)
    x0, y0 = x.astype(np.intp), y.astype(np.intp)
    x1, y1 = np.minimum(x0 + 1, columns - 1), np.minimum(y0 + 1, rows - 1)
    fx, fy = (x - x0).astype(np.float32), (y - y0).astype(np.float32)
    corners = np.stack([y0, y0, y1, y1]) * columns + np.stack([x0, x1, x0, x1])
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    mixed: Array32 = np.einsum(
        "dkn,kn->nd", np.take(values.reshape(dim, -1), corners, axis=1, mode="clip"), weights
    )
    return mixed
