"""Input of the estimate: the measured pose and the believed load, as arrays on one clock."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from plow_twin.errors import PlowTwinError
from plow_twin.estimate import priors, tuning
from plow_twin.model.pairs import PAIR_COUNT

Array = NDArray[np.float64]
Deviation = tuple[float, ...]
#: Definition: deviations that are not stated.
UNSTATED: Deviation = (0.0, 0.0, 0.0)
#: Derived: smallest numbers of values for a standard deviation. From n values it has the relative error 1 / sqrt(2 n):
#: 22 % for a cell in contact, 16 % for poses and gaps, 10 % for a scatter in a comparison.
FEWEST_IN_CONTACT, FEWEST_POSES, FEWEST_FOR_SCATTER = 10, 20, 50
#: Guard: longest interval in s between poses or samples; over it the motion in a soft contact is nearly cubic.
RESOLVING: Final = 0.02
#: Bound: smallest number of points between two knots over which a load is averaged.
_FINER = 8
#: Guard: largest possible component of a pose, in m or rad, and of a load, in N or N m.
_LARGEST_POSE, _LARGEST_LOAD = 1e6, 1e15


class EstimateError(PlowTwinError):
    """The data cannot be used; the text names the value got and the value expected."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Measured poses.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Stamps in s, strictly increasing.
    q : ndarray, shape (n, 3)
        x, y [m] and theta [rad]; NaN where a component was not measured.
    deviation : tuple of 3 float
        Stated standard deviation of each component; 0 if not stated.
    assumed : ndarray, shape (n, 3), optional
        Poses of a model, used where all three components are needed and a component was never measured.
    """

    t: Array
    q: Array
    deviation: Deviation = UNSTATED
    assumed: Array | None = None

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Whether each component was ever measured, shape (3,)."""
        return np.asarray(np.isfinite(self.q).any(axis=0))

    @staticmethod
    def of(t: ArrayLike, q: ArrayLike, deviation: Deviation = UNSTATED) -> tuple[Poses, int]:
        """Return rows in order of time, and the number of rows left out.

        Rows are left out if their stamp is not finite or repeated, if they have no finite component, or a component
        beyond 1e6.

        Raises
        ------
        EstimateError
            If an array has the wrong shape, or a deviation is invalid.
        """
        _check_deviation("poses", deviation)
        times, rows = np.asarray(t, dtype=np.float64), np.array(q, dtype=np.float64)
        if times.ndim != 1 or rows.shape != (len(times), 3):
            raise EstimateError(f"poses: got t {times.shape} and q {rows.shape}, expected (n,) and (n, 3)")
        rows[~np.isfinite(rows)] = np.nan
        absurd = (np.abs(rows) > _LARGEST_POSE).any(axis=1)
        index = _in_order(times, np.isfinite(rows).any(axis=1) & ~absurd)
        return Poses(times[index], rows[index], deviation), len(times) - len(index)

    def interval(self) -> float:
        """Return the interval in s between complete poses, after poses of single components have been merged."""
        measured = int(np.isfinite(self.q).sum())
        return float(np.median(np.diff(self.t))) * self.q.size / max(measured, 1)

    def gap(self) -> float:
        """Return the median gap in s between measured values of a component, weighted by the gaps' lengths."""
        gaps = np.sort(np.concatenate([np.diff(self.t[np.isfinite(column)]) for column in self.q.T]))
        return float(gaps[np.searchsorted(gaps.cumsum(), 0.5 * gaps.sum())])

    def between(self, start: float, end: float) -> Poses:
        """Return the poses stamped in [start, end)."""
        inside = (self.t >= start) & (self.t < end)
        assumed = None if self.assumed is None else self.assumed[inside]
        return Poses(self.t[inside], self.q[inside], self.deviation, assumed)

    def moved(self, by: Array) -> Poses:
        """Return the poses with `by`, shape (3,), added to each."""
        return replace(self, q=self.q + by, assumed=None if self.assumed is None else self.assumed + by)

    def without_spikes(self, level: Array) -> tuple[Poses, int]:
        """Leave out values far from all four neighbours, and return their number.

        `level`, shape (3,), is the noise from row to row. If there are many such values, the sensor is bad, and all
        values are kept.
        """
        if len(self.t) < FEWEST_FOR_SCATTER:
            return self, 0
        about = np.stack([np.roll(self.q, shift, axis=0) for shift in (-2, -1, 1, 2)])
        low, high = about.min(axis=0), about.max(axis=0)
        far = tuning.SPIKE[0] * level + (high - low)
        # a value with a NaN beside it is no spike, because comparisons with NaN are false
        spikes = (self.q > high + far) | (self.q < low - far)
        spikes[[0, 1, -2, -1]] = False
        count = int(spikes.sum())
        if not count or spikes.mean(axis=0).max() > tuning.SPIKE[1]:
            return self, 0
        return Poses(self.t, np.where(spikes, np.nan, self.q), self.deviation), count

    def fresh(self) -> Poses:
        """Leave out repeated values from a sensor slower than its sender: they are late and repeat the same noise.

        A value that is repeated for longer shows that the sensor has stopped; then all values are kept.
        """
        one, next_one = self.q[:-1], self.q[1:]
        again = ((one == next_one) | (np.isnan(one) & np.isnan(next_one))).all(axis=1)
        if again.mean() < tuning.REPEATING[0] if len(again) else True:
            return self
        first = np.flatnonzero(np.append(True, ~again))
        lengths = np.diff(np.append(first, len(self.t)))
        if len(first) < FEWEST_FOR_SCATTER or lengths.max() > tuning.REPEATING[1] * lengths.mean() + 1.0:
            return self
        return Poses(self.t[first], self.q[first], self.deviation)


