"""The page `docs/experiments.md`: a section for each experiment whose result is there."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from trigpoint.errors import ConfigError
from trigpoint.output import write_atomically
from trigpoint_db.experiments.store import read_result

# By the name of the result: what it is about, and the module of this package that writes it.
SECTIONS = {
    "noise": ("Noise", "noise"),
    "averaging": ("Center against translation averaging", "averaging"),
    "anchors": ("How many anchors", "anchors"),
    "redkitchen": ("RedKitchen", "scenes"),
    "7scenes": ("7-Scenes", "scenes"),
    "cambridge": ("Cambridge Landmarks", "scenes"),
    "aachen": ("Aachen Day-Night", "scenes"),
    "robotcar": ("RobotCar Seasons", "scenes"),
    "timing": ("Timing and storage", "timing"),
    "methods": ("Methods", "methods"),
    "recall": ("Retrieval", "recall"),
    "ablation": ("What each departure from the paper brings", "ablation"),
}
NUM_COLORS = 64
INTRODUCTION = """# The paper's experiments

What *Multiview Image-Based Localization* measures, measured again, beside the numbers that it
gives. Every number and every verdict on this page is computed: `make experiments` measures anew
what needs no public data set, and writes the page from the results in
[experiments/](experiments). `trigpoint-db experiment --help` lists the commands; one that was
interrupted goes on when it is given again.

The real images are those in `DATA`, a folder for each set with `images/`, a COLMAP model in
`sparse/`, and two splits: every fifth image is a query, or ("block") whole stretches are. Errors of
position are in metres for the kitchen, kitti and strecha, else in the model's unit. kitti's images
are stereo pairs: of most of its queries the map has the other one, taken at the same instant."""


def write_page(results: Path, docs: Path) -> Path:
    """Take over the results in a folder, and write the page of all that the docs have.

    In `docs` are then `experiments.md`, `experiments/*.json` and `images/experiments/*.png`.
    """
    if not results.is_dir():
        raise ConfigError(f"there is no folder {results}; name the one that has the results")
    kept, pictures = docs / "experiments", docs / "images" / "experiments"
    files = {
        name: path
        for name in SECTIONS
        for path in (kept / f"{name}.json", results / f"{name}.json")
        if path.is_file()
    }
    if not files:
        raise ConfigError(
            f"there is no result of an experiment in {results}; `trigpoint-db experiment noise "
            f"--output {results}` measures one"
        )
    # All is read and drawn before anything in docs changes: a damaged result replaces no good one.
    with tempfile.TemporaryDirectory() as scratch:
        sections = [_write_section_of(path, Path(scratch)) for path in files.values()]
        for folder in (kept, pictures):
            folder.mkdir(parents=True, exist_ok=True)
        for name, path in files.items():
            write_atomically(kept / path.name, path.read_text(encoding="utf-8"))
            shutil.copyfile(Path(scratch) / f"{name}.png", pictures / f"{name}.png")
    page = docs / "experiments.md"
    write_atomically(page, "\n\n".join([INTRODUCTION, *sections]) + "\n")
    return page


def _write_section_of(path: Path, pictures: Path) -> str:
    result = read_result(path)
    try:
        return write_section(path.stem, result, pictures)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path} is not the result of an experiment; measure it anew") from error


def write_section(name: str, result: Mapping[str, Any], pictures: Path) -> str:
    """Write a section, and draw its picture."""
    title, module = SECTIONS[name]
    experiment = import_module(f"trigpoint_db.experiments.{module}")
    picture = pictures / f"{name}.png"
    experiment.draw(result, picture)
    shrink(picture)
    return "\n\n".join(
        [
            f"## {title}",
            f"![{title}](images/experiments/{picture.name})",
            experiment.write_table(result),
            f"<sub>{describe_machine(result['machine'])}</sub>",
        ]
    )


def shrink(picture: Path) -> None:
    """Give a drawing a palette: a third of the size, and no difference that is seen."""
    from PIL import Image  # comes with matplotlib, an extra

    with Image.open(picture) as image:
        drawn = image.convert("RGB").quantize(NUM_COLORS)
    drawn.save(picture, optimize=True)


def describe_machine(machine: Mapping[str, Any]) -> str:
    """Name the machine that a result is of."""
    dot_products = "" if machine["has_8bit_dot_products"] else "no "
    versions = ", ".join(
        f"{name} {machine[name]}" for name in ("trigpoint", "numpy", "onnxruntime")
    )
    return (
        f"Measured on {machine['processor']}, {machine['num_cores']} cores, {dot_products}8-bit "
        f"dot products; Python {machine['python']}, {versions}."
    )
