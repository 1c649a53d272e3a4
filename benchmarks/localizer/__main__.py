"""Measure the localizer on real posed images.

    python -m benchmarks.localizer DATA [--hloc CHECKOUT] [--edgepoint2 CHECKOUT]
        [--only accuracy,trials] [--sets fox,tnt_truck] [--output FILE] [--picture FILE]

DATA holds a folder for each set, with images/, a COLMAP model in sparse/, and lists of both splits.
hloc (https://github.com/cvg/Hierarchical-Localization) and EdgePoint2 are run from their authors'
checkouts. Times are only worth something where nothing else runs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import threadpoolctl

from benchmarks.localizer import averaging, confidence, memory, tables
from benchmarks.localizer.comparison import Case, compare
from benchmarks.localizer.networks import EdgePointModel
from benchmarks.localizer.trials import run_trials
from benchmarks.stage_times import describe_machine
from trigpoint.errors import ConfigError, TrigpointError
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.output import check_output, open_text

TABLES = ("accuracy", "anchors", "averaging", "trials", "memory")
INTRODUCTION = """# Benchmarks of the localizer

{machine}.

    make bench-localizer HLOC=../Hierarchical-Localization EDGEPOINT2=../EdgePoint2

The sets are in no package: `DATA` holds a folder for each, with `images/`, a COLMAP model in
`sparse/`, and lists of both splits. Every fifth image is a query, or ("block") whole stretches are.
Where the time of a query goes is also in
[../benchmarks/stage_times.md](../benchmarks/stage_times.md); the networks are compared in
[../benchmarks/models.md](../benchmarks/models.md)."""
EXPLANATIONS = {
    "Accuracy, `base`": """\
