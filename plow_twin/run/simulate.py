"""Simulation of a scene from its initial state."""

from __future__ import annotations

import math
import time as _time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError, LimitError, RunInterrupted, SolverError, ToleranceWarning
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.run.energy_balance import EnergyBalance, energy_balance_of
from plow_twin.run.motion import BUDGET, Motion, run_events, run_fixed
from plow_twin.run.pace import MOST_SECONDS, check_limits
from plow_twin.run.sensitivity import Sensitivity, sensitivity_of
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene, options
from plow_twin.solve.energy_balance import new_balance
from plow_twin.solve.modes import beyond_range, range_of
from plow_twin.solve.state import EVENT, OFF, Status, Totals, Work, new_work

Method = Literal["events", "rk4", "euler"]
Array = NDArray[np.float64]

#: Record type of a contact event: time in s, pair, contact mode before and after the event, penetration rate in m/s.
#: The modes are 0 OFF, 1 ON and 2 CLIPPED.
EVENT_DTYPE: Final = EVENT
_ROWS_BY_DEFAULT = 1000
#: Largest number of output rows. A row takes 176 bytes of memory.
_MOST_ROWS: Final = 1e10


@dataclass(frozen=True)
class Result:
    """Motion of a scene, with statistics of its contacts.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times of the output rows in s.
    q : ndarray, shape (n, 3)
        Pose x, y [m], theta [rad] of the cavity's centre.
    v : ndarray, shape (n, 3)
        Rates of the pose in m/s, m/s and rad/s.
    force : ndarray, shape (n, 8)
        Normal force of each pair in N.
    penetration : ndarray, shape (n, 8)
        Signed penetration of each pair in m.
    events : ndarray of `EVENT_DTYPE`, shape (k,)
        All changes of contact mode, in order of time.
    statistics : mapping
        Values of each pair by its name: max, mean_in_contact and mean_over_time [N], impulse [N s], time_in_contact [s]
        and makes (number of touches). The values are computed from the whole motion, not from the output rows.
    contact_sets : mapping
        Shares of contact time. The keys are the sense of the swing that the contacts stop (`ccw` or `cw`), and a set of
        corners. A value is the share of the sense's contact time in which exactly these corners carry force. Corners
        have the labels of the scene, or their names without labels.
    solver : mapping
        The method, its `tol` or `dt`, and the numbers of steps, evaluations and events. An evaluation is one order of
        the Taylor series, or one evaluation of the right-hand side in a fixed step.
    wear_depth : ndarray, shape (8,)
        Wear depth of each pad at the end in m.
    wall_s : float
        Wall-clock time of the run in s, without compilation.
    compile_s : float
        Wall-clock time in s of the compilation before the run.
    energy_balance : EnergyBalance or None
        Balance of energy and momentum, if it was requested.
    sensitivity : Sensitivity or None
        Growth of errors along the motion, if it was requested.
    frame : ndarray, shape (n, 6), or None
        Displacement x, y [m], theta [rad] of a frame on springs (`Support`), and its rates. q and v are relative to the
        frame.
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
    sensitivity: Sensitivity | None = None
    frame: Array | None = None

    def _repr_html_(self) -> str:
        duration = float(self.t[-1]) if len(self.t) else 0.0
        title = f"{duration:g} s of motion, {len(self.t)} rows, {len(self.events)} changes of contact"
        heads = ("pair", "largest force [kN]", "mean in contact [kN]", "impulse [kN s]", "in contact [s]", "makes")
        keys = ("max", "mean_in_contact", "impulse", "time_in_contact", "makes")
        factors = (1e-3, 1e-3, 1e-3, 1.0, 1.0)
        rows = [
            [pair, *(f"{factor * value[key]:.4g}" for key, factor in zip(keys, factors, strict=True))]
            for pair, value in self.statistics.items()
        ]
        head = "".join(f"<th>{text}</th>" for text in heads)
        body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
        return f"<table><caption>{title}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def simulate(
    scene: Scene,
    t_end: float,
    output_dt: float | None = None,
    tol: float = 1e-9,
    method: Method = "events",
    dt: float | None = None,
    energy_balance: bool = False,
    *,
    max_steps: int = BUDGET,
    max_wall_s: float = MOST_SECONDS,
    on_progress: Callable[[float], None] | None = None,
    sensitivity: bool | Sequence[str] = False,
) -> Result:
    """Simulate a scene from t = 0 to `t_end`.

    Parameters
    ----------
    scene : Scene
    t_end : float
        End of the motion in s, at least 0.
    output_dt : float, optional
        Interval of the output rows in s; the default is a thousandth of the motion. The rows do not influence the
        motion. Fixed-step methods require a whole multiple of `dt`.
    tol : float
        Tolerance of the pose relative to the clearance, for `method="events"`.
    method : {"events", "rk4", "euler"}
        `events`: Taylor series with event detection. `rk4`, `euler`: fixed steps without event detection.
    dt : float, optional
        Step size in s of the fixed-step methods.
    energy_balance : bool
        Whether to compute the balance of energy and momentum (`Result.energy_balance`).
    max_steps : int
        Largest number of steps of the run.
    max_wall_s : float
        Largest wall-clock time in s of the run, without compilation.
    on_progress : callable, optional
        Function that is called with the completed share of the motion, 0..1, some fifty times a second.
    sensitivity : bool or sequence of str
        Whether to integrate the linearised motion, which shows whether the tolerance is met (`Result.sensitivity`). If
        errors grow too much, a `ToleranceWarning` is issued. A sequence of parameter paths (`sensitivity_parameters`)
        selects derivatives with respect to these parameters.

        The computation takes some five times as long as the run. For scenes that the linearised equations do not
        support (docs/solver.md), it takes a hundred times as long, or longer.

    Returns
    -------
    Result
        Output rows, events and statistics of the motion.

    Raises
    ------
    ArgumentError
        An argument is not valid.
    SolverError
        The solver cannot continue the motion. The message contains the time and the cause.
    LimitError
        `max_steps` or `max_wall_s` was reached. The attribute `result` of the error contains the motion up to the
        limit.
    RunInterrupted
        The user pressed Ctrl-C. The attribute `result` of the error contains the motion up to the interruption.
    """
    check_times(t_end, output_dt, method, dt)
    check_limits(max_steps, max_wall_s)
    if isinstance(sensitivity, str):
        raise ArgumentError(f"sensitivity: got {sensitivity!r}, expected True or a sequence of paths")
    compiled = compile_scene(scene, tol)
    if output_dt is None and dt is not None:
        output_dt = dt * max(1, round(t_end / dt / _ROWS_BY_DEFAULT))
    times = output_times(t_end, output_dt)
    compile_s = _make_ready(compiled, energy_balance, method, dt)
    begin = _time.perf_counter()
    motion, watch = _start(compiled, len(times), energy_balance), _Watch(t_end, max_steps, max_wall_s, on_progress)

    def so_far(rows: int, time: float) -> Result:
        wall_s = _time.perf_counter() - begin
        return _result(compiled, times, rows, time, tol, method, dt, motion, wall_s, compile_s)

    try:
        _run(compiled, motion, times, t_end, method, dt, watch)
    except LimitError as stop:
        raise LimitError(str(stop), so_far(motion.rows, motion.time), motion.time) from None
    except KeyboardInterrupt:
        message = f"interrupted at t = {motion.time:.9g} s of {t_end:g} s"
        raise RunInterrupted(message, so_far(motion.rows, motion.time), motion.time) from None
    result = so_far(len(times), t_end)
    if not sensitivity or t_end == 0.0:
        return result
    value = sensitivity_of(scene, t_end, tol, () if isinstance(sensitivity, bool) else tuple(sensitivity))
    if not value.trusted:
        warnings.warn(str(value), ToleranceWarning, stacklevel=2)
    return replace(result, sensitivity=value)


class _Watch:
    """Checks limits and reports progress between slices of a run."""

    def __init__(
        self, t_end: float, max_steps: int, max_wall_s: float, on_progress: Callable[[float], None] | None
    ) -> None:
        self._t_end, self.max_steps, self._max_wall_s, self._on_progress = t_end, max_steps, max_wall_s, on_progress
        self._begin = _time.perf_counter()

    def look(self, motion: Motion) -> None:
        """Report progress, and raise `LimitError` without a result if a limit is reached."""
        steps, wall = int(motion.state.steps), _time.perf_counter() - self._begin
        if self._on_progress is not None:
            self._on_progress(motion.time / self._t_end if self._t_end > 0.0 else 1.0)
        limit = f"max_steps = {self.max_steps}" if steps >= self.max_steps else f"max_wall_s = {self._max_wall_s:g}"
        if steps >= self.max_steps or wall >= self._max_wall_s:
            mode = motion.state.mode
            pairs = ", ".join(name for name, pair_mode in zip(PAIR_NAMES, mode, strict=True) if pair_mode != OFF)
            raise LimitError(
                f"{limit} reached at t = {motion.time:.9g} s of {self._t_end:g} s after {steps} steps and "
                f"{wall:.1f} s; the last step was {float(motion.state.last_step_size):.3g} s long, in contact: "
                f"{pairs or 'no pair'}",
                None,
                motion.time,
            )


def check_times(t_end: float, output_dt: float | None, method: str = "events", dt: float | None = None) -> None:
    """Raise `ArgumentError` if the times of a run are not valid."""
    if not (_is_finite(t_end) and t_end >= 0.0):
        raise ArgumentError(f"t_end: got {t_end!r}, expected a finite time >= 0 [s]")
    if output_dt is not None and not (_is_finite(output_dt) and output_dt > 0.0):
        raise ArgumentError(f"output_dt: got {output_dt!r}, expected a finite time > 0 [s]")
    if output_dt is not None and t_end / output_dt > _MOST_ROWS:
        raise ArgumentError(f"output_dt: got {output_dt!r}, expected at least t_end / {_MOST_ROWS:g} [s]")
    if method not in get_args(Method):
        raise ArgumentError(f"method: got {method!r}, expected one of {', '.join(get_args(Method))}")
    if method == "events":
        if dt is not None:
            raise ArgumentError(f"dt: got {dt!r}, expected None with method='events'")
        return
    if dt is None or not (_is_finite(dt) and dt > 0.0):
        raise ArgumentError(f"dt: got {dt!r}, expected a finite time > 0 [s] with method={method!r}")
    for name, value in (("t_end", t_end), ("output_dt", output_dt)):
        if value is not None and abs(value / dt - round(value / dt)) > 1e-6 * max(1.0, value / dt):
            raise ArgumentError(f"{name}: got {value!r}, expected a whole multiple of dt = {dt!r} [s]")


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def output_times(t_end: float, output_dt: float | None) -> Array:
    """Return the times 0, output_dt, ..., t_end of the output rows. By default there are a thousand intervals."""
    if t_end == 0.0:
        return np.zeros(1)
    if output_dt is None:
        output_dt = t_end / _ROWS_BY_DEFAULT
    count = int(np.floor(t_end / output_dt * (1.0 + 1e-12)))
    times: Array = np.arange(count + 1.0)
    times *= output_dt
    times[-1] = min(times[-1], t_end)
    return times if t_end - times[-1] <= 1e-9 * output_dt else np.append(times, t_end)


#: Scratch space of the last run, which the next run reuses. A run that overlaps another run allocates its own.
_spare: Final[deque[Work]] = deque(maxlen=1)
#: Combinations of terms, options and method whose kernels this process has compiled or loaded.
_ready: set[tuple[object, ...]] = set()


def _make_ready(compiled: CompiledScene, energy_balance: bool, method: Method, dt: float | None) -> float:
    """Compile or load the kernels by a run of length 0. Return the time in s, which is 0 for loaded kernels."""
    parts = compiled.parts
    loads = parts.harmonics is None, parts.segments is None, None if parts.implicit is None else parts.implicit.dtype
    kind = parts.terms, *loads, options(compiled.scene), method == "events", energy_balance
    if kind in _ready:
        return 0.0
    begin = _time.perf_counter()
    _run(compiled, _start(compiled, 1, energy_balance), np.zeros(1), 0.0, method, dt)
    _ready.add(kind)
    return _time.perf_counter() - begin


def _start(compiled: CompiledScene, rows: int, energy_balance: bool) -> Motion:
    motion = Motion.start(compiled, np.empty((rows, 3)), np.empty((rows, 3)), outputs=True)
    motion.sums = new_balance() if energy_balance else None
    return motion


def _run(
    compiled: CompiledScene,
    motion: Motion,
    times: Array,
    t_end: float,
    method: Method,
    dt: float | None,
    watch: _Watch | None = None,
) -> None:
    budget = BUDGET if watch is None else watch.max_steps
    look = None if watch is None else watch.look
    if dt is None:
        work = _spare_work()
        code, _ = run_events(compiled, motion, times, t_end, work, budget, look)
        _spare.append(work)
    else:
        stride = round(float(times[1]) / dt) if len(times) > 1 else 1
        code = run_fixed(compiled, motion, round(t_end / dt), stride, dt, method == "euler", budget, look)
    if code == Status.BUDGET and watch is not None:
        watch.look(motion)
    if code != Status.OK:
        raise SolverError(f"at t = {motion.time:.9g} s: {failure(Status(code), compiled, motion)}")


def failure(status: Status, compiled: CompiledScene, motion: Motion) -> str:
    """Return the reason why a motion ended early, with the angle or penetration beyond the range of the model."""
    if status is not Status.OUT_OF_RANGE:
        return status.text
    beyond = np.zeros(3)
    range_of(compiled.params, motion.state, beyond)
    return f"the head left the model's range: {beyond_range(beyond, float(compiled.params.half_cavity))}"


def _spare_work() -> Work:
    try:
        return _spare.pop()
    except IndexError:
        return new_work()


def _result(
    compiled: CompiledScene,
    times: Array,
    rows: int,
    time: float,
    tol: float,
    method: str,
    dt: float | None,
    motion: Motion,
    wall_s: float,
    compile_s: float,
) -> Result:
    scene, log, state = compiled.scene, motion.log, motion.state
    assert motion.force is not None and motion.penetration is not None
    # an attribute of a record takes some ten times as long as an item
    size = int(motion.totals["logged"])
    setting = {"tol": tol} if method == "events" else {"dt": dt}
    solver = {
        "method": method, **setting, "steps": int(state["steps"]), "evaluations": int(state["evaluations"]),
        "events": int(state["events"]) if method != "events" else size,
    }  # fmt: skip
    return Result(
        t=times[:rows], q=motion.q[:rows], v=motion.v[:rows], force=motion.force[:rows],
        penetration=motion.penetration[:rows], events=log[:size].copy(), statistics=statistics_of(motion.totals, time),
        contact_sets=contact_sets_of(scene, motion.totals), solver=solver, wear_depth=state["wear_depth"].copy(),
        wall_s=wall_s, compile_s=compile_s,
        energy_balance=energy_balance_of(compiled, motion.state, motion.sums) if motion.sums is not None else None,
        frame=None if motion.frame is None else motion.frame[:rows],
    )  # fmt: skip


def statistics_of(totals: Totals, duration: float) -> dict[str, dict[str, float]]:
    """Return the statistics of each pair over a motion of a given duration in s, as in `Result.statistics`."""
    table = {}
    sums = [totals[name].tolist() for name in ("peak", "impulse", "time_in_contact", "makes")]
    for name, peak, impulse, contact, makes in zip(PAIR_NAMES, *sums, strict=True):
        table[name] = {
            "max": peak,
            "mean_in_contact": impulse / contact if contact > 0.0 else 0.0,
            "mean_over_time": impulse / duration if duration > 0.0 else 0.0,
            "impulse": impulse,
            "time_in_contact": contact,
            "makes": makes,
        }
    return table


def contact_sets_of(scene: Scene, totals: Totals) -> dict[str, dict[str, float]]:
    """Return the shares of contact time, as in `Result.contact_sets`, in descending order."""
    labels = list(scene.frame.corner_labels.values())
    joint = "" if scene.frame.labels else "+"
    senses = {}
    # the force of a pair turns a block and a cavity in opposite senses
    order = ("ccw", "cw") if scene.head.carries == "walls" else ("cw", "ccw")
    for sense, times in sorted(zip(order, totals["set_time"], strict=True), key=lambda item: item[0]):
        total = times.sum()
        shares = {
            joint.join(sorted(labels[i] for i in range(4) if mask >> i & 1)): float(times[mask] / total)
            for mask in range(1, 16)
            if times[mask] > 0.0
        }
        senses[sense] = dict(sorted(shares.items(), key=lambda item: -item[1]))
    return senses
