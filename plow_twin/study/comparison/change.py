"""Statistical comparison of two groups of windows, with and without the effect of the load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import false_discovery_control
from scipy.stats import t as student

Array = NDArray[np.float64]

#: Number of bootstrap draws. With 1000 draws, the share of draws below the 2.5 % point has a standard error of 0.5 %.
_DRAWS: Final = 1000
FEWEST: Final = 8
#: Standard deviation of the load within the groups, relative to its mean, below which its effect is not estimated.
_LEAST_VARIATION: Final = 0.01
#: Relative difference below which two mean loads are treated as equal.
_EQUAL_LOAD: Final = 0.01
#: Percentiles [%] between which the loads of two groups must overlap, so that the effect of the load is not
#: extrapolated.
_USUAL: Final = (5.0, 95.0)
_LEVEL: Final = 0.05
#: Number of windows drawn at once, which limits the memory.
_AT_ONCE: Final = 2**21
#: Largest relative difference that is attributed to rounding errors.
ROUNDING: Final = 1e-12
#: Largest distance between the starts of two windows, in window lengths, for which the windows are neighbours.
_NEXT: Final = 1.5


@dataclass(frozen=True)
class Change:
    """Change of a mean from one group of windows to another, relative to the mean of the first group.

    `low` and `high` are the ends of the 95 % interval of `share`. `chance` is the probability that such a change occurs
    by chance. A *cell* of a comparison is one quantity of one pair, or one clearance. The probabilities of all cells
    are adjusted together by the method of Benjamini and Hochberg. Among the cells with an adjusted probability below
    0.05, about one in twenty has not changed.

    The fields `machine`, `machine_low`, `machine_high` and `machine_chance` describe the change at equal load in the
    same way. They are None if the loads of the two groups do not overlap, or if the load varies too little within the
    groups.
    """

    share: float
    low: float
    high: float
    chance: float
    machine: float | None = None
    machine_low: float | None = None
    machine_high: float | None = None
    machine_chance: float | None = None

    @property
    def verdict(self) -> str:
        """The word `chance`, or the cause of a significant change (`machine`, `load`, or `load or machine`)."""
        if self.chance > _LEVEL:
            return "chance"
        if self.machine_chance is None:
            return "load or machine"
        return "load" if self.machine_chance > _LEVEL else "machine"


def points(values: Array) -> dict[str, float]:
    """Return the mean and the 5 %, 50 % and 95 % points of values, shape (n,)."""
    p05, p50, p95 = np.percentile(values, (5.0, 50.0, 95.0)).tolist()
    return {"mean": float(values.mean()), "p05": p05, "p50": p50, "p95": p95}


def with_neighbours(load: Array, start_ns: NDArray[np.int64]) -> Array:
    """Return the load of each window and the loads of its two neighbours in time, shape (n, 3).

    The motion in a window depends on the load in the window and in its two neighbours. The effect of a lasting change
    of the load is therefore the sum of the slopes with respect to all three loads. A missing neighbour is replaced by
    the window itself.
    """
    steps = np.diff(start_ns)
    joined = (steps > 0) & (steps < _NEXT * np.median(steps)) if len(steps) else steps > 0
    before = np.where(joined, load[:-1], load[1:])
    after = np.where(joined, load[1:], load[:-1])
    return np.column_stack((load, np.append(load[:1], before), np.append(after, load[-1:])))


class Drawn:
    """Means and covariances of a group of windows. Row 0 is for all windows, each further row for one bootstrap draw.

    `values`, shape (n, k), are the quantities of n windows. The first column of `load`, shape (n,) or (n, m), is the
    load of each window.
    """

    def __init__(self, values: Array, load: Array, random: np.random.Generator, draws: int = _DRAWS) -> None:
        load = load.reshape(len(load), -1)
        self.size, width = load.shape
        #: Lower and upper limit of the usual loads.
        self.usual = np.percentile(load[:, 0], _USUAL)
        whole = np.hstack((load, values))
        usual = whole.mean(axis=0)
        centred = whole - usual
        means, products = [np.zeros((1, whole.shape[1]))], [centred[:, :width].T @ centred / self.size]
        done = 0
        while done < draws:
            count = min(draws - done, max(1, _AT_ONCE // self.size))
            done += count
            times = np.stack(
                [np.bincount(random.integers(0, self.size, self.size), minlength=self.size) for _ in range(count)]
            )
            weights = times / self.size
            means.append(weights @ centred)
            products.append(np.stack([weights @ (centred[:, [column]] * centred) for column in range(width)], axis=1))
        offset = np.concatenate(means)
        #: Means of the quantities, shape (draws + 1, k), and of the loads, shape (draws + 1, m).
        self.mean, self.load = (usual + offset)[:, width:], (usual + offset)[:, :width]
        second = np.concatenate([part.reshape(-1, width, whole.shape[1]) for part in products])
        #: Covariances of the loads with all loads and quantities, shape (draws + 1, m, m + k).
        self.within = second - offset[:, :width, None] * offset[:, None, :]


def changes(before: Drawn, after: Drawn) -> list[Change | None]:
    """Return the change of each quantity between two groups of windows, or None if a group has too few windows.

    The means are compared by a bootstrap over windows. The comparison at equal load subtracts the part of a change that
    the load causes (analysis of covariance). The effect of the load is estimated from its variation within the groups.

    References
    ----------
    Benjamini, Hochberg (1995), Controlling the false discovery rate, J. R. Stat. Soc. B 57.
    """
    result: list[Change | None] = [None] * before.mean.shape[1]
    fewest = min(before.size, after.size)
    positive = np.flatnonzero(before.mean[0] > 0.0)
    if fewest < FEWEST:
        return result
    mean = before.mean[:, positive]
    effect = _tested(after.mean[:, positive] - mean, mean, fewest)
    at_equal_load = None
    if not _apart(before, after):
        rest = _at_equal_load(before, after)[:, positive]
        determined = np.isfinite(rest[:, 0]) if len(positive) else np.zeros(len(rest), bool)
        if determined[0] and determined[1:].mean() >= 0.9:
            at_equal_load = _tested(rest[determined], mean[determined], fewest)
    for place, cell in enumerate(positive.tolist()):
        machine = (None,) * 4 if at_equal_load is None else (part[place].item() for part in at_equal_load)
        result[cell] = Change(*(part[place].item() for part in effect), *machine)
    return result


def _tested(differences: Array, mean: Array, fewest: int) -> tuple[Array, Array, Array, Array]:
    """Return share, low, high and adjusted probability of each column. Row 0 contains values, all further rows contain
    draws.

    Student's t distribution has the degrees of freedom of the smaller group, so the probabilities are rather too large.
    """
    drawn = np.divide(differences, mean, out=np.full_like(mean, np.nan), where=mean > 0.0)
    low, high = np.nanpercentile(drawn[1:], (2.5, 97.5), axis=0)
    share, spread = drawn[0], differences[1:].std(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        chance = 2.0 * student.sf(np.abs(differences[0] / spread), fewest - 1)
    chance[np.abs(share) <= ROUNDING] = 1.0
    return share, low, high, false_discovery_control(chance) if len(chance) else chance


def _apart(before: Drawn, after: Drawn) -> bool:
    first, second = before.load[0, 0], after.load[0, 0]
    differ = abs(second - first) >= _EQUAL_LOAD * first
    return bool(differ and (before.usual[0] > after.usual[1] or after.usual[0] > before.usual[1]))


def _at_equal_load(before: Drawn, after: Drawn) -> Array:
    """Return the differences of the means at the load of the first group, or NaN if the load hardly varies."""
    usual, difference = before.load[:, 0], after.load - before.load
    changed = np.abs(difference[:, 0]) >= _EQUAL_LOAD * usual
    width, size = difference.shape[1], before.size + after.size
    within = (before.size * before.within + after.size * after.within) / size
    slopes = np.linalg.pinv(within[:, :, :width], hermitian=True) @ within[:, :, width:]
    followed = np.einsum("dm,dmk->dk", np.where(changed[:, None], difference, 0.0), slopes)
    rest = after.mean - before.mean - followed
    still = np.sqrt(np.maximum(within[:, 0, 0], 0.0)) < _LEAST_VARIATION * usual
    rest[changed & still] = np.nan
    return np.asarray(rest)
