"""The commands of `trigpoint-db` on data sets, and the options that name one."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.errors import ConfigError
from trigpoint.output import check_output
from trigpoint_db.build import select_images
from trigpoint_db.importers.base import Dataset
from trigpoint_db.importers.registry import IMPORTERS, read_dataset
from trigpoint_db.poses import read_names, read_poses, write_poses, write_queries
from trigpoint_db.public_sets import PUBLIC_SETS
from trigpoint_db.submit import BENCHMARKS, write_submission
from trigpoint_db.terminal import Json

app = typer.Typer()
Source = Annotated[Path, typer.Argument(metavar="SOURCE", help="A data set's folder or file.")]
Format = Annotated[
    str | None,
    typer.Option("--format", help=f"{', '.join(IMPORTERS)}; found out by default."),
]
Images = Annotated[
    Path | None, typer.Option(help="Folder of the images, where it is not the format's own.")
]
Poses = Annotated[
    Path | None, typer.Option(help="Poses: a file for hloc, a folder of others' for 7scenes.")
]
Camera = Annotated[
    str | None, typer.Option(help="Of tum: its name, or 'MODEL width height params...'.")
]
ImageTopic = Annotated[str | None, typer.Option(help="Of mcap: one of several cameras.")]
PoseTopic = Annotated[str | None, typer.Option(help="Of mcap: one of several sources.")]
Mount = Annotated[
    str | None,
    typer.Option(
        metavar="'X Y Z QW QX QY QZ'|FRAME",
        help="Of mcap: where the camera sits on what the poses are of, or the frame of that.",
    ),
]
MaxGap = Annotated[
    float | None,
    typer.Option(help="Of tum, euroc, mcap: seconds between two poses, at most.", min=0),
]
NameList = Annotated[Path | None, typer.Option("--list", help="Only these names.")]
SkipExisting = Annotated[
    bool, typer.Option("--skip-existing", help="Leave out images that the map has.")
]


@dataclass(frozen=True)
class Survey:
    """The options that name a data set to map."""

    source: Source
    format_: Format = None
    images: Images = None
    poses: Poses = None
    camera: Camera = None
    image_topic: ImageTopic = None
    pose_topic: PoseTopic = None
    mount: Mount = None
    max_gap: MaxGap = None
    list_: NameList = None

    def read(self) -> Dataset:
        """Read it, and keep of the images to map those of the list; none is an error."""
        options = asdict(self)
        source, format_, list_ = (options.pop(name) for name in ("source", "format_", "list_"))
        dataset = read_dataset(source, format_, **options)
        if list_ is not None:
            dataset = replace(dataset, mapped=select_images(dataset.mapped, read_names(list_)))
        if not dataset.mapped:
            where = f"{list_} names none" if list_ else f"{source} has none with a pose"
            raise ConfigError(f"there are no images to map: {where}")
        return dataset


@app.command("queries")
def queries_command(
    source: Source,
    out: Annotated[Path, typer.Argument(metavar="OUT.txt", help="The list for `localize`.")],
    truth: Annotated[
        Path | None, typer.Option(help="Write their true poses, for `evaluate`.")
    ] = None,
    select: Annotated[
        str | None, typer.Option(metavar="PATTERN", help="Only such names: 'query/night/*'.")
    ] = None,
    format_: Format = None,
    images: Images = None,
    poses: Poses = None,
    as_json: Json = False,
) -> None:
    """Write the queries of a data set and, where they are public, their true poses."""
    inputs = [path for path in (source, poses) if path is not None]
    check_output(out, *inputs)
    check_output(truth, *inputs, out)
    dataset = read_dataset(source, format_, images=images, poses=poses)
    for output in (out, truth):
        for folder in (source, dataset.images):
            if output and output.exists() and output.resolve().is_relative_to(folder.resolve()):
                raise ConfigError(
                    f"cannot write {output}: it may be a file of the data set, in whose folder it "
                    "is; remove it first, or name another"
                )
    queries = [q for q in dataset.queries if fnmatchcase(q.name, select or "*")]
    if not queries:
        which = f" like {select!r}" if select and dataset.queries else ""
        raise ConfigError(f"{source} has no queries{which}")
    known = {q.name: dataset.truth[q.name] for q in queries if q.name in dataset.truth}
    if truth is not None and not known:
        raise ConfigError(f"no true poses of these queries are in {source}; leave out --truth")
    write_queries(out, queries)
    if truth is not None:
        write_poses(truth, known)
    if as_json:
        facts = {"num_queries": len(queries), "num_true_poses": len(known)}
        print(json.dumps({"queries": str(out), "images": str(dataset.images)} | facts))
    else:
        print(f"{out}: {len(queries)} queries, {len(known)} true poses; --images {dataset.images}")


@app.command()
def submit(
    benchmark: Annotated[str, typer.Argument(help=f"{' or '.join(BENCHMARKS)}.")],
    poses: Annotated[Path, typer.Argument(metavar="POSES", help="What `localize` wrote.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to submit.")],
    as_json: Json = False,
) -> None:
    """Write poses as a public benchmark takes them (visuallocalization.net)."""
    check_output(out, poses)
    estimates = read_poses(poses)
    if not estimates:
        raise ConfigError(f"there is no pose in {poses}")
    write_submission(benchmark, estimates, out)
    if as_json:
        print(json.dumps({"submission": str(out), "num_poses": len(estimates)}))
    else:
        print(f"{out}: {len(estimates)} poses")


@app.command()
def datasets(as_json: Json = False) -> None:
    """Say of each public data set where its owner offers it, under which terms, and the import."""
    if as_json:
        print(json.dumps([asdict(public) for public in PUBLIC_SETS]))
        return
    for public in PUBLIC_SETS:
        print(f"{public.title}\n  from    {public.url}\n  terms   {public.terms}")
        print(f"  unpack  {public.layout}\n  import  {public.command}\n")
