"""The clearance by groups of pads, as far as the motion tells it.

The two pads of a wall need not be worn alike. What turns the wall is one more unknown for each wall; beside a fit of
the clearances it is found by one linearised step, all others eliminated with it, and its interval says whether the
motion tells it. Where walls are turned so far that the fit does not hold, it is repeated with turned walls. How the
clearance lies to the left and to the right of the head, or above and below, no pose tells: the sensor's bias stands for
it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.fit import WALLS, Fit, Problem, fit, joint_step
from plow_twin.estimate.gaps import GROUPS
from plow_twin.estimate.result import Interval
from plow_twin.estimate.unknowns import GX, GY, SIZE

Array = NDArray[np.float64]

#: Groups by clearance, and the share of each wall's turn in it: top and bottom, left and right.
_MADE_OF: Final = {
    "horizontal_top": (GX, np.array([0.5, 0.5, 0.0, 0.0])),
    "horizontal_bottom": (GX, np.array([-0.5, -0.5, 0.0, 0.0])),
    "vertical_left": (GY, np.array([0.0, 0.0, 0.5, 0.5])),
    "vertical_right": (GY, np.array([0.0, 0.0, -0.5, -0.5])),
}
#: Prior deviation of a turn, and the step of its difference quotient, in m.
_TURN, _STEP = 4e-3, 2e-4
#: Rounds of fits with turned walls, iterations of each; longest turn of a round, and one that ends them, in m.
_ROUNDS, _ITERATIONS, _LONGEST_TURN, _NO_TURN = 4, 15, 2e-3, 1e-4
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
        turn = np.clip(step[SIZE:], -_LONGEST_TURN, _LONGEST_TURN)
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
    """Return what walls that may be turned add to the covariance of the shared unknowns, shape (11, 11).

    Where only one of the pads that face each other is touched, how far the others are apart is not known.
    """
    _, covariance = _joint_step(problem, found)
    held = np.linalg.inv(covariance)[:SIZE, :SIZE]
    added: Array = covariance[:SIZE, :SIZE] - np.linalg.inv(held)
    return added


def _joint_step(problem: Problem, found: Fit) -> tuple[Array, Array]:
    """Return the linearised step of the shared unknowns and the turns together, shape (15,), and its covariance."""
    precision = np.full(len(WALLS), 1.0 / _TURN**2)
    return joint_step(problem, found, _columns(problem, found), precision, -problem.turns * precision)


def _columns(problem: Problem, found: Fit) -> Array:
    """Return the derivatives of the prediction by the walls' turns, shape (n, 3, 4)."""
    point = found.point
    out = np.zeros((*point.residual.shape, len(WALLS)))
    for index in range(len(WALLS)):
        turns = problem.turns.copy()
        turns[index] += _STEP
        other = problem.evaluate(point.shared, point.states, turns)
        if other is not None:
            out[:, :, index] = np.nan_to_num((point.residual - other.residual) / _STEP)
    return out
