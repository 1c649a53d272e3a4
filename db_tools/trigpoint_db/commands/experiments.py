"""The commands `trigpoint-db experiment ...`: the paper's experiments, and ours."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from trigpoint.errors import ConfigError
from trigpoint.models.features import FeatureModel
from trigpoint_db.experiments import ablation, anchors, averaging, methods, noise, timing
from trigpoint_db.experiments.page import write_page
from trigpoint_db.experiments.sets import read_scenes, read_splits, read_wholes
from trigpoint_db.experiments.store import Store, read_result
from trigpoint_db.figures import require_matplotlib
from trigpoint_db.terminal import Json, Model

app = typer.Typer(help="The paper's experiments: measure, and write tables and pictures.")

Output = Annotated[
    Path, typer.Option(metavar="DIR", help="Results, and the pictures of them; made if missing.")
]
DATA = typer.Option(
    "--data", metavar="DIR", help="Folders with images/, sparse/, map.txt and queries.txt."
)
ROOT = typer.Option(
    "--root", metavar="DIR", help="Scenes of 7-Scenes or Cambridge Landmarks, or one of them."
)
RESULTS = Path("experiments")


class Experiment(Protocol):
    """A module of this package."""

    def write_table(self, result: Mapping[str, Any], /) -> str:
        """Write what a result says, as Markdown."""

    def draw(self, result: Mapping[str, Any], path: Path, /) -> None:
        """Draw it."""


def open_store(output: Path) -> Store:
    """Open the folder of the results; without matplotlib, say so before the work and not after."""
    require_matplotlib()
    return Store(output)


def publish(
    name: str, experiment: Experiment, result: Mapping[str, Any], store: Store, as_json: bool
) -> None:
    """Keep a result; print and draw what was kept, so that its rounding is that of the page."""
    path = store.write(name, result)
    kept = read_result(path)
    print(json.dumps(kept) if as_json else experiment.write_table(kept))
    experiment.draw(kept, path.with_suffix(".png"))


@app.command("noise")
def noise_command(
    output: Output = RESULTS,
    trials: Annotated[int, typer.Option(help="At each level of noise.", min=20)] = 400,
    as_json: Json = False,
) -> None:
    """Synthetic cameras: how center and translation averaging stand noise (the paper's figure)."""
    store = open_store(output)
    publish("noise", noise, noise.measure(trials, store), store, as_json)


@app.command("averaging")
def averaging_command(
    data: Annotated[Path | None, DATA] = None,
    root: Annotated[Path | None, ROOT] = None,
    output: Output = RESULTS,
    num_anchors: Annotated[int, typer.Option("--anchors", help="For each query.", min=2)] = 20,
    queries: Annotated[int, typer.Option(help="Of each set, at the most.", min=1)] = 100,
    model: Model = "base",
    as_json: Json = False,
) -> None:
    """Center against translation averaging on real images (the paper's first table)."""
    if data is None and root is None:
        raise ConfigError("there is nothing to measure on: give --data or --root")
    sets = ({} if data is None else read_splits(data)) | ({} if root is None else read_scenes(root))
    store, network = open_store(output), FeatureModel.load(model)
    result = averaging.measure(sets, network, num_anchors, queries, store)
    publish("averaging", averaging, result, store, as_json)


@app.command("anchors")
def anchors_command(
    data: Annotated[Path, DATA],
    output: Output = RESULTS,
    sets: Annotated[int, typer.Option(help="So many of them, the largest.", min=1)] = 2,
    images: Annotated[int, typer.Option(help="Of each set, at the most.", min=1)] = 30,
    model: Model = "base",
    as_json: Json = False,
) -> None:
    """Error and time by the number of anchors, from 2 to 150 (the paper's figure "ksweep")."""
    wholes = sorted(read_wholes(data).items(), key=lambda item: -len(item[1].mapped))
    store, network = open_store(output), FeatureModel.load(model)
    result = anchors.measure(dict(wholes[:sets]), network, images, store)
    publish("anchors", anchors, result, store, as_json)


@app.command("methods")
def methods_command(
    data: Annotated[Path, DATA],
    output: Output = RESULTS,
    num_anchors: Annotated[int, typer.Option("--anchors", help="For each query.", min=2)] = 20,
    queries: Annotated[int, typer.Option(help="Of each set, at the most.", min=1)] = 10,
    model: Model = "base",
    as_json: Json = False,
) -> None:
    """Every method of `localize --method` on the same features, anchors and matches."""
    store, network = open_store(output), FeatureModel.load(model)
    result = methods.measure(read_splits(data), network, num_anchors, queries, store)
    publish("methods", methods, result, store, as_json)


@app.command("timing")
def timing_command(
    data: Annotated[Path, DATA],
    hloc: Annotated[
        Path | None, typer.Option(metavar="DIR", help="A checkout of hloc, to time beside ours.")
    ] = None,
    output: Output = RESULTS,
    queries: Annotated[int, typer.Option(help="Of all sets, at the most.", min=1)] = 20,
    model: Model = "base",
    as_json: Json = False,
) -> None:
    """Time by stage and bytes an image, with 20, 50 and 150 anchors (the paper's last table)."""
    sets = {name: split for name, split in read_splits(data).items() if ", " not in name}
    store, network = open_store(output), FeatureModel.load(model)
    result = timing.measure(sets, network, hloc, queries, store)
    publish("timing", timing, result, store, as_json)


@app.command("ablation")
def ablation_command(
    data: Annotated[Path, DATA],
    output: Output = RESULTS,
    queries: Annotated[int, typer.Option(help="Of each set and split, at the most.", min=1)] = 15,
    model: Model = "base",
    fp32: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Has MODEL.fp32.onnx, to compare INT8 with it."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Take back our departures from the paper, one after the other: what each brings."""
    sets, store, network = read_splits(data), open_store(output), FeatureModel.load(model)
    float_network = None
    if fp32 is not None:
        float_network = FeatureModel.load(str(fp32 / f"{network.identity.name}.fp32.onnx"))
    result = ablation.measure(sets, network, float_network, queries, store)
    publish("ablation", ablation, result, store, as_json)


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
