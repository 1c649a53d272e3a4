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
from pathlib import Path

import threadpoolctl

from benchmarks.localizer import averaging, confidence, tables
from benchmarks.localizer.comparison import Case, compare
from benchmarks.localizer.networks import EdgePointModel
from benchmarks.localizer.trials import run_trials
from benchmarks.stage_times import describe_machine
from trigpoint.errors import ConfigError, TrigpointError
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.output import check_output, open_text

TABLES = ("accuracy", "anchors", "averaging", "trials")
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
    """Measure what was asked for: Markdown."""
    folders = find_sets(arguments.data, arguments.sets)
    parts = [f"# The localizer\n\n{describe_machine()}"]
    if {"accuracy", "anchors"} & set(arguments.only):
        methods = METHODS | (MORE_METHODS if "anchors" in arguments.only else {})
        cases = compare_sets(folders, FeatureModel.load(), methods, arguments.hloc)
        if arguments.hloc:
            parts.append(f"## Accuracy, `base`\n\n{tables.compare_accuracy(cases, DEFAULT)}")
        parts.append(f"## Time, `base`\n\n{tables.compare_times(cases, list(METHODS))}")
        sweep = sorted(methods, key=lambda name: (name == DEFAULT, len(name), name))
        parts.append(f"## Anchors\n\n{tables.compare_anchors(cases, sweep, REFERENCE)}")
        parts.append(f"## Covariance\n\n{tables.check_coverage(cases, DEFAULT)}")
        if arguments.picture:
            tables.draw_reliability(cases, DEFAULT, arguments.picture)
        if arguments.edgepoint2 and arguments.hloc:
            with tempfile.TemporaryDirectory() as scratch:
                network = EdgePointModel.load(arguments.edgepoint2, Path(scratch))
                cases = compare_sets(folders, network, METHODS, arguments.hloc)
            report = tables.compare_accuracy(cases, DEFAULT)
            parts.append(f"## Accuracy, EdgePoint2-E64\n\n{report}")
    if "averaging" in arguments.only:
        parts.append(f"## Center averaging\n\n{averaging.report(folders)}")
        say("averaging is done")
    if "trials" in arguments.only:
        trials = run_trials(folders, LocalizerOptions(min_confidence=1e-5))
        parts.append(f"## Wrong poses\n\n{tables.tabulate_trials(trials)}")
        parts.append(f"## Confidence\n\n{confidence.report(trials)}")
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
