"""Taylor series of the motion with fixed contact modes.

With the state in body coordinates (`model.geometry`) the equations of motion (paper, eq. 5) are polynomials:

    X'  = VX + omega Y            VX' =  omega VY + c (Fx/m) + s (Fy/m) + sum n_x F/m
    Y'  = VY - omega X            VY' = -omega VX - s (Fx/m) + c (Fy/m) + sum n_y F/m
    c'  = -omega s    s' = omega c    theta' = omega    omega' = M/I + sum arm F/I

so each coefficient of the series follows from the coefficients of lower order by Cauchy products (Jorba and Zou, Exp.
Math. 14 (2005) 99).

The time since the start of the step is t = alpha sigma + beta sigma^2 / 2 with the series variable sigma. For (alpha,
beta) = (1, 0), sigma is the time. For (0, 2), it is the square root of the time, in which a contact force with the
exponent 1.5 is analytic at its touch.
"""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import lane, magnitude, pack, permutation, row, set_row, splat, three_totals, total
from plow_twin.model.contact import power_term, power_terms, ramp_terms, root_terms
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_terms
from plow_twin.solve.grip import grip_terms
from plow_twin.solve.kinematics import fixed_axes, rolled, row_values, slip_arms
from plow_twin.solve.rubbing import time_per_length
from plow_twin.solve.state import ACTS, BASE, COS, DAMPS, OMEGA, RAMPS, SIN, THETA, VX, VY, X, Y
from plow_twin.solve.support import (
    FRAME_THETA,
    FRAME_VX,
    FRAME_VY,
    FRAME_X,
    FRAME_Y,
    RELATIVE_COS,
    RELATIVE_SIN,
    SPIN,
    start_frame,
)

#: Size of a term that is treated as zero, divided by the admissible size of the term of the last order.
_VANISHED = 0.4
#: Permutations of the state's components. `_turned` contains the components that are multiplied by omega, or by the
#: harmonic load S1 in lanes 4 and 7. `_rates_of` contains the components that are rates of other components.
_turned = permutation(Y, X, VY, VX, COS, SIN, COS, SIN)
_rates_of = permutation(VX, VY, VX, VY, OMEGA, COS, SIN, OMEGA)


@kernel(fast=True)
def expand_harmonics(harmonics, second, t, alpha, beta, order, w) -> None:
    """Write the series of the harmonic forces S1 and S2 and of the harmonic moment M to `w.load`.

    The coefficients follow from (k+1) sin_{k+1} = omega (alpha cos_k + beta cos_{k-1}), and likewise for the cosine.
    """
    load = w.load
    for k in range(order + 1):
        load[0, k] = load[1, k] = load[2, k] = 0.0
    for i in range(harmonics.size):
        harmonic = harmonics[i]
        omega = harmonic.omega
        sine, cosine = math.sin(omega * t), math.cos(omega * t)
        sine_before, cosine_before = 0.0, 0.0
        f0, f1, m0, m1 = harmonic.first[0], harmonic.first[1], harmonic.moment[0], harmonic.moment[1]
        for k in range(order + 1):
            load[0, k] += f0 * sine + f1 * cosine
            load[2, k] += m0 * sine + m1 * cosine
            if second is not None:
                load[1, k] += harmonic.second[0] * sine + harmonic.second[1] * cosine
            scale = omega * w.inverse[k + 1]
            new_sine = scale * (alpha * cosine + beta * cosine_before)
            new_cosine = -scale * (alpha * sine + beta * sine_before)
            sine_before, cosine_before = sine, cosine
            sine, cosine = new_sine, new_cosine


@kernel(fast=True)
def _multiply_older(a, b, k):
    """Return coefficient k of the products of the columns of a and b, without the terms that contain row k of a or b.

    The highest orders are added last, so that the sum can start before they are available.
    """
    low, high = splat(0.0), splat(0.0)
    half = k // 2
    if k == 2 * half and k > 0:
        low = row(a, half) * row(b, half)
        half -= 1
    for j in range(half, 0, -1):
        low = low + row(a, j) * row(b, k - j)
        high = high + row(a, k - j) * row(b, j)
    return low + high


@kernel(fast=True)
def _join(a, b, k, a_k, b_k):
    """Return coefficient k of the products of the columns of a and b, whose rows k are a_k and b_k.

    Reading the rows k from memory would wait until they are stored.
    """
    if k == 0:
        return a_k * b_k
    return _multiply_older(a, b, k) + (row(a, 0) * b_k + a_k * row(b, 0))


