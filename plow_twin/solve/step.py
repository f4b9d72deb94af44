"""One step: series, length, first event, what happened in it, and the switch at its end.

A step never depends on where output is wanted. It ends at an event, at a knot of the load, or where its series stops
being accurate. Guards are polynomials that stay >= 0 while a mode lasts; `polynomial.first_root` finds the first that
does not.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.model.contact import free_force, normal_force
from plow_twin.model.kernel import kernel
from plow_twin.model.lanes import below, magnitude, row, set_row, splat
from plow_twin.solve.layout import (
    ACTS,
    ALPHA,
    AT_HARD_END,
    BASE,
    BETA,
    CLIPPED,
    COEFFICIENTS,
    COS,
    CROSSING,
    DAMPS,
    EVENT_PAIR,
    EVENT_TO,
    EVENTS,
    FIRST,
    GUARD_ROOTS,
    HARD_END,
    LAST_LENGTH,
    LENGTH,
    NOW,
    OFF,
    OMEGA,
    ON,
    ORDER,
    OVERDAMPED,
    PIECE,
    RAMPS,
    RATIO,
    RECOVERIES,
    RELEASED,
    SECOND,
    SIGMA,
    SIGN,
    SIN,
    STALL,
    STEPS,
    SUM,
    T0,
    THETA,
    TOUCHED,
    TOUCHING,
    USED,
    VX,
    VY,
)
from plow_twin.solve.polynomial import first_root, maximum, shift_column
from plow_twin.solve.series import expand, expand_harmonics
from plow_twin.solve.stiff import PATIENCE, STAGES, collocate, note_explicit

#: Longest step in s; keeps every power of it finite.
LONGEST_STEP = 100.0
#: A pair that would part within so many steps like the last is looked at, by a series of this order.
_PARTING_REACH, PARTING_ORDER = 1.3, 6
#: A touch no farther back than so many steps like the last still shapes the series.
_TOUCH_REACH = 2.5


@kernel(inline=True)
def gap_and_rate(p, state, pair):
    """Return penetration and its rate of one pair at the step's start."""
    y, A = state.y, p.gap
    c, s, om = y[COS], y[SIN], y[OMEGA]
    d = A[0, pair] * c + A[1, pair] * s + A[2, pair] * y[0] + A[3, pair] * y[1] + A[4, pair] - state.depth[pair]
    r = om * (A[1, pair] * c - A[0, pair] * s) + A[2, pair] * (y[VX] + om * y[1]) + A[3, pair] * (y[VY] - om * y[0])
    return d, r


@kernel()
def touch(p, state, pair) -> None:
    """Start a contact: read its impact speed, lambda = D / v0."""
    if p.damping_factor >= 0.0:
        _, speed = gap_and_rate(p, state, pair)
        state.factor[pair] = p.damping_factor / max(speed, p.speed_floor)


@kernel()
def mode_inside(p, state, pair):
    """Return the mode of a pair that penetrates, and note on which side of its ramp's end it is."""
    depth, rate = gap_and_rate(p, state, pair)
    state.beyond[pair] = 1 if depth > p.ramp else 0
    if free_force(depth, rate, p.stiffness, p.exponent, state.factor[pair], p.viscous, p.ramp) < 0.0:
        return CLIPPED
    return ON if depth >= p.release else RELEASED


@kernel()
def settle_modes(p, state) -> None:
    """Choose each pair's mode from its penetration, where a motion starts or is changed from outside."""
    for pair in range(8):
        state.mode[pair] = OFF
        state.beyond[pair] = 0
        if p.enabled[pair] == 1 and gap_and_rate(p, state, pair)[0] > 0.0:
            touch(p, state, pair)
            state.mode[pair] = mode_inside(p, state, pair)
    state.clock[USED] = 0.0
    state.clock[LENGTH] = -1.0
    state.clock[LAST_LENGTH] = 0.0
    state.clock[TOUCHED] = -np.inf
    state.step[TOUCHING] = 0
    state.step[STALL] = 0