@dataclass(frozen=True, eq=False)
class Load:
    """The believed load: linear between its samples, constant before the first sample and after the last.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times in s, strictly increasing.
    wrench : ndarray, shape (n, 3)
        Fx, Fy [N] and M [N m] about the cavity's centre, without gravity.
    deviation : tuple of 3 float
        Stated standard deviation of each component; 0 if not stated.
    unknown : tuple of 3 float
        Spectral density of the unknown part of the load between its samples (`believable`), in N2 s and (N m)2 s.
    """

    t: Array
    wrench: Array
    deviation: Deviation = UNSTATED
    unknown: Deviation = UNSTATED

    @staticmethod
    def of(t: ArrayLike, wrench: ArrayLike, deviation: Deviation = UNSTATED) -> tuple[Load, int]:
        """Return samples in order of time, and the number of samples left out.

        Samples are left out if they are not finite, beyond 1e15, or have a repeated stamp.

        Raises
        ------
        EstimateError
            If an array has the wrong shape, there are fewer than two usable samples, or a deviation is invalid.
        """
        _check_deviation("load", deviation)
        times, rows = np.asarray(t, dtype=np.float64), np.asarray(wrench, dtype=np.float64)
        if times.ndim != 1 or rows.shape != (len(times), 3):
            raise EstimateError(f"load: got t {times.shape} and wrench {rows.shape}, expected (n,) and (n, 3)")
        index = _in_order(times, (np.abs(rows) < _LARGEST_LOAD).all(axis=1))
        if len(index) < 2:
            raise EstimateError(f"load: got {len(index)} samples that can be used, expected at least 2")
        return Load(times[index], rows[index], deviation), len(times) - len(index)

    def between(self, start: float, end: float) -> Load:
        """Return the samples that determine the load in [start, end]."""
        first = max(int(np.searchsorted(self.t, start, side="right")) - 1, 0)
        last = min(int(np.searchsorted(self.t, end, side="left")) + 1, len(self.t))
        return Load(self.t[first:last], self.wrench[first:last])

    def longest_stretch(self) -> Load:
        """Return the longest part of the load in which no samples are missing."""
        apart = np.diff(self.t)
        silent = np.flatnonzero(apart > max(tuning.LONGEST_GAP[0], tuning.LONGEST_GAP[1] * float(np.median(apart))))
        if not len(silent):
            return self
        bounds = np.concatenate([[0], silent + 1, [len(self.t)]])
        spans = self.t[bounds[1:] - 1] - self.t[bounds[:-1]]
        first, end = bounds[int(np.argmax(spans)) :][:2]
        return Load(self.t[first:end], self.wrench[first:end], self.deviation)

    def newest(self, span: float) -> Load:
        """Return the samples of the last `span` s."""
        first = int(np.searchsorted(self.t, self.t[-1] - span))
        first = min(first, len(self.t) - 2)
        return Load(self.t[first:], self.wrench[first:], self.deviation)

    def interval(self) -> float:
        """Return the median interval of the samples in s."""
        return float(np.median(np.diff(self.t)))

    def gain_deviations(self) -> Array:
        """Return the stated deviations as shares of the components' root mean squares, shape (3,); 0 without a load."""
        size = np.sqrt((self.wrench**2).mean(axis=0))
        shares: Array = np.divide(self.deviation, size, out=np.zeros(3), where=size > 0.0)
        return shares

    def period(self) -> float:
        """Return the period in s of the strongest oscillation, or a tenth of the span without one."""
        return self.oscillation() or float(self.t[-1] - self.t[0]) / 10.0

    def oscillation(self) -> float | None:
        """Return the period in s of the strongest oscillation, or None without one."""
        span = float(self.t[-1] - self.t[0])
        count = int(min(max(64, 4 * len(self.t)), 8192))
        grid = np.linspace(self.t[0], self.t[-1], count)
        columns = np.stack([np.interp(grid, self.t, column) for column in self.wrench.T])
        columns -= columns.mean(axis=1, keepdims=True)
        sizes = columns.std(axis=1)
        if not sizes.any():
            return None
        columns /= np.where(sizes > 0.0, sizes, 1.0)[:, None]
        power = (np.abs(np.fft.rfft(columns * np.hanning(count), axis=1)) ** 2).sum(axis=0)
        power[:2] = 0.0
        peak = int(np.argmax(power))
        return span / peak if power[peak - 1 : peak + 2].sum() > 0.3 * power.sum() else None

    def with_knot(self, t: float) -> Load:
        """Return the load with a further sample at `t` in s, interpolated."""
        place = int(np.searchsorted(self.t, t))
        if not 0 < place < len(self.t) or self.t[place] == t:
            return self
        value = [np.interp(t, self.t, column) for column in self.wrench.T]
        return Load(np.insert(self.t, place, t), np.insert(self.wrench, place, value, axis=0), self.deviation)

    def smooth(self, step: float) -> Load:
        """Return values of a cubic spline through the samples every `step` s, with the deviation `tuning.COARSE_GAIN`.

        Rare samples may be averages, which reduce the amplitude and keep the shape.
        """
        t = np.linspace(self.t[0], self.t[-1], math.ceil((self.t[-1] - self.t[0]) / step) + 1)
        size = tuning.COARSE_GAIN * np.sqrt((self.wrench**2).mean(axis=0))
        fx, fy, moment = np.hypot(size, self.deviation).tolist()
        return Load(t, np.asarray(CubicSpline(self.t, self.wrench)(t), np.float64), (fx, fy, moment))

    def thinned(self, share: float = 1e-3) -> Load:
        """Leave out samples that straight lines reproduce within `share` of the range (Ramer, Douglas and Peucker)."""
        return self.kept(self.significance(share) > share)

    def kept(self, keep: NDArray[np.bool_]) -> Load:
        """Return the samples selected by `keep`, shape (n,)."""
        return Load(self.t[keep], self.wrench[keep])

    def significance(self, share: float) -> Array:
        """Return for each sample the smallest `share` at which `thinned` leaves it out, shape (n,).

        It is infinite for the two ends, and 0 for samples that `share` itself leaves out.
        """
        scale = np.ptp(self.wrench, axis=0)
        rows = self.wrench / np.where(scale > 0.0, scale, 1.0)
        out = np.zeros(len(rows))
        out[[0, -1]] = np.inf
        # all lines of one level are divided at once; a line that is not divided has no lines in lower levels
        left, right, least = np.array([0]), np.array([len(rows) - 1]), np.array([np.inf])
        while len(left):
            inner = right - left > 1
            left, right, least = left[inner], right[inner], least[inner]
            if not len(left):
                break
            counts = right - left - 1
            first = np.concatenate([[0], np.cumsum(counts)])
            line = np.repeat(np.arange(len(left)), counts)
            place = np.arange(first[-1]) + (left + 1 - first[:-1])[line]
            along = (self.t[place] - self.t[left][line]) / (self.t[right] - self.t[left])[line]
            chord = rows[right] - rows[left]
            error = np.abs(rows[place] - rows[left][line] - along[:, None] * chord[line]).max(axis=1)
            largest = np.maximum.reduceat(error, first[:-1])
            # for each line, the first of the samples that are farthest from the line
            at = np.flatnonzero(error == largest[line])
            middle = place[at[np.unique(line[at], return_index=True)[1]]]
            least = np.minimum(least, largest)
            split = least > share
            left, right, middle, least = left[split], right[split], middle[split], least[split]
            out[middle] = least
            left, right = np.concatenate([left, middle]), np.concatenate([middle, right])
            least = np.concatenate([least, least])
        return out

    def _roughness(self) -> tuple[Array, Array, Array]:
        """Return the correlation from sample to sample, and spectral densities of the load and of the lines, (3,) each.

        The rough part of the load is modelled as an Ornstein-Uhlenbeck process with the correlation a from sample to
        sample. Consider the mean square distance of samples from the straight lines through their neighbours. With
        neighbours twice as far away, it grows by (1 + a) (3 - a^2) / (3 - a). The factor is 2 for a = 1, where the
        lines miss a Brownian bridge, and 1 for a = 0, where samples are too rare and the lines themselves are wrong.
        """
        if len(self.t) < 5:
            return np.ones(3), np.zeros(3), np.zeros(3)
        near = _from_lines(self.t, self.wrench)
        far = 0.5 * (_from_lines(self.t[::2], self.wrench[::2]) + _from_lines(self.t[1::2], self.wrench[1::2]))
        growth = np.divide(far, near, out=np.full(3, 2.0), where=near > 0.0)
        a = np.linspace(0.0, 1.0, 101)[1:-1]
        a = np.interp(growth, (1.0 + a) * (3.0 - a * a) / (3.0 - a), a)
        variance = 2.0 * near * float(np.diff(self.t).mean()) / ((1.0 - a) * (3.0 - a))
        return a, -2.0 * variance / np.log(a), variance * (1.0 + a) / (1.0 - a)

    def believable(self) -> Load:
        """Return the best estimate of the load between its samples, with the spectral density of its unknown part.

        Rare samples without correlation say little about the load between them, so only their strong oscillations are
        kept.
        """
        correlation, its, of_samples = self._roughness()
        # samples count as uncorrelated if their correlation is within three standard errors of zero
        rare = (correlation < 3.0 / math.sqrt(len(self.t))) & (self.interval() > RESOLVING)
        fx, fy, moment = np.where(rare, its, of_samples - its).tolist()
        if not rare.any():
            return replace(self, unknown=(fx, fy, moment))
        t = np.linspace(self.t[0], self.t[-1], len(self.t))
        wrench = np.stack([np.interp(t, self.t, column) for column in self.wrench.T], axis=1)
        mean = wrench.mean(axis=0)
        lines = np.fft.rfft(wrench - mean, axis=0)
        power = np.abs(lines) ** 2 * float(t[1] - t[0]) / len(t)
        strong = np.fft.irfft(np.where(power > 0.5 * tuning.OUTLYING**2 * of_samples, lines, 0.0), len(t), axis=0)
        return Load(t, np.where(rare, mean + strong, wrench), self.deviation, (fx, fy, moment))

    def averaged(self, count: int) -> Load:
        """Return `count` equidistant knots, joined by the straight lines that fit this load best (least squares).

        The remainder has a mean of zero over some knots, so it hardly moves the head.
        """
        knots = np.linspace(self.t[0], self.t[-1], count)
        within = max(_FINER, math.ceil(2.0 * len(self.t) / count))
        place = np.arange((count - 1) * within + 1) / within
        times = self.t[0] + (self.t[-1] - self.t[0]) * place / (count - 1)
        left = np.minimum(place.astype(np.int64), count - 2)
        share = place - left
        # the bands of the normal equations, whose matrix is tridiagonal
        bands = np.zeros((2, count))
        bands[1] = np.bincount(left, (1.0 - share) ** 2, count) + np.bincount(left + 1, share**2, count)
        bands[0, 1:] = np.bincount(left, share * (1.0 - share), count)[:-1]
        columns = []
        for column in self.wrench.T:
            value = np.interp(times, self.t, column)
            columns.append(
                np.bincount(left, (1.0 - share) * value, count) + np.bincount(left + 1, share * value, count)
            )
        return Load(knots, solveh_banded(bands, np.stack(columns, axis=1)))


