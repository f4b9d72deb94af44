"""Growth of errors along a motion, and the time up to which the tolerance is met.

The columns of the fundamental matrix are solutions of the linearised equations (`solve.tangents`). For terms that
`solve.tangents` does not support, they are finite differences between the motion and its shadows. A shadow is a second
motion that starts with a small displacement and lasts for a short stretch of time. It has its own events, so the
columns include the jumps at touches and separations (saltation).
"""

from __future__ import annotations

import math
import time as _time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError, SceneError, SolverError
from plow_twin.model import geometry
from plow_twin.model.scene import Load, Scene, Table
from plow_twin.run.motion import BUDGET, Motion, next_slice, run_events
from plow_twin.run.tangent_columns import displaced_columns, fits_tangents, is_curved
from plow_twin.solve.compiled_scene import TOLERANCE_RANGE, CompiledScene, compile_scene
from plow_twin.solve.growth import MOST_KEPT, follow_growth
from plow_twin.solve.state import State, Status, Work, first_of, new_record, new_records, new_work
from plow_twin.solve.tangents import ALONG, STATE_COLUMNS, follow_columns

Array = NDArray[np.float64]

#: `DISPLACEMENT`: displacement of a shadow relative to the clearance. `_LEAST_DISPLACEMENT`: smallest displacement of a
#: shadow near a wall. `SHADOW_TOLERANCE`: tolerance of the motion of a shadow.
DISPLACEMENT: Final = 1e-7
_LEAST_DISPLACEMENT: Final = 1e-10
SHADOW_TOLERANCE: Final = 1e-12
_STRETCHES: Final = 200
#: Change of a parameter relative to its value, unless the parameter is a length.
_RELATIVE_CHANGE: Final = 1e-6
#: `_CLEAR_OF_WALLS`: smallest distance from each wall at the beginning of a stretch, divided by the displacement of the
#: shadows. If the displacement would become too small, the previous stretch continues, at most `_MOST_MERGED` times or
#: `LONGEST_S` [s]. A contact of a short motion lasts many stretches, and has the damping of its first touch.
_CLEAR_OF_WALLS: Final = 100.0
_MOST_MERGED: Final = 20
LONGEST_S: Final = 0.5
#: Largest number of solver steps of a shadow in one stretch.
_SHADOW_BUDGET: Final = 10**7
#: `_EQUATIONS_TOLERANCE`: tolerance of the motion along which the equations are linearised. If the resulting error of
#: the derivatives, some 1e-6 times the growth of errors, exceeds `_LARGEST_ERROR`, the tolerance of the run is used.
_EQUATIONS_TOLERANCE, _LARGEST_ERROR = 1e-6, 1e-2
#: `_FIRST_SLICE`: steps before the first check of the time limit. `_MOST_WITHOUT_IMPLICIT`: largest number of explicit
#: steps in a scene that may need implicit steps.
_FIRST_SLICE, _MOST_WITHOUT_IMPLICIT = 2048, 200_000
#: Largest growth for which the error of a motion stays within ten tolerances (`docs/solver.md`).
TRUSTED_GROWTH: Final = 1e4


@dataclass(frozen=True)
class Sensitivity:
    """Growth of errors along a motion.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times in s.
    growth : ndarray, shape (n,)
        Largest factor by which an error at any earlier time has grown until `t`. Errors of poses are relative to the
        clearance. Errors of velocities are converted to lengths by the time in which the largest load moves the head
        across the clearance.
    from_start : ndarray, shape (n, k, k)
        Derivatives of the state at `t` with respect to the initial state. A state contains the coordinates of the k / 2
        free degrees of freedom, followed by their rates.
    exponent : float
        Largest Lyapunov exponent in 1/s in the second half of the motion. If it is positive, errors grow without bound.
    tol : float
        Tolerance of the motion, relative to the clearance.
    by_parameter : mapping of str to ndarray, shape (n, k)
        Derivatives of the state at `t` with respect to the chosen parameters. The keys are the paths of the parameters.
    """

    t: Array
    growth: Array
    from_start: Array
    exponent: float
    tol: float
    by_parameter: Mapping[str, Array] = field(default_factory=dict)

    @property
    def trusted(self) -> bool:
        """Whether the tolerance is met over the whole motion: `growth` is at most `TRUSTED_GROWTH`."""
        return bool(self.growth.max() <= TRUSTED_GROWTH)

    def good_until(self, accuracy: float) -> float:
        """Return the time in s until which the error of the pose stays below a limit.

        Parameters
        ----------
        accuracy : float
            Limit of the error of the pose, relative to the clearance.
        """
        bad = np.flatnonzero(self.tol * self.growth > accuracy)
        return float(self.t[-1] if len(bad) == 0 else self.t[max(0, bad[0] - 1)])

    def __str__(self) -> str:
        good = self.good_until(1e-2)
        until = "all the way" if good >= self.t[-1] else f"until t = {good:.4g} s"
        return (
            f"an error grows {self.growth.max():.2g} times, largest Lyapunov exponent {self.exponent:.3g} 1/s: "
            f"at tol {self.tol:g} the pose is good to 1 % of the clearance {until}"
        )


