"""Tables and a picture of what was measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, chi2

from benchmarks.localizer.comparison import HLOC, Case
from benchmarks.localizer.trials import NOT_OF_THIS_WORLD, Trial
from trigpoint_db.experiments.tables import markdown

Array = NDArray[np.float64]
Cases = Mapping[str, Sequence[Case]]  # by set and split

LEVELS = np.linspace(0.05, 0.99, 48)


def quantile(values: Sequence[float], share: float) -> float:
    """Interpolate between the nearest two; inf where one of them is."""
    return float(
        np.quantile(values, share, method="higher" if np.isinf(values).any() else "linear")
    )


def of_method(cases: Cases, method: str) -> dict[str, list[Case]]:
    """Pick one method's."""
    return {
        name: [case for case in found if case.method == method] for name, found in cases.items()
    }


def compare_accuracy(cases: Cases, method: str) -> str:
    """Errors by set beside hloc's, and the geometric means of the ratios."""
    ratios: dict[float, list[float]] = defaultdict(list)
    rows = []
    ours, theirs = of_method(cases, method), of_method(cases, HLOC)
    for name in cases:
        a, b = ([case.position for case in found[name]] for found in (ours, theirs))
        row = [name, f"{len(a)}", *(f"{np.isfinite(e).sum()}" for e in (a, b))]
        for share in (0.5, 0.9):
            mine, other = quantile(a, share), quantile(b, share)
            if np.isfinite(mine):
                ratios[share].append(mine / other)
            row += [f"{mine:.4f}", f"{other:.4f}", f"{mine / other:.2f}"]
        turns = [case.rotation_deg for case in ours[name]], [c.rotation_deg for c in theirs[name]]
        rows.append([*row, *(f"{quantile(t, 0.5):.3f}" for t in turns)])
    means = [float(np.exp(np.mean(np.log(ratios[share])))) for share in (0.5, 0.9)]
    header = "set,queries,localized,hloc's,median,hloc's,ratio,90th percentile,hloc's,ratio"
    table = markdown([*header.split(","), "median (deg)", "hloc's"], rows)
    return (
        f"{table}\n\nGeometric mean of the ratios: medians {means[0]:.2f}, 90th percentiles "
        f"{means[1]:.2f} (where both are finite)."
    )


def compare_times(cases: Cases, methods: Sequence[str]) -> str:
    """Medians, means and 99th percentiles of the stages, over all queries."""
    rows = []
    for method in (*methods, HLOC):
        own = [case for found in of_method(cases, method).values() for case in found]
        if not own:  # hloc was not there
            continue
        stages = dict.fromkeys(stage for case in own for stage in case.stage_ms)
        times = {s: [c.stage_ms[s] for c in own if s in c.stage_ms] for s in stages}
        times["whole query"] = [case.ms for case in own]
        for stage, spent in times.items():
            in_all = f"{len(spent) / len(own):.0%}"
            numbers = np.median(spent), np.mean(spent), np.quantile(spent, 0.99)
            rows.append([method, stage, in_all, *(f"{number:.1f}" for number in numbers)])
    header = ["", "stage", "of queries", "median (ms)", "mean", "p99"]
    return markdown(header, rows, num_words=2)


def compare_anchors(cases: Cases, methods: Sequence[str], reference: str) -> str:
    """Errors and times by the number of anchors, as ratios to those of `reference`."""
    base = of_method(cases, reference)
    rows = []
    for method in methods:
        found = of_method(cases, method)
        everything = [case for own in found.values() for case in own]
        row = [
            method,
            f"{np.mean([case.num_anchors for case in everything]):.1f}",
            f"{sum(np.isfinite(case.position) for case in everything)} of {len(everything)}",
        ]
        for share in (0.5, 0.9):
            pairs = [
                tuple(quantile([c.position for c in f[name]], share) for f in (found, base))
                for name in cases
            ]
            logs = [np.log(a / b) for a, b in pairs if np.isfinite(a) and np.isfinite(b)]
            row.append(f"{np.exp(np.mean(logs)):.3f}")
        reference_ms = np.median([c.ms for own in base.values() for c in own])
        row.append(f"{np.median([case.ms for case in everything]) / reference_ms:.2f}")
        rows.append(row)
    return markdown(["", "anchors", "localized", "median", "90th percentile", "time"], rows)


