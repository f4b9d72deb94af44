"""Test of the sensor's scale factors, whose errors would cause errors of the clearances.

A wrong scale factor shows in the measured acceleration in flight, and in the displacement of a rotated head in contact.
The scale factors are estimated in one linearised step from a fit, with all other unknowns eliminated (score test).
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
    """Estimated scale factors of the sensor.

    scale : (3,) measured values divided by true values of x, y and theta
    chi2 : chi^2 of the three scale factors, on average 3 for a correct sensor
    """

    scale: Array
    chi2: float


def scales_of(problem: Problem, fitted: Fit) -> Scales:
    """Return the scale factors of the sensor from the residuals of a fit."""
    motion = np.nan_to_num(problem.window.poses.q - fitted.point.residual - fitted.shared[BIAS])
    columns = motion[:, :, None] * np.eye(3)
    step, covariance = joint_step(problem, fitted, columns, np.full(3, NO_PRIOR), np.zeros(3))
    scale = step[SIZE:]
    chi2 = float(scale @ np.linalg.solve(covariance[SIZE:, SIZE:], scale))
    return Scales(1.0 + scale, chi2)
