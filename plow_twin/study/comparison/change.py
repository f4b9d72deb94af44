"""Groups of windows beside each other: distributions, changes with intervals, and the load's share in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Draws of the bootstrap: the 2.5 % point of an interval is then known to 0.5 % of probability.
_DRAWS: Final = 1000
#: Least number of windows that can separate chance from change.
FEWEST: Final = 8
#: Least variation of the load within groups, over its mean, that shows how a quantity follows it.
_LEAST_VARIATION: Final = 0.01
#: Loads of two groups that differ by less than this share count as equal.
_EQUAL_LOAD: Final = 0.01
#: Points of the loads of two groups that must overlap: no slope holds far beyond the loads that it comes from [%].
_USUAL: Final = (5.0, 95.0)
#: Means of equal numbers differ by rounding, less than by this share.
_ROUNDING: Final = 1e-12
#: A window whose start follows within this many lengths is the next one.
_NEXT: Final = 1.5


@dataclass(frozen=True)
class Change:
    """Change of a mean from one group to another, as shares of the first mean.

    Attributes
    ----------
    share, low, high : float
        The change and its 95 % interval.
    machine, machine_low, machine_high : float or None
        The same at equal load; None where the load varies too little to show how the quantity follows it, or where the
        loads of the groups do not overlap.
    """

    share: float
    low: float
    high: float
    machine: float | None
    machine_low: float | None
    machine_high: float | None

    @property
    def verdict(self) -> str:
        """`chance`, or the cause of a change that is more: `machine`, `load`, or `load or machine`."""
        if self.low <= _ROUNDING and self.high >= -_ROUNDING:
            return "chance"
        if self.machine_low is None or self.machine_high is None:
            return "load or machine"
        return "load" if self.machine_low <= 0.0 <= self.machine_high else "machine"


def points(values: Array) -> dict[str, float]:
    """Return mean, 5 %, 50 % and 95 % points of the values of windows, shape (n,)."""
    p05, p50, p95 = np.percentile(values, (5.0, 50.0, 95.0)).tolist()
    return {"mean": float(values.mean()), "p05": p05, "p50": p50, "p95": p95}


def with_neighbours(load: Array, start_ns: NDArray[np.int64]) -> Array:
    """Return the load of each window, of the one before and of the one after, shape (n, 3).

    Where there is no such neighbour, the window's own load takes its place. A window cuts through changes of the load,
    and the head's motion remembers the load before: the slope over a window's own load alone is not the effect of a
    lasting change, the sum of the slopes over all three is.
    """
    steps = np.diff(start_ns)
    joined = (steps > 0) & (steps < _NEXT * np.median(steps)) if len(steps) else steps > 0
    before = np.where(joined, load[:-1], load[1:])
    after = np.where(joined, load[1:], load[:-1])
    return np.column_stack((load, np.append(load[:1], before), np.append(after, load[-1:])))


def change(
    before: tuple[Array, Array], after: tuple[Array, Array], random: np.random.Generator, draws: int = _DRAWS
) -> Change | None:
    """Return the change between two groups of windows, None where there are too few.

    Means are compared by a bootstrap over windows. At equal load: less the part that follows the load, by the slopes
    over the load's variation within the groups (analysis of covariance).

    Parameters
    ----------
    before, after
        Values of a quantity, shape (n,), and load of the windows of each group, shape (n,), or as of
        `with_neighbours`, shape (n, 3).
    random
        Source of the draws.
    """
    if min(len(before[0]), len(after[0])) < FEWEST or not before[0].mean() > 0.0:
        return None
    shares, machine = [], []
    for draw in range(draws + 1):
        first, second = (_drawn(group, random) if draw else group for group in (before, after))
        mean = float(first[0].mean())
        if mean > 0.0:
            shares.append(float(second[0].mean()) / mean - 1.0)
            machine.append(_at_equal_load(first, second))
    low, high = np.percentile(shares[1:], (2.5, 97.5)).tolist()
    known = np.array([share for share in machine[1:] if share is not None])
    if machine[0] is None or _apart(before[1], after[1]) or len(known) < 0.9 * draws:
        return Change(shares[0], low, high, None, None, None)
    machine_low, machine_high = np.percentile(known, (2.5, 97.5)).tolist()
    return Change(shares[0], low, high, machine[0], machine_low, machine_high)


def _drawn(group: tuple[Array, Array], random: np.random.Generator) -> tuple[Array, Array]:
    chosen = random.integers(0, len(group[0]), len(group[0]))
    return group[0][chosen], group[1][chosen]


def _apart(before: Array, after: Array) -> bool:
    """Return whether the loads of two groups differ and do not overlap."""
    first, second = (load.reshape(len(load), -1)[:, 0] for load in (before, after))
    (low, high), (other_low, other_high) = (np.percentile(load, _USUAL) for load in (first, second))
    differ = abs(second.mean() - first.mean()) >= _EQUAL_LOAD * first.mean()
    return bool(differ and (low > other_high or other_low > high))


def _at_equal_load(before: tuple[Array, Array], after: tuple[Array, Array]) -> float | None:
    """Return the change of the mean at the first group's load, as a share of the first mean."""
    (first, load_before), (second, load_after) = (
        (values, load.reshape(len(load), -1)) for values, load in (before, after)
    )
    mean, usual = float(first.mean()), float(load_before.mean())
    difference = load_after.mean(axis=0) - load_before.mean(axis=0)
    if abs(difference[0]) < _EQUAL_LOAD * usual:
        return float(second.mean()) / mean - 1.0
    centred_load = np.concatenate((load_before - load_before.mean(axis=0), load_after - load_after.mean(axis=0)))
    centred = np.concatenate((first - first.mean(), second - second.mean()))
    if float(np.sqrt((centred_load[:, 0] ** 2).mean())) < _LEAST_VARIATION * usual:
        return None
    slopes = np.linalg.lstsq(centred_load, centred)[0]
    return (float(second.mean()) - float(slopes @ difference)) / mean - 1.0
