"""Training pairs: two spoilt views of one place, and what the teachers say of the same points.

Flat pictures are seen twice through homographies. Rendered places are seen from two sides, with
real parallax and occlusion, and each side through a homography besides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from training import scenes
from training.camera_effects import spoil
from training.corpus import Picture, load_corpus

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SIZE = 256  # px of the network's input in training
NUM_POINTS = 400  # a pair
BORDER = 4
KEYPOINT_SIGMA_PX = 0.8
MAX_KEYPOINTS = 400  # a view
RENDERED_SHARE = 0.4
MAX_DEPTH_ERROR = 0.02  # a point seen at another depth than its own is hidden


@dataclass(frozen=True, eq=False)
class Batch:
    """B pairs as tensors; view 0 of all pairs, then view 1.

    images : (2B, 1, S, S) uint8
    heat : (2B, 1, S, S) uint8
        255 a exp(-d^2 / 2 sigma^2) to the teachers' keypoints, a falling with their rank.
    points : (2, B, N, 2) float32
        x, y of the same scene points in both views.
    taught : (B, N, 192) float32
        The teachers' descriptor of them, unit length.
    valid : (B, N) bool
    """

    images: Tensor
    heat: Tensor
    points: Tensor
    taught: Tensor
    valid: Tensor

    def to(self, device: torch.device) -> Batch:
        """Move to a device."""
        return Batch(*(tensor.to(device, non_blocking=True) for tensor in vars(self).values()))


class Pairs(torch.utils.data.Dataset[Batch]):
    """Batch number `step` is a function of the seed and the step alone."""

    def __init__(self, corpus: Path, batch_size: int, seed: int) -> None:
        self.corpus, self.batch_size, self.seed = corpus, batch_size, seed

    @cached_property
    def _pictures(self) -> tuple[list[Picture], list[list[Picture]]]:
        """The corpus, read by the process that makes batches."""
        return load_corpus(self.corpus)

    def __getitem__(self, step: int) -> Batch:
        """Make one batch."""
        rng = np.random.default_rng((self.seed, step))
        sides: tuple[list[Image], list[Image]] = ([], [])
        heats: tuple[list[Image], list[Image]] = ([], [])
        count = self.batch_size
        points = np.zeros((2, count, NUM_POINTS, 2), np.float32)
        taught = np.zeros((count, NUM_POINTS, 192), np.float32)
        valid = np.zeros((count, NUM_POINTS), bool)
        for b in range(count):
            pictures, places = self._draw(rng)
            warps = _view_warps(pictures, rng)
            seen = [_apply(warp, place) for warp, place in zip(warps, places, strict=True)]
            inside = np.all([_inside(xy) for xy in seen], axis=0)
            chosen = rng.permutation(np.flatnonzero(inside))[:NUM_POINTS]
            n = len(chosen)
            valid[b, :n] = True
            for side, (picture, warp, xy) in enumerate(zip(pictures, warps, seen, strict=True)):
                points[side, b, :n] = xy[chosen]
                taught[b, :n] += picture.teach(places[side][chosen])
                sides[side].append(spoil(_warp_image(picture.image, warp), rng))
                heats[side].append(_heat(_apply(warp, picture.keypoints)))
        norm = np.linalg.norm(taught, axis=2, keepdims=True)
        return Batch(
            torch.from_numpy(np.stack(sides[0] + sides[1])[:, None]),
            torch.from_numpy(np.stack(heats[0] + heats[1])[:, None]),
            torch.from_numpy(points),
            torch.from_numpy(taught / np.maximum(norm, 1e-6)),
            torch.from_numpy(valid),
        )

    def _draw(self, rng: Generator) -> tuple[list[Picture], list[Array]]:
        """Draw two pictures and the same scene points (M, 2) in each."""
        flat, places = self._pictures
        if rng.random() >= RENDERED_SHARE:
            picture = flat[rng.integers(len(flat))]
            xy = _scatter(picture, rng)
            return [picture, picture], [xy, xy]
        views = places[rng.integers(len(places))]
        first, second = (views[i] for i in rng.permutation(len(views))[:2])
        xy = _scatter(first, rng)
        there, visible = transfer(first, second, xy)
        return [first, second], [xy[visible], there[visible]]


def transfer(first: Picture, second: Picture, xy: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where points (N, 2) of one rendered picture are in another, and whether they are seen."""
    for rendered in (first, second):
        assert rendered.depth is not None
        assert rendered.cam_from_world is not None
    column, row = np.rint(xy).astype(np.intp).T
    depth = first.depth[row, column].astype(np.float64)
    # The depth is that of the pixel's centre: where it changes fast, the point is not known.
    known = np.isfinite(depth)
    rays = np.c_[scenes.CAMERA.normalize(xy), np.ones(len(xy))]
    world = first.cam_from_world.inverse().apply(rays * np.where(known, depth, 1.0)[:, None])
    local = second.cam_from_world.apply(world)
    z = np.maximum(local[:, 2], 1e-3)
    fx, fy, cx, cy = scenes.CAMERA.params
    there = local[:, :2] / z[:, None] * (fx, fy) + (cx, cy)
    height, width = second.depth.shape
    inside = (there > 0).all(axis=1) & (there < (width - 1, height - 1)).all(axis=1)
    column, row = np.clip(np.rint(there), 0, (width - 1, height - 1)).astype(np.intp).T
    hit = np.abs(second.depth[row, column] / z - 1) < MAX_DEPTH_ERROR
    return there, known & inside & hit & (local[:, 2] > 0.1)