@kernel(fast=True)
def _guards(p, state, w, order, penetrating, viscous, ramp) -> None:
    """Write each pair's first guard to `w.guard`.

    off: -d >= 0; on: F / K = d + (C / K) d' >= 0 for Kelvin-Voigt, else d >= 0 or a small depth; others: d >= 0.
    """
    guard, weights = w.guard, w.lanes
    for pair in range(8):
        mode = state.mode[pair]
        weights[SIGN, pair] = 0.0 if p.enabled[pair] == 0 else -1.0 if mode == OFF else 1.0
        weights[RATIO, pair] = 0.0
        if viscous is not None and ramp is None and mode == ON:
            weights[RATIO, pair] = viscous / p.stiffness
    sign, ratio = row(weights, SIGN), row(weights, RATIO)
    for k in range(order + 1):
        set_row(guard, k, row(w.gap, k) * sign)
    if viscous is not None and ramp is None and penetrating:
        for k in range(order):
            set_row(guard, k, row(guard, k) + row(w.rate, k) * ratio)
    for pair in range(8):
        first = max(guard[0, pair], 0.0)
        if state.mode[pair] == ON:
            # released below a quarter of the depth at which it acts again, so that no pair hovers between
            first -= min(0.25 * p.release, 0.5 * first)
        elif state.mode[pair] == RELEASED and first <= 1e-6 * p.release:
            # one that rests on the wall is let go a little outside
            first = max(guard[0, pair] + 0.25 * p.release, 0.0)
        guard[0, pair] = first if p.enabled[pair] == 1 else 1.0


@kernel()
def _second_guard(p, state, w, order, pair, viscous, factor, integer, fraction, ramp) -> bool:
    """Write the second guard of a penetrating pair to `w.column[0]`; return whether it has one.

    on: 1 + lambda d' >= 0, with a ramp F >= 0; clipped: the force would pull; released: d <= p.release.
    """
    g, mode = w.column[0], state.mode[pair]
    g[order] = 0.0
    if mode == RELEASED:
        for k in range(order + 1):
            g[k] = -w.gap[k, pair]
        g[0] += p.release
    elif ramp is not None:
        _pull(p, w, order, pair, mode, viscous, integer, fraction)
    elif viscous is not None:
        if mode == ON:
            return False
        for k in range(order):
            g[k] = -(w.gap[k, pair] + viscous / p.stiffness * w.rate[k, pair])
    else:
        if factor is None:
            return False
        sign = 1.0 if mode == ON else -1.0
        for k in range(order):
            g[k] = sign * state.factor[pair] * w.rate[k, pair]
        g[0] += sign
    g[0] = max(g[0], 0.0)
    return True


@kernel()
def _pull(p, w, order, pair, mode, viscous, integer, fraction) -> None:
    """Write the force of a ramped law, negative for a clipped pair, to `w.column[0]`."""
    g, sign = w.column[0], 1.0 if mode == ON else -1.0
    for k in range(order):
        if integer is not None:
            elastic = w.power[integer - 2, k, pair]
        elif fraction is not None:
            elastic = w.power[0, k, pair]
        else:
            elastic = w.gap[k, pair]
        g[k] = sign * (p.stiffness * elastic + viscous * w.damped[k, pair])


@kernel()
def _ramp_guard(p, state, w, order, pair) -> None:
    """Write the guard of a pair that stays on its side of the ramp's end to `w.column[0]`."""
    g, sign = w.column[0], 1.0 if state.beyond[pair] == 1 else -1.0
    for k in range(order + 1):
        g[k] = sign * w.gap[k, pair]
    g[0] = max(g[0] - sign * p.ramp, 0.0)


@kernel(fast=True)
def _unsafe_pairs(w, order, h):
    """Return a bit for each guard that is not proved to stay positive on [0, h].

    The first proof is g_0 > sum |g_k| h^k; where it fails, that no Bernstein coefficient is negative.
    """
    guard, b = w.guard, w.bernstein
    reach = magnitude(row(guard, order)) * h
    for k in range(order - 1, 0, -1):
        reach = (reach + magnitude(row(guard, k))) * h
    if below(row(guard, 0), reach) == 0:
        return 0
    power = 1.0
    for k in range(order + 1):
        set_row(b, k, row(guard, k) * (power * w.binomial[order, k]))
        power *= h
    for r in range(1, order + 1):
        before = row(b, r - 1)
        for j in range(r, order + 1):
            here = row(b, j)
            set_row(b, j, here + before)
            before = here
    zero, bits = splat(0.0), 0
    for k in range(order + 1):
        bits |= below(row(b, k), zero)
    return bits


