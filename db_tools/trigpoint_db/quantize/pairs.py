"""Pairs of images whose relation is known: warped by a homography, rendered, or surveyed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.frame import Frame
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import read_frame
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.synthetic import World, look_at, make_room, render, render_depth, survey_poses

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CAMERA = Camera("PINHOLE", 640, 480, (460.0, 460.0, 319.5, 239.5))
_ROOM_SEED = 0
_MAX_SHIFT = 0.18  # of a corner, as a share of the image's side
_MAX_TURN_DEG = 25.0
_MAX_ZOOM = 1.35
_CLEARANCE_M = 0.3
_MAX_AXES_DEG = 35.0  # between the views of a surveyed pair


@dataclass(frozen=True, eq=False)
class Warped:
    """An image and what a homography and other light have made of it."""

    first: Image
    second: Image
    second_from_first: Array  # (3, 3)


@dataclass(frozen=True, eq=False)
class View:
    """A picture whose camera's pose is known."""

    frame: Frame
    cam_from_world: Rigid3


def warp(image: Image, rng: np.random.Generator) -> Warped:
    """Draw a homography and a change of light, blur and noise, and apply them."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    center = np.array([width, height]) / 2
    angle = np.deg2rad(rng.uniform(-_MAX_TURN_DEG, _MAX_TURN_DEG))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    zoom = _MAX_ZOOM ** rng.uniform(-1, 1)
    shift = rng.uniform(-_MAX_SHIFT, _MAX_SHIFT, (4, 2)) * (width, height)
    moved = (corners - center) @ turn.T * zoom + center + shift
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))
    warped = cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_LINEAR)
    return Warped(image, _relight(np.asarray(warped, np.uint8), rng), np.asarray(H, np.float64))


def _relight(image: Image, rng: np.random.Generator) -> Image:
    level = (image / np.float32(255)) ** np.float32(1.6 ** rng.uniform(-1, 1))
    level = level * np.float32(255 * rng.uniform(0.7, 1.2)) + np.float32(rng.uniform(-15, 15))
    blurred = cv2.GaussianBlur(level, (0, 0), rng.uniform(0.3, 1.2))
    noise = rng.standard_normal(image.shape, dtype=np.float32) * np.float32(rng.uniform(0, 6))
    return np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)


def rendered_pairs(num_pairs: int, seed: int = 0) -> list[tuple[View, View]]:
    """Render a room from many places, each from three sides of what is seen: three pairs."""
    world, rng = make_room(_ROOM_SEED), np.random.default_rng(seed)
    num_places = -(-num_pairs // 3)
    places = survey_poses(world, num_places, seed)
    pairs = []
    for i in range(num_places):
        a, b, c = _render_place(world, places[i], rng)
        pairs += [(a, b), (a, c), (b, c)]
    return pairs[:num_pairs]


def _render_place(world: World, cam_from_world: Rigid3, rng: np.random.Generator) -> Iterator[View]:
    depth = render_depth(world, CAMERA, cam_from_world)
    distance = float(np.median(depth[np.isfinite(depth)]))
    target = cam_from_world.inverse().apply(np.array([0, 0, distance]))
    poses = [cam_from_world]
    while len(poses) < 3:
        center = cam_from_world.center + rng.uniform(-0.3, 0.3, 3) * distance
        if world.clearance(center[None])[0] > _CLEARANCE_M:
            poses.append(look_at(center, target + rng.uniform(-0.1, 0.1, 3) * distance))
    for pose in poses:
        image = render(world, CAMERA, pose, seed=int(rng.integers(2**31)))
        yield View(Frame(image, CAMERA), pose)


def survey_pairs(
    posed: Sequence[PosedImage], folder: Path, max_pairs: int, seed: int = 0
) -> list[tuple[View, View]]:
    """Draw pairs of surveyed images that look about the same way, not far from each other.

    Far is what more than three quarters of all pairs are.
    """
    cams = Rigid3.stack(image.cam_from_world for image in posed)
    centers, axes = cams.center, cams.R[:, 2]
    a, b = np.triu_indices(len(posed), 1)
    baseline = np.linalg.norm(centers[a] - centers[b], axis=1)
    turned = rotation_angle(cams.R[a] @ np.swapaxes(cams.R[b], -1, -2))
    alike = (axes[a] * axes[b]).sum(axis=1) > np.cos(np.deg2rad(_MAX_AXES_DEG))
    alike &= turned < np.deg2rad(2 * _MAX_AXES_DEG)
    near = (baseline > 0) & (baseline <= np.percentile(baseline, 25)) if len(a) else alike
    found = np.flatnonzero(alike & near)
    if not len(found):
        raise ConfigError(f"no two of the {len(posed)} posed images show the same: give more")
    drawn = np.sort(np.random.default_rng(seed).permutation(found)[:max_pairs])
    used = sorted({int(i) for k in drawn for i in (a[k], b[k])})
    views = {
        i: View(
            read_frame(folder, posed[i].name, posed[i].camera),
            posed[i].cam_from_world,
        )
        for i in used
    }
    return [(views[int(a[k])], views[int(b[k])]) for k in drawn]
