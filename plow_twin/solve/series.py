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

from plow_twin.model.contact import power_term
from plow_twin.model.kernel import kernel
from plow_twin.solve.layout import (
    ALPHA,
    BETA,
    COS,
    OMEGA,
    ON,
    SIN,
    THETA,
    TOUCHING,
    VX,
    VY,
    X,
    Y,
)


@kernel(fast=True)
def expand_harmonics(harmonics, second, t, alpha, beta, order, w) -> None:  # type: ignore[no-untyped-def]
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


@kernel(fast=True)
def expand(p, state, w, active, count, start, slope, hard, harmonics, second, viscous, factor, integer, fraction, wear, offset, free):  # type: ignore[no-untyped-def]  # noqa: E501
    """Write the series of state, penetration, rate and force to `w`; return the order used.

    `active` holds the `count` pairs that penetrate; `start` and `slope` (3,) are the wrench that is linear in time, per
    mass and inertia; `hard` is the longest sigma of interest: orders whose terms vanish there are not computed.
    """
    y, mode, clock = state.y, state.mode, state.clock
    alpha, beta = clock[ALPHA], clock[BETA]
    series, left, right, gap, force, rate, arm = w.series, w.left, w.right, w.gap, w.force, w.rate, w.arm
    load, inverse, depth = w.load, w.inverse, state.depth
    A, B = p.gap, p.arm
    im, ii, K = p.inverse_mass, p.inverse_inertia, p.stiffness
    touching = state.step[TOUCHING]
    d0x, d0y, d1x, d1y = p.direction[0, 0], p.direction[0, 1], p.direction[1, 0], p.direction[1, 1]
    x, yy, vx, vy, om, c, s = y[X], y[Y], y[VX], y[VY], y[OMEGA], y[COS], y[SIN]
    theta = y[THETA]
    px = py = pvx = pvy = pom = pc = ps = pth = 0.0
    c1 = s1 = c2 = s2 = 0.0
    weight = p.radius * p.velocity_tolerance / p.position_tolerance
    small = 0.02 * p.velocity_tolerance
    quiet, reach = 0, 1.0
    order = p.order
    for k in range(order + 1):
        series[k, X], series[k, Y], series[k, VX], series[k, VY] = x, yy, vx, vy
        series[k, OMEGA], series[k, COS], series[k, SIN], series[k, THETA] = om, c, s, theta
        for lane in range(8):
            gap[k, lane] = A[0, lane] * c + A[1, lane] * s + A[2, lane] * x + A[3, lane] * yy
        if k == 0:
            for lane in range(8):
                gap[0, lane] += A[4, lane] - depth[lane]
        elif wear is not None:
            for i in range(count):
                gap[k, active[i]] -= w.worn[active[i], k]
        if k > 0:
            reach *= hard
            size = abs(vx) + abs(vy) + p.radius * abs(om) + weight * (abs(c) + abs(s))
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
        a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = 0.0
        for j in range(k + 1):
            i = k - j
            a0 += left[j, 0] * right[i, 0]
            a1 += left[j, 1] * right[i, 1]
            a2 += left[j, 2] * right[i, 2]
            a3 += left[j, 3] * right[i, 3]
            a4 += left[j, 4] * right[i, 4]
            a5 += left[j, 5] * right[i, 5]
            a6 += left[j, 6] * right[i, 6]
            a7 += left[j, 7] * right[i, 7]
        dx, dy, dc, ds = vx + a0, vy - a1, -a4, a5
        # loads, turned into head axes
        fx = start[0] * c + start[1] * s
        fy = start[1] * c - start[0] * s
        moment = start[2] if k == 0 else 0.0
        if slope is not None:
            # wrench start + slope t(sigma): its own series has the terms alpha slope and beta slope / 2
            fx += alpha * (slope[0] * c1 + slope[1] * s1) + 0.5 * beta * (slope[0] * c2 + slope[1] * s2)
            fy += alpha * (slope[1] * c1 - slope[0] * s1) + 0.5 * beta * (slope[1] * c2 - slope[0] * s2)
            moment += (alpha * slope[2] if k == 1 else 0.0) + (0.5 * beta * slope[2] if k == 2 else 0.0)
        if harmonics is not None:
            fx += d0x * a6 + d0y * a7
            fy += d0y * a6 - d0x * a7
            moment += load[2, k]
            if second is not None:
                b6 = b7 = 0.0
                for j in range(k + 1):
                    b6 += load[1, j] * right[k - j, 6]
                    b7 += load[1, j] * right[k - j, 7]
                fx += d1x * b6 + d1y * b7
                fy += d1y * b6 - d1x * b7
        if offset is not None:
            # the loads' moment is about the cavity's centre, gravity acts at the centre of mass
            moment -= (offset[0] * (fy + p.gravity * c) - offset[1] * (fx + p.gravity * s)) * ii / im
        # contact forces along the walls' normals
        for i in range(count):
            pair = active[i]
            d = gap[k, pair]
            r = A[0, pair] * dc + A[1, pair] * ds + A[2, pair] * dx + A[3, pair] * dy
            rate[pair, k] = r
            f = 0.0
            if mode[pair] == ON:
                if viscous is not None:
                    f = K * d + viscous * r
                else:
                    power = w.power[pair]
                    if integer is not None:
                        power[0, k] = d
                        for degree in range(1, integer):
                            total = 0.0
                            for j in range(k + 1):
                                total += power[degree - 1, j] * power[0, k - j]
                            power[degree, k] = total
                        base = power[integer - 1]
                        elastic = base[k]
                    elif fraction is not None:
                        base, bare = power[1], power[2]
                        power[0, k] = d
                        if touching >> pair & 1:
                            # d = sigma^2 (...): d^1.5 = sigma^3 (...)^1.5
                            base[k] = 0.0 if k < 3 else power_term(power[0], bare, k - 3, fraction, 2)
                        else:
                            base[k] = power_term(power[0], base, k, fraction, 0)
                        elastic = base[k]
                    else:
                        base = power[0]
                        base[k] = d
                        elastic = d
                    f = elastic
                    if factor is not None:
                        total = 0.0
                        for j in range(k + 1):
                            total += base[j] * rate[pair, k - j]
                        f += state.factor[pair] * total
                    f *= K
                force[pair, k] = f
                arm[pair, k] = B[0, pair] * c + B[1, pair] * s + B[2, pair] * x + B[3, pair] * yy
                torque = 0.0
                for j in range(k + 1):
                    torque += arm[pair, j] * force[pair, k - j]
                fx -= A[2, pair] * f * im
                fy -= A[3, pair] * f * im
                moment += ii * torque
                if wear is not None:
                    before = force[pair, k - 1] if k > 0 else 0.0
                    w.worn[pair, k + 1] = wear[pair] * (alpha * f + beta * before) * inverse[k + 1]
            elif wear is not None:
                w.worn[pair, k + 1] = 0.0
        if free is not None:
            moment *= free[2]
            if free[0] * free[1] == 0.0:
                # hold world axes: turn the force to world axes, drop what is locked, turn back
                w.scratch[0, k], w.scratch[1, k] = fx, fy
                wx = wy = 0.0
                for j in range(k + 1):
                    wx += right[k - j, 5] * w.scratch[0, j] - right[k - j, 4] * w.scratch[1, j]
                    wy += right[k - j, 4] * w.scratch[0, j] + right[k - j, 5] * w.scratch[1, j]
                w.world[0, k], w.world[1, k] = free[0] * wx, free[1] * wy
                fx = fy = 0.0
                for j in range(k + 1):
                    fx += right[k - j, 5] * w.world[0, j] + right[k - j, 4] * w.world[1, j]
                    fy += right[k - j, 5] * w.world[1, j] - right[k - j, 4] * w.world[0, j]
        dvx, dvy = fx + a2, fy - a3
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
