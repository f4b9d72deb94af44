"""Many live twins that are advanced together under sampled loads."""

from __future__ import annotations

import ctypes
import hashlib
import math
import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError
from plow_twin.model import geometry
from plow_twin.model.scene import Scene, check_travel_speed
from plow_twin.run.advance import AdvanceBatch, check_times
from plow_twin.run.lane_twins import LaneTwins
from plow_twin.run.pace import MOST_SECONDS, OutOfTimeError, Pace, check_limits, clear_sums, raise_stopped
from plow_twin.run.twin import DEFAULT_BUDGET, read_snapshot
from plow_twin.solve import loop
from plow_twin.solve.compiled_scene import CompiledScene, compile_scenes, inertias, options, start_many, wear_rate
from plow_twin.solve.lanes.advance import Load
from plow_twin.solve.lanes.record import fits_lanes
from plow_twin.solve.method.implicit import new_implicit
from plow_twin.solve.modes import settle_moved
from plow_twin.solve.state import ADVANCE, ROW, SEGMENT, TOTALS, WORK, Parts, Terms, new_records, new_work, state_type

__all__ = ["TwinBatch"]

_Array = NDArray[np.float64]
_NO_MARKS = np.zeros(0, np.int64)
#: Size of a cache line in bytes.
_LINE = 64
#: Largest number of values that Python checks faster than numpy.
_FEW = 32
#: Terms without effect if their parameters are zero. Code with these terms can run scenes without them.
_OPTIONAL = ("hysteretic", "wear", "sliding", "running_in", "offset", "free", "slip")


def _signature(parts: Parts, scene: Scene) -> tuple[bool, ...]:
    """Return which terms and options a scene has."""
    return (*(part is not None for part in (*parts.terms, parts.implicit)), *options(scene))


