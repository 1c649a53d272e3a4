"""Commands that make maps: `trigpoint-db build`, `calibrate`, `demo`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from trigpoint.database.codec import Profile
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import PoseNoise
from trigpoint.models.features import FeatureModel
from trigpoint.output import check_output
from trigpoint_db.build import (
    append_map,
    build_map,
    check_files,
    select_images,
    select_new,
)
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.commands.datasets import Format, Images, Poses, Source
from trigpoint_db.commands.survey import DensityAngle, DensityText, check_images, read_density
from trigpoint_db.demo import make_demo, prepare_folder
from trigpoint_db.extraction import NetworkFiles, open_crew
from trigpoint_db.importers.registry import read_dataset
from trigpoint_db.maps import leave_out
from trigpoint_db.poses import (
    read_names,
)
from trigpoint_db.terminal import (
    Json,
    MapPath,
    MapProfile,
    Model,
    Retrieval,
    SessionDate,
    SessionName,
    make_session,
    track,
    track_calibration,
)

app = typer.Typer()


@app.command()
def build(
    map_: MapPath,
    source: Source,
    format_: Format = None,
    images: Images = None,
    poses: Poses = None,
    camera: Annotated[
        str | None, typer.Option(help="Of tum: its name, or 'MODEL width height params...'.")
    ] = None,
    image_topic: Annotated[
        str | None, typer.Option(help="Of mcap: one of several cameras.")
    ] = None,
    pose_topic: Annotated[str | None, typer.Option(help="Of mcap: one of several sources.")] = None,
    mount: Annotated[
        str | None,
        typer.Option(
            metavar="'X Y Z QW QX QY QZ'|FRAME",
            help="Of mcap: where the camera sits on what the poses are of, or the frame of that.",
        ),
    ] = None,
    max_gap: Annotated[
        float | None,
        typer.Option(help="Of tum, euroc, mcap: seconds between two poses, at most.", min=0),
    ] = None,
    list_: Annotated[Path | None, typer.Option("--list", help="Only these names.")] = None,
    append: Annotated[bool, typer.Option("--append", help="Add to a map.")] = False,
    skip_existing: Annotated[
        bool, typer.Option("--skip-existing", help="Leave out images that the map has.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a build that was interrupted.")
    ] = False,
    jobs: Annotated[int, typer.Option(help="Processes that extract features.", min=1)] = 1,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, to use its workers.")
    ] = None,
    session: SessionName = None,
    date: SessionDate = None,
    select_: Annotated[
        bool, typer.Option("--select", help="Leave out what `select` would.")
    ] = False,
    density: DensityText = None,
    density_angle: DensityAngle = 15.0,
    keypoints: Annotated[int, typer.Option(help="At most so many an image.", min=50)] = 1024,
    profile: MapProfile = None,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Make a map from images with known poses."""
    survey = make_session(session, date)
    wanted = read_density(density, density_angle)
    if wanted is not None and not select_:
        raise ConfigError("--density is for --select: images are left out by both together")
    dataset = read_dataset(
        source,
        format_,
        images=images,
        poses=poses,
        camera=camera,
        image_topic=image_topic,
        pose_topic=pose_topic,
        mount=mount,
        max_gap=max_gap,
    )
    posed = dataset.mapped
    if list_ is not None:
        posed = select_images(posed, read_names(list_))
    if not posed:
        raise ConfigError(f"there are no images to map: {list_ or source} names none")
    check_output(map_)
    if append:
        require_profile(map_, profile)
        posed = select_new(posed, map_, skip_existing=skip_existing)
    check_files((image.name for image in posed), dataset.images)
    if append and resume:
        raise ConfigError("an interrupted --append goes on with --append --skip-existing")
    write = append_map if append else partial(build_map, resume=resume, profile=profile)
    network = FeatureModel.load(model, retrieval=retrieval)
    files = NetworkFiles(model, retrieval, network.identity)
    with (
        hint_at_resuming(append=append),
        open_crew(jobs, cluster, files) as crew,
        closing(track(posed, "mapping", len(posed))) as tracked,
    ):
        count = write(
            map_,
            tracked,
            dataset.images,
            network,
            max_keypoints=keypoints,
            session=survey,
            crew=crew,
        )
    selection = check_images(map_, dataset.images, network, num_new=count, density=wanted)
    if select_ and selection.findings:
        leave_out(map_, selection.names)
        count -= len(selection.findings)
    noise = calibrate_map(map_, network, track_calibration)
    size = map_.stat().st_size
    if as_json:
        facts = {"map": str(map_), "num_images_added": count, "bytes": size}
        facts["num_unposed"] = dataset.num_unposed
        facts |= {"selection": selection.to_json() | {"left_out": select_}}
        print(json.dumps(facts | {"pose_noise": noise and asdict(noise)}))
    else:
        unposed = f", {dataset.num_unposed} without a pose left out" * bool(dataset.num_unposed)
        advice = " left out" if select_ else "; --select leaves such images out"
        print(
            f"{map_}: {count} image{'s' * (count != 1)} added{unposed}, {size / 1e6:.1f} MB; "
            f"{selection}{advice * bool(selection.findings)}; {describe_noise(noise)}"
        )


