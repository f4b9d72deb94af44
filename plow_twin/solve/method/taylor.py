"""Computation of a step by Taylor series: choice of the series variable, and size of the step."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.solve.method.implicit import at_most_stable
from plow_twin.solve.method.series import expand, expand_harmonics, one_by_one
from plow_twin.solve.method.step_size import (
    accurate_step,
    before_gripping,
    before_pushing_again,
    before_sticking,
    time_to_separation,
)

#: The series variable is the square root of the time since a touch up to this time, divided by the last step size.
TOUCH_REACH = 2.5
#: Longest step in the square root of the time since the touch, divided by its value at the start of the step. The
#: rounding error of the force's series grows by this factor with each order.
FURTHEST = 4.0


@kernel(inline="source")
def own(parts):
    """Return the terms for which the method is compiled, and the record of implicit steps."""
    terms = parts.terms
    return terms.slip, terms.ramp, terms.fraction, terms.stick, parts.implicit


@kernel(inline="source")
def lay_out(p, parts, own, state, w, span, penetrating) -> bool:
    """Compute a step by Taylor series. Return False if the series is not finite."""
    return _lay_out(p, parts, *own, state, w, span, penetrating)


@kernel()
def _lay_out(p, parts, slip, ramp, fraction, stick, implicit, state, w, span, penetrating) -> bool:
    terms = parts.terms
    limit, whole = _choose_map(p, parts, terms.fraction, stick, state, w, span, penetrating)
    _expand_load(p, parts.harmonics, terms.second, state, w)
    order = expand(p, state, w, p.order, penetrating, limit, *one_by_one(terms))
    state.evaluations += order
    sigma = limit if order < p.order else accurate_step(p, w, order, limit)
    if not math.isfinite(sigma):
        return False
    if fraction is not None and state.alpha > 0.0 and state.beta > 0.0:
        sigma = min(sigma, FURTHEST * state.alpha / state.beta)
    if slip is not None:
        sigma = before_sticking(p, state, w, order, sigma)
    if ramp is not None and penetrating:
        sigma = before_pushing_again(p, state, w, order, sigma, terms.integer, fraction)
    if stick is not None and penetrating:
        state.sigma_end = sigma
        sigma = before_gripping(p, state, w, order, sigma)
    sigma = at_most_stable(p, implicit, state, w, sigma)
    state.sigma_end, state.order = sigma, order
    state.ends_at_stop = 1 if whole and sigma == limit else 0
    return True


@kernel()
def _choose_map(p, parts, fraction, stick, state, w, span, penetrating):
    """Choose the series variable sigma. Return its value after `span`, and whether a step may have this size."""
    if fraction is None:
        return span, True
    if state.touching != 0:
        # d^1.5 is analytic in the square root of the time since a touch
        state.alpha, state.beta = 0.0, 2.0
        return math.sqrt(span), True
    if not penetrating or p.exponent != 1.5:
        return span, True
    parting = time_to_separation(p, parts, state, w, span, parts.harmonics, stick)
    if parting > 0.0:
        # d^1.5 is analytic in the square root of the time until a separation
        root = math.sqrt(parting)
        state.alpha, state.beta = 2.0 * root, -2.0
        return (root if parting <= span else root - math.sqrt(parting - span)), parting > span
    since = state.step_start - state.touch_time
    if 0.0 < since < TOUCH_REACH * state.last_step_size:
        # soon after a touch, the square root of the time since the touch is a better variable than time
        root = math.sqrt(since)
        state.alpha, state.beta = 2.0 * root, 2.0
        return math.sqrt(since + span) - root, True
    return span, True


@kernel()
def _expand_load(p, harmonics, second, state, w) -> None:
    if harmonics is not None:
        expand_harmonics(harmonics, second, state.step_start, state.alpha, state.beta, p.order, w)
