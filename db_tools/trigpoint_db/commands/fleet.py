"""The commands `trigpoint-db publish` and `trigpoint-db fetch`."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.errors import ConfigError, TrigpointError
from trigpoint.output import check_output
from trigpoint_db.fleet.fetch import Fetched, fetch_map
from trigpoint_db.fleet.zenoh import Publisher, RemoteMap, check_key, open_session
from trigpoint_db.terminal import Json, MapPath, track

_LOOK_EVERY_S = 1.0  # for a new commit
_ASK_EVERY_S = 30.0  # where an announcement was missed

app = typer.Typer()
Connect = Annotated[list[str] | None, typer.Option(help="Endpoint to connect to.")]
Listen = Annotated[list[str] | None, typer.Option(help="Endpoint to listen on.")]
Zenoh = Annotated[
    Path | None, typer.Option(help="Zenoh's settings, a JSON5 file; for TLS, for one.")
]


@app.command()
def publish(
    map_: MapPath,
    key: Annotated[str, typer.Option(help="Such as trigpoint/maps/office.")],
    connect: Connect = None,
    listen: Listen = None,
    zenoh: Zenoh = None,
) -> None:
    """Offer a map, and each of its commits to come, to all that `fetch` it, until stopped."""
    check_key(key)
    with Publisher(open_session(zenoh, connect, listen), key, map_) as publisher:
        said = ""
        while True:
            facts, where = publisher.manifest, sys.stdout
            say = (
                f"{map_}: generation {facts.generation}, {facts.num_images} images, "
                f"{facts.num_bytes / 1e6:.1f} MB on {key}"
            )
            try:
                publisher.refresh()
            except TrigpointError as error:
                say = f"trigpoint-db: {error}; the last good state stays published"
                where = sys.stderr
            if say != said:
                print(say, file=where, flush=True)
                said = say
            time.sleep(_LOOK_EVERY_S)


@app.command()
def fetch(
    key: Annotated[str, typer.Argument(metavar="KEY", help="Such as trigpoint/maps/office.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The map, replaced as a whole.")],
    connect: Connect = None,
    listen: Listen = None,
    zenoh: Zenoh = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on with each new generation, until stopped.")
    ] = False,
    timeout: Annotated[
        float, typer.Option(help="Seconds without a chunk coming; with --watch, no limit.", min=1)
    ] = 60.0,
    as_json: Json = False,
) -> None:
    """Fetch a published map, or what has changed of it; a daemon that has it open takes it up."""
    check_output(out)
    if out.exists() and out.suffix != ".tpmap":  # a map that is damaged is replaced too
        raise ConfigError(
            f"cannot write {out}: it exists, and is no map by its name (.tpmap); remove it, or "
            "name another file"
        )
    check_key(key)
    session = open_session(zenoh, connect, listen)
    try:
        remote = RemoteMap(session, key)
        if not watch:
            fetched = fetch_map(remote, out, patience_s=timeout, track=track)
            _print(fetched, out, as_json=as_json)
            return
        said = ""
        while True:
            try:
                fetched = fetch_map(remote, out, patience_s=math.inf, track=track)
                said = ""
                if fetched.is_new:
                    _print(fetched, out, as_json=as_json)
            except TrigpointError as error:  # a full disk, a wrong chunk: the next try may do
                if str(error) != said:
                    said = str(error)
                    print(f"trigpoint-db: {said}; trying again", file=sys.stderr)
            remote.wait_for_news(_ASK_EVERY_S)
    finally:
        session.close()  # type: ignore[no-untyped-call]


def _print(fetched: Fetched, out: Path, *, as_json: bool) -> None:
    facts = fetched.manifest
    if as_json:
        counts = facts.model_dump(include={"num_bytes", "generation", "num_images", "model"})
        more = {"map": str(out), "num_bytes_fetched": fetched.num_bytes_fetched}
        print(json.dumps(more | counts), flush=True)
        return
    what = f"{fetched.num_bytes_fetched / 1e6:.1f} MB of it fetched" * fetched.is_new
    print(
        f"{out}: generation {facts.generation}, {facts.num_images} images, "
        f"{facts.num_bytes / 1e6:.1f} MB, {what or 'up to date'}",
        flush=True,
    )
