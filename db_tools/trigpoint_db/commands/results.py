"""Commands on queries: `trigpoint-db localize`, `evaluate`."""

from __future__ import annotations

import json
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Failed
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import load_matcher
from trigpoint.options import LocalizerOptions
from trigpoint.output import check_output, open_text
from trigpoint_db.build import (
    check_files,
)
from trigpoint_db.evaluate import evaluate, plot_paths, read_truth
from trigpoint_db.figures import check_picture
from trigpoint_db.latency import print_latency, read_stage_times, summarize_latency
from trigpoint_db.localize import localize_images
from trigpoint_db.methods.baseline import Baseline
from trigpoint_db.methods.registry import MethodName
from trigpoint_db.poses import (
    read_names,
    read_poses,
    read_priors,
    read_queries,
    write_poses,
)
from trigpoint_db.terminal import (
    Json,
    MapPath,
    Model,
    Retrieval,
    console,
    track,
)

app = typer.Typer()


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
    method: Annotated[
        MethodName, typer.Option(help="The localizer, latent-points, or one to compare it with.")
    ] = MethodName.LATENT_POINTS,
    as_json: Json = False,
) -> None:
    """Localize images; OK poses go to a file, what came of every query to another."""
    wanted = read_queries(queries)
    inputs = [map_, queries, images, *([priors] if priors else [])]
    inputs += [images / query.name for query in wanted]
    check_output(poses, *inputs)
    check_output(results, *inputs, poses, in_place=True)
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
            raise ConfigError(f"{map_} holds no images; add some: trigpoint-db add")
        localizer = Localizer(network, reader, options, time.perf_counter, matching)
        is_own = method == MethodName.LATENT_POINTS
        solver = localizer if is_own else Baseline(method, localizer)
        lines = None if results is None else stack.enter_context(open_text(results))
        localized = localize_images(solver, wanted, images, around)
        outcomes = []
        for outcome in track(localized, "localizing", len(wanted)):
            outcomes.append(outcome)
            if lines is not None:
                lines.write(json.dumps(outcome.describe()) + "\n")
    found = {o.name: o.cam_from_world for o in outcomes if o.cam_from_world is not None}
    write_poses(poses, found)
    counts = Counter(outcome.summarize() for outcome in outcomes)
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
    check_picture(picture, poses, *(p for p in (truth, queries, log) if p is not None))
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
            print(f"picture: {picture}")
