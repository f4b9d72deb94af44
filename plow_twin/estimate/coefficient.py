"""Posterior of the wear coefficient, from clearances that were estimated over weeks.

The exposure of a pad is E = k_s s / A, where k_s is the wear coefficient, s the travel and A the area of the pad. The
clearance is a function of E only, so a history of clearances against travel determines k_s. The posterior is computed
on a grid of ln k_s with the log-normal prior of the scene's wear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from plow_twin.estimate import tuning
from plow_twin.estimate.life import LifeError, Path, wear_path
from plow_twin.estimate.measurements import interpolated
from plow_twin.estimate.result import NORMAL_P95, Interval
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Clearance, Scene

Array = NDArray[np.float64]

#: Upper bound on the number of grid points, and half width of the grid in prior deviations.
_POINTS, _REACH = 801, 4.0
#: Bounds on the simulated wear path, on which a clearance grows by `_FURTHER_M` [m] plus `_FURTHER` times the growth in
#: the history.
_FURTHER, _FURTHER_M = 2.0, 5e-4


class RowError(LifeError):
    """A row of a history cannot be used. The attribute `row` is its index."""

    def __init__(self, row: int, got: str) -> None:
        super().__init__(
            f"history: row {row}: got {got}, expected finite numbers, clearances and deviations above 0, and a travel "
            "that does not decrease"
        )
        self.row = row


@dataclass(frozen=True, eq=False)
class History:
    """Estimated clearances at several values of the travel.

    travel : (n,) travel along the face in m since the first row; it must not decrease
    clearance : (n, 2) horizontal and vertical clearance in m
    deviation : (n, 2) standard deviations of the clearances in m
    """

    travel: Array
    clearance: Array
    deviation: Array

    def __post_init__(self) -> None:
        """Raise `LifeError` if there are too few rows, and `RowError` if a row cannot be used."""
        shape, count = self.clearance.shape, len(self.travel)
        if shape != (count, 2) or self.deviation.shape != (count, 2) or count < 2:
            raise LifeError(f"history: got {count} travels and clearances {shape}, expected at least 2 rows of both")
        columns = np.column_stack([self.travel, self.clearance, self.deviation])
        rises = np.diff(self.travel, prepend=-np.inf) >= 0.0
        possible = (np.isfinite(columns) & (columns > [-np.inf, 0.0, 0.0, 0.0, 0.0])).all(axis=1) & rises
        if not possible.all():
            row = int(np.argmin(possible))
            raise RowError(row, str(columns[row].tolist()))


@dataclass(frozen=True, eq=False)
class Coefficient:
    """Posterior of the wear coefficient, and the state at the end of the history.

    value : (m,) values of the wear coefficient k_s in m^2/N on a grid
    weight : (m,) probability of each value
    clearance : (2,) horizontal and vertical clearance in m
    deviation : (2,) standard deviations of the clearances in m
    depth : (8,) wear depth of each pad in m, from the simulated wear path
    """

    value: Array
    weight: Array
    clearance: Array
    deviation: Array
    depth: Array

    def interval(self) -> Interval:
        """Return the median and the 5 % and 95 % quantiles of k_s in m^2/N."""
        return Interval(self.quantile(0.5), self.quantile(0.05), self.quantile(0.95))

    def quantile(self, share: float) -> float:
        """Return the quantile of k_s in m^2/N below which the probability is `share`, with the model error included."""
        middle, point = np.log(np.interp([0.5, share], np.cumsum(self.weight), self.value))
        distance = math.hypot(point - middle, tuning.PATH_DEVIATION * float(ndtri(share)))
        return math.exp(float(middle) + math.copysign(distance, share - 0.5))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Return random values of k_s in m^2/N from the posterior, shape (count,)."""
        drawn: Array = np.interp(rng.random(count), np.cumsum(self.weight), self.value)
        return drawn