def _from_lines(t: Array, value: Array) -> Array:
    """Return the mean square distance of inner values from the lines through their neighbours, shape (3,)."""
    step = np.diff(t)
    slope = np.diff(value, axis=0) / step[:, None]
    off = np.diff(slope, axis=0) * (step[:-1] * step[1:] / (step[:-1] + step[1:]))[:, None]
    mean: Array = (off**2).mean(axis=0)
    return mean


def filled(poses: Poses) -> Array:
    """Return the poses with missing values bridged by straight lines.

    A component that was never measured has its assumed values, or zeros.
    """
    out = np.zeros_like(poses.q) if poses.assumed is None else poses.assumed.copy()
    for i, column in enumerate(poses.q.T):
        there = np.isfinite(column)
        if there.any():
            out[:, i] = np.interp(poses.t, poses.t[there], column[there])
    return out


def own_deviations(brought: Iterable[tuple[float, ...]]) -> Array:
    """Return the deviations that the messages of poses state, shape (n, 3); NaN where a message states none."""
    return np.array([one or (math.nan,) * 3 for one in brought], dtype=np.float64).reshape(-1, 3)


def useless_deviation() -> Deviation:
    """Return the stated deviations of x, y [m], theta [rad] above which a component is treated as not measured."""
    return tuple(tuning.MUCH_WORSE * bias for bias in priors.BIAS)


