"""The live twin of one head, which is advanced in time under sampled or analytic loads."""

from __future__ import annotations

import hashlib
import math
import time as _time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError
from plow_twin.kernel.compiler import for_arguments
from plow_twin.model import geometry
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Initial, Scene, check_travel_speed
from plow_twin.run.advance import Advance, AdvanceSeries, check_times
from plow_twin.run.pace import MOST_SECONDS, OutOfTimeError, Pace, check_limits, clear_sums, raise_stopped
from plow_twin.solve import loop
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene, inertias, options, wear_rate
from plow_twin.solve.method.rest import AT_REST
from plow_twin.solve.method.step_size import PARTING_ORDER
from plow_twin.solve.modes import beyond_range, settle_moved
from plow_twin.solve.samples import lay_out
from plow_twin.solve.state import (
    BOUND,
    ROW,
    TOTALS,
    WORK,
    Bound,
    State,
    Status,
    first_of,
    new_record,
    new_records,
    new_work,
    state_type,
)
from plow_twin.solve.support import frame_at

__all__ = ["Advance", "AdvanceSeries", "Status", "Twin"]

#: Default number of steps after which an advance fails.
DEFAULT_BUDGET = 50_000_000
#: Compiled kernels by signature and kind, which determine the argument types. Numba's own look-up takes milliseconds.
_entries: dict[tuple[Any, ...], Callable[..., bool]] = {}
_NO_DIGESTS = np.zeros(0, np.int64)
_ONLY_TWIN = np.zeros(1, np.int64)
#: Smallest admissible number of evaluations of an advance, enough for four Runge-Kutta steps.
LEAST_EVALUATIONS = 16


