"""Where the time of a query goes, and what an image takes to store: the paper's last table.

hloc, where its checkout is named, gets our features, retrieval and matches in the same run: query
by query in turn with ours, so that a machine that slows down slows both.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor, Frame, Localized, Statistics
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import Matchable
from trigpoint.options import LocalizerOptions
from trigpoint_db.build import read_frame
from trigpoint_db.experiments.hloc import (
    NUM_NEIGHBOURS,
    Hloc,
    match_map,
    match_query,
    write_features,
    write_keypoints,
    write_matches,
)
from trigpoint_db.experiments.published import load_published
from trigpoint_db.experiments.sets import choose, identify, open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import markdown, median, number
from trigpoint_db.figures import make_figure, save_figure
from trigpoint_db.importers.base import Dataset

NUM_ANCHORS = (20, 50, 150)
AS_NEEDED = "as many as needed"
OURS, HLOC = "ours", "hloc"
FEATURES, RETRIEVAL, MATCHING, LOCALIZATION = "features", "retrieval", "matching", "localization"
STAGES = {
    FEATURES: "tab:blue",
    RETRIEVAL: "tab:gray",
    MATCHING: "tab:olive",
    LOCALIZATION: "tab:red",
}
TOTAL = "total"
HLOC_FEATURES, HLOC_MODEL = "hloc's features", "hloc's reconstruction"
# The paper's table "timing": one query of Aachen by day, 50 images retrieved.
PAPER_ANCHORS = 50
PAPER_COLUMNS = ("NetVLAD", "SuperPoint", RETRIEVAL, "matching (SuperGlue)", LOCALIZATION)
PAPER_HLOC, PAPER = "HLOC + SG", "the paper's method"
PAPER_CLAIMS_PERCENT = (5, 10)  # less time, less storage than hloc
NUM_AACHEN = 4328  # database images of Aachen Day-Night (Sattler et al., CVPR 2018)


@dataclass(frozen=True, eq=False)
class Rival:
    """hloc with a map of the same images."""

    hloc: Hloc
    anchors: Mapping[str, Anchor]
    scratch: Path


def measure(
    sets: Mapping[str, Dataset],
    network: FeatureModel,
    checkout: Path | None,
    max_queries: int,
    store: Store,
) -> dict[str, Any]:
    """Time queries of all sets against one map of them, with hloc if its checkout is named."""
    joined = join(sets)
    queries = {query.name: query for query in choose(joined.queries, max_queries)}
    settings = {"network": network.identity.name, "sets": list(sets)}
    chosen = {"queries": list(queries), "hloc": checkout is not None}
    store.begin("timing", settings | chosen | identify(network, sets))
    if not all(key in store for key in queries):
        with (
            open_map(store.folder / "maps", "all", joined, network) as reader,
            open_rival(reader, checkout) as rival,
        ):
            store["bytes"] = measure_storage(reader, rival)
            localizers = {
                str(num_anchors): Localizer(
                    network, reader, at_once(num_anchors), time.perf_counter
                )
                for num_anchors in sorted({min(n, len(joined.mapped)) for n in NUM_ANCHORS})
            } | {AS_NEEDED: Localizer(network, reader, None, time.perf_counter)}
            for key in store.each(list(queries), "timing"):
                frame = read_frame(joined.images, key, queries[key].camera)
                store[key] = [
                    case
                    for label, localizer in localizers.items()
                    for case in time_query(label, localizer, frame, rival)
                ]
    return {
        **settings,
        "num_mapped": len(joined.mapped),
        "largest": max(len(dataset.mapped) for dataset in sets.values()),
        "num_queries": len(joined.queries),
        "num_chosen": len(queries),
        "rows": [summarize(cases) for cases in zip(*(store[key] for key in queries), strict=True)],
        "bytes": store["bytes"],
    }


def join(sets: Mapping[str, Dataset]) -> Dataset:
    """Make one data set of all; their worlds' frames, which differ, have no part in times."""
    if not sets:
        raise ConfigError("no set has map.txt and queries.txt, the split that is timed")
    root = Path(os.path.commonpath([dataset.images for dataset in sets.values()]))
    mapped, queries = [], []
    for dataset in sets.values():
        folder = dataset.images.relative_to(root)
        mapped += [replace(image, name=str(folder / image.name)) for image in dataset.mapped]
        queries += [replace(query, name=str(folder / query.name)) for query in dataset.queries]
    return Dataset(root, mapped, queries)


