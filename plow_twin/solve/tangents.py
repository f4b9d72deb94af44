"""Derivatives of a motion with respect to state and parameters, by linearisation along the series of each step.

Each column is one derivative. xi and eta are the derivatives of position and velocity of the centre of mass in head
axes. phi and psi are the derivatives of the angle and its rate. With the contact force f = (fx, fy) in head axes, a
column satisfies

    xi'  = eta - omega J xi                   J = rotation by a quarter turn
    eta' = -omega J eta + (phi J f + df) / m  + the change of the load per mass
    phi' = psi,  psi' = (-fy xi_x + fx xi_y + phi dtau + sum arm dF) / I + the change of the moment per inertia
    dd   = n . xi - arm phi + de,             dd' its rate,     dF = F_d dd + F_d' dd' + the change by the law's
    constants

where d and F are penetration and force of a pair, n contains the coefficients of X and Y in the penetration, and de is
the change of the penetration by a clearance. df and dF are the changes of f and F. dtau is the derivative of the
contacts' moment with respect to the angle. The coefficients of these equations are series over the step, so each order
of a column is a sum of Cauchy products. Eight columns are computed in one vector.

At a touch the Kelvin-Voigt force jumps by C d'. The displaced motion touches earlier by the time dd / d', and so
receives the additional impulse C dd. At all other changes of contact mode the force is continuous.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from plow_twin.kernel.arrays import unowned
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import exact_row, exact_splat, fused, row, set_row, splat, total
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.kinematics import penetration_of, rate_at, row_rate, row_value, row_values
from plow_twin.solve.modes import within_range
from plow_twin.solve.state import COS, MAX_ORDER, OFF, OMEGA, ON, SIN, VX, VY, Status, X, Y
from plow_twin.solve.step import complete_step, lay_out_series_step

#: Number of columns that are computed in one vector.
WIDTH: Final = 8
#: Number of derivatives with respect to the state, which precede the derivatives with respect to parameters.
STATE_COLUMNS: Final = 6
#: Indices of the components of a column.
PLACE_X, PLACE_Y, PLACE_THETA, RATE_X, RATE_Y, RATE_THETA = range(6)

_ROWS: Final = MAX_ORDER + 1
_EIGHT: Final = (PAIR_COUNT, WIDTH)
_OF_PAIRS: Final = (PAIR_COUNT, _ROWS, WIDTH)

#: Eight columns of derivatives, with their dependence on parameters and their series over a step.
COLUMNS: Final = np.dtype(
    [
        ("series", "f8", (6, _ROWS, WIDTH)),
        # for pairs that exert force: change of the penetration, change of its rate, and change of the force
        ("depth", "f8", _OF_PAIRS),
        ("rate", "f8", _OF_PAIRS),
        ("force", "f8", _OF_PAIRS),
        ("load", "f8", (3, _ROWS, WIDTH)),  # change of the load per mass and inertia, in world axes
        ("now", "f8", (6, WIDTH)),  # columns in head axes at the start of the step
        ("factor", "f8", _EIGHT),  # change of each pair's damping factor lambda
        ("edge", "f8", _EIGHT),  # derivative of each pair's penetration with respect to a clearance
        ("constant", "f8", (3, WIDTH)),  # derivative of the constant load
        ("stiffness", "f8", (WIDTH,)),
        ("viscous", "f8", (WIDTH,)),
        ("number", "f8", (WIDTH,)),  # derivative of D in lambda = D / v0
        ("loaded", "i8"),  # 1 if any of the columns changes a load
    ]
)

#: Series of one step that all columns share as factors of their Cauchy products. Lanes are components or pairs.
ALONG: Final = np.dtype(
    [
        ("spin", "f8", (_ROWS, PAIR_COUNT)),  # omega in each lane
        ("turned", "f8", (_ROWS, PAIR_COUNT)),  # omega times the state
        ("arm_rate", "f8", (_ROWS, PAIR_COUNT)),
        ("arm_turned", "f8", (_ROWS, PAIR_COUNT)),  # derivative of an arm with respect to the angle
        # derivatives of the force with respect to the penetration and with respect to its rate
        ("by_depth", "f8", (_ROWS, PAIR_COUNT)),
        ("by_rate", "f8", (_ROWS, PAIR_COUNT)),
        ("elastic", "f8", (_ROWS, PAIR_COUNT)),  # d^n
        ("slope", "f8", (_ROWS, PAIR_COUNT)),  # derivative of d^n with respect to d
        ("lift", "f8", (_ROWS, PAIR_COUNT)),  # 1 + lambda d'
        ("damped", "f8", (_ROWS, PAIR_COUNT)),  # d^n d'
        ("push", "f8", (4, _ROWS)),  # fx, fy, derivative of the moment with respect to the angle, -fy
        ("mode", "i8", (PAIR_COUNT,)),  # modes of the pairs before the event of the step
        ("waiting", "i8"),  # number of successive times at which a new stretch could not begin
    ]
)

_OK, _RANGE, _NON_FINITE, _BUDGET = (
    int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE), int(Status.BUDGET),
)  # fmt: skip


@kernel(fast=True)
def _product(a, b, k):
    """Return coefficient k of the products of the series in a and b, column by column."""
    low, high = splat(0.0), splat(0.0)
    for j in range(k // 2 + 1):
        low = low + row(a, j) * row(b, k - j)
    for j in range(k // 2 + 1, k + 1):
        high = high + row(a, j) * row(b, k - j)
    return low + high


@kernel(fast=True)
def _expand_along(p, state, w, along, order, viscous, hysteretic, integer, fraction) -> None:
    """Write the factors that all columns share, from the series of a step with acting pairs."""
    for k in range(order):
        set_row(along.spin, k, splat(w.series[k, OMEGA]))
        turned = _product(along.spin, w.series, k)
        set_row(along.turned, k, turned)
        c, s, x, y = w.series[k, COS], w.series[k, SIN], w.series[k, X], w.series[k, Y]
        dx, dy = w.series[k, VX] + along.turned[k, Y], w.series[k, VY] - along.turned[k, X]
        set_row(along.arm_rate, k, row_values(p.arm_rows, -along.turned[k, SIN], along.turned[k, COS], dx, dy))
        set_row(along.arm_turned, k, row_values(p.arm_rows, -s, c, y, -x))
        along.push[0, k] = -total(row(p.penetration_rows, 2) * row(w.force, k))
        along.push[1, k] = -total(row(p.penetration_rows, 3) * row(w.force, k))
        along.push[2, k] = total(_product(along.arm_turned, w.force, k))
        along.push[3, k] = -along.push[1, k]
    if hysteretic is not None or integer is not None or fraction is not None:
        _expand_law(p, state, w, along, order, viscous, hysteretic, integer, fraction)


@kernel(fast=True)
def _expand_law(p, state, w, along, order, viscous, hysteretic, integer, fraction) -> None:
    """Write the derivatives of a nonlinear contact force with respect to penetration and rate."""
    for k in range(order):
        elastic, slope = row(w.penetration, k), splat(1.0 if k == 0 else 0.0)
        if integer is not None:
            degree = int(p.exponent)
            elastic = row(w.power[degree - 2], k)
            slope = (row(w.penetration, k) if degree == 2 else row(w.power[degree - 3], k)) * p.exponent
        if fraction is not None:
            elastic, slope = row(w.power[0], k), row(w.power[1], k) * p.exponent
        set_row(along.elastic, k, elastic)
        set_row(along.slope, k, slope)
    if fraction is not None:
        for pair in range(PAIR_COUNT):
            if state.touching >> pair & 1:
                _slope_at_touch(w, along, order, pair)
    for k in range(order):
        by_depth, by_rate = row(along.slope, k), splat(0.0)
        if hysteretic is not None:
            lift = row(w.rate, k) * row(state.damping_factor, 0) + splat(1.0 if k == 0 else 0.0)
            set_row(along.lift, k, lift)
            set_row(along.damped, k, _product(along.elastic, w.rate, k))
            by_depth = _product(along.slope, along.lift, k)
            by_rate = row(along.elastic, k) * row(state.damping_factor, 0)
        set_row(along.by_depth, k, by_depth * p.stiffness)
        set_row(along.by_rate, k, by_rate * p.stiffness)
        if viscous is not None and k == 0:
            set_row(along.by_rate, 0, splat(p.viscous))


@kernel()
def _slope_at_touch(w, along, order, pair) -> None:
    """Write (d^n)' / d' of a pair that touches at the start of the step, where d is of order sigma^2."""
    first = 2.0 * w.penetration[2, pair]
    for k in range(order):
        along.slope[k, pair] = 0.0
        if k + 2 < order:
            rest = (k + 2.0) * along.elastic[k + 2, pair]
            for j in range(2, k + 2):
                rest -= (j + 1.0) * w.penetration[j + 1, pair] * along.slope[k + 1 - j, pair]
            along.slope[k, pair] = rest / first


@kernel()
def _expand_waves(omegas, amplitudes, state, w, columns, order) -> None:
    """Write the series of the changes of the loads in eight columns.

    `amplitudes`, shape (h, 2, 3, 8), contains the changes of the sine and cosine amplitudes along x, y and theta.
    """
    load, t, alpha, beta = columns.load, state.step_start, state.alpha, state.beta
    for k in range(order):
        for j in range(3):
            set_row(load[j], k, exact_row(columns.constant, j) if k == 0 else exact_splat(0.0))
    for i in range(omegas.size):
        omega = omegas[i]
        sine, cosine, sine_before, cosine_before = math.sin(omega * t), math.cos(omega * t), 0.0, 0.0
        for k in range(order):
            for j in range(3):
                wave = fused(exact_row(amplitudes[i, 0], j), exact_splat(sine), exact_row(load[j], k))
                set_row(load[j], k, fused(exact_row(amplitudes[i, 1], j), exact_splat(cosine), wave))
            scale = omega * w.inverse[k + 1]
            new_sine = scale * (alpha * cosine + beta * cosine_before)
            new_cosine = -scale * (alpha * sine + beta * sine_before)
            sine_before, cosine_before, sine, cosine = sine, cosine, new_sine, new_cosine


@kernel()
def _times(factor, pair, series, k):
    """Return coefficient k of the products of the eight `series` with column `pair` of `factor`."""
    value = exact_splat(0.0)
    for j in range(k + 1):
        value = fused(exact_splat(factor[j, pair]), exact_row(series, k - j), value)
    return value


@kernel()
def _change_force(p, state, w, along, columns, pair, k, moved, moved_rate, viscous, hysteretic, curved):
    """Write and return coefficient k of the change of a pair's force, for n . xi and its rate."""
    depth, rate, force, series = columns.depth[pair], columns.rate[pair], columns.force[pair], columns.series
    changed, changed_rate, by_angle = exact_splat(0.0), exact_splat(0.0), exact_splat(0.0)
    for j in range(k + 1):
        arm, angle = exact_splat(w.arm[j, pair]), exact_row(series[PLACE_THETA], k - j)
        changed = fused(arm, angle, changed)
        changed_rate = fused(exact_splat(along.arm_rate[j, pair]), angle, changed_rate)
        by_angle = fused(arm, exact_row(series[RATE_THETA], k - j), by_angle)
    changed = moved - changed
    if k == 0:
        changed = changed + exact_row(columns.edge, pair)
    changed_rate = moved_rate - changed_rate - by_angle
    stiffness, damping = exact_row(columns.stiffness, 0), exact_row(columns.viscous, 0)
    if curved is not None:
        set_row(depth, k, changed)
        set_row(rate, k, changed_rate)
        push = stiffness * along.elastic[k, pair]
        if hysteretic is not None:
            damped = along.damped[k, pair]
            push = push + stiffness * (state.damping_factor[pair] * damped)
            push = push + exact_row(columns.factor, pair) * (p.stiffness * damped)
        for j in range(k + 1):
            push = fused(exact_splat(along.by_depth[j, pair]), exact_row(depth, k - j), push)
            push = fused(exact_splat(along.by_rate[j, pair]), exact_row(rate, k - j), push)
    else:
        push = fused(stiffness, exact_splat(w.penetration[k, pair]), changed * p.stiffness)
        if viscous is not None:
            push = push + changed_rate * p.viscous
    if viscous is not None:
        push = fused(damping, exact_splat(w.rate[k, pair]), push)
    set_row(force, k, push)
    return push


