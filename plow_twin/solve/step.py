"""One step: series, length, first event, what happened in it, and the switch at its end.

A step never depends on where output is wanted. It ends at an event, at a knot of the load, or where its series stops being
accurate. Guards are polynomials that stay >= 0 while a mode lasts; `polynomial.first_root` finds the first that does not.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.model.contact import normal_force
from plow_twin.model.kernel import kernel
from plow_twin.solve.layout import (
    ALPHA,
    AT_HARD_END,
    BETA,
    CLIPPED,
    COEFFICIENTS,
    COS,
    EVENT_PAIR,
    EVENT_TO,
    EVENTS,
    GUARD_ROOTS,
    HARD_END,
    LENGTH,
    OFF,
    OMEGA,
    ON,
    ORDER,
    PIECE,
    RECOVERIES,
    RELEASED,
    SIGMA,
    SIN,
    STALL,
    STEPS,
    T0,
    THETA,
    TOUCHING,
    USED,
    VX,
    VY,
)
from plow_twin.solve.polynomial import columns_to_bernstein, first_root, maximum, shift
from plow_twin.solve.series import expand, expand_harmonics

#: Longest step in s; keeps every power of it finite.
LONGEST_STEP = 100.0


@kernel(inline=True)
def gap_and_rate(p, state, pair):  # type: ignore[no-untyped-def]
    """Return penetration and its rate of one pair at the step's start."""
    y, A = state.y, p.gap
    c, s, om = y[COS], y[SIN], y[OMEGA]
    d = A[0, pair] * c + A[1, pair] * s + A[2, pair] * y[0] + A[3, pair] * y[1] + A[4, pair] - state.depth[pair]
    r = om * (A[1, pair] * c - A[0, pair] * s) + A[2, pair] * (y[VX] + om * y[1]) + A[3, pair] * (y[VY] - om * y[0])
    return d, r


@kernel()
def touch(p, state, pair) -> None:  # type: ignore[no-untyped-def]
    """Start a contact: read its impact speed, lambda = D / v0."""
    if p.damping_factor >= 0.0:
        _, speed = gap_and_rate(p, state, pair)
        state.factor[pair] = p.damping_factor / max(speed, p.speed_floor)


@kernel()
def settle_modes(p, state) -> None:  # type: ignore[no-untyped-def]
    """Choose each pair's mode from its penetration, where a motion starts or is changed from outside."""
    for pair in range(8):
        state.mode[pair] = OFF
        if p.enabled[pair] == 1 and gap_and_rate(p, state, pair)[0] > 0.0:
            touch(p, state, pair)
            state.mode[pair] = ON if gap_and_rate(p, state, pair)[0] >= p.release else RELEASED
    state.clock[USED] = 0.0
    state.clock[LENGTH] = -1.0
    state.step[TOUCHING] = 0
    state.step[STALL] = 0


@kernel(fast=True)
def _guards(p, state, w, order, viscous) -> bool:  # type: ignore[no-untyped-def]
    """Write each pair's first guard to `w.guard`; return whether some pair has a second one."""
    gap, guard, mode = w.gap, w.guard, state.mode
    for lane in range(8):
        sign = -1.0 if mode[lane] == OFF else 1.0
        for k in range(order + 1):
            guard[k, lane] = sign * gap[k, lane]
    second = False
    for lane in range(8):
        if p.enabled[lane] == 0:
            for k in range(1, order + 1):
                guard[k, lane] = 0.0
            guard[0, lane] = 1.0
            continue
        if mode[lane] == ON:
            if viscous is not None:
                # F / K = d + (C / K) d'
                ratio = viscous / p.stiffness
                for k in range(order):
                    guard[k, lane] += ratio * w.rate[lane, k]
            else:
                second = True
                # released below a quarter of the depth at which it acts again, so that no pair hovers between
                guard[0, lane] -= min(0.25 * p.release, 0.5 * max(guard[0, lane], 0.0))
        elif mode[lane] != OFF:
            second = True
        guard[0, lane] = max(guard[0, lane], 0.0)
    return second


