"""Derivative of a fitted motion with respect to the compliance of the frame.

A frame on springs of the stiffness k yields to the contact forces. Let F(q, v) be the contact force on the head, which
depends on its pose q and rate v relative to the frame, and let c = 1 / k be the compliance. If the frame moves much
faster than the head, its displacement is -c F. The head moves relative to the frame by q + c F, so its force is, to
first order in c,

    F(q + c F, v + c F') = F(q, v) + c g,   g = dF/dq F + dF/dv F'.

The derivative of the motion with respect to c is therefore the derivative with respect to a load g(t), where g is
computed along the fitted motion. The pose is assumed to be measured from the ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.contact_forces import forces_at
from plow_twin.estimate.fit import TURNS, Point, Problem, depth_of
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.unknowns import BIAS, DELAY, GAIN
from plow_twin.model.geometry import arm_rows, body_states
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y
from plow_twin.model.scene import Scene

Array = NDArray[np.float64]

#: Interval in s between the values of the load g, derived as a twenty-fifth of the period of a soft contact (20 Hz).
_INTERVAL = 2e-3
#: Step of the difference quotients in m/N. A force of 100 kN then moves the frame by 0.1 um.
_STEP = 1e-12
#: Upper bound on the error of the load g due to linear interpolation, relative to its range.
_INTERPOLATED = 1e-3


def by_compliance(problem: Problem, point: Point) -> Array | None:
    """Return the derivative of the predicted measurements with respect to the compliance in m/N, shape (n, 3).

    The result is None if the motion cannot be simulated.
    """
    change = _change_of_load(problem, point)
    if change is None:
        return None
    load = problem.forward.load
    t = np.union1d(load.t, change.t)
    rigid, soft = (
        problem.evaluate(point.shared, point.states, load=Load(t, load.at(t) + step * change.at(t)))
        for step in (0.0, _STEP)
    )
    return None if rigid is None or soft is None else np.nan_to_num((soft.predicted - rigid.predicted) / _STEP)


def _change_of_load(problem: Problem, point: Point) -> Load | None:
    """Return the load g before the gains are applied, in N, N, N m for a compliance of 1 m/N."""
    starts, turns = problem.window.starts, problem.differences[TURNS]
    t = np.arange(starts[0], starts[-1], _INTERVAL)
    shared = point.shared.copy()
    shared[BIAS], shared[DELAY] = 0.0, 0.0
    motion = problem.at_times(t).evaluate(shared, point.states)
    if motion is None:
        return None
    scene, depth, inside = problem.unknowns.scene_of(shared), depth_of(turns), (motion.swing >= 0)[:, None]
    q, v = np.where(inside, motion.predicted, 0.0), motion.rate
    force = _wrench(scene, q, v, depth)
    rate = np.gradient(force, t, axis=0)
    yielding = _STEP * np.array([1.0, 1.0, 0.0])
    change = (_wrench(scene, q + yielding * force, v + yielding * rate, depth) - force) / _STEP
    return Load(t, np.where(inside, change, 0.0) / shared[GAIN]).thinned(_INTERPOLATED)


def _wrench(scene: Scene, q: Array, v: Array, depth: Array | None) -> Array:
    """Return the sum of the contact forces on the head and their moment, (n, 3), for poses and rates (n, 3)."""
    _, force = forces_at(scene, q, v, depth)
    x, y, _, _, _, c, s, _ = body_states(np.hstack((q, v)), scene.head.com_offset_m).T
    arms = np.stack([c, s, x, y], axis=1) @ arm_rows(scene)
    along = force @ np.stack([NORMAL_X, NORMAL_Y, np.zeros_like(NORMAL_X)], axis=1)
    moment = (force * arms).sum(axis=1)
    return np.stack([c * along[:, 0] - s * along[:, 1], s * along[:, 0] + c * along[:, 1], moment], axis=1)
