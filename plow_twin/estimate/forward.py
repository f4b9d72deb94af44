"""The forward model of the estimate: simulations of a scene with varied parameters under the measured load."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import EstimateError, Load
from plow_twin.model.geometry import body_states
from plow_twin.model.loads import Pieces
from plow_twin.model.scene import Scene
from plow_twin.run.batch import TwinBatch
from plow_twin.solve.compiled_scene import compile_scene, inertias
from plow_twin.solve.lanes.record import WIDTH, fits_lanes
from plow_twin.solve.method.implicit import new_implicit
from plow_twin.solve.restarts import run_restarts
from plow_twin.solve.state import EVENT, SEGMENT, TOTALS, Parts, Status, new_records, new_work, state_type

Array = NDArray[np.float64]

#: Upper bounds on one simulation: `_STEPS` plus `_STEPS_PER_SECOND` for each second, and rows of the event log.
_STEPS_PER_SECOND, _STEPS = 20_000, 2_000
_LOG_SIZE = 4096
#: Upper bound on the number of samples in one call for a vector of motions, whose rows take 21 MB.
_SAMPLES = 4096
#: Cost of an implicit step in series steps.
_IMPLICIT_WORK = 10


@dataclass(frozen=True, eq=False)
class Motions:
    """Poses and rates of all rows of s simulations, shape (n, 3) each, and contact times in s, shape (s, 8)."""

    q: Array
    v: Array
    contact: Array


@dataclass(frozen=True, eq=False)
class Start:
    """A scene, the gains of its load, shape (3,), and its state at the start (x, y, theta and their rates)."""

    scene: Scene
    gain: Array
    state: Array


class Forward:
    """Forward model of one scene; simulations with varied parameters use the same compiled kernel.

    Parameters
    ----------
    scene : Scene
        The nominal scene, whose loads and wear are not used.
    load : Load
        The measured load.

    Raises
    ------
    EstimateError
        If the scene has a `support`, or if its `head.carries` is not `walls`.
    """

    def __init__(self, scene: Scene, load: Load) -> None:
        if scene.head.carries != "walls":
            raise EstimateError(
                f"scene: got head.carries {scene.head.carries}, expected walls, because the fit cannot use a block"
            )
        if scene.support is not None:
            raise EstimateError("scene: got a support, expected a fixed frame, which the fit assumes")
        nominal = compile_scene(replace(scene, loads=(), wear=None), tuning.TOLERANCE, sampled=True)
        self._terms = nominal.parts.terms
        self._implicit = nominal.parts.implicit
        if self._implicit is None and scene.contact.restitution is not None:
            self._implicit = new_implicit(False)
        self._scene = scene
        self._set_load(load)
        self._work, self._log = new_work(), np.zeros(_LOG_SIZE, EVENT)
        self._params: tuple[Scene, tuple[bytes | None, ...], Any] | None = None
        #: work of all simulations so far, in steps of the series
        self.work = 0

    def _set_load(self, load: Load) -> None:
        pieces = Pieces.through(load.t, load.wrench)
        self._start, self._slope, self._knots, self.load = pieces.start, pieces.slope, pieces.knots, load

    def renewed(self) -> Forward:
        """Return a copy with the work counter at zero."""
        return Forward(self._scene, self.load)

    def of(self, scene: Scene) -> Forward:
        """Return a model of the nominal scene `scene` under this load, with the work counter at zero."""
        return Forward(scene, self.load)

    def under(self, load: Load) -> Forward:
        """Return a model of this nominal scene under the load `load`, with the work counter at zero."""
        other = copy(self)
        other._set_load(load)
        other.work = 0
        return other

    def run(
        self, scene: Scene, gain: Array, starts: Array, states: Array, edges: NDArray[np.int64], times: Array,
        depth: Array | None = None, push: Array | None = None, stiffness: Array | None = None,
        damping: Array | None = None,
    ) -> Motions | None:  # fmt: skip
        """Return the motions of `scene` from several states, under the load times `gain`, shape (3,).

        Parameters
        ----------
        starts, states : ndarray, shape (s,), (s, 6)
            Times in s at which the simulations begin, and the states (x, y, theta and their rates) at these times.
        edges : ndarray of int64, shape (s + 1,)
            Simulation m fills the rows edges[m]:edges[m + 1].
        times : ndarray, shape (n,)
            Times of the rows in s, which rise within each simulation and are not before its start.
        depth : ndarray, shape (8,), optional
            Outward displacement of each pad in m, in addition to the clearances.
        push : ndarray, shape (3,), optional
            A constant load that is added to the measured load, in N, N, N m.
        stiffness : ndarray, shape (8,), optional
            Stiffness of each pair relative to the contact's stiffness.
        damping : ndarray, shape (8,), optional
            Damping of each pair relative to the contact's damping, for a law with a constant lambda.

        Returns
        -------
        Motions or None
            None if the head leaves the range of the model.
        """
        params, segments = self._compiled(scene, gain, depth, push, stiffness)
        records = new_records(state_type(self._terms), len(starts))
        records["y"] = body_states(_with_locks(scene, states), scene.head.com_offset_m)
        if self._terms.hysteretic is not None:
            records["damping_factor"] = (scene.contact.damping or 0.0) * (1.0 if damping is None else damping)
        records["step_start"] = starts
        records["time"] = starts
        totals = new_records(TOTALS, len(starts))
        q, v = np.zeros((len(times), 3)), np.zeros((len(times), 3))
        spans = np.where(edges[1:] > edges[:-1], times[np.maximum(edges[1:], 1) - 1] - starts, 0.0)
        budgets = (_STEPS_PER_SECOND * spans).astype(np.int64) + _STEPS
        parts = Parts(self._terms, None, segments, self._implicit)
        code = run_restarts(params, parts, records, self._work, totals, self._log, edges, budgets, times, q, v)
        self.work += int(records["steps"].sum()) + _IMPLICIT_WORK * int(records["implicit_steps"].sum())
        if code != Status.OK or not np.isfinite(q).all():
            return None
        return Motions(q, v, np.array(totals["time_in_contact"]))

    def run_many(self, starts: Sequence[Start], start: float, times: Array) -> list[Array | None]:
        """Return the poses of many scenes at the times `times`, shape (n, 3) each; None as in `run`.

        Scenes that fit share SIMD vectors. The results agree with those of `run` within the tolerance.

        Parameters
        ----------
        starts : sequence of Start
            Scenes with the terms of the nominal scene.
        start : float
            Time in s at which all motions begin.
        times : ndarray, shape (n,)
            Times in s, which rise and are not before `start`.
        """
        motions: list[Array | None] = [None] * len(starts)
        edges, begin, fitting = np.array([0, len(times)]), np.array([start]), []
        for place, motion_start in enumerate(starts):
            if fits_lanes(compile_scene(motion_start.scene, tuning.TOLERANCE, sampled=True), sampled=True):
                fitting.append(place)
                continue
            run = self.run(motion_start.scene, motion_start.gain, begin, motion_start.state[None], edges, times)
            motions[place] = None if run is None else run.q
        # motions that share a SIMD vector end with the slowest of them, and harder contacts take more steps
        fitting.sort(key=lambda place: starts[place].scene.contact.stiffness)
        for first in range(0, len(fitting), WIDTH):
            places = fitting[first : first + WIDTH]
            for place, q in zip(places, self._in_lanes([starts[i] for i in places], start, times), strict=True):
                motions[place] = q
        return motions

    def _in_lanes(self, starts: Sequence[Start], start: float, times: Array) -> list[Array | None]:
        knots = self._knots
        t = np.union1d(knots[(knots > start) & (knots < times[-1])], times)
        at_times, out = np.isin(t, times), []
        states, gains = np.array([one.state for one in starts]), np.array([one.gain for one in starts])[:, None]
        batch = TwinBatch([one.scene for one in starts], tol=tuning.TOLERANCE, start=start, max_steps=_STEPS)
        states = _with_locks(starts[0].scene, states)
        batch.move(range(len(starts)), states[:, :3], states[:, 3:])
        batch.set_wrench((self.load.at(np.array([start])) * gains)[:, 0])
        good = np.ones(len(starts), np.bool_)
        for part in range(0, len(t), _SAMPLES):
            inside = slice(part, part + _SAMPLES)
            rows = batch.advance_samples(t[inside], self.load.at(t[inside]) * gains)
            self.work += int(rows.steps.sum())
            good &= (rows.status == Status.OK).all(axis=1)
            out.append(rows.q[:, at_times[inside]])
        q = np.concatenate(out, axis=1)
        good &= np.isfinite(q).all(axis=(1, 2))
        return [q[i] if good[i] else None for i in range(len(starts))]

    def _compiled(
        self, scene: Scene, gain: Array, depth: Array | None, push: Array | None, stiffness: Array | None
    ) -> tuple[Any, Any]:
        walls = tuple(None if part is None else part.tobytes() for part in (depth, stiffness))
        if self._params is None or self._params[:2] != (scene, walls):
            params = compile_scene(scene, tuning.TOLERANCE, sampled=True).params
            if depth is not None:
                params["penetration_rows"][4] -= depth
            if stiffness is not None:
                # under a linear law, equivalent to a factor on the stiffness
                params["penetration_rows"][:] *= stiffness
            self._params = scene, walls, params
        inertia = inertias(scene)
        segments = np.zeros(len(self._knots), SEGMENT)
        segments["knot"] = self._knots
        segments["start"] = self._start / inertia * gain
        segments["slope"] = self._slope / inertia * gain
        if push is not None:
            segments["start"] += push / inertia
        return self._params[2], segments


def _with_locks(scene: Scene, states: Array) -> Array:
    """Return states, shape (s, 6), whose locked degrees of freedom rest where the scene begins."""
    free = np.tile(scene.free, 2)
    return states if free.all() else np.where(free, states, [*scene.initial.q, 0.0, 0.0, 0.0])