@kernel(fast=True)
def _multiply(a, b, k):
    """Return coefficient k of the products of the columns of a and b."""
    return _join(a, b, k, row(a, k), row(b, k))


@kernel(fast=True, inline="code")
def _raise(w, k, penetration, touching, exponent):
    """Write coefficient k of penetration^exponent of the acting pairs to `w.power[0]`, and return it.

    For acting pairs, row BASE of `w.per_pair` is 1 / d, or half the square root of 1 / d for the exponent 1.5. For
    other pairs it is zero.
    """
    if exponent == 1.5:
        # d sqrt(d) is faster than the general recurrence
        if k == 0:
            for pair in range(PAIR_COUNT):
                w.power[1, 0, pair] = math.sqrt(w.penetration[0, pair]) if w.per_pair[BASE, pair] != 0.0 else 0.0
            root = row(w.power[1], 0)
        else:
            root = root_terms(penetration, w.power[1], k) * row(w.per_pair, BASE)
            set_row(w.power[1], k, root)
        power = _join(w.penetration, w.power[1], k, penetration, root)
    elif k == 0:
        for pair in range(PAIR_COUNT):
            w.power[0, 0, pair] = w.penetration[0, pair] ** exponent if w.per_pair[BASE, pair] != 0.0 else 0.0
        power = row(w.power[0], 0)
    else:
        power = power_terms(w.penetration, w.power[0], k, exponent) * row(w.per_pair, BASE)
    set_row(w.power[0], k, power)
    if touching != 0:
        for pair in range(PAIR_COUNT):
            if touching >> pair & 1:
                w.power[0, k, pair] = power_term(w.penetration, w.power[0], pair, k, exponent, 2)
        power = row(w.power[0], k)
    return power


@kernel(fast=True, inline="code")
def _damp(p, elastic, w, k, elastic_k, rate, viscous, hysteretic, ramp):
    """Return coefficient k of K d^n (1 + lambda d') or of K d^n + C psi d', where psi is the active share of C."""
    force = row(w.per_pair, ACTS) * elastic_k
    if ramp is not None:
        _ramp(p, w, k)
        set_row(w.damped, k, _multiply(w.ramp[2], w.rate, k))
        return force + row(w.per_pair, DAMPS) * row(w.damped, k)
    if viscous is not None:
        return force + row(w.per_pair, DAMPS) * rate
    return force if hysteretic is None else force + row(w.per_pair, DAMPS) * _join(elastic, w.rate, k, elastic_k, rate)


@kernel(fast=True, inline="code")
def _ramp(p, w, k) -> None:
    """Write coefficient k of the active share of C to `w.ramp[2]`. The share is constant beyond the ramp."""
    set_row(w.ramp[0], k, _multiply(w.penetration, w.penetration, k))
    set_row(w.ramp[1], k, _multiply(w.ramp[0], w.penetration, k))
    within = row(w.per_pair, RAMPS)
    share = ramp_terms(w.ramp[0], w.ramp[1], k, p.ramp) * within
    if k == 0:
        share = share + (within * -1.0 + 1.0)
    set_row(w.ramp[2], k, share)


@kernel(fast=True, inline="code")
def _push(p, state, w, k, penetration, rate, viscous, hysteretic, integer, fraction, ramp):
    """Return coefficient k of the eight contact forces (`model.contact`), zero for pairs that do not act.

    For acting pairs, row ACTS of `w.per_pair` is K, and row DAMPS is C or K lambda. For other pairs, both rows are
    zero.
    """
    if integer is not None:
        set_row(w.power[0], k, _multiply(w.penetration, w.penetration, k))
        degree = int(p.exponent)
        for i in range(1, degree - 1):
            set_row(w.power[i], k, _multiply(w.power[i - 1], w.penetration, k))
        elastic = w.power[degree - 2]
        return _damp(p, elastic, w, k, row(elastic, k), rate, viscous, hysteretic, ramp)
    if fraction is not None:
        power = _raise(w, k, penetration, state.touching, p.exponent)
        return _damp(p, w.power[0], w, k, power, rate, viscous, hysteretic, ramp)
    return _damp(p, w.penetration, w, k, penetration, rate, viscous, hysteretic, ramp)


