"""Taylor series of the motion with the contact modes frozen.

With the state in body coordinates (`model.geometry`) the equations of motion (paper, eq. 5) are polynomial:

    X'  = VX + omega Y            VX' =  omega VY + c (Fx/m) + s (Fy/m) + sum n_x F/m
    Y'  = VY - omega X            VY' = -omega VX - s (Fx/m) + c (Fy/m) + sum n_y F/m
    c'  = -omega s    s' = omega c    theta' = omega    omega' = M/I + sum arm F/I

so each order of the series follows from the lower ones by Cauchy products (Jorba and Zou, Exp. Math. 14 (2005) 99).
Time runs as t = alpha sigma + beta sigma^2 / 2. With (1, 0) sigma is time; with (0, 2) the root-like start of a contact
force with exponent 1.5 becomes analytic.
"""

from __future__ import annotations

import math

from plow_twin.model.contact import power_term, power_terms
from plow_twin.model.kernel import kernel
from plow_twin.solve.layout import (
    ACTS,
    ALPHA,
    BASE,
    BETA,
    COS,
    DAMPS,
    OMEGA,
    SIN,
    THETA,
    TOUCHING,
    VX,
    VY,
    X,
    Y,
)


@kernel(fast=True)
def expand_harmonics(harmonics, second, t, alpha, beta, order, w) -> None:
    """Write the series of S1, S2 and M to `w.load`.

    sin and cos along t(sigma) follow from one another:  (k+1) sin_{k+1} = omega (alpha cos_k + beta cos_{k-1}).
    """
    load = w.load
    load[:, : order + 1] = 0.0
    for i in range(harmonics.omega.size):
        omega = harmonics.omega[i]
        sine, cosine = math.sin(omega * t), math.cos(omega * t)
        sine_before, cosine_before = 0.0, 0.0
        f0, f1 = harmonics.first[i, 0], harmonics.first[i, 1]
        m0, m1 = harmonics.moment[i, 0], harmonics.moment[i, 1]
        for k in range(order + 1):
            load[0, k] += f0 * sine + f1 * cosine
            load[2, k] += m0 * sine + m1 * cosine
            if second is not None:
                load[1, k] += second[i, 0] * sine + second[i, 1] * cosine
            scale = omega * w.inverse[k + 1]
            new_sine = scale * (alpha * cosine + beta * cosine_before)
            new_cosine = -scale * (alpha * sine + beta * sine_before)
            sine_before, cosine_before = sine, cosine
            sine, cosine = new_sine, new_cosine


# The eight columns of these arrays are SIMD lanes. The lanes are written out and stored last: a store between two loads
# could touch what is loaded, and the compiler would not dare to put them side by side.


@kernel(fast=True)
def _multiply_older(a, b, k, out) -> None:
    """Write order k of the eight products of the columns of a and b, without the two terms of order k itself, to `out`.

    These sums do not wait for the newest order, so that the processor can run them ahead.
    """
    t0 = t1 = t2 = t3 = t4 = t5 = t6 = t7 = 0.0
    for j in range(1, k):
        i = k - j
        t0 += a[j, 0] * b[i, 0]
        t1 += a[j, 1] * b[i, 1]
        t2 += a[j, 2] * b[i, 2]
        t3 += a[j, 3] * b[i, 3]
        t4 += a[j, 4] * b[i, 4]
        t5 += a[j, 5] * b[i, 5]
        t6 += a[j, 6] * b[i, 6]
        t7 += a[j, 7] * b[i, 7]
    out[k, 0], out[k, 1], out[k, 2], out[k, 3] = t0, t1, t2, t3
    out[k, 4], out[k, 5], out[k, 6], out[k, 7] = t4, t5, t6, t7


