"""Test of the sensor's scales: an error of a scale is an error of the clearances.

In flight the load over the mass is an acceleration in m/s2, gravity is known, and the reach of x and y at a turned
head follows from the frame. Three scales are further unknowns beside a fit, found by one linearised step with all
others eliminated (score test).
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

    scale : (3,) measured over true x, y, theta
    chi2 : of the three; 3 on the average where they are right
    """

    scale: Array
    chi2: float


def scales_of(problem: Problem, found: Fit) -> Scales:
    """Return the sensor's scales by the residuals of a fit."""
    motion = np.nan_to_num(problem.window.poses.q - found.point.residual - found.shared[BIAS])
    columns = motion[:, :, None] * np.eye(3)
    step, covariance = joint_step(problem, found, columns, np.full(3, NO_PRIOR), np.zeros(3))
    scale = step[SIZE:]
    chi2 = float(scale @ np.linalg.solve(covariance[SIZE:, SIZE:], scale))
    return Scales(1.0 + scale, chi2)
