"""Statistics of the running system, compared with results of numpy for the same numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plow_twin.stream.health import DurationHistogram, Periods, RealTimeFactor


@given(st.lists(st.floats(2e-6, 90.0), min_size=1, max_size=300), st.sampled_from((0.5, 0.9, 0.99, 1.0)))
def test_quantiles_are_accurate_to_half_a_bin(durations: list[float], share: float) -> None:
    histogram = DurationHistogram()
    for duration in durations:
        histogram.add(duration)
    exact = np.quantile(durations, share, method="inverted_cdf")
    assert histogram.quantile(share) == pytest.approx(exact, rel=0.024)
    assert histogram.largest_s == max(durations)
    assert histogram.count == len(durations)


def test_durations_out_of_range_are_counted_and_negative_durations_are_not() -> None:
    histogram = DurationHistogram()
    assert math.isnan(histogram.quantile(0.5))
    for duration in (0.0, 1e-9, 1e9, -1.0, math.nan):
        histogram.add(duration)
    assert histogram.count == 3
    assert histogram.quantile(1.0) > 90.0


def test_real_time_factor_is_model_time_over_wall_time() -> None:
    factor = RealTimeFactor()
    assert factor.mean() == factor.recent(5) == 0.0
    for second in range(11):
        factor.advanced(0.0 if second == 0 else 3.0, second * 1_000_000_000)
    assert factor.mean() == pytest.approx(3.0)
    assert factor.recent(20_000_000_000) == pytest.approx(1.5)
    factor.advanced(1.0, 21_000_000_000)
    assert factor.recent(22_000_000_000) == pytest.approx(0.5)


def test_missed_periods_are_counted_and_statistics_begin_at_the_last_call() -> None:
    periods = Periods(0.01)
    for now_s in (1.0, 1.011, 1.02, 1.051, 1.06):  # the turn at 1.05 follows two missed periods
        periods.turn(now_s)
    mean, deviation, largest = periods.recent()
    passed = np.array([0.011, 0.009, 0.031, 0.009])
    assert (mean, deviation, largest) == pytest.approx((passed.mean(), passed.std(), 0.031))
    assert periods.missed == 2 and np.isnan(periods.recent()).all()
    periods.begin()
    periods.turn(7.0)  # inactive time is not a period
    assert periods.missed == 2 and np.isnan(periods.recent()).all()
