"""Estimate of the differences from the model, and of the clearances between facing pads.

The two pads of a wall may be worn differently, which rotates the wall. The sensor may have a lever arm and a low pass.
These *differences* from the model are estimated in one linearised step from a fit, or as unknowns of the fit if the fit
fails a check without them. Poses do not determine the division of a clearance between the two sides of the head,
because a bias of the sensor has the same effect.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.fit import DIFFERENCES, LAG, TURNS, WALLS, Fit, Problem, fit, joint_step
from plow_twin.estimate.gaps import GROUPS
from plow_twin.estimate.priors import UNSTATED
from plow_twin.estimate.result import Interval
from plow_twin.estimate.unknowns import GX, GY, SIZE

Array = NDArray[np.float64]

#: Definition of the clearance of each group of facing pads: the clearance of an axis, plus the rotations of the left,
#: right, top and bottom wall times these factors.
_MADE_OF: Final = {
    "horizontal_top": (GX, np.array([0.5, 0.5, 0.0, 0.0])),
    "horizontal_bottom": (GX, np.array([-0.5, -0.5, 0.0, 0.0])),
    "vertical_left": (GY, np.array([0.0, 0.0, 0.5, 0.5])),
    "vertical_right": (GY, np.array([0.0, 0.0, -0.5, -0.5])),
}
#: Upper bounds on the number of fits with differences, and on the number of iterations in each fit.
_ROUNDS, _ITERATIONS = 6, 15
assert list(_MADE_OF) == list(GROUPS)


def deviations() -> Array:
    """Return the prior standard deviations of the differences, shape (7,)."""
    out = np.array([UNSTATED[name] for name in DIFFERENCES])
    out[TURNS] = tuning.TURN
    return out


def by_group(problem: Problem, fitted: Fit, widened: float) -> dict[str, tuple[Interval, float]]:
    """Return the clearance of each group of facing pads, and its standard deviation in m.

    `widened` is a factor on the standard deviations of the fit.
    """
    step, covariance = _joint_step(problem, fitted)
    out = {}
    for name, (axis, shares) in _MADE_OF.items():
        made = np.zeros(SIZE + len(DIFFERENCES))
        made[axis] = 1.0
        made[SIZE : SIZE + len(WALLS)] = shares
        mean = float(fitted.shared[axis] + shares @ problem.differences[TURNS] + made @ step)
        deviation = widened * float(np.sqrt(made @ covariance @ made))
        out[name] = Interval.normal(mean, deviation), deviation
    return out


def shown(problem: Problem, fitted: Fit) -> float:
    """Return chi^2 of the linearised step of the differences; a large value is evidence of differences."""
    step, covariance = _joint_step(problem, fitted)
    step, covariance = step[SIZE:], covariance[SIZE:, SIZE:]
    return float(step @ np.linalg.solve(covariance, step))


def with_differences(problem: Problem, fitted: Fit) -> tuple[Problem, Fit] | None:
    """Return a fit that includes the differences; None if the motion cannot be simulated."""
    forward, most = problem.forward.renewed(), 0.5 * deviations()
    for index in range(_ROUNDS):
        step, covariance = _joint_step(problem, fitted)
        differences = problem.differences + np.clip(step[SIZE:], -most, most)
        differences[LAG] = max(differences[LAG], 0.0)
        change = differences - problem.differences
        size = float(change @ np.linalg.solve(covariance[SIZE:, SIZE:], change))
        # a change within the noise is left to the linearised step of `discrepancy.graded`
        if index and size < tuning.SETTLED:
            break
        problem = problem.having(forward=forward, differences=differences, drift=problem.drift)
        refitted = fit(problem, fitted.shared, fitted.point.states, fitted.noise, _ITERATIONS)
        if refitted is None:
            return None
        fitted = refitted
    return problem, fitted


def of_differences(problem: Problem, fitted: Fit) -> Array:
    """Return the covariance of the shared unknowns due to uncertain differences, shape (SIZE, SIZE)."""
    covariance = _joint_step(problem, fitted)[1]
    held = np.linalg.inv(covariance)[:SIZE, :SIZE]
    added: Array = covariance[:SIZE, :SIZE] - np.linalg.inv(held)
    return added


def _joint_step(problem: Problem, fitted: Fit) -> tuple[Array, Array]:
    precision = deviations() ** -2.0
    columns, pull = problem.by_differences(fitted.point), -problem.differences * precision
    return joint_step(problem, fitted, columns, precision, pull)[:2]