class Twin:
    """One head that is advanced in time.

    Parameters
    ----------
    scene : Scene
    tol : float
        Tolerance of the pose relative to the clearance.
    excitation : {"scene", "sampled"}
        `scene`: the loads of the scene. `sampled`: the wrenches given to `advance`, interpolated linearly, instead of
        the loads of the scene.
    start : float
        Model time in s of the scene's initial state.
    max_evaluations : int, optional
        Largest number of evaluations of the equations of motion in an advance, at least `LEAST_EVALUATIONS`, for hard
        real time. One order of the Taylor series is one evaluation. If an advance needs more evaluations, a few
        Runge-Kutta steps complete it, and its `error_estimate_m` is not zero.
    max_steps : int
        Largest number of steps of an advance. If an advance needs more steps, its status is `BUDGET`, and the twin is
        unchanged.
    max_wall_s : float
        Largest wall-clock time in s of a call that advances the twin.

    Notes
    -----
    A call raises `LimitError` after `max_wall_s`, and `RunInterrupted` after Ctrl-C. After such an error, the twin has
    the state after the last complete advance. The attribute `result` of the error contains the rows up to this advance.

    The motion does not depend on the output times. Each sample ends a step of the solver, so only equal samples give
    bit-identical results.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        tol: float = 1e-9,
        excitation: Literal["scene", "sampled"] = "scene",
        start: float = 0.0,
        max_evaluations: int | None = None,
        max_steps: int = DEFAULT_BUDGET,
        max_wall_s: float = MOST_SECONDS,
    ) -> None:
        check_limits(max_steps, max_wall_s)
        if excitation not in ("scene", "sampled"):
            raise ArgumentError(f"excitation: got {excitation!r}, expected 'scene' or 'sampled'")
        self.scene = scene
        self.tol = tol
        self.excitation: Literal["scene", "sampled"] = excitation
        self.max_evaluations = max_evaluations
        compiled = compile_scene(scene, tol, sampled=excitation == "sampled")
        self._params = new_records(compiled.params.dtype, 1)
        self._states = new_records(state_type(compiled.parts.terms), 1)
        self._params[0] = compiled.params
        self._state: State = first_of(self._states)
        self._compiled: CompiledScene = replace(compiled, params=first_of(self._params))
        self._parts = self._compiled.parts
        self._max_steps, self._max_wall_s = max_steps, max_wall_s
        self._budget, self._bound = _bounded(max_evaluations, int(compiled.params.order), max_steps)
        self._pace = Pace(self._states.dtype, compiled.parts.implicit is not None, max_wall_s)
        self._works, self._all_totals = new_records(WORK, 1), new_records(TOTALS, 1)
        self._works[0] = new_work()
        self._work, self._totals = first_of(self._works), first_of(self._all_totals)
        self._states[0] = compiled.initial_state(start)
        self._inertias = inertias(scene)
        #: kernel that writes output rows (True), and kernel without output (False)
        self._kernels: dict[bool, Callable[..., bool]] = {}
        #: model time in s, as a view of the state
        self._time = self._states["time"]
        self._wrench = np.zeros(3)
        #: `_one_load`: work space for one sample of the load, divided by mass and inertia. `_no_snapshots`: an empty
        #: array of snapshots.
        self._one_load, self._no_snapshots = np.empty((1, 2, 3)), self._states[:0]
        self._travel_speed = scene.wear.travel_speed_m_s if scene.wear is not None else 0.0

    @property
    def signature(self) -> tuple[bool, ...]:
        """Optional terms of the equations. Twins with equal signatures share their compiled code."""
        parts = self._parts
        arguments = (*parts.terms, parts.harmonics, parts.segments, parts.implicit, self._bound)
        return (*(part is not None for part in arguments), *options(self.scene))

    def like(self, scene: Scene) -> Twin:
        """Return a new twin of the given scene, with the tolerance, excitation and limits of this twin.

        Parameters
        ----------
        scene : Scene

        Returns
        -------
        Twin
        """
        return Twin(
            scene, tol=self.tol, excitation=self.excitation, max_evaluations=self.max_evaluations,
            max_steps=self._max_steps, max_wall_s=self._max_wall_s,
        )  # fmt: skip

    @property
    def time(self) -> float:
        """Model time in s."""
        return float(self._time[0])

    def warm_up(self) -> float:
        """Compile every kernel that this scene needs, or load it from the disk cache. Return the time in s."""
        begin = _time.perf_counter()
        saved = self.snapshot()
        self.advance(self.time + 1e-6)
        self.restore(self.snapshot())
        self._end_step()
        self.restore(saved)
        return _time.perf_counter() - begin

    def advance(self, t: float, wrench: ArrayLike | None = None) -> Advance:
        """Advance to model time `t`.

        Parameters
        ----------
        t : float
            Model time in s, at least the current model time.
        wrench : array_like, shape (3,), optional
            Fx, Fy [N] and M [N m] about the cavity's centre at `t`, only for `excitation="sampled"`. The load changes
            linearly from the previous sample to this sample. Without `wrench`, the load stays at its last sample.

        Returns
        -------
        Advance
            State at `t`, and sums since the previous advance. If `status` is not `OK`, the twin is unchanged.

        Raises
        ------
        ArgumentError
            The time is before the current model time, or a number is not finite. The twin is unchanged.
        """
        if self.excitation == "scene" and wrench is not None:
            raise ArgumentError(f"wrench: got {wrench!r}, expected None with excitation='scene'")
        sample = self._wrench if wrench is None else np.asarray(wrench, dtype=np.float64)
        if sample.shape != (3,):
            raise ArgumentError(f"wrench: got {sample!r}, expected 3 finite numbers")
        rows = np.zeros(1, ROW)
        self.advance_rows(np.array([t], dtype=np.float64), sample[None], rows)
        return Advance(rows[0])

    def advance_samples(self, t: ArrayLike, wrench: ArrayLike) -> AdvanceSeries:
        """Advance through many samples. The results are bit-identical to one `advance` per sample.

        Parameters
        ----------
        t : array_like, shape (n,)
            Model times in s, not decreasing.
        wrench : array_like, shape (n, 3)
            Fx, Fy [N] and M [N m] about the cavity's centre at each time.

        Returns
        -------
        AdvanceSeries
            One row for each sample.

        Raises
        ------
        ArgumentError
            The arguments are not valid (see `advance`). The twin is unchanged.
        """
        if self.excitation != "sampled":
            raise ArgumentError("advance_samples: got excitation='scene', expected excitation='sampled'")
        times = np.asarray(t, dtype=np.float64)
        rows = np.zeros(times.size, ROW)
        self.advance_rows(times, np.asarray(wrench, dtype=np.float64), rows)
        return AdvanceSeries(rows)

    def advance_rows(
        self,
        t: NDArray[np.float64],
        wrench: NDArray[np.float64],
        rows: NDArray[np.void] | None,
        digest_after: NDArray[np.int64] = _NO_DIGESTS,
    ) -> Advanced:
        """Advance to given times.

        Parameters
        ----------
        t : ndarray, shape (n,)
            Model times in s, not decreasing.
        wrench : ndarray, shape (n, 3)
            Fx, Fy [N] and M [N m] about the cavity's centre at each time. Ignored for `excitation="scene"`.
        rows : ndarray of `ROW`, shape (n,), or None
            Array for one output row per time. None saves the computation of forces for output, and does not change the
            motion.
        digest_after : ndarray of int64, shape (m,)
            Increasing numbers from 1 to n. A digest of the state is computed when this number of advances is complete.

        Returns
        -------
        Advanced
            Number of failed advances, and the m digests.

        Raises
        ------
        ArgumentError
            The arguments are not valid (see `advance`). The twin is unchanged.
        """
        sampled, count, with_rows = self.excitation == "sampled", len(t), rows is not None
        t, wrench = np.ascontiguousarray(t, np.float64), np.ascontiguousarray(wrench, np.float64)
        check_times(self.time, t)
        per_inertia = None
        if sampled:
            per_inertia = self._one_load if count == 1 else np.empty((1, count + 1, 3))
            if wrench.shape != (count, 3) or not lay_out(self._wrench, wrench, self._inertias, per_inertia[0]):
                raise ArgumentError(f"wrench: got {wrench!r}, expected finite numbers of shape ({count}, 3)")
        snapshots = np.zeros(len(digest_after), self._states.dtype) if len(digest_after) else self._no_snapshots
        arguments = (
            self._params, self._parts, self._states, self._pace.saved, self._works,
            None if rows is None else self._all_totals, 0, 1, t, per_inertia, self._budget,
            None if rows is None else rows[None], digest_after, snapshots, self._bound, self._pace.argument,
        )  # fmt: skip
        if with_rows not in self._kernels:
            self._kernels[with_rows] = self._kernel((sampled, with_rows), arguments)
        try:
            self._pace.run(self._kernels[with_rows], arguments)
        except (OutOfTimeError, KeyboardInterrupt) as stop:
            self._stopped(stop, count, wrench if sampled else None, rows)
        if sampled and count:
            self._wrench[:] = wrench[-1]
        digests = self._digests(snapshots, wrench[digest_after - 1]) if len(digest_after) else []
        return Advanced(self._pace.failed.item(), digests)

    @property
    def wrench(self) -> NDArray[np.float64]:
        """Last sample of the load, shape (3,): Fx, Fy [N] and M [N m]. The value is zero before the first sample."""
        return self._wrench.copy()

    def reset(
        self, t: float, *, wear_depth: ArrayLike | None = None, pose: tuple[ArrayLike, ArrayLike] | None = None
    ) -> None:
        """Restart at model time `t` from the initial state of the scene or from a given state.

        Parameters
        ----------
        t : float
            Model time in s.
        wear_depth : array_like, shape (8,), optional
            Wear depth of each pad in m, at least 0. The default is the scene's initial wear depth.
        pose : tuple of array_like, shapes (3,) and (3,), optional
            x, y [m], theta [rad] and their rates at the start. The default is the scene's initial state. Rates of
            locked degrees of freedom, which rounding leaves in a motion, are set to 0.

        Raises
        ------
        ArgumentError
            A time, depth or pose is not valid. The twin is unchanged.
        """
        if not np.isfinite(t):
            raise ArgumentError(f"t: got {t!r}, expected a finite time in s")
        depth = None if wear_depth is None else np.asarray(wear_depth, dtype=np.float64)
        if depth is not None and (depth.shape != (PAIR_COUNT,) or not (np.isfinite(depth) & (depth >= 0.0)).all()):
            raise ArgumentError(f"wear_depth: got {wear_depth!r}, expected {PAIR_COUNT} finite depths >= 0 in m")
        begin = self._compiled
        if pose is not None:
            q, v = (np.asarray(part, dtype=np.float64) for part in pose)
            if q.shape != (3,) or v.shape != (3,) or not np.isfinite([q, v]).all():
                raise ArgumentError(f"pose: got {pose!r}, expected pose and rates, 3 finite numbers each")
            v = np.where(self.scene.free, v, 0.0)
            initial = Initial((q[0], q[1], q[2]), (v[0], v[1], v[2]))
            begin = replace(begin, scene=replace(self.scene, initial=initial))
        self._states[0] = begin.initial_state(t, depth)
        self._wrench = np.zeros(3)

    def move(self, q: ArrayLike, v: ArrayLike) -> None:
        """Set pose and rates at the current time, only for sampled loads. Wear and counters are unchanged.

        Parameters
        ----------
        q : array_like, shape (3,)
            Pose x, y [m], theta [rad]. If a contact continues, the damping factor from its first touch remains valid.
        v : array_like, shape (3,)
            Rates of the pose in m/s, m/s and rad/s; rates of locked degrees of freedom are set to 0, as by `reset`.
        """
        place = geometry.states_of(self.scene, np.concatenate([q, np.where(self.scene.free, v, 0.0)])[None])
        settle_moved(self._params, self._states, _ONLY_TWIN, place, self.time, self._parts.terms.stick)

    def set_travel_speed(self, speed_m_s: float) -> None:
        """Set the speed along the face from the current time on. Only wear depends on this speed.

        Parameters
        ----------
        speed_m_s : float
            Speed in m/s. The sign is the direction; wear depends on the magnitude.

        Raises
        ------
        ArgumentError
            The speed is not finite or exceeds the limit of the damping (`check_travel_speed`).
        """
        check_travel_speed(self.scene, float(speed_m_s))
        if self._parts.terms.wear is not None:
            self._end_step()
            self._set_wear_rate(abs(float(speed_m_s)))

    def snapshot(self) -> bytes:
        """Return the exact state as bytes. Twins of the same scene, tolerance and excitation can restore it."""
        return self._state.tobytes() + self._wrench.tobytes() + np.float64(self._travel_speed).tobytes()

    def restore(self, data: bytes) -> None:
        """Restore a state saved by `snapshot`.

        Parameters
        ----------
        data : bytes
            Snapshot of a twin of the same scene, tolerance and excitation.

        Raises
        ------
        ArgumentError
            The data does not have the size of a snapshot.
        """
        self._states[0], self._wrench, speed = read_snapshot(data, self._states.dtype)
        self._set_wear_rate(speed)
        self._lay_out_again()

    def digest(self) -> str:
        """Return a hash of the exact state, as 16 hexadecimal digits."""
        return _digest(self.snapshot())

    @property
    def wear_depth(self) -> NDArray[np.float64]:
        """Wear depth of each pad at the end of the last solver step [m], shape (8,). Each sample ends a step."""
        depth: NDArray[np.float64] = self._state.wear_depth.copy()
        return depth

    def failure(self, status: int) -> str:
        """Return the reason for the most recent failure of an advance.

        Parameters
        ----------
        status : int
            Status of the failed advance.

        Returns
        -------
        str
            The reason. For `OUT_OF_RANGE` it contains the angle or penetration, and the limit of the model.
        """
        if status != Status.OUT_OF_RANGE:
            return Status(status).text
        return beyond_range(self._work.beyond, float(self._compiled.params.half_cavity))

    @property
    def frame(self) -> NDArray[np.float64] | None:
        """Displacement x, y [m], theta [rad] of a frame on springs and its rates, shape (6,); None if it is fixed."""
        state, work = self._state, self._work
        if self._parts.terms.support is None:
            return None
        if state.step_size < 0.0:
            return np.array(state.frame)
        # the current time may be within a step: evaluate the series of this step at the sigma of
        # `dense_output.sigma_at`
        used, beta = float(state.elapsed), float(state.beta)
        sigma = 2.0 * used / (state.alpha + math.sqrt(max(state.alpha**2 + 2.0 * beta * used, 0.0)))
        return frame_at(work.frame, int(state.order), sigma)

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return int(self._state.steps)

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the equations of motion so far. One order of the series is one evaluation."""
        return int(self._state.evaluations)

    @property
    def bounded(self) -> int:
        """Number of advances so far that Runge-Kutta steps completed because of `max_evaluations`."""
        return int(self._state.bounded)

    def _kernel(self, kind: tuple[bool, bool], arguments: tuple[Any, ...]) -> Callable[..., bool]:
        """Return the kernel for these arguments, whose types the signature and `kind` determine."""
        key = self.signature, kind
        if key not in _entries:
            _entries[key] = for_arguments(loop.advance_rows, arguments)
        return _entries[key]

    def _digests(self, states: NDArray[np.void], wrench: NDArray[np.float64]) -> list[str]:
        """Return a digest of each state and its last sample of the load, for `wrench` of shape (m, 3)."""
        size = states.itemsize
        rows = np.empty((len(states), size + 32), np.uint8)  # each row has the layout of `snapshot`
        rows[:, :size] = states.view(np.uint8).reshape(len(states), size)
        rows[:, size : size + 24] = np.ascontiguousarray(wrench).view(np.uint8)
        rows[:, size + 24 :] = np.frombuffer(np.float64(self._travel_speed).tobytes(), np.uint8)
        return [_digest(row.data) for row in rows]

    def _stopped(
        self, stop: BaseException, count: int, samples: NDArray[np.float64] | None, rows: NDArray[np.void] | None
    ) -> NoReturn:
        """Restore the state after the last complete advance, and raise an error."""
        steps, done = self.steps, int(self._pace.record.row)
        self._go_back()
        if samples is not None and done > 0:
            self._wrench = samples[done - 1].copy()
        part = None if rows is None else AdvanceSeries(rows[:done])
        progress = f"at t = {self.time:.9g} s after {done} of {count} advances, {steps} steps in all"
        raise_stopped(stop, self._max_wall_s, progress, part, self.time)

    def _go_back(self) -> None:
        if self._pace.record.underway == 0:
            return
        self._states[0] = self._pace.saved[0]
        self._lay_out_again()
        clear_sums(self._all_totals)

    def _lay_out_again(self) -> None:
        """Compute the series of the step in which the restored state is, if it is in a step."""
        if self._state.step_size >= 0.0:
            loop.lay_out_again(self._compiled.params, self._parts, self._state, self._work)

    def _end_step(self) -> None:
        loop.interrupt_step(self._compiled.params, self._parts, self._state, self._work, self._totals)

    def _set_wear_rate(self, speed: float) -> None:
        self._travel_speed = speed
        wear = self.scene.wear
        if wear is not None and self._parts.terms.wear is not None:
            self._compiled.params.wear_per_impulse[:] = wear_rate(wear, speed)