@kernel(inline=True)
def _next_mode(mode, viscous, fraction, ramp):
    """Return the mode that follows when a pair's first guard ends it."""
    if mode == OFF:
        return ON if fraction is None or fraction == 1.5 else RELEASED
    if mode == ON and viscous is not None and ramp is None:
        return CLIPPED
    return RELEASED if mode == ON and fraction is not None else OFF


@kernel()
def _sooner(state, w, order, best) -> float:
    """Return where the guard in `w.column[0]` first turns negative before `best`, else `best`."""
    column, reach = w.column[0], 0.0
    for k in range(order, 0, -1):
        reach = (reach + abs(column[k])) * best
    if column[0] >= reach:
        return best
    state.count[GUARD_ROOTS] += 1
    return min(best, first_root(column, order, best, w))


@kernel()
def _first_event(p, state, w, order, sigma, penetrating, viscous, factor, integer, fraction, ramp):
    """Return (sigma, pair, mode) of the first event in [0, sigma), or (sigma, -1, 0)."""
    _guards(p, state, w, order, penetrating, viscous, ramp)
    best, event, target = sigma, -1, 0
    unsafe = _unsafe_pairs(w, order, sigma)
    column = w.column[0]
    for pair in range(8):
        if unsafe >> pair & 1:
            for k in range(order + 1):
                column[k] = w.guard[k, pair]
            state.count[GUARD_ROOTS] += 1
            root = first_root(column, order, best, w)
            if root < best:
                best, event, target = root, pair, _next_mode(state.mode[pair], viscous, fraction, ramp)
    if penetrating:
        for pair in range(8):
            if state.mode[pair] == OFF:
                continue
            if _second_guard(p, state, w, order, pair, viscous, factor, integer, fraction, ramp):
                root = _sooner(state, w, order, best)
                if root < best:
                    best, event, target = root, pair, CLIPPED if state.mode[pair] == ON else ON
            if ramp is not None and state.mode[pair] != RELEASED:
                _ramp_guard(p, state, w, order, pair)
                root = _sooner(state, w, order, best)
                if root < best:
                    best, event, target = root, pair, CROSSING
    return best, event, target


@kernel()
def _accurate_length(p, w, order, hard):
    """Return the sigma over which the series meets its share of the tolerance, at most `hard`; NaN if not finite.

    Term k may be as large as `threshold[k]`, which falls geometrically to the admissible error at the last order (root
    test as by Jorba and Zou, sec. 3.2). All of the last `lacuna` orders are looked at, since single ones can vanish.
    """
    length = hard
    for k in range(order, order - max(p.lacuna, 2), -1):
        size = w.size[k]
        if not (size <= 1e300):
            return math.nan
        if size > 0.0:
            length = min(length, math.exp(math.log(p.threshold[k] / size) / k))
    # an error of velocity becomes one of position over a long step
    stretch = length * p.velocity_tolerance / (p.position_tolerance * (order + 1))
    if stretch > 1.0 and length < hard:
        length *= math.exp(-math.log(stretch) / order)
    return length


@kernel()
def _before_sticking(p, state, w, order, sigma) -> float:
    """Return the part of `sigma` over which the series of tanh r converges well enough.

    Far from sticking tanh r is constant to the last bit: no coefficient tells that its poles at r = +-i pi/2 come near.
    With |r - r_0| at most theta times their distance what the series leaves out is below theta^order.
    """
    theta = (p.threshold[p.order] / p.threshold[0]) ** (1.0 / order)
    length = sigma
    for pair in range(8):
        if state.mode[pair] != ON:
            continue
        change = 0.0
        for k in range(order - 1, 0, -1):
            change = (change + abs(w.slip[0, k, pair])) * length
        limit = theta * math.hypot(w.slip[0, 0, pair], 0.5 * math.pi)
        if change > limit:
            # the change is convex in sigma
            length *= limit / change
    return length


