"""Runs of many scenes on all cores.

Scenes whose only terms are their contact law, regularised friction and harmonic loads share SIMD vectors
(`solve.lanes`). All other scenes run one by one.
"""

from __future__ import annotations

import os
import threading
import time as _time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError
from plow_twin.kernel.linked import garbage_kept
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.run.lane_run import LaneRun
from plow_twin.run.motion import BUDGET, Motion, run_events
from plow_twin.run.pace import MOST_SECONDS, OutOfTimeError, check_limits, raise_stopped
from plow_twin.run.simulate import check_times, output_times
from plow_twin.solve.compiled_scene import compile_scenes
from plow_twin.solve.lanes.record import fits_lanes, new_lanes
from plow_twin.solve.state import WORK, State, Status, Totals, first_of, new_records, new_work

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ensemble:
    """Motions of m scenes (members).

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times of the output rows in s.
    q : ndarray, shape (m, n, 3)
        Poses x, y [m], theta [rad] of the cavity's centre. The rows after a failure are NaN.
    v : ndarray, shape (m, n, 3)
        Rates of the poses in m/s, m/s and rad/s.
    peak : ndarray, shape (m, 8)
        Largest force of each pair in N.
    impulse : ndarray, shape (m, 8)
        Impulse of each pair in N s.
    time_in_contact : ndarray, shape (m, 8)
        Time in which each pair is in contact in s.
    makes : ndarray of int64, shape (m, 8)
        Number of touches of each pair.
    set_time : ndarray, shape (m, 2, 16)
        Time in s in which exactly the corners of each set are in contact. Bit i of the last index is corner i. The
        middle index is 0 for counter-clockwise and 1 for clockwise contacts.
    events : ndarray of int64, shape (m,)
        Number of changes of contact mode.
    wear_depth : ndarray, shape (m, 8)
        Wear depth of each pad at the end in m.
    steps : ndarray of int64, shape (m,)
        Number of steps of each member.
    status : ndarray of int64, shape (m,)
        `Status` of each member. A member that fails does not stop the run of the ensemble.
    """

    t: Array
    q: Array
    v: Array
    peak: Array
    impulse: Array
    time_in_contact: Array
    makes: NDArray[np.int64]
    set_time: Array
    events: NDArray[np.int64]
    wear_depth: Array
    steps: NDArray[np.int64]
    status: NDArray[np.int64]


def simulate_many(
    scenes: Sequence[Scene],
    t_end: float,
    output_dt: float | None = None,
    tol: float = 1e-9,
    workers: int | None = None,
    on_progress: Callable[[int], None] | None = None,
    *,
    max_steps: int = BUDGET,
    max_wall_s: float = MOST_SECONDS,
) -> Ensemble:
    """Simulate every scene from t = 0 to `t_end`. The bits of a result do not depend on the other scenes.

    Scenes run eight at a time in the lanes of a SIMD vector if they have constant or harmonic loads, a contact law
    without a ramp, perhaps regularised friction, and no further terms. The results of these scenes agree with
    `simulate` within the tolerance. For all other scenes the results are bit-identical to `simulate`.

    Parameters
    ----------
    scenes : sequence of Scene
    t_end, output_dt, tol
        As in `simulate`.
    workers : int, optional
        Number of threads. The default is the number of cores. Kernels release Python's global interpreter lock.
    on_progress : callable, optional
        Function that is called with the number of finished members. Calls from different threads do not overlap.
    max_steps : int
        Largest number of steps of a member. A member that needs more steps ends with the status `BUDGET`.
    max_wall_s : float
        Largest wall-clock time in s of the whole call, including compilation.

    Returns
    -------
    Ensemble
        Rows, statistics and status of each member.

    Raises
    ------
    ArgumentError
        An argument is not valid.
    LimitError, RunInterrupted
        The time `max_wall_s` has expired, or the user pressed Ctrl-C. The attribute `result` of the error contains the
        finished members. Unfinished members have the status `BUDGET`.
    """
    if not isinstance(scenes, Sequence):
        raise ArgumentError(f"scenes: got {scenes!r}, expected a sequence of scenes")
    check_times(t_end, output_dt)
    check_limits(max_steps, max_wall_s)
    end = _time.perf_counter() + max_wall_s
    ensemble = _empty(output_times(t_end, output_dt), len(scenes))
    run = _Run(scenes, t_end, tol, ensemble, on_progress, max_steps, end)
    threads = workers or os.cpu_count() or 1
    first, others = run.tasks(threads)
    with ThreadPoolExecutor(threads) as pool:
        try:
            # run the first member without lanes alone, because it compiles the kernels
            for task in first:
                task()
            for done in [pool.submit(task) for task in others]:
                done.result()
        except (OutOfTimeError, KeyboardInterrupt) as stop:
            run.stopped.set()
            pool.shutdown(cancel_futures=True)
            progress = f"after {run.done} of {len(scenes)} members"
            raise_stopped(stop, max_wall_s, progress, ensemble, 0.0)
    return ensemble