class Advanced(NamedTuple):
    """Number of failed advances of a call, and the digests."""

    failed: int
    digests: list[str]


def read_snapshot(data: bytes, dtype: np.dtype[np.void]) -> tuple[np.void, NDArray[np.float64], float]:
    """Return the state of type `dtype`, the wrench, shape (3,), and the travel speed [m/s] in a `Twin.snapshot`.

    Raise `ArgumentError` if the data does not have the size of a snapshot.
    """
    size = dtype.itemsize
    if len(data) != size + 32:
        raise ArgumentError(f"snapshot: got {len(data)} bytes, expected {size + 32}")
    wrench_and_speed = np.frombuffer(data[size:])
    return np.frombuffer(data[:size], dtype)[0], wrench_and_speed[:3].copy(), float(wrench_and_speed[3])


def _digest(snapshot: bytes | memoryview) -> str:
    return hashlib.blake2b(snapshot, digest_size=8).hexdigest()


def _bounded(max_evaluations: int | None, order: int, max_steps: int) -> tuple[int, Bound | None]:
    """Return the largest number of series steps of an advance, and the Runge-Kutta steps that can complete it."""
    if max_evaluations is None:
        return max_steps, None
    if isinstance(max_evaluations, bool) or not max_evaluations >= LEAST_EVALUATIONS:
        raise ArgumentError(f"max_evaluations: got {max_evaluations!r}, expected an integer >= {LEAST_EVALUATIONS}")
    coarse = max(LEAST_EVALUATIONS // 4, max_evaluations // 16)
    budget = (int(max_evaluations) - 4 * coarse) // (order + PARTING_ORDER + AT_REST)
    bound: Bound = new_record(BOUND)
    bound.steps = coarse
    return budget, bound