@kernel(fast=True)
def _hold(p, w, k, fx, fy):
    """Return coefficient k of the force per mass in head axes, without its component along a locked world axis."""
    if fixed_axes(p) is not None:
        return p.free[0] * fx, p.free[1] * fy
    w.world[0, k], w.world[1, k] = fx, fy
    right, world = w.right, w.world
    along_x = along_y = 0.0
    for j in range(k + 1):
        along_x += right[k - j, 4] * world[0, j] - right[k - j, 5] * world[1, j]
        along_y += right[k - j, 5] * world[0, j] + right[k - j, 4] * world[1, j]
    world[2, k], world[3, k] = p.free[0] * along_x, p.free[1] * along_y
    fx = fy = 0.0
    for j in range(k + 1):
        fx += right[k - j, 4] * world[2, j] + right[k - j, 5] * world[3, j]
        fy += right[k - j, 4] * world[3, j] - right[k - j, 5] * world[2, j]
    return fx, fy


@kernel(fast=True)
def _loads(p, w, k, c, s, c1, s1, c2, s2, product, alpha, beta, harmonics, second, segments):
    """Return coefficient k of the load per mass in head axes, and of its moment per inertia.

    c and s are coefficient k of cosine and sine, c1 and s1 coefficient k - 1, c2 and s2 coefficient k - 2. `product`
    contains coefficient k of S1 c and S1 s.
    """
    if fixed_axes(p) is not None:
        return _loads_along_world(p, w, k, alpha, beta, harmonics, second, segments)
    load, right, start, slope = w.load, w.right, w.wrench[0], w.wrench[1]
    fx, fy = start[0] * c + start[1] * s, start[1] * c - start[0] * s
    moment = start[2] if k == 0 else 0.0
    if segments is not None:
        # coefficients of start + slope t(sigma): alpha slope and beta slope / 2
        fx += alpha * (slope[0] * c1 + slope[1] * s1) + 0.5 * beta * (slope[0] * c2 + slope[1] * s2)
        fy += alpha * (slope[1] * c1 - slope[0] * s1) + 0.5 * beta * (slope[1] * c2 - slope[0] * s2)
        if k == 1:
            moment += alpha * slope[2]
        elif k == 2:
            moment += 0.5 * beta * slope[2]
    if harmonics is not None:
        along_c, along_s = lane(product, 4), lane(product, 7)
        fx += p.direction[0, 0] * along_c + p.direction[0, 1] * along_s
        fy += p.direction[0, 1] * along_c - p.direction[0, 0] * along_s
        moment += load[2, k]
        if second is not None:
            along_c = along_s = 0.0
            for j in range(k + 1):
                along_c += load[1, j] * right[k - j, 6]
                along_s += load[1, j] * right[k - j, 7]
            fx += p.direction[1, 0] * along_c + p.direction[1, 1] * along_s
            fy += p.direction[1, 1] * along_c - p.direction[1, 0] * along_s
    return fx, fy, moment


@kernel(fast=True)
def _loads_along_world(p, w, k, alpha, beta, harmonics, second, segments):
    """Return coefficient k of the load per mass in world axes, and of its moment per inertia."""
    load, start, slope = w.load, w.wrench[0], w.wrench[1]
    held, rising = 1.0 if k == 0 else 0.0, 0.0
    if segments is not None:
        # coefficients of t(sigma): alpha and beta / 2
        rising = alpha if k == 1 else 0.5 * beta if k == 2 else 0.0
    fx, fy = held * start[0] + rising * slope[0], held * start[1] + rising * slope[1]
    moment = held * start[2] + rising * slope[2]
    if harmonics is not None:
        fx += p.direction[0, 0] * load[0, k]
        fy += p.direction[0, 1] * load[0, k]
        moment += load[2, k]
        if second is not None:
            fx += p.direction[1, 0] * load[1, k]
            fy += p.direction[1, 1] * load[1, k]
    return fx, fy, moment


@kernel(fast=True, inline="source")
def _applied(p, along_x, along_y, torque):
    """Return the accelerations that forces (head axes) and moments of the pairs cause, in the lanes of the rates."""
    mass, inertia = p.inverse_mass, p.inverse_inertia
    return three_totals(along_x, along_y, torque) * pack(0.0, 0.0, mass, mass, inertia, 0.0, 0.0, 0.0)


