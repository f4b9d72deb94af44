"""Tangential friction of a pair, compiled: regularised Coulomb,  T = mu N tanh(s' / v_s).

s' is the rate at which the frame's corner slides along the head's wall; the corner drags the wall with it. Below the
regularisation speed v_s friction is viscous: a body held by friction creeps with v_s atanh(T / (mu N)). Source:
Andersson, Soederberg and Bjoerklund, Tribol. Int. 40 (2007) 580, eq. 5.
"""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel


@kernel(inline="source")
def friction_force(normal: float, slip_rate: float, coefficient: float, speed: float) -> float:
    """Return T in N for the normal force N in N and the slip rate in m/s; it has the slip rate's sign."""
    return coefficient * normal * math.tanh(slip_rate / speed)
