"""What live cameras share: the time of their frames, and patience with a device that is lost."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator

_FIRST_DELAY_S = 0.5
_MAX_DELAY_S = 10.0


def wall_time_ns(monotonic_ns: int) -> int:
    """Return the system's time (ns since 1970) at a moment of CLOCK_MONOTONIC.

    Cameras stamp frames with the monotonic clock, poses are stamped with the system's. How far the
    two are apart is read anew each time, so that stamps follow where the system's clock is set.
    """
    readings = []
    for _ in range(3):
        before_ns, now_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, now_ns - (before_ns + after_ns) // 2))
    _, offset_ns = min(readings)  # the others may have been interrupted between the clocks
    return monotonic_ns + offset_ns


def retry_delays_s(generator: random.Random | None = None) -> Iterator[float]:
    """Yield how long to wait before each try: 0.5 s, doubled up to 10 s, less up to half of it.

    The random part keeps several daemons from trying in step.
    """
    generator = generator or random.Random()
    delay_s = _FIRST_DELAY_S
    while True:
        yield delay_s * generator.uniform(0.5, 1)
        delay_s = min(2 * delay_s, _MAX_DELAY_S)