@kernel()
def _expand_columns(p, state, w, along, columns, order, acts, viscous, hysteretic, curved) -> None:
    series, alpha, beta = columns.series, state.alpha, state.beta
    x, y, angle = series[PLACE_X], series[PLACE_Y], series[PLACE_THETA]
    vx, vy, spin = series[RATE_X], series[RATE_Y], series[RATE_THETA]
    for i in range(6):
        set_row(series[i], 0, exact_row(columns.now, i))
    zero, mass, inertia = exact_splat(0.0), p.inverse_mass, p.inverse_inertia
    dx0 = dy0 = ds0 = ax0 = ay0 = as0 = zero
    for k in range(order):
        dx = dy = ax = ay = turned = zero
        for j in range(k + 1):
            omega = exact_splat(w.series[j, OMEGA])
            dx, dy = fused(omega, exact_row(y, k - j), dx), fused(omega, exact_row(x, k - j), dy)
            ax, ay = fused(omega, exact_row(vy, k - j), ax), fused(omega, exact_row(vx, k - j), ay)
        dx, dy, ay, ds = exact_row(vx, k) + dx, exact_row(vy, k) - dy, ay * -1.0, exact_row(spin, k)
        if columns.loaded == 1:
            for j in range(k + 1):
                c, s = exact_splat(w.series[j, COS]), exact_splat(w.series[j, SIN])
                load_x, load_y = exact_row(columns.load[0], k - j), exact_row(columns.load[1], k - j)
                ax, ay = fused(c, load_x, fused(s, load_y, ax)), fused(c, load_y, ay) - s * load_x
            turned = exact_row(columns.load[2], k)
        if acts != 0:
            fx = fy = moment = other = turning = zero
            for j in range(k + 1):
                push_x, against_y = exact_splat(along.push[0, j]), exact_splat(along.push[3, j])
                by_angle = exact_row(angle, k - j)
                fx, fy = fused(against_y, by_angle, fx), fused(push_x, by_angle, fy)
                moment = fused(push_x, exact_row(y, k - j), moment)
                other = fused(against_y, exact_row(x, k - j), other)
                turning = fused(exact_splat(along.push[2, j]), by_angle, turning)
            moment = moment + other + turning
            for pair in range(PAIR_COUNT):
                if acts >> pair & 1 == 0:
                    continue
                if pair % 2 == 1:
                    normal = p.penetration_rows[2, pair]
                    push = _change_force(
                        p, state, w, along, columns, pair, k, exact_row(x, k) * normal, dx * normal, viscous,
                        hysteretic, curved,
                    )  # fmt: skip
                    fx = fx - push * normal
                else:
                    normal = p.penetration_rows[3, pair]
                    push = _change_force(
                        p, state, w, along, columns, pair, k, exact_row(y, k) * normal, dy * normal, viscous,
                        hysteretic, curved,
                    )  # fmt: skip
                    fy = fy - push * normal
                moment = moment + _times(w.arm, pair, columns.force[pair], k)
            ax, ay, turned = ax + fx * mass, ay + fy * mass, turned + moment * inertia
        part = w.inverse[k + 1]
        steady, bent = alpha * part, beta * part
        set_row(x, k + 1, dx * steady + dx0 * bent)
        set_row(y, k + 1, dy * steady + dy0 * bent)
        set_row(angle, k + 1, ds * steady + ds0 * bent)
        set_row(vx, k + 1, ax * steady + ax0 * bent)
        set_row(vy, k + 1, ay * steady + ay0 * bent)
        set_row(spin, k + 1, turned * steady + as0 * bent)
        dx0, dy0, ds0, ax0, ay0, as0 = dx, dy, ds, ax, ay, turned


