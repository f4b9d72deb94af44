"""Tangential friction of a pair: regularised Coulomb, compiled,  T = mu N tanh(s' / v_s); Painleve's case.

s' is the rate at which the frame's corner slides along the head's wall; the corner drags the wall with it. Below the
regularisation speed v_s friction is viscous: a body held by friction creeps with v_s atanh(T / (mu N)). Source:
Andersson, Soederberg and Bjoerklund, Tribol. Int. 40 (2007) 580, eq. 5. Friction with stick has a state of its own:
`solve.grip`.
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
    """Return T in N for the normal force N in N and the slip rate in m/s; it has the slip rate's sign."""
    return coefficient * normal * math.tanh(slip_rate / speed)


def painleve_coefficients(scene: Scene) -> NDArray[np.float64]:
    """Return for each pair the mu above which its sliding corner can be Painleve's case, shape (8,); inf if it cannot.

    A sliding corner is pressed into the wall by its own friction where d'' = -p N with p = 1/m + a^2/I - mu |a b|/I <
    0, with the arms a and b of N and T about the centre of mass, here at q = 0. Rigid bodies then have no solution or
    several; the compliant contact has one: N grows with the rate sqrt(-p K) until the slip has stopped ("impact without
    collision"). Source: Genot and Brogliato, Eur. J. Mech. A 18 (1999) 653.
    """
    c, s, (x, y) = 1.0, 0.0, scene.head.com_offset_m
    normal, along = (rows.T @ np.array([c, s, x, y]) for rows in (arm_rows(scene), slip_arm_rows(scene)))
    product = np.abs(normal * (along - roll(scene)))
    if "theta" in scene.locked:
        product[:] = 0.0
    with np.errstate(divide="ignore"):
        limit: NDArray[np.float64] = (scene.head.inertia_kg_m2 / scene.head.mass_kg + normal**2) / product
    return limit
