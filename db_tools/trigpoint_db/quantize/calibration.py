"""Which values each tensor of a network takes on given images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from trigpoint.errors import ModelError

Array32 = NDArray[np.float32]
Inputs = Mapping[str, Array32]

NUM_BINS = 2048


@dataclass(frozen=True, eq=False)
class Distribution:
    """The values of one tensor over all images, and its shape in the first."""

    low: float
    high: float
    counts: NDArray[np.int64]  # (NUM_BINS,) between low and high
    shape: tuple[int, ...]

    def limits(self, percentile: float) -> tuple[float, float]:
        """Return the limits outside of which 100 - percentile of the values are; 0 is inside.

        Half of that share is cut off at each end; with 100 nothing is.
        """
        tail = (100 - percentile) / 200 * self.counts.sum()
        edges = np.linspace(self.low, self.high, NUM_BINS + 1)
        passed = np.cumsum(self.counts)
        first = np.searchsorted(passed, tail, side="right")
        last = np.searchsorted(passed, passed[-1] - tail)
        return min(float(edges[first]), 0.0), max(float(edges[last + 1]), 0.0)


def calibrate(session: ort.InferenceSession, inputs: Sequence[Inputs]) -> dict[str, Distribution]:
    """Run a network and count what its outputs and inputs hold; images may differ in size."""
    names = [output.name for output in session.get_outputs()]
    limits: dict[str, tuple[float, float]] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    for name, values in _run(session, names, inputs):
        low, high = float(values.min()), float(values.max())
        if not np.isfinite((low, high)).all():
            raise ModelError(f"the network's {name!r} is not finite on the images given")
        before = limits.get(name, (low, high))
        limits[name] = min(low, before[0]), max(high, before[1])
        shapes.setdefault(name, values.shape)
    counts = {name: np.zeros(NUM_BINS, np.int64) for name in limits}
    for name, values in _run(session, names, inputs):
        counts[name] += np.histogram(values, NUM_BINS, _widened(*limits[name]))[0]
    return {
        name: Distribution(*_widened(*limits[name]), counts[name], shapes[name]) for name in limits
    }


def _widened(low: float, high: float) -> tuple[float, float]:
    """Give what hardly varies a width that float32 can cut into bins."""
    width = max(1e-3 * max(abs(low), abs(high)), 1e-6)
    return (low, high) if high - low > width else (low - width, high + width)


def _run(
    session: ort.InferenceSession, names: list[str], inputs: Sequence[Inputs]
) -> Iterator[tuple[str, Array32]]:
    for given in inputs:
        yield from given.items()
        yield from zip(names, session.run(names, given), strict=True)