@kernel()
def _move_columns(columns, order, sigma) -> None:
    at = exact_splat(sigma)
    for i in range(6):
        series = columns.series[i]
        value = exact_row(series, order)
        for k in range(order - 1, -1, -1):
            value = fused(value, at, exact_row(series, k))
        set_row(columns.now, i, value)


@kernel()
def _second_rate(state, w, pair):
    """Return the second time derivative of a penetration at the end of the step [m/s^2]."""
    sigma, slope, bend = state.sigma_end, 0.0, 0.0
    for k in range(state.order, 0, -1):
        bend = bend * sigma + slope
        slope = slope * sigma + k * w.penetration[k, pair]
    pace = state.alpha + state.beta * sigma
    return (bend - state.beta * slope / pace) / (pace * pace)


@kernel()
def _touch(p, state, w, columns, pair, viscous) -> None:
    """Add the effects of a touch to eight columns: impulse of the earlier touch, and change of the impact speed."""
    y, now = state.y, columns.now
    c, s, om = y[COS], y[SIN], y[OMEGA]
    arm = row_value(p.arm_rows, pair, c, s, y[X], y[Y])
    which, along, rate_along = (2, PLACE_X, RATE_X) if pair % 2 == 1 else (3, PLACE_Y, RATE_Y)
    normal = p.penetration_rows[which, pair]
    angle, spin = exact_row(now, PLACE_THETA), exact_row(now, RATE_THETA)
    depth = exact_row(now, along) * normal - angle * arm + exact_row(columns.edge, pair)
    if viscous is not None:
        impulse = depth * p.viscous
        set_row(now, rate_along, exact_row(now, rate_along) - impulse * (normal * p.inverse_mass))
        set_row(now, RATE_THETA, spin + impulse * (arm * p.inverse_inertia))
    if p.damping_number >= 0.0:
        speed = rate_at(p, pair, c, s, om, y[X], y[Y], y[VX], y[VY])
        changed = exact_row(columns.number, 0)
        if speed > p.speed_floor:
            across = exact_row(now, PLACE_Y if pair % 2 == 1 else PLACE_X) * (om if pair % 2 == 1 else -om)
            rate = (exact_row(now, rate_along) + across) * normal - spin * arm
            rate = rate - angle * row_rate(p, p.arm_rows, pair, c, s, om, y[X], y[Y], y[VX], y[VY])
            rate = rate - depth * (_second_rate(state, w, pair) / speed)
            changed = changed - rate * state.damping_factor[pair]
        set_row(columns.factor, pair, changed * (1.0 / max(speed, p.speed_floor)))


