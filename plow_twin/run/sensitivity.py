"""How an error grows along a motion: what a tolerance is worth, and until when.

Displaced motions are followed beside the motion itself, over short stretches, from states close to it. Their
differences are the columns of the fundamental matrix; what a touch or a separation does to a displacement (the jump of
the variational equations, saltation) is in them, since each shadow has its own events.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import SolverError
from plow_twin.model import geometry
from plow_twin.model.scene import DOF_NAMES, Scene
from plow_twin.run.motion import Motion, run_events
from plow_twin.solve.compiled_scene import TOLERANCE_RANGE, CompiledScene, compile_scene
from plow_twin.solve.state import Status, Work, first_of, new_records, new_work, state_type

Array = NDArray[np.float64]

#: Displacement of a shadow in shares of the clearance, and the tolerance at which it is followed.
_DISPLACEMENT: Final = 1e-7
_TOLERANCE: Final = 1e-12
_STRETCHES: Final = 200
#: A stretch does not end where some pair is nearer to its wall than so many displacements, unless so many in a row do.
_CLEAR_OF_WALLS, _MOST_MERGED = 100.0, 20
#: Steps of one shadow over one stretch.
_BUDGET: Final = 10**7
#: Growth above which an error is no longer within ten tolerances (`docs/solver.md`).
TRUSTED_GROWTH: Final = 1e4


@dataclass(frozen=True)
class Sensitivity:
    """How errors grow along a motion.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times in s; the last one is a little before the end where a pair is just at its wall there.
    growth : ndarray, shape (n,)
        Largest factor by which an error made at any time before has grown at `t`. Errors count as poses relative to the
        clearance, velocities over the time in which the largest load crosses it.
    from_start : ndarray, shape (n, k, k)
        Derivatives of the state at `t` by the initial state, of the k / 2 free degrees of freedom: places, then rates.
    exponent : float
        Largest Lyapunov exponent in 1/s, of the second half of the motion: above 0 errors grow for ever.
    tol : float
        Tolerance that the motion was asked for.
    """

    t: Array
    growth: Array
    from_start: Array
    exponent: float
    tol: float

    @property
    def trusted(self) -> bool:
        """Whether the tolerance means what it says for the whole motion."""
        return bool(self.growth.max() <= TRUSTED_GROWTH)

    def good_until(self, accuracy: float) -> float:
        """Return the time in s up to which the pose is good to an accuracy.

        Parameters
        ----------
        accuracy : float
            Error of the pose relative to the clearance.
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


def sensitivity_of(scene: Scene, t_end: float, tol: float) -> Sensitivity:
    """Follow shadows of a scene's motion up to `t_end`.

    Parameters
    ----------
    scene : Scene
    t_end : float
        End in s, above 0.
    tol : float
        Tolerance that the motion itself is asked for.

    Raises
    ------
    SolverError
        When a shadow could not be followed.
    """
    # finer than the displacement by so much that the difference keeps five digits
    compiled = compile_scene(scene, min(max(_TOLERANCE, TOLERANCE_RANGE[0]), tol))
    scale, free = _scale(compiled), _free(scene)
    work, state, begin, merged = new_work(), compiled.initial_state(), 0.0, 0
    size = len(free)
    total, since, basis = np.eye(size), np.zeros((0, size, size)), np.eye(size)
    times, growth, from_start, logs = [0.0], [1.0], [np.eye(size)], np.zeros(size)
    for end in _ends(t_end):
        after, reached, nearest = _follow(compiled, state, end, None, work)
        if nearest < _CLEAR_OF_WALLS * _DISPLACEMENT * scale[0] and merged < _MOST_MERGED:
            merged += 1
            continue
        merged = 0
        matrix = _derivatives(compiled, state, end, reached, free, scale, work)
        total = matrix @ total
        since = matrix @ np.concatenate([since, np.eye(size)[None]])
        basis, upper = np.linalg.qr(matrix @ basis)
        if times[-1] >= 0.5 * t_end:
            begin = begin if begin > 0.0 else times[-1]
            logs += np.log(np.maximum(np.abs(np.diag(upper)), 1e-300))
        times.append(end)
        growth.append(max(1.0, float(np.linalg.norm(since, 2, axis=(1, 2)).max())))
        from_start.append(total * scale[free][:, None] / scale[free][None, :])
        state = after
    exponent = float(logs.max()) / max(times[-1] - begin, 1e-300)
    return Sensitivity(np.array(times), np.array(growth), np.array(from_start), exponent, tol)


def _ends(t_end: float) -> list[float]:
    """Return where stretches end: not evenly, so that they keep no pace with what is periodic."""
    ends = np.arange(1, _STRETCHES + 1, dtype=np.float64)
    ends[:-1] += 0.4 * (np.mod(ends[:-1] * 0.5 * (math.sqrt(5.0) - 1.0), 1.0) - 0.5)
    return [*(ends[:-1] / _STRETCHES * t_end).tolist(), t_end]


def _scale(compiled: CompiledScene) -> Array:
    """Return what makes places and rates shares of the clearance, shape (6,)."""
    params, length = compiled.params, geometry.length_scale(compiled.scene)
    place = np.array([1.0, 1.0, 1.0 / float(params.radius)]) * length
    scale: Array = np.concatenate([place, place * float(params.velocity_tolerance / params.position_tolerance)])
    return scale


def _free(scene: Scene) -> NDArray[np.int64]:
    """Return the indices of what can differ: places and rates of the degrees of freedom that are not locked."""
    places = [index for index, name in enumerate(DOF_NAMES) if name not in scene.locked]
    return np.array(places + [3 + index for index in places], dtype=np.int64)


def _derivatives(
    compiled: CompiledScene,
    state: Any,
    end: float,
    reached: Array,
    free: NDArray[np.int64],
    scale: Array,
    work: Work,
) -> Array:
    """Return the derivatives of the scaled state at `end`, where it is `reached`, by the one at the start."""
    start = _follow(compiled, state, float(state.time), None, work)[1]
    columns = []
    for index in free:
        displaced = start.copy()
        displaced[index] += _DISPLACEMENT * scale[index]
        shadow = _follow(compiled, state, end, displaced, work)[1]
        columns.append((shadow - reached)[free] / scale[free] / _DISPLACEMENT)
    return np.array(columns).T


def _follow(
    compiled: CompiledScene, state: Any, end: float, displaced: Array | None, work: Work
) -> tuple[Any, Array, float]:
    """Bring a copy of a state, displaced in pose and rate, to `end`.

    Return it with its pose and rate, shape (6,), and how near the nearest pair is to its wall in m, inside or outside.
    """
    records = new_records(state_type(compiled.parts.terms), 1)
    records[0] = state
    motion = Motion.start(compiled, np.zeros((1, 3)), np.zeros((1, 3)), outputs=True)
    motion.state = first_of(records)
    if displaced is not None:
        motion.state.y[:] = geometry.body_state(displaced[:3], displaced[3:], compiled.scene.head.com_offset_m)
    code, _ = run_events(compiled, motion, np.array([end]), end, work, int(motion.state.steps) + _BUDGET)
    if code != Status.OK:
        raise SolverError(f"shadow at t = {motion.time:.9g} s: {Status(code).text}")
    assert motion.penetration is not None
    nearest = float(np.abs(motion.penetration[0, compiled.params.enabled == 1]).min(initial=np.inf))
    return motion.state, np.concatenate([motion.q[0], motion.v[0]]), nearest
