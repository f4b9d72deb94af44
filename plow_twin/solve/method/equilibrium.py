"""Equilibrium of a head that is held by its contacts: stiffness and distance."""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.dynamics import accelerate
from plow_twin.solve.kinematics import penetration_of
from plow_twin.solve.state import OFF, ON


@kernel()
def held(p, state, y, least) -> bool:
    """Return whether every pair is ON or OFF with a penetration or gap larger than `least`."""
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            penetration = penetration_of(p, state, pair, y)
            inside = state.mode[pair] == ON and penetration > least
            if not (inside or (state.mode[pair] == OFF and penetration < -least)):
                return False
    return True


@kernel()
def stiffness_at(p, acts, state, w, gyration) -> None:
    """Write the accelerations at the state `w.rest[0]` to `w.rest[1]`, and the stiffness, shape (3, 3), to `w.hessian`.

    The stiffness is minus the derivative of the accelerations with respect to the coordinates. The radius of gyration
    times the angle as third coordinate makes the matrix symmetric.
    """
    z, rate, moved, t = w.rest[0], w.rest[1], w.rest[2], state.step_start
    accelerate(p, acts, True, state, t, z, w.rest[3, :3], rate)
    for j in range(3):
        unit = gyration if j == 2 else 1.0
        saved, delta = z[j], 1e-9 / unit
        z[j] = saved + delta
        accelerate(p, acts, True, state, t, z, w.rest[3, :3], moved)
        z[j] = saved
        for i in range(3):
            scale = gyration if i == 2 else 1.0
            w.hessian[i, j] = (rate[3 + i] - moved[3 + i]) * scale / (delta * unit)
            if p.free[i] == 0.0 or p.free[j] == 0.0:
                w.hessian[i, j] = np.inf if i == j else 0.0
    state.evaluations += 4


@kernel()
def stiffer_than(h, least) -> bool:
    """Return whether all eigenvalues of the symmetric matrix h exceed `least`, by the signs of leading minors."""
    a, b, c = h[0, 0] - least, h[1, 1] - least, h[2, 2] - least
    if not a > 0.0:
        return False
    # Cholesky decomposition without square roots; a locked degree of freedom is infinitely stiff
    b -= h[1, 0] * h[0, 1] / a
    if not b > 0.0:
        return False
    mixed = h[2, 1] - h[2, 0] * h[0, 1] / a
    c -= h[2, 0] * h[0, 2] / a + mixed * mixed / b
    return c > 0.0


@kernel()
def to_equilibrium(h, rate, z, gyration) -> float:
    """Move z by one Newton step x towards the point without acceleration. Return x h x, twice the energy."""
    a, b, c = rate[3], rate[4], rate[5] * gyration
    low10, low20 = h[1, 0] / h[0, 0], h[2, 0] / h[0, 0]
    d1 = h[1, 1] - low10 * h[0, 1]
    mixed = h[2, 1] - low20 * h[0, 1]
    low21 = mixed / d1
    b -= low10 * a
    c -= low20 * a + low21 * b
    angle = c / (h[2, 2] - low20 * h[0, 2] - low21 * mixed)
    y = (b - mixed * angle) / d1
    x = (a - h[0, 1] * y - h[0, 2] * angle) / h[0, 0]
    z[0] += x
    z[1] += y
    z[2] += angle / gyration
    return rate[3] * x + rate[4] * y + rate[5] * gyration * angle
