"""Taylor series of eight scenes with fixed contact modes. `method.series` contains the equations.

If the contact force is linear in penetration and rate, the sum over a scene's acting pairs is one affine map of the
state, and an order needs twelve Cauchy products. For each slot of acting pairs (`record`), the force K d (1 + lambda
d') = K (d + lambda / 2 (d^2)') adds half a product, the force K d^n (1 + lambda d') adds two or three, and friction
three more.
"""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, magnitude, set_row, square_root
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import DC, DS, DX, DY, MOST_LACUNA, WIDTH, linear_at, penetration_at
from plow_twin.solve.lanes.waves import coarse_exp2, coarse_log2, turn_lanes
from plow_twin.solve.method.step_size import FARTHEST_TO_POLE
from plow_twin.solve.method.taylor import FURTHEST
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, X, Y

#: Largest usable term of a series, whose products are finite.
_FINITE = 1e300
#: Lowest order at which a series with negligible terms may end.
_FEWEST_ORDERS = 4
_ALL = 2**WIDTH - 1


@kernel()
def _gather_harmonic(harmonics, extent, lanes, i) -> None:
    """Write the harmonic load with index `i` of each lane to `lanes.harmonic`, or zeros beyond the last load."""
    there = lanes.harmonic
    for lane in range(WIDTH):
        member = lanes.member[lane]
        if member >= 0 and i < extent[member, 1]:
            harmonic = harmonics[extent[member, 0] + i]
            there[0, lane], there[9, lane] = harmonic.omega, harmonic.omega * lanes.time[lane]
            for j in range(2):
                there[3 + j, lane], there[5 + j, lane] = harmonic.first[j], harmonic.second[j]
                there[7 + j, lane] = harmonic.moment[j]
        else:
            for j in range(10):
                there[j, lane] = 0.0
    turn_lanes(there[9], there[2], there[1])


@kernel()
def _add_wave(load, k, lanes, first, sine, cosine) -> None:
    """Add coefficient k of a harmonic load to `load`. The row `first` of `lanes.harmonic` is its first amplitude."""
    wave = fused(exact_row(lanes.harmonic, first), sine, exact_row(load, k))
    set_row(load, k, fused(exact_row(lanes.harmonic, first + 1), cosine, wave))


@kernel()
def expand_loads(harmonics, extent, second, fraction, lanes, w, order) -> None:
    """Write the series of the harmonic loads S1, S2 and M of each lane's scene.

    `extent`, shape (n, 2), contains the index of each scene's first harmonic load and the number of its harmonic loads.
    """
    zero, most = exact_splat(0.0), 0
    alpha, beta = exact_row(lanes.alpha, 0), exact_row(lanes.beta, 0)
    for k in range(order):
        for j in range(3):
            set_row(lanes.load[j], k, zero)
    for lane in range(WIDTH):
        if lanes.member[lane] >= 0:
            most = max(most, extent[lanes.member[lane], 1])
    for i in range(most):
        _gather_harmonic(harmonics, extent, lanes, i)
        omega, sine, cosine = (exact_row(lanes.harmonic, 0), exact_row(lanes.harmonic, 1), exact_row(lanes.harmonic, 2))
        sine_before = cosine_before = zero
        for k in range(order):
            _add_wave(lanes.load[0], k, lanes, 3, sine, cosine)
            if second is not None:
                _add_wave(lanes.load[1], k, lanes, 5, sine, cosine)
            _add_wave(lanes.load[2], k, lanes, 7, sine, cosine)
            scale = omega * w.inverse[k + 1]
            if fraction is None:
                sine, cosine = scale * cosine, scale * -1.0 * sine
            else:
                new_sine = scale * fused(alpha, cosine, beta * cosine_before)
                new_cosine = scale * fused(alpha, sine, beta * sine_before) * -1.0
                sine_before, cosine_before, sine, cosine = sine, cosine, new_sine, new_cosine


