"""Commands on surveys: `trigpoint-db select`, `coverage`, `align`."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.output import check_output
from trigpoint.rigid import Rigid3
from trigpoint_db.align import Alignment, align_survey, choose_spread
from trigpoint_db.build import append_map, check_files, select_new
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.commands import datasets
from trigpoint_db.commands.datasets import Format, Source
from trigpoint_db.coverage import (
    APART,
    GRADES,
    NUM_SECTORS,
    Coverage,
    Grade,
    cell_size,
    count_cells,
    headings,
    measure_coverage,
    summary,
)
from trigpoint_db.coverage_picture import draw_coverage
from trigpoint_db.figures import check_picture, save_figure
from trigpoint_db.gaps import Place, find_gaps, suggest_poses
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import write_model
from trigpoint_db.importers.registry import read_dataset
from trigpoint_db.maps import copy_without
from trigpoint_db.poses import write_poses
from trigpoint_db.selection import Density, Selection, select
from trigpoint_db.terminal import (
    Json,
    MapPath,
    Model,
    Retrieval,
    SessionDate,
    SessionName,
    console,
    make_session,
    track,
    track_calibration,
)

app = typer.Typer()
DensityText = Annotated[
    str | None,
    typer.Option(
        "--density",
        metavar="DISTANCE",
        help="Keep one image in so much of the map's unit, or in 10% of the median depth.",
    ),
]
DensityAngle = Annotated[
    float, typer.Option(help="With --density: images turned by more are both kept.", min=0)
]
Images = Annotated[Path, typer.Option(help="Where the map's images are: a folder or a recording.")]
Probes = Annotated[int, typer.Option(help="Images that are tried, at the most.", min=1)]
Apart = Annotated[
    float,
    typer.Option(
        help="How far frames are from the nearest image: distance over depth, or radians.",
        min=0.01,
        max=1.0,
    ),
]
Up = Annotated[
    str | None, typer.Option(metavar="X,Y,Z", help="By default, what is up in the images.")
]


@app.command("select")
def select_command(
    map_: MapPath,
    images: Images,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write a map without them.")
    ] = None,
    density: DensityText = None,
    density_angle: DensityAngle = 15.0,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """List images that are better left out: blurred, twice there, without overlap, too dense."""
    wanted = read_density(density, density_angle)
    check_output(out, map_)
    network = FeatureModel.load(model, retrieval=retrieval)
    found = check_images(map_, images, network, density=wanted)
    num_left = None if out is None else copy_without(map_, found.names, out)
    if as_json:
        print(json.dumps(found.to_json() | {"map": str(out or map_), "num_images_left": num_left}))
        return
    for finding in found.findings:
        print(f"{finding.flaw}: {finding.name}: {finding.detail}")
    print(f"{map_}: of {found.num_images} images, {found}")
    if out is not None:
        print(f"{out}: {num_left} images")


def read_density(text: str | None, angle_deg: float) -> Density | None:
    """Make what --density and --density-angle say."""
    return None if text is None else Density.from_text(text, angle_deg)


def check_images(
    map_: Path,
    images: Path,
    network: FeatureModel,
    *,
    num_new: int | None = None,
    density: Density | None = None,
) -> Selection:
    """Find what is better left out of a map, or of the last images of it, with a progress bar."""
    with MapReader.open(map_, network.identity) as reader:
        return select(
            reader,
            images,
            network.long_side_px,
            first=0 if num_new is None else len(reader) - num_new,
            density=density,
            track=lambda part: track(part, "comparing", len(part)),
        )


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
    probes: Probes = 100,
    apart: Apart = APART,
    cell: Annotated[
        float | None, typer.Option(help="Of the ground, in the map's unit.", min=1e-6)
    ] = None,
    up: Up = None,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Say where a map is strong, thin or blind, and what to go and photograph."""
    for output in (picture, photograph):
        check_output(output, map_)
    if picture is not None:
        check_picture(picture)
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
    map_: Path, probes: int, apart: float, up: str | None, model: str, retrieval: Path | None
) -> tuple[Coverage, list[Place]]:
    """Measure the coverage of a map and find its gaps, with a progress bar."""
    direction = None if up is None else read_direction(up)
    network = FeatureModel.load(model, retrieval=retrieval)
    with MapReader.open(map_, network.identity) as reader:
        localizer = Localizer(network, reader, LocalizerOptions(), time.perf_counter)
        coverage = measure_coverage(
            localizer,
            num_probes=probes,
            apart=apart,
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
    table = Table(title=f"{map_}: {len(coverage.probes)} of its images, by where they look")
    table.add_column("heading (deg)", justify="right")
    for grade in GRADES:
        table.add_column(grade, justify="right")
    poses = Rigid3.stack(probe.cam_from_world for probe in coverage.probes)
    sector_deg = 360 / NUM_SECTORS
    sectors = np.round(np.rad2deg(headings(poses, coverage.axes)) / sector_deg) % NUM_SECTORS
    grades = np.array([probe.grade for probe in coverage.probes])
    for sector in np.unique(sectors).astype(int):
        there = grades[sectors == sector]
        table.add_row(
            f"{sector * sector_deg:g}", *(str((there == grade).sum()) for grade in GRADES)
        )
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


@app.command()
def align(
    map_: MapPath,
    source: Source,
    format_: Format = None,
    images: datasets.Images = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for it in the map's frame.")
    ] = None,
    apply: Annotated[bool, typer.Option("--apply", help="Add its images to the map.")] = False,
    session: SessionName = None,
    date: SessionDate = None,
    sample: Annotated[
        int, typer.Option(help="Localize so many of its images.", min=10, max=500)
    ] = 100,
    max_error: Annotated[
        float,
        typer.Option(help="Of an image that agrees: share of its distance; radians.", min=1e-4),
    ] = 0.05,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Bring a survey with poses of its own into the frame of a map, by localizing it there."""
    survey = make_session(session, date)
    if out is None and not apply:
        raise ConfigError("give -o for the poses in the map's frame, --apply to add them, or both")
    if out is not None and any((out / f"images{suffix}").exists() for suffix in (".txt", ".bin")):
        raise ConfigError(f"{out} holds a COLMAP model already; name another folder")
    dataset = read_dataset(source, format_, images=images)
    posed = dataset.mapped
    if apply:
        select_new(posed, map_, skip_existing=False)
    check_files((image.name for image in posed), dataset.images)
    network = FeatureModel.load(model, retrieval=retrieval)
    with MapReader.open(map_, network.identity) as reader:
        found = align_survey(
            Localizer(network, reader, clock=time.perf_counter),
            choose_spread(posed, sample),
            dataset.images,
            max_error=max_error,
            track=lambda outcomes, total: track(outcomes, "localizing", total),
        )
    moved = found.move(posed)
    if out is not None:
        write_model(out, moved)
    if apply:
        append_map(
            map_, track(moved, "mapping", len(moved)), dataset.images, network, session=survey
        )
        calibrate_map(map_, network, track_calibration)
    print_alignment(found, moved, out=out, added_to=map_ if apply else None, as_json=as_json)


def print_alignment(
    found: Alignment,
    moved: list[PosedImage],
    *,
    out: Path | None,
    added_to: Path | None,
    as_json: bool,
) -> None:
    """Print how well a survey fits, and where it is now."""
    facts: dict[str, Any] = found.to_json()
    if as_json:
        written = {"model": out and str(out), "map": added_to and str(added_to)}
        print(json.dumps(facts | written | {"num_images": len(moved)}))
        return
    print(
        "{num_localized} of {num_tried} images localized, {num_agreeing} agree: scale {scale:.6g}, "
        "turned by {rotation_deg:.3f} degrees\n"
        "they are off by {median_position:.3g} and {median_rotation_deg:.3g} degrees (median), "
        "{p90_position:.3g} and {p90_rotation_deg:.3g} degrees (90th percentile)".format(**facts)
    )
    for place in (out, added_to):
        if place is not None:
            print(f"{place}: {len(moved)} images of the survey")