#: Smallest number of members that a thread takes at a time. Some lanes are empty while the last members end.
_LEAST_SHARE = 64
#: Number of shares per thread. With several shares, all threads end at about the same time.
_SHARES = 4


class _Scratch(threading.local):
    """Scratch space of a thread."""

    def __init__(self) -> None:
        self.work, self.lanes = new_records(WORK, 1), new_lanes()
        self.work[0] = new_work()


class _Run:
    """Data that the threads of an ensemble share."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        t_end: float,
        tol: float,
        ensemble: Ensemble,
        on_progress: Callable[[int], None] | None,
        max_steps: int,
        end: float,
    ) -> None:
        with garbage_kept():  # collection takes a third of the time, for no compiled scene is garbage
            self._params, self._compiled = compile_scenes(scenes, tol)
        self._t_end, self._ensemble, self._on_progress, self._max_steps = t_end, ensemble, on_progress, max_steps
        self._end, self._scratch, self._lock = end, _Scratch(), threading.Lock()
        self.stopped, self.done = threading.Event(), 0

    def tasks(self, threads: int) -> tuple[list[Callable[[], None]], list[Callable[[], None]]]:
        """Return the tasks to run first, one after another, and the tasks that the threads share."""
        groups: dict[object, list[int]] = {}
        alone: list[Callable[[], None]] = []
        for index, compiled_scene in enumerate(self._compiled):
            if fits_lanes(compiled_scene):
                groups.setdefault((compiled_scene.parts.terms, int(self._params["order"][index])), []).append(index)
            else:
                alone.append(partial(self._run_alone, index))
        shares: list[Callable[[], None]] = []
        members = sorted(index for group in groups.values() for index in group)
        if members:
            rows = self._ensemble.t, self._ensemble.q, self._ensemble.v
            run = LaneRun(self._params, self._compiled, members, *rows, self._t_end, self._max_steps)
            for group in groups.values():
                parts = 1 if threads == 1 else _SHARES * threads
                size = max(_LEAST_SHARE, -(-len(group) // parts))
                for start in range(0, len(group), size):
                    share = np.array(group[start : start + size])
                    shares.append(partial(self._run_lanes, run, share))
        return alone[:1], shares + alone[1:]

    def _check_time(self, motion: Motion | None = None) -> None:
        if self.stopped.is_set() or _time.perf_counter() > self._end:
            raise OutOfTimeError

    def _report_progress(self, count: int) -> None:
        with self._lock:
            self.done += count
            if self._on_progress is not None and count > 0:
                self._on_progress(self.done)

    def _run_lanes(self, run: LaneRun, share: NDArray[np.int64]) -> None:
        """Run some members in lanes. Their scenes must fit (`fits_lanes`)."""
        waiting = share
        while len(waiting):
            self._check_time()
            is_done = run.go_on(waiting, self._scratch.work, self._scratch.lanes)
            done, waiting = waiting[is_done], waiting[~is_done]
            self._store(done, run.totals[done], run.states[done], run.status[done])
            self._report_progress(len(done))

    def _run_alone(self, index: int) -> None:
        self._check_time()
        compiled, ensemble = self._compiled[index], self._ensemble
        motion = Motion.start(compiled, ensemble.q[index], ensemble.v[index])
        status, _ = run_events(
            compiled, motion, ensemble.t, self._t_end, first_of(self._scratch.work), self._max_steps, self._check_time
        )
        self._store(index, motion.totals, motion.state, status)
        self._report_progress(1)

    def _store(
        self,
        index: int | NDArray[np.int64],
        totals: Totals | NDArray[np.void],
        state: State | NDArray[np.void],
        status: int | NDArray[np.int64],
    ) -> None:
        ensemble = self._ensemble
        ensemble.peak[index], ensemble.impulse[index] = totals["peak"], totals["impulse"]
        ensemble.time_in_contact[index], ensemble.makes[index] = totals["time_in_contact"], totals["makes"]
        ensemble.set_time[index], ensemble.events[index] = totals["set_time"], totals["logged"]
        ensemble.wear_depth[index] = state["wear_depth"]
        ensemble.steps[index], ensemble.status[index] = state["steps"], status


def _empty(times: Array, members: int) -> Ensemble:
    def eight() -> Array:
        return np.zeros((members, PAIR_COUNT))

    return Ensemble(
        t=times,
        q=np.full((members, len(times), 3), np.nan),
        v=np.full((members, len(times), 3), np.nan),
        peak=eight(),
        impulse=eight(),
        time_in_contact=eight(),
        makes=np.zeros((members, PAIR_COUNT), np.int64),
        set_time=np.zeros((members, 2, 16)),
        events=np.zeros(members, np.int64),
        wear_depth=eight(),
        steps=np.zeros(members, np.int64),
        status=np.full(members, int(Status.BUDGET)),
    )
