"""Comparison of a predicted signal with a measured signal: bias, RMS, correlation, lag and coherence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Largest lag [s] of the search, less than a load period. Signals that are shifted by a whole period are similar.
LARGEST_LAG_S: Final = 1.0
_FEWEST: Final = 8
_MOST_POINTS: Final = 400_000


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison. Differences are predicted minus measured."""

    n: int
    #: Mean and root mean square of the difference at equal stamps.
    bias: float
    rms: float
    #: Pearson's correlation at equal stamps, or None if a signal is constant.
    correlation: float | None
    #: Lag [s] of the measurement behind the prediction with the largest correlation.
    lag_s: float | None
    #: Standard deviation of the difference at the lag `lag_s`.
    rms_aligned: float | None
    #: Magnitude-squared coherence at the strongest frequency of the prediction.
    coherence: float | None


def signal_unit(name: str) -> str:
    """Return the unit of a signal, given its name."""
    return "N" if name.startswith("force_") else "rad" if name == "theta" else "m"


def compare(t: Array, predicted: Array, t_measured: Array, measured: Array) -> Comparison | None:
    """Compare a prediction, shape (n,), at increasing times `t` with measured values, shape (m,).

    The result is None if there are too few values.
    """
    inside = (t_measured >= t[0]) & (t_measured <= t[-1]) & np.isfinite(measured) if len(t) else np.zeros(0, bool)
    if inside.sum() < _FEWEST:
        return None
    order = np.argsort(t_measured[inside], kind="stable")
    times, values = t_measured[inside][order], measured[inside][order]
    here = np.interp(times, t, predicted)
    difference = here - values
    correlation = _correlation(here, values)
    lag_s = None if correlation is None else _lag(t, predicted, times, values)
    aligned = None
    if lag_s is not None:
        rest = _at(times - lag_s, t, predicted) - values
        aligned = float(np.nanstd(rest))
    bias, rms = float(difference.mean()), math.sqrt(float((difference**2).mean()))
    return Comparison(len(values), bias, rms, correlation, lag_s, aligned, _coherence(times, here, values))


def _correlation(first: Array, second: Array) -> float | None:
    finite = np.isfinite(first) & np.isfinite(second)
    first, second = first[finite], second[finite]
    if len(first) < _FEWEST:
        return None
    first, second = first - first.mean(), second - second.mean()
    size = math.sqrt(float(first @ first) * float(second @ second))
    # rounding errors could give a magnitude above 1
    return min(1.0, max(-1.0, float(first @ second) / size)) if size > 1e-300 else None


def _at(times: Array, t: Array, predicted: Array) -> Array:
    """Interpolate the prediction at the given times; it is NaN outside the time range of the prediction."""
    return np.interp(times, t, predicted, left=math.nan, right=math.nan)


def _step(times: Array, span: float) -> float:
    return max(float(np.median(np.diff(np.unique(times)))), span / _MOST_POINTS, 1e-6)


def _correlations(longer: Array, shorter: Array) -> Array:
    """Return Pearson's correlation of a series with each equally long piece of a longer series.

    The longer series is finite in one contiguous part and NaN outside. The result is -1 for a piece with too few finite
    numbers.
    """
    from scipy.signal import correlate

    finite = np.flatnonzero(np.isfinite(longer))
    n, begin = len(shorter), np.arange(len(longer) - len(shorter) + 1)
    if not finite.size:
        return np.full(len(begin), -1.0)
    one, other = longer - longer[finite].mean(), shorter - shorter.mean()
    one[: finite[0]] = one[finite[-1] + 1 :] = 0.0
    low = np.clip(finite[0] - begin, 0, n)
    high = np.clip(finite[-1] + 1 - begin, low, n)
    count = np.maximum(high - low, 1)

    def sums(series: Array, first: Any, last: Any) -> Array:
        total = np.concatenate(([0.0], np.cumsum(series)))
        return np.asarray(total[last] - total[first])

    mean_one, mean_other = sums(one, low + begin, high + begin) / count, sums(other, low, high) / count
    square_one = sums(one**2, low + begin, high + begin) - count * mean_one**2
    square_other = sums(other**2, low, high) - count * mean_other**2
    product = correlate(one, other, mode="valid", method="fft") - count * mean_one * mean_other
    # in a constant piece, the deviations from the mean are rounding errors, so no correlation is defined
    enough = (high - low >= _FEWEST) & (square_one > 1e-12 * (one @ one)) & (square_other > 1e-12 * (other @ other))
    size = np.sqrt(np.where(enough, square_one * square_other, 1.0))
    return np.where(enough, product / size, -1.0)


def _lag(t: Array, predicted: Array, times: Array, values: Array) -> float | None:
    """Return the lag [s] with the largest correlation, searched on a grid and then refined."""
    from scipy.optimize import minimize_scalar

    span = float(times[-1] - times[0])
    if span <= 0.0:
        return None
    step = _step(times, span)
    grid = np.arange(times[0], times[-1], step)
    reach = int(min(LARGEST_LAG_S, span / 4.0) / step)
    if len(grid) < _FEWEST or reach < 1:
        return 0.0
    at = grid[0] + step * np.arange(-reach, len(grid) + reach)
    scores = _correlations(_at(at, t, predicted), np.interp(grid, times, values))
    best = (reach - int(np.argmax(scores))) * step
    thin = max(1, len(times) // 50_000)

    def badness(lag_s: float) -> float:
        correlation = _correlation(_at(times[::thin] - lag_s, t, predicted), values[::thin])
        return 1.0 if correlation is None else -correlation

    bounds = max(best - 1.5 * step, -LARGEST_LAG_S), min(best + 1.5 * step, LARGEST_LAG_S)
    near = minimize_scalar(badness, bounds=bounds, method="bounded")
    return float(near.x) if near.fun <= badness(best) else best


def _coherence(times: Array, predicted: Array, measured: Array) -> float | None:
    from scipy.signal import coherence, periodogram

    span = float(times[-1] - times[0])
    if len(times) < 64 or span <= 0.0:
        return None
    step = _step(times, span)
    grid = np.arange(times[0], times[-1], step)
    one, other = np.interp(grid, times, predicted), np.interp(grid, times, measured)
    if len(grid) < 64 or not np.ptp(one) or not np.ptp(other):
        return None
    length = min(len(grid) // 4, 4096)
    frequencies, shares = coherence(one, other, fs=1.0 / step, nperseg=length)
    spectrum_at, spectrum = periodogram(one - one.mean(), fs=1.0 / step)
    strongest = spectrum_at[int(np.argmax(spectrum[1:])) + 1]
    found = float(shares[int(np.argmin(np.abs(frequencies - strongest)))])
    return min(1.0, found) if math.isfinite(found) else None
