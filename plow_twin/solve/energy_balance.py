"""Energy balance of a run, which compares changes of energy and momentum with work and impulse of the forces.

The forces are computed at single instants, independently of the series, by `model.contact` and `model.friction`. They
and their powers are integrated by Gauss-Legendre quadrature over each step of the series, or by the trapezoidal rule
over fixed steps.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row
from plow_twin.model.geometry import STATE_SIZE
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.dense_output import evaluate, pair_outputs, time_along, wear_depth_at
from plow_twin.solve.dynamics import about_mass, push
from plow_twin.solve.kinematics import along, to_world_axes
from plow_twin.solve.loads import load_at
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, X, Y, new_record
from plow_twin.solve.support import to_ground

#: Number of nodes of the quadrature, which is exact up to degree 15. Higher terms are as small as the series' error.
_NODES = 8
#: Largest phase [rad] of the fastest harmonic load over one quadrature in flight or at rest, with an error of 1e-13 for
#: a product of two harmonics.
_PANEL_PHASE = 2.0
# indices into the powers [W] and forces [N, N m] at one time
LOADS, NORMAL, FRICTION, SUPPORT, LOAD_X, LOAD_Y, LOAD_M, CONTACT_X, CONTACT_Y, CONTACT_M, SIZE = range(11)

#: Sums over a run.
SUMS = np.dtype(
    [
        ("work", "f8", (SIZE,)),  # time integrals of the powers and forces
        ("turnover", "f8"),  # time integral of the absolute values of the powers
        ("energy", "f8", (2,)),  # kinetic energy of head and frame: initial value, current value
        ("momentum", "f8", (2, 3)),  # m vx, m vy, I omega in world axes: initial values, current values
        ("residual", "f8"),  # largest imbalance of energy so far
        ("momentum_residual", "f8", (3,)),  # largest imbalances of momentum so far
    ]
)


#: Record of the energy balance: quadrature, work space and sums. Kernels that receive None omit the balance.
BALANCE = np.dtype(
    [
        ("nodes", "f8", (_NODES,)),
        ("weights", "f8", (_NODES,)),
        ("now", "f8", (SIZE,)),  # powers and forces at one time
        ("before", "f8", (SIZE,)),  # powers and forces at the end of the previous fixed step
        ("body", "f8", (STATE_SIZE,)),  # body coordinates at a node
        ("ground", "f8", (STATE_SIZE,)),  # with a support: body coordinates relative to the ground
        ("wear_depth", "f8", (PAIR_COUNT,)),  # wear depth at a node
        ("pairs", "f8", (3, PAIR_COUNT)),  # penetration, rate, force
        ("sums", SUMS),
    ]
)
BalanceSums: TypeAlias = np.record


def new_balance() -> BalanceSums:
    """Return a balance whose sums are zero."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    balance = new_record(BALANCE)
    balance.nodes[:], balance.weights[:] = 0.5 * (nodes + 1.0), 0.5 * weights
    return balance


@kernel()
def _powers(p, parts, state, wear_depth, y, frame, t, balance, out) -> None:
    """Write powers and forces at time t, body coordinates y and the state `frame` of a frame on springs, if any."""
    terms, load = parts.terms, out[LOAD_X : LOAD_M + 1]
    load_at(p, parts.harmonics, parts.segments, t, load)
    ground = _on_ground(terms.support, y, frame, balance)
    _powers_under(
        p, terms.offset, terms.free, terms.slip, terms.stick, state, wear_depth, y, ground, load, balance.pairs, out
    )
    out[SUPPORT] = _taken_by_support(p, terms.support, frame)


@kernel()
def _taken_by_support(p, support, frame):
    power = 0.0
    if support is not None:
        for j in range(3):
            held = p.frame_stiffness[j] * frame[j] + p.frame_damping[j] * frame[3 + j]
            power += held / p.frame_mobility[j] * frame[3 + j]
    return power


@kernel()
def _on_ground(support, y, frame, balance):
    """Convert body coordinates y relative to the frame to coordinates relative to the ground."""
    if support is not None:
        to_ground(y, frame, balance.ground)
        return balance.ground
    return y


@kernel()
def _powers_under(p, offset, free, slip, stick, state, wear_depth, y, ground, load, pairs, out) -> None:
    c, s = ground[COS], ground[SIN]
    out[LOADS] = out[NORMAL] = out[FRICTION] = 0.0
    m, inertia = 1.0 / p.inverse_mass, 1.0 / p.inverse_inertia
    if offset is not None:
        load[2] += about_mass(p, c, s, load)
    load[0], load[1], load[2] = m * load[0], m * load[1], inertia * load[2]
    pair_outputs(p, state, wear_depth, y, pairs[0], pairs[1], pairs[2])
    fx = fy = torque = 0.0
    for pair in range(PAIR_COUNT):
        force = pairs[2, pair]
        if force == 0.0:
            continue
        push_x, push_y, moment, power = push(
            p, slip, stick, state, True, pair, force, y[COS], y[SIN], y[THETA], y[OMEGA], y[X], y[Y], y[VX], y[VY]
        )
        fx += push_x
        fy += push_y
        torque += moment
        out[NORMAL] += force * pairs[1, pair]
        out[FRICTION] += power
    ca, sa = along(p, c, s)
    out[CONTACT_X], out[CONTACT_Y] = to_world_axes(ca, sa, fx, fy)
    out[CONTACT_M] = torque
    if free is not None:
        for j in range(3):
            load[j] *= p.free[j]
            out[CONTACT_X + j] *= p.free[j]
    vx, vy = to_world_axes(ca, sa, ground[VX], ground[VY])
    out[LOADS] = load[0] * vx + load[1] * vy + load[2] * ground[OMEGA]


