"""Run a scene from its initial state and return everything about the motion as arrays."""

from __future__ import annotations

import time as _time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError, SolverError
from plow_twin.model.pairs import CORNER_NAMES, PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.run.energy_balance import EnergyBalance, energy_balance_of
from plow_twin.solve import fixed_step, loop
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene
from plow_twin.solve.energy_balance import BalanceSums, new_balance
from plow_twin.solve.state import TOTALS, Log, State, Status, Totals, Work, new_log, new_record, new_work

Method = Literal["events", "rk4", "euler"]
Array = NDArray[np.float64]

#: Type of one contact event: time in s, pair, modes (0 off, 1 on, 2 clipped), rate of penetration in m/s.
EVENT_DTYPE: Final = np.dtype([("time", "f8"), ("pair", "i8"), ("mode_from", "i8"), ("mode_to", "i8"), ("rate", "f8")])
_FIRST_LOG = 4096
_ROWS_BY_DEFAULT = 1000
#: Steps after which a run gives up with a named error: minutes of work.
BUDGET: Final = 10**8


@dataclass(frozen=True)
class Result:
    """A motion.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times of the output rows in s.
    q, v : ndarray, shape (n, 3)
        Pose x, y [m], theta [rad] of the cavity's centre, and its rate.
    force, penetration : ndarray, shape (n, 8)
        Normal force [N] and signed penetration [m] of each pair.
    events : ndarray of `EVENT_DTYPE`, shape (k,)
        Every change of contact in order of time.
    statistics : mapping
        By pair name: max, mean_in_contact, mean_over_time [N], impulse [N s], time_in_contact [s], makes; over the
        whole motion, not over the output rows.
    contact_sets : mapping
        `ccw` and `cw`: share of the contact time of that sense in which exactly these corners carry force. Corners by
        the scene's labels, else by name.
    solver : mapping
        method, tol or dt, steps, evaluations (orders of series, or right-hand sides), events.
    wear_depth : ndarray, shape (8,)
        Wear depth of each pad at the end in m.
    wall_s, compile_s : float
        Time taken by the run, and by compiling before it, in s.
    energy_balance : EnergyBalance or None
        Energy and momentum, when asked for.
    """

    t: Array
    q: Array
    v: Array
    force: Array
    penetration: Array
    events: NDArray[np.void]
    statistics: Mapping[str, Mapping[str, float]]
    contact_sets: Mapping[str, Mapping[str, float]]
    solver: Mapping[str, Any]
    wear_depth: Array
    wall_s: float
    compile_s: float
    energy_balance: EnergyBalance | None = None


def simulate(
    scene: Scene,
    t_end: float,
    output_dt: float | None = None,
    tol: float = 1e-9,
    method: Method = "events",
    dt: float | None = None,
    energy_balance: bool = False,
) -> Result:
    """Simulate a scene from t = 0 to `t_end`.

    Parameters
    ----------
    scene : Scene
    t_end : float
        End in s, not negative.
    output_dt : float, optional
        Distance of the output rows in s; a thousandth of the motion by default. The rows do not change the motion, but
        for the fixed-step methods `output_dt` is a whole multiple of `dt`.
    tol : float
        Tolerance of the pose relative to the clearance (`method="events"`).
    method : {"events", "rk4", "euler"}
        Event-located Taylor series, or a fixed step without event location.
    dt : float, optional
        The fixed step in s.
    energy_balance : bool
        Balance energy and momentum (`Result.energy_balance`); off, its code does not run.

    Returns
    -------
    Result
        Rows, events, statistics.

    Raises
    ------
    ArgumentError
        For an argument that cannot be used.
    SolverError
        When the motion could not be continued; says when and why.
    """
    check_times(t_end, output_dt, method, dt)
    compiled = compile_scene(scene, tol)
    if output_dt is None and dt is not None:
        output_dt = dt * max(1, round(t_end / dt / _ROWS_BY_DEFAULT))
    times = output_times(t_end, output_dt)
    begin = _time.perf_counter()
    _run(compiled, np.zeros(1), 0.0, method, dt, energy_balance)
    compile_s = _time.perf_counter() - begin
    begin = _time.perf_counter()
    motion = _run(compiled, times, t_end, method, dt, energy_balance)
    wall_s = _time.perf_counter() - begin
    return _result(compiled, times, t_end, tol, method, dt, motion, wall_s, compile_s)


