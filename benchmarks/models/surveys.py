"""Posed images of a place, and which of them see the same things.

Nobody has told which images overlap, and no network may be asked. So a median depth is triangulated
for each image from SIFT matches with its neighbours, under the known poses; a grid of the image's
pixels is put at that depth, and what share of it falls into another image, and under which
parallax, follows from the poses.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.models.rootsift import RootSift
from trigpoint.camera import Camera
from trigpoint.geometry.epipolar import essential_matrix, homogeneous
from trigpoint.images import read_gray
from trigpoint.models.matching import match_mutual
from trigpoint.rigid import Rigid3, rotate
from trigpoint_db.importers.colmap import read_model

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

LONG_SIDE_PX = 640
NUM_KEYPOINTS = 1500
NUM_NEIGHBOURS = 6
MAX_NEIGHBOUR_ANGLE_DEG = 25.0  # between optical axes
MIN_SIMILARITY = 0.8
MAX_EPIPOLAR_ERROR = 0.003  # of normalised coordinates: 1.5 px or so
MIN_RAY_ANGLE_DEG = 1.0
MIN_POINTS = 10  # for a median depth of an image's own
GRID = (12, 16)
MIN_OVERLAP = 0.3
PARALLAX_DEG = (15.0, 50.0)


def shrink(image: Image, long_side_px: int = LONG_SIDE_PX) -> Image:
    """Scale an image down to a long side; a smaller one is left alone."""
    zoom = long_side_px / max(image.shape)
    if zoom >= 1:
        return image
    smaller = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, np.uint8)


@dataclass(frozen=True, eq=False)
class Survey:
    """Images, scaled to LONG_SIDE_PX, the cameras of the originals, and the poses."""

    name: str
    names: tuple[str, ...]
    images: tuple[Image, ...]
    cameras: tuple[Camera, ...]
    cam_from_world: Rigid3

    def __len__(self) -> int:
        return len(self.names)

    def normalize(self, index: int, points: NDArray[np.floating]) -> Array:
        """Turn px (N, 2) of a scaled image into normalised coordinates (N, 2)."""
        camera = self.cameras[index]
        zoom = np.divide((camera.width, camera.height), self.images[index].shape[::-1])
        return camera.normalize((points + 0.5) * zoom - 0.5)

    def focal_px(self, index: int) -> float:
        """Return the focal length of a scaled image."""
        camera = self.cameras[index]
        return camera.focal_px * self.images[index].shape[1] / camera.width


@functools.cache
def load_survey(folder: Path) -> Survey:
    """Read `images/` and `sparse/` of a folder, once in a process."""
    model = read_model(folder / "sparse")
    return Survey(
        folder.name,
        tuple(image.name for image in model),
        tuple(shrink(read_gray(folder / "images" / image.name)) for image in model),
        tuple(image.camera for image in model),
        Rigid3.stack(image.cam_from_world for image in model),
    )


@dataclass(frozen=True, eq=False)
class Visibility:
    """What images see of one another.

    Parameters
    ----------
    overlap : (N, N) float64
        Share of image i's view that lies in image j's.
    parallax_deg : (N, N) float64
        Median angle at which the two see what they share; 0 where that is nothing.
    """

    overlap: Array
    parallax_deg: Array

    def overlapping(self) -> NDArray[np.bool_]:
        """Who sees the same things from about the same side, (N, N): in both directions.

        The parallax has a limit, for what is before the cameras may hide its other side.
        """
        least = np.minimum(self.overlap, self.overlap.T)
        most_parallax = np.maximum(self.parallax_deg, self.parallax_deg.T)
        return (least > MIN_OVERLAP) & (most_parallax <= PARALLAX_DEG[1])

    def wide_pairs(self, count: int) -> list[tuple[int, int]]:
        """Draw pairs with overlap and a wide baseline, the same ones in every run."""
        least_parallax = np.minimum(self.parallax_deg, self.parallax_deg.T)
        wide = self.overlapping() & (least_parallax >= PARALLAX_DEG[0])
        candidates = np.argwhere(np.triu(wide, 1))
        rng = np.random.default_rng(0)
        drawn = rng.choice(len(candidates), min(count, len(candidates)), replace=False)
        return [(int(i), int(j)) for i, j in candidates[np.sort(drawn)]]


def measure_visibility(folder: Path) -> Visibility:
    """Find what the images of a survey see of one another."""
    survey = load_survey(folder)
    depths = median_depths(survey)
    rows = [_look(survey, i, depths[i]) for i in range(len(survey))]
    return Visibility(*(np.array(values) for values in zip(*rows, strict=True)))


def median_depths(survey: Survey) -> Array:
    """Median depth (N,) of what each image sees; the survey's median where too little is known."""
    extract = RootSift().extract
    points, descriptors = [], []
    for i, image in enumerate(survey.images):
        features = extract(image, NUM_KEYPOINTS)
        points.append(survey.normalize(i, features.keypoints))
        descriptors.append(features.descriptors)
    poses = survey.cam_from_world
    baselines = np.linalg.norm(poses.center[:, None] - poses.center, axis=-1)
    axes = poses.R[:, 2]
    angles = np.rad2deg(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    medians = np.full(len(survey), np.nan)
    for i in range(len(survey)):
        near = [j for j in np.argsort(baselines[i]) if j != i]
        near = [j for j in near if angles[i, j] < MAX_NEIGHBOUR_ANGLE_DEG][:NUM_NEIGHBOURS]
        found = [np.empty(0)]
        for j in near:
            matches, similarities = match_mutual(descriptors[i], descriptors[j])
            a, b = matches[similarities > MIN_SIMILARITY].T
            found.append(_depths(points[i][a], points[j][b], poses[j] @ poses[i].inverse()))
        depths = np.concatenate(found)
        if len(depths) > MIN_POINTS:
            medians[i] = np.median(depths)
    return np.where(np.isnan(medians), np.nanmedian(medians), medians)


def _depths(points_a: Array, points_b: Array, b_from_a: Rigid3) -> Array:
    """Depths in view a of the matches that agree with the pose."""
    a, b = homogeneous(points_a), homogeneous(points_b)
    lines = a @ essential_matrix(b_from_a).T
    errors = np.abs((lines * b).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    rays = rotate(b_from_a.R, a)
    # depth_b b = depth_a R a + t, in the least squares sense
    A = np.stack([rays, -b], axis=-1)
    normal = np.swapaxes(A, 1, 2)
    depths = np.linalg.solve(normal @ A, -(normal @ b_from_a.t)[..., None])[..., 0]
    good = (errors < MAX_EPIPOLAR_ERROR) & (depths > 0).all(axis=1)
    return depths[good & (_angles_deg(rays, b) > MIN_RAY_ANGLE_DEG), 0]


def _look(survey: Survey, i: int, depth: float) -> tuple[Array, Array]:
    """Overlap and parallax (N,) of image i with every image."""
    poses = survey.cam_from_world
    height, width = survey.images[i].shape
    v, u = np.meshgrid(
        np.linspace(0, height - 1, GRID[0]), np.linspace(0, width - 1, GRID[1]), indexing="ij"
    )
    rays = homogeneous(survey.normalize(i, np.column_stack([u.ravel(), v.ravel()])))
    points = poses[i].inverse().apply(rays * depth)
    overlap, parallax_deg = np.zeros((2, len(survey)))
    for j in range(len(survey)):
        seen = poses[j].apply(points)
        height, width = survey.images[j].shape
        low, high = survey.normalize(j, np.array([[0.0, 0.0], [width - 1, height - 1]]))
        xy = seen[:, :2] / seen[:, 2:]
        inside = (seen[:, 2] > 0) & (xy > low).all(axis=1) & (xy < high).all(axis=1)
        overlap[j] = inside.mean()
        if inside.any():
            sight = points[inside]
            angles = _angles_deg(sight - poses[i].center, sight - poses[j].center)
            parallax_deg[j] = np.median(angles)
    return overlap, parallax_deg


def _angles_deg(a: Array, b: Array) -> Array:
    """Angles between vectors (N, 3)."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.rad2deg(np.arccos(np.clip((a * b).sum(axis=1) / lengths, -1, 1)))
