"""Test of the sensor's scales, because an error of a scale causes an error of the clearances.

The scales can be tested because accelerations in flight are known from the load, the mass and gravity, and because the
frame determines the reach of x and y of a turned head. Three scales are further unknowns beside a fit. One linearised
step estimates them, with all other unknowns eliminated (score test).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.fit import NO_PRIOR, Fit, Problem, joint_step
from plow_twin.estimate.unknowns import BIAS, SIZE

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scales:
    """Estimated scales.

    scale : (3,) measured divided by true x, y, theta
    chi2 : chi^2 of the three scales, on average 3 if they are right
    """

    scale: Array
    chi2: float


def scales_of(problem: Problem, found: Fit) -> Scales:
    """Return the sensor's scales from the residuals of a fit."""
    motion = np.nan_to_num(problem.window.poses.q - found.point.residual - found.shared[BIAS])
    columns = motion[:, :, None] * np.eye(3)
    step, covariance = joint_step(problem, found, columns, np.full(3, NO_PRIOR), np.zeros(3))
    scale = step[SIZE:]
    chi2 = float(scale @ np.linalg.solve(covariance[SIZE:, SIZE:], scale))
    return Scales(1.0 + scale, chi2)