@kernel()
def expand(lanes, w, limit, waves, second, viscous, hysteretic, power, fraction, slip, segments) -> int:
    """Write the series of the state, and return the order.

    Under sampled loads, the series of a lane ends at the order from which its terms are negligible over the longest
    admissible step. Its higher terms are zero, so that the bits of a lane do not depend on the orders of other lanes.
    """
    series, moment = lanes.series, lanes.moment
    zero = exact_splat(0.0)
    x0, y0, vx0, vy0 = (exact_row(lanes.y, X), exact_row(lanes.y, Y), exact_row(lanes.y, VX), exact_row(lanes.y, VY))
    om0, c0, s0, angle = (
        exact_row(lanes.y, OMEGA), exact_row(lanes.y, COS), exact_row(lanes.y, SIN), exact_row(lanes.y, THETA),
    )  # fmt: skip
    x, y, vx, vy, om, c, s = x0, y0, vx0, vy0, om0, c0, s0
    start_x, start_y, turned_at = (
        exact_row(lanes.constant, 0),
        exact_row(lanes.constant, 1),
        exact_row(lanes.constant, 2),
    )
    active = calm = history = 0
    recent = tested(power)
    alpha, beta = exact_row(lanes.alpha, 0), exact_row(lanes.beta, 0)
    older_c = older_s = x_rate = y_rate = vx_rate = vy_rate = om_rate = c_rate = s_rate = angle_rate = zero
    before_c = before_s = zero
    reach = exact_splat(1.0)
    if segments is not None:
        start_x, start_y, turned_at = exact_row(lanes.held, 0), exact_row(lanes.held, 1), exact_row(lanes.held, 2)
        active, lanes.vanished[0] = lanes.live[0], 0
    m, i = exact_row(lanes.inverse_mass, 0), exact_row(lanes.inverse_inertia, 0)
    if power is not None:
        # `_push_by_power` returns forces divided by K
        m, i = m * exact_row(lanes.stiffness, 0), i * exact_row(lanes.stiffness, 0)
    along, turn, load, direction = lanes.along, lanes.turn, lanes.load, lanes.direction
    order = limit
    for k in range(limit):
        _set_state(series, k, x, y, vx, vy, om, c, s, angle)
        if segments is not None and k > 0:
            reach = reach * exact_row(lanes.whole, 0)
            quiet = below(_size(lanes, vx, vy, om, c, s) * reach, exact_row(lanes.small, 0))
            if power is not None:
                calm, history = _long_quiet(history), history << WIDTH | quiet
            if k >= _FEWEST_ORDERS and quiet & calm & active != 0:
                active = _end_series(lanes, active, quiet & calm, k)
                if active == 0:
                    order = k
                    break
            if power is None:
                calm = quiet
        # the highest orders are added last, so that the sum can start before they are available
        px = py = pvx = pvy = pc = ps = wc = ws = torque_c = torque_s = torque_x = torque_y = zero
        for j in range(1, k):
            # each coefficient is loaded once for all products
            turned, cosine, sine = (
                exact_row(series[OMEGA], j),
                exact_row(series[COS], k - j),
                exact_row(series[SIN], k - j),
            )
            pc, ps = fused(turned, cosine, pc), fused(turned, sine, ps)
            torque_c = fused(exact_row(moment[DC], j), cosine, torque_c)
            torque_s = fused(exact_row(moment[DS], j), sine, torque_s)
            if waves is not None:
                load_coefficient = exact_row(load[0], j)
                wc, ws = fused(load_coefficient, cosine, wc), fused(load_coefficient, sine, ws)
            along_x, along_y = exact_row(series[X], k - j), exact_row(series[Y], k - j)
            px, py = fused(turned, along_x, px), fused(turned, along_y, py)
            torque_x = fused(exact_row(moment[DX], j), along_x, torque_x)
            torque_y = fused(exact_row(moment[DY], j), along_y, torque_y)
            pvx = fused(turned, exact_row(series[VX], k - j), pvx)
            pvy = fused(turned, exact_row(series[VY], k - j), pvy)
        torque, other = torque_c + torque_x, torque_s + torque_y
        share = 0.0 if k == 0 else 1.0  # order 0 has only one product, which must not be added twice
        early = om0 * share
        px, py = fused(om, x0, fused(early, x, px)), fused(om, y0, fused(early, y, py))
        pvx, pvy = fused(om, vx0, fused(early, vx, pvx)), fused(om, vy0, fused(early, vy, pvy))
        pc, ps = fused(om, c0, fused(early, c, pc)), fused(om, s0, fused(early, s, ps))
        dx, dy, dc, ds = vx + py, vy - px, ps * -1.0, pc
        if segments is not None and active != _ALL:
            dx, dy, dc, ds = (
                choose(active, dx, zero), choose(active, dy, zero), choose(active, dc, zero), choose(active, ds, zero),
            )  # fmt: skip
        ax, ay = fused(start_x, c, fused(start_y, s, pvy)), fused(start_y, c, (fused(start_x, s, pvx)) * -1.0)
        turned_by = turned_at * (1.0 - share)
        if segments is not None:
            rise_x, rise_y = exact_row(lanes.slope, 0), exact_row(lanes.slope, 1)
            ax = fused(rise_x, before_c, fused(rise_y, before_s, ax))
            ay = fused(rise_y, before_c, fused(rise_x, before_s * -1.0, ay))
            if fraction is None:
                if k == 1:
                    turned_by = exact_row(lanes.slope, 2)
                before_c, before_s = c, s
            else:
                # coefficients of the time t(sigma): alpha and beta / 2
                if k == 1:
                    turned_by = exact_row(lanes.slope, 2) * alpha
                if k == 2:
                    turned_by = exact_row(lanes.slope, 2) * beta * 0.5
                before_c, before_s = fused(alpha, c, beta * older_c * 0.5), fused(alpha, s, beta * older_s * 0.5)
                older_c, older_s = c, s
        if waves is not None:
            wc, ws = _add_ends(load[0], k, c0, s0, c, s, share, wc, ws)
            ax = fused(exact_row(direction, 0), wc, fused(exact_row(direction, 1), ws, ax))
            ay = fused(exact_row(direction, 1), wc, fused(exact_row(direction, 0), ws * -1.0, ay))
            if second is not None:
                wc = ws = zero
                for j in range(1, k):
                    load_coefficient = exact_row(load[1], j)
                    wc = fused(load_coefficient, exact_row(series[COS], k - j), wc)
                    ws = fused(load_coefficient, exact_row(series[SIN], k - j), ws)
                wc, ws = _add_ends(load[1], k, c0, s0, c, s, share, wc, ws)
                ax = fused(exact_row(direction, 2), wc, fused(exact_row(direction, 3), ws, ax))
                ay = fused(exact_row(direction, 3), wc, fused(exact_row(direction, 2), ws * -1.0, ay))
            turned_by = turned_by + exact_row(load[2], k)
        acts = _ALL
        if segments is not None:
            acts = active
        if power is not None:
            if fraction is not None:
                _set_rates(lanes, k, dx, dy, dc, ds)
            fx, fy, gc, gs = _push_by_power(
                lanes, w, k, acts, hysteretic, fraction, slip, c, s, x, y, dc, ds, dx, dy, alpha, beta
            )
        elif hysteretic is not None or slip is not None or k == 0:
            # the first forces are computed from the same penetrations as the guard functions; the summed maps
            # (`record._weigh_lanes`) have different rounding, so the force would begin 1e-17 m away from the event
            fx, fy, gc, gs = _push(lanes, w, k, acts, viscous, hysteretic, slip, c, s, x, y, dc, ds, dx, dy)
        else:
            fx = _force(along[0], viscous, c, s, x, dc, ds, dx)
            fy = _force(along[1], viscous, c, s, y, dc, ds, dy)
            gc = _lever(turn[0], viscous, c, s, x, y, dc, ds, dx, dy)
            gs = _lever(turn[1], viscous, c, s, x, y, dc, ds, dx, dy)
        gx, gy = fy * -1.0, fx
        set_row(moment[DC], k, gc)
        set_row(moment[DS], k, gs)
        set_row(moment[DX], k, gx)
        set_row(moment[DY], k, gy)
        torque = fused(c * share, exact_row(moment[DC], 0), fused(x * share, exact_row(moment[DX], 0), torque))
        other = fused(s * share, exact_row(moment[DS], 0), fused(y * share, exact_row(moment[DY], 0), other))
        torque = fused(c0, gc, fused(x0, gx, torque)) + fused(s0, gs, fused(y0, gy, other))
        ax, ay, turned_by = fused(m, fx, ax), fused(m, fy, ay), fused(i, torque, turned_by)
        if segments is not None and active != _ALL:
            ax, ay, turned_by = choose(active, ax, zero), choose(active, ay, zero), choose(active, turned_by, zero)
            om = choose(active, om, zero)
        part = w.inverse[k + 1]
        if fraction is None:
            x, y, vx, vy, c, s = dx * part, dy * part, ax * part, ay * part, dc * part, ds * part
            angle, om = om * part, turned_by * part
        else:
            steady, bent = alpha * part, beta * part
            x, x_rate, y, y_rate = fused(dx, steady, x_rate * bent), dx, fused(dy, steady, y_rate * bent), dy
            vx, vx_rate, vy, vy_rate = fused(ax, steady, vx_rate * bent), ax, fused(ay, steady, vy_rate * bent), ay
            c, c_rate, s, s_rate = fused(dc, steady, c_rate * bent), dc, fused(ds, steady, s_rate * bent), ds
            angle, angle_rate = fused(om, steady, angle_rate * bent), om
            om, om_rate = fused(turned_by, steady, om_rate * bent), turned_by
            if segments is not None and active != _ALL:
                x, y, vx, vy = (
                    choose(active, x, zero), choose(active, y, zero), choose(active, vx, zero),
                    choose(active, vy, zero),
                )  # fmt: skip
                c, s, om, angle = (
                    choose(active, c, zero), choose(active, s, zero), choose(active, om, zero),
                    choose(active, angle, zero),
                )  # fmt: skip
        if k >= limit - recent:
            set_row(lanes.size, k - (limit - recent), _size(lanes, vx, vy, om, c, s))
    _set_state(series, order, x, y, vx, vy, om, c, s, angle)
    return order