@kernel(fast=True)
def _drag(p, w, k, c, s, x, y, om, dc, ds, dx, dy):
    """Return coefficient k of the accelerations by regularised friction (`_applied`, `model.friction`).

    Let s' be the slip rate, v_s the regularisation speed, r = s' / v_s and tau = tanh(r). Then k tau_k = sum_j j r_j (1
    - tau^2)_{k-j}.
    """
    weighted, tau, rest, drag, arm = w.slip[1], w.slip[2], w.slip[3], w.slip[4], w.slip[5]
    rate = rolled(p, row_values(p.slip_rows, dc, ds, dx, dy), om) * (1.0 / p.slip_speed)
    set_row(w.slip[0], k, rate)
    set_row(arm, k, slip_arms(p, row_values(p.slip_arm_rows, c, s, x, y), k))
    if k == 0:
        for pair in range(PAIR_COUNT):
            tau[0, pair] = math.tanh(lane(rate, pair))
        set_row(rest, 0, row(tau, 0) * row(tau, 0) * -1.0 + 1.0)
        set_row(weighted, 0, splat(0.0))
    else:
        set_row(weighted, k, rate * k)
        older = _multiply_older(weighted, rest, k) + row(weighted, k) * row(rest, 0)
        set_row(tau, k, older * w.inverse[k])
        set_row(rest, k, _multiply(tau, tau, k) * -1.0)
    force = _multiply(w.force, tau, k) * p.friction
    set_row(drag, k, force)
    # the tangent is the normal, rotated by +90 degrees; rows 2 and 3 are minus the normal
    return _applied(
        p, row(p.penetration_rows, 3) * force, row(p.penetration_rows, 2) * force * -1.0, _multiply(arm, drag, k)
    )


@kernel(fast=True)
def _hold_on(p, state, w, k, c, s, x, y, theta, om, dc, ds, dx, dy):
    """Return coefficient k of the accelerations by friction with stick (`_applied`, `solve.grip`)."""
    drag, arm = w.slip[4], w.slip[5]
    rate = rolled(p, row_values(p.slip_rows, dc, ds, dx, dy), om)
    set_row(w.slip[0], k, rate)
    set_row(arm, k, slip_arms(p, row_values(p.slip_arm_rows, c, s, x, y), k))
    force = grip_terms(p, state, w, k, rolled(p, row_values(p.slip_rows, c, s, x, y), theta), rate)
    set_row(drag, k, force)
    return _applied(
        p, row(p.penetration_rows, 3) * force, row(p.penetration_rows, 2) * force * -1.0, _multiply(arm, drag, k)
    )


@kernel(fast=True)
def _slide(p, w, k, om, dc, ds, dx, dy) -> None:
    """Write coefficient k of force times sliding distance per travel to `w.rub[2]`.

    The sliding distance of a corner per travel is the root of q = 1 + (s' / v)^2 (`model.contact.root_terms`).
    """
    sliding, way = w.rub[0], w.rub[1]
    rate = rolled(p, row_values(p.slip_rows, dc, ds, dx, dy), om)
    for pair in range(PAIR_COUNT):
        sliding[k, pair] = lane(rate, pair) * time_per_length(p, pair)
    square = _multiply(sliding, sliding, k)
    if k == 0:
        for pair in range(PAIR_COUNT):
            way[0, pair] = math.sqrt(1.0 + lane(square, pair))
    else:
        twice = square - _multiply_older(way, way, k)
        for pair in range(PAIR_COUNT):
            way[k, pair] = 0.5 * lane(twice, pair) / way[0, pair]
    set_row(w.rub[2], k, _multiply(w.force, way, k))


@kernel(fast=True)
def _run_in(p, state, w, rubbed, k) -> None:
    """Write coefficient k of the product of `rubbed` and the factor of running-in, 1 + a e, to `w.rub[5]`.

    With the wear depth h, e = exp(-h / h0) satisfies k e_k = -(1 / h0) sum_j j h_j e_{k-j}.
    """
    growth, left = w.rub[3], w.rub[4]
    if k == 0:
        set_row(growth, 0, splat(0.0))
        for pair in range(PAIR_COUNT):
            left[0, pair] = p.running_in * math.exp(-state.wear_depth[pair] * p.running_in_rate)
    else:
        set_row(growth, k, row(w.wear, k) * (-p.running_in_rate * k))
        set_row(left, k, (_multiply_older(growth, left, k) + row(growth, k) * row(left, 0)) * w.inverse[k])
    set_row(w.rub[5], k, row(rubbed, k) + _multiply(rubbed, left, k))


