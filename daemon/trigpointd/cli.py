"""The command `trigpointd`."""

from __future__ import annotations

import asyncio
import faulthandler
import json
import logging
import os
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import threadpoolctl
import typer
from pydantic import ValidationError

from trigpoint.errors import TrigpointError
from trigpoint.models.features import find_model
from trigpoint.output import check_output, check_place, open_text
from trigpoint.poses import format_pose
from trigpointd.config import (
    Config,
    LogConfig,
    McapConfig,
    ModelConfig,
    ZenohConfig,
    explain,
    load_config,
)
from trigpointd.pipeline import open_pipeline
from trigpointd.service import open_source, run
from trigpointd.session import load_settings, make_settings, set_endpoints
from trigpointd.sinks.foxglove import import_sdk
from trigpointd.sinks.log_files import LogFiles
from trigpointd.sources.depthai import is_opening
from trigpointd.watch import Received, subscribe

app = typer.Typer(
    help="Trigpoint: where is this camera, from its pictures and a map.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback()
def _set_up(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say more.")] = False,
) -> None:
    # Several threads win a few per cent in matrix products this small, and lose tenfold where
    # another program holds a core, since OpenBLAS's threads spin while they wait for each other.
    threadpoolctl.threadpool_limits(1, user_api="blas")
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="trigpointd: %(message)s",
        stream=sys.stderr,
    )


@app.command("run")
def run_command(
    config: Annotated[Path, typer.Option(help="Settings, a TOML file.")],
) -> None:
    """Localize frames and publish poses, until the recording ends or SIGTERM comes.

    SIGHUP takes up the settings, the networks and the map anew, but for source and outputs.
    """
    faulthandler.enable()  # systemd's watchdog ends a hang by SIGABRT: where it hung is then said
    totals = run(load_config(config), read=partial(load_config, config))
    logging.getLogger(__name__).info("%s", totals)
    if is_opening():  # all else has ended
        os._exit(0)


@app.command()
def check_config(config: Annotated[Path, typer.Argument(help="Settings, a TOML file.")]) -> None:
    """Check the settings; open the network, the map and the source, but nothing for writing."""
    settings = load_config(config)
    if settings.zenoh is not None:
        make_settings(settings.zenoh)
    if settings.log is not None:
        check_place(LogFiles(settings.log.path).unnumbered())
    if settings.foxglove is not None:
        import_sdk()
    with open_pipeline(settings):
        source = open_source(settings)
        print(source.describe())
        asyncio.run(source.close())
    print(f"{config}: good")


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="An MCAP recording, or a log.")],
    map_: Annotated[Path, typer.Option("--map", help="The map.")],
    log: Annotated[Path | None, typer.Option(help="Write an MCAP log.")] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Write `time_ns qw qx qy qz tx ty tz`, cam_from_world.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="The images' topic.")] = None,
    rate: Annotated[
        float | None, typer.Option(help="Of the recorded pace; as fast as it goes by default.")
    ] = None,
    start: Annotated[float, typer.Option(help="Seconds since the first image.")] = 0.0,
    end: Annotated[float | None, typer.Option(help="The same; the last by default.")] = None,
    model: Annotated[str, typer.Option(help="tiny, base, large, or a file (.onnx).")] = "base",
    retrieval: Annotated[
        Path | None, typer.Option(help="A retrieval network, where the other needs one.")
    ] = None,
    matcher: Annotated[
        Path | None, typer.Option(help="A matching network; mutual nearest neighbours by default.")
    ] = None,
) -> None:
    """Localize every frame of a recording."""
    config = Config(
        map=map_,
        source=McapConfig(
            type="mcap", path=recording, image_topic=topic, rate=rate, start_s=start, end_s=end
        ),
        model=ModelConfig(network=find_model(model), retrieval=retrieval, matcher=matcher),
        log=None if log is None else LogConfig(path=log),
    )
    totals = run(config, poses=poses)
    print(f"{recording}: {totals}")


@app.command()
def watch(
    key: Annotated[str, typer.Option(help="Which poses.")] = "trigpoint/**/pose",
    connect: Annotated[list[str] | None, typer.Option(help="Endpoint to connect to.")] = None,
    listen: Annotated[list[str] | None, typer.Option(help="Endpoint to listen on.")] = None,
    zenoh: Annotated[
        Path | None, typer.Option(help="Zenoh's settings, a JSON5 file; for TLS, for one.")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Write `time_ns qw qx qy qz tx ty tz`, body_from_world.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON lines.")] = False,
    exit_with_daemon: Annotated[
        bool, typer.Option("--exit-with-daemon", help="End when the daemon leaves.")
    ] = False,
) -> None:
    """Print the last pose, then poses as they come over Zenoh, in their world frame."""
    if zenoh is None:
        settings = make_settings(ZenohConfig(multicast_scouting=not (connect or listen)))
    else:
        settings = load_settings(zenoh)
    set_endpoints(settings, "connect", tuple(connect or ()))
    set_endpoints(settings, "listen", tuple(listen or ()))
    check_output(poses, in_place=True)
    with ExitStack() as stack:
        arriving = stack.enter_context(subscribe(settings, key, exit_with_daemon=exit_with_daemon))
        file = None if poses is None else stack.enter_context(open_text(poses))
        for received in arriving:
            if isinstance(received, str):
                print(f"trigpointd: {received}", file=sys.stderr)
                continue
            print(_format_json(received) if as_json else _format(received), flush=True)
            if file is not None:
                pose = received.pose
                file.write(format_pose(str(pose.time_ns), pose.world_from_body.inverse()))


def _format(received: Received) -> str:
    pose = received.pose
    std_m = np.sqrt(np.diag(pose.covariance)[:3])
    x, y, z = pose.world_from_body.t
    w, qx, qy, qz = pose.world_from_body.quaternion
    return (
        f"{pose.time_ns / 1e9:.3f} {received.key}  {x:+8.3f} {y:+8.3f} {z:+8.3f} m "
        f"(std {np.linalg.norm(std_m) * 1e3:.1f} mm)  "
        f"wxyz {w:+.4f} {qx:+.4f} {qy:+.4f} {qz:+.4f}"
    )


def _format_json(received: Received) -> str:
    pose = received.pose
    return json.dumps(
        {
            "key": received.key,
            "time_ns": pose.time_ns,
            "frame_id": pose.frame_id,
            "position_m": pose.world_from_body.t.tolist(),
            "rotation_wxyz": pose.world_from_body.quaternion.tolist(),
            "covariance": pose.covariance.ravel().tolist(),
        }
    )


def main() -> None:
    """Run the command; an error is one line and exit code 1."""
    try:
        app()
    except TrigpointError as error:
        sys.exit(f"trigpointd: {error}")
    except ValidationError as error:  # of an option of `replay`
        sys.exit(f"trigpointd: {explain(error)}")
    except OSError as error:  # a folder that cannot be entered, a name too long, a full disk
        sys.exit(f"trigpointd: {error.filename or 'output'}: {error.strerror}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
