"""Live twins in SIMD lanes, advanced in slices of work."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import for_arguments
from plow_twin.run.pace import Pace
from plow_twin.solve.lanes.advance import OTHERS, Load, Samples, advance_lanes
from plow_twin.solve.lanes.record import BLOCK, WIDTH, forces, new_lanes
from plow_twin.solve.state import TOTALS, Terms, new_records

#: Total number of steps of all lanes in a slice of work, which takes about a millisecond.
_SLICE: Final = 256

_Array = NDArray[np.float64]
#: Compiled code by the types of the records and by the terms, which determine the types of all arguments.
_entries: dict[tuple[object, ...], Callable[..., bool]] = {}


class LaneTwins:
    """Twins that one thread advances in lanes.

    Parameters
    ----------
    params : ndarray of records, shape (m,)
        Parameters of all twins of a batch.
    terms : Terms
        Terms that any of the twins has.
    members : range
        Indices of the twins that these lanes advance.
    work : ndarray of `WORK`, shape (1,)
        Scratch space.
    max_steps : int
        Largest number of steps of an advance.
    """

    def __init__(
        self, params: NDArray[np.void], terms: Terms, members: range, work: NDArray[np.void], max_steps: int
    ) -> None:
        self._params, self._terms, self._work = params, terms, work
        self._max_steps, self._order = max_steps, int(params["order"][members[0]])
        count = -(-len(members) // WIDTH)
        self._blocks, self._noted = new_records(BLOCK, count), np.empty(count, np.int64)
        self._place, self._other = np.zeros(len(params), np.int64), np.zeros(len(params), np.int64)
        self._start = np.array([0, 0, 0, members.start, members.stop], np.int64)
        self._progress = self._start.copy()
        self._kernel: Callable[..., bool] | None = None
        self.clear()

    def clear(self) -> None:
        """Empty the lanes after a stopped call."""
        self._lanes, self._totals = new_lanes(), np.zeros(WIDTH, TOTALS)
        self.reload()

    def reload(self) -> None:
        """Load all twins from their changed records at the next advance."""
        self._noted[:] = -1
        self.stale = True

    def advance(
        self,
        states: NDArray[np.void],
        times: _Array,
        load: Load,
        rows: NDArray[np.void],
        pace: Pace,
        alone: Callable[[int, int], None],
    ) -> None:
        """Advance all twins to all times, and write the new states to `states`.

        `load` and `rows` are those of `Samples`. `alone` advances one twin to one time without lanes. If `stale` is
        set, `states` must contain the current states.
        """
        self._place[:], self.stale = 0, False
        terms = self._terms
        flags = terms.viscous, terms.hysteretic, *forces(terms), terms.rest
        while True:
            self._progress[:] = self._start
            samples = Samples(
                self._params, states, self._blocks, self._noted, self._totals, times, load, rows, self._place,
                self._progress, self._other,
            )  # fmt: skip
            arguments = (
                samples, *flags, self._order, self._lanes, self._work, self._max_steps, _SLICE,
            )  # fmt: skip
            if self._kernel is None:
                key = self._params.dtype, states.dtype, flags
                if key not in _entries:
                    _entries[key] = for_arguments(advance_lanes, arguments)
                self._kernel = _entries[key]
            pace.run(self._kernel, arguments)
            if self._progress[OTHERS] == 0:
                return
            self.stale = True
            for member in self._other[: self._progress[OTHERS]].tolist():
                alone(member, int(self._place[member]))
                self._place[member] += 1