def believed(stated: Deviation, q: Array, own: Array) -> tuple[Array, Deviation]:
    """Return poses without components of a large stated deviation, and the deviation of the others.

    Parameters
    ----------
    stated : tuple of 3 float
        Smallest deviation of each component.
    q, own : ndarray, shape (n, 3)
        Poses, and the deviations stated with them; NaN where not stated.

    Returns
    -------
    ndarray, tuple of 3 float
        Poses, NaN where left out; root mean square of the deviations of the others, at least `stated`.
    """
    known = [column[np.isfinite(column)] for column in own.T]
    usual = np.array([float(np.median(column)) if len(column) else 0.0 for column in known])
    worse = own > np.minimum(useless_deviation(), np.where(usual > 0.0, tuning.MUCH_WORSE * usual, np.inf))
    kept = np.where(worse | ~np.isfinite(own), 0.0, own)
    count = np.maximum((np.isfinite(own) & ~worse).sum(axis=0), 1)
    x, y, theta = np.maximum(stated, np.sqrt((kept**2).sum(axis=0) / count)).tolist()
    return np.where(worse, np.nan, q), (x, y, theta)


def _check_deviation(name: str, deviation: Deviation) -> None:
    if len(deviation) != 3 or not all(0.0 <= value < math.inf for value in deviation):
        raise EstimateError(f"{name}: got the deviations {deviation}, expected three finite numbers >= 0")


