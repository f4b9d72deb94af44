"""Comparison of groups of windows: distributions, changes with intervals, and the effect of the load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import false_discovery_control
from scipy.stats import t as student

Array = NDArray[np.float64]

#: Number of bootstrap draws, with which the 2.5 % point of an interval has a standard error of 0.5 %.
_DRAWS: Final = 1000
#: Smallest number of windows that can distinguish a change from chance.
FEWEST: Final = 8
#: Smallest variation of the load within groups, relative to the mean load; a smaller variation does not show how a
#: quantity depends on the load.
_LEAST_VARIATION: Final = 0.01
#: If the loads of two groups differ by less than this share, they are treated as equal.
_EQUAL_LOAD: Final = 0.01
#: The loads of two groups must overlap between these percentiles [%], because a slope is valid only near the loads from
#: which it was computed.
_USUAL: Final = (5.0, 95.0)
#: Probability below which a change is statistically significant.
_LEVEL: Final = 0.05
#: Number of windows that are drawn at once; it limits the memory that is used.
_AT_ONCE: Final = 2**21
#: Relative difference that rounding alone can cause between the means of equal numbers.
_ROUNDING: Final = 1e-12
#: Largest distance between the starts of two windows that count as neighbours, in window lengths.
_NEXT: Final = 1.5


@dataclass(frozen=True)
class Change:
    """Change of a mean from one group to another, relative to the first mean.

    Attributes
    ----------
    share, low, high : float
        The relative change and the limits of its 95 % interval.
    chance : float
        Probability that such a change occurs by chance, adjusted for the number of cells (a quantity of a pair, or a
        clearance) that are judged together (Benjamini and Hochberg). Of the cells with a probability below 0.05, about
        one in twenty is below 0.05 only by chance.
    machine, machine_low, machine_high, machine_chance : float or None
        The same four numbers for the change at equal load; None if the load varies too little to show how the quantity
        depends on it, or if the loads of the groups do not overlap.
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
        """`chance`, or the cause of a significant change: `machine`, `load`, or `load or machine`."""
        if self.chance > _LEVEL:
            return "chance"
        if self.machine_chance is None:
            return "load or machine"
        return "load" if self.machine_chance > _LEVEL else "machine"


def points(values: Array) -> dict[str, float]:
    """Return mean, 5 %, 50 % and 95 % points of the values of windows, shape (n,)."""
    p05, p50, p95 = np.percentile(values, (5.0, 50.0, 95.0)).tolist()
    return {"mean": float(values.mean()), "p05": p05, "p50": p50, "p95": p95}


def with_neighbours(load: Array, start_ns: NDArray[np.int64]) -> Array:
    """Return the load of each window, of the window before and of the window after, shape (n, 3).

    A missing neighbour gets the window's own load. The neighbours are included because the load may change within a
    window, and the head's motion still depends on the earlier load. The effect of a lasting change of the load is
    therefore the sum of the slopes with respect to all three loads, not only the slope with respect to the window's own
    load.
    """
    steps = np.diff(start_ns)
    joined = (steps > 0) & (steps < _NEXT * np.median(steps)) if len(steps) else steps > 0
    before = np.where(joined, load[:-1], load[1:])
    after = np.where(joined, load[1:], load[:-1])
    return np.column_stack((load, np.append(load[:1], before), np.append(after, load[-1:])))


