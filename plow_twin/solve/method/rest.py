"""Rest: a head that its contacts hold still is not followed through what rounding leaves of its ringing.

With constant loads and nothing else that drives it, the sum of kinetic and potential energy cannot grow. Where the
stiffness is positive definite it bounds for all time how far the head can get from its equilibrium. Once that is far
below the tolerance the head is put there, and steps are as long as they may be.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.dynamics import accelerate, acting
from plow_twin.solve.kinematics import penetration_of, to_body, to_world
from plow_twin.solve.state import OFF, OMEGA, ON, VX, VY

#: Share of the tolerances that the motion left out may reach.
_SHARE = 1e-3
#: How much deeper than that a pair must be, or how much farther away.
_MARGIN = 100.0
#: And at least so deep in m, for the differences that give the stiffness.
_DEEP = 1e-7
#: Evaluations of the equations of motion that it takes to tell, at most.
AT_REST = 5


@kernel()
def _held(p, state, y, least) -> bool:
    """Tell whether each pair is on or off, and neither close to changing that."""
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            penetration = penetration_of(p, state, pair, y)
            inside = state.mode[pair] == ON and penetration > least
            if not (inside or (state.mode[pair] == OFF and penetration < -least)):
                return False
    return True


@kernel()
def _stiffness(p, acts, state, w, gyration) -> None:
    """Write the accelerations at `w.rest[0]` to `w.rest[1]`, minus their derivatives by place to `w.hessian` (3, 3).

    The angle times the radius of gyration counts as a place: the matrix is symmetric then.
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
def _stiffer_than(h, least) -> bool:
    """Tell whether the symmetric matrix h exceeds `least` times the unit matrix: all leading minors are positive."""
    a, b, c = h[0, 0] - least, h[1, 1] - least, h[2, 2] - least
    if not a > 0.0:
        return False
    # Cholesky without roots; a locked degree of freedom is infinitely stiff
    b -= h[1, 0] * h[0, 1] / a
    if not b > 0.0:
        return False
    mixed = h[2, 1] - h[2, 0] * h[0, 1] / a
    c -= h[2, 0] * h[0, 2] / a + mixed * mixed / b
    return c > 0.0


@kernel()
def _to_equilibrium(h, rate, z, gyration) -> None:
    """Move z to where the accelerations vanish, by one Newton step."""
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


@kernel()
def _still(p, acts, state, w) -> bool:
    """Tell whether the head stays within the share of the tolerances for all time; bring it to rest then."""
    y, z, rate = state.y, w.rest[0], w.rest[1]
    gyration = math.sqrt(p.inverse_mass / p.inverse_inertia)
    speed = math.hypot(math.hypot(y[VX], y[VY]), gyration * y[OMEGA])
    way, fast = _SHARE * p.position_tolerance, _SHARE * p.velocity_tolerance
    if speed > 0.5 * fast or not _held(p, state, y, max(_MARGIN * way, _DEEP)):
        return False
    to_world(y, z)
    z[3] = z[4] = z[5] = 0.0
    _stiffness(p, acts, state, w, gyration)
    push = math.hypot(math.hypot(rate[3], rate[4]), gyration * rate[5])
    # energy bounds the distance from the equilibrium by v / sqrt(least) + 2 a / least, the speed by v + a / sqrt(least)
    least = max((2.0 * speed / way) ** 2, 4.0 * push / way, (2.0 * push / fast) ** 2)
    if not _stiffer_than(w.hessian, least):
        return False
    _to_equilibrium(w.hessian, rate, z, gyration)
    return True


@kernel()
def _still_as_before(p, acts, state, w) -> bool:
    """Tell whether nothing has changed since the head was found at rest: neither its place nor its load."""
    z, rate = w.rest[0], w.rest[1]
    to_world(state.y, z)
    accelerate(p, acts, True, state, state.step_start, z, w.rest[3, :3], rate)
    state.evaluations += 1
    push = math.hypot(math.hypot(rate[3], rate[4]), p.radius * rate[5])
    return push <= 1e-12 * p.threshold[0] * p.weight / p.radius


@kernel()
def lay_out(p, parts, rest, state, w, span, penetrating) -> bool:
    """Lay out a step of rest where the head is at rest and its load constant."""
    if rest is None:
        return False
    steady = penetrating and w.wrench[1, 0] == 0.0 and w.wrench[1, 1] == 0.0 and w.wrench[1, 2] == 0.0
    state.at_rest = 1 if steady and _settle(p, acting(parts), state, w) else 0
    if state.at_rest == 0:
        return False
    write_rest(p, state, w)
    state.sigma_end, state.order, state.ends_at_stop = span, 1, 1
    return True


@kernel()
def _settle(p, acts, state, w) -> bool:
    """Bring the head to rest where it is found at rest; tell whether it is."""
    if not (state.at_rest == 1 and _still_as_before(p, acts, state, w)):
        if not _still(p, acts, state, w):
            return False
        to_body(w.rest[0], state.y)
    return True


@kernel()
def write_rest(p, state, w) -> None:
    """Write the series of a head at rest: it stays where it is."""
    y = state.y
    set_row(w.series, 0, row(y, 0))
    for pair in range(PAIR_COUNT):
        penetration = penetration_of(p, state, pair, y)
        w.penetration[0, pair], w.force[0, pair] = penetration, 0.0
        if state.mode[pair] == ON:
            w.force[0, pair] = law_force(p, state, pair, penetration, 0.0)
    set_row(w.series, 1, splat(0.0))
    set_row(w.penetration, 1, splat(0.0))
    set_row(w.force, 1, splat(0.0))
