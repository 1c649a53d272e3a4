"""The commands `trigpoint-db experiment ...`: the paper's experiments, and ours."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from trigpoint_db.experiments import noise
from trigpoint_db.experiments.page import write_page
from trigpoint_db.experiments.store import Store
from trigpoint_db.terminal import Json

app = typer.Typer(help="The paper's experiments: measure, and write tables and pictures.")

Output = Annotated[
    Path, typer.Option(metavar="DIR", help="Results, and the pictures of them; made if missing.")
]
Data = Annotated[
    Path,
    typer.Option(metavar="DIR", help="Folders with images/, sparse/, map.txt and queries.txt."),
]
RESULTS = Path("experiments")


class Experiment(Protocol):
    """A module of this package."""

    def write_table(self, result: Mapping[str, Any], /) -> str:
        """Write what a result says, as Markdown."""

    def draw(self, result: Mapping[str, Any], path: Path, /) -> None:
        """Draw it."""


def publish(
    name: str, experiment: Experiment, result: Mapping[str, Any], store: Store, as_json: bool
) -> None:
    """Keep a result, print it, and draw it."""
    path = store.write(name, result)
    print(json.dumps(result) if as_json else experiment.write_table(result))
    experiment.draw(result, path.with_suffix(".png"))


@app.command("noise")
def noise_command(
    output: Output = RESULTS,
    trials: Annotated[int, typer.Option(help="At each level of noise.", min=20)] = 400,
    as_json: Json = False,
) -> None:
    """Synthetic cameras: how center and translation averaging stand noise (the paper's figure)."""
    store = Store(output)
    publish("noise", noise, noise.measure(trials, store), store, as_json)


@app.command()
def page(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="What was measured.")],
    docs: Annotated[
        Path, typer.Argument(metavar="DOCS", help="Gets experiments.md, results, pictures.")
    ],
    as_json: Json = False,
) -> None:
    """Write a page of all results: new ones, and those that the page has already."""
    path = write_page(results, docs)
    print(json.dumps({"page": str(path)}) if as_json else path)
