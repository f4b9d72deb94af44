"""Runs of scenes in the lanes of SIMD vectors, in slices of work."""

from __future__ import annotations

import time as _time
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.run.motion import Motion, next_slice, run_events
from plow_twin.solve.compiled_scene import CompiledScene, start_many
from plow_twin.solve.lanes.loop import OTHER_METHOD, Members, run_lanes
from plow_twin.solve.lanes.record import forces
from plow_twin.solve.modes import settle_many
from plow_twin.solve.state import EVENT, HARMONIC, STATE, TOTALS, Status, Work, first_of, new_records

#: Number of steps of each lane in the first slice.
_FIRST_SLICE: Final = 256
#: Number of steps per call of the loop for one scene. A call costs as much as some thirty steps.
_OTHER_STEPS: Final = 32


class LaneRun:
    """Run of the members of an ensemble that use lanes.

    Parameters
    ----------
    params : ndarray of `PARAMS`, shape (m,)
    compiled : sequence of CompiledScene
        All members.
    members : sequence of int
        Indices of the members that use lanes.
    times : ndarray, shape (n,)
        Times of the output rows in s.
    q, v : ndarray, shape (m, n, 3)
        Arrays that receive the output rows.
    t_end : float
        End of the motion in s.
    max_steps : int
        Largest number of steps of a member.
    """

    def __init__(
        self,
        params: NDArray[np.void],
        compiled: Sequence[CompiledScene],
        members: Sequence[int],
        times: NDArray[np.float64],
        q: NDArray[np.float64],
        v: NDArray[np.float64],
        t_end: float,
        max_steps: int,
    ) -> None:
        count = len(compiled)
        self._compiled, self._times, self._t_end, self._max_steps = compiled, times, t_end, max_steps
        self._size = _FIRST_SLICE
        self.states, self.totals = new_records(STATE, count), np.zeros(count, TOTALS)
        self.status = np.full(count, int(Status.PAUSED))
        start_many(compiled, self.states, members)
        settle_many(params, self.states, np.array(members))
        self._members = Members(
            params, self.states, self.totals, *_joined(compiled, members), self.status, np.zeros(count, np.int64),
            q, v,
        )  # fmt: skip

    def go_on(self, waiting: NDArray[np.int64], work: NDArray[np.void], lanes: NDArray[np.void]) -> NDArray[np.bool_]:
        """Advance members by a slice of work, and return whether each member has finished.

        `work` of `WORK` and `lanes` of `LANES`, shape (1,), are scratch space.
        """
        first, begin = self._compiled[waiting[0]], _time.perf_counter()
        terms = first.parts.terms
        run_lanes(
            self._members, terms.harmonics, terms.second, terms.viscous, terms.hysteretic, *forces(terms),
            terms.flight, terms.rest, int(first.params.order), lanes, work, waiting, self._t_end, self._max_steps,
            self._size, self._times,
        )  # fmt: skip
        self._size = next_slice(self._size, _time.perf_counter() - begin)
        for index in waiting[self.status[waiting] == OTHER_METHOD].tolist():
            self._step_otherwise(index, first_of(work))
        status = self.status[waiting]
        done: NDArray[np.bool_] = (status != Status.PAUSED) & (status != OTHER_METHOD)
        return done

    def _step_otherwise(self, index: int, work: Work) -> None:
        """Advance a member by some steps in the loop for one scene."""
        members = self._members
        state, totals = self.states.view(np.recarray)[index], self.totals.view(np.recarray)[index]
        motion = Motion(state, totals, np.zeros(16 * _OTHER_STEPS, EVENT), members.q[index], members.v[index])
        motion.first = members.first[index : index + 1]
        logged, totals.logged = int(totals.logged), 0
        budget = min(self._max_steps, int(state.steps) + _OTHER_STEPS)
        status, _ = run_events(self._compiled[index], motion, self._times, self._t_end, work, budget)
        totals.logged += logged
        more = status == Status.BUDGET and budget < self._max_steps
        self.status[index] = int(Status.PAUSED) if more else status


def _joined(compiled: Sequence[CompiledScene], members: Sequence[int]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Return all members' harmonics in one array, and for each member its first index and its count, shape (m, 2)."""
    parts, extent, begin = [np.zeros(0, HARMONIC)], np.zeros((len(compiled), 2), np.int64), 0
    spans: dict[int, tuple[int, int]] = {}
    for index in members:
        harmonics = compiled[index].parts.harmonics
        if harmonics is None:
            continue
        if id(harmonics) not in spans:
            spans[id(harmonics)] = begin, len(harmonics)
            parts.append(harmonics)
            begin += len(harmonics)
        extent[index] = spans[id(harmonics)]
    return np.concatenate(parts), extent
