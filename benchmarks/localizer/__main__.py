"""Compare the localizer with hloc on real posed images.

    python -m benchmarks.localizer DATA --hloc CHECKOUT [--model base] [--only SET,...]

DATA holds a folder for each set, with images/, a COLMAP model in sparse/, and lists of both splits.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import threadpoolctl

from benchmarks.localizer.comparison import Case, compare
from trigpoint.errors import TrigpointError
from trigpoint.models.features import FeatureModel
from trigpoint.stages import LocalizerOptions

METHODS = ("Trigpoint", "hloc")


def quantile(values: list[float], share: float) -> float:
    """Interpolate between the nearest two; inf where one of them is."""
    return float(
        np.quantile(values, share, method="higher" if np.isinf(values).any() else "linear")
    )


def report_accuracy(cases: dict[str, list[Case]]) -> str:
    """Print errors by set, and the geometric means of their ratios."""
    titles = "set,queries,localized,hloc's,median,hloc's,ratio,90th percentile,hloc's,ratio"
    lines = [f"| {titles.replace(',', ' | ')} |", "|---|" + "---:|" * 9]
    ratios: dict[float, list[float]] = defaultdict(list)
    for name, found in cases.items():
        errors = {m: [case.position for case in found if case.method == m] for m in METHODS}
        counts = [str(int(np.isfinite(errors[m]).sum())) for m in METHODS]
        cells = [name, str(len(errors["hloc"])), *counts]
        for share in (0.5, 0.9):
            ours, theirs = (quantile(errors[m], share) for m in METHODS)
            ratios[share].append(ours / theirs)
            cells += [f"{ours:.4f}", f"{theirs:.4f}", f"{ours / theirs:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    means = [float(np.exp(np.mean(np.log(ratios[share])))) for share in (0.5, 0.9)]
    lines.append(
        f"\nGeometric mean of the ratios: medians {means[0]:.3f}, 90th percentiles {means[1]:.3f}."
    )
    return "\n".join(lines)


def report_times(cases: dict[str, list[Case]]) -> str:
    """Print medians and 99th percentiles of the stages, over all queries."""
    lines = ["| | stage | median (ms) | p99 (ms) |", "|---|---|---:|---:|"]
    for method in METHODS:
        own = [case for found in cases.values() for case in found if case.method == method]
        stages = dict.fromkeys(stage for case in own for stage in case.stage_ms)
        times = {s: [case.stage_ms[s] for case in own if s in case.stage_ms] for s in stages}
        times["whole query"] = [case.ms for case in own]
        for stage, spent in times.items():
            lines.append(
                f"| {method} | {stage} | {np.median(spent):.1f} | {np.quantile(spent, 0.99):.1f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--hloc", type=Path, required=True, help="a checkout of hloc")
    parser.add_argument("--model", default="base", help="tiny, base, large, or a file")
    parser.add_argument("--anchors", type=int, default=20)
    parser.add_argument("--only", help="names of sets, with commas between")
    arguments = parser.parse_args()
    threadpoolctl.threadpool_limits(1, user_api="blas")
    folders = sorted(path for path in arguments.data.iterdir() if path.is_dir())
    if arguments.only:
        folders = [arguments.data / name for name in arguments.only.split(",")]
    try:
        network = FeatureModel.load(arguments.model)
        options = LocalizerOptions(num_anchors=arguments.anchors)
        cases = {}
        for folder in folders:
            for split in ("", "_block"):
                name = folder.name + split.replace("_", ", ")
                cases[name] = compare(folder, split, network, options, arguments.hloc)
                print(f"{name} is done", file=sys.stderr, flush=True)
    except TrigpointError as error:
        sys.exit(str(error))
    print(report_accuracy(cases), report_times(cases), sep="\n\n")


if __name__ == "__main__":
    main()
