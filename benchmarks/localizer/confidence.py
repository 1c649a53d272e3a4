"""Learn the confidence in a pose from trials, and see how it does in maps that it has not seen."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.localizer.trials import NOT_OF_THIS_WORLD, Trial
from trigpoint_db.experiments.tables import markdown

Array = NDArray[np.float64]

BINS = (0.0, 0.2, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.01)


def describe(trial: Trial) -> list[float]:
    """Return what the confidence is made of: 1, and the logarithms of two shares."""
    statistics = trial.statistics
    agreeing = statistics.num_inliers / statistics.num_candidates
    return [1.0, float(np.log(agreeing)), float(np.log(statistics.std_ratio))]


def learn(features: Array, right: NDArray[np.bool_]) -> Array:
    """Fit a logistic regression to features (N, F): weights (F,)."""
    sign = np.where(right, 1.0, -1.0)

    def loss(weights: Array) -> float:
        return float(np.logaddexp(0, -sign * (features @ weights)).sum())

    return np.asarray(minimize(loss, np.zeros(features.shape[1])).x)


def report(trials: Sequence[Trial]) -> str:
    """Tabulate the confidence against the share of right poses; both with that learnt elsewhere."""
    posed = [t for t in trials if t.is_posed and t.kind not in NOT_OF_THIS_WORLD]
    features = np.array([describe(trial) for trial in posed])
    right = np.array([trial.is_right for trial in posed])
    maps = np.array([trial.map for trial in posed])
    elsewhere = np.empty(len(posed))
    for name in np.unique(maps):
        own = maps == name
        elsewhere[own] = 1 / (1 + np.exp(-features[own] @ learn(features[~own], right[~own])))
    packaged = np.array([trial.confidence for trial in posed])
    rows = []
    for low, high in itertools.pairwise(BINS):
        row = [f"{low:g} to {min(high, 1):g}"]
        for confidence in (packaged, elsewhere):
            inside = (low <= confidence) & (confidence < high)
            row.append(f"{inside.sum()}")
            found = (confidence[inside].mean(), right[inside].mean()) if inside.any() else ()
            row += [f"{value:.3f}" for value in found] or ["", ""]
        rows.append(row)
    header = "confidence,poses,its mean,right,learnt on other maps: poses,its mean,right"
    weights = ", ".join(f"{weight:.2f}" for weight in learn(features, right))
    return f"{markdown(header.split(','), rows)}\n\nLearnt on all of these: {weights}."