@kernel(inline="code")
def tested(power) -> int:
    """Return the number of last orders that determine the size of a step."""
    if power is None:
        return 2
    return MOST_LACUNA


@kernel(inline="code")
def _long_quiet(history) -> int:
    """Return a bit mask of the lanes whose terms are negligible in the last orders, without the newest order."""
    bits = history
    for i in range(1, MOST_LACUNA - 1):
        bits &= history >> WIDTH * i
    return bits


@kernel(inline="code")
def _set_rates(lanes, k, dx, dy, dc, ds) -> None:
    set_row(lanes.rates[0], k, dc)
    set_row(lanes.rates[1], k, ds)
    set_row(lanes.rates[2], k, dx)
    set_row(lanes.rates[3], k, dy)


@kernel()
def _end_series(lanes, active, ended, k) -> int:
    """Record that the series of the lanes `ended` end at order k. Return a bit mask of the other active lanes."""
    for lane in range(WIDTH):
        if (ended & active) >> lane & 1:
            lanes.orders[lane] = k
    lanes.vanished[0] |= ended & active
    return active & ~ended


@kernel(inline="code")
def _set_state(series, k, x, y, vx, vy, om, c, s, angle) -> None:
    set_row(series[X], k, x)
    set_row(series[Y], k, y)
    set_row(series[VX], k, vx)
    set_row(series[VY], k, vy)
    set_row(series[OMEGA], k, om)
    set_row(series[COS], k, c)
    set_row(series[SIN], k, s)
    set_row(series[THETA], k, angle)


