"""Commands on maps that are in use: `trigpoint-db info`, `remove`, `merge` and so on."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from trigpoint.database.index import MIN_ROWS
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import compact_map
from trigpoint.errors import ConfigError
from trigpoint_db.calibrate import describe_noise
from trigpoint_db.maps import (
    Difference,
    compare_maps,
    count_sessions,
    find_session,
    merge_maps,
    remove_images,
    split_map,
)
from trigpoint_db.poses import read_names
from trigpoint_db.terminal import (
    Json,
    MapPath,
    MapProfile,
    console,
    track,
)
from trigpoint_db.usage import Usage, count_usage, find_unused

app = typer.Typer()
NewMap = Annotated[Path, typer.Option("--out", "-o", help="The new map.")]


@app.command()
def remove(
    map_: MapPath,
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...")] = None,
    list_: Annotated[Path | None, typer.Option("--names", help="A file of names.")] = None,
    session: Annotated[str | None, typer.Option(help="All images of this session.")] = None,
    as_json: Json = False,
) -> None:
    """Remove images from a map, all or none of them; `compact` gives their space back."""
    listed = [] if list_ is None else read_names(list_)
    of_session = [] if session is None else find_session(map_, session)
    unwanted = list(dict.fromkeys([*(names or []), *listed, *of_session]))
    if not unwanted and list_ is None:
        raise ConfigError("there is nothing to remove: give names, --names FILE or --session NAME")
    remove_images(map_, unwanted)
    if as_json:
        print(json.dumps({"map": str(map_), "num_images_removed": len(unwanted)}))
    else:
        print(f"{map_}: {len(unwanted)} image{'s' * (len(unwanted) != 1)} removed")


@app.command()
def merge(
    map_a: Annotated[Path, typer.Argument(metavar="A", help="A map.")],
    map_b: Annotated[Path, typer.Argument(metavar="B", help="Another one, in the same frame.")],
    out: NewMap,
    prefix: Annotated[str, typer.Option(help="Put before the names of B's images.")] = "",
    as_json: Json = False,
) -> None:
    """Make one map of two that were made with the same network."""
    count = merge_maps(
        map_a, map_b, out, prefix=prefix, track=lambda part: track(part, "merging", len(part))
    )
    if as_json:
        print(json.dumps({"map": str(out), "num_images": count}))
    else:
        print(f"{out}: {count} images; how well their poses agree: trigpoint-db calibrate {out}")


@app.command()
def split(
    map_: MapPath,
    box: Annotated[
        str, typer.Option(help="xmin,ymin,zmin,xmax,ymax,zmax of camera centers, in its unit.")
    ],
    out: NewMap,
    as_json: Json = False,
) -> None:
    """Make a map of the images that were taken within a box."""
    try:
        corners = [float(number) for number in box.split(",")]
    except ValueError:
        corners = []
    if len(corners) != 6:
        raise ConfigError(f"--box wants xmin,ymin,zmin,xmax,ymax,zmax, not {box!r}")
    count = split_map(map_, corners, out, track=lambda part: track(part, "splitting", len(part)))
    if as_json:
        print(json.dumps({"map": str(out), "num_images": count}))
    else:
        print(f"{out}: {count} images")


@app.command()
def compact(
    map_: MapPath,
    profile: MapProfile = None,
    index: Annotated[
        bool | None,
        typer.Option(
            "--index/--no-index",
            help=f"An index of the images; by default from {MIN_ROWS} on, or as it was.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Rewrite a map, under those that have it open: smaller, and faster to search.

    The space of removed images is given back. With `--profile compact` an image takes a third of
    the space, for good.
    """
    before = map_.stat().st_size if map_.is_file() else 0
    compact_map(
        map_, profile=profile, index=index, track=lambda part: track(part, "compacting", len(part))
    )
    after = map_.stat().st_size
    if as_json:
        print(json.dumps({"map": str(map_), "bytes_before": before, "bytes": after}))
    else:
        print(f"{map_}: {before / 1e6:.1f} MB before, {after / 1e6:.1f} MB now")


@app.command()
def diff(
    map_a: Annotated[Path, typer.Argument(metavar="A", help="A map.")],
    map_b: Annotated[Path, typer.Argument(metavar="B", help="Another one.")],
    as_json: Json = False,
) -> None:
    """Say what B has more (+) than A, has not (-), and has changed (~)."""
    found = compare_maps(map_a, map_b)
    if as_json:
        print(json.dumps(asdict(found)))
    else:
        print_difference(found)