@kernel(fast=True)
def _grow(p, w, rubbed, k, alpha, beta) -> None:
    """Write coefficient k + 1 of the increase of each pad's wear depth, dh/dt = k_s F v / A (Archard).

    `rubbed` is the series of F, or the series of F times the factors of sliding and running-in.
    """
    growth = row(rubbed, k) * alpha
    if k > 0:
        growth = growth + row(rubbed, k - 1) * beta
    set_row(w.wear, k + 1, growth * row(p.wear_per_impulse, 0) * w.inverse[k + 1])


@kernel(fast=True, inline="code")
def _wear(p, state, w, k, alpha, beta, om, dc, ds, dx, dy, sliding, running_in) -> None:
    if sliding is not None:
        _slide(p, w, k, om, dc, ds, dx, dy)
        if running_in is not None:
            _run_in(p, state, w, w.rub[2], k)
            _grow(p, w, w.rub[5], k, alpha, beta)
        else:
            _grow(p, w, w.rub[2], k, alpha, beta)
    elif running_in is not None:
        _run_in(p, state, w, w.force, k)
        _grow(p, w, w.rub[5], k, alpha, beta)
    else:
        _grow(p, w, w.force, k, alpha, beta)


@kernel(fast=True, inline="code")
def _slide_size(p, w, k, sliding, running_in):
    """Return the size of coefficient k - 1 (the last known) of the sliding speed of loaded pads."""
    size = 0.0
    if sliding is not None:
        for pair in range(PAIR_COUNT):
            if w.per_pair[ACTS, pair] != 0.0 and p.speed_per_wear != 0.0:
                size += abs(w.rub[1, k - 1, pair]) / time_per_length(p, pair)
    return size


@kernel(inline="source")
def one_by_one(terms):
    """Return the terms as plain tuples, which kernels can unpack: of the load, of the law, and all other terms."""
    load = terms.harmonics, terms.second, terms.segments
    rub = terms.sliding, terms.running_in
    return load, law_terms(terms), terms.wear, rub, terms.offset, terms.free, terms.slip, terms.stick, terms.support


@kernel(fast=True)
def _turn_frame(w, k, there, c, s):
    """Return coefficient k of the frame's displacement and velocity in head axes, in four lanes."""
    u, v, wx, wy = lane(there, FRAME_X), lane(there, FRAME_Y), lane(there, FRAME_VX), lane(there, FRAME_VY)
    left, right = pack(c, s, c, s, c, s, c, s), pack(u, v, v, -u, wx, wy, wy, -wx)
    set_row(w.frame_left[0], k, left)
    set_row(w.frame_right[0], k, right)
    turned = _join(w.frame_left[0], w.frame_right[0], k, left, right)
    x, y = lane(turned, 0) + lane(turned, 1), lane(turned, 2) + lane(turned, 3)
    return pack(x, y, lane(turned, 4) + lane(turned, 5), lane(turned, 6) + lane(turned, 7), 0.0, 0.0, 0.0, 0.0)


@kernel(fast=True)
def _relative_rates(w, k, there, turned, om, turning):
    """Return coefficient k of the rates of the head's cosine, sine and position relative to the frame.

    `turned` is the result of `_turn_frame`: R^T u and R^T w with the frame's displacement u and velocity w, where R
    rotates from head axes to world axes. `turning` contains the rates of the head's position relative to the ground.
    """
    relative = om - lane(there, SPIN)
    left = pack(om, om, relative, relative, 0.0, 0.0, 0.0, 0.0)
    right = pack(
        lane(turned, 1), -lane(turned, 0), -lane(there, RELATIVE_SIN), lane(there, RELATIVE_COS), 0.0, 0.0, 0.0, 0.0
    )
    set_row(w.frame_left[1], k, left)
    set_row(w.frame_right[1], k, right)
    rates = _join(w.frame_left[1], w.frame_right[1], k, left, right)
    dx = lane(turning, X) - (lane(turned, 2) + lane(rates, 0))
    dy = lane(turning, Y) - (lane(turned, 3) + lane(rates, 1))
    return dx, dy, lane(rates, 2), lane(rates, 3)


