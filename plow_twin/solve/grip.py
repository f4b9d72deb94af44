"""Friction with stick: force of sticking corners, and conditions for slip and stick.

A spring and a damper connect a sticking corner to its anchor a on the wall. A slipping corner exerts sliding friction:

    sticks    T = k (s - a) + c s'      while |T| <= mu_s N
    slips     T = +-mu N                while +-(k s' + c s'') >= mu N'

T is the tangential force, N the normal force, s the corner's position along the wall, and k and c the constants of
spring and damper. While a corner slips, the anchor follows it, so that spring and damper carry mu N. A corner starts to
stick when the force of spring and damper would grow more slowly than mu N.

If mu_s = mu, T is continuous at the change, so each pair can change separately. Sources: Cundall and Strack,
Geotechnique 29 (1979) 47; Luding, Granul. Matter 10 (2008) 235, sec. 3.2.
"""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.kinematics import penetration_of, rate_of, slip_place, slip_rate
from plow_twin.solve.state import (
    CLIPPED,
    COS,
    OFF,
    OMEGA,
    ON,
    SIN,
    SLIPS_BACKWARD,
    SLIPS_FORWARD,
    STICKS,
    THETA,
    VX,
    VY,
    X,
    Y,
)

#: Rounding errors of the first value of a guard function, relative to its terms at the start of the step and to its
#: largest term over the step.
_ROUNDING, _ROUNDING_OVER_STEP = 1e-10, 1e-13
#: Rounding error of a corner's penetration and of its position along its wall, divided by `Params.leverage`, and of its
#: slip rate, divided by `Params.threshold[0]`.
_FINEST = 4e-15


@kernel(inline="code")
def _along(p, pair, y):
    """Return the position of a corner along its wall and its slip rate, at body coordinates y."""
    place = slip_place(p, pair, y[COS], y[SIN], y[X], y[Y], y[THETA])
    return place, slip_rate(p, pair, y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY])


@kernel(inline="code")
def held_force(p, state, pair, place, rate):
    """Return the tangential force T in N of the spring and the damper at a corner."""
    return p.stick_stiffness * (place - state.anchor[pair]) + p.stick_damping * rate


@kernel(inline="code")
def tangential_force(p, state, frozen, pair, normal, place, rate):
    """Return the tangential force T in N, limited to the force that causes slip unless `frozen` is true."""
    grip = state.grip[pair]
    if state.mode[pair] != ON:
        return 0.0
    if frozen and grip != 0:
        return grip * p.friction * normal
    held = held_force(p, state, pair, place, rate)
    limit = (p.static_friction if grip == 0 else p.friction) * normal
    if frozen or abs(held) <= limit:
        return held
    return p.friction * normal if held > 0.0 else -p.friction * normal


@kernel(inline="code")
def _anchor(p, state, pair, force, place, rate) -> None:
    """Set the anchor of a corner so that spring and damper carry `force`."""
    state.anchor[pair] = place - (force - p.stick_damping * rate) / p.stick_stiffness


@kernel(inline="code")
def _normal_force(p, state, pair, depth):
    """Return the normal force of a pair that pushes, even if rounding makes the penetration `depth` negative."""
    return max(law_force(p, state, pair, depth, rate_of(p, pair, state.y)), 0.0)


@kernel()
def _normal_rounding(p, state, pair):
    """Return the rounding error in N of a corner's normal force, which follows from that of its penetration."""
    depth = max(penetration_of(p, state, pair, state.y), 0.0)
    more = _normal_force(p, state, pair, depth + _FINEST * p.leverage)
    return abs(more - _normal_force(p, state, pair, depth))


@kernel()
def grasp(p, state, pair, old) -> None:
    """Make the corner of a pair that begins to push stick with a relaxed spring, or slip if |T| exceeds mu_s N.

    N depends on the previous mode `old`, not on a rounded depth: it is the force at depth 0 after a touch, and 0 for a
    CLIPPED pair.
    """
    place, rate = _along(p, pair, state.y)
    depth = 0.0 if old == OFF else penetration_of(p, state, pair, state.y)
    normal = 0.0 if old == CLIPPED else _normal_force(p, state, pair, depth)
    state.anchor[pair], state.grip[pair] = place, 0
    held = p.stick_damping * rate
    # without normal force, every moving corner slips
    if abs(held) > p.static_friction * normal or (normal <= 0.0 and rate != 0.0):
        state.grip[pair] = 1 if rate > 0.0 else -1


@kernel()
def switch_grip(p, state, pair, new) -> None:
    """Set a corner to stick or slip, as the event `new` requires."""
    if new == STICKS:
        place, rate = _along(p, pair, state.y)
        normal = _normal_force(p, state, pair, penetration_of(p, state, pair, state.y))
        _anchor(p, state, pair, state.grip[pair] * p.friction * normal, place, rate)
        state.grip[pair] = 0
    else:
        state.grip[pair] = 1 if new == SLIPS_FORWARD else -1