def sensitivity_parameters(scene: Scene) -> dict[str, float]:
    """Return the parameters with respect to which a motion can be differentiated.

    The parameters are the stiffness, the damping or restitution, the two clearances, and a scale factor for each load.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    dict of str to float
        Values of the parameters in the scene. The keys are paths such as `contact.stiffness`.
    """
    contact, clearance = scene.contact, scene.clearance
    values = {"contact.stiffness": contact.stiffness, "contact.damping": contact.damping or 0.0}
    values |= {"contact.restitution": contact.restitution or 0.0}
    values = {path: value for path, value in values.items() if value > 0.0}
    values |= {f"clearance.{name}": getattr(clearance, name) for name in ("horizontal_m", "vertical_m")}
    return values | {f"loads.{load.name}.scale": 1.0 for load in scene.loads}


def _changed(scene: Scene, path: str, value: float) -> Scene:
    part, _, name = path.rpartition(".")
    if part in ("contact", "clearance"):
        return replace(scene, **{part: replace(getattr(scene, part), **{name: value})})
    return replace(
        scene, loads=tuple(_scaled(load, value) if f"loads.{load.name}" == part else load for load in scene.loads)
    )


def _scaled(load: Load, factor: float) -> Load:
    if isinstance(load, Table):
        return replace(load, wrench=factor * np.asarray(load.wrench))
    x, y = load.force_n
    return replace(load, force_n=(factor * x, factor * y), moment_n_m=factor * load.moment_n_m)


@dataclass(frozen=True)
class ChangedScene:
    """A scene in which one parameter differs by a small change."""

    path: str
    compiled: CompiledScene
    change: float

    @staticmethod
    def of(scene: Scene, path: str, tol: float) -> ChangedScene:
        """Return a copy of the scene with a small change of the parameter at `path`."""
        value = sensitivity_parameters(scene)[path]
        length = path.startswith("clearance")
        change = DISPLACEMENT * geometry.length_scale(scene) if length else _RELATIVE_CHANGE * value
        try:
            changed = _changed(scene, path, value + change)
        except SceneError:
            # the value is the largest admissible value
            change = -change
            changed = _changed(scene, path, value + change)
        return ChangedScene(path, compile_scene(changed, tol), change)


def refuse_support(scene: Scene) -> None:
    """Raise `ArgumentError` for a scene with a `Support`, because shadows cannot displace the frame."""
    if scene.support is not None:
        raise ArgumentError(f"sensitivity: got a scene with {scene.support}, expected a scene without support")