def coefficient(scene: Scene, history: History) -> Coefficient:
    """Return the posterior of the wear coefficient, given a history.

    Parameters
    ----------
    scene : Scene
        A scene with wear; `wear.prior_m2_n` is the prior. Its clearances are replaced by the first row of the history.
    history : History
        Clearances at several values of the travel.

    Raises
    ------
    LifeError
        If the scene has no wear or no period, or if the history contradicts the prior or cannot be explained by wear.
    """
    wear = scene.wear
    if wear is None:
        raise LifeError("wear: got no wear, expected a section `wear`")
    weight = 1.0 / history.deviation**2
    first = history.clearance[0]
    growth = np.ptp(history.clearance, axis=0)
    begin = replace(scene, clearance=Clearance(float(first[0]), float(first[1])))
    low, high = (math.log(value) for value in wear.prior_m2_n)
    middle, spread = 0.5 * (low + high), max((high - low) / (2.0 * NORMAL_P95), 1e-6)
    grid = middle + spread * np.linspace(-_REACH, _REACH, _POINTS)
    most = math.exp(float(grid[-1])) * float(history.travel[-1]) / wear.pad_area_m2
    limit = first + _FURTHER * growth + _FURTHER_M
    path = wear_path(begin, (float(limit[0]), float(limit[1])), most)
    likely, means, depths = np.empty(len(grid)), np.empty((len(grid), 2)), np.empty((len(grid), PAIR_COUNT))
    for index, ln_k in enumerate(grid):
        grown = _growth(path, math.exp(float(ln_k)) * history.travel / wear.pad_area_m2)
        start = (weight * (history.clearance - grown)).sum(axis=0) / weight.sum(axis=0)
        misfit = history.clearance - grown - start
        likely[index] = -0.5 * float((weight * misfit**2).sum() + ((ln_k - middle) / spread) ** 2)
        means[index] = start + grown[-1]
        now = math.exp(float(ln_k)) * float(history.travel[-1]) / wear.pad_area_m2
        depths[index] = interpolated(np.array([now]), path.exposure, path.depth)
    share = np.exp(likely - likely.max())
    share /= share.sum()
    if max(share[0], share[-1]) > tuning.LEAST_PROBABLE[1]:
        raise LifeError(
            "history: got a growth that the coefficient's prior, {:.3g} to {:.3g} m^2/N, hardly allows, expected a "
            "wider wear.prior_m2_n".format(*wear.prior_m2_n)
        )
    _check_fit(history, _growth(path, math.exp(float(grid[share.argmax()])) * history.travel / wear.pad_area_m2))
    clearance = share @ means
    variance = share @ (means - clearance) ** 2 + 1.0 / weight.sum(axis=0)
    return Coefficient(np.exp(grid), share, clearance, np.sqrt(variance), share @ depths)


def _check_fit(history: History, growth: Array) -> None:
    """Raise `LifeError` if the clearances contradict the growth `growth`, shape (n, 2), in a chi-square test."""
    weight = 1.0 / (history.deviation**2 + (tuning.PATH_DEVIATION * growth) ** 2)
    apart = history.clearance - growth
    apart -= (weight * apart).sum(axis=0) / weight.sum(axis=0)
    square, freedom = float((weight * apart**2).sum()), 2 * (len(apart) - 1)
    if chdtrc(freedom, square) < tuning.LEAST_PROBABLE[0]:
        row, axis = np.unravel_index(int((weight * apart**2).argmax()), apart.shape)
        name = ("horizontally", "vertically")[axis]
        raise LifeError(
            f"history: got clearances that no wear of this scene explains (chi^2 {square:.3g} with {freedom} degrees "
            f"of freedom, row {row + 1} is {1e3 * apart[row, axis]:+.3g} mm off {name}), expected growing clearances "
            "with their true deviations"
        )


def _growth(path: Path, exposure: Array) -> Array:
    growth = path.clearance_growth()
    out = interpolated(exposure, path.exposure, growth)
    if len(path.exposure) > 1:
        slope = (growth[-1] - growth[-2]) / (path.exposure[-1] - path.exposure[-2])
        out += np.maximum(exposure - path.exposure[-1], 0.0)[:, None] * slope
    return out
