"""The commands of `trigpoint-db` on data sets, and the options that name one."""

from __future__ import annotations

import json
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.errors import ConfigError
from trigpoint.output import check_output
from trigpoint_db.importers.registry import IMPORTERS, read_dataset
from trigpoint_db.poses import read_poses, write_poses, write_queries
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
    for output in (out, truth):
        check_output(output, source)
    dataset = read_dataset(source, format_, images=images, poses=poses)
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