class StretchProduct:
    """Product of the fundamental matrices of successive stretches of time.

    Parameters
    ----------
    size : int
        Number of free coordinates and their rates.
    parameters : int
        Number of parameters.

    Attributes
    ----------
    total : ndarray, shape (k, k)
        Derivatives of the current state with respect to the initial state.
    rows : ndarray, shape (p, k)
        Derivatives of the current state with respect to the parameters.
    growth : float
        Largest factor by which an error at any stored earlier time has grown until now, at least 1.
    """

    def __init__(self, size: int, parameters: int) -> None:
        self.total, self.rows, self.growth = np.eye(size), np.zeros((parameters, size)), 1.0
        self._since, self._kept = np.zeros((2, size, MOST_KEPT, size)), np.zeros(1, np.int64)
        self._basis, self._scratch = np.eye(size), np.zeros((5 + MOST_KEPT, size, size))

    def follow(self, matrices: Array, changes: Array, ends: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
        """Multiply the product by the matrices of successive stretches, and update the attributes.

        At a time within a stretch, `growth` includes only errors of coordinates. In the middle of an impact, a stiff
        contact turns any displacement into a large, temporary difference of velocities.

        Parameters
        ----------
        matrices : ndarray, shape (n, k, k)
            Fundamental matrices, each from the beginning of a stretch to one of n times.
        changes : ndarray, shape (n, p, k)
            Effects of the parameters over the same n intervals of time.
        ends : ndarray of bool, shape (n,)
            Whether a stretch ends at each of the n times.

        Returns
        -------
        totals, rows, growth : ndarray, shapes (n, k, k), (n, p, k) and (n,)
            The attributes `total`, `rows` and `growth` at each of the n times.
        logs : ndarray, shape (n, k)
            Logarithms of the factors by which a stretch has extended the vectors of a basis, in the row of the end of
            the stretch. All other rows are 0.
        """
        count, size = matrices.shape[:2]
        totals, rows = np.zeros((count, size, size)), np.zeros((count, len(self.rows), size))
        growth, logs = np.ones(count), np.zeros((count, size))
        follow_growth(
            np.ascontiguousarray(matrices), np.ascontiguousarray(changes), ends.astype(np.int64), self._since,
            self._kept, (self.total, self.rows), self._basis, self._scratch, totals, rows, growth, logs,
        )  # fmt: skip
        self.growth = float(growth[-1])
        return totals, rows, growth, logs


def sensitivity_of(scene: Scene, t_end: float, tol: float, parameters: Sequence[str] = ()) -> Sensitivity:
    """Return the growth of errors and the derivatives of a scene's motion up to `t_end`.

    Parameters
    ----------
    scene : Scene
    t_end : float
        End of the motion in s, above 0.
    tol : float
        Tolerance of the simulated motion. The tolerance of the derivatives may be different.
    parameters : sequence of str
        Paths of the parameters with respect to which derivatives are computed, from `sensitivity_parameters`.

    Raises
    ------
    ArgumentError
        The scene does not have one of the parameters, or the scene has a `Support`.
    SolverError
        The solver cannot continue a motion.
    """
    refuse_support(scene)
    available = sensitivity_parameters(scene)
    for path in parameters:
        if path not in available:
            raise ArgumentError(f"sensitivity: got {path!r}, expected one of {', '.join(available)}")
    free = free_places(scene)
    scale, size = scale_of(compile_scene(scene, tol))[free], len(free)

    def follow(stretches: _Stretches) -> tuple[Array, Array, Array, Array]:
        return StretchProduct(size, len(parameters)).follow(*stretches)

    stretches = _by_equations(scene, t_end, _EQUATIONS_TOLERANCE, parameters)
    if stretches is None:
        stretches = _by_shadows(scene, t_end, tol, parameters)
    totals, rows, growth, logs = follow(stretches)
    if tol < _EQUATIONS_TOLERANCE and _EQUATIONS_TOLERANCE * growth.max() > _LARGEST_ERROR:
        # compute the derivatives again, at the tolerance of the run
        stretches = _by_equations(scene, t_end, tol, parameters) or stretches
        totals, rows, growth, logs = follow(stretches)
    times, ends = _ends(t_end), stretches.ends
    # only stretches that begin in the second half of the motion contribute to the exponent
    edges = np.concatenate([[0.0], times[ends]])
    first = int(np.searchsorted(edges, 0.5 * t_end))
    stretched = logs[ends][first:].sum(axis=0)
    exponent = float(stretched.max()) / (edges[-1] - edges[first]) if first < len(edges) - 1 else 0.0
    from_start = np.concatenate([np.eye(size)[None], totals]) * (scale[:, None] / scale[None, :])
    by_parameter = np.concatenate([np.zeros((1, len(parameters), size)), rows]) * scale
    derivatives = {path: by_parameter[:, index] for index, path in enumerate(parameters)}
    t = np.concatenate([[0.0], times])
    return Sensitivity(t, np.concatenate([[1.0], growth]), from_start, exponent, tol, derivatives)


class _Stretches(NamedTuple):
    """Derivatives, scaled by `scale_of`, at the times of `_ends` with respect to the start of the stretch."""

    matrices: Array  #: derivatives with respect to the state, shape (n, k, k)
    changes: Array  #: derivatives with respect to the parameters, shape (n, p, k)
    ends: NDArray[np.bool_]  #: whether a stretch ends and the next stretch begins, shape (n,)


def _by_equations(scene: Scene, t_end: float, tol: float, parameters: Sequence[str]) -> _Stretches | None:
    """Return the derivatives from the linearised equations, or None for unsupported terms or too many steps."""
    compiled = compile_scene(scene, tol)
    changed = [ChangedScene.of(scene, path, tol) for path in parameters]
    if not fits_tangents(compiled) or any(change.compiled.parts.terms != compiled.parts.terms for change in changed):
        return None
    scale, parts = scale_of(compiled), compiled.parts
    ends, count = _ends(t_end), STATE_COLUMNS + len(changed)
    columns, omegas, amplitudes = displaced_columns(
        compiled, [(displaced.compiled, displaced.change) for displaced in changed]
    )
    out, whole, reached = np.zeros((len(ends), STATE_COLUMNS, count)), np.zeros(len(ends), np.int64), np.zeros(1, int)
    state, work, along = compiled.initial_state(), new_work(), new_record(ALONG)
    room, size = _CLEAR_OF_WALLS * DISPLACEMENT * scale[0], _FIRST_SLICE
    most = BUDGET if parts.implicit is None else _MOST_WITHOUT_IMPLICIT
    code = int(Status.BUDGET)
    while code == Status.BUDGET:
        if int(state.steps) >= most:
            return None
        begin, allowed = _time.perf_counter(), min(most, int(state.steps) + size)
        code = follow_columns(
            compiled.params, parts, state, work, along, columns, omegas, amplitudes, is_curved(parts.terms), ends, room,
            _most_merged(t_end), reached, allowed, out, whole,
        )  # fmt: skip
        size = next_slice(size, _time.perf_counter() - begin)
    if code != Status.OK:
        raise SolverError(f"sensitivity at t = {float(state.step_start):.9g} s: {Status(code).text}")
    matrices = out[:, :, :STATE_COLUMNS] * (scale[None, :] / scale[:, None])
    changes = (out[:, :, STATE_COLUMNS:] / scale[:, None]).transpose(0, 2, 1)
    return _Stretches(matrices, changes, whole == 1)


def _by_shadows(scene: Scene, t_end: float, tol: float, parameters: Sequence[str]) -> _Stretches:
    # `SHADOW_TOLERANCE` is 1e-5 of the displacement; a tighter tolerance of the run takes precedence
    fine = min(max(SHADOW_TOLERANCE, TOLERANCE_RANGE[0]), tol)
    compiled = compile_scene(scene, fine)
    changed = [ChangedScene.of(scene, path, fine) for path in parameters]
    scale, free = scale_of(compiled), free_places(scene)
    work, merged, most_merged, size = new_work(), 0, _most_merged(t_end), len(free)
    moved, implicit = DISPLACEMENT, 0
    scenes = [compiled] * (1 + size) + [change.compiled for change in changed]
    first_states = [displaced.compiled.initial_state() for displaced in changed]
    states = _displaced(compiled, compiled.initial_state(), moved * scale, free, first_states, work)
    matrices, changes, ended = [], [], []
    for end in _ends(t_end).tolist():
        followed = [_follow(scene, state, end, work) for scene, state in zip(scenes, states, strict=True)]
        states = [motion.state for motion in followed]
        reached = np.array([_pose_and_rate(motion) for motion in followed])
        away = (reached[1:] - reached[0])[:, free] / scale[free]
        matrices.append(away[:size].T / moved)
        changes.append(away[size:] / np.array([displaced.change for displaced in changed])[:, None])
        assert followed[0].penetration is not None
        held = int(states[0].implicit_steps) > implicit
        depths = followed[0].penetration[0, compiled.params.enabled == 1]
        possible = possible_displacement(
            depths, scale[0], held=held, reads_speed=bool(compiled.params.damping_number >= 0.0)
        )
        ends = possible is not None or merged >= most_merged
        if ends:
            merged, moved, implicit = 0, possible or DISPLACEMENT, int(states[0].implicit_steps)
            states = _displaced(compiled, states[0], moved * scale, free, states[1 + size :], work)
        else:
            merged += 1
        ended.append(ends)
    return _Stretches(np.array(matrices), np.array(changes), np.array(ended))


def _ends(t_end: float) -> Array:
    """Return the times [s] at which stretches may end, unevenly spaced so that they do not follow the load's period."""
    ends = np.arange(1, _STRETCHES + 1, dtype=np.float64)
    ends[:-1] += 0.4 * (np.mod(ends[:-1] * 0.5 * (math.sqrt(5.0) - 1.0), 1.0) - 0.5)
    ends *= t_end / _STRETCHES
    ends[-1] = t_end
    return ends


def _most_merged(t_end: float) -> int:
    return max(_MOST_MERGED, math.ceil(LONGEST_S * _STRETCHES / t_end))


def scale_of(compiled: CompiledScene) -> Array:
    """Return the scales of coordinates and rates, shape (6,), in which the clearance is 1."""
    params, length = compiled.params, geometry.length_scale(compiled.scene)
    place = np.array([1.0, 1.0, 1.0 / float(params.radius)]) * length
    scale: Array = np.concatenate([place, place * float(params.velocity_tolerance / params.position_tolerance)])
    return scale


def possible_displacement(
    penetration: Array, length: float, *, held: bool = False, reads_speed: bool = False
) -> float | None:
    """Return the largest displacement of shadows, relative to the clearance, for the start of a stretch.

    A stretch does not begin during an elastic contact, which would turn a displacement into a large velocity.

    Parameters
    ----------
    penetration : ndarray, shape (n,)
        Penetrations in m at the beginning of the stretch, of the pairs that can touch.
    length : float
        Reference length of displacements in m.
    held : bool
        Whether overdamped contact holds the head. Displacements then decay slowly, so a small displacement suffices.
    reads_speed : bool
        Whether the damping of a contact depends on the speed at first touch.

    Returns
    -------
    float or None
        Displacement, or None if no stretch can begin, because a pair is too close to its wall (`_CLEAR_OF_WALLS`), or
        because a pair is in contact and `reads_speed` is True.
    """
    if reads_speed and bool((penetration > 0.0).any()):
        return None
    room = float(np.abs(penetration).min(initial=np.inf)) / (_CLEAR_OF_WALLS * length)
    return min(DISPLACEMENT, room) if room >= (_LEAST_DISPLACEMENT if held else DISPLACEMENT) else None


def free_places(scene: Scene) -> NDArray[np.int64]:
    """Return the indices of the free coordinates, followed by the indices of their rates."""
    return np.flatnonzero(scene.free * 2)


def _displaced(
    compiled: CompiledScene, state: State, moved: Array, free: NDArray[np.int64], before: Sequence[State], work: Work
) -> list[State]:
    """Return a state, a shadow for each free coordinate, a shadow for each rate, and a shadow for each changed scene.

    `moved` contains the displacements of the shadows for coordinates and rates. Shadows of changed scenes have the
    damping factors of their own touches, from the states `before`.
    """
    start = _pose_and_rate(_follow(compiled, state, float(state.time), work))
    states = [state]
    for index in free:
        displaced, shadow = start.copy(), _copy(state)
        displaced[index] += moved[index]
        shadow.y[:] = geometry.state_of(compiled.scene, displaced[:3], displaced[3:])
        states.append(shadow)
    for own in before:
        shadow = _copy(state)
        shadow.damping_factor[:] = own.damping_factor
        states.append(shadow)
    return states


def _copy(state: State) -> State:
    records = new_records(state.dtype, 1)
    records[0] = state
    return first_of(records)


def _follow(compiled: CompiledScene, state: State, end: float, work: Work) -> Motion:
    """Return the motion from a copy of a state to the time `end`, with one output row at `end`."""
    motion = Motion.start(compiled, np.zeros((1, 3)), np.zeros((1, 3)), outputs=True)
    motion.state = _copy(state)
    code, _ = run_events(compiled, motion, np.array([end]), end, work, int(motion.state.steps) + _SHADOW_BUDGET)
    if code != Status.OK:
        raise SolverError(f"shadow at t = {motion.time:.9g} s: {Status(code).text}")
    return motion


def _pose_and_rate(motion: Motion) -> Array:
    return np.concatenate([motion.q[0], motion.v[0]])
