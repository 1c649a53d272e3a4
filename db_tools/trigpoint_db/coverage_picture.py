"""A map's coverage, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from trigpoint.rigid import Rigid3
from trigpoint_db.coverage import GRADES, Coverage, Grade
from trigpoint_db.figures import make_figure
from trigpoint_db.gaps import Place
from trigpoint_db.ground import NUM_SECTORS, cell_size, count_cells, headings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

# Told apart in gray, and by those who do not see red and green.
COLORS = {Grade.STRONG: "#3b8bc4", Grade.THIN: "#e8a33d", Grade.BLIND: "#c2255c"}
MARKERS = {Grade.STRONG: "o", Grade.THIN: "^", Grade.BLIND: "X"}


def draw_coverage(
    coverage: Coverage, gaps: Sequence[Place], wanted: Sequence[Place], size: float | None = None
) -> Figure:
    """Draw squares of the ground with a wedge for each sector of headings, gaps, and wanted poses.

    `size` is that of the squares, in the map's unit.
    """
    size = cell_size(coverage) if size is None else size
    figure = make_figure(8.0, 7.0)
    axes = figure.subplots()
    _draw_cells(axes, coverage, size)
    centers = coverage.images_from_world.center @ coverage.axes.T
    axes.plot(*centers.T, ".", color="0.5", markersize=2, zorder=3)
    _draw_gaps(axes, coverage, gaps)
    if wanted:
        _draw_wanted(axes, coverage, wanted, size)
    axes.set(aspect="equal", xlabel="from above, in the map's unit")
    axes.margins(0.08)
    axes.tick_params(labelsize="small")
    handles = _legend(coverage, gaps, wanted)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize="small", frameon=False
    )
    return figure


def _draw_cells(axes: Axes, coverage: Coverage, size: float) -> None:
    from matplotlib.patches import Rectangle, Wedge

    sector_deg = 360 / NUM_SECTORS
    cells = count_cells(coverage, size)
    for column, row in {(cell.column, cell.row) for cell in cells}:
        corner = (column * size, row * size)
        axes.add_patch(
            Rectangle(corner, size, size, fill=False, edgecolor="0.6", linewidth=0.4, alpha=0.6)
        )
    for cell in cells:
        middle = ((cell.column + 0.5) * size, (cell.row + 0.5) * size)
        start, end = (cell.sector - 0.5) * sector_deg, (cell.sector + 0.5) * sector_deg
        axes.add_patch(Wedge(middle, 0.48 * size, start, end, color=COLORS[cell.grade], alpha=0.75))


def _draw_gaps(axes: Axes, coverage: Coverage, gaps: Sequence[Place]) -> None:
    for grade in GRADES:
        places = [gap.cam_from_world.center for gap in gaps if gap.grade is grade]
        if places:
            axes.plot(
                *(np.array(places) @ coverage.axes.T).T,
                MARKERS[grade],
                color=COLORS[grade],
                markersize=4 if grade is Grade.STRONG else 7,
                markeredgecolor="0.5",
                markeredgewidth=0.5,
                zorder=4,
            )


def _draw_wanted(axes: Axes, coverage: Coverage, wanted: Sequence[Place], size: float) -> None:
    poses = Rigid3.stack(place.cam_from_world for place in wanted)
    angles = headings(poses, coverage.axes)
    axes.quiver(
        *(poses.center @ coverage.axes.T).T,
        np.cos(angles),
        np.sin(angles),
        angles="xy",
        scale_units="xy",
        scale=1.2 / size,
        width=0.004,
        color="black",
        zorder=5,
    )


def _legend(
    coverage: Coverage, gaps: Sequence[Place], wanted: Sequence[Place]
) -> list[Patch | Line2D]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Patch | Line2D] = [
        Patch(color=COLORS[grade], label=f"{grade} ({coverage.counts[grade]} images)")
        for grade in GRADES
    ]
    handles += [
        Line2D([], [], linestyle="", marker=MARKERS[grade], color=COLORS[grade], label=label)
        for grade in GRADES
        if (num := sum(gap.grade is grade for gap in gaps))
        and (label := f"gap: {grade} ({num} places)")
    ]
    if wanted:
        label = f"to photograph ({len(wanted)} poses)"
        handles.append(Line2D([], [], color="black", marker=">", label=label))
    return handles
