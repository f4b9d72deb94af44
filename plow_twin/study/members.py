"""Runs of many scenes, and what of each motion a study can ask for."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.simulate import BUDGET, Motion, check_times, output_times, run_events
from plow_twin.solve.compiled import compile_scene
from plow_twin.solve.layout import STEPS, Status, new_work

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Members:
    """What was counted over the motions of m scenes.

    Attributes
    ----------
    duration_s : float
    t, q, v : ndarray, shapes (n,), (m, n, 3), (m, n, 3)
        Output rows in s; pose x, y [m], theta [rad] and its rate; NaN from a failure on.
    peak, impulse, time_in_contact, makes, wear_depth : ndarray, shape (m, 8)
        Of each pair: largest force [N], impulse [N s], time with force [s], touches, wear depth at the end [m].
    set_time : ndarray, shape (m, 2, 16)
        Time in s in which exactly the corners of the mask carry force; counter-clockwise and clockwise pairs.
    events, steps, status : ndarray of int64, shape (m,)
        Contact changes, steps of the solver, `Status` of the run.
    """

    duration_s: float
    t: Array
    q: Array
    v: Array
    peak: Array
    impulse: Array
    time_in_contact: Array
    makes: NDArray[np.int64]
    wear_depth: Array
    set_time: Array
    events: NDArray[np.int64]
    steps: NDArray[np.int64]
    status: NDArray[np.int64]

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Which runs did not reach their end, shape (m,)."""
        return np.asarray(self.status != Status.OK)

    def at(self, rows: NDArray[np.int64]) -> Members:
        """Return the members of these numbers."""
        kept = {name: getattr(self, name) for name in ("duration_s", "t")}
        rest = {spec.name: getattr(self, spec.name)[rows] for spec in fields(self) if spec.name not in kept}
        return Members(**kept, **rest)


def run_members(
    scenes: Sequence[Scene],
    t_end: float,
    tol: float = 1e-9,
    output_dt: float | None = None,
    workers: int | None = None,
    on_done: Callable[[int], None] | None = None,
) -> Members:
    """Run every scene from t = 0 to `t_end`, each with the bits of its single run.

    Parameters
    ----------
    scenes : sequence of Scene
    t_end, tol : float
        End in s; tolerance as in `plow_twin.simulate`.
    output_dt : float, optional
        Distance of the output rows in s; without it only the start and the end are kept.
    workers : int, optional
        Threads; all cores by default.
    on_done : callable, optional
        Called with the number of members done, from one thread at a time.
    """
    check_times(t_end, output_dt)
    times = output_times(t_end, output_dt or t_end or None)
    members = _empty(len(scenes), times, t_end)
    local, lock, done = threading.local(), threading.Lock(), [0]

    def run(index: int) -> None:
        if not hasattr(local, "work"):
            local.work = new_work()
        compiled = compile_scene(scenes[index], tol)
        motion = Motion.start(compiled, members.q[index], members.v[index])
        status, rows = run_events(compiled, motion, times, t_end, local.work, BUDGET)
        members.q[index, rows:] = members.v[index, rows:] = np.nan
        for name in ("peak", "impulse", "time_in_contact", "makes", "set_time"):
            getattr(members, name)[index] = getattr(motion.totals, name)
        members.wear_depth[index] = motion.state.depth
        members.events[index] = int(motion.log.length[0])
        members.steps[index], members.status[index] = motion.state.count[STEPS], Status(status)
        with lock:
            done[0] += 1
            if on_done is not None:
                on_done(done[0])

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        # the first alone: it compiles what all need
        for index in range(min(1, len(scenes))):
            run(index)
        list(pool.map(run, range(1, len(scenes))))
    return members


def _empty(count: int, times: Array, duration: float) -> Members:
    eight, integers = (count, PAIR_COUNT), np.int64
    return Members(
        duration_s=duration, t=times,
        q=np.zeros((count, len(times), 3)), v=np.zeros((count, len(times), 3)),
        peak=np.zeros(eight), impulse=np.zeros(eight), time_in_contact=np.zeros(eight), makes=np.zeros(eight, integers),
        wear_depth=np.zeros(eight), set_time=np.zeros((count, 2, 16)),
        events=np.zeros(count, integers), steps=np.zeros(count, integers), status=np.zeros(count, integers),
    )  # fmt: skip
