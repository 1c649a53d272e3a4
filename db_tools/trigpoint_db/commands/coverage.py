"""The command `trigpoint-db coverage`, and its options."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.output import check_output
from trigpoint.rigid import Rigid3
from trigpoint_db.coverage import (
    APART,
    GRADES,
    Coverage,
    Grade,
    measure_coverage,
    summary,
)
from trigpoint_db.coverage_picture import draw_coverage
from trigpoint_db.figures import check_picture, save_figure
from trigpoint_db.gaps import Place, find_gaps, suggest_poses
from trigpoint_db.ground import NUM_SECTORS, cell_size, count_cells, headings, sectors
from trigpoint_db.poses import write_poses
from trigpoint_db.terminal import Json, MapPath, Model, Retrieval, console, track

app = typer.Typer()
NUM_PROBES = 100
Probes = Annotated[
    int | None,
    typer.Option(help=f"Images that are tried, at the most; by default {NUM_PROBES}.", min=1),
]
Apart = Annotated[
    float | None,
    typer.Option(
        help="How far frames are from the nearest image: distance over depth, or radians; "
        f"by default {APART}.",
        min=0.01,
        max=1.0,
    ),
]
Up = Annotated[
    str | None, typer.Option(metavar="X,Y,Z", help="By default, what is up in the images.")
]


@app.command("coverage")
def coverage_command(
    map_: MapPath,
    picture: Annotated[
        Path | None, typer.Option("--picture", "-o", help="Draw it from above (PNG).")
    ] = None,
    photograph: Annotated[
        Path | None, typer.Option(help="Write the poses to go and photograph.")
    ] = None,
    max_poses: Annotated[int, typer.Option(help="Of those, at the most.", min=0)] = 30,
    probes: Probes = None,
    apart: Apart = None,
    cell: Annotated[
        float | None, typer.Option(help="Of the ground, in the map's unit.", min=1e-6)
    ] = None,
    up: Up = None,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Say where a map is strong, thin or blind, and what to go and photograph."""
    check_picture(picture, map_)
    check_output(photograph, map_, *([picture] if picture else []))
    if cell is not None and not math.isfinite(cell):
        raise ConfigError(f"--cell wants a length, not {cell}")
    coverage, gaps = measure(map_, probes, apart, up, model, retrieval)
    wanted = suggest_poses(coverage, gaps, max_poses)
    if picture is not None:
        save_figure(draw_coverage(coverage, gaps, wanted, cell), picture)
    if photograph is not None:
        write_poses(photograph, name_poses(wanted))
    if as_json:
        cells = [asdict(found) for found in count_cells(coverage, cell or cell_size(coverage))]
        more = {"cells": cells, "gaps": describe(gaps, coverage)}
        print(json.dumps(summary(coverage) | more | {"photograph": describe(wanted, coverage)}))
    else:
        print_coverage(map_, coverage, gaps, wanted)


def measure(
    map_: Path,
    probes: int | None,
    apart: float | None,
    up: str | None,
    model: str,
    retrieval: Path | None,
) -> tuple[Coverage, list[Place]]:
    """Measure the coverage of a map and find its gaps, with a progress bar."""
    direction = None if up is None else read_direction(up)
    network = FeatureModel.load(model, retrieval=retrieval)
    with MapReader.open(map_, network.identity) as reader:
        localizer = Localizer(network, reader, LocalizerOptions(), time.perf_counter)
        coverage = measure_coverage(
            localizer,
            num_probes=probes or NUM_PROBES,
            apart=apart or APART,
            up=direction,
            track=lambda part: track(part, "localizing", len(part)),
        )
        return coverage, find_gaps(reader, coverage)


def read_direction(text: str) -> NDArray[np.float64]:
    """Read 'X,Y,Z' as a unit vector (3,)."""
    try:
        vector = np.array([float(number) for number in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 0 < length < np.inf:
        raise ConfigError(f"--up wants a direction such as 0,0,1, not {text!r}")
    up: NDArray[np.float64] = vector / length
    return up


def name_poses(wanted: list[Place]) -> dict[str, Rigid3]:
    """Give poses to photograph names, in their order."""
    return {f"photograph_{i:03d}": place.cam_from_world for i, place in enumerate(wanted)}


def describe(places: list[Place], coverage: Coverage) -> list[dict[str, object]]:
    """Say in JSON's types where places are and why."""
    return [
        {
            "center": place.cam_from_world.center.tolist(),
            "heading_deg": float(np.rad2deg(headings(place.cam_from_world, coverage.axes))),
            "rotation_wxyz": place.cam_from_world.inverse().quaternion.tolist(),
            "grade": place.grade,
            "reason": place.reason,
        }
        for place in places
    ]


def print_coverage(map_: Path, coverage: Coverage, gaps: list[Place], wanted: list[Place]) -> None:
    """Print grades by heading, then what to photograph."""
    title = f"{map_}: {len(coverage.probes)} of its images, by where they look"
    table = Table(title=escape(title))
    table.add_column("heading (deg)", justify="right")
    for grade in GRADES:
        table.add_column(grade, justify="right")
    looking = sectors(coverage.probed, coverage.axes)
    grades = np.array([probe.grade for probe in coverage.probes])
    for sector in np.unique(looking):
        there = grades[looking == sector]
        middle_deg = f"{sector * 360 / NUM_SECTORS:g}"
        table.add_row(middle_deg, *(str((there == grade).sum()) for grade in GRADES))
    table.add_section()
    table.add_row("all", *(str(coverage.counts[grade]) for grade in GRADES))
    console.print(table)
    weak = sum(gap.grade is not Grade.STRONG for gap in gaps)
    print(f"{len(gaps)} places in gaps between images, {weak} of them thin or blind")
    for place in wanted:
        x, y, z = place.cam_from_world.center
        heading = np.rad2deg(headings(place.cam_from_world, coverage.axes))
        where = f"({x:.4g}, {y:.4g}, {z:.4g}) heading {heading:.0f} degrees"
        print(f"photograph {where}: {place.grade}, {place.reason}")