@kernel()
def _linear_load(segments, step, t0, w):
    """Add the linear load at t0 to `w.wrench` and return the time up to which it is linear."""
    piece = step[PIECE]
    while piece + 1 < segments.knots.size and segments.knots[piece + 1] <= t0:
        piece += 1
    step[PIECE] = piece
    if t0 < segments.knots[piece]:
        for j in range(3):
            w.wrench[0, j] += segments.start[piece, j]
            w.wrench[1, j] = 0.0
        return segments.knots[piece]
    for j in range(3):
        w.wrench[1, j] = segments.slope[piece, j]
        w.wrench[0, j] += segments.start[piece, j] + segments.slope[piece, j] * (t0 - segments.knots[piece])
    return segments.knots[piece + 1] if piece + 1 < segments.knots.size else np.inf


@kernel()
def _weigh_pairs(p, state, w, viscous, fraction, ramp) -> bool:
    """Write what each pair that acts contributes per order to `w.lanes`; return whether any pair penetrates."""
    mode, lanes = state.mode, w.lanes
    inside = 0
    for pair in range(8):
        lanes[BASE, pair] = 0.0
        lanes[RAMPS, pair] = 1.0 - state.beyond[pair]
        raised = mode[pair] == ON or (ramp is not None and mode[pair] == CLIPPED)
        if fraction is not None and raised and state.step[TOUCHING] >> pair & 1 == 0:
            depth = gap_and_rate(p, state, pair)[0]
            if depth > 1e-3 * p.release:
                lanes[BASE, pair] = 0.5 / math.sqrt(depth) if fraction == 1.5 else 1.0 / depth
            else:
                # interrupted right after its touch: too shallow for a series of its power
                mode[pair] = RELEASED
        acts = mode[pair] == ON
        lanes[ACTS, pair] = p.stiffness if acts else 0.0
        lanes[DAMPS, pair] = 0.0
        if acts:
            lanes[DAMPS, pair] = p.viscous if viscous is not None else p.stiffness * state.factor[pair]
        inside += 0 if mode[pair] == OFF else 1
    return inside > 0


@kernel()
def _time_to_part(
    p, state, w, span, harmonics, second, segments, viscous, factor, integer, fraction, wear, offset, free, ramp, slip
):
    """Return the time until the first pair parts, where that is what shortens steps; else 0.

    The root of a short series is enough: what it misses is left to the next step.
    """
    if fraction != 1.5:
        return 0.0
    near = False
    for pair in range(8):
        if state.mode[pair] == ON:
            depth, rate = gap_and_rate(p, state, pair)
            if rate < 0.0 and depth < -rate * _PARTING_REACH * state.clock[LAST_LENGTH]:
                near = True
    if not near:
        return 0.0
    if harmonics is not None:
        expand_harmonics(harmonics, second, state.clock[T0], 1.0, 0.0, PARTING_ORDER, w)
    order = expand(
        p,
        state,
        w,
        PARTING_ORDER,
        True,
        span,
        harmonics,
        second,
        segments,
        viscous,
        factor,
        integer,
        fraction,
        wear,
        offset,
        free,
        ramp,
        slip,
    )
    state.count[COEFFICIENTS] += order
    first = np.inf
    for pair in range(8):
        if state.mode[pair] != ON or w.gap[1, pair] >= 0.0:
            continue
        t = -w.gap[0, pair] / w.gap[1, pair]
        if t > _PARTING_REACH * state.clock[LAST_LENGTH]:
            continue
        for _ in range(6):
            value, slope = w.gap[order, pair], 0.0
            for k in range(order - 1, -1, -1):
                slope = slope * t + value
                value = value * t + w.gap[k, pair]
            if not slope < 0.0:
                break
            change = value / slope
            t -= change
            if abs(change) < 1e-9 * t:
                first = min(first, t)
                break
    return first if 0.0 < first < np.inf else 0.0


