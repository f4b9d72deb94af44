"""A step of the solver: choice of the method, first event, and change of modes at the end.

A step ends at an event, at a knot of the load, or where its series is no longer accurate, not at output times.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from plow_twin.kernel.arrays import copy_into
from plow_twin.kernel.compiler import kernel
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_terms
from plow_twin.solve.dense_output import evaluate, time_along, wear_depth_at
from plow_twin.solve.events import first_event, note_switches
from plow_twin.solve.grip import grasp, switch_grip
from plow_twin.solve.kinematics import named_angle
from plow_twin.solve.method import flight, implicit, rest, taylor
from plow_twin.solve.method.protocol import Method
from plow_twin.solve.modes import penetration_and_rate, slow_touch, touch, weigh_pairs
from plow_twin.solve.state import COS, CROSSING, OFF, ON, RELEASED, SIN, SLIPS_FORWARD, THETA
from plow_twin.solve.totals import log_event
from plow_twin.solve.tumbling import turn_at, turn_corners

#: Methods in the order in which `lay_out_step` tries them.
METHODS: Final[tuple[Method, ...]] = (flight, rest, implicit, taylor)
#: Longest step in s, so that all powers of a step are finite.
LONGEST_STEP = 100.0
#: Size, in sigma, of the step that ends an endless alternation of modes at one instant.
PAST_AN_INSTANT = 1e-9
#: Largest relative difference of two times that are treated as equal, a few rounding errors.
ONE_INSTANT = 1e-15


@kernel()
def _set_load(p, segments, state, w):
    """Write the load at the start of the step and its slope to `w.wrench`. Return the time until which it is valid."""
    for j in range(3):
        w.wrench[0, j], w.wrench[1, j] = p.constant[j], 0.0
    if segments is None:
        return np.inf
    t0, piece = state.step_start, state.piece
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


@kernel()
def _begin_step(p, segments, state, w, stop_time, viscous, fraction, ramp, stick):
    """Begin the computation of a step. Return its largest length in s, and whether any pair penetrates."""
    penetrating = weigh_pairs(p, state, w, viscous, fraction, ramp, stick)
    state.stop_time = min(stop_time, _set_load(p, segments, state, w))
    state.alpha, state.beta, state.elapsed, state.event_pair = 1.0, 0.0, 0.0, -1
    state.steps += 1
    return min(state.stop_time - state.step_start, LONGEST_STEP), penetrating


@kernel()
def lay_out_step(p, parts, state, w, stop_time) -> bool:
    """Compute the next step, which ends at `stop_time` at the latest. Return False if its series is not finite."""
    terms = parts.terms
    span, penetrating = _begin_step(
        p, parts.segments, state, w, stop_time, terms.viscous, terms.fraction, terms.ramp, terms.stick
    )
    if flight.lay_out(p, parts, flight.own(parts), state, w, span, penetrating) or rest.lay_out(
        p, parts, rest.own(parts), state, w, span, penetrating
    ):
        # contacts do not change in flight and at rest
        state.step_size = state.sigma_end
    elif implicit.lay_out(p, parts, implicit.own(parts), state, w, span, penetrating) or taylor.lay_out(
        p, parts, taylor.own(parts), state, w, span, penetrating
    ):
        _end_at_event(p, state, w, span, penetrating, law_terms(terms), terms.stick)
        implicit.note_step(parts.implicit, state, w, state.step_size, state.event_pair >= 0)
    else:
        return False
    if span == LONGEST_STEP:
        state.ends_at_stop = 0
    return True


@kernel()
def lay_out_series_step(p, parts, state, w, stop_time) -> bool:
    """Compute the next step by Taylor series, even in free flight or at rest. Return False if it is not finite."""
    terms = parts.terms
    span, penetrating = _begin_step(
        p, parts.segments, state, w, stop_time, terms.viscous, terms.fraction, terms.ramp, terms.stick
    )
    if not taylor.lay_out(p, parts, taylor.own(parts), state, w, span, penetrating):
        return False
    _end_at_event(p, state, w, span, penetrating, law_terms(terms), terms.stick)
    if span == LONGEST_STEP:
        state.ends_at_stop = 0
    return True


@kernel()
def _end_at_event(p, state, w, span, penetrating, law, stick) -> None:
    sigma, order = state.sigma_end, state.order
    end, pair, target = first_event(p, state, w, order, sigma, penetrating, *law, stick)
    if pair >= 0 and state.events_at_once > p.max_events:
        # if modes alternate at one instant, take a short step with the current modes
        state.recoveries += 1
        end, pair = max(end, min(sigma, PAST_AN_INSTANT)), -1
    turn = turn_at(p, state, w, order, end)
    if turn < end:
        end, pair = turn, -1
    if pair >= 0:
        note_switches(p, state, w, order, end, pair, target, penetrating, *law, stick)
    if pair >= 0 or end != sigma:
        state.ends_at_stop = 0
    state.sigma_end, state.event_pair = end, pair
    whole = state.ends_at_stop == 1 and span < LONGEST_STEP
    state.step_size = span if whole else time_along(state.alpha, state.beta, end)


@kernel()
def complete_step(p, harmonics, flight, support, state, w, totals, log, wear, fraction, stick) -> None:
    """Set the state to the end of the step, and change the modes of its event. `totals` and `log` may be None."""
    y = state.y
    sigma = state.sigma_end
    if wear is not None:
        wear_depth_at(state, w, sigma, state.wear_depth)
    evaluate(p, harmonics, flight, support, state, w, sigma, y)
    if support is not None:
        copy_into(state.frame, w.frame_now)
    angle = named_angle(p, y, y[THETA])
    y[COS], y[SIN] = math.cos(angle), math.sin(angle)
    before = state.step_start
    state.step_start = before + state.step_size
    if state.ends_at_stop == 1:
        state.step_start = state.stop_time
    state.time = state.step_start
    state.step_size = -1.0
    state.elapsed = 0.0
    at_once = state.step_start - before <= ONE_INSTANT * (1.0 + abs(before))
    if not at_once:
        state.last_step_size = state.step_start - before
    touching = state.touching if at_once else 0
    state.touching = 0
    turn_corners(p, state, stick, totals, log)
    if state.event_pair < 0:
        state.events_at_once = 0
        return
    state.events_at_once = state.events_at_once + 1 if at_once else 0
    state.refused, state.decay_times = 0, 0.0
    if fraction is not None:
        state.touching = touching
    for pair in range(PAIR_COUNT):
        if w.switch[pair] >= 0:
            _switch(p, state, pair, w.switch[pair], totals, log, fraction, stick)


@kernel()
def _switch(p, state, pair, new, totals, log, fraction, stick) -> None:
    old = state.mode[pair]
    if stick is not None and new >= SLIPS_FORWARD:
        switch_grip(p, state, pair, new)
        state.events += 1
        return
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
        if totals is not None:
            totals.makes[pair] += 1
        if fraction is not None and new == ON:
            if penetration_and_rate(p, state, pair)[1] > slow_touch(p):
                state.touching |= 1 << pair
                state.touch_time = state.step_start
            else:
                state.mode[pair] = RELEASED
    if stick is not None and state.mode[pair] == ON and old != ON:
        grasp(p, state, pair, old)
    # the log has ON in place of RELEASED
    old, new = ON if old == RELEASED else old, ON if new == RELEASED else new
    if log is not None and old != new:
        log_event(log, totals, state.step_start, pair, old, new, penetration_and_rate(p, state, pair)[1])
