"""The command `trigpoint-db`."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import threadpoolctl
import typer
from rich.table import Table

from trigpoint.camera import Camera
from trigpoint.database.codec import Profile
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError, SourceError, TrigpointError
from trigpoint.frame import Failed, Localized, PoseNoise, describe, summarize
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel, find_model
from trigpoint.models.matching import load_matcher
from trigpoint.options import LocalizerOptions
from trigpoint.output import check_output, open_text
from trigpoint_db.adapt import adapt_model
from trigpoint_db.build import (
    append_map,
    build_map,
    check_files,
    select_images,
    select_new,
)
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.cli_maps import app as maps
from trigpoint_db.cli_report import app as report_app
from trigpoint_db.cli_survey import DensityAngle, DensityText, check_images, read_density
from trigpoint_db.cli_survey import app as survey_app
from trigpoint_db.demo import make_demo, prepare_folder
from trigpoint_db.evaluate import evaluate, plot_paths, read_truth
from trigpoint_db.experiments.cli import app as experiments
from trigpoint_db.experiments.cli_scenes import app as scenes
from trigpoint_db.extraction import NetworkFiles, open_crew
from trigpoint_db.fleet import cli as fleet_cli
from trigpoint_db.importers import cli as importers_cli
from trigpoint_db.importers.cli import Format, Images, Poses, Source
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.importers.registry import read_dataset
from trigpoint_db.latency import print_latency, read_stage_times, summarize_latency
from trigpoint_db.localize import localize_images
from trigpoint_db.maps import count_sessions, leave_out
from trigpoint_db.poses import (
    Query,
    read_names,
    read_poses,
    read_priors,
    read_queries,
    write_poses,
)
from trigpoint_db.recording import FORMATS, RecordedImage, write_recording
from trigpoint_db.recover import recover
from trigpoint_db.terminal import (
    Json,
    MapPath,
    MapProfile,
    Model,
    Retrieval,
    SessionDate,
    SessionName,
    console,
    make_session,
    track,
    track_calibration,
)

app = typer.Typer(
    help="Off-line tools on maps, recordings and results.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(maps)  # on the same level
app.add_typer(importers_cli.app)
app.add_typer(fleet_cli.app)
app.add_typer(survey_app)
app.add_typer(report_app)
experiments.add_typer(scenes)
app.add_typer(experiments, name="experiment")


@app.callback()
def _set_up() -> None:
    # As in the daemon: OpenBLAS's threads spin while they wait for each other.
    threadpoolctl.threadpool_limits(1, user_api="blas")


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
            f"{map_}: {count} images added{unposed}, {size / 1e6:.1f} MB; "
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
def localize(
    map_: MapPath,
    images: Annotated[Path, typer.Option(help="Folder of the query images.")],
    queries: Annotated[Path, typer.Option(help="Lines `name MODEL width height params...`.")],
    poses: Annotated[Path, typer.Option(help="Write `name qw qx qy qz tx ty tz`.")],
    results: Annotated[Path | None, typer.Option(help="Write a JSON line a query.")] = None,
    anchors: Annotated[int, typer.Option(help="How many to retrieve.", min=2)] = 20,
    priors: Annotated[
        Path | None, typer.Option(help="Lines `name x y z radius`: images elsewhere do not count.")
    ] = None,
    model: Model = "base",
    retrieval: Retrieval = None,
    matcher: Annotated[
        Path | None, typer.Option(help="A matching network; mutual nearest neighbours by default.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Localize images; OK poses go to a file, what came of every query to another."""
    for output in (poses, results):
        check_output(output, map_, queries)
    wanted = read_queries(queries)
    if not wanted:
        raise ConfigError(f"{queries} names no images")
    around = {} if priors is None else read_priors(priors)
    if priors is not None and not any(query.name in around for query in wanted):
        raise ConfigError(f"{priors} names none of the images in {queries}")
    check_files((query.name for query in wanted), images)
    network = FeatureModel.load(model, retrieval=retrieval)
    matching = load_matcher(matcher, network.identity.descriptor_dim)
    options = LocalizerOptions(num_anchors=anchors)
    with MapReader.open(map_, network.identity) as reader, ExitStack() as stack:
        if len(reader) == 0:
            raise ConfigError(f"{map_} holds no images; add some: trigpoint-db build --append")
        lines = None if results is None else stack.enter_context(open_text(results))
        localizer = Localizer(network, reader, options, time.perf_counter, matching)
        localized = localize_images(localizer, wanted, images, around)
        outcomes = []
        for outcome in track(localized, "localizing", len(wanted)):
            outcomes.append(outcome)
            if lines is not None:
                lines.write(json.dumps({"name": outcome.name, **describe(outcome.result)}) + "\n")
    found = {o.name: o.result.cam_from_world for o in outcomes if isinstance(o.result, Localized)}
    write_poses(poses, found)
    counts = Counter(summarize(outcome.result) for outcome in outcomes)
    others = ", ".join(f"{n} {reason}" for reason, n in counts.items() if reason != "LOCALIZED")
    if as_json:
        print(json.dumps({"num_queries": len(outcomes), "outcomes": counts}))
    else:
        print(f"{len(found)} of {len(outcomes)} localized" + (f", {others}" if others else ""))
    bad = [outcome.result for outcome in outcomes if isinstance(outcome.result, Failed)]
    if bad:
        raise SourceError(f"{len(bad)} queries failed; the first: {bad[0].detail}")
    if not found:
        raise ConfigError(
            f"no query was localized: {others}; --results says more of each, and whether the map "
            "shows their place only you can tell"
        )