@kernel()
def _second_guard(p, state, w, order, pair, viscous, factor) -> bool:  # type: ignore[no-untyped-def]
    """Write the second guard of a penetrating pair to `w.scratch[0]`; return whether it has one."""
    g, mode = w.scratch[0], state.mode[pair]
    if mode == ON and factor is None:
        return False
    sign = 1.0 if mode == ON else -1.0
    g[order] = 0.0
    if mode == RELEASED:
        for k in range(order + 1):
            g[k] = -w.gap[k, pair]
        g[0] += p.release
    elif viscous is not None:
        for k in range(order):
            g[k] = sign * (w.gap[k, pair] + viscous / p.stiffness * w.rate[pair, k])
    else:
        scale = sign * state.factor[pair]
        for k in range(order):
            g[k] = scale * w.rate[pair, k]
        g[0] += sign
    g[0] = max(g[0], 0.0)
    return True


@kernel(fast=True)
def _unsafe_lanes(guard, order, h):  # type: ignore[no-untyped-def]
    """Return a bit for each guard that |g_0| > sum |g_k| h^k does not prove to keep its sign on [0, h]."""
    bits = 0
    total = np.zeros(8)
    for k in range(order, 0, -1):
        for lane in range(8):
            total[lane] = (total[lane] + abs(guard[k, lane])) * h
    for lane in range(8):
        if guard[0, lane] < total[lane]:
            bits |= 1 << lane
    return bits


@kernel()
def _first_event(p, state, w, order, sigma, active, count, viscous, factor, fraction):  # type: ignore[no-untyped-def]
    """Return (sigma, pair, mode) of the first event in [0, sigma), or (sigma, -1, 0)."""
    has_second = _guards(p, state, w, order, viscous)
    best, event, target = sigma, -1, 0
    unsafe = _unsafe_lanes(w.guard, order, sigma)
    if unsafe != 0:
        columns_to_bernstein(w.guard, order, sigma, w.binomial[order], w.bernstein)
        for pair in range(8):
            if unsafe >> pair & 1 == 0:
                continue
            lowest = 0.0
            for k in range(order + 1):
                lowest = min(lowest, w.bernstein[k, pair])
            if lowest < 0.0:
                for k in range(order + 1):
                    w.scratch[0, k] = w.guard[k, pair]
                state.count[GUARD_ROOTS] += 1
                root = first_root(w.scratch[0], order, best, w)
                if root < best:
                    mode = state.mode[pair]
                    best, event = root, pair
                    if mode == OFF:
                        target = ON if fraction is None or fraction == 1.5 else RELEASED
                    elif mode == ON and viscous is not None:
                        target = CLIPPED
                    elif mode == ON and fraction is not None:
                        target = RELEASED
                    else:
                        target = OFF
    if has_second:
        for i in range(count):
            pair = active[i]
            if not _second_guard(p, state, w, order, pair, viscous, factor):
                continue
            g = w.scratch[0]
            reach = 0.0
            for k in range(order, 0, -1):
                reach = (reach + abs(g[k])) * best
            if g[0] < reach:
                state.count[GUARD_ROOTS] += 1
                root = first_root(g, order, best, w)
                if root < best:
                    best, event, target = root, pair, CLIPPED if state.mode[pair] == ON else ON
    return best, event, target


@kernel(inline=True)
def _term_size(p, series, k):  # type: ignore[no-untyped-def]
    """Return the size of order k as a velocity."""
    weight = p.radius * p.velocity_tolerance / p.position_tolerance
    size = abs(series[k, VX]) + abs(series[k, VY]) + p.radius * abs(series[k, OMEGA])
    return size + weight * (abs(series[k, COS]) + abs(series[k, SIN]))


@kernel()
def _accurate_length(p, w, order, hard):  # type: ignore[no-untyped-def]
    """Return the sigma over which the series meets the step's share of the tolerance, at most `hard`; NaN if not finite.

    Term k may be as large as `threshold[k]`, which falls geometrically to the admissible error at the last order (root
    test as by Jorba and Zou, sec. 3.2). All of the last `lacuna` orders are looked at, since single ones can vanish.
    """
    length = hard
    for k in range(order, order - max(p.lacuna, 2), -1):
        size = _term_size(p, w.series, k)
        if not (size <= 1e300):
            return math.nan
        if size * length**k > p.threshold[k]:
            length = math.exp(math.log(p.threshold[k] / size) / k)
    # an error of velocity becomes one of position over a long step
    stretch = length * p.velocity_tolerance / (p.position_tolerance * (order + 1))
    if stretch > 1.0 and length < hard:
        length *= math.exp(-math.log(stretch) / order)
    return length


