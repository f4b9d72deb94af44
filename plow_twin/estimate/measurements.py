"""Input of the estimate: measured poses and measured loads, as arrays with stamps of one clock."""

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
#: Standard deviations of a pose or a load without stated deviations, by definition.
UNSTATED: Deviation = (0.0, 0.0, 0.0)
#: Smallest numbers of values for a standard deviation of load cells in contact, of poses and gaps, and in a comparison,
#: derived from the relative error 1 / sqrt(2 n) for n values.
FEWEST_IN_CONTACT, FEWEST_POSES, FEWEST_FOR_SCATTER = 10, 20, 50
#: Upper bound on the interval in s between poses or samples that resolve the motion in a soft contact.
RESOLVING: Final = 0.02
#: Lower bound on the number of points between two knots when a load is averaged.
_FINER = 8
#: Largest accepted component of a pose in m or rad, and of a load in N or N m, guards against faulty data.
_LARGEST_POSE, _LARGEST_LOAD = 1e6, 1e15


class EstimateError(PlowTwinError):
    """The data cannot be used for an estimate."""


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
        Poses of a model. Where all three components are needed, they replace a component that was never measured.
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
        """Return the usable rows in order of time, and the number of rows that are left out.

        A row is left out if its stamp is not finite or repeated, if no component is finite, or if a component is above
        1e6.

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
        """Return the median interval of the rows in s, divided by the share of components that were measured."""
        measured = int(np.isfinite(self.q).sum())
        return float(np.median(np.diff(self.t))) * self.q.size / max(measured, 1)

    def gap(self) -> float:
        """Return the median of the gaps in s between measured values of a component, weighted by their lengths."""
        gaps = np.sort(np.concatenate([np.diff(self.t[np.isfinite(column)]) for column in self.q.T]))
        return float(gaps[np.searchsorted(gaps.cumsum(), 0.5 * gaps.sum())])

    def between(self, start: float, end: float) -> Poses:
        """Return the poses with stamps in [start, end)."""
        inside = (self.t >= start) & (self.t < end)
        assumed = None if self.assumed is None else self.assumed[inside]
        return Poses(self.t[inside], self.q[inside], self.deviation, assumed)

    def moved(self, by: Array) -> Poses:
        """Return the poses plus `by`, shape (3,)."""
        return replace(self, q=self.q + by, assumed=None if self.assumed is None else self.assumed + by)

    def without_spikes(self, level: Array) -> tuple[Poses, int]:
        """Return the poses without spikes, and the number of spikes.

        A spike is a value far from all four neighbours, compared with the noise `level`, shape (3,). Too many spikes
        show a faulty sensor and are kept.
        """
        if len(self.t) < FEWEST_FOR_SCATTER:
            return self, 0
        about = np.stack([np.roll(self.q, shift, axis=0) for shift in (-2, -1, 1, 2)])
        low, high = about.min(axis=0), about.max(axis=0)
        far = tuning.SPIKE[0] * level + (high - low)
        # a value next to a missing value (NaN) is not a spike
        spikes = (self.q > high + far) | (self.q < low - far)
        spikes[[0, 1, -2, -1]] = False
        count = int(spikes.sum())
        if not count or spikes.mean(axis=0).max() > tuning.SPIKE[1]:
            return self, 0
        return Poses(self.t, np.where(spikes, np.nan, self.q), self.deviation), count

    def fresh(self) -> Poses:
        """Return the poses without repeated values, which occur if a sensor is slower than its sender.

        A value that is repeated for a long time shows a stopped sensor and is kept.
        """
        previous, next_one = self.q[:-1], self.q[1:]
        repeated = ((previous == next_one) | (np.isnan(previous) & np.isnan(next_one))).all(axis=1)
        if repeated.mean() < tuning.REPEATING[0] if len(repeated) else True:
            return self
        first = np.flatnonzero(np.append(True, ~repeated))
        lengths = np.diff(np.append(first, len(self.t)))
        if len(first) < FEWEST_FOR_SCATTER or lengths.max() > tuning.REPEATING[1] * lengths.mean() + 1.0:
            return self
        return Poses(self.t[first], self.q[first], self.deviation)


@dataclass(frozen=True, eq=False)
class Load:
    """The measured load, which is linear between samples and constant before the first and after the last sample.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times in s, strictly increasing.
    wrench : ndarray, shape (n, 3)
        Fx, Fy [N] and M [N m] about the cavity's centre, without gravity.
    deviation : tuple of 3 float
        Stated standard deviation of each component; 0 if not stated.
    unknown : tuple of 3 float
        Spectral density of the unknown part of the load between the samples, in N2 s and (N m)2 s, from the method
        `believable`.
    rare : bool
        Whether samples are so rare and uncorrelated that the method `believable` uses only their strong oscillations.
    """

    t: Array
    wrench: Array
    deviation: Deviation = UNSTATED
    unknown: Deviation = UNSTATED
    rare: bool = False

    @staticmethod
    def of(t: ArrayLike, wrench: ArrayLike, deviation: Deviation = UNSTATED) -> tuple[Load, int]:
        """Return the usable samples in order of time, and the number of samples that are left out.

        A sample is left out if it contains a number that is not finite or exceeds 1e15, or if its stamp occurs twice.

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

    @staticmethod
    def unmeasured(end: float, start: float = 0.0) -> Load:
        """Return a load of zero between two times in s, in place of a missing measurement."""
        return Load(np.array([start, end]), np.zeros((2, 3)))

    @property
    def missing(self) -> bool:
        """Whether the load is that of `unmeasured`."""
        return len(self.t) == 2 and not self.wrench.any()

    @property
    def constant(self) -> bool:
        """Whether all samples are equal, as without a measurement or behind a failed sensor."""
        return not np.ptp(self.wrench, axis=0).any()

    def at(self, t: Array) -> Array:
        """Return the linearly interpolated load at the times `t`, shape (n, 3)."""
        return interpolated(t, self.t, self.wrench)

    def between(self, start: float, end: float) -> Load:
        """Return the samples that determine the load in the closed interval [start, end]."""
        first = max(int(np.searchsorted(self.t, start, side="right")) - 1, 0)
        last = min(int(np.searchsorted(self.t, end, side="left")) + 1, len(self.t))
        return Load(self.t[first:last], self.wrench[first:last])

    def longest_stretch(self) -> Load:
        """Return the longest part of the load without long gaps between samples."""
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
        """Return the stated deviations divided by the root mean square of each component, shape (3,)."""
        size = np.sqrt((self.wrench**2).mean(axis=0))
        shares: Array = np.divide(self.deviation, size, out=np.zeros(3), where=size > 0.0)
        return shares

    def period(self) -> float:
        """Return the period in s of the strongest oscillation or, without any, a tenth of the load's span."""
        return self.oscillation() or float(self.t[-1] - self.t[0]) / 10.0

    def oscillation(self) -> float | None:
        """Return the period in s of the strongest oscillation, or None if there is no oscillation."""
        span = float(self.t[-1] - self.t[0])
        count = int(min(max(64, 4 * len(self.t)), 8192))
        grid = np.linspace(self.t[0], self.t[-1], count)
        columns = np.ascontiguousarray(self.at(grid).T)
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
        """Return the load with an additional, interpolated sample at the time `t` in s."""
        place = int(np.searchsorted(self.t, t))
        if not 0 < place < len(self.t) or self.t[place] == t:
            return self
        wrench = np.insert(self.wrench, place, self.at(np.array([t])), axis=0)
        return Load(np.insert(self.t, place, t), wrench, self.deviation)

    def smooth(self, step: float) -> Load:
        """Return values of a cubic spline through the samples at intervals of about `step` in s.

        Samples at long intervals may be averages, so the stated deviation of the result includes `tuning.COARSE_GAIN`.
        """
        t = np.linspace(self.t[0], self.t[-1], math.ceil((self.t[-1] - self.t[0]) / step) + 1)
        size = tuning.COARSE_GAIN * np.sqrt((self.wrench**2).mean(axis=0))
        fx, fy, moment = np.hypot(size, self.deviation).tolist()
        return Load(t, np.asarray(CubicSpline(self.t, self.wrench)(t), np.float64), (fx, fy, moment))

    def thinned(self, share: float = 1e-3) -> Load:
        """Return the load without samples that linear interpolation reproduces within `share` of the range.

        The algorithm is that of Ramer, Douglas and Peucker.
        """
        return self.kept(self.significance(share) > share)

    def kept(self, keep: NDArray[np.bool_]) -> Load:
        """Return the samples that the mask `keep`, shape (n,), selects."""
        return Load(self.t[keep], self.wrench[keep])

    def significance(self, share: float) -> Array:
        """Return for each sample the smallest argument of `thinned` for which the sample is left out, shape (n,).

        The result is infinite for the first and the last sample, and 0 for samples that `thinned(share)` leaves out.
        """
        scale = np.ptp(self.wrench, axis=0)
        rows = self.wrench / np.where(scale > 0.0, scale, 1.0)
        out = np.zeros(len(rows))
        out[[0, -1]] = np.inf
        # one recursion level at a time
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
            # first sample with the largest distance from each line
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
        """Return the correlation of samples, and the spectral densities of load and interpolation, shape (3,) each.

        The rough part of the load is modelled as an Ornstein-Uhlenbeck process with the correlation a of successive
        samples. With neighbours twice as far away, the mean square distance of samples from the straight line through
        two neighbours is larger by the factor (1 + a) (3 - a^2) / (3 - a): 2 for Brownian motion, 1 for uncorrelated
        samples.
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
        """Return the best estimate of the load between its samples, with the spectral density of the unknown part.

        Uncorrelated samples at long intervals do not determine the load between them, so only their strong oscillations
        are used.
        """
        correlation, density, of_samples = self._roughness()
        # a correlation within three standard errors of zero is not significant
        rare = (correlation < 3.0 / math.sqrt(len(self.t))) & (self.interval() > RESOLVING)
        fx, fy, moment = np.where(rare, density, of_samples - density).tolist()
        if not rare.any():
            return replace(self, unknown=(fx, fy, moment))
        t = np.linspace(self.t[0], self.t[-1], len(self.t))
        wrench = self.at(t)
        mean = wrench.mean(axis=0)
        lines = np.fft.rfft(wrench - mean, axis=0)
        power = np.abs(lines) ** 2 * float(t[1] - t[0]) / len(t)
        strong = np.fft.irfft(np.where(power > 0.5 * tuning.OUTLYING**2 * of_samples, lines, 0.0), len(t), axis=0)
        return Load(t, np.where(rare, mean + strong, wrench), self.deviation, (fx, fy, moment), rare=True)

    def averaged(self, count: int) -> Load:
        """Return the least-squares fit of a piecewise linear load with `count` equidistant knots.

        The difference from the load has a mean of zero over several knots, so it hardly moves the head.
        """
        knots = np.linspace(self.t[0], self.t[-1], count)
        within = max(_FINER, math.ceil(2.0 * len(self.t) / count))
        place = np.arange((count - 1) * within + 1) / within
        times = self.t[0] + (self.t[-1] - self.t[0]) * place / (count - 1)
        left = np.minimum(place.astype(np.int64), count - 2)
        share = place - left
        # tridiagonal normal equations
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
    """Return the mean square distance of values from the straight line through their two neighbours, shape (3,)."""
    step = np.diff(t)
    slope = np.diff(value, axis=0) / step[:, None]
    distance = np.diff(slope, axis=0) * (step[:-1] * step[1:] / (step[:-1] + step[1:]))[:, None]
    mean: Array = (distance**2).mean(axis=0)
    return mean


def interpolated(t: Array, times: Array, rows: Array) -> Array:
    """Return the rows at the times `times`, linearly interpolated at the times `t`."""
    return np.stack([np.interp(t, times, column) for column in rows.T], axis=1)


def filled(poses: Poses) -> Array:
    """Return the poses, shape (n, 3), with missing values interpolated linearly.

    A component that was never measured has its assumed values, or zeros without assumed values.
    """
    out = np.zeros_like(poses.q) if poses.assumed is None else poses.assumed.copy()
    for i, column in enumerate(poses.q.T):
        finite = np.isfinite(column)
        if finite.any():
            out[:, i] = np.interp(poses.t, poses.t[finite], column[finite])
    return out


def own_deviations(stated: Iterable[tuple[float, ...]]) -> Array:
    """Return the standard deviations in n messages of poses, shape (n, 3); NaN for a message without deviations."""
    return np.array([deviations or (math.nan,) * 3 for deviations in stated], dtype=np.float64).reshape(-1, 3)


def useless_deviation() -> Deviation:
    """Return the largest standard deviations of x, y [m] and theta [rad] with which a component is used."""
    return tuple(tuning.MUCH_WORSE * bias for bias in priors.BIAS)


def without_uncertain(stated: Deviation, q: Array, own: Array) -> tuple[Array, Deviation]:
    """Return poses without the components that have a large stated deviation, and the deviations of the others.

    Parameters
    ----------
    stated : tuple of 3 float
        Lower limit of the deviation of each component.
    q, own : ndarray, shape (n, 3)
        Poses, and standard deviations of their components. A deviation that is not stated is NaN.

    Returns
    -------
    q : ndarray, shape (n, 3)
        Poses, with NaN for components that are left out.
    deviation : tuple of 3 float
        Root mean square of the deviations of the remaining components, at least `stated`.
    """
    finite = [column[np.isfinite(column)] for column in own.T]
    usual = np.array([float(np.median(column)) if len(column) else 0.0 for column in finite])
    worse = own > np.minimum(useless_deviation(), np.where(usual > 0.0, tuning.MUCH_WORSE * usual, np.inf))
    kept = np.where(worse | ~np.isfinite(own), 0.0, own)
    count = np.maximum((np.isfinite(own) & ~worse).sum(axis=0), 1)
    x, y, theta = np.maximum(stated, np.sqrt((kept**2).sum(axis=0) / count)).tolist()
    return np.where(worse, np.nan, q), (x, y, theta)


def _check_deviation(name: str, deviation: Deviation) -> None:
    if len(deviation) != 3 or not all(0.0 <= value < math.inf for value in deviation):
        raise EstimateError(f"{name}: got the deviations {deviation}, expected three finite numbers >= 0")


def _in_order(times: Array, usable: Any) -> NDArray[np.int64]:
    """Return the indices of usable rows in order of time; of several rows with equal stamps, only the first."""
    candidates = np.flatnonzero(usable & np.isfinite(times))
    _, first = np.unique(times[candidates], return_index=True)
    index: NDArray[np.int64] = candidates[first]
    return index


def usable_rows(
    t: ArrayLike, values: ArrayLike, largest: float, names: tuple[str, str], error: type[PlowTwinError]
) -> tuple[Array, Array, int]:
    """Return stamps (n,) and rows (n, 8) in order of time, and the number of rows that are left out.

    A row is left out if its stamp is not finite or repeated, if it contains no number, or if a number exceeds
    `largest`. For arrays of the wrong shape, an exception of the type `error` with the texts `names` is raised.
    """
    times, rows = np.asarray(t, dtype=np.float64), np.array(values, dtype=np.float64)
    if times.ndim != 1 or rows.shape != (len(times), PAIR_COUNT):
        got = f"t {times.shape} and {names[1]} {rows.shape}"
        raise error(f"{names[0]}: got {got}, expected (n,) and (n, {PAIR_COUNT})")
    rows[~np.isfinite(rows)] = np.nan
    absurd = (np.abs(rows) > largest).any(axis=1)
    index = _in_order(times, np.isfinite(rows).any(axis=1) & ~absurd)
    return times[index], rows[index], len(times) - len(index)