def print_difference(found: Difference) -> None:
    """Print a line for each image that is not the same in both maps, and one of counts."""
    for sign, names in (("+", found.added), ("-", found.removed)):
        for name in names:
            print(f"{sign} {name}")
    for change in found.changed:
        details = {
            "pose": f"moved by {change.distance:.3g} and {change.angle_deg:.3g} degrees",
            "camera": "another camera",
            "features": "other features",
            "session": "session {} was {}".format(*(s or "none" for s in change.sessions[::-1])),
        }
        print(f"~ {change.name}: {', '.join(details[what] for what in change.what)}")
    print(
        f"{len(found.added)} added, {len(found.removed)} removed, {len(found.changed)} changed, "
        f"{found.num_same} the same"
    )


@app.command()
def usage(
    map_: MapPath,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="The daemon's MCAP logs.")],
    unused: Annotated[
        bool, typer.Option("--unused", help="Print only names of images without use.")
    ] = False,
    min_frames: Annotated[
        int, typer.Option(help="Frames localized near an image without its use.", min=1)
    ] = 10,
    as_json: Json = False,
) -> None:
    """Say how often the images of a map were retrieved for a frame, and supported its pose.

    `--unused > FILE` and `remove MAP --names FILE` drop those that are stale: retrieved for at
    least --min-frames frames that were localized, always by other images.
    """
    with MapReader.open(map_) as reader:
        names = reader.names()
        sessions = ["" if s is None else str(s) for s in reader.sessions_by_index()]
    counted, num_frames = count_usage(logs)
    without_use = find_unused(counted, names, min_frames)
    if unused:
        for line in [json.dumps(without_use)] if as_json else without_use:
            print(line)
        return
    by_image = {name: counted.get(name, Usage()) for name in names}
    by_session: dict[str, Usage] = {}
    for name, session in zip(names, sessions, strict=True):
        by_session.setdefault(session, Usage()).add(by_image[name])
    if as_json:
        facts: dict[str, Any] = {"num_frames": num_frames, "num_unused": len(without_use)}
        of_all = {"sessions": by_session, "images": by_image}
        for what, of in of_all.items():
            facts[what] = [{"name": name, **asdict(used)} for name, used in of.items()]
        print(json.dumps(facts))
        return
    print_usage("session", by_session, Counter(sessions))
    print_usage("image", {name: used for name, used in by_image.items() if used.num_retrieved})
    print(
        f"{num_frames} frames; {sum(u.num_retrieved == 0 for u in by_image.values())} images were "
        f"not retrieved, {len(without_use)} are without use (--unused)"
    )


def print_usage(what: str, used: dict[str, Usage], num_images: Counter[str] | None = None) -> None:
    """Print a table of sessions or images."""
    table = Table()
    table.add_column(what)
    columns = ["retrieved", "in localized frames", "supported a pose"]
    for heading in (["images"] if num_images else []) + columns:
        table.add_column(heading, justify="right")
    for name, of_name in used.items():
        counts = [num_images[name]] if num_images else []
        counts += [of_name.num_retrieved, of_name.num_localized, of_name.num_supported]
        table.add_row(escape(name) or "none", *map(str, counts))
    console.print(table)


@app.command()
def info(map_: MapPath, as_json: Json = False) -> None:
    """Say what a map holds."""
    with MapReader.open(map_) as reader:
        noise = reader.pose_noise
        centers = reader.poses().center
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
            "pose_noise": noise and asdict(noise),
            "sessions": [
                {
                    "name": session and session.name,
                    "date": session and session.date and session.date.isoformat(),
                    "num_images": count,
                }
                for session, count in count_sessions(reader).items()
            ],
            "bytes": map_.stat().st_size,
            "min_center": centers.min(axis=0).tolist() if len(centers) else None,
            "max_center": centers.max(axis=0).tolist() if len(centers) else None,
        }
    if as_json:
        print(json.dumps(facts))
        return
    table = Table(show_header=False)
    table.add_row("images", str(facts["num_images"]))
    for session in facts["sessions"]:
        about = f"of session {session['name']}" if session["name"] else "of no session"
        table.add_row(escape(f"  {about} {session['date'] or ''}"), str(session["num_images"]))
    each = facts["bytes"] / 1e3 / max(facts["num_images"], 1)
    table.add_row("size", f"{facts['bytes'] / 1e6:.1f} MB, {each:.1f} kB an image")
    table.add_row("profile", f"{facts['profile']}, {'an' if facts['has_index'] else 'no'} index")
    table.add_row("network", escape(f"{facts['model']} ({facts['model_sha256'][:12]})"))
    table.add_row("generation", str(facts["generation"]))
    if len(centers):
        box = ",".join(f"{x:.4g}" for x in [*centers.min(axis=0), *centers.max(axis=0)])
        table.add_row("cameras in the box", box)
    table.add_row("poses", describe_noise(noise))
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
        number = f"{len(problems) or 'no'} problem{'s' * (len(problems) != 1)}"
        print(f"{map_}: {count} images, {number}")
    if problems:
        raise typer.Exit(1)