@kernel()
def _start_columns(c, s, columns, first) -> None:
    """Begin a stretch: set columns of the state to a displacement of 1, and columns of parameters to 0.

    A stretch is the part of the motion over which derivatives are taken. The derivatives of a continuing contact's
    lambda do not change, because its impact speed is fixed.
    """
    for lane in range(WIDTH):
        column = first + lane
        for i in range(6):
            columns.now[i, lane] = 1.0 if i == column else 0.0
        for i in range(0, 4, 3):
            if column == i:
                columns.now[i, lane], columns.now[i + 1, lane] = c, -s
            elif column == i + 1:
                columns.now[i, lane], columns.now[i + 1, lane] = s, c
        if column < STATE_COLUMNS:
            for pair in range(PAIR_COUNT):
                columns.factor[pair, lane] = 0.0


@kernel()
def _read_columns(c, s, columns, first, out) -> None:
    """Convert eight columns to world axes, and write them to `out`, shape (6, columns)."""
    for lane in range(min(WIDTH, out.shape[1] - first)):
        for i in range(6):
            out[i, first + lane] = columns.now[i, lane]
        for i in range(0, 4, 3):
            along, across = columns.now[i, lane], columns.now[i + 1, lane]
            out[i, first + lane], out[i + 1, first + lane] = c * along - s * across, s * along + c * across


