"""Measure maps: their profiles, and retrieval in large ones.

    python -m benchmarks.maps DATA [--only profiles,retrieval] [--sizes 10000,100000,1000000]
        [--output FILE]

DATA holds a folder for each set, as for `benchmarks.localizer`. A million images need 2 GB of disk
and memory.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from benchmarks.localizer.__main__ import find_sets, say
from benchmarks.maps import profiles, retrieval, rows
from benchmarks.stage_times import describe_machine
from trigpoint.errors import TrigpointError
from trigpoint.models.features import FeatureModel
from trigpoint.output import check_output, open_text
from trigpoint_db.build import read_frame
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.importers.colmap import read_model

MIN_IMAGES = 40  # of a set that places are made of


def measure(arguments: argparse.Namespace) -> str:
    """Measure what was asked for: Markdown, as it stands in docs/maps.md."""
    folders, network = find_sets(arguments.data, arguments.sets), FeatureModel.load()
    parts = [f"{describe_machine()}."]
    if "profiles" in arguments.only:
        parts.append(profiles.report(folders, network))
        say("profiles are done")
    if "retrieval" in arguments.only:
        surveys = {folder.name: describe(folder, network) for folder in folders}
        surveys = {name: own for name, own in surveys.items() if len(own) >= MIN_IMAGES}
        quantiles = rows.compare(surveys, rows.Places(list(surveys.values())))
        parts.append(markdown(["cosine", "10 %", "50 %", "90 %"], quantiles))
        parts.append(retrieval.report(list(surveys.values()), arguments.sizes))
    return "\n\n".join(parts) + "\n"


def describe(folder: Path, network: FeatureModel) -> NDArray[np.float32]:
    """Return the global descriptors of a set's images, by name."""
    images = sorted(read_model(folder / "sparse"), key=lambda image: image.name)
    frames = (read_frame(folder / "images", i.name, i.camera) for i in images)
    return np.stack([network.extract(frame.image, 1).global_descriptor for frame in frames])


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.maps", description=__doc__.splitlines()[0]
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", type=lambda text: text.split(","), default="profiles,retrieval")
    parser.add_argument("--sets", help="names, with commas between")
    parser.add_argument(
        "--sizes",
        type=lambda text: [int(size) for size in text.split(",")],
        default="10000,100000,1000000",
    )
    parser.add_argument("--output", type=Path, help="Markdown")
    arguments = parser.parse_args()
    threadpoolctl.threadpool_limits(1, user_api="blas")
    try:
        check_output(arguments.output)
        report = measure(arguments)
        print(report)
        if arguments.output:
            with open_text(arguments.output) as file:
                file.write(report)
    except TrigpointError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