@kernel()
def begin(
    p,
    state,
    w,
    hard_time,
    harmonics,
    second,
    segments,
    viscous,
    factor,
    integer,
    fraction,
    wear,
    offset,
    free,
    ramp,
    slip,
    implicit,
    parts,
) -> bool:
    """Lay out the next step, at most to `hard_time`; return False when it is not finite."""
    clock, step = state.clock, state.step
    t0 = clock[T0]
    penetrating = _weigh_pairs(p, state, w, viscous, fraction, ramp)
    for j in range(3):
        w.wrench[0, j] = p.constant[j]
    if segments is not None:
        hard_time = min(hard_time, _linear_load(segments, step, t0, w))
    clock[HARD_END] = hard_time
    span = min(hard_time - t0, LONGEST_STEP)
    limited = span < LONGEST_STEP
    clock[ALPHA], clock[BETA] = 1.0, 0.0
    hard, length = span, 0.0
    if implicit is not None and penetrating and step[OVERDAMPED] >= PATIENCE:
        length = collocate(p, parts, state, w, span, implicit)
    if length > 0.0:
        order, sigma = STAGES, length
        state.count[STEPS] += 1
    else:
        if step[TOUCHING] != 0:
            # a force that starts like d^1.5 is analytic in the square root of time
            clock[ALPHA], clock[BETA] = 0.0, 2.0
            hard = math.sqrt(span)
        elif fraction is not None and penetrating:
            parting = _time_to_part(
                p,
                state,
                w,
                span,
                harmonics,
                second,
                segments,
                viscous,
                factor,
                integer,
                fraction,
                wear,
                offset,
                free,
                ramp,
                slip,
            )
            if parting > 0.0:
                # one that ends like d^1.5 is analytic in the root of the time left
                root = math.sqrt(parting)
                clock[ALPHA], clock[BETA] = 2.0 * root, -2.0
                hard = root if parting <= span else root - math.sqrt(parting - span)
                limited = limited and parting > span
            elif fraction == 1.5 and 0.0 < t0 - clock[TOUCHED] < _TOUCH_REACH * clock[LAST_LENGTH]:
                # and still in the root of the time since its start, some steps on
                root = math.sqrt(t0 - clock[TOUCHED])
                clock[ALPHA], clock[BETA] = 2.0 * root, 2.0
                hard = math.sqrt(t0 - clock[TOUCHED] + span) - root
        if harmonics is not None:
            expand_harmonics(harmonics, second, t0, clock[ALPHA], clock[BETA], p.order, w)
        order = expand(
            p,
            state,
            w,
            p.order,
            penetrating,
            hard,
            harmonics,
            second,
            segments,
            viscous,
            factor,
            integer,
            fraction,
            wear,
            offset,
            free,
            ramp,
            slip,
        )
        state.count[STEPS] += 1
        state.count[COEFFICIENTS] += order
        sigma = hard if order < p.order else _accurate_length(p, w, order, hard)
        if not math.isfinite(sigma):
            return False
        if slip is not None:
            sigma = _before_sticking(p, state, w, order, sigma)
        if implicit is not None and penetrating:
            note_explicit(p, state, w, clock[ALPHA] * sigma + 0.5 * clock[BETA] * sigma * sigma, sigma < hard)
    limited = limited and sigma == hard
    end, pair, target = _first_event(p, state, w, order, sigma, penetrating, viscous, factor, integer, fraction, ramp)
    if pair >= 0 and step[STALL] > p.max_events:
        # modes flip at one instant: go on past it with the modes as they are
        state.count[RECOVERIES] += 1
        end, pair = max(end, min(sigma, 1e-9)), -1
        limited = limited and end == sigma
    clock[SIGMA] = end
    clock[LENGTH] = clock[ALPHA] * end + 0.5 * clock[BETA] * end * end
    if limited and pair < 0:
        clock[LENGTH] = span
    clock[USED] = 0.0
    step[ORDER], step[EVENT_PAIR], step[EVENT_TO] = order, pair, target
    step[AT_HARD_END] = 1 if limited and pair < 0 else 0
    return True


@kernel(inline=True)
def sigma_at(state, used):
    """Return sigma at `used` seconds into the step."""
    clock = state.clock
    if used >= clock[LENGTH]:
        return clock[SIGMA]
    if clock[BETA] == 0.0:
        return used
    # the root of alpha sigma + beta sigma^2 / 2 = used that suffers no cancellation
    return 2.0 * used / (clock[ALPHA] + math.sqrt(max(clock[ALPHA] ** 2 + 2.0 * clock[BETA] * used, 0.0)))