@dataclass
class Motion:
    """A run under way, and the arrays that it fills."""

    state: State
    totals: Totals
    log: Log
    q: Array
    v: Array
    penetration: Array | None = None
    force: Array | None = None
    sums: BalanceSums | None = None

    @staticmethod
    def start(compiled: CompiledScene, q: Array, v: Array, outputs: bool = False) -> Motion:
        """Start at the scene's initial state; rows go to q and v, shape (n, 3) each, pair outputs to new arrays."""
        eight = (len(q), PAIR_COUNT)
        pairs = (np.zeros(eight), np.zeros(eight)) if outputs else (None, None)
        return Motion(compiled.initial_state(), new_record(TOTALS), new_log(_FIRST_LOG), q, v, *pairs)


def check_times(t_end: float, output_dt: float | None, method: str = "events", dt: float | None = None) -> None:
    """Raise `ValueError` for times that no run can have."""
    if not (np.isfinite(t_end) and t_end >= 0.0):
        raise ArgumentError(f"t_end: got {t_end!r}, expected a finite time >= 0 [s]")
    if output_dt is not None and not (np.isfinite(output_dt) and output_dt > 0.0):
        raise ArgumentError(f"output_dt: got {output_dt!r}, expected a finite time > 0 [s]")
    if method not in get_args(Method):
        raise ArgumentError(f"method: got {method!r}, expected one of {', '.join(get_args(Method))}")
    if method == "events":
        if dt is not None:
            raise ArgumentError(f"dt: got {dt!r}, expected None with method='events'")
        return
    if dt is None or not (np.isfinite(dt) and dt > 0.0):
        raise ArgumentError(f"dt: got {dt!r}, expected a finite time > 0 [s] with method={method!r}")
    for name, value in (("t_end", t_end), ("output_dt", output_dt)):
        if value is not None and abs(value / dt - round(value / dt)) > 1e-6 * max(1.0, value / dt):
            raise ArgumentError(f"{name}: got {value!r}, expected a whole multiple of dt = {dt!r} [s]")


def output_times(t_end: float, output_dt: float | None) -> Array:
    """Return 0, output_dt, .. and t_end; a thousand rows without `output_dt`."""
    if t_end == 0.0:
        return np.zeros(1)
    if output_dt is None:
        output_dt = t_end / _ROWS_BY_DEFAULT
    count = int(np.floor(t_end / output_dt * (1.0 + 1e-12)))
    times: Array = np.minimum(np.arange(count + 1) * output_dt, t_end)
    return times if t_end - times[-1] <= 1e-9 * output_dt else np.append(times, t_end)


def _run(
    compiled: CompiledScene, times: Array, t_end: float, method: Method, dt: float | None, energy_balance: bool = False
) -> Motion:
    motion = Motion.start(compiled, np.zeros((len(times), 3)), np.zeros((len(times), 3)), outputs=True)
    motion.sums = new_balance() if energy_balance else None
    if dt is None:
        code, _ = run_events(compiled, motion, times, t_end, new_work(), BUDGET)
        time = float(motion.state.step_start)
    else:
        stride = round(float(times[1]) / dt) if len(times) > 1 else 1
        code, time = _run_fixed(compiled, motion, round(t_end / dt), stride, dt, method == "euler")
    if code != Status.OK:
        raise SolverError(f"at t = {time:.9g} s: {Status(code).text}")
    return motion


