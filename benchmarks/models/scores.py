"""Areas under recall curves, their standard errors, and Markdown tables."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NUM_RESAMPLES = 2000


def gains(errors: ArrayLike, threshold: float) -> Array:
    """Return what each error adds to the area under the curve of recall: max(0, 1 - e / t).

    The mean is the area under the step curve up to the threshold, exactly, as a share of the
    whole. (Joining the steps by straight lines, as is often done, adds 1 / (2 N) at the most.)
    """
    return np.maximum(0.0, 1.0 - np.asarray(errors, np.float64) / threshold)


def area(errors: ArrayLike, threshold: float) -> float:
    """AUC of errors of any shape, in percent."""
    return 100 * float(gains(errors, threshold).mean())


def standard_error(case_gains: Array) -> float:
    """Bootstrap standard error of an AUC over cases (N,), in percent."""
    return 100 * float(np.std(_resample(len(case_gains)) @ case_gains))


def standard_error_of_ratio(case_gains: Array, baseline: Array) -> float:
    """Paired bootstrap standard error of the ratio of two AUCs over the same cases."""
    weights = _resample(len(case_gains))
    return float(np.std(weights @ case_gains / np.maximum(weights @ baseline, 1e-9)))


def _resample(num_cases: int) -> Array:
    """Weights (NUM_RESAMPLES, N) of the cases in samples drawn with replacement."""
    rng = np.random.default_rng(0)
    return rng.multinomial(num_cases, np.full(num_cases, 1 / num_cases), NUM_RESAMPLES) / num_cases
