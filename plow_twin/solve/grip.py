"""Friction with stick: the force of sticking corners, and the conditions for slip and stick.

A spring and a damper connect a sticking corner to its anchor a on the wall; a slipping corner exerts sliding friction
on the wall:

    sticks    T = k (s - a) + c s'      while |T| <= mu_s N
    slips     T = +-mu N                while +-(k s' + c s'') >= mu N'

T is the tangential force, N the normal force, s the corner's place along the wall; k and c are the stiffness and
damping of spring and damper. While a corner slips, the anchor follows the corner so that spring and damper carry mu N.
The corner slips as long as the force of spring and damper would grow at least as fast as mu N after a change to stick.
If mu_s = mu, T and the accelerations are continuous at the change, so each pair can be decided separately. Sources:
Cundall and Strack, Geotechnique 29 (1979) 47; Luding, Granul. Matter 10 (2008) 235, sec. 3.2.
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

#: A guard's first value counts as rounding error up to the sum of two bounds: `_ROUNDING` times its terms at the step's
#: start, and `_ROUNDING_OVER_STEP` times its largest term over the step.
_ROUNDING, _ROUNDING_OVER_STEP = 1e-10, 1e-13
#: Rounding error of a corner's place along its wall, as a share of `Params.leverage`, and of its slip rate, as a share
#: of `Params.threshold[0]`.
_FINEST = 4e-15


@kernel(inline="code")
def _along(p, pair, y):
    """Return the place of a corner along its wall and its slip rate, at body coordinates y."""
    place = slip_place(p, pair, y[COS], y[SIN], y[X], y[Y], y[THETA])
    return place, slip_rate(p, pair, y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY])


@kernel(inline="code")
def held_force(p, state, pair, place, rate):
    """Return the tangential force T in N of a corner's spring and damper."""
    return p.stick_stiffness * (place - state.anchor[pair]) + p.stick_damping * rate


@kernel(inline="code")
def tangential_force(p, state, frozen, pair, normal, place, rate):
    """Return the tangential force T in N; unless `frozen`, it is limited by the force at which the corner slips."""
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
    """Set the anchor so that spring and damper carry `force`."""
    state.anchor[pair] = place - (force - p.stick_damping * rate) / p.stick_stiffness


@kernel(inline="code")
def _normal_force(p, state, pair, depth):
    """Return the normal force of a pair that pushes, even if a rounding error makes the depth negative."""
    return max(law_force(p, state, pair, depth, rate_of(p, pair, state.y)), 0.0)


@kernel()
def grasp(p, state, pair, old) -> None:
    """Let the corner of a pair that begins to push stick with a slack spring, or slip if T would exceed mu_s N.

    N follows from the previous mode `old`; if N followed from the depth, rounding would decide between stick and slip.
    At a touch N is the force at depth 0, that of Kelvin-Voigt's damper; for a CLIPPED pair that pushes again N is 0.
    """
    place, rate = _along(p, pair, state.y)
    depth = 0.0 if old == OFF else penetration_of(p, state, pair, state.y)
    normal = 0.0 if old == CLIPPED else _normal_force(p, state, pair, depth)
    state.anchor[pair], state.grip[pair] = place, 0
    held = p.stick_damping * rate
    # without a normal force every sliding corner slips; the guard of a slipping corner gives the same decision
    if abs(held) > p.static_friction * normal or (normal <= 0.0 and rate != 0.0):
        state.grip[pair] = 1 if rate > 0.0 else -1


@kernel()
def switch_grip(p, state, pair, new) -> None:
    """Change a corner's grip to stick or slip, as `new` says."""
    if new == STICKS:
        place, rate = _along(p, pair, state.y)
        # a Kelvin-Voigt force acts from the touch on, so it is computed even if rounding has made the depth zero or
        # negative
        normal = _normal_force(p, state, pair, penetration_of(p, state, pair, state.y))
        _anchor(p, state, pair, state.grip[pair] * p.friction * normal, place, rate)
        state.grip[pair] = 0
    else:
        state.grip[pair] = 1 if new == SLIPS_FORWARD else -1


@kernel()
def settle_grips(p, state, force) -> None:
    """Update after a fixed step which corners slip; `force` holds the normal forces, shape (8,)."""
    for pair in range(PAIR_COUNT):
        place, rate = _along(p, pair, state.y)
        if state.mode[pair] != ON or force[pair] <= 0.0:
            # a new touch starts with a slack spring, as in `grasp`
            state.anchor[pair], state.grip[pair] = place, 0
            continue
        held = held_force(p, state, pair, place, rate)
        limit = (p.static_friction if state.grip[pair] == 0 else p.friction) * force[pair]
        state.grip[pair] = 0
        if abs(held) > limit:
            state.grip[pair] = 1 if held > 0.0 else -1
            _anchor(p, state, pair, state.grip[pair] * p.friction * force[pair], place, rate)


@kernel()
def weigh_grips(p, state, w) -> None:
    """Write to `w.grip` the factors by which T depends on normal force, place and slip rate of each corner."""
    for pair in range(PAIR_COUNT):
        acts = state.mode[pair] == ON
        sticks = acts and state.grip[pair] == 0
        w.grip[0, pair] = p.friction * state.grip[pair] if acts else 0.0
        w.grip[1, pair] = p.stick_stiffness if sticks else 0.0
        w.grip[2, pair] = p.stick_damping if sticks else 0.0


@kernel(fast=True, inline="code")
def grip_terms(p, state, w, k, place, rate):
    """Return order k of the tangential forces T of the eight pairs.

    `place` and `rate` are order k of the corners' places and slip rates; `w.force` holds the normal forces.
    """
    if k == 0:
        place = place - row(state.anchor, 0)
    return row(w.grip, 0) * row(w.force, k) + row(w.grip, 1) * place + row(w.grip, 2) * rate


@kernel()
def grip_guard(p, state, w, order, pair, side) -> int:
    """Write a guard of a corner's grip to `w.column[0]`; return the switch that it causes, 0 without a guard.

    A sticking corner has two guards mu_s N -+ T, one for each direction of slip (`side`). A slipping corner has a guard
    for side 0 only: the condition for slip in the module's docstring, times the time per sigma.
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
        # a negative force counts as 0: a pair that is ON can lie slightly outside its wall, because the place of its
        # touch has an error
        g[0] = p.static_friction * max(force[0, pair], 0.0) - sign * drag[0, pair]
        size, noise = p.static_friction * abs(force[0, pair]) + abs(drag[0, pair]), 0.0
        # the guard is raised by the rounding error of the tangential force T; otherwise a corner could slip as soon as
        # it sticks
        late = _FINEST * (p.stick_stiffness * p.leverage + p.stick_damping * p.threshold[0])
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
    # a negative first value within rounding error is set to 0; the higher orders then decide whether the guard turns
    # negative
    if abs(g[0]) <= _ROUNDING * size + noise:
        g[0] = max(g[0], 0.0)
    g[0] += late
    if grip != 0:
        return STICKS
    return SLIPS_FORWARD if side == 0 else SLIPS_BACKWARD