def at_once(num_anchors: int) -> LocalizerOptions:
    """Take all anchors in one round."""
    return LocalizerOptions(num_anchors=num_anchors, first_anchors=num_anchors)


@contextmanager
def open_rival(reader: MapReader, checkout: Path | None) -> Iterator[Rival | None]:
    """Make hloc's map of the same images, where its checkout is named."""
    if checkout is None:
        yield None
        return
    anchors = {anchor.name: anchor for anchor in map(reader.anchor, range(len(reader)))}
    matches: dict[tuple[str, str], Any] = {}
    for _, names in itertools.groupby(anchors, lambda name: Path(name).parent):  # set by set
        matches |= match_map({name: anchors[name] for name in names})
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        yield Rival(Hloc(checkout, scratch, list(anchors.values()), matches), anchors, scratch)


def measure_storage(reader: MapReader, rival: Rival | None) -> dict[str, float]:
    """Return bytes an image: of our map, and of hloc's features and reconstruction."""
    num_bytes = {OURS: reader.path.stat().st_size}
    if rival is not None:
        file = rival.scratch / "map_features.h5"
        write_features(file, {name: reader.features(i) for i, name in enumerate(reader.names())})
        num_bytes |= {HLOC_FEATURES: file.stat().st_size, HLOC_MODEL: rival.hloc.num_model_bytes}
    return {what: count / len(reader) for what, count in num_bytes.items()}


def time_query(
    label: str, localizer: Localizer, frame: Frame, rival: Rival | None
) -> list[dict[str, Any]]:
    """Localize a frame by a localizer, and by hloc with as many anchors, the same ones."""
    localizer.localize(frame)  # once before, as hloc's: caches are warm
    start = time.perf_counter()
    result = localizer.localize(frame)
    total = 1e3 * (time.perf_counter() - start)
    statistics = result.statistics
    ms = {stage: statistics.stage_ms.get(stage, 0.0) for stage in STAGES}
    ms[LOCALIZATION] = total - sum(ms.values())
    case = {"anchors": label, "num_anchors": statistics.num_anchors}
    found = isinstance(result, Localized)
    cases = [case | {"pipeline": OURS, "found": found, "ms": ms}]
    if rival is not None and label != AS_NEEDED:
        time_rival(rival, localizer, frame, statistics)
        found, ms = time_rival(rival, localizer, frame, statistics)
        cases.append(case | {"pipeline": HLOC, "found": found, "ms": ms})
    return cases


def time_rival(
    rival: Rival, localizer: Localizer, frame: Frame, ours: Statistics
) -> tuple[bool, dict[str, float]]:
    """Say whether hloc localizes a frame, and the milliseconds; features and retrieval are ours."""
    features = localizer.model.extract(frame.image, localizer.options.max_keypoints)
    start = time.perf_counter()
    query = Matchable.of(features, frame.camera)
    retrieved = ours.anchors[: localizer.options.num_anchors]
    matches = match_query(query, rival.anchors, retrieved)
    matched = time.perf_counter()
    files = rival.scratch / "query.h5", rival.scratch / "query_matches.h5"
    write_keypoints(files[0], {frame.name: features.keypoints})
    write_matches(files[1], {(frame.name, name): pairs for name, pairs in matches.items()})
    camera = rival.hloc.camera(frame.camera.to_text())
    written = time.perf_counter()
    pose = rival.hloc.localize(frame.name, camera, retrieved, *files)
    ms = {
        FEATURES: ours.stage_ms[FEATURES],
        RETRIEVAL: ours.stage_ms[RETRIEVAL],
        MATCHING: 1e3 * (matched - start),
        LOCALIZATION: 1e3 * (time.perf_counter() - written),
    }
    return pose is not None, ms