@kernel()
def _is_clear(p, state, room) -> bool:
    """Return whether a new stretch (`_start_columns`) can begin.

    Every gap or penetration must be at least `room`, and no contact's damping factor may depend on its impact speed.
    """
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            if abs(penetration_of(p, state, pair, state.y)) < room:
                return False
            if p.damping_number >= 0.0 and state.mode[pair] != OFF:
                return False
    return True


@kernel()
def _step(p, parts, state, w, along, columns, omegas, amplitudes, curved, end) -> bool:
    """Take a step of the motion and of its columns. Return False if the motion is not finite."""
    terms = parts.terms
    if not lay_out_series_step(p, parts, state, w, end):
        return False
    order, acts = state.order, 0
    for pair in range(PAIR_COUNT):
        along.mode[pair] = state.mode[pair]
        acts |= 1 << pair if state.mode[pair] == ON else 0
    if acts != 0:
        _expand_along(p, state, w, along, order, terms.viscous, terms.hysteretic, terms.integer, terms.fraction)
    for i in range(columns.size):
        if columns[i].loaded == 1:
            _expand_waves(omegas, amplitudes[i], state, w, columns[i], order)
        _expand_columns(p, state, w, along, columns[i], order, acts, terms.viscous, terms.hysteretic, curved)
        _move_columns(columns[i], order, state.sigma_end)
    complete_step(p, parts.harmonics, None, None, state, w, None, None, None, terms.fraction, None)
    if state.event_pair >= 0:
        for pair in range(PAIR_COUNT):
            if along.mode[pair] == OFF and state.mode[pair] != OFF:
                for i in range(columns.size):
                    _touch(p, state, w, columns[i], pair, terms.viscous)
    return True


