"""State, wear depths, penetrations and forces at any time within the current step."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, choose, equal, exact_row, exact_splat, row, set_row, splat, square_root
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import pair_force
from plow_twin.solve.kinematics import row_values, spin_of_axes
from plow_twin.solve.method.flight import fly
from plow_twin.solve.modes import any_penetrates
from plow_twin.solve.state import COS, OMEGA, ON, SIN, VX, VY, X, Y
from plow_twin.solve.support import see_from_frame


@kernel(inline="source")
def time_along(alpha, beta, sigma):
    """Return the time since the start of the step at the series variable sigma."""
    return alpha * sigma + 0.5 * beta * sigma * sigma


@kernel(inline="source")
def sigma_at(state, used):
    """Return the series variable sigma at `used` seconds after the start of the step."""
    if used >= state.step_size:
        return state.sigma_end
    # the formula below is 0 / 0 at a touch (alpha = 0)
    if state.beta == 0.0 or used == 0.0:
        return used
    # root of alpha sigma + beta sigma^2 / 2 = used, in a form without cancellation
    return 2.0 * used / (state.alpha + math.sqrt(max(state.alpha**2 + 2.0 * state.beta * used, 0.0)))


@kernel(fast=True)
def sum_series(support, state, w, sigma, out) -> None:
    """Write the state from its series at sigma to `out`, shape (8,), relative to a frame on springs."""
    order, series = state.order, w.series
    value = row(series, order)
    for k in range(order - 1, -1, -1):
        value = value * sigma + row(series, k)
    set_row(out, 0, value)
    if support is not None:
        see_from_frame(w, order, sigma, out)


@kernel(inline="code")
def evaluate(p, harmonics, flight, support, state, w, sigma, out) -> None:
    """Write the state in body coordinates at sigma to `out`, shape (8,)."""
    if state.in_flight == 1:
        fly(p, harmonics, flight, state, w, sigma, out)
    else:
        sum_series(support, state, w, sigma, out)


@kernel(fast=True)
def wear_depth_at(state, w, sigma, out) -> None:
    """Write the wear depth of each pad at sigma to `out`, shape (8,)."""
    wear_depth = row(state.wear_depth, 0)
    if any_penetrates(state):
        # row 0 of `w.wear` is the wear before the step
        order = state.order
        growth = row(w.wear, order)
        for k in range(order - 1, 0, -1):
            growth = growth * sigma + row(w.wear, k)
        wear_depth = wear_depth + growth * sigma
    set_row(out, 0, wear_depth)


@kernel(fast=True)
def pair_outputs(p, state, wear_depth, y, penetration, rate, force) -> None:
    """Write penetration, its rate and the force of the eight pairs, shape (8,) each, at body coordinates y."""
    c, s, om = y[COS], y[SIN], y[OMEGA]
    set_row(
        penetration,
        0,
        row_values(p.penetration_rows, c, s, y[X], y[Y]) + (row(p.penetration_rows, 4) - row(wear_depth, 0)),
    )
    spin = spin_of_axes(p, om)
    set_row(rate, 0, row_values(p.penetration_rows, -om * s, om * c, y[VX] + spin * y[Y], y[VY] - spin * y[X]))
    acting = equal(state.mode, 0, ON)
    if acting == 0:
        set_row(force, 0, splat(0.0))
    elif p.ramp == 0.0 and (p.exponent == 1.0 or p.exponent == 1.5):
        set_row(force, 0, _forces(p, state, acting, exact_row(penetration, 0), exact_row(rate, 0)))
    else:
        for pair in range(PAIR_COUNT):
            force[pair] = pair_force(p, state, pair, penetration[pair], rate[pair]) if acting >> pair & 1 else 0.0


@kernel()
def _forces(p, state, acting, penetration, rate):
    """Return the forces of all pairs whose bit in `acting` is set, for the exponents 1 and 1.5 without a ramp.

    They are the values of `pair_force`, whose general power would take most of the time of an output row.
    """
    zero = exact_splat(0.0)
    acting &= below(zero, penetration)
    elastic = penetration
    if p.exponent == 1.5:
        elastic = penetration * square_root(choose(acting, penetration, zero))
    force = (elastic * p.stiffness) * (exact_row(state.damping_factor, 0) * rate + 1.0) + rate * p.viscous
    return choose(acting & below(zero, force), force, zero)
