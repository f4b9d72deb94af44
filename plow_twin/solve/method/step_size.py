"""Size of a step over which its series is accurate, with bounds where a series hides its error."""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.events import elastic_term
from plow_twin.solve.grip import grip_guard
from plow_twin.solve.method.series import expand, expand_harmonics, one_by_one
from plow_twin.solve.modes import penetration_and_rate
from plow_twin.solve.state import CLIPPED, ON

#: Time in which a separation is searched, divided by the last step size, and order of the series for this search.
PARTING_REACH, PARTING_ORDER = 1.3, 6
#: `PARTING_REACH` for friction with stick, whose guard functions make steps shorter.
_PARTING_REACH_STICK = 8.0
#: Largest number of Newton iterations for the separation, and relative change at which they end.
_NEWTON_STEPS, _ROOT_FOUND = 6, 1e-9
#: Largest theta in `before_sticking`. The two poles nearest to r_0 then give the series of tanh r a remainder of at
#: most 4 / pi theta^order.
FARTHEST_TO_POLE = 0.5
#: Largest usable term of a series, whose products are finite.
_FINITE = 1e300
#: Largest number of times that a step is shortened, and ratio of successive sizes above which this ends. The largest
#: term decreases with the step.
_SHORTER, _SHORT_ENOUGH = 20, 0.9


@kernel()
def accurate_step(p, w, order, sigma_limit):
    """Return the sigma up to which the series meets the admissible error of a step, or NaN if a term is not finite.

    The admissible size `threshold[k]` of term k decreases geometrically with k to the admissible error at the last
    order (root test of Jorba and Zou, sec. 3.2). Single terms can be zero, so the last `lacuna` terms are checked.
    """
    least = np.inf
    for k in range(order, order - max(p.lacuna, 2), -1):
        size = w.term_size[k]
        if not size <= _FINITE:
            return math.nan
        if size > 0.0:
            least = min(least, math.log(p.threshold[k] / size) / k)
    sigma = min(sigma_limit, math.exp(least))
    # over a long step, an admissible error of the velocity is a large error of the position
    stretch = sigma * p.velocity_tolerance / (p.position_tolerance * (order + 1))
    if stretch > 1.0 and sigma < sigma_limit:
        sigma *= math.exp(-math.log(stretch) / order)
    return sigma


@kernel()
def before_sticking(p, state, w, order, sigma) -> float:
    """Return `sigma`, or the smaller value up to which the series of tanh r converges well enough.

    r is the slip rate divided by the regularisation speed. During fast slip, tanh r is constant up to rounding and does
    not show its poles at r = +-i pi/2. If |r - r_0| is at most theta times the distance of r_0 from the poles, the
    remainder of the series is about theta^order. This share of the change of velocity by friction must be admissible.
    """
    mobility, within = p.inverse_mass + p.radius * p.radius * p.inverse_inertia, sigma
    for pair in range(PAIR_COUNT):
        if state.mode[pair] != ON:
            continue
        change = normal = 0.0
        for k in range(order - 1, 0, -1):
            change = (change + abs(w.slip[0, k, pair])) * within
            normal = (normal + abs(w.force[k, pair])) * within
        time = within * (state.alpha + abs(state.beta) * within)
        gained, theta = p.friction * (normal + abs(w.force[0, pair])) * mobility * time, FARTHEST_TO_POLE
        if gained * theta**order > p.threshold[p.order]:
            theta = (p.threshold[p.order] / gained) ** (1.0 / order)
        limit = theta * math.hypot(w.slip[0, 0, pair], 0.5 * math.pi)
        if change > limit:
            # the change is convex in sigma
            within *= limit / change
    return within


