"""Commands on surveys: `trigpoint-db select`, `align`."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import require_new
from trigpoint.errors import ConfigError
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.output import check_output
from trigpoint_db.align import align_survey, choose_spread
from trigpoint_db.build import append_map, check_files, select_new
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.commands.datasets import SkipExisting, Survey
from trigpoint_db.importers.colmap import require_no_model, write_model
from trigpoint_db.maps import copy_without
from trigpoint_db.selection import Density, Selection, select
from trigpoint_db.terminal import (
    Json,
    Keypoints,
    MapPath,
    Model,
    Retrieval,
    SessionDate,
    SessionName,
    fields_as_options,
    hint_at,
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
    if out is not None:
        check_output(out)
        require_new(out)
    network = FeatureModel.load(model, retrieval=retrieval)
    found = check_images(map_, images, network, density=wanted)
    if not as_json:
        for finding in found.findings:
            print(f"{finding.flaw}: {finding.name}: {finding.detail}")
        print(f"{map_}: of {found.num_images} images, {found}")
    num_left = None if out is None else copy_without(map_, found.names, out)
    if as_json:
        print(json.dumps(found.to_json() | {"map": str(out or map_), "num_images_left": num_left}))
    elif out is not None:
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


@app.command()
@fields_as_options
def align(
    map_: MapPath,
    survey: Survey,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for it in the map's frame.")
    ] = None,
    apply: Annotated[bool, typer.Option("--apply", help="Add its images to the map.")] = False,
    skip_existing: SkipExisting = False,
    session: SessionName = None,
    date: SessionDate = None,
    keypoints: Keypoints = 1024,
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
    own_session = make_session(session, date)
    if out is None and not apply:
        raise ConfigError("give -o for the poses in the map's frame, --apply to add them, or both")
    if out is not None:
        require_no_model(out)
    if apply:
        check_output(map_, in_place=True)
    dataset = survey.read()
    posed = dataset.mapped
    added = (
        {i.name for i in select_new(posed, map_, skip_existing=skip_existing)} if apply else set()
    )
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
    new = [image for image in moved if image.name in added]
    if apply:
        with hint_at("--skip-existing" + ", without -o" * (out is not None)):
            in_work = track(new, "mapping", len(new))
            append_map(
                map_, in_work, dataset.images, network, max_keypoints=keypoints, session=own_session
            )
            calibrate_map(map_, network, track_calibration)
    facts: dict[str, Any] = found.to_json()
    if as_json:
        written = {"model": out and str(out), "map": str(map_) if apply else None}
        counts = {"num_images": len(moved), "num_images_added": len(new)}
        print(json.dumps(facts | written | counts))
        return
    print_alignment(facts)
    if out is not None:
        print(f"{out}: {len(moved)} images of the survey")
    if apply:
        print(f"{map_}: {len(new)} images of the survey added")


def print_alignment(facts: Mapping[str, Any]) -> None:
    """Print how well a survey fits."""
    print(
        "{num_localized} of {num_tried} images localized, {num_agreeing} agree: scale {scale:.6g}, "
        "turned by {rotation_deg:.3f} degrees\n"
        "they are off by {median_position:.3g} and {median_rotation_deg:.3g} degrees (median), "
        "{p90_position:.3g} and {p90_rotation_deg:.3g} degrees (90th percentile)".format(**facts)
    )