@kernel(fast=True)
def evaluate(state, w, sigma, out) -> None:
    """Write the body-coordinate state at sigma to `out`, shape (8,)."""
    order, series = state.step[ORDER], w.series
    value = row(series, order)
    for k in range(order - 1, -1, -1):
        value = value * sigma + row(series, k)
    set_row(out, 0, value)


@kernel()
def pose_of(y, offset, q, v) -> None:
    """Write pose and rate of the cavity's centre in world axes from body coordinates; inverse of `body_state`."""
    c, s, x, yy, vx, vy, om = y[COS], y[SIN], y[0], y[1], y[VX], y[VY], y[OMEGA]
    if offset is not None:
        x, yy = x - offset[0], yy - offset[1]
        vx, vy = vx + om * offset[1], vy - om * offset[0]
    q[0], q[1], q[2] = c * x - s * yy, s * x + c * yy, y[THETA]
    v[0], v[1], v[2] = c * vx - s * vy, s * vx + c * vy, om


@kernel()
def pair_outputs(p, state, depth, y, penetration, rate, force) -> None:
    """Write penetration, rate and force of the eight pairs in body coordinates y, worn by `depth`; shape (8,) each."""
    A = p.gap
    c, s, om = y[COS], y[SIN], y[OMEGA]
    for pair in range(8):
        d = A[0, pair] * c + A[1, pair] * s + A[2, pair] * y[0] + A[3, pair] * y[1] + A[4, pair] - depth[pair]
        r = om * (A[1, pair] * c - A[0, pair] * s) + A[2, pair] * (y[VX] + om * y[1]) + A[3, pair] * (y[VY] - om * y[0])
        penetration[pair], rate[pair], force[pair] = d, r, 0.0
        if state.mode[pair] == ON:
            force[pair] = normal_force(d, r, p.stiffness, p.exponent, state.factor[pair], p.viscous, p.ramp)


@kernel(fast=True)
def _sums(w, order, h) -> None:
    """Write bound and integrals of each force over [0, h]: sum |f_k| h^k, sum f_k h^k / (k+1), sum f_k h^k / (k+2)."""
    bound = first = second = splat(0.0)
    for k in range(order, -1, -1):
        force = row(w.force, k)
        bound = bound * h + magnitude(force)
        first = first * h + force * w.inverse[k + 1]
        second = second * h + force * w.inverse[k + 2]
    set_row(w.lanes, SUM, bound)
    set_row(w.lanes, FIRST, first)
    set_row(w.lanes, SECOND, second)


@kernel()
def account(state, w, low, high, totals) -> None:
    """Add what happened between two sigmas of the step to the totals: peaks, impulses, times, sets of corners."""
    mode = state.mode
    acting = 0
    for pair in range(8):
        acting += 1 if mode[pair] == ON else 0
    if acting == 0:
        return
    order, clock = state.step[ORDER] - 1, state.clock
    alpha, beta = clock[ALPHA] + clock[BETA] * low, clock[BETA]
    h = high - low
    elapsed = alpha * h + 0.5 * beta * h * h
    if low > 0.0:
        for pair in range(8):
            shift_column(w.force, pair, order, low, w.bernstein)
        _swap_rows(w.force, w.bernstein, order)
    _sums(w, order, h)
    ccw = cw = 0
    for pair in range(8):
        if mode[pair] != ON:
            continue
        totals.impulse[pair] += max(0.0, (alpha * w.lanes[FIRST, pair] + beta * h * w.lanes[SECOND, pair]) * h)
        if w.lanes[SUM, pair] > totals.peak[pair]:
            for k in range(order + 1):
                w.column[0, k] = w.force[k, pair]
            totals.peak[pair] = maximum(w.column[0], order, h, totals.peak[pair], w)
        totals.time_in_contact[pair] += elapsed
        # pairs 0, 3, 4, 7 stop a counter-clockwise swing, the others a clockwise one
        corner = pair // 2
        if (pair + corner) % 2 == 0:
            ccw |= 1 << corner
        else:
            cw |= 1 << corner
    if low > 0.0:
        _swap_rows(w.force, w.bernstein, order)
    totals.set_time[0, ccw] += elapsed if ccw != 0 else 0.0
    totals.set_time[1, cw] += elapsed if cw != 0 else 0.0


