"""Many scenes at once on all cores: clearance, stiffness, load or initial state differ from member to member."""

from __future__ import annotations

import os
import threading
import time as _time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import LimitError, RunInterrupted
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.run.motion import BUDGET, Motion, run_events
from plow_twin.run.pace import MOST_SECONDS, OutOfTimeError, check_limits
from plow_twin.run.simulate import check_times, output_times
from plow_twin.solve.compiled_scene import compile_scene
from plow_twin.solve.state import Status, Work, new_work

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ensemble:
    """The motions of m scenes.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times of the output rows in s.
    q, v : ndarray, shape (m, n, 3)
        Pose x, y [m], theta [rad] and its rate; rows after a failure are NaN.
    peak, impulse, time_in_contact : ndarray, shape (m, 8)
        Largest force [N], impulse [N s] and time with force [s] of each pair over the whole motion.
    makes : ndarray of int64, shape (m, 8)
        Touches.
    set_time : ndarray, shape (m, 2, 16)
        Time in s in each set of corners (bit i: corner i), for counter-clockwise and for clockwise contacts.
    events : ndarray of int64, shape (m,)
        Changes of contact.
    wear_depth : ndarray, shape (m, 8)
        Wear depth at the end in m.
    steps, status : ndarray of int64, shape (m,)
        Steps taken; `Status` of each member. A member that fails does not stop the others.
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
    """Simulate every scene from t = 0 to `t_end`; each member has the same bits as `simulate` gives it alone.

    Parameters
    ----------
    scenes : sequence of Scene
    t_end, output_dt, tol
        As in `simulate`.
    workers : int, optional
        Threads; all cores by default. The kernels run without the interpreter's lock.
    on_progress : callable, optional
        Called with the number of members done, from one thread at a time.
    max_steps : int
        Steps that each member may take; one that needs more ends with the status `BUDGET`.
    max_wall_s : float
        Seconds of wall-clock time that all members together may take, compiling counted.

    Returns
    -------
    Ensemble
        Rows and statistics of each member, and its status: one that fails does not stop the others.

    Raises
    ------
    ArgumentError
        For an argument that cannot be used.
    LimitError, RunInterrupted
        At `max_wall_s`, and after Ctrl-C; `result` holds the members as far as they had come, those not done with the
        status `BUDGET`.
    """
    check_times(t_end, output_dt)
    check_limits(max_steps, max_wall_s)
    times = output_times(t_end, output_dt)
    ensemble = _empty(times, len(scenes))
    local, lock = threading.local(), threading.Lock()
    done, stopped = 0, threading.Event()
    end = _time.perf_counter() + max_wall_s

    def look(motion: Motion | None = None) -> None:
        if stopped.is_set() or _time.perf_counter() > end:
            raise OutOfTimeError

    def run(index: int) -> None:
        nonlocal done
        if not hasattr(local, "work"):
            local.work = new_work()
        look()
        _run_member(scenes[index], index, t_end, tol, local.work, ensemble, max_steps, look)
        with lock:
            done += 1
            if on_progress is not None:
                on_progress(done)

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        try:
            # the first member alone: it compiles what all need
            for index in range(min(1, len(scenes))):
                run(index)
            list(pool.map(run, range(1, len(scenes))))
        except (OutOfTimeError, KeyboardInterrupt) as stop:
            stopped.set()
            pool.shutdown(cancel_futures=True)
            late = isinstance(stop, OutOfTimeError)
            what = f"max_wall_s = {max_wall_s:g} reached" if late else "interrupted"
            message = f"{what} after {done} of {len(scenes)} members"
            raise (LimitError if late else RunInterrupted)(message, ensemble, 0.0) from None
    return ensemble


def _run_member(
    scene: Scene,
    index: int,
    t_end: float,
    tol: float,
    work: Work,
    ensemble: Ensemble,
    max_steps: int,
    look: Callable[[Motion], None],
) -> None:
    compiled = compile_scene(scene, tol)
    motion = Motion.start(compiled, ensemble.q[index], ensemble.v[index])
    try:
        status, rows = run_events(compiled, motion, ensemble.t, t_end, work, max_steps, look)
    except OutOfTimeError:
        ensemble.q[index, motion.rows :] = ensemble.v[index, motion.rows :] = np.nan
        raise
    ensemble.q[index, rows:] = ensemble.v[index, rows:] = np.nan
    totals = motion.totals
    ensemble.peak[index], ensemble.impulse[index] = totals.peak, totals.impulse
    ensemble.time_in_contact[index], ensemble.makes[index] = totals.time_in_contact, totals.makes
    ensemble.set_time[index], ensemble.events[index] = totals.set_time, totals.logged
    ensemble.wear_depth[index] = motion.state.wear_depth
    ensemble.steps[index], ensemble.status[index] = motion.state.steps, Status(status)


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
