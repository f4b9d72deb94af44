"""The wear coefficient from clearances that were estimated over weeks.

The clearance grows along one path h(E) of the exposure E = k_s s / A (s the travel) for any coefficient k_s.
So a history of clearances against travel gives k_s: its posterior follows on a grid of ln k_s from the log-normal prior
of the scene's wear, with the clearance at the beginning integrated out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from plow_twin.estimate import tuning
from plow_twin.estimate.life import LifeError, Path, wear_path
from plow_twin.estimate.result import NORMAL_P95, Interval
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Clearance, Scene

Array = NDArray[np.float64]

#: Bound: points of the grid. Derived: range of the grid, four deviations of the prior to both sides: all but 6e-5 of
#: its probability.
_POINTS, _REACH = 801, 4.0
#: Bound: how far the path is followed beyond the history, in multiples of the clearance's growth, plus a depth in m.
_FURTHER, _FURTHER_M = 2.0, 5e-4


@dataclass(frozen=True, eq=False)
class History:
    """Estimated clearances against travel.

    travel : (n,) along the face since the first one, in m, never falling
    clearance, deviation : (n, 2) horizontal and vertical with their standard deviations, in m
    """

    travel: Array
    clearance: Array
    deviation: Array

    def __post_init__(self) -> None:
        """Raise LifeError where the rows cannot be used."""
        shape, count = self.clearance.shape, len(self.travel)
        if shape != (count, 2) or self.deviation.shape != (count, 2) or count < 2:
            raise LifeError(f"history: got {count} travels and clearances {shape}, expected at least 2 rows of both")
        finite = all(np.isfinite(column).all() for column in (self.travel, self.clearance, self.deviation))
        positive = (self.clearance > 0.0).all() and (self.deviation > 0.0).all()
        if not (finite and positive and (np.diff(self.travel) >= 0.0).all()):
            raise LifeError(
                "history: got a row that is not finite, not above zero, without a deviation or back in travel, "
                "expected none"
            )


@dataclass(frozen=True, eq=False)
class Coefficient:
    """Posterior of the wear coefficient, and the clearances at the end of the history.

    value, weight : (m,) k_s in m^2/N on a grid, and its probabilities
    clearance, deviation : (2,) in m
    depth : (8,) of the pads in m, as the path of the history has it: they are not worn alike
    """

    value: Array
    weight: Array
    clearance: Array
    deviation: Array
    depth: Array

    def interval(self) -> Interval:
        """Return median and 5 % and 95 % points in m^2/N."""
        return Interval(self.quantile(0.5), self.quantile(0.05), self.quantile(0.95))

    def quantile(self, share: float) -> float:
        """Return a point of the distribution in m^2/N, widened by `tuning.PATH_DEVIATION`."""
        middle, point = np.log(np.interp([0.5, share], np.cumsum(self.weight), self.value))
        off = math.hypot(point - middle, tuning.PATH_DEVIATION * float(ndtri(share)))
        return math.exp(float(middle) + math.copysign(off, share - 0.5))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Return coefficients drawn from the posterior, shape (count,)."""
        drawn: Array = np.interp(rng.random(count), np.cumsum(self.weight), self.value)
        return drawn


def coefficient(scene: Scene, history: History) -> Coefficient:
    """Return the posterior of the wear coefficient from a history.

    Parameters
    ----------
    scene : Scene
        With wear, whose `prior_m2_n` is the prior; its clearances are replaced by the first of the history.
    history : History

    Raises
    ------
    LifeError
        Where the scene has no wear or no period, or the history cannot be used or contradicts the prior or wear itself.
    """
    wear = scene.wear
    if wear is None:
        raise LifeError("wear: got none, expected its parameters")
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
        depths[index] = [np.interp(now, path.exposure, pad) for pad in path.depth.T]
    share = np.exp(likely - likely.max())
    share /= share.sum()
    ends = np.exp(grid[[0, -1]])
    if max(share[0], share[-1]) > tuning.LEAST_PROBABLE[1]:
        raise LifeError(
            f"history: got a growth that the prior of the coefficient does not allow, from {ends[0]:.2g} to "
            f"{ends[1]:.2g} m^2/N, expected a wider wear.prior_m2_n"
        )
    _check_fit(history, _growth(path, math.exp(float(grid[share.argmax()])) * history.travel / wear.pad_area_m2))
    clearance = share @ means
    variance = share @ (means - clearance) ** 2 + 1.0 / weight.sum(axis=0)
    return Coefficient(np.exp(grid), share, clearance, np.sqrt(variance), share @ depths)


def _check_fit(history: History, grown: Array) -> None:
    """Raise LifeError where clearances deviate more from a growth, shape (n, 2), than their deviations allow.

    The growth itself is known to within `tuning.PATH_DEVIATION`.
    """
    weight = 1.0 / (history.deviation**2 + (tuning.PATH_DEVIATION * grown) ** 2)
    apart = history.clearance - grown
    apart -= (weight * apart).sum(axis=0) / weight.sum(axis=0)
    square, freedom = float((weight * apart**2).sum()), 2 * (len(apart) - 1)
    if chdtrc(freedom, square) < tuning.LEAST_PROBABLE[0]:
        row, axis = np.unravel_index(int((weight * apart**2).argmax()), apart.shape)
        name = ("horizontally", "vertically")[axis]
        raise LifeError(
            f"history: got clearances that no wear of this scene explains (chi^2 {square:.3g} with {freedom} degrees "
            f"of freedom, row {row + 1} is {1e3 * apart[row, axis]:+.3g} mm off {name}), expected ones that grow, with "
            "the deviations that they have"
        )


def _growth(path: Path, exposure: Array) -> Array:
    """Return how much the clearances have grown at each exposure, shape (n, 2); beyond the path by its last slope."""
    grown = path.clearance_growth()
    out = np.stack([np.interp(exposure, path.exposure, column) for column in grown.T], axis=1)
    if len(path.exposure) > 1:
        slope = (grown[-1] - grown[-2]) / (path.exposure[-1] - path.exposure[-2])
        out += np.maximum(exposure - path.exposure[-1], 0.0)[:, None] * slope
    return out