@kernel()
def settle_grips(p, state, force) -> None:
    """Determine after a fixed step which corners slip under the normal forces `force`, shape (8,)."""
    for pair in range(PAIR_COUNT):
        if state.mode[pair] != ON or force[pair] <= 0.0:
            # each touch starts with a relaxed spring, as in `grasp`
            state.anchor[pair], _ = _along(p, pair, state.y)
            state.grip[pair] = 0
            continue
        _settle_grip(p, state, pair, force[pair])


@kernel()
def _settle_grip(p, state, pair, normal) -> None:
    """Determine whether a corner slips under the normal force `normal`."""
    place, rate = _along(p, pair, state.y)
    held = held_force(p, state, pair, place, rate)
    limit = (p.static_friction if state.grip[pair] == 0 else p.friction) * normal
    state.grip[pair] = 0
    if abs(held) > limit:
        state.grip[pair] = 1 if held > 0.0 else -1
        _anchor(p, state, pair, state.grip[pair] * p.friction * normal, place, rate)


@kernel()
def stretches(p, state, out) -> None:
    """Write the elongation of the spring of each corner in m to `out`, shape (8,)."""
    for pair in range(PAIR_COUNT):
        out[pair] = _along(p, pair, state.y)[0] - state.anchor[pair]


@kernel()
def keep_grip(p, state, pair, stretch, grip) -> None:
    """Give a corner that was moved the elongation of its spring and the grip before the move."""
    state.anchor[pair] = _along(p, pair, state.y)[0] - stretch
    state.grip[pair] = grip
    _settle_grip(p, state, pair, _normal_force(p, state, pair, penetration_of(p, state, pair, state.y)))


@kernel()
def weigh_grips(p, state, w) -> None:
    """Write to `w.grip` the factors of normal force, position and slip rate in the tangential force of each corner."""
    for pair in range(PAIR_COUNT):
        acts = state.mode[pair] == ON
        sticks = acts and state.grip[pair] == 0
        w.grip[0, pair] = p.friction * state.grip[pair] if acts else 0.0
        w.grip[1, pair] = p.stick_stiffness if sticks else 0.0
        w.grip[2, pair] = p.stick_damping if sticks else 0.0


@kernel(fast=True, inline="code")
def grip_terms(p, state, w, k, place, rate):
    """Return coefficient k of the tangential forces T, from coefficient k of the corners' positions and slip rates."""
    if k == 0:
        place = place - row(state.anchor, 0)
    return row(w.grip, 0) * row(w.force, k) + row(w.grip, 1) * place + row(w.grip, 2) * rate


@kernel()
def grip_guard(p, state, w, order, pair, side) -> int:
    """Write a guard function of a corner to `w.column[0]`. Return the event of its root, or 0 without a guard function.

    A sticking corner has the guard functions mu_s N -+ T, one for each direction of slip (`side`). A slipping corner
    has one for side 0, the condition for slip in the module's docstring times dt/dsigma.
    """
    g, rate, force, drag = w.column[0], w.slip[0], w.force, w.slip[4]
    grip = state.grip[pair]
    if state.mode[pair] != ON or (grip != 0 and side != 0):
        return 0
    for k in range(order + 1):
        g[k] = 0.0
    if grip == 0:
        sign = 1.0 if side == 0 else -1.0
        for k in range(order):
            g[k] = p.static_friction * force[k, pair] - sign * drag[k, pair]
        # a pair with mode ON can be slightly outside its wall, because of the error of its touch time
        g[0] = p.static_friction * max(force[0, pair], 0.0) - sign * drag[0, pair]
        size, noise = p.static_friction * abs(force[0, pair]) + abs(drag[0, pair]), 0.0
        # an allowance for the rounding errors of T and N, so that a corner does not slip as soon as it sticks
        late = _FINEST * (p.stick_stiffness * p.leverage + p.stick_damping * p.threshold[0])
        late += p.static_friction * _normal_rounding(p, state, pair)
    else:
        for k in range(order - 1):
            spring = state.alpha * rate[k, pair]
            if k > 0:
                spring += state.beta * rate[k - 1, pair]
            damper = p.stick_damping * (k + 1) * rate[k + 1, pair]
            g[k] = grip * (p.stick_stiffness * spring + damper) - p.friction * (k + 1) * force[k + 1, pair]
        size = p.stick_stiffness * abs(state.alpha * rate[0, pair])
        size += p.stick_damping * abs(rate[1, pair]) + p.friction * abs(force[1, pair])
        noise, late, power = 0.0, 0.0, 1.0
        for k in range(1, order):
            power *= state.sigma_end
            noise = max(noise, _ROUNDING_OVER_STEP * abs(g[k]) * power)
    # within the rounding error of the first value, the higher orders determine the sign
    if abs(g[0]) <= _ROUNDING * size + noise:
        g[0] = max(g[0], 0.0)
    g[0] += late
    if grip != 0:
        return STICKS
    return SLIPS_FORWARD if side == 0 else SLIPS_BACKWARD
