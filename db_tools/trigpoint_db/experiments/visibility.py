"""Which images of a map see what a query sees, from the true poses.

Nobody has told which images overlap. As in the frustum overlap of RelocNet (Balntas, Li and
Prisacariu, ECCV 2018), a grid of the query's pixels is put at the depth of what it sees, and an
image sees the same if at least MIN_OVERLAP of the points fall into it, under a parallax of at most
MAX_PARALLAX_DEG: what is before the camera may hide its other side. The depth is a median,
triangulated from the true poses with images that stand near and look the same way; retrieval has no
part in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor
from trigpoint.rigid import Rigid3
from trigpoint.verdict import see_share
from trigpoint_db.overlap import verify_pair

Array = NDArray[np.float64]

MIN_OVERLAP = 0.3
MAX_PARALLAX_DEG = 50.0
GRID = (16, 12)  # points of a query, across and down
NUM_NEIGHBORS = 5  # images that tell the depth of a query
MAX_NEIGHBOR_ANGLE_DEG = 45.0


def find_overlapping(
    queries: Sequence[Anchor], reader: MapReader, long_side_px: int
) -> NDArray[np.bool_]:
    """Say which images of a map see what queries see, (Q, N).

    A query has the median depth of the others where none of the images near it tells its own.
    """
    poses = reader.poses()
    depths = [_measure_depth(query, reader, poses, long_side_px) for query in queries]
    known = [depth for depth in depths if not math.isnan(depth)]
    if not known:
        raise ConfigError("no query shares anything with an image near it; are the poses right?")
    middle = float(np.median(known))
    overlapping = np.empty((len(queries), len(poses)), np.bool_)
    for row, query, depth in zip(overlapping, queries, depths, strict=True):
        points3d = _spread_points(query, middle if math.isnan(depth) else depth)
        rays = points3d.mean(axis=0) - np.vstack([query.cam_from_world.center, poses.center])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        shares = [see_share(*reader.view(index), points3d, math.inf) for index in range(len(row))]
        row[:] = np.array(shares) >= MIN_OVERLAP
        row &= rays[1:] @ rays[0] >= math.cos(math.radians(MAX_PARALLAX_DEG))
    return overlapping


def _measure_depth(query: Anchor, reader: MapReader, poses: Rigid3, long_side_px: int) -> float:
    """Return the median depth of what a query sees; nan where no image near it tells."""
    distances = np.linalg.norm(poses.center - query.cam_from_world.center, axis=1)
    cosines = poses.R[:, 2] @ query.cam_from_world.R[2]
    distances[cosines < math.cos(math.radians(MAX_NEIGHBOR_ANGLE_DEG))] = np.inf
    near = [i for i in np.argsort(distances)[:NUM_NEIGHBORS].tolist() if distances[i] < np.inf]
    depths = [verify_pair(query, query, reader.anchor(i), long_side_px).depth for i in near]
    known = [depth for depth in depths if not math.isnan(depth)]
    return float(np.median(known)) if known else math.nan


def _spread_points(query: Anchor, depth: float) -> Array:
    """Put a grid of a query's pixels at a depth: points in the world (M, 3)."""
    points_px = _grid_px(query.camera)
    xy = query.camera.normalize(points_px)
    xy = xy[np.isfinite(xy).all(axis=1)]
    points: Array = query.cam_from_world.inverse().apply(
        depth * np.column_stack([xy, np.ones(len(xy))])
    )
    return points


def _grid_px(camera: Camera) -> Array:
    """Return the middles (M, 2) of equal parts of an image."""
    u, v = ((np.arange(n) + 0.5) / n for n in GRID)
    shares = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return shares * (camera.width, camera.height) - 0.5
