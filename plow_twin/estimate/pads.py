"""The clearance by groups of pads.

The two pads of a wall may be worn differently, which turns the wall. One linearised step beside a fit of the clearances
finds these turns, with all other unknowns eliminated; their intervals show whether the motion determines them. If walls
are turned so far that the fit does not hold, it is repeated with turned walls. A pose cannot divide a clearance between
the two sides of the head: the difference is the sensor's bias.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.fit import WALLS, Fit, Problem, fit, joint_step
from plow_twin.estimate.gaps import GROUPS
from plow_twin.estimate.result import Interval
from plow_twin.estimate.unknowns import GX, GY, SIZE

Array = NDArray[np.float64]

#: Definition: groups by clearance, and the share of each wall's turn in it: top and bottom, left and right.
_MADE_OF: Final = {
    "horizontal_top": (GX, np.array([0.5, 0.5, 0.0, 0.0])),
    "horizontal_bottom": (GX, np.array([-0.5, -0.5, 0.0, 0.0])),
    "vertical_left": (GY, np.array([0.0, 0.0, 0.5, 0.5])),
    "vertical_right": (GY, np.array([0.0, 0.0, -0.5, -0.5])),
}
#: Step: of the difference quotient by a turn in m.
TURN_STEP = 2e-4
#: Bound: rounds of fits with turned walls, iterations of each; change of a turn in m that ends them, half of that step.
_ROUNDS, _ITERATIONS, _NO_TURN = 4, 15, 0.5 * TURN_STEP
assert list(_MADE_OF) == list(GROUPS)


def by_group(problem: Problem, found: Fit, widened: float) -> dict[str, tuple[Interval, float]]:
    """Return the clearance of each group with its standard deviation in m.

    `widened` multiplies the deviations of the fit for scatter beyond the noise.
    """
    step, covariance = _joint_step(problem, found)
    out = {}
    for name, (axis, shares) in _MADE_OF.items():
        made = np.zeros(SIZE + len(WALLS))
        made[axis] = 1.0
        made[SIZE:] = shares
        mean = float(found.shared[axis] + shares @ problem.turns + made @ step)
        deviation = widened * float(np.sqrt(made @ covariance @ made))
        out[name] = Interval.normal(mean, deviation), deviation
    return out


def askew(problem: Problem, found: Fit) -> float:
    """Return chi^2 of the linearised step of the four turns: whether the motion shows walls that are worn askew."""
    step, covariance = _joint_step(problem, found)
    turn = step[SIZE:]
    return float(turn @ np.linalg.solve(covariance[SIZE:, SIZE:], turn))


def turned(problem: Problem, found: Fit) -> tuple[Problem, Fit] | None:
    """Fit again with walls that are turned, from a fit without; None where the model cannot be run there."""
    forward = problem.forward.renewed()
    for _ in range(_ROUNDS):
        step, _ = _joint_step(problem, found)
        turn = np.clip(step[SIZE:], -tuning.TURN[1], tuning.TURN[1])
        problem = Problem(
            forward, problem.unknowns, problem.window, horizon=problem.horizon, turns=problem.turns + turn,
            drift=problem.drift,
        )  # fmt: skip
        again = fit(problem, found.shared, found.point.states, found.noise, _ITERATIONS)
        if again is None:
            return None
        found = again
        if np.abs(turn).max() < _NO_TURN:
            break
    return problem, found


def of_turns(problem: Problem, found: Fit) -> Array:
    """Return the covariance of the shared unknowns due to walls that may be turned, shape (SIZE, SIZE).

    If only one of two facing pads is touched, the distance of the others is unknown.
    """
    _, covariance = _joint_step(problem, found)
    held = np.linalg.inv(covariance)[:SIZE, :SIZE]
    added: Array = covariance[:SIZE, :SIZE] - np.linalg.inv(held)
    return added


def _joint_step(problem: Problem, found: Fit) -> tuple[Array, Array]:
    """Return the linearised step of the shared unknowns and the turns together, shape (15,), and its covariance."""
    precision = np.full(len(WALLS), 1.0 / tuning.TURN[0] ** 2)
    return joint_step(problem, found, _columns(problem, found), precision, -problem.turns * precision)


def _columns(problem: Problem, found: Fit) -> Array:
    """Return the derivatives of the prediction by the walls' turns, shape (n, 3, 4)."""
    point = found.point
    out = np.zeros((*point.residual.shape, len(WALLS)))
    for index in range(len(WALLS)):
        turns = problem.turns.copy()
        turns[index] += TURN_STEP
        other = problem.evaluate(point.shared, point.states, turns)
        if other is not None:
            out[:, :, index] = np.nan_to_num((point.residual - other.residual) / TURN_STEP)
    return out
