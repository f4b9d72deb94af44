"""Live twins in SIMD lanes, advanced in slices; advances that lanes cannot make are made one by one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import for_arguments
from plow_twin.run.pace import Pace
from plow_twin.solve.lanes.advance import Load, Samples, advance_lanes
from plow_twin.solve.lanes.record import WIDTH, new_lanes, powers
from plow_twin.solve.state import TOTALS, Terms

#: Number of steps in a slice of work, summed over all lanes; a slice takes about a millisecond.
_SLICE: Final = 256

_Array = NDArray[np.float64]


class LaneTwins:
    """Twins that one thread advances in lanes.

    Parameters
    ----------
    params, states : ndarray of records, shape (m,)
        Parameters and states of all twins of a batch.
    terms : Terms
        Joint terms of all twins.
    members : range
        Indices of the twins that these lanes advance.
    work : ndarray of `WORK`, shape (1,)
        Scratch space.
    max_steps : int
        Largest number of steps of an advance.
    """

    def __init__(
        self,
        params: NDArray[np.void],
        states: NDArray[np.void],
        terms: Terms,
        members: range,
        work: NDArray[np.void],
        max_steps: int,
    ) -> None:
        self._params, self._states, self._terms, self._work = params, states, terms, work
        self._members, self._max_steps, self._order = np.array(members), max_steps, int(params["order"][members[0]])
        self._place, self._queue = np.zeros(len(params), np.int64), self._members.copy()
        self._other, self._progress = np.zeros(len(params), np.int64), np.zeros(2, np.int64)
        self._kernel: Callable[..., bool] | None = None
        self.clear()

    def clear(self) -> None:
        """Empty the lanes after a call that was stopped."""
        self._lanes, self._totals = new_lanes(), np.zeros(WIDTH, TOTALS)

    def advance(
        self, times: _Array, load: Load, rows: NDArray[np.void], pace: Pace, alone: Callable[[int, int], None]
    ) -> None:
        """Advance all twins to all times; `alone` advances a single twin to one of these times by other methods.

        `load` and `rows` are as in `Samples`.
        """
        if not len(times):
            return
        self._place[self._members] = 0
        self._queue[:] = self._members
        queue = self._queue
        while len(queue):
            self._progress[:] = 0
            samples = Samples(
                self._params, self._states, self._totals, times, load, rows, self._place, queue, self._progress,
                self._other,
            )  # fmt: skip
            terms = self._terms
            arguments = (
                samples, terms.viscous, terms.hysteretic, *powers(terms), terms.rest, self._order, self._lanes,
                self._work, self._max_steps, _SLICE,
            )  # fmt: skip
            if self._kernel is None:
                self._kernel = for_arguments(advance_lanes, arguments)
            pace.run(self._kernel, arguments)
            if not self._progress[1]:
                return
            queue = np.array(self._advance_others(len(times), alone), np.int64)

    def _advance_others(self, count: int, alone: Callable[[int, int], None]) -> list[int]:
        """Advance each twin without a lane to its next time; return those that have not reached all `count` times."""
        others: list[int] = self._other[: self._progress[1]].tolist()
        for member in others:
            alone(member, int(self._place[member]))
            self._place[member] += 1
        return [member for member in others if self._place[member] < count]