@kernel(fast=True)
def _push_frame(p, w, k, there, c, s, x, y, dc, ds, pushed):
    """Return coefficient k of the frame's rates under its springs, its dampers and the reactions of the contacts.

    `pushed` contains the head's accelerations by the pairs (`_applied`), whose moment is moved from the head's centre
    of mass (x, y) to the frame's centre.
    """
    fx, fy = lane(pushed, VX) / p.inverse_mass, lane(pushed, VY) / p.inverse_mass
    left, right = pack(c, s, s, c, x, y, 0.0, 0.0), pack(fx, fy, fx, fy, fy, fx, 0.0, 0.0)
    set_row(w.frame_left[2], k, left)
    set_row(w.frame_right[2], k, right)
    turned = _join(w.frame_left[2], w.frame_right[2], k, left, right)
    along_x, along_y = lane(turned, 0) - lane(turned, 1), lane(turned, 2) + lane(turned, 3)
    moment = lane(pushed, OMEGA) / p.inverse_inertia + lane(turned, 4) - lane(turned, 5)
    wx, wy, spin = lane(there, FRAME_VX), lane(there, FRAME_VY), lane(there, SPIN)
    springs, dampers, mobility = p.frame_stiffness, p.frame_damping, p.frame_mobility
    return pack(
        wx,
        wy,
        -springs[0] * lane(there, FRAME_X) - dampers[0] * wx - mobility[0] * along_x,
        -springs[1] * lane(there, FRAME_Y) - dampers[1] * wy - mobility[1] * along_y,
        -springs[2] * lane(there, FRAME_THETA) - dampers[2] * spin - mobility[2] * moment,
        dc,
        ds,
        spin,
    )


@kernel(fast=True, inline="source")
def _turn_of_axes(p):
    """Return the factors of products with omega in the state's rates, four of which are 0 in fixed axes."""
    if fixed_axes(p) is not None:
        return pack(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0)
    return pack(1.0, -1.0, 1.0, -1.0, 0.0, -1.0, 1.0, 0.0)


@kernel(fast=True, inline="code")
def _size(p, w, k, penetrating, sigma_limit, wear, support, sliding, running_in):
    """Return the size of the terms of order k > 0, converted to a velocity."""
    here = w.series[k]
    size = abs(here[VX]) + abs(here[VY]) + p.radius * abs(here[OMEGA]) + p.weight * (abs(here[COS]) + abs(here[SIN]))
    if support is not None:
        there = w.frame[k]
        size += abs(there[FRAME_VX]) + abs(there[FRAME_VY]) + p.radius * abs(there[SPIN])
        size += p.weight * (abs(there[RELATIVE_COS]) + abs(there[RELATIVE_SIN]))
    if wear is not None and penetrating:
        size += p.weight / p.radius * total(magnitude(row(w.wear, k)))
        size += _slide_size(p, w, k, sliding, running_in) / sigma_limit
    return size


