"""What cameras share, and what is said of one whose package is missing; no camera is needed."""

import itertools
import random
import sys
import time

import pytest

from trigpoint.errors import ConfigError
from trigpointd.config import DepthaiConfig
from trigpointd.sources.depthai import DepthaiSource
from trigpointd.sources.live import retry_delays_s, wall_time_ns

SECOND_NS = 10**9


def test_a_moment_of_the_monotonic_clock_has_its_time_of_day() -> None:
    assert abs(wall_time_ns(time.monotonic_ns()) - time.time_ns()) < SECOND_NS
    moment_ns = time.monotonic_ns()
    elapsed_ns = wall_time_ns(moment_ns) - wall_time_ns(moment_ns - 100 * SECOND_NS)
    assert abs(elapsed_ns - 100 * SECOND_NS) < SECOND_NS


def test_stamps_follow_a_system_clock_that_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    moment_ns = time.monotonic_ns()
    before_ns = wall_time_ns(moment_ns)
    system_time_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: system_time_ns() + 3600 * SECOND_NS)
    assert abs(wall_time_ns(moment_ns) - before_ns - 3600 * SECOND_NS) < SECOND_NS


def test_delays_double_up_to_ten_seconds_and_differ_at_random() -> None:
    delays_s = list(itertools.islice(retry_delays_s(random.Random(1)), 50))
    longest_s = [0.5, 1, 2, 4, 8, *[10] * 45]
    assert all(m / 2 <= d <= m for d, m in zip(delays_s, longest_s, strict=True))
    assert len(set(delays_s)) == 50
    assert delays_s == list(itertools.islice(retry_delays_s(random.Random(1)), 50))
    assert delays_s != list(itertools.islice(retry_delays_s(), 50))


def test_without_depthai_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(ConfigError, match=r"pip install 'trigpoint\[oak\]'") as caught:
        DepthaiSource(DepthaiConfig(type="depthai"))
    assert "\n" not in str(caught.value)