@kernel(inline="code")
def _add_ends(load, k, c0, s0, c, s, share, wc, ws):
    """Add the first and the last product to `wc` and `ws`, coefficient k of a load times cosine and sine."""
    first, newest = exact_row(load, 0) * share, exact_row(load, k)
    return fused(newest, c0, fused(first, c, wc)), fused(newest, s0, fused(first, s, ws))


@kernel(inline="code")
def _add_force(gear, force, fx, fy, gc, gs):
    """Return the forces along X and Y and the factors of c and s in the moment, plus those of a slot's force."""
    return (
        fused(exact_row(gear, 2) * -1.0, force, fx), fused(exact_row(gear, 3) * -1.0, force, fy),
        fused(exact_row(gear, 5), force, gc), fused(exact_row(gear, 6), force, gs),
    )  # fmt: skip


@kernel(inline="code")
def _push(lanes, w, k, acts, viscous, hysteretic, slip, c, s, x, y, dc, ds, dx, dy):
    """Return coefficient k of the forces along X and Y, and of the factors of cosine and sine in the contacts' moment.

    They are sums over the slots for F = K d + C d' or F = K d (1 + lambda d'). The next order of the penetrations and
    order k of F / K are written to `lanes`.
    """
    fx = fy = gc = gs = exact_splat(0.0)
    for slot in range(PAIR_COUNT):
        taken, gear, depth = lanes.taken[slot] & acts, lanes.gear[slot], lanes.depth[slot]
        if lanes.taken[slot] == 0:
            break
        if k == 0:
            set_row(depth, 0, penetration_at(gear, c, s, x, y))
        rate, push = linear_at(gear, dc, ds, dx, dy), exact_row(depth, k)
        deeper = rate * w.inverse[k + 1]
        set_row(depth, k + 1, deeper)
        if hysteretic is not None:
            half = exact_row(depth, 0) * deeper
            for j in range(1, k // 2 + 1):
                half = fused(exact_row(depth, j), exact_row(depth, k + 1 - j), half)
            if k % 2 == 1:
                middle = exact_row(depth, k // 2 + 1)
                half = fused(middle * 0.5, middle, half)
            push = fused(exact_row(gear, 7), half * (k + 1.0), push)
        elif viscous is not None:
            push = fused(exact_row(lanes.damped, 0), rate, push)
        push = choose(taken, push, exact_splat(0.0))
        set_row(lanes.push[slot], k, push)
        fx, fy, gc, gs = _add_force(gear, exact_row(lanes.stiffness, 0) * push, fx, fy, gc, gs)
        if slip is not None:
            sliding = exact_row(lanes.friction, 0) * exact_row(lanes.stiffness, 0)
            fx, fy, gc, gs = _add_friction(lanes, w, slot, k, taken, sliding, push, dc, ds, dx, dy, fx, fy, gc, gs)
    return fx, fy, gc, gs


@kernel(inline="code")
def _push_by_power(lanes, w, k, acts, hysteretic, fraction, slip, c, s, x, y, dc, ds, dx, dy, alpha, beta):
    """Return the results of `_push`, divided by K, for F = K d^n (1 + lambda d') with exponents n other than 1."""
    fx = fy = gc = gs = zero = exact_splat(0.0)
    per_order = (exact_row(lanes.exponent, 0) + 1.0) * w.inverse[max(k, 1)]
    steady, bent = alpha * per_order, beta * per_order
    for slot in range(PAIR_COUNT):
        gear, depth = lanes.gear[slot], lanes.depth[slot]
        if lanes.taken[slot] == 0:
            break
        rate = linear_at(gear, dc, ds, dx, dy)
        if k == 0:
            set_row(depth, 0, penetration_at(gear, c, s, x, y))
        set_row(lanes.rate[slot], k, rate)
        if fraction is not None:
            rate = rate * alpha
            if k > 0:
                rate = fused(exact_row(lanes.rate[slot], k - 1), beta, rate)
        deeper = rate * w.inverse[k + 1]
        if acts != _ALL:
            deeper = choose(acts, deeper, zero)
        set_row(depth, k + 1, deeper)
        if fraction is not None:
            power, damped = _raise(lanes, w, slot, k, steady, bent)
        else:
            power, damped = _multiply(lanes, slot, k, hysteretic)
            power = choose(lanes.taken[slot], power, zero)
        if acts != _ALL:
            power, damped = choose(acts, power, zero), choose(acts, damped, zero)
        set_row(lanes.power[slot], k, power)
        push = power
        if hysteretic is not None or fraction is not None:
            damped = fused(power, exact_row(lanes.rate[slot], 0), damped)
            if fraction is not None:
                set_row(lanes.swept[slot], k, damped)
            if hysteretic is not None:
                push = fused(exact_row(gear, 7), damped, push)
        set_row(lanes.push[slot], k, push)
        fx, fy, gc, gs = _add_force(gear, push, fx, fy, gc, gs)
        if slip is not None:
            taken = lanes.taken[slot] & acts
            sliding = exact_row(lanes.friction, 0)
            fx, fy, gc, gs = _add_friction(lanes, w, slot, k, taken, sliding, push, dc, ds, dx, dy, fx, fy, gc, gs)
    return fx, fy, gc, gs


@kernel(inline="code")
def _add_friction(lanes, w, slot, k, taken, sliding, push, dc, ds, dx, dy, fx, fy, gc, gs):
    """Return forces and factors after adding coefficient k of a slot's friction T = mu F tanh r (`method.series`).

    `sliding` is the friction T of a pair with `push` 1 and tanh r = 1.

    For a head that carries walls, the position of a corner along its wall has the coefficients of the arm of F with the
    opposite sign, and the arm of T has the coefficients of the penetration (`model.geometry`).
    """
    gear, slip, tau, rest = lanes.gear[slot], lanes.slip[slot], lanes.tanh[slot], lanes.rest[slot]
    rate = fused(exact_row(gear, 5), dc, fused(exact_row(gear, 6), ds, exact_row(gear, 3) * dx))
    rate = fused(exact_row(gear, 2), dy, rate * -1.0) * exact_row(lanes.per_slip_speed, 0)
    if k == 0:
        set_row(slip, 0, rate)
        for lane in range(WIDTH):
            tau[0, lane] = math.tanh(slip[0, lane])
        newest = exact_row(tau, 0)
        drag, square = push * newest, newest * newest - 1.0
    else:
        weighted, newest, drag, square = rate * (1.0 * k), exact_splat(0.0), exact_splat(0.0), exact_splat(0.0)
        set_row(slip, k, weighted)
        for j in range(1, k):
            newest = fused(exact_row(slip, j), exact_row(rest, k - j), newest)
            drag = fused(exact_row(lanes.push[slot], j), exact_row(tau, k - j), drag)
            square = fused(exact_row(tau, j), exact_row(tau, k - j), square)
        first = exact_row(tau, 0)
        newest = fused(weighted, exact_row(rest, 0), newest) * w.inverse[k]
        drag = fused(push, first, fused(exact_row(lanes.push[slot], 0), newest, drag))
        square = fused(first * 2.0, newest, square)
        set_row(tau, k, newest)
    set_row(rest, k, square * -1.0)
    force = choose(taken, sliding * drag, exact_splat(0.0))
    return (
        fused(exact_row(gear, 3), force, fx), fused(exact_row(gear, 2) * -1.0, force, fy),
        fused(exact_row(gear, 0), force, gc), fused(exact_row(gear, 1), force, gs),
    )  # fmt: skip


@kernel(inline="code")
def _multiply(lanes, slot, k, hysteretic):
    """Return coefficient k of d^n, and that of d^n d' without the product that contains coefficient k of d^n.

    The exponents are integers from 2 to 4, and may differ between lanes.
    """
    depth, square, power, exponent = lanes.depth[slot], lanes.base[slot], lanes.power[slot], lanes.exponent
    set_row(square, k, _product(depth, depth, k))
    result = exact_row(square, k)
    higher = below(exact_splat(2.5), exact_row(exponent, 0))
    if higher != 0:
        # d^3 is d^2 times d, and d^4 is the square of d^2
        fourth = below(exact_splat(3.5), exact_row(exponent, 0))
        result = choose(higher, choose(fourth, _product(square, square, k), _product(square, depth, k)), result)
    damped = exact_splat(0.0)
    if hysteretic is not None:
        for j in range(k):
            damped = fused(exact_row(power, j), exact_row(lanes.rate[slot], k - j), damped)
    return result, damped


@kernel(inline="code")
def _product(a, b, k):
    total = exact_splat(0.0)
    for j in range(k + 1):
        total = fused(exact_row(a, j), exact_row(b, k - j), total)
    return total


@kernel(inline="code")
def _raise(lanes, w, slot, k, steady, bent):
    """Return the results of `_multiply` for exponents n that are not integers.

    The series P of d^n follows from (n + 1) P d' = (P d)'. Since P d' and P d are products with d^n, an order takes two
    Cauchy products. P d' is a series of the rate in time; `steady` and `bent` are (n + 1) / k times alpha and beta.
    The base is d. If the pair of a lane touches at the start of the step, it is d / sigma^2, and the power begins with
    sigma^3 (n = 1.5).
    """
    power, base, rate, swept = lanes.power[slot], lanes.base[slot], lanes.rate[slot], lanes.swept[slot]
    touching, zero, here = lanes.touching[slot], exact_splat(0.0), exact_row(lanes.depth[slot], k)
    if touching != 0:
        if k > 1:
            set_row(base, k - 2, choose(touching, here, exact_row(base, k - 2)))
        if k == 2:
            _invert(lanes, slot, here, touching)
        here = choose(touching, zero, here)
    set_row(base, k, here)
    if k == 0:
        _invert(lanes, slot, here, ~touching)
        # the powers of lanes without a pair in the slot remain zero
        return choose(lanes.taken[slot] & ~touching, _first_power(lanes, here), zero), zero
    lower = damped = zero
    for j in range(1, k):
        term = exact_row(power, k - j)
        lower, damped = fused(term, exact_row(base, j), lower), fused(term, exact_row(rate, j), damped)
    first = exact_row(power, 0)
    lower, damped = fused(first, here, lower), fused(first, exact_row(rate, k), damped)
    older = zero
    if k > 1:
        older = exact_row(swept, k - 2) * bent
    result = fused(exact_row(swept, k - 1), steady, older - lower)
    if touching != 0:
        # here (k - 3) d_2 P_k = 2 (n + 1) (P d')_k - (k + 2) (P d)_(k + 2), both without their terms with P_k
        rising = (exact_row(lanes.exponent, 0) + 1.0) * 2.0 * damped - lower * (k + 2.0)
        result = choose(touching, rising * w.inverse[max(k - 3, 1)], result)
    result = result * exact_row(lanes.per_base, slot)
    if touching != 0 and k <= 3:
        result = choose(touching, zero, result)
        if k == 3:
            result = choose(touching, _first_power(lanes, exact_row(base, 0)), result)
    return result, damped


@kernel(inline="code")
def _invert(lanes, slot, value, bits) -> None:
    """Write 1 / `value` for the lanes in `bits`, or 0 for lanes without a pair in the slot."""
    there = choose(lanes.taken[slot], exact_splat(1.0) / value, exact_splat(0.0))
    set_row(lanes.per_base, slot, choose(bits, there, exact_row(lanes.per_base, slot)))


@kernel()
def raised(lanes, value, fraction):
    """Return value^n of each lane, or 0 for negative values."""
    if fraction is not None:
        return _first_power(lanes, value)
    zero, square, exponent = exact_splat(0.0), value * value, exact_row(lanes.exponent, 0)
    higher, fourth = below(exact_splat(2.5), exponent), below(exact_splat(3.5), exponent)
    power = choose(higher, choose(fourth, square, value) * square, square)
    return choose(below(zero, value), power, zero)


@kernel()
def _first_power(lanes, value):
    """Return value^n of each lane for exponents that are not integers, or 0 for negative values."""
    zero, half = exact_splat(0.0), exact_splat(1.5)
    value = choose(below(zero, value), value, zero)
    result = value * square_root(value)
    others = below(exact_row(lanes.exponent, 0), half) | below(half, exact_row(lanes.exponent, 0))
    if others != 0:
        set_row(lanes.root, 0, value)
        for lane in range(WIDTH):
            lanes.root[lane] = lanes.root[lane] ** lanes.exponent[lane]
        result = choose(others, exact_row(lanes.root, 0), result)
    return result


@kernel(inline="code")
def _force(row, viscous, c, s, z, dc, ds, dz):
    """Return coefficient k > 0 of a contact force along X or Y."""
    force = fused(exact_row(row, 2), z, fused(exact_row(row, 0), c, exact_row(row, 1) * s))
    if viscous is not None:
        rates = fused(exact_row(row, 3), dc, fused(exact_row(row, 4), ds, exact_row(row, 5) * dz))
        force = force + rates
    return force


@kernel(inline="code")
def _lever(row, viscous, c, s, x, y, dc, ds, dx, dy):
    """Return coefficient k > 0 of the factor of cosine or sine in the contacts' moment."""
    lever = fused(exact_row(row, 0), c, exact_row(row, 1) * s)
    lever = lever + fused(exact_row(row, 2), x, exact_row(row, 3) * y)
    if viscous is not None:
        rates = fused(exact_row(row, 4), dc, exact_row(row, 5) * ds)
        lever = lever + (rates + fused(exact_row(row, 6), dx, exact_row(row, 7) * dy))
    return lever


@kernel(inline="code")
def _size(lanes, vx, vy, om, c, s):
    size = fused(exact_row(lanes.weight, 0), magnitude(c) + magnitude(s), magnitude(vx) + magnitude(vy))
    return fused(exact_row(lanes.radius, 0), magnitude(om), size)


@kernel()
def _end_before_stop(lanes, bits) -> None:
    for lane in range(WIDTH):
        lanes.ends_at_stop[lane] &= 1 - (bits >> lane & 1)


@kernel()
def _not_too_far(lanes, step):
    """Limit the steps where the variable is the square root of the time since a touch (`method.taylor`)."""
    zero, alpha, beta = exact_splat(0.0), exact_row(lanes.alpha, 0), exact_row(lanes.beta, 0)
    furthest = alpha / beta * FURTHEST
    far = below(zero, alpha) & below(zero, beta) & below(furthest, step)
    _end_before_stop(lanes, far)
    return choose(far, furthest, step)


@kernel()
def accurate_steps(lanes, w, order, power, fraction) -> int:
    """Write the accurate step size of each lane's series to `lanes.step`, and return a bit mask of non-finite series.

    The test is that of `method.step_size.accurate_step`, with a coarse logarithm: a step that is longer by 1e-4 has an
    error that is larger by 0.2 %.
    """
    whole, least, zero, infinite = exact_row(lanes.whole, 0), exact_splat(1e3), exact_splat(0.0), 0
    recent = tested(power)
    for i in range(recent):
        size = exact_row(lanes.size, recent - 1 - i)
        infinite |= ~below(size, exact_splat(_FINITE))
        here = coarse_log2(exact_row(lanes.threshold, i) / size) * w.inverse[order - i]
        least = choose(below(here, least), here, least)
    shorter = below(coarse_exp2(least), whole)
    # over a long step, an admissible error of the velocity is a large error of the position
    stretch = least + exact_row(lanes.stretch, 0)
    stretch = choose(below(zero, stretch), stretch, zero)
    step = choose(shorter, coarse_exp2(fused(stretch, exact_splat(-w.inverse[order]), least)), whole)
    live = 0
    for lane in range(WIDTH):
        lanes.ends_at_stop[lane] = 1
        if lanes.member[lane] >= 0 and lanes.vanished[0] >> lane & 1 == 0:
            live |= 1 << lane
            lanes.orders[lane] = order
            lanes.ends_at_stop[lane] = 1 - (shorter >> lane & 1)
        if fraction is not None:
            lanes.ends_at_stop[lane] &= lanes.may_stop[lane]
    step = choose(live, step, whole)
    if fraction is not None:
        step = _not_too_far(lanes, step)
    set_row(lanes.step, 0, step)
    set_row(lanes.accurate, 0, step)
    return infinite & live


@kernel()
def before_sticking(lanes, w, order, fraction) -> None:
    """Shorten the steps where tanh r converges too slowly (`method.step_size.before_sticking`)."""
    for lane in range(WIDTH):
        lanes.root[lane] = w.inverse[lanes.orders[lane]]
    radius, step, zero, shorter = exact_row(lanes.radius, 0), exact_row(lanes.step, 0), exact_splat(0.0), 0
    mobility = fused(radius * radius, exact_row(lanes.inverse_inertia, 0), exact_row(lanes.inverse_mass, 0))
    per_push = exact_row(lanes.friction, 0) * exact_row(lanes.stiffness, 0) * mobility
    for slot in range(PAIR_COUNT):
        slip, push, change, normal = lanes.slip[slot], lanes.push[slot], zero, zero
        if lanes.taken[slot] == 0:
            break
        for k in range(order - 1, 0, -1):
            change = fused(magnitude(exact_row(slip, k)), exact_splat(w.inverse[k]), change) * step
            normal = (normal + magnitude(exact_row(push, k))) * step
        time, first = step, exact_row(slip, 0)
        if fraction is not None:
            time = step * fused(magnitude(exact_row(lanes.beta, 0)), step, exact_row(lanes.alpha, 0))
        gained = per_push * (normal + magnitude(exact_row(push, 0))) * time
        theta = coarse_exp2(coarse_log2(exact_row(lanes.threshold, 0) / gained) * exact_row(lanes.root, 0))
        theta = choose(below(theta, exact_splat(FARTHEST_TO_POLE)), theta, exact_splat(FARTHEST_TO_POLE))
        limit = theta * square_root(fused(first, first, exact_splat(0.25 * math.pi**2)))
        far = below(limit, change) & below(zero, gained) & lanes.taken[slot]
        step = choose(far, step * (limit / change), step)
        shorter |= far
    _end_before_stop(lanes, shorter)
    set_row(lanes.step, 0, step)
    set_row(lanes.accurate, 0, step)
