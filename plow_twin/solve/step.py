"""One step: series, step size, first event, what happened in it, and the switch at its end.

A step never depends on where output is wanted. It ends at an event, at a knot of the load, or where its series stops
being accurate.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.solve.dense_output import evaluate, wear_depth_at
from plow_twin.solve.events import first_event, note_switches
from plow_twin.solve.method.flight import take_off
from plow_twin.solve.method.implicit import STAGES, collocate, decay_rate, has_decayed, note_decay, stable_decay
from plow_twin.solve.method.rest import settle
from plow_twin.solve.method.step_size import accurate_step, before_sticking, time_to_separation
from plow_twin.solve.method.taylor import expand, expand_harmonics, one_by_one
from plow_twin.solve.modes import penetration_and_rate, slow_touch, touch, weigh_pairs
from plow_twin.solve.state import COS, CROSSING, OFF, ON, RELEASED, SIN, THETA

#: Longest step in s; keeps every power of it finite.
LONGEST_STEP = 100.0
#: A touch no farther back than so many steps like the last still shapes the series.
_TOUCH_REACH = 2.5


@kernel()
def _linear_load(segments, state, t0, w):
    """Add the linear load at t0 to `w.wrench` and return the time up to which it is linear."""
    piece = state.piece
    while piece + 1 < segments.size and segments[piece + 1].knot <= t0:
        piece += 1
    state.piece = piece
    here = segments[piece]
    if t0 < here.knot:
        for j in range(3):
            w.wrench[0, j] += here.start[j]
        return here.knot
    for j in range(3):
        w.wrench[1, j] = here.slope[j]
        w.wrench[0, j] += here.start[j] + here.slope[j] * (t0 - here.knot)
    return segments[piece + 1].knot if piece + 1 < segments.size else np.inf


@kernel(inline=True)
def _note(state, sigma, step_size, order, pair, target, ends_at_stop) -> None:
    """Note the step that has been laid out."""
    state.sigma_end, state.step_size, state.elapsed = sigma, step_size, 0.0
    state.order, state.event_pair, state.event_mode = order, pair, target
    state.ends_at_stop = 1 if ends_at_stop else 0


@kernel()
def lay_out_step(
    p,
    parts,
    state,
    w,
    stop_time,
    harmonics,
    second,
    segments,
    viscous,
    hysteretic,
    integer,
    fraction,
    ramp,
    wear,
    offset,
    free,
    slip,
    implicit,
    flight,
    rest,
) -> bool:
    """Lay out the next step, at most to `stop_time`; return False when it is not finite."""
    t0 = state.step_start
    penetrating = weigh_pairs(p, state, w, viscous, fraction, ramp)
    for j in range(3):
        w.wrench[0, j], w.wrench[1, j] = p.constant[j], 0.0
    if segments is not None:
        stop_time = min(stop_time, _linear_load(parts.segments, state, t0, w))
    state.stop_time = stop_time
    span = min(stop_time - t0, LONGEST_STEP)
    limited = span < LONGEST_STEP
    state.alpha, state.beta = 1.0, 0.0
    sigma_limit, step_size = span, 0.0
    state.steps += 1
    if flight is not None:
        step_size = 0.0 if penetrating else take_off(p, parts.harmonics, state, w, span)
        state.in_flight = 1 if step_size > 0.0 else 0
    if rest is not None:
        steady = penetrating and w.wrench[1, 0] == 0.0 and w.wrench[1, 1] == 0.0 and w.wrench[1, 2] == 0.0
        state.at_rest = 1 if steady and settle(p, parts, state, w) else 0
        step_size = span if state.at_rest == 1 else 0.0
    if (flight is not None or rest is not None) and step_size > 0.0:
        _note(state, step_size, step_size, 1, -1, 0, limited and step_size == span)
        return True
    if implicit is not None:
        state.implicit_size_before, state.decay_times_before = state.implicit_size, state.decay_times
        state.refused_before = state.refused
        decay = decay_rate(p, state, w, slip) if penetrating else 0.0
        if decay > 0.0 and state.touching == 0 and has_decayed(p, state):
            step_size = collocate(p, parts, state, w, span, decay, implicit, ramp, wear)
    if step_size > 0.0:
        order, sigma = STAGES, step_size
    else:
        if state.touching != 0:
            # a force that starts like d^1.5 is analytic in the square root of time
            state.alpha, state.beta = 0.0, 2.0
            sigma_limit = math.sqrt(span)
        elif fraction is not None and penetrating:
            parting = time_to_separation(p, parts, state, w, span, harmonics) if p.exponent == 1.5 else 0.0
            if parting > 0.0:
                # one that ends like d^1.5 is analytic in the root of the time left
                root = math.sqrt(parting)
                state.alpha, state.beta = 2.0 * root, -2.0
                sigma_limit = root if parting <= span else root - math.sqrt(parting - span)
                limited = limited and parting > span
            elif p.exponent == 1.5 and 0.0 < t0 - state.touch_time < _TOUCH_REACH * state.last_step_size:
                # and still in the root of the time since its start, some steps on
                root = math.sqrt(t0 - state.touch_time)
                state.alpha, state.beta = 2.0 * root, 2.0
                sigma_limit = math.sqrt(t0 - state.touch_time + span) - root
        if harmonics is not None:
            expand_harmonics(parts.harmonics, second, t0, state.alpha, state.beta, p.order, w)
        terms = one_by_one(parts.terms)
        order = expand(p, state, w, p.order, penetrating, sigma_limit, *terms)
        state.evaluations += order
        sigma = sigma_limit if order < p.order else accurate_step(p, w, order, sigma_limit)
        if not math.isfinite(sigma):
            return False
        if slip is not None:
            sigma = before_sticking(p, state, w, order, sigma)
        if implicit is not None and decay > 0.0 and state.beta == 0.0:
            sigma = min(sigma, stable_decay(p.order) / decay)
    limited = limited and sigma == sigma_limit
    end, pair, target = first_event(
        p, state, w, order, sigma, penetrating, viscous, hysteretic, integer, fraction, ramp
    )
    if pair >= 0 and state.events_at_once > p.max_events:
        # modes flip at one instant: go on past it with the modes as they are
        state.recoveries += 1
        end, pair = max(end, min(sigma, 1e-9)), -1
        limited = limited and end == sigma
    if pair >= 0:
        note_switches(p, state, w, order, end, pair, target, penetrating, viscous, hysteretic, integer, fraction, ramp)
    limited = limited and pair < 0
    step_size = span if limited else state.alpha * end + 0.5 * state.beta * end * end
    if implicit is not None:
        note_decay(state, decay, step_size)
        if pair >= 0:
            # a long polynomial may bring a pair that only hovers at its wall back to it; a short one knows better
            state.implicit_size = min(state.implicit_size, 4.0 * step_size)
    _note(state, end, step_size, order, pair, target, limited)
    return True


@kernel()
def complete_step(p, parts, state, w, totals, log, wear, fraction) -> None:
    """Move the state to the step's end and switch the mode that its event changes."""
    y = state.y
    sigma = state.sigma_end
    if wear is not None:
        wear_depth_at(state, w, sigma, state.wear_depth)
    evaluate(p, parts, state, w, sigma, y)
    y[COS], y[SIN] = math.cos(y[THETA]), math.sin(y[THETA])
    before = state.step_start
    state.step_start = before + state.step_size
    if state.ends_at_stop == 1:
        state.step_start = state.stop_time
    state.time = state.step_start
    state.step_size = -1.0
    state.elapsed = 0.0
    state.last_step_size = state.step_start - before
    at_once = state.step_start - before <= 1e-15 * (1.0 + abs(before))
    touching = state.touching if at_once else 0
    state.touching = 0
    if state.event_pair < 0:
        state.events_at_once = 0
        return
    state.events_at_once = state.events_at_once + 1 if at_once else 0
    state.refused, state.decay_times = 0, 0.0
    if fraction is not None:
        state.touching = touching
    for pair in range(8):
        if w.switch[pair] >= 0:
            _switch(p, state, pair, w.switch[pair], totals, log, fraction)


@kernel()
def _switch(p, state, pair, new, totals, log, fraction) -> None:
    """Let a pair change its mode; note it."""
    old = state.mode[pair]
    if new == CROSSING:
        state.beyond_ramp[pair] = 1 - state.beyond_ramp[pair]
        new = old
    state.mode[pair] = new
    state.events += 1
    if fraction is not None:
        state.touching &= ~(1 << pair)
    if new == OFF:
        state.beyond_ramp[pair] = 0
    if old == OFF:
        touch(p, state, pair)
        totals.makes[pair] += 1
        if fraction is not None and new == ON:
            if penetration_and_rate(p, state, pair)[1] > slow_touch(p):
                state.touching |= 1 << pair
                state.touch_time = state.step_start
            else:
                state.mode[pair] = RELEASED
    # to the outside a released pair is on
    old, new = ON if old == RELEASED else old, ON if new == RELEASED else new
    if log is not None and old != new:
        i = log.length[0]
        log.time[i], log.pair[i] = state.step_start, pair
        log.mode_from[i], log.mode_to[i] = old, new
        log.rate[i] = penetration_and_rate(p, state, pair)[1]
        log.length[0] = i + 1
