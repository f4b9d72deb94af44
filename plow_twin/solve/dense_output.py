"""State, wear depths, penetrations and forces at any time within the current step."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import (
    below,
    choose,
    equal,
    exact_row,
    exact_splat,
    fused,
    lane,
    row,
    set_row,
    square_root,
    with_lane,
)
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import pair_force
from plow_twin.solve.kinematics import spin_of_axes
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


@kernel()
def pair_outputs(p, state, wear_depth, y, penetration, rate, force) -> None:
    """Write penetration, its rate and the force of the eight pairs, shape (8,) each, at body coordinates y.

    All sums are rounded as written, so that the results are the same in each kernel that calls this one.
    """
    c, s, om, spin = y[COS], y[SIN], y[OMEGA], spin_of_axes(p, y[OMEGA])
    depths = _with_rows(p, c, s, exact_splat(y[X]), exact_splat(y[Y]), exact_row(p.penetration_rows, 4))
    set_row(penetration, 0, depths - exact_row(wear_depth, 0))
    vx = fused(exact_splat(spin), exact_splat(y[Y]), exact_splat(y[VX]))
    vy = fused(exact_splat(-spin), exact_splat(y[X]), exact_splat(y[VY]))
    set_row(rate, 0, _with_rows(p, -om * s, om * c, vx, vy, exact_splat(0.0)))
    set_row(force, 0, _forces(p, state, exact_row(penetration, 0), exact_row(rate, 0)))


@kernel()
def _with_rows(p, c, s, x, y, start):
    """Return `start` plus the products of the first four rows of `penetration_rows` with c, s, x and y."""
    rows = p.penetration_rows
    turned = fused(exact_row(rows, 1), exact_splat(s), fused(exact_row(rows, 0), exact_splat(c), start))
    return fused(exact_row(rows, 3), y, fused(exact_row(rows, 2), x, turned))


@kernel()
def _forces(p, state, penetration, rate):
    """Return the force of each pair. A general power takes most of the time of an output row, so 1.5 is special."""
    zero = exact_splat(0.0)
    acting = equal(state.mode, 0, ON) & below(zero, penetration)
    if acting == 0:
        return zero
    if p.ramp == 0.0 and (p.exponent == 1.0 or p.exponent == 1.5):
        elastic = penetration
        if p.exponent == 1.5:
            elastic = penetration * square_root(choose(acting, penetration, zero))
        force = (elastic * p.stiffness) * (exact_row(state.damping_factor, 0) * rate + 1.0) + rate * p.viscous
        return choose(acting & below(zero, force), force, zero)
    force = zero
    for pair in range(PAIR_COUNT):
        if acting >> pair & 1:
            force = with_lane(force, pair, pair_force(p, state, pair, lane(penetration, pair), lane(rate, pair)))
    return force
