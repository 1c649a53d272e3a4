"""What a long run is judged by: a leak is found, noise is not taken for one."""

import numpy as np
import pytest

from benchmarks.daemon.growth import fifth, fit_slope, has_risen
from benchmarks.daemon.soak import MEMORY_MB, MONTH_H, Records, find_growth

TIMES_S = np.arange(600.0)
# What the service's limit allows to a daemon that has taken 200 MB.
LIMIT = (MEMORY_MB - 200) / MONTH_H


def wander(seed: int) -> np.ndarray:
    """Return a memory that goes up and down by a megabyte, slowly."""
    noise = np.random.default_rng(seed).normal(size=len(TIMES_S) + 20)
    return 200 + np.convolve(noise, np.ones(20) / 20, "valid")[: len(TIMES_S)] * 4


def make_records(own_mb: np.ndarray, **counts: np.ndarray) -> Records:
    steady = {"threads": np.full(len(own_mb), 20), "files": np.full(len(own_mb), 60)}
    columns = {"time_s": TIMES_S, "Anonymous": own_mb, **steady, **counts}
    rows = zip(*columns.values(), strict=True)
    return Records(samples=[dict(zip(columns, row, strict=True)) for row in rows])


def test_a_line_has_its_slope_and_no_error() -> None:
    slope = fit_slope(TIMES_S, 5 + TIMES_S / 3600 * 7)
    assert slope.per_h == pytest.approx(7)
    assert slope.error == pytest.approx(0, abs=1e-9)


def test_the_error_says_how_far_off_the_slope_of_noise_is() -> None:
    slopes = [fit_slope(TIMES_S, wander(seed)) for seed in range(200)]
    scores = [slope.per_h / slope.error for slope in slopes]
    assert 0.7 < np.std(scores) < 1.5


def test_noise_does_not_grow() -> None:
    growing = [find_growth(make_records(wander(seed))) for seed in range(200)]
    assert sum(map(bool, growing)) <= 2


def test_a_leak_of_twenty_megabytes_an_hour_is_found_within_ten_minutes() -> None:
    leak = TIMES_S / 3600 * 20
    (found,) = find_growth(make_records(200 + leak + (wander(0) - 200) / 10))
    assert found.startswith("memory grows by +")


def test_growth_that_a_month_can_bear_is_no_failure() -> None:
    assert find_growth(make_records(200 + TIMES_S / 3600 * LIMIT * 0.9)) == []
    assert find_growth(make_records(200 + TIMES_S / 3600 * LIMIT * 1.1)) != []


def test_growth_in_the_first_fifth_is_warming_up() -> None:
    own_mb = np.minimum(100 + TIMES_S, 220)
    assert find_growth(make_records(own_mb, threads=np.minimum(TIMES_S, 119))) == []


@pytest.mark.parametrize("name", ["threads", "files"])
def test_what_is_opened_and_never_closed_is_found(name: str) -> None:
    (found,) = find_growth(make_records(np.full(600, 200.0), **{name: 60 + TIMES_S // 60}))
    assert found.startswith(f"{name} grow: ")


def test_counts_that_go_up_and_down_have_not_risen() -> None:
    assert not has_risen(60 + TIMES_S % 7)


def test_fifths_are_in_order_and_leave_nothing_out() -> None:
    values = np.concatenate([fifth(np.arange(11), i) for i in range(5)])
    np.testing.assert_array_equal(values, np.arange(11))