@kernel()
def _balance(p, support, relative, frame, balance, start) -> None:
    """Compute energy and momentum from the state, and update the largest imbalances."""
    sums, y = balance.sums, _on_ground(support, relative, frame, balance)
    m, inertia = 1.0 / p.inverse_mass, 1.0 / p.inverse_inertia
    c, s = along(p, math.cos(y[THETA]), math.sin(y[THETA]))
    sums.energy[1] = 0.5 * m * (y[VX] * y[VX] + y[VY] * y[VY]) + 0.5 * inertia * y[OMEGA] * y[OMEGA]
    if support is not None:
        for j in range(3):
            sums.energy[1] += 0.5 * frame[3 + j] * frame[3 + j] / p.frame_mobility[j]
    vx, vy = to_world_axes(c, s, y[VX], y[VY])
    sums.momentum[1, 0], sums.momentum[1, 1] = m * vx, m * vy
    sums.momentum[1, 2] = inertia * y[OMEGA]
    if start:
        sums.energy[0] = sums.energy[1]
        for j in range(3):
            sums.momentum[0, j] = sums.momentum[1, j]
    gained = sums.work[LOADS] - sums.work[NORMAL] - sums.work[FRICTION] - sums.work[SUPPORT]
    sums.residual = max(sums.residual, abs(sums.energy[1] - sums.energy[0] - gained))
    for j in range(3):
        pushed = sums.work[LOAD_X + j] + sums.work[CONTACT_X + j]
        change = sums.momentum[1, j] - sums.momentum[0, j]
        sums.momentum_residual[j] = max(sums.momentum_residual[j], abs(change - pushed))


@kernel()
def _frame_of(support, state):
    if support is not None:
        return state.frame
    return None


@kernel()
def _frame_now(support, w):
    """Return the last evaluated state of a frame on springs, or None for a fixed frame."""
    if support is not None:
        return w.frame_now
    return None


@kernel()
def start_balance(p, parts, state, y, t, balance) -> None:
    """Store energy, momentum, powers and forces at the start of a run."""
    frame = _frame_of(parts.terms.support, state)
    _balance(p, parts.terms.support, y, frame, balance, True)
    _powers(p, parts, state, state.wear_depth, y, frame, t, balance, balance.before)


@kernel()
def _add(balance, powers, weight) -> None:
    sums = balance.sums
    for i in range(SIZE):
        sums.work[i] += weight * powers[i]
    sums.turnover += weight * (abs(powers[LOADS]) + abs(powers[NORMAL]) + abs(powers[FRICTION]) + abs(powers[SUPPORT]))


@kernel()
def balance_step(p, parts, wear, flight, state, w, balance) -> None:
    """Add the integrals over the current step, before it is completed."""
    y, wear_depth, end, support = balance.body, balance.wear_depth, state.sigma_end, parts.terms.support
    frame = _frame_now(support, w)
    set_row(wear_depth, 0, row(state.wear_depth, 0))
    panels = 1
    if flight is not None and (state.in_flight == 1 or state.at_rest == 1):
        panels += int(end * p.fastest / _PANEL_PHASE)
    width = end / panels
    for panel in range(panels):
        for i in range(balance.nodes.size):
            sigma = width * (panel + balance.nodes[i])
            evaluate(p, parts.harmonics, flight, support, state, w, sigma, y)
            if wear is not None:
                wear_depth_at(state, w, sigma, wear_depth)
            t = state.step_start + time_along(state.alpha, state.beta, sigma)
            _powers(p, parts, state, wear_depth, y, frame, t, balance, balance.now)
            _add(balance, balance.now, balance.weights[i] * width * (state.alpha + state.beta * sigma))
    evaluate(p, parts.harmonics, flight, support, state, w, end, y)
    _balance(p, support, y, frame, balance, False)


@kernel()
def balance_fixed_step(p, parts, state, y, t, dt, balance) -> None:
    """Add the integrals over a fixed step that ends at body coordinates y and time t."""
    frame = _frame_of(parts.terms.support, state)
    _powers(p, parts, state, state.wear_depth, y, frame, t, balance, balance.now)
    _add(balance, balance.before, 0.5 * dt)
    _add(balance, balance.now, 0.5 * dt)
    for i in range(SIZE):
        balance.before[i] = balance.now[i]
    _balance(p, parts.terms.support, y, frame, balance, False)
