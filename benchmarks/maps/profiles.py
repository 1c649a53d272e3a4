"""What a compact map costs in accuracy, and gains in space."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.localizer.comparison import errors
from benchmarks.localizer.tables import quantile
from trigpoint.database.codec import Profile
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import compact_map
from trigpoint.frame import Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map, read_frame, select_images
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import read_names, read_queries


@dataclass(frozen=True, eq=False)
class Measured:
    """A split's queries in a map of one profile."""

    positions: list[float]  # errors; inf where there is no pose
    bytes_per_image: float
    anchor_ms: float  # to read an anchor, the median

    @property
    def num_localized(self) -> int:
        """How many queries have a pose."""
        return int(np.isfinite(self.positions).sum())


def report(folders: Sequence[Path], network: FeatureModel) -> str:
    """Tabulate both profiles, set by set."""
    rows, ratios, logs = [], [], []
    totals = dict.fromkeys(Profile, 0)
    for folder in folders:
        for split in ("", "_block"):
            found = measure(folder, split, network)
            standard, compact = found[Profile.STANDARD], found[Profile.COMPACT]
            row = [f"{folder.name}{split.replace('_', ', ')}", f"{len(standard.positions)}"]
            row += [f"{own.num_localized}" for own in found.values()]
            pair = []
            for share in (0.5, 0.9):
                a, b = (quantile(own.positions, share) for own in found.values())
                row += [f"{a:.4f}", f"{b:.4f}"]
                pair.append(b / a if np.isfinite([a, b]).all() else np.nan)
            ratios.append(pair)
            a, b = np.array(standard.positions), np.array(compact.positions)
            both = np.isfinite(a) & np.isfinite(b)
            logs.append(np.log(b[both] / a[both]))
            row += [f"{own.bytes_per_image / 1000:.1f}" for own in found.values()]
            rows.append(row)
            for profile in Profile:
                totals[profile] += found[profile].num_localized
            anchor_ms = standard.anchor_ms, compact.anchor_ms
    means = np.exp(np.nanmean(np.log(ratios), axis=0))
    of_queries = np.concatenate(logs)
    drawn = np.random.default_rng(0).choice(of_queries, (2000, len(of_queries))).mean(axis=1)
    low, high = np.exp(np.percentile(drawn, [2.5, 97.5]))
    header = (
        "set,queries,localized,compact,median,compact,90th percentile,compact,kB an image,compact"
    )
    return (
        f"{markdown(header.split(','), rows)}\n\n"
        f"compact by standard, geometric means: medians {means[0]:.3f}, 90th percentiles "
        f"{means[1]:.3f} (where both are finite); of the errors of the {len(of_queries)} queries "
        f"that both localize {np.exp(of_queries.mean()):.3f} (95 % of bootstraps: {low:.3f} to "
        f"{high:.3f}); localized {totals[Profile.COMPACT]} and {totals[Profile.STANDARD]}. To read "
        f"an anchor takes {anchor_ms[1]:.2f} ms, one of the standard profile {anchor_ms[0]:.2f} ms."
    )


def measure(folder: Path, split: str, network: FeatureModel) -> dict[Profile, Measured]:
    """Localize a split's queries in its map as it is built, and once that is made compact."""
    posed = {image.name: image for image in read_model(folder / "sparse")}
    survey = select_images(list(posed.values()), read_names(folder / f"map{split}.txt"))
    queries = read_queries(folder / f"queries{split}.txt")
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        paths = {profile: Path(scratch) / f"{profile}.tpmap" for profile in Profile}
        build_map(paths[Profile.STANDARD], survey, folder / "images", network)
        calibrate_map(paths[Profile.STANDARD], network)
        shutil.copy(paths[Profile.STANDARD], paths[Profile.COMPACT])
        compact_map(paths[Profile.COMPACT], profile=Profile.COMPACT)
        for profile, path in paths.items():
            with MapReader.open(path, network.identity) as reader:
                localizer, positions = Localizer(network, reader), []
                for query in queries:
                    frame = read_frame(folder / "images", query.name, query.camera)
                    result = localizer.localize(frame)
                    pose = result.cam_from_world if isinstance(result, Localized) else None
                    positions.append(errors(pose, posed[query.name].cam_from_world)[0])
                size = path.stat().st_size / len(reader)
                found[profile] = Measured(positions, size, _time_anchors(reader))
    return found


def _time_anchors(reader: MapReader) -> float:
    spent = []
    for index in range(len(reader)):
        start = time.perf_counter()
        reader.anchor(index)
        spent.append((time.perf_counter() - start) * 1e3)
    return float(np.median(spent))