class Drawn:
    """Means and covariances of a group: row 0 for all windows, every other row for a bootstrap draw.

    Parameters
    ----------
    values
        Quantities of the windows, shape (n, k).
    load
        Load of the windows, shape (n,), or the loads of `with_neighbours`, shape (n, 3).
    random
        Generator of the draws.
    draws
        Number of draws.

    Attributes
    ----------
    usual : ndarray, shape (2,)
        Smallest and largest usual load (`_USUAL`).
    size : int
        Number of windows in a draw.
    mean : ndarray, shape (draws + 1, k)
        Means of the quantities.
    load : ndarray, shape (draws + 1, m)
        Means of the loads.
    within : ndarray, shape (draws + 1, m, m + k)
        Covariance of the loads with each other and with the quantities.
    """

    def __init__(self, values: Array, load: Array, random: np.random.Generator, draws: int = _DRAWS) -> None:
        load = load.reshape(len(load), -1)
        self.size, width = load.shape
        self.usual = np.percentile(load[:, 0], _USUAL)
        whole = np.hstack((load, values))
        usual = whole.mean(axis=0)
        centred = whole - usual
        means, products = [np.zeros((1, whole.shape[1]))], [centred[:, :width].T @ centred / self.size]
        done = 0
        while done < draws:  # each round makes as many draws as the memory allows
            count = min(draws - done, max(1, _AT_ONCE // self.size))
            done += count
            times = np.stack(
                [np.bincount(random.integers(0, self.size, self.size), minlength=self.size) for _ in range(count)]
            )
            weights = times / self.size
            means.append(weights @ centred)
            products.append(np.stack([weights @ (centred[:, [one]] * centred) for one in range(width)], axis=1))
        offset = np.concatenate(means)
        self.mean, self.load = (usual + offset)[:, width:], (usual + offset)[:, :width]
        second = np.concatenate([part.reshape(-1, width, whole.shape[1]) for part in products])
        self.within = second - offset[:, :width, None] * offset[:, None, :]


def changes(before: Drawn, after: Drawn) -> list[Change | None]:
    """Return the changes of quantities between two groups of windows, None if there are too few windows.

    Means are compared by a bootstrap over windows. For the comparison at equal load, the part of a change that follows
    from the load is subtracted. The slopes for this part come from the variation of the load within the groups
    (analysis of covariance).

    References
    ----------
    Benjamini, Hochberg (1995), Controlling the false discovery rate, J. R. Stat. Soc. B 57.
    """
    result: list[Change | None] = [None] * before.mean.shape[1]
    fewest = min(before.size, after.size)
    known = np.flatnonzero(before.mean[0] > 0.0)
    if fewest < FEWEST:
        return result
    mean = before.mean[:, known]
    found = _tested(after.mean[:, known] - mean, mean, fewest)
    at_equal_load = None
    if not _apart(before, after):
        rest = _at_equal_load(before, after)[:, known]
        left = np.isfinite(rest[:, 0]) if len(known) else np.zeros(len(rest), bool)
        if left[0] and left[1:].mean() >= 0.9:
            at_equal_load = _tested(rest[left], mean[left], fewest)
    for place, cell in enumerate(known.tolist()):
        machine = (None,) * 4 if at_equal_load is None else (part[place].item() for part in at_equal_load)
        result[cell] = Change(*(part[place].item() for part in found), *machine)
    return result


def _tested(differences: Array, mean: Array, fewest: int) -> tuple[Array, Array, Array, Array]:
    """Return share, low, high and adjusted chance of each column; row 0 has values, the other rows draws.

    Student's t distribution gets the degrees of freedom of the smaller group, so that the probabilities are too large
    rather than too small.
    """
    drawn = np.divide(differences, mean, out=np.full_like(mean, np.nan), where=mean > 0.0)
    low, high = np.nanpercentile(drawn[1:], (2.5, 97.5), axis=0)
    share, spread = drawn[0], differences[1:].std(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        chance = 2.0 * student.sf(np.abs(differences[0] / spread), fewest - 1)
    chance[np.abs(share) <= _ROUNDING] = 1.0
    return share, low, high, false_discovery_control(chance) if len(chance) else chance


def _apart(before: Drawn, after: Drawn) -> bool:
    """Return whether the loads of two groups differ and do not overlap."""
    first, second = before.load[0, 0], after.load[0, 0]
    differ = abs(second - first) >= _EQUAL_LOAD * first
    return bool(differ and (before.usual[0] > after.usual[1] or after.usual[0] > before.usual[1]))


def _at_equal_load(before: Drawn, after: Drawn) -> Array:
    """Return the differences of the means at the first group's load, NaN if the load hardly varies."""
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
