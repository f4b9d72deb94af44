"""Performance statistics of the running twin, such as quantiles of durations and the real-time factor."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

_BINS_PER_DECADE: Final = 50
_LOWEST_S: Final = 1e-6
_DECADES: Final = 8
_BINS: Final = _BINS_PER_DECADE * _DECADES


class DurationHistogram:
    """Histogram of durations from 1 us to 100 s; the width of the bins limits the error of a quantile to 2.4 %."""

    def __init__(self) -> None:
        # a list is used, because incrementing an item of a NumPy array takes ten times as long
        self._counts = [0] * _BINS
        self._counted = np.zeros(len(self._counts), np.int64)
        self.largest_s = 0.0

    @property
    def count(self) -> int:
        """Number of durations counted."""
        return sum(self._counts)

    def add(self, duration_s: float, count: int = 1) -> None:
        """Count a duration [s] `count` times. Negative durations are ignored."""
        if not duration_s >= 0.0:
            return
        if duration_s > self.largest_s:
            self.largest_s = duration_s
        index = int(math.log10(duration_s / _LOWEST_S) * _BINS_PER_DECADE) if duration_s > _LOWEST_S else 0
        self._counts[index if index < _BINS else -1] += count

    def quantile(self, share: float) -> float:
        """Return the quantile `share` of all durations [s]; NaN without durations."""
        return self._quantile(np.array(self._counts), share)

    def recent(self, share: float) -> float:
        """Return the quantile `share` of the durations [s] added since the last call of this method."""
        counts = np.array(self._counts)
        before, self._counted = self._counted, counts
        return self._quantile(counts - before, share)

    def _quantile(self, counts: NDArray[np.int64], share: float) -> float:
        total = int(counts.sum())
        if total == 0:
            return math.nan
        rank = max(1, math.ceil(share * total))
        index = int(np.searchsorted(np.cumsum(counts), rank))
        return min(self.largest_s, float(_LOWEST_S * 10.0 ** ((index + 0.5) / _BINS_PER_DECADE)))


class Periods:
    """Times between successive iterations of a periodic loop, and the number of missed periods."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self.missed = 0
        self._before_s = math.nan
        self._recent: list[float] = []

    def begin(self) -> None:
        """Forget the last iteration, so that the time to the next iteration is not measured."""
        self._before_s = math.nan

    def turn(self, now_s: float) -> None:
        """Record an iteration of the loop at the time `now_s` [s] of the steady clock."""
        passed_s, self._before_s = now_s - self._before_s, now_s
        if passed_s >= 0.0:
            self._recent.append(passed_s)
            self.missed += max(0, round(passed_s / self._period_s) - 1)

    def recent(self) -> tuple[float, float, float]:
        """Return mean, standard deviation and maximum of the times [s] since the last call; NaN without iterations."""
        periods, self._recent = np.array(self._recent), []
        if not periods.size:
            return math.nan, math.nan, math.nan
        return float(periods.mean()), float(periods.std()), float(periods.max())


class RealTimeFactor:
    """Real-time factor: model time divided by wall time."""

    def __init__(self) -> None:
        self.model_s = 0.0
        self._start_ns: int | None = None
        self._newest_ns = 0
        self._last = (0, 0.0)

    def advanced(self, duration_s: float, now_ns: int) -> None:
        """Count `duration_s` [s] of model time at the time `now_ns` [ns] of the steady clock."""
        if self._start_ns is None:
            self._start_ns = now_ns
            self._last = (now_ns, 0.0)
        self._newest_ns = now_ns
        self.model_s += duration_s

    def mean(self) -> float:
        """Return the factor from the first to the newest advance; 0 before the first advance."""
        if self._start_ns is None or self._newest_ns <= self._start_ns:
            return 0.0
        return self.model_s / ((self._newest_ns - self._start_ns) * 1e-9)

    def recent(self, now_ns: int) -> float:
        """Return the factor since the last call of this method; 0 before the first advance."""
        last_ns, last_model_s = self._last
        if self._start_ns is None or now_ns <= last_ns:
            return 0.0
        self._last = (now_ns, self.model_s)
        return (self.model_s - last_model_s) / ((now_ns - last_ns) * 1e-9)
