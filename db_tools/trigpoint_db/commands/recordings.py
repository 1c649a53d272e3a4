"""Commands on recordings and logs: `trigpoint-db record`, `recover`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint_db.build import (
    check_files,
)
from trigpoint_db.evaluate import read_truth
from trigpoint_db.poses import (
    Query,
    read_queries,
)
from trigpoint_db.recording import RecordedImage, list_images, write_recording
from trigpoint_db.recover import recover
from trigpoint_db.terminal import (
    Json,
    track,
)

app = typer.Typer()


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
        wanted = [Query(name, common) for name in list_images(images)]
    poses = {} if truth is None else read_truth(truth)
    if truth is not None and not any(query.name in poses for query in wanted):
        raise ConfigError(f"{truth} has no pose of any of the images")
    recorded = [RecordedImage(images / q.name, q.camera, poses.get(q.name)) for q in wanted]
    count = write_recording(out, track(recorded, "recording", len(recorded)), rate_hz=rate)
    if as_json:
        print(json.dumps({"recording": str(out), "num_images": count, "rate_hz": rate}))
    else:
        print(f"{out}: {count} images, {count / rate:.1f} s")


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
