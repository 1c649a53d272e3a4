"""Commands that make maps and add to them: `trigpoint-db build`, `add`, `calibrate`, `demo`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.database.replacing import name_map, partial_map, require_new, spare_file
from trigpoint.errors import ConfigError
from trigpoint.frame import PoseNoise, Session
from trigpoint.models.features import FeatureModel
from trigpoint.output import check_output
from trigpoint_db.build import append_map, build_map, check_files, select_new
from trigpoint_db.calibrate import calibrate_map, describe_noise
from trigpoint_db.commands.datasets import SkipExisting, Survey
from trigpoint_db.commands.survey import DensityAngle, DensityText, check_images, read_density
from trigpoint_db.demo import make_demo, prepare_folder
from trigpoint_db.extraction import NetworkFiles, open_crew
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.maps import copy_without, leave_out
from trigpoint_db.selection import Density, Selection
from trigpoint_db.terminal import (
    Json,
    Keypoints,
    MapPath,
    MapProfile,
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
Jobs = Annotated[int, typer.Option(help="Processes that extract features.", min=1)]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, to use its workers.")
]
LeaveOut = Annotated[bool, typer.Option("--select", help="Leave out what `select` would.")]


@dataclass(frozen=True)
class Work:
    """The options that say how images come into a map, and how that is reported."""

    session_name: SessionName = None
    date: SessionDate = None
    keypoints: Keypoints = 1024
    leaves_out: LeaveOut = False
    density_text: DensityText = None
    density_angle: DensityAngle = 15.0
    jobs: Jobs = 1
    cluster: Cluster = None
    model: Model = "base"
    retrieval: Retrieval = None
    as_json: Json = False

    @property
    def session(self) -> Session | None:
        """What survey the images are of."""
        return make_session(self.session_name, self.date)

    @property
    def density(self) -> Density | None:
        """How near two images may be to each other."""
        if self.density_text is not None and not self.leaves_out:
            raise ConfigError("--density is for --select: images are left out by both together")
        return read_density(self.density_text, self.density_angle)

    def load_network(self) -> FeatureModel:
        """Load the network that extracts features."""
        return FeatureModel.load(self.model, retrieval=self.retrieval)

    def write(
        self,
        write: Callable[..., int],
        images: Sequence[PosedImage],
        folder: Path,
        network: FeatureModel,
    ) -> int:
        """Write images to a map, with a progress bar; returns how many."""
        files = NetworkFiles(self.model, self.retrieval, network.identity)
        with (
            open_crew(self.jobs, self.cluster, files) as crew,
            closing(track(images, "mapping", len(images))) as tracked,
        ):
            return write(tracked, folder, network, max_keypoints=self.keypoints, crew=crew)

    def say(
        self, map_: Path, count: int, num_unposed: int, found: Selection, noise: PoseNoise | None
    ) -> None:
        """Print what has come into the map."""
        size = map_.stat().st_size
        if self.as_json:
            facts = {"map": str(map_), "num_images_added": count, "bytes": size}
            facts["num_unposed"] = num_unposed
            facts |= {"selection": found.to_json() | {"left_out": self.leaves_out}}
            print(json.dumps(facts | {"pose_noise": noise and asdict(noise)}))
            return
        unposed = f", {num_unposed} without a pose left out" * bool(num_unposed)
        advice = " left out" if self.leaves_out else "; --select leaves such images out"
        print(
            f"{map_}: {count} image{'s' * (count != 1)} added{unposed}, {size / 1e6:.1f} MB; "
            f"{found}{advice * bool(found.findings)}; {describe_noise(noise)}"
        )


@app.command()
@fields_as_options
def build(
    map_: MapPath,
    survey: Survey,
    work: Work,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a build that was interrupted.")
    ] = False,
    profile: MapProfile = None,
) -> None:
    """Make a map from images with known poses."""
    session, density = work.session, work.density
    dataset = survey.read()
    check_output(map_)
    require_new(map_)
    check_files((image.name for image in dataset.mapped), dataset.images)
    network = work.load_network()
    write = partial(build_map, map_, resume=resume, profile=profile, session=session, named=False)
    with hint_at("--resume"), spare_file(map_) as spare:
        count, whole = work.write(write, dataset.mapped, dataset.images, network), partial_map(map_)
        found = check_images(whole, dataset.images, network, density=density)
        if work.leaves_out and found.findings:
            if len(found.findings) == count:
                raise ConfigError(
                    f"--select would leave out all {count} images; see what the map is like "
                    "without it: --resume"
                )
            count, whole = copy_without(whole, found.names, spare), spare
        noise = calibrate_map(whole, network, track_calibration)
        name_map(whole, map_)
    work.say(map_, count, dataset.num_unposed, found, noise)


@app.command()
@fields_as_options
def add(
    map_: MapPath,
    survey: Survey,
    work: Work,
    skip_existing: SkipExisting = False,
) -> None:
    """Add images with known poses to a map; each is there for good, and used, once it is added."""
    session, density = work.session, work.density
    dataset = survey.read()
    check_output(map_, in_place=True)
    new = select_new(dataset.mapped, map_, skip_existing=skip_existing)
    check_files((image.name for image in new), dataset.images)
    network = work.load_network()
    write = partial(append_map, map_, session=session)
    rest = "; `trigpoint-db select` finds what it should have left out" if work.leaves_out else ""
    with hint_at(f"--skip-existing{rest}"):
        count = work.write(write, new, dataset.images, network)
        found = check_images(map_, dataset.images, network, num_new=count, density=density)
        if work.leaves_out and found.findings:
            leave_out(map_, found.names)
            count -= len(found.findings)
        noise = calibrate_map(map_, network, track_calibration)
    work.say(map_, count, dataset.num_unposed, found, noise)


@app.command()
def calibrate(
    map_: MapPath, model: Model = "base", retrieval: Retrieval = None, as_json: Json = False
) -> None:
    """Measure how well the poses of a map agree, as `build` does, and note it in the map."""
    check_output(map_, in_place=True)
    network = FeatureModel.load(model, retrieval=retrieval)
    noise = calibrate_map(map_, network, track_calibration)
    if as_json:
        print(json.dumps({"map": str(map_), "pose_noise": noise and asdict(noise)}))
    else:
        print(f"{map_}: {describe_noise(noise)}")


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