def summarize(cases: tuple[Mapping[str, Any], ...]) -> dict[str, Any]:
    """Take medians over queries of one pipeline with one number of anchors."""
    ms = {stage: median([case["ms"][stage] for case in cases]) for stage in STAGES}
    return {
        "anchors": cases[0]["anchors"],
        "pipeline": cases[0]["pipeline"],
        "num_anchors": median([case["num_anchors"] for case in cases]),
        "num_found": sum(case["found"] for case in cases),
        "ms": ms | {TOTAL: median([sum(case["ms"].values()) for case in cases])},
    }


def write_table(result: Mapping[str, Any]) -> str:
    """Write times and sizes, ours, hloc's and the paper's."""
    rows = result["rows"]
    has_hloc = any(row["pipeline"] == HLOC for row in rows)
    theirs = (
        "hloc's features and retrieval are ours; its matching is by the same matcher, of anchors "
        "that lie in memory, where ours reads them from the map and takes the lens's distortion "
        "off; its localization reads the files that it wants and solves for the pose. It and ours "
        f"take turns. Its map is triangulated from each image's {NUM_NEIGHBOURS} best neighbours."
        if has_hloc
        else "hloc is not here: `--hloc` names a checkout of it."
    )
    cells = [
        [
            row["anchors"],
            row["pipeline"],
            f"{row['num_found']} of {result['num_chosen']}",
            *(number(row["ms"][stage]) for stage in (*STAGES, TOTAL)),
        ]
        for row in rows
    ]
    about = (
        f"{result['num_chosen']} of the {result['num_queries']} queries of "
        f"{', '.join(result['sets'])}, chosen by a fixed seed, against one map of all their "
        f"{result['num_mapped']} images (`{result['network']}`); medians in ms. {theirs}"
    )
    parts = [about, markdown(["anchors", "", "localized", *STAGES, TOTAL], cells, num_words=2)]
    counts = [row["anchors"] for row in rows if row["pipeline"] == OURS]
    counts = [count for count in counts if count != AS_NEEDED]
    if beyond := [count for count in counts if int(count) > result["largest"]]:
        parts.append(
            f"No set has more than {result['largest']} images: of {' or '.join(beyond)} "
            "anchors some show other places, and what is matched with them is wrong."
        )
    if has_hloc:
        parts.append("\n".join(f"- {compare(rows, count)}" for count in counts))
    parts += [write_storage(result["bytes"]), write_paper(rows)]
    return "\n\n".join(parts)


def compare(rows: list[Mapping[str, Any]], anchors: str) -> str:
    """Say how much faster or slower ours is than hloc with as many anchors."""
    ours, theirs = (
        next(row["ms"] for row in rows if (row["anchors"], row["pipeline"]) == (anchors, pipeline))
        for pipeline in (OURS, HLOC)
    )
    ratios = {stage: ours[stage] / theirs[stage] for stage in (MATCHING, LOCALIZATION, TOTAL)}
    shares = ", ".join(f"{number(ratio, 2)} of hloc's {stage}" for stage, ratio in ratios.items())
    return f"{anchors} anchors: times of ours are {shares}."


def write_storage(num_bytes: Mapping[str, float]) -> str:
    """Write bytes an image."""
    cells = [[what, f"{count:,.0f}"] for what, count in num_bytes.items()]
    text = "Bytes an image: of our map everything that localizing takes"
    if HLOC_MODEL in num_bytes:
        theirs = num_bytes[HLOC_FEATURES] + num_bytes[HLOC_MODEL]
        cells.append(["hloc's together", f"{theirs:,.0f}"])
        text += (
            ", of hloc's local and global features in half precision, as it keeps them, and "
            f"COLMAP's files; ours is {number(num_bytes[OURS] / theirs, 2)} of hloc's"
        )
    return f"{text}.\n\n" + markdown(["", "bytes an image"], cells)