@contextmanager
def hint_at_resuming(*, append: bool) -> Iterator[None]:
    """Say after an interruption how the command goes on."""
    try:
        yield
    except KeyboardInterrupt:
        how = "--skip-existing" if append else "--resume"
        print(f"trigpoint-db: interrupted; the same command goes on with {how}", file=sys.stderr)
        raise


def require_profile(map_: Path, profile: Profile | None) -> None:
    """Refuse to add to a map of another profile than was asked for."""
    with MapReader.open(map_) as reader:
        if profile not in (None, reader.profile):
            raise ConfigError(
                f"{map_} is of the {reader.profile} profile, and images added are of it too; "
                "leave --profile out"
            )


@app.command()
def calibrate(
    map_: MapPath, model: Model = "base", retrieval: Retrieval = None, as_json: Json = False
) -> None:
    """Measure how well the poses of a map agree, as `build` does, and note it in the map."""
    network = FeatureModel.load(model, retrieval=retrieval)
    noise = calibrate_map(map_, network, track_calibration)
    if as_json:
        print(json.dumps({"map": str(map_), "pose_noise": noise and asdict(noise)}))
    else:
        print(f"{map_}: {describe_noise(noise)}")


def describe_noise(noise: PoseNoise | None) -> str:
    """Say for people how well the poses of a map agree."""
    if noise is None:
        return "too few of its images could be localized to tell how well its poses agree"
    return (
        f"its poses agree to {noise.position:.2g} and {noise.position_drift * 100:.2g} % of their "
        f"distance, {np.rad2deg(noise.rotation_rad):.2g} degrees and "
        f"{np.rad2deg(noise.rotation_drift_rad):.2g} for each unit of it"
    )


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to; made if missing.")],
    survey: Annotated[int, typer.Option(help="Images of the map.", min=10)] = 140,
    flight: Annotated[int, typer.Option(help="Frames of the flight.", min=2)] = 120,
    seed: Annotated[int, typer.Option(help="Another seed, another room.", min=0)] = 0,
    as_json: Json = False,
) -> None:
    """Render a room, survey and fly through it: images, map, recording, truth, settings."""
    prepare_folder(folder)
    posed = make_demo(folder, num_survey=survey, num_flight=flight, seed=seed, progress=track)
    map_ = folder / "map.tpmap"
    network = FeatureModel.load()
    build_map(map_, track(posed, "mapping", len(posed)), folder / "survey", network)
    calibrate_map(map_, network, track_calibration)
    if as_json:
        print(json.dumps({"folder": str(folder), "num_survey": survey, "num_flight": flight}))
    else:
        print(f"{folder}: map of {survey} images, flight of {flight} frames, trigpointd.toml")