@kernel(fast=True)
def _multiply(a, b, k, out) -> None:
    """Write order k of the eight products of the columns of a and b to row k of `out`."""
    _multiply_older(a, b, k, out)
    both = 0.0 if k == 0 else 1.0
    t0 = out[k, 0] + a[0, 0] * b[k, 0] + both * a[k, 0] * b[0, 0]
    t1 = out[k, 1] + a[0, 1] * b[k, 1] + both * a[k, 1] * b[0, 1]
    t2 = out[k, 2] + a[0, 2] * b[k, 2] + both * a[k, 2] * b[0, 2]
    t3 = out[k, 3] + a[0, 3] * b[k, 3] + both * a[k, 3] * b[0, 3]
    t4 = out[k, 4] + a[0, 4] * b[k, 4] + both * a[k, 4] * b[0, 4]
    t5 = out[k, 5] + a[0, 5] * b[k, 5] + both * a[k, 5] * b[0, 5]
    t6 = out[k, 6] + a[0, 6] * b[k, 6] + both * a[k, 6] * b[0, 6]
    t7 = out[k, 7] + a[0, 7] * b[k, 7] + both * a[k, 7] * b[0, 7]
    out[k, 0], out[k, 1], out[k, 2], out[k, 3] = t0, t1, t2, t3
    out[k, 4], out[k, 5], out[k, 6], out[k, 7] = t4, t5, t6, t7


@kernel(fast=True)
def _combine(rows, c, s, x, y, k, out) -> None:
    """Write rows . (c, s, x, y) to row k of `out`."""
    t0 = rows[0, 0] * c + rows[1, 0] * s + rows[2, 0] * x + rows[3, 0] * y
    t1 = rows[0, 1] * c + rows[1, 1] * s + rows[2, 1] * x + rows[3, 1] * y
    t2 = rows[0, 2] * c + rows[1, 2] * s + rows[2, 2] * x + rows[3, 2] * y
    t3 = rows[0, 3] * c + rows[1, 3] * s + rows[2, 3] * x + rows[3, 3] * y
    t4 = rows[0, 4] * c + rows[1, 4] * s + rows[2, 4] * x + rows[3, 4] * y
    t5 = rows[0, 5] * c + rows[1, 5] * s + rows[2, 5] * x + rows[3, 5] * y
    t6 = rows[0, 6] * c + rows[1, 6] * s + rows[2, 6] * x + rows[3, 6] * y
    t7 = rows[0, 7] * c + rows[1, 7] * s + rows[2, 7] * x + rows[3, 7] * y
    out[k, 0], out[k, 1], out[k, 2], out[k, 3] = t0, t1, t2, t3
    out[k, 4], out[k, 5], out[k, 6], out[k, 7] = t4, t5, t6, t7


@kernel(fast=True)
def _weigh(a, weight_a, b, weight_b, k, out) -> None:
    """Write weight_a a + weight_b b, lane by lane, to row k of `out`."""
    t0 = weight_a[0] * a[k, 0] + weight_b[0] * b[k, 0]
    t1 = weight_a[1] * a[k, 1] + weight_b[1] * b[k, 1]
    t2 = weight_a[2] * a[k, 2] + weight_b[2] * b[k, 2]
    t3 = weight_a[3] * a[k, 3] + weight_b[3] * b[k, 3]
    t4 = weight_a[4] * a[k, 4] + weight_b[4] * b[k, 4]
    t5 = weight_a[5] * a[k, 5] + weight_b[5] * b[k, 5]
    t6 = weight_a[6] * a[k, 6] + weight_b[6] * b[k, 6]
    t7 = weight_a[7] * a[k, 7] + weight_b[7] * b[k, 7]
    out[k, 0], out[k, 1], out[k, 2], out[k, 3] = t0, t1, t2, t3
    out[k, 4], out[k, 5], out[k, 6], out[k, 7] = t4, t5, t6, t7


@kernel(fast=True)
def _raise(w, k, touching, exponent) -> None:
    """Write order k of penetration^exponent of the pairs that act to `w.power[0]`."""
    power_terms(w.gap, w.power[0], k, exponent, w.lanes[BASE])
    if k == 0:
        for lane in range(8):
            w.power[0, 0, lane] = w.gap[0, lane] ** exponent if w.lanes[BASE, lane] != 0.0 else 0.0
    if touching != 0:
        for lane in range(8):
            if touching >> lane & 1:
                w.power[0, k, lane] = power_term(w.gap, w.power[0], lane, k, exponent, 2)


@kernel(fast=True)
def _damp(elastic, w, k, factor) -> None:
    """Write order k of K elastic (1 + lambda d') to `w.force`."""
    if factor is not None:
        _multiply(elastic, w.rate, k, w.damped)
    _weigh(elastic, w.lanes[ACTS], w.damped, w.lanes[DAMPS], k, w.force)