class TwinBatch:
    """A live ensemble of twins. The twins are advanced together, each under its own sampled load.

    Parameters
    ----------
    scenes : sequence of Scene
        Scene of each twin. The loads of the scenes are ignored. All contact laws must have the same terms: C d', a
        ramp, or lambda, which is zero without damping. The exponents must be all 1, all integers of at least 2, or all
        fractions.
    tol : float
        Tolerance of the pose relative to the clearance.
    start : float
        Model time in s of the initial states of the scenes.
    workers : int, optional
        Number of threads. The default is 1, because waking a second thread takes longer than an advance by one sample.
    max_steps : int
        Largest number of steps of an advance of one twin (see `Twin`).
    max_wall_s : float
        Largest wall-clock time in s of a call that advances the twins.
    compiled : tuple, optional
        Result of `compile_scenes` for the same scenes and tolerance, if they have been compiled before.

    Raises
    ------
    ArgumentError
        There are no scenes, or the terms of their equations differ.

    Notes
    -----
    A call raises `LimitError` after `max_wall_s`, and `RunInterrupted` after Ctrl-C. After such an error, all twins
    have the state before the call.

    Each SIMD vector advances eight twins if no scene has a ramp, wear, friction with stick, a support, locks, an offset
    centre of mass, `carries: corners`, rounded corners, a falling restitution or overdamped contact. The results agree
    with those of a `Twin` within the tolerance, and do not depend on the other twins of the batch if all have the same
    terms. In all other batches, the results are bit-identical to a `Twin` with the same terms.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        *,
        tol: float = 1e-9,
        start: float = 0.0,
        workers: int = 1,
        max_steps: int = DEFAULT_BUDGET,
        max_wall_s: float = MOST_SECONDS,
        compiled: tuple[NDArray[np.void], list[CompiledScene]] | None = None,
    ) -> None:
        check_limits(max_steps, max_wall_s)
        if not scenes:
            raise ArgumentError("scenes: got no scene, expected at least one")
        self.scenes = tuple(scenes)
        self.tol = tol
        self._params, self._compiled = compiled or compile_scenes(scenes, tol, sampled=True, kind=options(scenes[0]))
        terms = _merge(self._compiled)
        self._stick = terms.stick
        self._states = new_records(state_type(self._compiled[0].parts.terms), len(scenes))
        #: states before the last call, and memory for the states of the next call
        self._before = new_records(self._states.dtype, len(scenes))
        #: last samples of the load: shape (m, 3), or (1, 3) if all twins have the same sample
        self._wrench = np.zeros((1, 3))
        self._masses = np.array([inertias(scene) for scene in scenes])
        self._max_steps, self._max_wall_s = max_steps, max_wall_s
        count = max(1, min(workers, os.cpu_count() or 1, len(scenes)))
        self._workers = [_Worker.of(terms, self._compiled, max_wall_s) for _ in range(count)]
        self._edges = [len(scenes) * index // len(self._workers) for index in range(len(self._workers) + 1)]
        if all(fits_lanes(compiled_scene, sampled=True) for _, compiled_scene in _kinds(self._compiled)):
            spans = [range(*span) for span in pairwise(self._edges)]
            self._workers = [
                worker.with_lanes(self, terms, span) for worker, span in zip(self._workers, spans, strict=True)
            ]
        self._pool = ThreadPoolExecutor(len(self._workers)) if len(self._workers) > 1 else None
        self.reset(start)

    def __len__(self) -> int:
        return len(self.scenes)

    @property
    def time(self) -> float:
        """Model time in s."""
        return float(self._states["time"][0])

    @property
    def signature(self) -> tuple[bool, ...]:
        """Terms of the equations, as in `Twin.signature`. Batches with equal terms share their compiled code."""
        return _signature(self._workers[0].parts, self.scenes[0])

    def warm_up(self) -> None:
        """Compile every kernel that the twins may need, or load it from the disk cache. The twins are unchanged.

        Twins in lanes need the kernel of a twin without lanes only for rare steps.
        """
        saved = self.snapshot()
        self.advance(self.time + 1e-6)
        self.restore(saved)
        worker, times, member = self._workers[0], np.array([self.time]), slice(0, 1)
        line = self._ends(self._samples_before()[:, None], member)
        records = self._params[member], self._states[member].copy()
        worker.advance(*records, 0, 1, times, line, self._max_steps, np.zeros((1, 1), ROW))

    def set_wrench(self, wrench: ArrayLike) -> None:
        """Set the initial samples of the load. The load is interpolated linearly between samples.

        Parameters
        ----------
        wrench : array_like, shape (m, 3)
            Fx, Fy [N] and M [N m] about the cavity's centre, for each twin.
        """
        self._wrench = np.array(wrench, dtype=np.float64).reshape(len(self), 3)

    def advance(self, t: float, wrench: ArrayLike | None = None) -> AdvanceBatch:
        """Advance all twins to model time `t`.

        Parameters
        ----------
        t : float
            Model time in s, at least the current model time.
        wrench : array_like, shape (m, 3) or (3,), optional
            Fx, Fy [N] and M [N m] about the cavity's centre at `t`, for each twin or for all twins. Without `wrench`,
            the loads stay at their last samples.

        Returns
        -------
        AdvanceBatch
            One row for each twin.

        Raises
        ------
        ArgumentError
            The arguments are not valid (see `advance_samples`).
        """
        sample = self._samples_before() if wrench is None else np.asarray(wrench, dtype=np.float64)
        if sample.shape not in ((3,), (len(self), 3)):
            raise ArgumentError(f"wrench: got shape {sample.shape}, expected (3,) or ({len(self)}, 3)")
        return self.advance_samples(np.array([t], dtype=np.float64), sample[..., None, :])

    def advance_samples(self, t: ArrayLike, wrench: ArrayLike) -> AdvanceBatch:
        """Advance all twins through many samples. The results are bit-identical to one `advance` per sample.

        Parameters
        ----------
        t : array_like, shape (n,)
            Model times in s, not decreasing.
        wrench : array_like, shape (m, n, 3) or (n, 3)
            Fx, Fy [N] and M [N m] about the cavity's centre at each time, for each twin or for all twins.

        Returns
        -------
        AdvanceBatch
            One row for each twin and sample.

        Raises
        ------
        ArgumentError
            A time is before the current model time, or a number is not finite. The batch is unchanged.
        """
        times, samples = np.ascontiguousarray(t, dtype=np.float64), np.asarray(wrench, dtype=np.float64)
        check_times(self.time, times)
        shape = (len(self), len(times), 3)
        if samples.shape not in (shape, shape[1:]) or not _all_finite(samples):
            raise ArgumentError(f"wrench: got {samples!r}, expected finite numbers of shape {shape} or {shape[1:]}")
        samples = np.ascontiguousarray(samples if samples.ndim == 3 else samples[None])
        rows = self._run(times, samples)
        if len(times):
            self._wrench = samples[:, -1].copy()
        return AdvanceBatch(rows)

    def reset(self, t: float, *, wear_depth: ArrayLike | None = None) -> None:
        """Reset all twins to the initial states of their scenes, at model time `t`.

        Parameters
        ----------
        t : float
            Model time in s.
        wear_depth : array_like, shape (8,) or (m, 8), optional
            Wear depth of each pad in m, at least 0. The default are the scenes' initial wear depths.

        Raises
        ------
        ArgumentError
            The time is not finite.
        """
        if not np.isfinite(t):
            raise ArgumentError(f"t: got {t!r}, expected a finite time in s")
        members = np.arange(len(self))
        self._states[:] = 0
        start_many(self._compiled, self._states, members.tolist())
        if wear_depth is not None:
            self._states["wear_depth"] = wear_depth
        settle_moved(self._params, self._states, members, self._states["y"].copy(), t, self._stick)
        self._reload()
        self._wrench = np.zeros((1, 3))

    def begin_displaced(self, snapshot: bytes, moved: ArrayLike, *, again: bool = False) -> None:
        """Set all twins to displaced states of a sampled twin, and copy its contacts, last sample and travel speed.

        Parameters
        ----------
        snapshot : bytes
            Snapshot of a `Twin` with `excitation="sampled"`. Its scene must have the same state type as the batch.
        moved : array_like, shape (m, 6)
            Displacement of x, y [m], theta [rad] and their rates for each twin.
        again : bool
            Whether an earlier call displaced the twins from the same sampled twin. If True, the damping factor of a
            continuing contact is unchanged in each twin. If False, it is copied from the sampled twin.

        Raises
        ------
        ArgumentError
            The size of the data is not that of a snapshot. The twins are unchanged.
        """
        state, sample, speed = read_snapshot(snapshot, self._states.dtype)
        away = np.broadcast_to(np.asarray(moved, dtype=np.float64), (len(self), 6))
        displaced = away.any(axis=1)
        damping = self._states["damping_factor"].copy()
        damping[displaced] = damping[0]
        if not again:
            damping[:] = state["damping_factor"]
        self._states[:], self._wrench = state, np.reshape(sample, (1, 3)).copy()
        self._reload()
        self.set_travel_speed(speed)
        row = self.advance(self.time)
        pose = np.concatenate([row.q[0, 0], row.v[0, 0]])
        self._states[:] = state
        self._states["damping_factor"] = damping
        self._reload()
        for index in np.flatnonzero(displaced):
            displaced_pose = pose + away[index]
            self._states["y"][index] = geometry.state_of(self.scenes[index], displaced_pose[:3], displaced_pose[3:])

    def move(self, which: ArrayLike, q: ArrayLike, v: ArrayLike) -> None:
        """Set the poses and rates of some twins at the current time. Their wear and counters are unchanged.

        Parameters
        ----------
        which : array_like of int, shape (k,)
            Indices of the twins.
        q : array_like, shape (k, 3)
            Poses x, y [m], theta [rad]. If a contact continues, the damping factor from its first touch remains valid.
        v : array_like, shape (k, 3)
            Rates of the poses in m/s, m/s and rad/s; rates of locked degrees of freedom are set to 0.
        """
        index = np.asarray(which, dtype=np.int64)
        poses, rates = np.asarray(q, dtype=np.float64), np.where(self.scenes[0].free, v, 0.0)
        places = geometry.states_of(self.scenes[0], np.concatenate([poses, rates], axis=1))
        settle_moved(self._params, self._states, index, places, self.time, self._stick)
        self._reload()

    def change(self, which: ArrayLike, scenes: Sequence[Scene]) -> NDArray[np.bool_]:
        """Replace the scenes of some twins. Positions, wear and travel speeds of the twins are unchanged.

        Parameters
        ----------
        which : array_like of int, shape (k,)
            Indices of the twins. Each of these twins must be moved by `move` before its next advance.
        scenes : sequence of Scene
            New scenes of these twins. A continuing contact keeps the damping factor that was set at its first touch.

        Returns
        -------
        ndarray of bool, shape (k,)
            False for a twin if its scene was not replaced, because the new scene has different terms.
        """
        changed = np.zeros(len(scenes), dtype=bool)
        if not scenes:
            return changed
        places, own = np.asarray(which), list(self.scenes)
        params, compiled = compile_scenes(scenes, self.tol, sampled=True, kind=options(own[0]))
        for index, (place, scene, compiled_scene) in enumerate(zip(places.tolist(), scenes, compiled, strict=True)):
            before = self._compiled[place]
            changed[index] = _signature(compiled_scene.parts, scene) == _signature(before.parts, before.scene)
            if not changed[index]:
                continue
            self._compiled[place], own[place] = compiled_scene, scene
            if scene.contact.damping is not None and compiled_scene.parts.terms.hysteretic is not None:
                self._states["damping_factor"][place] = scene.contact.damping
        params["wear_per_impulse"] = self._params["wear_per_impulse"][places]
        self._params[places[changed]] = params[changed]
        self.scenes = tuple(own)
        self._reload()
        return changed

    def set_travel_speed(self, speed_m_s: ArrayLike) -> None:
        """Set the speed along the face from the current time on. Only wear depends on this speed.

        Parameters
        ----------
        speed_m_s : array_like, shape (m,) or ()
            Speed in m/s, for each twin or for all twins. Wear depends on the magnitude.

        Raises
        ------
        ArgumentError
            A speed is not finite, or exceeds the limit of the damping (`check_travel_speed`). The batch is unchanged.
        """
        speeds = np.broadcast_to(np.abs(np.asarray(speed_m_s, dtype=np.float64)), len(self))
        for scene, speed in zip(self.scenes, speeds.tolist(), strict=True):
            check_travel_speed(scene, speed)
        for index, (scene, speed) in enumerate(zip(self.scenes, speeds, strict=True)):
            if scene.wear is not None:
                self._params["wear_per_impulse"][index] = wear_rate(scene.wear, speed)

    def snapshot(self) -> bytes:
        """Return the exact states as bytes. A batch with the same scenes and tolerance can restore them."""
        return self._states.tobytes() + self._samples_before().tobytes() + self._params["wear_per_impulse"].tobytes()

    def restore(self, data: bytes) -> None:
        """Restore the states saved by `snapshot`.

        Parameters
        ----------
        data : bytes
            Snapshot of a batch with the same scenes and tolerance.

        Raises
        ------
        ArgumentError
            The size of the data is not that of a snapshot.
        """
        wear = self._params["wear_per_impulse"]
        ends = np.cumsum([self._states.nbytes, 24 * len(self), wear.nbytes])
        if len(data) != ends[-1]:
            raise ArgumentError(f"snapshot: got {len(data)} bytes, expected {ends[-1]}")
        self._states[...] = np.frombuffer(data[: ends[0]], self._states.dtype)
        self._reload()
        self._wrench = np.frombuffer(data[ends[0] : ends[1]]).reshape(-1, 3).copy()
        wear[...] = np.frombuffer(data[ends[1] :]).reshape(wear.shape)

    def digest(self) -> str:
        """Return a hash of the exact states, as 16 hexadecimal digits."""
        return hashlib.blake2b(self.snapshot(), digest_size=8).hexdigest()

    def _run(self, times: NDArray[np.float64], samples: NDArray[np.float64]) -> NDArray[np.void]:
        """Advance all twins under samples, shape (m or 1, n, 3), and return their rows, shape (m, n)."""
        in_lanes = self._workers[0].lanes is not None
        shape = len(self), len(times)
        rows = _rows_to_fill(*shape) if in_lanes else np.zeros(shape, ROW)

        def run(index: int) -> None:
            worker, (first, last) = self._workers[index], self._edges[index : index + 2]
            if worker.lanes is None:
                ends = self._ends(samples, slice(None))
                worker.advance(self._params, self._states, first, last, times, ends, self._max_steps, rows)
                return

            def alone(member: int, i: int) -> None:
                member_slice, row = slice(member, member + 1), np.zeros((1, 1), ROW)
                line = self._ends(samples[:, : i + 1], member_slice)[:, i:]
                records = self._params[member_slice], self._states[member_slice]
                worker.advance(*records, 0, 1, times[i : i + 1], np.ascontiguousarray(line), self._max_steps, row)
                rows[member, i] = row.view(np.uint8)[0, : ADVANCE.itemsize].view(ADVANCE)[0]

            load = Load(self._wrench, samples, self._masses)
            worker.lanes.advance(self._states, times, load, rows, worker.pace, alone)

        if not len(times):
            return rows
        before, after, begun = self._states, self._before, list[Future[None]]()
        if any(worker.lanes is None or worker.lanes.stale for worker in self._workers):
            # numpy copies bytes faster than records
            after.view(np.uint8)[:] = before.view(np.uint8)
        try:
            self._states, self._before = after, before
            if self._pool is None:
                run(0)
            else:
                begun = [self._pool.submit(run, index) for index in range(len(self._workers))]
                for twins_begun in begun:
                    twins_begun.result()
        except (OutOfTimeError, KeyboardInterrupt) as stop:
            self._stop(begun)
            self._states, self._before = before, after
            progress = f"in advances from t = {self.time:.9g} s to {float(times[-1]):.9g} s of {len(self)} twins"
            raise_stopped(stop, self._max_wall_s, progress, None, self.time)
        return rows

    def _reload(self) -> None:
        """Make the lanes reload the changed states from their records at the next advance."""
        for worker in self._workers:
            if worker.lanes is not None:
                worker.lanes.reload()

    def _samples_before(self) -> NDArray[np.float64]:
        return np.broadcast_to(self._wrench, (len(self), 3))

    def _ends(self, samples: NDArray[np.float64], members: slice) -> NDArray[np.float64]:
        """Return the previous and the new samples of some twins, divided by mass and inertia, shape (k, n + 1, 3)."""
        before, masses = self._samples_before()[members, None], self._masses[members, None]
        own = samples[members] if len(samples) > 1 else np.broadcast_to(samples, (len(before), *samples.shape[1:]))
        # in one layout, for which a single kernel is compiled
        return np.ascontiguousarray(np.concatenate([before, own], axis=1) / masses)

    def _stop(self, begun: Sequence[Future[None]]) -> None:
        for worker in self._workers:
            worker.pace.stopped = True
        wait(begun)
        for worker in self._workers:
            worker.pace.stopped = False
            clear_sums(worker.totals)
            if worker.lanes is not None:
                worker.lanes.clear()


def _all_finite(numbers: NDArray[np.float64]) -> bool:
    if numbers.size <= _FEW:
        return all(map(math.isfinite, numbers.ravel().tolist()))
    return bool(np.isfinite(numbers).all())


def _rows_to_fill(twins: int, times: int) -> NDArray[np.void]:
    """Return uninitialised rows of `ADVANCE`, aligned with cache lines."""
    memory = np.empty(twins * times * ADVANCE.itemsize + _LINE, np.uint8)
    # numpy's own address, `memory.ctypes.data`, takes four times as long
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory.data))
    return np.ndarray((twins, times), ADVANCE, memory, -address % _LINE)


class _Worker(NamedTuple):
    """Data of one thread."""

    parts: Parts
    work: NDArray[np.void]
    totals: NDArray[np.void]
    pace: Pace
    lanes: LaneTwins | None

    @staticmethod
    def of(terms: Terms, compiled: Sequence[CompiledScene], max_wall_s: float) -> _Worker:
        stiff = any(compiled_scene.parts.implicit is not None for compiled_scene in compiled)
        parts = Parts(terms, None, np.zeros(1, SEGMENT), new_implicit(terms.support is not None) if stiff else None)
        work = new_records(WORK, 1)
        work[0] = new_work()
        return _Worker(parts, work, new_records(TOTALS, 1), Pace(state_type(terms), stiff, max_wall_s), None)

    def with_lanes(self, batch: TwinBatch, terms: Terms, members: range) -> _Worker:
        twins = LaneTwins(batch._params, terms, members, self.work, batch._max_steps)
        return self._replace(lanes=twins)

    def advance(
        self, params: NDArray[np.void], states: NDArray[np.void], first: int, last: int, times: _Array, ends: _Array,
        max_steps: int, rows: NDArray[np.void],
    ) -> None:  # fmt: skip
        """Advance the twins `first` to `last` - 1 through all samples, one twin after another without lanes."""
        self.pace.run(loop.advance_rows, (
            params, self.parts, states, self.pace.saved, self.work, self.totals, first, last, times, ends, max_steps,
            rows, _NO_MARKS, states[:0], None, self.pace.record,
        ))  # fmt: skip


def _kinds(compiled: Sequence[CompiledScene]) -> list[tuple[int, CompiledScene]]:
    """Return the index and the first scene of each combination of terms, implicit steps, kind of head and options."""
    kinds: dict[object, tuple[int, CompiledScene]] = {}
    for index, compiled_scene in enumerate(compiled):
        key = (
            compiled_scene.parts.terms,
            compiled_scene.parts.implicit is None,
            compiled_scene.scene.head.carries,
            options(compiled_scene.scene),
        )
        kinds.setdefault(key, (index, compiled_scene))
    return list(kinds.values())


def _merge(compiled: Sequence[CompiledScene]) -> Terms:
    """Return the merged terms of all members, or raise `ArgumentError` if terms that cannot be merged differ."""
    first = compiled[0]
    merged = first.parts.terms
    for index, member in _kinds(compiled):
        for (own, path, got, expected), (common, _, in_first, _) in zip(_shared(member), _shared(first), strict=True):
            if own != common:
                raise ArgumentError(f"scenes[{index}]{path}: got {got}, expected {expected}: scenes[0] has {in_first}")
        terms = member.parts.terms
        merged = merged._replace(**{name: 1 for name in _OPTIONAL if getattr(terms, name) is not None})
    if merged.wear is not None or merged.slip is not None:
        merged = merged._replace(rest=None)
    return merged


def _shared(member: CompiledScene) -> tuple[tuple[object, str, object, str], ...]:
    """Return the properties that all members must share.

    Each property has a value to compare, its path in the scene, its value for a message, and the expected value.
    """
    terms, scene = member.parts.terms, member.scene
    law = f"law {scene.contact.law} with exponent {scene.contact.exponent:g}"
    carries, kind = scene.head.carries, options(scene)
    return (
        ((terms.viscous, terms.integer, terms.fraction, terms.ramp), ".contact", law, "the terms of scenes[0]"),
        (terms.stick, ".friction", scene.friction, "friction with stick in all or in none"),
        (carries, ".head.carries", carries, "the same in all"),
        (kind, "", kind, "a corner_radius_m and a restitution that falls in all or in none"),
        (terms.support, ".support", scene.support, "a support in all or in none"),
    )
