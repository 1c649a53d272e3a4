"""From the clock that drivers stamp frames with to the clock that poses are stamped with."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)
_TOLERANCE_NS = 1_000_000  # of the two readings' not being simultaneous


class WallClock:
    """Tells the wall clock's time (UTC since 1970) of moments on CLOCK_MONOTONIC.

    NTP slews both clocks alike, so that their difference stays the same, to the bit, until
    somebody sets the wall clock; from then on the new difference holds, and stamps jump with it.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns = monotonic_ns
        self._wall_ns = wall_ns
        _, self._difference_ns = self._measure()

    def time_ns(self, monotonic_ns: int) -> int:
        """Return the wall clock's time of a moment, in ns."""
        width_ns, difference_ns = self._measure()
        change_ns = difference_ns - self._difference_ns
        if abs(change_ns) > _TOLERANCE_NS + width_ns:
            _log.warning("the wall clock was set by %+.3f s; capture times follow", change_ns / 1e9)
            self._difference_ns = difference_ns
        return monotonic_ns + self._difference_ns

    def _measure(self) -> tuple[int, int]:
        """Return how far apart the readings were, at best, and the clocks' difference."""
        readings = []
        for _ in range(3):
            before_ns, wall_ns, after_ns = (
                self._monotonic_ns(),
                self._wall_ns(),
                self._monotonic_ns(),
            )
            readings.append((after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2))
        return min(readings)