@kernel(fast=True)
def _push(state, w, k, viscous, factor, integer, fraction) -> None:
    """Write order k of the eight contact forces (`model.contact`), zero for pairs that do not act.

    Row ACTS of `w.lanes` is K for pairs that act, row DAMPS is C or K lambda; both are zero for the others.
    """
    if viscous is not None:
        _weigh(w.gap, w.lanes[ACTS], w.rate, w.lanes[DAMPS], k, w.force)
    elif integer is not None:
        _multiply(w.gap, w.gap, k, w.power[0])
        for degree in range(1, integer - 1):
            _multiply(w.power[degree - 1], w.gap, k, w.power[degree])
        _damp(w.power[integer - 2], w, k, factor)
    elif fraction is not None:
        _raise(w, k, state.step[TOUCHING], fraction)
        _damp(w.power[0], w, k, factor)
    else:
        _damp(w.gap, w, k, factor)


@kernel(fast=True)
def _hold(w, k, free, fx, fy):
    """Return order k of the force per mass in head axes without what acts along a locked world axis."""
    w.world[0, k], w.world[1, k] = fx, fy
    right, world = w.right, w.world
    along_x = along_y = 0.0
    for j in range(k + 1):
        along_x += right[k - j, 5] * world[0, j] - right[k - j, 4] * world[1, j]
        along_y += right[k - j, 4] * world[0, j] + right[k - j, 5] * world[1, j]
    world[2, k], world[3, k] = free[0] * along_x, free[1] * along_y
    fx = fy = 0.0
    for j in range(k + 1):
        fx += right[k - j, 5] * world[2, j] + right[k - j, 4] * world[3, j]
        fy += right[k - j, 5] * world[3, j] - right[k - j, 4] * world[2, j]
    return fx, fy


@kernel(fast=True)
def _loads(p, w, k, c, s, c1, s1, c2, s2, alpha, beta, harmonics, second, segments):
    """Return order k of the load per mass, turned into head axes, and of its moment per inertia.

    c, s are the orders k of cosine and sine, c1, s1 and c2, s2 those one and two before.
    """
    load, product, right, start, slope = w.load, w.product, w.right, w.wrench[0], w.wrench[1]
    fx, fy = start[0] * c + start[1] * s, start[1] * c - start[0] * s
    moment = start[2] if k == 0 else 0.0
    if segments is not None:
        # wrench start + slope t(sigma): its own series has the terms alpha slope and beta slope / 2
        fx += alpha * (slope[0] * c1 + slope[1] * s1) + 0.5 * beta * (slope[0] * c2 + slope[1] * s2)
        fy += alpha * (slope[1] * c1 - slope[0] * s1) + 0.5 * beta * (slope[1] * c2 - slope[0] * s2)
        if k == 1:
            moment += alpha * slope[2]
        elif k == 2:
            moment += 0.5 * beta * slope[2]
    if harmonics is not None:
        along_c = product[k, 6] + load[0, 0] * c
        along_s = product[k, 7] + load[0, 0] * s
        if k > 0:
            along_c += load[0, k] * right[0, 6]
            along_s += load[0, k] * right[0, 7]
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
def _resultant(p, w, k):
    """Return order k of the sum of the contact forces in head axes, and of their moment about the centre of mass."""
    rows, force, torque = p.gap, w.force, w.torque
    _multiply(w.arm, force, k, torque)
    push_x = push_y = moment = 0.0
    for lane in range(8):
        # the rows for X and Y are the walls' inward normals
        push_x -= rows[2, lane] * force[k, lane]
        push_y -= rows[3, lane] * force[k, lane]
        moment += torque[k, lane]
    return push_x, push_y, moment


@kernel(fast=True)
def _wear(w, k, wear, alpha, beta) -> None:
    """Write order k + 1 of the growth of each pad's depth:  dh/dt = k_s F v / A (Archard)."""
    for lane in range(8):
        before = w.force[k - 1, lane] if k > 0 else 0.0
        growth = wear[lane] * (alpha * w.force[k, lane] + beta * before)
        w.worn[k + 1, lane] = growth * w.inverse[k + 1]


