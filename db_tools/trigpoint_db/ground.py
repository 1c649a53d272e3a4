"""A map's coverage by place on the ground and by where images look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.rigid import Rigid3
from trigpoint_db.coverage import GRADES, Coverage, Grade

Array = NDArray[np.float64]

NUM_SECTORS = 8  # of headings


@dataclass(frozen=True)
class Cell:
    """A square of the ground and a sector of headings: the images taken there, looking there."""

    column: int
    row: int
    sector: int  # counterclockwise from the axis to the right; the first one is centred on it
    grade: Grade  # the middle one of its images, the worse of two
    num_images: int


def headings(poses: Rigid3, axes: Array) -> Array:
    """Return where cameras (...) look, in radians counterclockwise from the first axis."""
    ahead = poses.R[..., 2, :] @ axes.T
    angles: Array = np.arctan2(ahead[..., 1], ahead[..., 0])
    return angles


def sectors(poses: Rigid3, axes: Array) -> NDArray[np.intp]:
    """Return in which sector of headings cameras (...) look, counted from the first axis."""
    turns = headings(poses, axes) / (2 * np.pi)
    return np.round(turns * NUM_SECTORS).astype(np.intp) % NUM_SECTORS


def count_cells(coverage: Coverage, size: float) -> list[Cell]:
    """Grade squares of the ground of a size in the map's unit, by sectors of headings."""
    poses = coverage.probed
    places = np.floor(poses.center @ coverage.axes.T / size).astype(int)
    found: dict[tuple[int, int, int], list[int]] = {}
    for probe, (column, row), sector in zip(
        coverage.probes, places.tolist(), sectors(poses, coverage.axes).tolist(), strict=True
    ):
        found.setdefault((column, row, sector), []).append(GRADES.index(probe.grade))
    return [
        Cell(*where, GRADES[sorted(grades)[len(grades) // 2]], len(grades))
        for where, grades in sorted(found.items())
    ]


def cell_size(coverage: Coverage) -> float:
    """Choose a size of cells: 1, 2 or 5 times a power of ten, some 12 over the longer side."""
    places = coverage.probed.center @ coverage.axes.T
    wanted = max(float(np.ptp(places, axis=0).max()) / 12, 0.05 * coverage.median_depth)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= wanted))