@kernel()
def _swap_rows(a, b, order) -> None:
    for k in range(order + 1):
        for lane in range(8):
            a[k, lane], b[k, lane] = b[k, lane], a[k, lane]


@kernel(inline=True)
def _slow_touch(p) -> float:
    """Return the speed below which a pair cannot reach the release depth by the speed of its touch alone."""
    acceleration = p.threshold[0] * p.weight / p.radius
    return 1e-3 * math.sqrt(2.0 * acceleration * p.release)


@kernel(inline=True)
def _penetrating(state) -> bool:
    inside = 0
    for pair in range(8):
        inside += 0 if state.mode[pair] == OFF else 1
    return inside > 0


@kernel(fast=True)
def worn_depth(state, w, sigma, out) -> None:
    """Write each pad's wear depth at sigma of the step to `out`, shape (8,)."""
    depth = row(state.depth, 0)
    if _penetrating(state):
        # row 0 would be the depth itself; pairs without force do not wear
        order = state.step[ORDER]
        growth = row(w.worn, order)
        for k in range(order - 1, 0, -1):
            growth = growth * sigma + row(w.worn, k)
        depth = depth + growth * sigma
    set_row(out, 0, depth)


@kernel()
def finish(p, state, w, totals, log, wear, fraction) -> None:
    """Move the state to the step's end and switch the mode that its event changes."""
    clock, step, y = state.clock, state.step, state.y
    sigma = clock[SIGMA]
    if wear is not None:
        worn_depth(state, w, sigma, state.depth)
    evaluate(state, w, sigma, y)
    y[COS], y[SIN] = math.cos(y[THETA]), math.sin(y[THETA])
    before = clock[T0]
    clock[T0] = before + clock[LENGTH]
    if step[AT_HARD_END] == 1:
        clock[T0] = clock[HARD_END]
    clock[NOW] = clock[T0]
    clock[LENGTH] = -1.0
    clock[USED] = 0.0
    clock[LAST_LENGTH] = clock[T0] - before
    at_once = clock[T0] - before <= 1e-15 * (1.0 + abs(before))
    touching = step[TOUCHING] if at_once else 0
    step[TOUCHING] = 0
    pair = step[EVENT_PAIR]
    if pair < 0:
        step[STALL] = 0
        return
    step[STALL] = step[STALL] + 1 if at_once else 0
    old, new = state.mode[pair], step[EVENT_TO]
    if new == CROSSING:
        state.beyond[pair] = 1 - state.beyond[pair]
        new = old
    state.mode[pair] = new
    state.count[EVENTS] += 1
    if fraction is not None:
        step[TOUCHING] = touching & ~(1 << pair)
    step[OVERDAMPED] = 0
    if new == OFF:
        state.beyond[pair] = 0
    if old == OFF:
        touch(p, state, pair)
        totals.makes[pair] += 1
        if fraction is not None and new == ON:
            if gap_and_rate(p, state, pair)[1] > _slow_touch(p):
                step[TOUCHING] |= 1 << pair
                clock[TOUCHED] = clock[T0]
            else:
                state.mode[pair] = RELEASED
    # to the outside a released pair is on
    old, new = ON if old == RELEASED else old, ON if new == RELEASED else new
    if log is not None and old != new:
        i = log.length[0]
        log.time[i], log.pair[i] = clock[T0], pair
        log.mode_from[i], log.mode_to[i] = old, new
        log.rate[i] = gap_and_rate(p, state, pair)[1]
        log.length[0] = i + 1


@kernel()
def within_range(p, state, y) -> bool:
    """Tell whether the model holds in body coordinates y: |theta| <= 45 degrees, no pair beyond half the cavity."""
    deepest = 0.0
    for pair in range(8):
        if p.enabled[pair] == 1:
            A = p.gap
            depth = A[0, pair] * y[COS] + A[1, pair] * y[SIN] + A[2, pair] * y[0] + A[3, pair] * y[1] + A[4, pair]
            deepest = max(deepest, depth - state.depth[pair])
    return abs(y[THETA]) <= 0.7853981633974483 and deepest <= p.half_cavity
