"""Commands on networks: `trigpoint-db adapt`, `quantize`, `export-oak`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from trigpoint.errors import ConfigError
from trigpoint.models.features import find_model
from trigpoint_db.adapt import adapt_model
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.recording import list_images
from trigpoint_db.terminal import (
    Json,
    console,
    track,
)

app = typer.Typer()


@app.command()
def adapt(
    model: Annotated[Path, typer.Argument(metavar="MODEL.onnx", help="A network made elsewhere.")],
    out: Annotated[Path, typer.Argument(metavar="OUT.onnx", help="The same, with a contract.")],
    kind: Annotated[str, typer.Option(help="features, retrieval or matcher.")],
    name: Annotated[str | None, typer.Option(help="For people; the file's by default.")] = None,
    rename: Annotated[
        list[str] | None,
        typer.Option(metavar="TENSOR=NAME", help="What the file calls a tensor of the contract."),
    ] = None,
    layout: Annotated[str | None, typer.Option(help="dense or sparse.")] = None,
    descriptor_dim: Annotated[int | None, typer.Option(help="Of the local descriptors.")] = None,
    global_dim: Annotated[int | None, typer.Option(help="Of the global descriptor.")] = None,
    channels: Annotated[int | None, typer.Option(help="1 or 3.")] = None,
    normalization: Annotated[
        str | None, typer.Option(help="standardize, unit, imagenet or raw.")
    ] = None,
    multiple_of: Annotated[int | None, typer.Option(help="Of height and width.")] = None,
    long_side_px: Annotated[int | None, typer.Option(help="Larger images are scaled down.")] = None,
    height: Annotated[int | None, typer.Option(help="Of a retrieval network's input.")] = None,
    width: Annotated[int | None, typer.Option(help="Of a retrieval network's input.")] = None,
    min_score: Annotated[float | None, typer.Option(help="Of a keypoint or a match.")] = None,
    keypoints: Annotated[str | None, typer.Option(help="px, normalized or centered.")] = None,
    as_json: Json = False,
) -> None:
    """Make a network fit in: check what it is said to be, and write that into it."""
    options = {
        key: value
        for key, value in locals().items()
        if key not in ("model", "out", "rename", "as_json") and value is not None
    }
    names = dict(_split_names(rename or []))
    contract, found = adapt_model(model, out, {"name": model.stem, "names": names} | options)
    if as_json:
        print(json.dumps({"model": str(out), "contract": contract.model_dump(), "found": found}))
    else:
        print(f"{out}: {contract.kind}, {found} in a trial")


def _split_names(renames: list[str]) -> Iterator[tuple[str, str]]:
    for rename in renames:
        tensor, separator, name = rename.partition("=")
        if not (tensor and separator and name):
            raise ConfigError(f"--rename wants TENSOR=NAME, such as image=input, not {rename!r}")
        yield tensor, name


@app.command("quantize")
def quantize_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL.onnx", help="A float feature network.")],
    images: Annotated[Path, typer.Option(help="Folder of images like those it will see.")],
    out: Annotated[
        Path | None, typer.Option(help="The INT8 network; MODEL.int8.onnx by default.")
    ] = None,
    colmap: Annotated[
        Path | None, typer.Option(help="A COLMAP model of the images: poses count on them, too.")
    ] = None,
    max_loss: Annotated[
        float, typer.Option(help="Of fp32's matching score or pose accuracy.", min=0, max=1)
    ] = 0.02,
    pairs: Annotated[
        int, typer.Option(help="To compare on; more pairs, less noise.", min=12)
    ] = 120,
    float_layers: Annotated[
        bool, typer.Option(help="Leave in float what loses too much; without: all is INT8.")
    ] = True,
    as_json: Json = False,
) -> None:
    """Make a feature network INT8, compare it with fp32, and write it if little is lost."""
    from trigpoint_db.quantize import QuantizationOptions, quantize  # imports onnx, an extra

    out = model.with_suffix(".int8.onnx") if out is None else out
    options = QuantizationOptions(
        max_loss=max_loss, keep_float=float_layers, num_warped=pairs, num_rendered=2 * pairs
    )
    paths = [images / name for name in list_images(images)]
    posed = None if colmap is None else (read_model(colmap), images)
    report = quantize(model, paths, out, options=options, posed=posed, track=track)
    if as_json:
        print(json.dumps(report.to_json()))
    else:
        report.print_table(console)
    if report.refusal is not None:
        raise ConfigError(f"{out} is not written: {report.refusal}")
    if not as_json:
        print(f"{out}: {report.num_bytes[1]} bytes")


@app.command("export-oak")
def export_oak_command(
    model: Annotated[str, typer.Argument(help="tiny, base, large, or a file (.onnx).")],
    out: Annotated[Path, typer.Argument(metavar="OUT.tar.xz", help="The archive.")],
    height: Annotated[int, typer.Option(help="Of the image on the device.", min=1)] = 480,
    width: Annotated[int, typer.Option(help="Of the image on the device.", min=1)] = 640,
    as_json: Json = False,
) -> None:
    """Write a feature network as an NN Archive, for Luxonis cameras (docs/oak.md)."""
    from trigpoint_db.export_oak import export_oak  # imports onnx, an extra

    config = export_oak(find_model(model), out, height=height, width=width)
    if as_json:
        print(json.dumps({"archive": str(out), "config": config}))
    else:
        outputs = ", ".join(f"{o['name']} {o['shape']}" for o in config["model"]["outputs"])
        print(f"{out}: gray {width} x {height} to {outputs}")
