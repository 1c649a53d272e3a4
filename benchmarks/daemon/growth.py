"""Whether what is counted second by second grows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_NUM_BLOCKS = 20
_CLEAR = 3.0  # standard errors
_HOUR_S = 3600.0


@dataclass(frozen=True)
class Slope:
    """Growth an hour, and its standard error."""

    per_h: float
    error: float

    def exceeds(self, limit: float) -> bool:
        """Whether it is clearly above a limit, not by accident."""
        return self.per_h - _CLEAR * self.error > limit

    def __str__(self) -> str:
        return f"{self.per_h:+.1f} ± {self.error:.1f}"


def fit_slope(times_s: ArrayLike, values: ArrayLike) -> Slope:
    """Fit a line to the means of 20 stretches of equal length.

    Samples of one second resemble those of the next, so that a fit to them all would claim to be
    more certain than it is; means over stretches hardly do.

    Parameters
    ----------
    times_s, values : (N,) float64
        N >= 20.
    """
    times, means = (
        np.array([part.mean() for part in np.array_split(np.asarray(x, np.float64), _NUM_BLOCKS)])
        for x in (times_s, values)
    )
    centered = times - times.mean()
    spread = centered @ centered
    slope = centered @ means / spread
    residuals = means - means.mean() - slope * centered
    error = np.sqrt(residuals @ residuals / (_NUM_BLOCKS - 2) / spread)
    return Slope(float(slope * _HOUR_S), float(error * _HOUR_S))


def fifth(values: ArrayLike, number: int) -> Array:
    """Return one of five equal parts of (N,) values, the first being 0."""
    return np.array_split(np.asarray(values, np.float64), 5)[number]


def has_risen(counts: ArrayLike) -> bool:
    """Whether a count was in the last fifth always above all that it was in the second."""
    return bool(fifth(counts, 4).min() > fifth(counts, 1).max())