def _in_order(times: Array, usable: Any) -> NDArray[np.int64]:
    """Return the indices of usable rows in order of time; of rows with equal stamps only the first is kept."""
    candidates = np.flatnonzero(usable & np.isfinite(times))
    _, first = np.unique(times[candidates], return_index=True)
    index: NDArray[np.int64] = candidates[first]
    return index


def usable_rows(
    t: ArrayLike, values: ArrayLike, largest: float, names: tuple[str, str], error: type[PlowTwinError]
) -> tuple[Array, Array, int]:
    """Return stamps (n,) and rows of numbers by pair (n, 8) in order of time, and the number of rows left out.

    Rows are left out if their stamp is not finite or repeated, if they have no number, or a number beyond `largest`.
    Arrays of the wrong shape raise `error`; `names` are the words for the rows and for a number in its message.
    """
    times, rows = np.asarray(t, dtype=np.float64), np.array(values, dtype=np.float64)
    if times.ndim != 1 or rows.shape != (len(times), PAIR_COUNT):
        got = f"t {times.shape} and {names[1]} {rows.shape}"
        raise error(f"{names[0]}: got {got}, expected (n,) and (n, {PAIR_COUNT})")
    rows[~np.isfinite(rows)] = np.nan
    absurd = (np.abs(rows) > largest).any(axis=1)
    index = _in_order(times, np.isfinite(rows).any(axis=1) & ~absurd)
    return times[index], rows[index], len(times) - len(index)
