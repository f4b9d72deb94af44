"""The length of a step: up to where its series stops being accurate, and shorter where the series cannot show this."""

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

#: Number of steps of the last size within which a parting is searched, and the order of its series.
_PARTING_REACH, PARTING_ORDER = 1.3, 6
#: The same with friction that sticks, where the remaining force is judged separately and steps are shorter.
_PARTING_REACH_STICK = 8.0
#: Newton steps to its root, and the relative change at which they end: the next step corrects the rest.
_NEWTON_STEPS, _ROOT_FOUND = 6, 1e-9
#: A larger term is not finite, or its products would not be.
_FINITE = 1e300
#: How often a step is shortened (the largest term over it also shrinks), and the change that counts as zero.
_SHORTER, _SHORT_ENOUGH = 20, 0.9


@kernel()
def accurate_step(p, w, order, sigma_limit):
    """Return the sigma over which the series meets its share of the tolerance; NaN if it is not finite.

    Term k may be as large as `threshold[k]`, which falls geometrically to the admissible error at the last order (root
    test as by Jorba and Zou, sec. 3.2). All of the last `lacuna` orders are checked, since single orders can vanish.
    """
    least = np.inf
    for k in range(order, order - max(p.lacuna, 2), -1):
        size = w.term_size[k]
        if not size <= _FINITE:
            return math.nan
        if size > 0.0:
            least = min(least, math.log(p.threshold[k] / size) / k)
    sigma = min(sigma_limit, math.exp(least))
    # an error of velocity becomes one of position over a long step
    stretch = sigma * p.velocity_tolerance / (p.position_tolerance * (order + 1))
    if stretch > 1.0 and sigma < sigma_limit:
        sigma *= math.exp(-math.log(stretch) / order)
    return sigma


@kernel()
def before_sticking(p, state, w, order, sigma) -> float:
    """Return the part of `sigma` over which the series of tanh r converges well enough.

    Far from sticking tanh r is constant to the last bit, and no coefficient shows its poles at r = +-i pi/2.
    With |r - r_0| at most theta times their distance, the remainder of the series is below theta^order.
    """
    theta = (p.threshold[p.order] / p.threshold[0]) ** (1.0 / order)
    within = sigma
    for pair in range(PAIR_COUNT):
        if state.mode[pair] != ON:
            continue
        change = 0.0
        for k in range(order - 1, 0, -1):
            change = (change + abs(w.slip[0, k, pair])) * within
        limit = theta * math.hypot(w.slip[0, 0, pair], 0.5 * math.pi)
        if change > limit:
            # the change is convex in sigma
            within *= limit / change
    return within


@kernel()
def before_pushing_again(p, state, w, order, sigma, integer, fraction) -> float:
    """Return the part of `sigma` over which the series of the ramped force of clipped pairs is accurate.

    This force does not act yet: only a guard depends on it, so no other check shortens a step for it. The root test of
    the motion is applied to the velocity that the force would give. The acting share of C is a cubic, whose series ends
    after the penetration's, and a force d^n has its branch point where the pair parts. The motion's own terms may have
    ended early: the test uses the orders that exist.
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
    """Return the part of `sigma` over which the guards of stick and slip are accurate.

    A force far too small to move the head still decides whether its corner holds: the same root test, relative to the
    largest term of the guard.
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
    """Return the part of `sigma` over which the last terms of a polynomial g are small beside its largest term.

    Term k may be exp(share k) of it. Only the upper half counts: near a root the first terms are large beside the rest.
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
    """Return the time until the first pair parts, where the parting shortens steps; otherwise 0.

    The root of a short series is enough: the next step corrects its error.
    """
    near, reach = False, _PARTING_REACH
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
    first = np.inf
    for pair in range(PAIR_COUNT):
        if state.mode[pair] != ON or w.penetration[1, pair] >= 0.0:
            continue
        t = -w.penetration[0, pair] / w.penetration[1, pair]
        if t > reach * state.last_step_size:
            continue
        for _ in range(_NEWTON_STEPS):
            value, slope = w.penetration[order, pair], 0.0
            for k in range(order - 1, -1, -1):
                slope = slope * t + value
                value = value * t + w.penetration[k, pair]
            if not slope < 0.0:
                break
            change = value / slope
            t -= change
            if abs(change) < _ROOT_FOUND * t:
                first = min(first, t)
                break
    return first if 0.0 < first < np.inf else 0.0