@kernel()
def begin(p, state, w, hard_time, harmonics, second, segments, viscous, factor, integer, fraction, wear, offset, free) -> bool:  # type: ignore[no-untyped-def]  # noqa: E501
    """Lay out the next step, at most to `hard_time`; return False when it is not finite."""
    clock, step, mode = state.clock, state.step, state.mode
    t0 = clock[T0]
    active = np.empty(8, np.int64)
    count = 0
    for pair in range(8):
        if mode[pair] != OFF:
            active[count] = pair
            count += 1
    start, slope = p.constant.copy(), None
    if segments is not None:
        piece = step[PIECE]
        while piece + 1 < segments.knots.size and segments.knots[piece + 1] <= t0:
            piece += 1
        step[PIECE] = piece
        slope = np.zeros(3)
        ahead = segments.knots[0]
        if t0 >= segments.knots[piece]:
            slope = segments.slope[piece]
            ahead = segments.knots[piece + 1] if piece + 1 < segments.knots.size else np.inf
        start = start + segments.start[piece] + slope * max(t0 - segments.knots[piece], 0.0)
        hard_time = min(hard_time, ahead)
    clock[HARD_END] = hard_time
    span = min(hard_time - t0, LONGEST_STEP)
    limited = span < LONGEST_STEP
    clock[ALPHA], clock[BETA] = 1.0, 0.0
    hard = span
    if step[TOUCHING] != 0:
        # a force that starts like d^1.5 is analytic in the square root of time
        clock[ALPHA], clock[BETA] = 0.0, 2.0
        hard = math.sqrt(span)
    if harmonics is not None:
        expand_harmonics(harmonics, second, t0, clock[ALPHA], clock[BETA], p.order, w)
    order = expand(
        p, state, w, active, count, start, slope, hard, harmonics, second, viscous, factor, integer, fraction, wear, offset, free
    )
    state.count[STEPS] += 1
    state.count[COEFFICIENTS] += order
    if order < p.order:
        sigma = hard
    else:
        sigma = _accurate_length(p, w, order, hard)
    if not math.isfinite(sigma):
        return False
    limited = limited and sigma == hard
    end, pair, target = _first_event(p, state, w, order, sigma, active, count, viscous, factor, fraction)
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
def sigma_at(state, used):  # type: ignore[no-untyped-def]
    """Return sigma at `used` seconds into the step."""
    clock = state.clock
    if used >= clock[LENGTH]:
        return clock[SIGMA]
    return used if clock[BETA] == 0.0 else math.sqrt(2.0 * used / clock[BETA])


@kernel(fast=True)
def evaluate(state, w, sigma, out) -> None:  # type: ignore[no-untyped-def]
    """Write the body-coordinate state at sigma to `out`, shape (8,)."""
    order, series = state.step[ORDER], w.series
    for i in range(8):
        out[i] = series[order, i]
    for k in range(order - 1, -1, -1):
        for i in range(8):
            out[i] = out[i] * sigma + series[k, i]


@kernel()
def pose_of(y, offset, q, v) -> None:  # type: ignore[no-untyped-def]
    """Write pose and rate of the cavity's centre in world axes from body coordinates; inverse of `body_state`."""
    c, s, x, yy, vx, vy, om = y[COS], y[SIN], y[0], y[1], y[VX], y[VY], y[OMEGA]
    if offset is not None:
        x, yy = x - offset[0], yy - offset[1]
        vx, vy = vx + om * offset[1], vy - om * offset[0]
    q[0], q[1], q[2] = c * x - s * yy, s * x + c * yy, y[THETA]
    v[0], v[1], v[2] = c * vx - s * vy, s * vx + c * vy, om