@kernel()
def before_pushing_again(p, state, w, order, sigma, integer, fraction) -> float:
    """Return `sigma`, or the smaller value up to which the ramped force of CLIPPED pairs has an accurate series.

    This force appears only in a guard function, so the test of the motion does not limit its error. The root test is
    applied to the velocity that the force would cause, because the active share of C, a cubic, has a longer series than
    the penetration, and d^n has a branch point where the pair separates.
    """
    least, share = np.inf, math.log(p.threshold[p.order] / p.threshold[0]) / order
    for pair in range(PAIR_COUNT):
        if state.mode[pair] != CLIPPED:
            continue
        for k in range(order - 1, order - 1 - p.lacuna, -1):
            force = p.stiffness * elastic_term(p, w, k, pair, integer, fraction) + p.viscous * w.damped[k, pair]
            size = abs(force) * p.inverse_mass * (state.alpha + abs(state.beta)) / (k + 1)
            if size > 0.0:
                least = min(least, share + math.log(p.threshold[0] / size) / (k + 1))
    return min(sigma, math.exp(least))


@kernel()
def before_gripping(p, state, w, order, sigma) -> float:
    """Return `sigma`, or the smaller value up to which the guard functions of stick and slip are accurate.

    The root test is relative to the largest term, because even a small force can determine whether a corner sticks.
    """
    guard = w.column[0]
    share = math.log(p.threshold[p.order] / p.threshold[0]) / order
    for pair in range(PAIR_COUNT):
        for side in range(2):
            if grip_guard(p, state, w, order, pair, side) != 0:
                sigma = _relatively_accurate(guard, order, p.lacuna, share, sigma)
    return sigma


@kernel()
def _relatively_accurate(g, order, lacuna, share, sigma) -> float:
    """Return `sigma`, or the smaller value up to which the last terms of g are small relative to its largest term.

    The admissible size of term k is exp(share k) times the largest term, for the upper half of the terms: lower terms
    may be large near a root.
    """
    for _ in range(_SHORTER):
        largest, power = 0.0, 1.0
        for k in range(order + 1):
            largest = max(largest, abs(g[k]) * power)
            power *= sigma
        least = math.log(sigma)
        for k in range(order, max(order - 2 - lacuna, order // 2), -1):
            if g[k] != 0.0:
                least = min(least, share + math.log(largest / abs(g[k])) / k)
        shorter = math.exp(least)
        if not shorter < _SHORT_ENOUGH * sigma:
            return min(sigma, shorter)
        sigma = shorter
    return sigma


@kernel()
def time_to_separation(p, parts, state, w, span, harmonics, stick):
    """Return the time in s until the first pair separates, or 0 if the separation is too far away to shorten steps.

    The next step corrects the error of the series of low order.
    """
    near, reach = False, PARTING_REACH
    if stick is not None:
        reach = _PARTING_REACH_STICK
    for pair in range(PAIR_COUNT):
        if state.mode[pair] == ON:
            penetration, rate = penetration_and_rate(p, state, pair)
            if rate < 0.0 and penetration < -rate * reach * state.last_step_size:
                near = True
    if not near:
        return 0.0
    if harmonics is not None:
        expand_harmonics(parts.harmonics, parts.terms.second, state.step_start, 1.0, 0.0, PARTING_ORDER, w)
    terms = one_by_one(parts.terms)
    order = expand(p, state, w, PARTING_ORDER, True, span, *terms)
    state.evaluations += order
    first, column = np.inf, w.column[0]
    for pair in range(PAIR_COUNT):
        if state.mode[pair] == ON:
            for k in range(order + 1):
                column[k] = w.penetration[k, pair]
            first = min(first, parting_of(column, order, reach * state.last_step_size))
    return first if 0.0 < first < np.inf else 0.0


@kernel()
def parting_of(penetration, order, reach) -> float:
    """Return the first root of a penetration's series by Newton's method, or inf without a root before `reach`."""
    if penetration[1] >= 0.0:
        return np.inf
    t = -penetration[0] / penetration[1]
    if t > reach:
        return np.inf
    for _ in range(_NEWTON_STEPS):
        value, slope = penetration[order], 0.0
        for k in range(order - 1, -1, -1):
            slope = slope * t + value
            value = value * t + penetration[k]
        if not slope < 0.0:
            break
        change = value / slope
        t -= change
        if abs(change) < _ROOT_FOUND * t:
            return t
    return np.inf