def run_events(
    compiled: CompiledScene, motion: Motion, times: Array, t_end: float, work: Work, budget: int
) -> tuple[int, int]:
    """Bring a motion to `t_end` by the event-located series; return its `Status` and the number of rows written."""
    first = np.zeros(1, np.int64)
    while True:
        code = loop.integrate(
            compiled.params, compiled.parts, motion.state, work, motion.totals, motion.log, t_end, budget, first,
            times, motion.q, motion.v, motion.penetration, motion.force, motion.sums,
        )  # fmt: skip
        if code != Status.LOG_FULL:
            return code, int(first[0])
        motion.log = _grown(motion.log)


def _run_fixed(
    compiled: CompiledScene, motion: Motion, steps: int, stride: int, dt: float, euler: bool
) -> tuple[int, float]:
    """Bring a motion through `steps` fixed steps; return its `Status` and the time reached."""
    done = np.zeros(1, np.int64)
    while True:
        code = fixed_step.integrate_fixed(
            compiled.params, compiled.parts, motion.state, motion.totals, motion.log, done, steps, dt, euler, stride,
            motion.q, motion.v, motion.penetration, motion.force, motion.sums,
        )  # fmt: skip
        if code != Status.LOG_FULL:
            return code, float(done[0]) * dt
        motion.log = _grown(motion.log)


def _grown(log: Log) -> Log:
    larger = new_log(2 * log.time.size)
    for new, old in zip(larger[:-1], log[:-1], strict=True):
        new[: old.size] = old
    larger.length[0] = log.length[0]
    return larger


def _result(
    compiled: CompiledScene,
    times: Array,
    t_end: float,
    tol: float,
    method: str,
    dt: float | None,
    motion: Motion,
    wall_s: float,
    compile_s: float,
) -> Result:
    scene, log, state = compiled.scene, motion.log, motion.state
    assert motion.force is not None and motion.penetration is not None
    size = int(log.length[0])
    events = np.zeros(size, EVENT_DTYPE)
    for name in EVENT_DTYPE.names or ():
        events[name] = getattr(log, name)[:size]
    setting = {"tol": tol} if method == "events" else {"dt": dt}
    solver = {
        "method": method, **setting, "steps": int(state.steps), "evaluations": int(state.evaluations),
        "events": int(state.events) if method != "events" else size,
    }  # fmt: skip
    return Result(
        t=times, q=motion.q, v=motion.v, force=motion.force, penetration=motion.penetration, events=events,
        statistics=statistics_of(motion.totals, t_end), contact_sets=contact_sets_of(scene, motion.totals),
        solver=solver, wear_depth=motion.state.wear_depth.copy(), wall_s=wall_s, compile_s=compile_s,
        energy_balance=energy_balance_of(compiled, motion.state, motion.sums) if motion.sums is not None else None,
    )  # fmt: skip


def statistics_of(totals: Totals, duration: float) -> dict[str, dict[str, float]]:
    """Return the statistics of each pair over the motion (see `Result`)."""
    table = {}
    for pair, name in enumerate(PAIR_NAMES):
        impulse, contact = float(totals.impulse[pair]), float(totals.time_in_contact[pair])
        table[name] = {
            "max": float(totals.peak[pair]),
            "mean_in_contact": impulse / contact if contact > 0.0 else 0.0,
            "mean_over_time": impulse / duration if duration > 0.0 else 0.0,
            "impulse": impulse,
            "time_in_contact": contact,
            "makes": int(totals.makes[pair]),
        }
    return table


def contact_sets_of(scene: Scene, totals: Totals) -> dict[str, dict[str, float]]:
    """Return the shares of the sets of corners that carry force together, for each sense, largest first."""
    letters = {corner: letter for letter, corner in scene.frame.labels.items()}
    labels = [letters.get(corner, corner) for corner in CORNER_NAMES]
    joint = "" if letters else "+"
    senses = {}
    for sense, times in zip(("ccw", "cw"), totals.set_time, strict=True):
        total = times.sum()
        shares = {
            joint.join(sorted(labels[i] for i in range(4) if mask >> i & 1)): float(times[mask] / total)
            for mask in range(1, 16)
            if times[mask] > 0.0
        }
        senses[sense] = dict(sorted(shares.items(), key=lambda item: -item[1]))
    return senses
