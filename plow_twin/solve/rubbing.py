"""Factors of a pad's wear due to in-plane sliding and running-in.

    dh/dt = (k_s v / A) F sqrt(1 + (s' / v)^2) (1 + a exp(-h / h0))

v is the speed of travel along the face. s' is the rate at which the corner slides along its wall, perpendicular to the
travel. At v = 0, the root has a kink where s' = 0, which a power series cannot represent, so the v under the root is at
least `SLOWEST_TRAVEL`.
"""

from __future__ import annotations

import math
from typing import Final

from plow_twin.kernel.compiler import kernel
from plow_twin.solve.kinematics import slip_rate
from plow_twin.solve.state import COS, OMEGA, SIN, VX, VY, X, Y

#: Lower limit in m/s of the speed v in s' / v. Below this limit, wear by in-plane sliding is proportional to v.
SLOWEST_TRAVEL: Final = 0.01


@kernel(inline="code")
def time_per_length(p, pair) -> float:
    """Return 1 / v of a pad in s/m, with v at least `SLOWEST_TRAVEL`, or 0 if in-plane sliding causes no wear."""
    if p.speed_per_wear == 0.0:
        return 0.0
    return 1.0 / max(p.speed_per_wear * p.wear_per_impulse[pair], SLOWEST_TRAVEL)


@kernel()
def rubbing(p, pair, y, depth, sliding, running_in) -> float:
    """Return the wear factor of sliding and running-in, for a wear depth in m and the state y, shape (8,)."""
    factor = 1.0
    if sliding is not None:
        rate = slip_rate(p, pair, y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY])
        factor = math.sqrt(1.0 + (rate * time_per_length(p, pair)) ** 2)
    if running_in is not None:
        factor *= 1.0 + p.running_in * math.exp(-depth * p.running_in_rate)
    return factor
