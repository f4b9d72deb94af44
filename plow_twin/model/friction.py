"""Regularised Coulomb friction of a pair, T = mu N tanh(s' / v_s), and a test for Painleve's case.

s' is the rate at which the corner of the frame slides along the wall of the head. Under a steady load T below mu N, the
corner creeps at v_s atanh(T / (mu N)) instead of sticking; `solve.grip` implements friction with stick. Source:
Andersson, Soederberg and Bjoerklund, Tribol. Int. 40 (2007) 580, eq. 5.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.model.geometry import arm_rows, roll, slip_arm_rows

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene


@kernel(inline="source")
def friction_force(normal: float, slip_rate: float, coefficient: float, speed: float) -> float:
    """Return the friction T in N, which has the sign of the slip rate. `slip_rate` and `speed` are in m/s."""
    return coefficient * normal * math.tanh(slip_rate / speed)


def painleve_coefficients(scene: Scene) -> NDArray[np.float64]:
    """Return the friction coefficient mu of each pair, shape (8,), above which Painleve's case is possible.

    In Painleve's case, a sliding corner is pressed into the wall by its own friction: in d'' = -p N, the factor p = 1/m
    + a^2/I - mu |a b|/I is negative. The lengths a and b are the arms of N and of T about the centre of mass at q = 0.
    The value is inf where Painleve's case is impossible.

    Compliant contact has exactly one solution: N grows with the rate sqrt(-p K) until the slip stops. Source: Genot and
    Brogliato, Eur. J. Mech. A 18 (1999) 653.
    """
    c, s, (x, y) = 1.0, 0.0, scene.head.com_offset_m
    normal, along = (rows.T @ np.array([c, s, x, y]) for rows in (arm_rows(scene), slip_arm_rows(scene)))
    product = np.abs(normal * (along - roll(scene)))
    if "theta" in scene.locked:
        product[:] = 0.0
    with np.errstate(divide="ignore"):
        limit: NDArray[np.float64] = (scene.head.inertia_kg_m2 / scene.head.mass_kg + normal**2) / product
    return limit