def write_paper(rows: list[Mapping[str, Any]]) -> str:
    """Quote the paper's table, and say what of it adds up."""
    published = {
        PAPER if row.pipeline == "Ours" else row.pipeline: [cell or "-" for cell in row.cells]
        for row in load_published()["timing"].rows
    }
    totals = {name: float(cells[-2]) for name, cells in published.items()}
    gigabytes = {name: float(cells[-1]) for name, cells in published.items()}
    cells = [
        [name, *printed, f"{gigabytes[name] * 1e6 / NUM_AACHEN:,.0f}"]
        for name, printed in published.items()
    ]
    own = [row["ms"][TOTAL] for row in rows if row["anchors"] == str(PAPER_ANCHORS)]
    header = ["", *PAPER_COLUMNS, TOTAL, "GB", "kB an image"]
    notes = [
        f"The stages of {name} add up to {sum(map(int, ms))} ms; its total says {total}."
        for name, (*ms, total, _) in published.items()
    ]
    faster, smaller = (100 * (1 - of[PAPER] / of[PAPER_HLOC]) for of in (totals, gigabytes))
    claims = " and ".join(f"{percent} %" for percent in PAPER_CLAIMS_PERCENT)
    notes.append(
        f"By these totals the paper's method takes {number(faster, 2)} % less time than HLOC + SG "
        f"and {number(smaller, 2)} % less storage; its text says {claims}."
    )
    if own:  # else the map has not as many images
        notes.append(
            f"The paper's total is {number(totals[PAPER] / own[0], 2)} times ours with as "
            "many anchors, but machine, network and images differ."
        )
    return (
        f'The paper\'s own table ("timing"): ms of one query of Aachen by day on its machine, with '
        f"{PAPER_ANCHORS} images retrieved; kB an image are of {NUM_AACHEN:,} images, as Aachen "
        "Day-Night has.\n\n" + markdown(header, cells) + "\n\n" + "\n".join(f"- {n}" for n in notes)
    )


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw the stages of each pipeline, one upon the other, and the bytes."""
    rows = result["rows"]
    figure = make_figure(10, 1.5 + 0.4 * len(rows))
    times, sizes = figure.subplots(1, 2, width_ratios=(5, 2))
    labels = [f"{row['pipeline']}, {row['anchors']}" for row in rows]
    left = [0.0] * len(rows)
    for stage, color in STAGES.items():
        widths = [row["ms"][stage] for row in rows]
        times.barh(labels, widths, left=left, color=color, label=stage)
        left = [start + width for start, width in zip(left, widths, strict=True)]
    times.invert_yaxis()
    times.set_xlabel("ms, medians of the stages")
    times.legend(fontsize="small")
    ours, *theirs = (count / 1e3 for count in result["bytes"].values())
    sizes.bar(OURS, ours, color="tab:blue", label=f"{OURS}: all")
    bottom = 0.0
    for kilo, color, label in zip(
        theirs, ("tab:gray", "tab:red"), (HLOC_FEATURES, HLOC_MODEL), strict=False
    ):
        sizes.bar(HLOC, kilo, bottom=bottom, color=color, label=label)
        bottom += kilo
    sizes.set_ylabel("kB an image")
    sizes.set_ylim(top=1.4 * max(ours, bottom))  # room for the legend
    sizes.legend(fontsize="small", handlelength=1, frameon=False)
    for axes, axis in ((times, "x"), (sizes, "y")):
        axes.grid(axis=axis, alpha=0.3)
        axes.set_axisbelow(True)
    save_figure(figure, path)