@kernel(fast=True)
def expand(
    p, state, w, penetrating, hard, harmonics, second, segments, viscous, factor, integer, fraction, wear, offset, free
):
    """Write the series of state, penetration, rate and force to `w`; return the order used.

    Without `penetrating` no pair is deeper than zero and nothing of the contact is computed. `hard` is the longest
    sigma of interest: orders whose terms vanish there are not computed.
    """
    y, alpha, beta = state.y, state.clock[ALPHA], state.clock[BETA]
    series, left, right, product, gap, worn = w.series, w.left, w.right, w.product, w.gap, w.worn
    load, inverse, A = w.load, w.inverse, p.gap
    im, ii = p.inverse_mass, p.inverse_inertia
    x, yy, vx, vy, om, c, s, theta = y[X], y[Y], y[VX], y[VY], y[OMEGA], y[COS], y[SIN], y[THETA]
    x0, y0, vx0, vy0, om0, c0, s0 = x, yy, vx, vy, om, c, s
    # rates of the order before, for the sigma term of the time map
    px = py = pvx = pvy = pom = pc = ps = pth = 0.0
    c1 = s1 = c2 = s2 = 0.0
    small, quiet, reach, order = 0.4 * p.threshold[p.order], 0, 1.0, p.order
    for k in range(order + 1):
        series[k, X], series[k, Y], series[k, VX], series[k, VY] = x, yy, vx, vy
        series[k, OMEGA], series[k, COS], series[k, SIN], series[k, THETA] = om, c, s, theta
        _combine(A, c, s, x, yy, k, gap)
        if k == 0:
            for lane in range(8):
                gap[0, lane] += A[4, lane] - state.depth[lane]
        else:
            size = abs(vx) + abs(vy) + p.radius * abs(om) + p.weight * (abs(c) + abs(s))
            if wear is not None and penetrating:
                for lane in range(8):
                    gap[k, lane] -= worn[k, lane]
                    size += p.weight / p.radius * abs(worn[k, lane])
            w.size[k] = size
            reach *= hard
            quiet = quiet + 1 if size * reach < small else 0
            if quiet == p.lacuna and k >= 4:
                order = k
                break
        if k == order:
            break
        right[k, 0], right[k, 1], right[k, 2], right[k, 3] = yy, x, vy, vx
        right[k, 4], right[k, 5], right[k, 6], right[k, 7] = s, c, c, s
        left[k, 0] = left[k, 1] = left[k, 2] = left[k, 3] = left[k, 4] = left[k, 5] = om
        if harmonics is not None:
            left[k, 6] = left[k, 7] = load[0, k]
        _multiply_older(left, right, k, product)
        # omega times the others: the terms of order k itself, and those between
        om_k = 0.0 if k == 0 else om
        dx = vx + (product[k, 0] + om0 * yy + om_k * y0)
        dy = vy - (product[k, 1] + om0 * x + om_k * x0)
        dc = -(product[k, 4] + om0 * s + om_k * s0)
        ds = product[k, 5] + om0 * c + om_k * c0
        fx, fy, moment = _loads(p, w, k, c, s, c1, s1, c2, s2, alpha, beta, harmonics, second, segments)
        if offset is not None:
            # the loads' moment is about the cavity's centre, gravity acts at the centre of mass
            moment -= (offset[0] * (fy + p.gravity * c) - offset[1] * (fx + p.gravity * s)) * ii / im
        if penetrating:
            _combine(A, dc, ds, dx, dy, k, w.rate)
            _combine(p.arm, c, s, x, yy, k, w.arm)
            _push(state, w, k, viscous, factor, integer, fraction)
            push_x, push_y, torque = _resultant(p, w, k)
            fx += push_x * im
            fy += push_y * im
            moment += torque * ii
            if wear is not None:
                _wear(w, k, wear, alpha, beta)
        if free is not None:
            moment *= free[2]
            fx, fy = _hold(w, k, free, fx, fy)
        dvx = fx + (product[k, 2] + om0 * vy + om_k * vy0)
        dvy = fy - (product[k, 3] + om0 * vx + om_k * vx0)
        c2, s2, c1, s1 = c1, s1, c, s
        q = inverse[k + 1]
        x, px = (alpha * dx + beta * px) * q, dx
        yy, py = (alpha * dy + beta * py) * q, dy
        theta, pth = (alpha * om + beta * pth) * q, om
        vx, pvx = (alpha * dvx + beta * pvx) * q, dvx
        vy, pvy = (alpha * dvy + beta * pvy) * q, dvy
        om, pom = (alpha * moment + beta * pom) * q, moment
        c, pc = (alpha * dc + beta * pc) * q, dc
        s, ps = (alpha * ds + beta * ps) * q, ds
    return order
