"""Localization error on posed images, for every set and split in a folder.

    python benchmarks/accuracy.py ../shared/data [--anchors 20] [--model base]

Each set is a folder with `images/`, `sparse/` (a COLMAP model), and for each split `map*.txt`
(names) and `queries*.txt` (names with cameras). Failures count as infinite errors. The last column
is the share of localized queries whose true center lies inside the covariance's 95 % ellipsoid.
Then each set's block queries are tried in the maps of all other sets: none should get a pose.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import threadpoolctl

from trigpoint.database.reader import MapReader
from trigpoint.frame import Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.stages import LocalizerOptions
from trigpoint_db.build import build_map, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.evaluate import evaluate
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.localize import Outcome, localize_images
from trigpoint_db.poses import Query, read_names, read_queries

CHI2_95 = 7.815  # three degrees of freedom


def localize(
    folder: Path, split: str, queries: dict[Path, list[Query]], network: FeatureModel, anchors: int
) -> dict[Path, list[Outcome]]:
    """Build the map of a set and localize queries whose images are in several folders."""
    survey = select_images(read_model(folder / "sparse"), read_names(folder / f"map{split}.txt"))
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "map.tpmap"
        build_map(path, survey, folder / "images", network)
        calibrate_map(path, network)
        with MapReader.open(path, network.identity) as reader:
            localizer = Localizer(network, reader, LocalizerOptions(num_anchors=anchors))
            return {
                images: list(localize_images(localizer, wanted, images))
                for images, wanted in queries.items()
            }


def measure(folder: Path, split: str, network: FeatureModel, anchors: int) -> str:
    """One row of the table of errors."""
    queries = read_queries(folder / f"queries{split}.txt")
    images = folder / "images"
    outcomes = localize(folder, split, {images: queries}, network, anchors)[images]
    found = {o.name: o.result for o in outcomes if isinstance(o.result, Localized)}
    truth = {image.name: image.cam_from_world for image in read_model(folder / "sparse")}
    result = evaluate(
        {name: localized.cam_from_world for name, localized in found.items()},
        truth,
        [query.name for query in queries],
    )
    inside = []
    for name, localized in found.items():
        error = localized.cam_from_world.center - truth[name].center
        inside.append(error @ np.linalg.solve(localized.covariance[:3, :3], error) < CHI2_95)
    return (
        f"| {folder.name}{split.replace('_', ', ')} | {result.num_localized} of "
        f"{result.num_queries} | {result.median_position_m:.4f} | {result.p90_position_m:.4f} | "
        f"{result.median_rotation_deg:.3f} | {np.mean(inside):.2f} |"
    )


def count_strangers(
    folder: Path, others: list[Path], network: FeatureModel, anchors: int
) -> tuple[int, int]:
    """Count frames of other places, and those of them that were given a pose."""
    queries = {other / "images": read_queries(other / "queries_block.txt") for other in others}
    outcomes = localize(folder, "", queries, network, anchors).values()
    return (
        sum(len(found) for found in outcomes),
        sum(isinstance(o.result, Localized) for found in outcomes for o in found),
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--anchors", type=int, default=20)
    parser.add_argument("--model", default="base", help="tiny, base, large, or a file")
    arguments = parser.parse_args()
    threadpoolctl.threadpool_limits(1, user_api="blas")
    network = FeatureModel.load(arguments.model)
    print("| set | localized | median | 90th percentile | median (deg) | in 95 % |")
    print("|---|---|---|---|---|---|")
    folders = sorted(path for path in arguments.data.iterdir() if path.is_dir())
    for folder in folders:
        for split in ("", "_block"):
            print(measure(folder, split, network, arguments.anchors), flush=True)
    strangers = [
        count_strangers(
            folder, [other for other in folders if other != folder], network, arguments.anchors
        )
        for folder in folders
    ]
    total, posed = np.sum(strangers, axis=0)
    print(f"\nOf {total} frames of other places {posed} were given a pose.")


if __name__ == "__main__":
    main()