@app.command("evaluate")
def evaluate_command(
    poses: Annotated[Path, typer.Option(help="Estimated poses.")],
    truth: Annotated[Path, typer.Option(help="A COLMAP model's folder, or a pose file.")],
    queries: Annotated[
        Path | None, typer.Option(help="What was asked for; without: all of the truth.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="A daemon's MCAP log: show latency.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw both paths (PNG).")] = None,
    as_json: Json = False,
) -> None:
    """Compare poses with the truth; a query without a pose counts as a failure."""
    check_output(picture, poses, *(p for p in (truth, queries, log) if p is not None))
    estimates, reference = read_poses(poses), read_truth(truth)
    names = list(reference) if queries is None else read_names(queries)
    evaluation = evaluate(estimates, reference, names)
    stage_times = None if log is None else read_stage_times(log)
    if as_json:
        report = evaluation.to_json()
        if stage_times is not None:
            report["latency_ms"] = summarize_latency(stage_times)
        print(json.dumps(report))
    else:
        evaluation.print_table(console)
        if stage_times is not None:
            print_latency(console, stage_times)
    if picture is not None:
        plot_paths(estimates, {name: reference[name] for name in names}, picture)
        if not as_json:
            console.print(f"picture: {picture}", soft_wrap=True)


@app.command()
def info(map_: MapPath, as_json: Json = False) -> None:
    """Say what a map holds."""
    with MapReader.open(map_) as reader:
        centers = np.array([reader.view(i)[1].center for i in range(len(reader))])
        facts: dict[str, Any] = {
            "map": str(map_),
            "num_images": len(reader),
            "generation": reader.generation,
            "model": reader.model.name,
            "model_sha256": reader.model.sha256,
            "profile": reader.profile,
            "has_index": reader.has_index,
            "descriptor_dim": reader.model.descriptor_dim,
            "global_dim": reader.model.global_dim,
            "pose_noise": reader.pose_noise and asdict(reader.pose_noise),
            "sessions": count_sessions(reader),
            "bytes": map_.stat().st_size,
            "min_center": centers.min(axis=0).tolist() if len(centers) else None,
            "max_center": centers.max(axis=0).tolist() if len(centers) else None,
        }
    if as_json:
        print(json.dumps(facts))
        return
    table = Table(show_header=False)
    for session in facts.pop("sessions"):
        about = f"session {session['name'] or 'none'}", session["date"] or ""
        table.add_row(" ".join(about), f"{session['num_images']} images")
    for key, value in facts.items():
        table.add_row(key, str(value))
    console.print(table)


@app.command()
def verify(map_: MapPath, as_json: Json = False) -> None:
    """Check every record of a map; exit code 1 where something is wrong."""
    with MapReader.open(map_) as reader:
        problems, count = reader.verify(), len(reader)
    if as_json:
        print(json.dumps({"map": str(map_), "num_images": count, "problems": problems}))
    else:
        for problem in problems:
            print(problem)
        print(f"{map_}: {count} images, {len(problems) or 'no'} problems")
    if problems:
        raise typer.Exit(1)


@app.command()
def record(
    out: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The recording.")],
    images: Annotated[Path, typer.Option(help="Folder of the images, in order of name.")],
    camera: Annotated[
        str | None, typer.Option(help="'MODEL width height params...' of all of them.")
    ] = None,
    queries: Annotated[
        Path | None, typer.Option(help="Only these, `name MODEL width height params...`.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Images a second.", min=0.01, max=1e4)] = 10.0,
    truth: Annotated[Path | None, typer.Option(help="A COLMAP model's folder.")] = None,
    as_json: Json = False,
) -> None:
    """Write images to a recording that `trigpointd` and Foxglove play."""
    if (camera is None) == (queries is None):
        raise ConfigError("give either --camera for all images or --queries with one for each")
    if queries is not None:
        wanted = read_queries(queries)
        check_files((query.name for query in wanted), images)
    else:
        common = Camera.from_text(camera or "")
        wanted = [Query(name, common) for name in _image_names(images)]
    poses = {} if truth is None else read_truth(truth)
    if truth is not None and not any(query.name in poses for query in wanted):
        raise ConfigError(f"{truth} has no pose of any of the images")
    recorded = [RecordedImage(images / q.name, q.camera, poses.get(q.name)) for q in wanted]
    count = write_recording(out, track(recorded, "recording", len(recorded)), rate_hz=rate)
    if as_json:
        print(json.dumps({"recording": str(out), "num_images": count, "rate_hz": rate}))
    else:
        print(f"{out}: {count} images, {count / rate:.1f} s")


def _image_names(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise ConfigError(f"no such folder: {folder}")
    names = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in FORMATS)
    if not names:
        raise ConfigError(f"{folder} holds no images ({', '.join(FORMATS)})")
    return names


@app.command("recover")
def recover_command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="An MCAP log or recording.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The whole file; LOG.recovered.mcap by default."),
    ] = None,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Put the whole file in the place of LOG.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Save what is whole of a log that a crash or a loss of power left unfinished, or damaged."""
    if in_place and out is not None:
        raise ConfigError("give either -o or --in-place")
    out = log if in_place else out or log.with_suffix(f".recovered{log.suffix}")
    recovered = recover(log, out, in_place=in_place)
    if as_json:
        print(json.dumps({"log": str(log), "recovered": str(out)} | asdict(recovered)))
    else:
        print(f"{out}: {recovered}")
        for topic, count in sorted(recovered.topics.items()):
            print(f"  {count:8d}  {topic}")


@app.command()
def adapt(
    model: Annotated[Path, typer.Argument(metavar="MODEL.onnx", help="A network made elsewhere.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.onnx", help="The same, with a contract.")],
    kind: Annotated[str, typer.Option(help="features, retrieval or matcher.")],
    name: Annotated[str | None, typer.Option(help="For people; the file's by default.")] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(metavar="TENSOR=NAME", help="What the file calls a tensor of the contract."),
    ] = None,
    layout: Annotated[str | None, typer.Option(help="dense or sparse.")] = None,
    descriptor_dim: Annotated[int | None, typer.Option(help="Of the local descriptors.")] = None,
    global_dim: Annotated[int | None, typer.Option(help="Of the global descriptor.")] = None,
    channels: Annotated[int | None, typer.Option(help="1 or 3.")] = None,
    normalization: Annotated[
        str | None, typer.Option(help="standardize, unit, imagenet or raw.")
    ] = None,
    multiple_of: Annotated[int | None, typer.Option(help="Of height and width.")] = None,
    long_side_px: Annotated[int | None, typer.Option(help="Larger images are scaled down.")] = None,
    height: Annotated[int | None, typer.Option(help="Of a retrieval network's input.")] = None,
    width: Annotated[int | None, typer.Option(help="Of a retrieval network's input.")] = None,
    min_score: Annotated[float | None, typer.Option(help="Of a keypoint or a match.")] = None,
    keypoints: Annotated[str | None, typer.Option(help="px, normalized or centered.")] = None,
    as_json: Json = False,
) -> None:
    """Make a network fit in: check what it is said to be, and write that into it."""
    options = {
        key: value
        for key, value in locals().items()
        if key not in ("model", "out", "rename", "as_json") and value is not None
    }
    names = dict(_split_names(rename or []))
    contract, found = adapt_model(model, out, {"name": model.stem, "names": names} | options)
    if as_json:
        print(json.dumps({"model": str(out), "contract": contract.model_dump(), "found": found}))
    else:
        print(f"{out}: {contract.kind}, {found} in a trial")


def _split_names(renames: list[str]) -> Iterator[tuple[str, str]]:
    for rename in renames:
        tensor, separator, name = rename.partition("=")
        if not (tensor and separator and name):
            raise ConfigError(f"--rename wants TENSOR=NAME, such as image=input, not {rename!r}")
        yield tensor, name


@app.command("quantize")
def quantize_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL.onnx", help="A float feature network.")],
    images: Annotated[Path, typer.Option(help="Folder of images like those it will see.")],
    out: Annotated[
        Path | None, typer.Option(help="The INT8 network; MODEL.int8.onnx by default.")
    ] = None,
    colmap: Annotated[
        Path | None, typer.Option(help="A COLMAP model of the images: poses count on them, too.")
    ] = None,
    max_loss: Annotated[
        float, typer.Option(help="Of fp32's matching score or pose accuracy.", min=0, max=1)
    ] = 0.02,
    pairs: Annotated[
        int, typer.Option(help="To compare on; more pairs, less noise.", min=12)
    ] = 120,
    float_layers: Annotated[
        bool, typer.Option(help="Leave in float what loses too much; without: all is INT8.")
    ] = True,
    as_json: Json = False,
) -> None:
    """Make a feature network INT8, compare it with fp32, and write it if little is lost."""
    from trigpoint_db.quantize import QuantizationOptions, quantize  # imports onnx, an extra

    out = model.with_suffix(".int8.onnx") if out is None else out
    options = QuantizationOptions(
        max_loss=max_loss, keep_float=float_layers, num_warped=pairs, num_rendered=2 * pairs
    )
    paths = [images / name for name in _image_names(images)]
    posed = None if colmap is None else (read_model(colmap), images)
    report = quantize(model, paths, out, options=options, posed=posed, track=track)
    if as_json:
        print(json.dumps(report.to_json()))
    else:
        report.print_table(console)
    if report.refusal is not None:
        raise ConfigError(f"{out} is not written: {report.refusal}")
    if not as_json:
        print(f"{out}: {report.num_bytes[1]} bytes")


@app.command("export-oak")
def export_oak_command(
    model: Annotated[str, typer.Argument(help="tiny, base, large, or a file (.onnx).")],
    out: Annotated[Path, typer.Argument(metavar="OUT.tar.xz", help="The archive.")],
    height: Annotated[int, typer.Option(help="Of the image on the device.", min=1)] = 480,
    width: Annotated[int, typer.Option(help="Of the image on the device.", min=1)] = 640,
    as_json: Json = False,
) -> None:
    """Write a feature network as an NN Archive, for Luxonis cameras (docs/oak.md)."""
    from trigpoint_db.export_oak import export_oak  # imports onnx, an extra

    config = export_oak(find_model(model), out, height=height, width=width)
    if as_json:
        print(json.dumps({"archive": str(out), "config": config}))
    else:
        outputs = ", ".join(f"{o['name']} {o['shape']}" for o in config["model"]["outputs"])
        print(f"{out}: gray {width} x {height} to {outputs}")


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


def main() -> None:
    """Run the command; an error is one line and exit code 1."""
    # So that what is half done is cleaned up.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        app()
    except TrigpointError as error:
        sys.exit(f"trigpoint-db: {error}")
    except OSError as error:  # a folder that cannot be entered, a name too long, a full disk
        sys.exit(f"trigpoint-db: {error.filename or 'output'}: {error.strerror}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