Each set and split: localized frames, median and 90th percentile of the position errors (metres for
the kitchen, kitti and strecha, else the model's units; failures are infinite), and median rotation
errors, beside [hloc](https://github.com/cvg/Hierarchical-Localization) on the same features,
retrieval and matches, each query by both in turn. hloc's map is triangulated by COLMAP from the
same matches, with each image's 20 best neighbours; it gets 20 anchors, ours as many as it takes of
these.""",
    "Time, `base`": """\
All queries of all sets. hloc's share of the features, the retrieval and the matching are ours; its
pose is read from the files that it wants.""",
    "Anchors": """\
Ratios to 20 anchors for every frame, as geometric means over sets and splits where both are
finite.""",
    "Covariance": """\
True centers and rotations inside the ellipsoid of 95 %. The two columns on the right have another
factor than the one that is built in: that under which 95 % are inside in all other sets.""",
    "Accuracy, EdgePoint2-E64": """\
As above, with EdgePoint2-E64's keypoints (sub-pixel) and descriptors, and `base`'s global
descriptor.""",
    "Center averaging": """\
Medians in percent of the distance of the five nearest anchors: the paper's experiment, with the
poses of real surveys, by the noise of the relative poses (20 anchors) and, at 1 degree, by the
number of anchors and the share of relative poses that are wrong altogether.""",
    "Wrong poses": """\
Frames of every place in the maps of all others, and of the own place, spoilt. Right is a pose
within 5 % of the depth and 3 degrees.""",
    "Confidence": """\
The poses of the same trials, also those refused for their confidence alone.""",
    "Memory": """\
Megabytes resident over many frames, in a map of 10,000 images, sixty of which show the room that
the frames are of: of the process alone (anonymous), and of the map's pages and the libraries, which
the system drops when it needs the memory.""",
}
DEFAULT = "as many as needed"
SWEEP = (5, 10, 20, 50, 100)


def at_once(num_anchors: int) -> LocalizerOptions:
    """Take all anchors at once."""
    return LocalizerOptions(num_anchors=num_anchors, first_anchors=num_anchors)


REFERENCE = "20 anchors"
METHODS = {REFERENCE: at_once(20), DEFAULT: LocalizerOptions(), "50 anchors": at_once(50)}
MORE_METHODS = {f"{k} anchors": at_once(k) for k in SWEEP}


def compare_sets(
    folders: Sequence[Path],
    network: FeatureModel,
    methods: Mapping[str, LocalizerOptions],
    hloc: Path | None,
) -> dict[str, list[Case]]:
    """Localize both splits of all sets."""
    cases = {}
    for folder in folders:
        for split in ("", "_block"):
            name = folder.name + split.replace("_", ", ")
            cases[name] = compare(folder, split, network, methods, hloc)
            say(f"{name} with {network.identity.name} is done")
    return cases


def measure(arguments: argparse.Namespace) -> str:
    """Measure what was asked for: Markdown, as it stands in docs/benchmarks.md."""
    folders = find_sets(arguments.data, arguments.sets)
    parts = [INTRODUCTION.format(machine=describe_machine())]

    def add(title: str, report: str) -> None:
        parts.append(f"## {title}\n\n{EXPLANATIONS[title]}\n\n{report}")

    if {"accuracy", "anchors"} & set(arguments.only):
        methods = METHODS | (MORE_METHODS if "anchors" in arguments.only else {})
        cases = compare_sets(folders, FeatureModel.load(), methods, arguments.hloc)
        if arguments.hloc:
            add("Accuracy, `base`", tables.compare_accuracy(cases, DEFAULT))
        add("Time, `base`", tables.compare_times(cases, list(METHODS)))
        sweep = sorted(methods, key=lambda name: (name == DEFAULT, len(name), name))
        add("Anchors", tables.compare_anchors(cases, sweep, REFERENCE))
        add("Covariance", tables.check_coverage(cases, DEFAULT))
        if arguments.picture:
            tables.draw_reliability(cases, DEFAULT, arguments.picture)
            parts.append(f"![Share of the true poses inside](images/{arguments.picture.name})")
        if arguments.edgepoint2 and arguments.hloc:
            with tempfile.TemporaryDirectory() as scratch:
                network = EdgePointModel.load(arguments.edgepoint2, Path(scratch))
                cases = compare_sets(folders, network, METHODS, arguments.hloc)
            add("Accuracy, EdgePoint2-E64", tables.compare_accuracy(cases, DEFAULT))
    if "averaging" in arguments.only:
        add("Center averaging", averaging.report(folders))
        say("averaging is done")
    if "trials" in arguments.only:
        trials = run_trials(folders, LocalizerOptions(min_confidence=1e-5))
        add("Wrong poses", tables.tabulate_trials(trials))
        add("Confidence", confidence.report(trials))
        say("trials are done")
    if "memory" in arguments.only:
        # In a process of its own: what this one has in memory is not the localizer's.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            add("Memory", pool.submit(memory.report).result())
    return "\n\n".join(parts) + "\n"


def find_sets(data: Path, names: str | None) -> list[Path]:
    """List the folders of the sets."""
    if not data.is_dir():
        raise ConfigError(f"there is no folder {data}")
    chosen = sorted(data.iterdir()) if names is None else [data / n for n in names.split(",")]
    folders = [folder for folder in chosen if (folder / "sparse").is_dir()]
    if not folders or (names and len(folders) < len(chosen)):
        raise ConfigError(f"{data} holds no such sets; each is a folder with images/ and sparse/")
    return folders


def say(text: str) -> None:
    """Report progress."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.localizer", description=__doc__.splitlines()[0]
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--hloc", type=Path)
    parser.add_argument("--edgepoint2", type=Path)
    parser.add_argument("--only", type=_tables, default=list(TABLES))
    parser.add_argument("--sets", help="names, with commas between")
    parser.add_argument("--output", type=Path, help="Markdown")
    parser.add_argument("--picture", type=Path, help="of the covariance's reliability")
    arguments = parser.parse_args()
    threadpoolctl.threadpool_limits(1, user_api="blas")
    try:
        check_output(arguments.output)
        check_output(arguments.picture)
        report = measure(arguments)
        print(report)
        if arguments.output:
            with open_text(arguments.output) as file:
                file.write(report)
    except TrigpointError as error:
        sys.exit(str(error))


def _tables(text: str) -> list[str]:
    wanted = text.split(",")
    if unknown := sorted(set(wanted) - set(TABLES)):
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not one of {', '.join(TABLES)}")
    return wanted


if __name__ == "__main__":
    main()
