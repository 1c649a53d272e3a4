"""Localization error on posed images, for every set and split in a folder.

    python benchmarks/accuracy.py ../shared/data [--anchors 20]

Each set is a folder with `images/`, `sparse/` (a COLMAP model), and for each split `map*.txt`
(names) and `queries*.txt` (names with cameras). Failures count as infinite errors. The last column
is the share of localized queries whose true center lies inside the covariance's 95 % ellipsoid.
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
from trigpoint_db.evaluate import evaluate
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.localize import localize_images
from trigpoint_db.poses import read_names, read_queries

CHI2_95 = 7.815  # three degrees of freedom


def measure(folder: Path, split: str, network: FeatureModel, anchors: int) -> str:
    """Build, localize, evaluate: one row of the table."""
    posed = {image.name: image for image in read_model(folder / "sparse")}
    queries = read_queries(folder / f"queries{split}.txt")
    survey = select_images(list(posed.values()), read_names(folder / f"map{split}.txt"))
    options = LocalizerOptions(num_anchors=anchors)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "map.tpmap"
        build_map(path, survey, folder / "images", network)
        with MapReader.open(path, network.identity) as reader:
            localizer = Localizer(network, reader, options)
            outcomes = list(localize_images(localizer, queries, folder / "images"))
    found = {o.name: o.result for o in outcomes if isinstance(o.result, Localized)}
    truth = {name: image.cam_from_world for name, image in posed.items()}
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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("--anchors", type=int, default=20)
    arguments = parser.parse_args()
    threadpoolctl.threadpool_limits(1, user_api="blas")
    network = FeatureModel.load()
    print("| set | localized | median | 90th percentile | median (deg) | in 95 % |")
    print("|---|---|---|---|---|---|")
    for folder in sorted(path for path in arguments.data.iterdir() if path.is_dir()):
        for split in ("", "_block"):
            print(measure(folder, split, network, arguments.anchors), flush=True)


if __name__ == "__main__":
    main()