def coverage(squares: Array, level: float, scale: float = 1.0) -> float:
    """Share of squared errors (N,) inside the ellipsoid of a level, with the covariance scaled."""
    return float((squares < scale * chi2.ppf(level, 3)).mean())


def check_coverage(cases: Cases, method: str) -> str:
    """Shares of true poses inside the 95 % ellipsoid, by set.

    The last columns have another factor for the covariance than the one that is built in: that
    under which 95 % are inside in all other sets.
    """
    groups: dict[str, list[Case]] = defaultdict(list)
    for name, found in of_method(cases, method).items():
        groups[name.split(",")[0]] += [case for case in found if np.isfinite(case.position)]
    squares = {name: np.array([case.squares for case in own]) for name, own in groups.items()}
    limit = chi2.ppf(0.95, 3)
    rows = []
    for name, own in [*squares.items(), ("all", np.concatenate(list(squares.values())))]:
        row = [name, f"{len(own)}", *(f"{coverage(own[:, i], 0.95):.0%}" for i in (0, 1))]
        if name != "all" and len(squares) > 1:
            others = np.concatenate([s for other, s in squares.items() if other != name])
            for i in (0, 1):
                scale = np.quantile(others[:, i], 0.95) / limit
                row.append(f"{coverage(own[:, i], 0.95, scale):.0%} (x {scale:.2f})")
        rows.append([*row, "", ""][:6])
    header = ["set", "poses", "center", "rotation", "center, learnt elsewhere", "rotation"]
    return markdown(header, rows)


def draw_reliability(cases: Cases, method: str, path: Path) -> None:
    """Draw which share of the true poses lies inside the ellipsoid of each level."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    groups: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for name, found in of_method(cases, method).items():
        own = [case.squares for case in found if np.isfinite(case.position)]
        groups[name.split(",")[0]] += own
        groups["all"] += own
    for i, title in enumerate(("center", "rotation")):
        for name, squares in sorted(groups.items()):
            values = np.array(squares)[:, i]
            style = {"color": "black", "linewidth": 2} if name == "all" else {"linewidth": 1}
            axes[i].plot(LEVELS, [coverage(values, level) for level in LEVELS], label=name, **style)
        axes[i].plot([0, 1], [0, 1], ":", color="gray")
        axes[i].set(title=title, xlabel="ellipsoid", xlim=(0, 1), ylim=(0, 1))
    axes[0].set_ylabel("true poses inside")
    axes[1].legend(fontsize="small", loc="lower right")
    figure.savefig(path, dpi=110)


def upper_bound(count: int, total: int) -> float:
    """Upper end of the 95 % interval of a share (Clopper and Pearson, one-sided)."""
    return 1.0 if count == total else float(beta.ppf(0.95, count + 1, total - count))


def tabulate_trials(trials: Sequence[Trial]) -> str:
    """Count poses given, and wrong ones among them, by the state of the frame."""

    def count(name: str, own: Sequence[Trial]) -> list[str]:
        given = [trial for trial in own if trial.is_given]
        wrong = sum(not trial.is_right for trial in given)
        lost = sum(trial.is_right and not trial.is_given for trial in own)
        return [name, f"{len(own)}", f"{len(given)}", f"{wrong}", f"{lost}"]

    possible = [trial for trial in trials if trial.kind not in NOT_OF_THIS_WORLD]
    kinds = dict.fromkeys(trial.kind for trial in trials)
    rows = [count(kind, [trial for trial in trials if trial.kind == kind]) for kind in kinds]
    rows.sort(key=lambda row: row[0] in NOT_OF_THIS_WORLD)
    others = " and ".join(NOT_OF_THIS_WORLD)
    rows.append(count(f"all but {others}", possible))
    given = [trial for trial in possible if trial.is_given]
    wrong = sum(not trial.is_right for trial in given)
    bounds = (upper_bound(wrong, len(given)), upper_bound(wrong, len(possible)))
    header = ["frame", "trials", "pose given", "wrong", "right ones refused"]
    return (
        f"{markdown(header, rows)}\n\n"
        f"Without {others}, wrong among the poses given: {wrong} of {len(given)}, at most "
        f"{bounds[0]:.2%} with 95 % confidence; among all trials at most {bounds[1]:.2%}."
    )
