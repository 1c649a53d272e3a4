import logging

import pytest

from trigpointd.clock import WallClock

START_NS = 1_700_000_000 * 10**9


class Clocks:
    """Two clocks that a test sets; a reading takes a microsecond, or as long as it says."""

    def __init__(self) -> None:
        self.now_ns = 5 * 10**9
        self.difference_ns = START_NS
        self.reading_ns = 1000

    def monotonic_ns(self) -> int:
        self.now_ns += self.reading_ns
        return self.now_ns

    def wall_ns(self) -> int:
        return self.monotonic_ns() + self.difference_ns


def test_while_nobody_sets_the_wall_clock_times_keep_their_distances_to_the_bit() -> None:
    clocks = Clocks()
    clock = WallClock(clocks.monotonic_ns, clocks.wall_ns)
    times_ns = []
    for i in range(20):
        clocks.difference_ns += 1000 if i % 2 else -1000  # what one sees of the readings' jitter
        clocks.reading_ns = 10**8 if i == 10 else 1000  # the process was held up in between
        times_ns.append(clock.time_ns(10**9 + i * 33_333_333))
    assert times_ns == [times_ns[0] + i * 33_333_333 for i in range(20)]
    assert abs(times_ns[0] - START_NS - 10**9) < 10_000


@pytest.mark.parametrize("step_ns", [3600 * 10**9, -5 * 10**6])
def test_a_wall_clock_that_is_set_is_followed_and_said_once(
    step_ns: int, caplog: pytest.LogCaptureFixture
) -> None:
    clocks = Clocks()
    clock = WallClock(clocks.monotonic_ns, clocks.wall_ns)
    before_ns = clock.time_ns(10**9)
    clocks.difference_ns += step_ns
    with caplog.at_level(logging.INFO):
        after_ns = [clock.time_ns(10**9) for _ in range(3)]
    assert after_ns == [before_ns + step_ns] * 3
    assert caplog.messages == [
        f"the wall clock was set by {step_ns / 1e9:+.3f} s; capture times follow"
    ]