@kernel()
def pair_outputs(p, state, y, penetration, rate, force) -> None:  # type: ignore[no-untyped-def]
    """Write penetration, rate and force of the eight pairs in body coordinates y, shape (8,) each."""
    A = p.gap
    c, s, om = y[COS], y[SIN], y[OMEGA]
    for pair in range(8):
        d = A[0, pair] * c + A[1, pair] * s + A[2, pair] * y[0] + A[3, pair] * y[1] + A[4, pair] - state.depth[pair]
        r = om * (A[1, pair] * c - A[0, pair] * s) + A[2, pair] * (y[VX] + om * y[1]) + A[3, pair] * (y[VY] - om * y[0])
        penetration[pair], rate[pair], force[pair] = d, r, 0.0
        if state.mode[pair] == ON:
            force[pair] = normal_force(d, r, p.stiffness, p.exponent, state.factor[pair], p.viscous)


@kernel()
def account(state, w, low, high, totals) -> None:  # type: ignore[no-untyped-def]
    """Add what happened between two sigmas of the step to the totals: peaks, impulses, times, sets of corners."""
    order, clock = state.step[ORDER] - 1, state.clock
    alpha, beta = clock[ALPHA] + clock[BETA] * low, clock[BETA]
    h = high - low
    elapsed = alpha * h + 0.5 * beta * h * h
    sets = np.zeros(2, np.int64)
    for pair in range(8):
        if state.mode[pair] != ON:
            continue
        f = w.force[pair]
        if low > 0.0:
            shift(f, order, low, w.scratch[1])
            f = w.scratch[1]
        bound, first, second = 0.0, 0.0, 0.0
        for k in range(order, -1, -1):
            bound = bound * h + abs(f[k])
            first = first * h + f[k] * w.inverse[k + 1]
            second = second * h + f[k] * w.inverse[k + 2]
        totals.impulse[pair] += max(0.0, (alpha * first + beta * h * second) * h)
        if bound > totals.peak[pair]:
            totals.peak[pair] = maximum(f, order, h, totals.peak[pair], w)
        totals.time_in_contact[pair] += elapsed
        # pairs 0, 3, 4, 7 stop a counter-clockwise swing, the others a clockwise one
        corner = pair // 2
        sets[(pair + corner) % 2] |= 1 << corner
    for sense in range(2):
        if sets[sense] != 0:
            totals.set_time[sense, sets[sense]] += elapsed


@kernel()
def finish(p, state, w, totals, log, wear, fraction) -> None:  # type: ignore[no-untyped-def]
    """Move the state to the step's end and switch the mode that its event changes."""
    clock, step, y = state.clock, state.step, state.y
    sigma, order = clock[SIGMA], step[ORDER]
    if wear is not None:
        for pair in range(8):
            if state.mode[pair] == ON:
                # coefficients 1..order of the depth; coefficient 0 is the depth itself
                worn = w.worn[pair]
                value = worn[order]
                for k in range(order - 1, 0, -1):
                    value = value * sigma + worn[k]
                state.depth[pair] += value * sigma
    moved = np.empty(8)
    evaluate(state, w, sigma, moved)
    y[:] = moved
    y[COS], y[SIN] = math.cos(y[THETA]), math.sin(y[THETA])
    before = clock[T0]
    clock[T0] = before + clock[LENGTH]
    if step[AT_HARD_END] == 1:
        clock[T0] = clock[HARD_END]
    clock[LENGTH] = -1.0
    clock[USED] = 0.0
    at_once = clock[T0] - before <= 1e-15 * (1.0 + abs(before))
    touching = step[TOUCHING] if at_once else 0
    step[TOUCHING] = 0
    pair = step[EVENT_PAIR]
    if pair < 0:
        step[STALL] = 0
        return
    step[STALL] = step[STALL] + 1 if at_once else 0
    old, new = state.mode[pair], step[EVENT_TO]
    state.mode[pair] = new
    state.count[EVENTS] += 1
    if fraction is not None:
        step[TOUCHING] = touching & ~(1 << pair)
    if old == OFF:
        touch(p, state, pair)
        totals.makes[pair] += 1
        if fraction is not None and new == ON:
            if gap_and_rate(p, state, pair)[1] > 0.0:
                step[TOUCHING] |= 1 << pair
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
def within_range(p, state) -> bool:  # type: ignore[no-untyped-def]
    """Tell whether the model still holds: |theta| <= 45 degrees and no penetration beyond half the cavity."""
    if abs(state.y[THETA]) > 0.7853981633974483:
        return False
    for pair in range(8):
        if p.enabled[pair] == 1 and gap_and_rate(p, state, pair)[0] > p.half_cavity:
            return False
    return True
