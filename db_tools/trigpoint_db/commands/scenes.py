"""The commands `trigpoint-db experiment ...` on public benchmarks, and on retrieval."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.errors import ConfigError
from trigpoint.models.features import FeatureModel
from trigpoint.models.retrieval import RetrievalModel
from trigpoint_db.commands.experiments import DATA, RESULTS, ROOT, Output, open_store, publish
from trigpoint_db.experiments import recall, scenes
from trigpoint_db.experiments.benchmarks import read_benchmark
from trigpoint_db.experiments.sets import read_scenes, read_splits
from trigpoint_db.terminal import Json, Model, Retrieval

app = typer.Typer()

Root = Annotated[
    Path, typer.Option(metavar="DIR", help="The data set's folder, unpacked as docs/maps.md says.")
]
SceneNames = Annotated[
    list[str] | None, typer.Option("--scene", help="Only this one; several may be given.")
]
Anchors = Annotated[int, typer.Option(help="How many to retrieve.", min=2)]


@app.command("7scenes")
def seven_scenes_command(
    root: Root,
    scene: SceneNames = None,
    output: Output = RESULTS,
    anchors: Anchors = 20,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """7-Scenes: chess/ and the others; pgt/ beside them has the second ground truth."""
    _measure("7scenes", root, scene or (), output, anchors, model, retrieval, as_json)


@app.command("cambridge")
def cambridge_command(
    root: Root,
    scene: SceneNames = None,
    output: Output = RESULTS,
    anchors: Anchors = 20,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Cambridge Landmarks: KingsCollege/ and the others."""
    _measure("cambridge", root, scene or (), output, anchors, model, retrieval, as_json)


@app.command("aachen")
def aachen_command(
    root: Root,
    output: Output = RESULTS,
    anchors: Anchors = 20,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """Aachen Day-Night v1.1: what is localized, and the file to submit."""
    _measure("aachen", root, (), output, anchors, model, retrieval, as_json)


@app.command("robotcar")
def robotcar_command(
    root: Root,
    output: Output = RESULTS,
    anchors: Anchors = 20,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """RobotCar Seasons: what is localized, and the file to submit."""
    _measure("robotcar", root, (), output, anchors, model, retrieval, as_json)


@app.command("redkitchen")
def redkitchen_command(
    data: Annotated[Path, DATA],
    output: Output = RESULTS,
    anchors: Anchors = 20,
    model: Model = "base",
    retrieval: Retrieval = None,
    as_json: Json = False,
) -> None:
    """One sequence of 7-Scenes' RedKitchen, beside what is published of the scene."""
    _measure("redkitchen", data, (), output, anchors, model, retrieval, as_json)


def _measure(
    name: str,
    root: Path,
    names: Sequence[str],
    output: Path,
    anchors: int,
    model: str,
    retrieval: Path | None,
    as_json: bool,
) -> None:
    found, store = read_benchmark(name, root, names), open_store(output)
    network = FeatureModel.load(model, retrieval=retrieval)
    publish(name, scenes, scenes.measure(name, found, network, anchors, store), store, as_json)


@app.command("recall")
def recall_command(
    data: Annotated[Path | None, DATA] = None,
    root: Annotated[Path | None, ROOT] = None,
    output: Output = RESULTS,
    anchors: Anchors = 20,
    queries: Annotated[int, typer.Option(help="Of each set, at the most.", min=1)] = 100,
    model: Model = "base",
    retrieval: Annotated[
        Path | None, typer.Option(help="Another retrieval network, to compare with.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Count the retrieved images that see what the query sees, in a rendered room and elsewhere."""
    splits = {} if data is None else read_splits(data)
    sets = {name: dataset for name, dataset in splits.items() if name.endswith(", block")}
    if data is not None and not sets:
        raise ConfigError(
            f"no set in {data} has map_block.txt and queries_block.txt, the names of a split by "
            "blocks: retrieval is measured on these, as other splits have neighbours of each query "
            "in the map"
        )
    sets |= {} if root is None else read_scenes(root)
    external = None if retrieval is None else RetrievalModel.load(retrieval)
    store, network = open_store(output), FeatureModel.load(model)
    result = recall.measure(sets, network, external, anchors, queries, store)
    publish("recall", recall, result, store, as_json)