@kernel(entry=True)
def follow_columns(
    p, parts, state, w, along, columns, omegas, amplitudes, curved, ends, room, longest_wait, reached, budget, out,
    whole,
) -> int:  # fmt: skip
    """Advance a motion and its columns to each of the times `ends`, at which new stretches begin if possible.

    Parameters
    ----------
    columns : ndarray of `COLUMNS`, shape (b,)
        Blocks of eight columns. The first six columns are derivatives with respect to the state.
    omegas : ndarray, shape (h,)
        Angular frequencies in rad/s of the loads that the columns change.
    amplitudes : ndarray, shape (b, h, 2, 3, 8)
        Changes of the amplitudes of the loads by each column.
    curved : int or None
        1 if the contact force is nonlinear in penetration and rate, else None.
    ends : ndarray, shape (n,)
        Times in s.
    room : float
        Smallest gap or penetration in m that every pair must have for a stretch to begin.
    longest_wait : int
        Number of successive times without a new stretch, after which a stretch begins even if a pair is closer than
        `room`.
    reached : ndarray of int64, shape (1,)
        Number of times in `ends` that have been reached, from which the call continues.
    budget : int
        Largest number of steps of the motion.
    out : ndarray, shape (n, 6, columns)
        Array that receives the derivatives since the beginning of the stretch, in world axes.
    whole : ndarray of int64, shape (n,)
        Array that receives 1 for each time at which a stretch ends and the next stretch begins.
    """
    columns, omegas, amplitudes, ends, out = (
        unowned(columns), unowned(omegas), unowned(amplitudes), unowned(ends), unowned(out),
    )  # fmt: skip
    if state.steps == 0:
        for i in range(columns.size):
            _start_columns(state.y[COS], state.y[SIN], columns[i], i * WIDTH)
    while reached[0] < ends.size:
        end = ends[reached[0]]
        while state.step_start < end:
            if state.steps >= budget:
                return _BUDGET
            if not within_range(p, state, state.y):
                return _RANGE
            if not _step(p, parts, state, w, along, columns, omegas, amplitudes, curved, end):
                return _NON_FINITE
        c, s = state.y[COS], state.y[SIN]
        for i in range(columns.size):
            _read_columns(c, s, columns[i], i * WIDTH, out[reached[0]])
        clear = _is_clear(p, state, room) or along.waiting >= longest_wait
        along.waiting = 0 if clear else along.waiting + 1
        if clear:
            whole[reached[0]] = 1
            for i in range(columns.size):
                _start_columns(c, s, columns[i], i * WIDTH)
        reached[0] += 1
    return _OK