@kernel(fast=True)
def expand(
    p,
    state,
    w,
    limit,
    penetrating,
    sigma_limit,
    load_terms,
    law_terms,
    wear,
    rub_terms,
    offset,
    free,
    slip,
    stick,
    support,
):
    """Write the series of state, penetration, rate and force up to order `limit` to `w`. Return their order.

    If no pair is `penetrating`, the contacts are omitted. The series ends early if its terms are negligible at
    `sigma_limit`, the largest sigma of interest.
    """
    alpha, beta = state.alpha, state.beta
    left, right, load, inverse = w.left, w.right, w.load, w.inverse
    here, before, closing, penetration = row(state.y, 0), splat(0.0), splat(0.0), splat(0.0)
    there = there_before = pushed = splat(0.0)
    if support is not None:
        start_frame(state, w)
        here, there = row(w.moved, 0), row(w.frame, 0)
    c1 = s1 = c2 = s2 = 0.0
    small, quiet, reach = _VANISHED * p.threshold[p.order], 0, 1.0
    for k in range(limit + 1):
        set_row(w.series, k, here)
        x, yy, om, c, s = lane(here, X), lane(here, Y), lane(here, OMEGA), lane(here, COS), lane(here, SIN)
        # the contact forces depend on the state relative to the frame
        seen_c, seen_s, seen_x, seen_y = c, s, x, yy
        if support is not None:
            set_row(w.frame, k, there)
            frame_turned = _turn_frame(w, k, there, c, s)
            seen_c, seen_s = lane(there, RELATIVE_COS), lane(there, RELATIVE_SIN)
            seen_x, seen_y = x - lane(frame_turned, 0), yy - lane(frame_turned, 1)
        if k == 0:
            penetration = (
                row_values(p.penetration_rows, seen_c, seen_s, seen_x, seen_y)
                + row(p.penetration_rows, 4)
                - row(state.wear_depth, 0)
            )
        else:
            if not penetrating:
                penetration = row_values(p.penetration_rows, seen_c, seen_s, seen_x, seen_y)
            if wear is not None and penetrating:
                penetration = penetration - row(w.wear, k)
        set_row(w.penetration, k, penetration)
        if k > 0 and load_terms[2] is not None:
            # under sampled loads most series end early
            reach *= sigma_limit
            size = _size(p, w, k, penetrating, sigma_limit, wear, support, *rub_terms)
            w.term_size[k] = size
            quiet = quiet + 1 if size * reach < small else 0
            if quiet == p.lacuna and k >= 4:
                return k
        if k == limit:
            break
        s1_k = 0.0 if load_terms[0] is None else load[0, k]
        turned, turning_by = _turned(here), pack(om, om, om, om, s1_k, om, om, s1_k)
        set_row(right, k, turned)
        set_row(left, k, turning_by)
        product = _join(left, right, k, turning_by, turned)
        turning = product * _turn_of_axes(p)
        turning = turning + _rates_of(here) * pack(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        fx, fy, moment = _loads(p, w, k, c, s, c1, s1, c2, s2, product, alpha, beta, *load_terms)
        if offset is not None:
            # loads act at the cavity's centre, gravity at the centre of mass
            across = p.offset[0] * (fy + p.gravity * c) - p.offset[1] * (fx + p.gravity * s)
            moment -= across * p.inverse_inertia / p.inverse_mass
        applied = pack(0.0, 0.0, fx, fy, moment, 0.0, 0.0, 0.0)
        steady, bent = alpha * inverse[k + 1], beta * inverse[k + 1]
        dx, dy, dc, ds = lane(turning, X), lane(turning, Y), lane(turning, COS), lane(turning, SIN)
        if support is not None:
            dx, dy, dc, ds = _relative_rates(w, k, there, frame_turned, om, turning)
            pushed = splat(0.0)
        if penetrating:
            rate = row_values(p.penetration_rows, dc, ds, dx, dy)
            set_row(w.rate, k, rate)
            arm = row_values(p.arm_rows, seen_c, seen_s, seen_x, seen_y)
            set_row(w.arm, k, arm)
            force = _push(p, state, w, k, penetration, rate, *law_terms)
            set_row(w.force, k, force)
            # rows 2 and 3 of the penetration are minus the inward normals of the walls
            torque = _join(w.arm, w.force, k, arm, force)
            pushed = _applied(
                p, row(p.penetration_rows, 2) * force * -1.0, row(p.penetration_rows, 3) * force * -1.0, torque
            )
            applied = applied + pushed
            if slip is not None:
                dragged = _drag(p, w, k, seen_c, seen_s, seen_x, seen_y, om, dc, ds, dx, dy)
                applied, pushed = applied + dragged, pushed + dragged
            if stick is not None:
                theta = lane(here, THETA)
                dragged = _hold_on(p, state, w, k, seen_c, seen_s, seen_x, seen_y, theta, om, dc, ds, dx, dy)
                applied, pushed = applied + dragged, pushed + dragged
            if wear is not None:
                _wear(p, state, w, k, alpha, beta, om, dc, ds, dx, dy, *rub_terms)
            # the next order of the penetration does not wait for the forces of this order
            penetration = rate * steady + closing * bent
            closing = rate
        if support is not None:
            there_rates = _push_frame(p, w, k, there, c, s, seen_x, seen_y, dc, ds, pushed)
            there = there_rates * steady + there_before * bent
            there_before = there_rates
        if free is not None:
            fx, fy = _hold(p, w, k, lane(applied, VX), lane(applied, VY))
            applied = pack(0.0, 0.0, fx, fy, lane(applied, OMEGA) * p.free[2], 0.0, 0.0, 0.0)
        c2, s2, c1, s1 = c1, s1, c, s
        rates = turning + applied
        here = rates * steady + before * bent
        before = rates
        if k > 0 and load_terms[2] is None:
            # the next order does not depend on the size of this order
            size = _size(p, w, k, penetrating, sigma_limit, wear, support, *rub_terms)
            w.term_size[k] = size
            reach *= sigma_limit
            quiet = quiet + 1 if size * reach < small else 0
            if quiet == p.lacuna and k >= 4:
                return k
    w.term_size[limit] = _size(p, w, limit, penetrating, sigma_limit, wear, support, *rub_terms)
    return limit
