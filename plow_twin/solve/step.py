"""One step: series, length, first event, what happened in it, and the switch at its end.

A step never depends on where output is wanted. It ends at an event, at a knot of the load, or where its series stops
being accurate.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.model.kernel import kernel
from plow_twin.solve.contacts import gap_and_rate, slow_touch, touch, weigh_pairs
from plow_twin.solve.events import first_event
from plow_twin.solve.flight import take_off
from plow_twin.solve.layout import (
    ALPHA,
    AT_HARD_END,
    BETA,
    COEFFICIENTS,
    COS,
    CROSSING,
    EVENT_PAIR,
    EVENT_TO,
    EVENTS,
    EXPLICIT_LENGTH,
    FLYING,
    HARD_END,
    IMPLICIT_LENGTH,
    LAST_LENGTH,
    LENGTH,
    NOW,
    OFF,
    ON,
    ORDER,
    OVERDAMPED,
    PIECE,
    RECOVERIES,
    RELEASED,
    RESTING,
    SIGMA,
    SIN,
    STALL,
    STEPS,
    T0,
    THETA,
    TOUCHED,
    TOUCHING,
    USED,
    WAS_EXPLICIT,
    WAS_IMPLICIT,
    WAS_OVERDAMPED,
)
from plow_twin.solve.length import accurate_length, before_sticking, time_to_part
from plow_twin.solve.readout import evaluate, worn_depth
from plow_twin.solve.rest import settle
from plow_twin.solve.series import expand, expand_harmonics, one_by_one
from plow_twin.solve.stiff import PATIENCE, STAGES, collocate, note_explicit

#: Longest step in s; keeps every power of it finite.
LONGEST_STEP = 100.0
#: A touch no farther back than so many steps like the last still shapes the series.
_TOUCH_REACH = 2.5


@kernel()
def _linear_load(segments, step, t0, w):
    """Add the linear load at t0 to `w.wrench` and return the time up to which it is linear."""
    piece = step[PIECE]
    while piece + 1 < segments.size and segments[piece + 1].knot <= t0:
        piece += 1
    step[PIECE] = piece
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
def _note(state, sigma, length, order, pair, target, at_hard_end) -> None:
    """Note the step that has been laid out."""
    clock, step = state.clock, state.step
    clock[SIGMA], clock[LENGTH], clock[USED] = sigma, length, 0.0
    step[ORDER], step[EVENT_PAIR], step[EVENT_TO] = order, pair, target
    step[AT_HARD_END] = 1 if at_hard_end else 0


@kernel()
def begin(
    p,
    parts,
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
    ramp,
    wear,
    offset,
    free,
    slip,
    implicit,
    flight,
    rest,
) -> bool:
    """Lay out the next step, at most to `hard_time`; return False when it is not finite."""
    clock, step = state.clock, state.step
    t0 = clock[T0]
    penetrating = weigh_pairs(p, state, w, viscous, fraction, ramp)
    for j in range(3):
        w.wrench[0, j], w.wrench[1, j] = p.constant[j], 0.0
    if segments is not None:
        hard_time = min(hard_time, _linear_load(parts.segments, step, t0, w))
    clock[HARD_END] = hard_time
    span = min(hard_time - t0, LONGEST_STEP)
    limited = span < LONGEST_STEP
    clock[ALPHA], clock[BETA] = 1.0, 0.0
    hard, length = span, 0.0
    state.count[STEPS] += 1
    if flight is not None:
        length = 0.0 if penetrating else take_off(p, parts.harmonics, state, w, span)
        step[FLYING] = 1 if length > 0.0 else 0
    if rest is not None:
        steady = penetrating and w.wrench[1, 0] == 0.0 and w.wrench[1, 1] == 0.0 and w.wrench[1, 2] == 0.0
        step[RESTING] = 1 if steady and settle(p, parts, state, w) else 0
        length = span if step[RESTING] == 1 else 0.0
    if (flight is not None or rest is not None) and length > 0.0:
        _note(state, length, length, 1, -1, 0, limited and length == span)
        return True
    if implicit is not None:
        clock[WAS_IMPLICIT], clock[WAS_EXPLICIT] = clock[IMPLICIT_LENGTH], clock[EXPLICIT_LENGTH]
        step[WAS_OVERDAMPED] = step[OVERDAMPED]
    if implicit is not None and penetrating and step[OVERDAMPED] >= PATIENCE:
        length = collocate(p, parts, state, w, span, implicit)
    if length > 0.0:
        order, sigma = STAGES, length
    else:
        if step[TOUCHING] != 0:
            # a force that starts like d^1.5 is analytic in the square root of time
            clock[ALPHA], clock[BETA] = 0.0, 2.0
            hard = math.sqrt(span)
        elif fraction is not None and penetrating:
            parting = time_to_part(p, parts, state, w, span, harmonics) if p.exponent == 1.5 else 0.0
            if parting > 0.0:
                # one that ends like d^1.5 is analytic in the root of the time left
                root = math.sqrt(parting)
                clock[ALPHA], clock[BETA] = 2.0 * root, -2.0
                hard = root if parting <= span else root - math.sqrt(parting - span)
                limited = limited and parting > span
            elif p.exponent == 1.5 and 0.0 < t0 - clock[TOUCHED] < _TOUCH_REACH * clock[LAST_LENGTH]:
                # and still in the root of the time since its start, some steps on
                root = math.sqrt(t0 - clock[TOUCHED])
                clock[ALPHA], clock[BETA] = 2.0 * root, 2.0
                hard = math.sqrt(t0 - clock[TOUCHED] + span) - root
        if harmonics is not None:
            expand_harmonics(parts.harmonics, second, t0, clock[ALPHA], clock[BETA], p.order, w)
        terms = one_by_one(parts.terms)
        order = expand(p, state, w, p.order, penetrating, hard, *terms)
        state.count[COEFFICIENTS] += order
        sigma = hard if order < p.order else accurate_length(p, w, order, hard)
        if not math.isfinite(sigma):
            return False
        if slip is not None:
            sigma = before_sticking(p, state, w, order, sigma)
        if implicit is not None and penetrating:
            note_explicit(p, state, w, clock[ALPHA] * sigma + 0.5 * clock[BETA] * sigma * sigma, sigma < hard)
    limited = limited and sigma == hard
    end, pair, target = first_event(p, state, w, order, sigma, penetrating, viscous, factor, integer, fraction, ramp)
    if pair >= 0 and step[STALL] > p.max_events:
        # modes flip at one instant: go on past it with the modes as they are
        state.count[RECOVERIES] += 1
        end, pair = max(end, min(sigma, 1e-9)), -1
        limited = limited and end == sigma
    limited = limited and pair < 0
    length = span if limited else clock[ALPHA] * end + 0.5 * clock[BETA] * end * end
    _note(state, end, length, order, pair, target, limited)
    return True


@kernel()
def finish(p, parts, state, w, totals, log, wear, fraction) -> None:
    """Move the state to the step's end and switch the mode that its event changes."""
    clock, step, y = state.clock, state.step, state.y
    sigma = clock[SIGMA]
    if wear is not None:
        worn_depth(state, w, sigma, state.depth)
    evaluate(p, parts, state, w, sigma, y)
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
            if gap_and_rate(p, state, pair)[1] > slow_touch(p):
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
