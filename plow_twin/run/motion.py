"""Runs of the compiled loop in slices, between which limits, progress and Ctrl-C are handled."""

from __future__ import annotations

import time as _time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve import fixed_step, loop
from plow_twin.solve.compiled_scene import CompiledScene
from plow_twin.solve.energy_balance import BalanceSums
from plow_twin.solve.state import EVENT, TOTALS, Log, State, Status, Totals, Work, new_record

Array = NDArray[np.float64]

_FIRST_LOG: Final = 4096
#: Default number of steps after which a run ends with an error.
BUDGET: Final = 10**8
#: `_SLICE_S`: intended computing time of a slice in s. `_FIRST_SLICE`, `_FIRST_SLICE_IMPLICIT`: steps of the first
#: slice without and with implicit steps.
_SLICE_S: Final = 0.02
_FIRST_SLICE, _FIRST_SLICE_IMPLICIT = 2048, 64


@dataclass
class Motion:
    """State of a run, and the arrays that receive its results."""

    state: State
    totals: Totals
    log: Log
    q: Array
    v: Array
    penetration: Array | None = None
    force: Array | None = None
    #: displacement of a frame on springs and its rates, shape (n, 6)
    frame: Array | None = None
    sums: BalanceSums | None = None
    #: number of rows written
    first: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))
    #: time reached in s by fixed steps, which do not update the state's `time`
    fixed_time: float | None = None

    @property
    def rows(self) -> int:
        """Number of rows written so far."""
        return int(self.first[0])

    @property
    def time(self) -> float:
        """Time reached in s."""
        return float(self.state.step_start) if self.fixed_time is None else self.fixed_time

    @staticmethod
    def start(compiled: CompiledScene, q: Array, v: Array, outputs: bool = False) -> Motion:
        """Return a motion at the initial state with the output rows q and v, shape (n, 3) each.

        `outputs` adds uninitialised rows for the pairs and for a frame on springs.
        """
        # malloc keeps freed memory for the next run as long as one block is more than half of it
        penetration, force = np.empty((2, len(q), PAIR_COUNT)) if outputs else (None, None)
        frame = np.empty((len(q), 6)) if outputs and compiled.scene.support is not None else None
        state, totals, log = compiled.initial_state(), new_record(TOTALS), np.empty(_FIRST_LOG, EVENT)
        return Motion(state, totals, log, q, v, penetration, force, frame)


def run_events(
    compiled: CompiledScene,
    motion: Motion,
    times: Array,
    t_end: float,
    work: Work,
    budget: int,
    look: Callable[[Motion], None] | None = None,
) -> tuple[int, int]:
    """Advance a motion to `t_end` by Taylor series with event detection, and return its `Status` and number of rows.

    `look` is called between slices, which do not change the results.
    """
    size = _FIRST_SLICE if compiled.parts.implicit is None else _FIRST_SLICE_IMPLICIT
    while True:
        begin = _time.perf_counter()
        allowed = budget if look is None else min(budget, int(motion.state["steps"]) + size)
        code = loop.integrate(
            compiled.params, compiled.parts, motion.state, work, motion.totals, motion.log, t_end, allowed,
            motion.first, times, motion.q, motion.v, motion.penetration, motion.force, motion.frame, motion.sums,
        )  # fmt: skip
        if code == Status.LOG_FULL:
            motion.log = _grown(motion.log)
        elif code == Status.BUDGET and allowed < budget and look is not None:
            look(motion)
            size = next_slice(size, _time.perf_counter() - begin)
        else:
            return code, motion.rows


def next_slice(size: int, took_s: float) -> int:
    """Return the number of steps of the next slice, after a slice of `size` steps that took `took_s`."""
    return min(BUDGET, max(1, int(size * min(4.0, max(0.1, _SLICE_S / max(took_s, 1e-6))))))


def run_fixed(
    compiled: CompiledScene,
    motion: Motion,
    steps: int,
    stride: int,
    dt: float,
    euler: bool,
    budget: int,
    look: Callable[[Motion], None] | None,
) -> int:
    """Advance a motion by `steps` fixed steps, and return its `Status`."""
    z = np.zeros(6 if compiled.parts.terms.support is None else 12)
    done, size = np.zeros(1, np.int64), _FIRST_SLICE
    while True:
        begin = _time.perf_counter()
        # a slice may end with an output row between output times, which the next slice overwrites
        allowed = min(steps, budget, steps if look is None else int(done[0]) + size)
        code = int(fixed_step.integrate_fixed(
            compiled.params, compiled.parts, motion.state, motion.totals, motion.log, z, done, allowed, dt, euler,
            stride, motion.q, motion.v, motion.penetration, motion.force, motion.frame, motion.sums,
        ))  # fmt: skip
        motion.fixed_time, motion.first[0] = float(done[0]) * dt, int(done[0]) // stride + 1
        if code == Status.LOG_FULL:
            motion.log = _grown(motion.log)
        elif code == Status.OK and allowed < steps:
            if allowed == budget:
                return int(Status.BUDGET)
            if look is not None:
                look(motion)
            size = next_slice(size, _time.perf_counter() - begin)
        else:
            return code


def _grown(log: Log) -> Log:
    return np.concatenate([log, np.empty_like(log)])