def _scatter(picture: Picture, rng: Generator) -> Array:
    """Keypoints, a little beside their places, and points anywhere."""
    height, width = picture.image.shape
    near = picture.keypoints + rng.uniform(-0.7, 0.7, picture.keypoints.shape)
    anywhere = rng.uniform((4, 4), (width - 5, height - 5), (len(near) // 2 + 600, 2))
    return np.clip(np.concatenate([near, anywhere]), 4, (width - 5, height - 5))


def _view_warps(pictures: list[Picture], rng: Generator) -> tuple[Array, Array]:
    """Homographies from each picture to its view of SIZE x SIZE."""
    flat = pictures[0] is pictures[1]
    height, width = pictures[0].image.shape
    zoom = np.exp(rng.uniform(np.log(0.5), np.log(1.35)))
    turn = rng.normal(0, 0.2)
    middle = _middle(width, height, zoom, rng)
    base = _tilt(0.05, rng) @ _similarity(middle, turn, zoom, rng, 0.0)
    # A drone banks: in one pair of three the second view is turned by up to 60 degrees.
    turn += rng.uniform(-1.05, 1.05) if rng.random() < 0.33 else rng.uniform(-0.5, 0.5)
    zoom *= np.exp(rng.uniform(-0.45, 0.45))
    if flat:
        return base, _tilt(0.15, rng) @ _similarity(middle, turn, zoom, rng, 0.15)
    # The second camera looks at the same target, so the picture's middle is the common part.
    return base, _tilt(0.08, rng) @ _similarity(
        _middle(width, height, zoom, rng, 0.3), turn, zoom, rng, 0.05
    )


def _middle(
    width: int, height: int, zoom: float, rng: Generator, freedom: float = 1.0
) -> tuple[float, float]:
    """Choose a place whose surroundings fill the view, where the picture is large enough."""
    slack = [max(0.0, side / 2 - SIZE / 2 / zoom) * freedom for side in (width, height)]
    return (
        width / 2 + rng.uniform(-slack[0], slack[0]),
        height / 2 + rng.uniform(-slack[1], slack[1]),
    )


def _similarity(
    middle: tuple[float, float], turn: float, zoom: float, rng: Generator, shift: float
) -> Array:
    c, s = np.cos(turn) * zoom, np.sin(turn) * zoom
    tx, ty = SIZE / 2 + rng.uniform(-shift, shift, 2) * SIZE
    x, y = middle
    return np.array([[c, -s, tx - c * x + s * y], [s, c, ty - s * x - c * y], [0, 0, 1]])


def _tilt(amount: float, rng: Generator) -> Array:
    corners = np.array([[0, 0], [SIZE, 0], [SIZE, SIZE], [0, SIZE]], np.float32)
    moved = corners + rng.uniform(-amount, amount, (4, 2)).astype(np.float32) * SIZE
    return cv2.getPerspectiveTransform(corners, moved).astype(np.float64)


def _apply(warp: Array, points: NDArray[np.floating]) -> Array:
    """Move points (N, 2); those behind the horizon go to nan."""
    moved = np.c_[points, np.ones(len(points))] @ warp.T
    w = np.where(moved[:, 2] > 1e-6, moved[:, 2], np.nan)
    return np.asarray(moved[:, :2] / w[:, None], np.float64)


def _inside(xy: Array) -> NDArray[np.bool_]:
    return (xy > BORDER).all(axis=1) & (xy < SIZE - 1 - BORDER).all(axis=1)


def _warp_image(image: Image, warp: Array) -> Image:
    """Warp to the view; a smaller view is smoothed first, against aliasing."""
    x, y, w = warp @ (image.shape[1] / 2, image.shape[0] / 2, 1.0)
    zoom = np.sqrt(abs(np.linalg.det(warp[:2, :2] - np.outer((x / w, y / w), warp[2, :2])))) / w
    if zoom < 0.8:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.45 / max(zoom, 0.1)), np.uint8)
    gray = float(image[::16, ::16].mean())  # beside the picture; edges there are no keypoints
    warped = cv2.warpPerspective(
        image, warp, (SIZE, SIZE), flags=cv2.INTER_LINEAR, borderValue=(gray,)
    )
    return np.asarray(warped, np.uint8)


def _heat(keypoints: Array) -> Image:
    """Draw a blob at each keypoint's sub-pixel place, the best (first) ones brightest."""
    heat = np.zeros(SIZE * SIZE, np.float32)
    xy = keypoints[_inside(keypoints)][:MAX_KEYPOINTS]
    offsets = np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), axis=-1).reshape(-1, 2)
    pixels = np.rint(xy).astype(np.intp)[:, None] + offsets
    squared = np.square(pixels - xy[:, None]).sum(axis=2)
    blob = np.exp(-0.5 * squared / KEYPOINT_SIGMA_PX**2).astype(np.float32)
    blob *= np.linspace(1.0, 0.6, len(xy), dtype=np.float32)[:, None]
    np.maximum.at(heat, (pixels[..., 1] * SIZE + pixels[..., 0]).ravel(), blob.ravel())
    return (heat.reshape(SIZE, SIZE) * 255).round().astype(np.uint8)
