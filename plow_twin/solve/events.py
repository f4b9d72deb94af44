"""Detection of the first event of a step, the earliest root of all guard functions (`polynomial.first_root`).

A guard function is a polynomial that is positive as long as a pair keeps its mode.
"""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import first_root, first_root_within, sum_to_bernstein
from plow_twin.kernel.simd import below, magnitude, row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.grip import grip_guard
from plow_twin.solve.state import CLIPPED, CROSSING, OFF, ON, RATIO, RELEASED, SIGN

#: Largest difference of the times of two simultaneous events, divided by the size of the step that ends with them.
_AT_ONCE = 1e-12
#: Penetration at which a pair changes from ON to RELEASED, divided by `Params.release`, at which it changes back.
LET_GO = 0.25
#: Allowances for rounding of guard functions: a factor for sums of terms, and an absolute error of 1 + lambda d'.
_ROUNDED, _ROUNDING = 1.0 + 1e-9, 1e-9
_ALL_PAIRS = 2**PAIR_COUNT - 1
#: Penetration below which a RELEASED pair is treated as resting on its wall, divided by `Params.release`.
ON_THE_WALL = 1e-6


@kernel(fast=True)
def _guards(p, state, w, order, penetrating, viscous, ramp) -> None:
    """Write the first guard function of each pair to `w.guard`.

    The guard function depends on the mode and on the penetration d:

    - OFF: -d.
    - ON: F / K = d + (C / K) d' for Kelvin-Voigt, and d for all other laws, minus a small penetration for exponents
      that are not integers.
    - All other modes: d.
    """
    guard, weights = w.guard, w.per_pair
    for pair in range(PAIR_COUNT):
        mode = state.mode[pair]
        weights[SIGN, pair] = 0.0 if p.enabled[pair] == 0 else -1.0 if mode == OFF else 1.0
        weights[RATIO, pair] = 0.0
        if viscous is not None and ramp is None and mode == ON:
            weights[RATIO, pair] = p.viscous / p.stiffness
    sign, ratio = row(weights, SIGN), row(weights, RATIO)
    for k in range(order):
        term = row(w.penetration, k)
        if viscous is not None and ramp is None and penetrating:
            term = term + row(w.rate, k) * ratio
        set_row(guard, k, term * sign)
    set_row(guard, order, row(w.penetration, order) * sign)
    for pair in range(PAIR_COUNT):
        first = max(guard[0, pair], 0.0)
        if state.mode[pair] == ON:
            # the two depths differ, so that a pair cannot alternate between RELEASED and ON
            first -= min(LET_GO * p.release, 0.5 * first)
        elif state.mode[pair] == RELEASED and first <= ON_THE_WALL * p.release:
            # a RELEASED pair that rests on its wall separates at the depth -LET_GO * release
            first = max(guard[0, pair] + LET_GO * p.release, 0.0)
        guard[0, pair] = first if p.enabled[pair] == 1 else 1.0


@kernel()
def _second_guard(p, state, w, order, pair, viscous, hysteretic, integer, fraction, ramp) -> bool:
    """Write the second guard function of a penetrating pair to `w.column[0]`, and return whether it has one:

    - ON: 1 + lambda d', or the force F for a law with a ramp.
    - CLIPPED: the function for ON with the opposite sign, positive as long as the force would pull.
    - RELEASED: p.release - d.
    """
    g, mode = w.column[0], state.mode[pair]
    g[order] = 0.0
    if mode == RELEASED:
        for k in range(order + 1):
            g[k] = -w.penetration[k, pair]
        g[0] += p.release
    elif ramp is not None:
        _pull(p, w, order, pair, mode, integer, fraction)
    elif viscous is not None:
        if mode == ON:
            return False
        for k in range(order):
            g[k] = -(w.penetration[k, pair] + p.viscous / p.stiffness * w.rate[k, pair])
    else:
        if hysteretic is None:
            return False
        sign = 1.0 if mode == ON else -1.0
        for k in range(order):
            g[k] = sign * state.damping_factor[pair] * w.rate[k, pair]
        g[0] += sign
    g[0] = max(g[0], 0.0)
    return True


@kernel(inline="code")
def elastic_term(p, w, k, pair, integer, fraction):
    """Return coefficient k of the series of d^n, where d is the penetration of a pair."""
    if integer is not None:
        return w.power[int(p.exponent) - 2, k, pair]
    if fraction is not None:
        return w.power[0, k, pair]
    return w.penetration[k, pair]


@kernel()
def _pull(p, w, order, pair, mode, integer, fraction) -> None:
    """Write the force of a law with a ramp to `w.column[0]`, with the opposite sign for a CLIPPED pair."""
    g, sign = w.column[0], 1.0 if mode == ON else -1.0
    for k in range(order):
        elastic = elastic_term(p, w, k, pair, integer, fraction)
        g[k] = sign * (p.stiffness * elastic + p.viscous * w.damped[k, pair])


@kernel()
def _ramp_guard(p, state, w, order, pair) -> None:
    """Write to `w.column[0]` a guard function that is positive until the penetration crosses the end of the ramp."""
    g, sign = w.column[0], 1.0 if state.beyond_ramp[pair] == 1 else -1.0
    for k in range(order + 1):
        g[k] = sign * w.penetration[k, pair]
    g[0] = max(g[0] - sign * p.ramp, 0.0)


@kernel(fast=True)
def _unsafe_pairs(w, order, h):
    """Return an integer with a bit for each pair whose guard function g may become negative on [0, h].

    g stays positive on [0, h] if g_0 and b(h) = g_0 + g_1 h - sum over k > 1 of max(-g_k, 0) h^k are positive, because
    b is concave and a lower bound of g. If this test fails for any pair, the signs of the Bernstein coefficients are
    tested.
    """
    guard, b = w.guard, w.bernstein
    reach = splat(0.0)
    for k in range(order, 1, -1):
        term = row(guard, k)
        reach = (reach + (magnitude(term) - term) * 0.5) * h
    if below(row(guard, 0) + row(guard, 1) * h, reach * h) == 0:
        return 0
    power = 1.0
    for k in range(order + 1):
        set_row(b, k, row(guard, k) * (power * w.binomial[order, k]))
        power *= h
    sum_to_bernstein(b, order)
    zero, bits = splat(0.0), 0
    for k in range(order + 1):
        bits |= below(row(b, k), zero)
    return bits


@kernel(fast=True)
def _nothing_ends(p, state, w, order, h, penetrating, hysteretic) -> bool:
    """Return whether no pair changes its mode on [0, h], for an integer exponent without a ramp.

    The test is stricter than `_unsafe_pairs` and `_stays`: it ignores positive linear terms and allows for rounding.
    """
    weights = w.per_pair
    for pair in range(PAIR_COUNT):
        mode = state.mode[pair]
        weights[SIGN, pair] = 0.0 if p.enabled[pair] == 0 else -1.0 if mode == OFF else 1.0
        weights[RATIO, pair] = 0.0 if mode == OFF else 1.0 if mode == ON else -1.0
    sign, reach = row(weights, SIGN), splat(0.0)
    for k in range(order, 0, -1):
        term = row(w.penetration, k) * sign
        reach = (reach + (magnitude(term) - term) * 0.5) * h
    away = row(w.penetration, 0) * sign + (magnitude(sign) * -1.0 + 1.0)
    safe = below(reach * _ROUNDED, away)
    if penetrating and hysteretic is not None:
        sense = row(weights, RATIO)
        factor, reach = row(state.damping_factor, 0) * sense, splat(0.0)
        for k in range(order - 1, 0, -1):
            term = row(w.rate, k) * factor
            reach = (reach + (magnitude(term) - term) * 0.5) * h
        push = sense + row(w.rate, 0) * factor + (magnitude(sense) * -1.0 + 1.0)
        safe &= below(reach * _ROUNDED + _ROUNDING, push)
    return bool(safe == _ALL_PAIRS)


@kernel(inline="code")
def _next_mode(p, mode, viscous, fraction, ramp):
    """Return the mode that follows `mode` when the first guard function of a pair becomes negative."""
    if mode == OFF:
        return ON if fraction is None or p.exponent == 1.5 else RELEASED
    if mode == ON and viscous is not None and ramp is None:
        return CLIPPED
    return RELEASED if mode == ON and fraction is not None else OFF


@kernel()
def _stays(column, order, h) -> bool:
    """Return whether a guard function stays positive on [0, h] by the lower bound of `_unsafe_pairs`."""
    reach = 0.0
    for k in range(order, 1, -1):
        reach = (reach + max(-column[k], 0.0)) * h
    return column[0] >= 0.0 and column[0] + column[1] * h >= reach * h


@kernel()
def _sooner(state, w, order, best) -> float:
    """Return the sigma at which the guard function in `w.column[0]` first becomes negative, at most `best`."""
    column = w.column[0]
    if _stays(column, order, best):
        return best
    state.guard_roots += 1
    return min(best, first_root(column, order, best, w))


@kernel()
def _ends_with(column, order, at, within) -> bool:
    """Return whether a guard function that is positive before `at` becomes negative before `at` + `within`."""
    value, slope = column[order], 0.0
    for k in range(order - 1, -1, -1):
        slope = slope * at + value
        value = value * at + column[k]
    return slope < 0.0 and value + slope * within <= 0.0


@kernel(fast=True)
def _guards_end_with(w, order, at, within):
    """Return an integer with a bit for each pair whose first guard function satisfies `_ends_with`."""
    value, slope, zero = row(w.guard, order), splat(0.0), splat(0.0)
    for k in range(order - 1, -1, -1):
        slope = slope * at + value
        value = value * at + row(w.guard, k)
    return below(slope, zero) & below(value + slope * within, zero)


@kernel()
def note_switches(
    p, state, w, order, at, event, target, penetrating, viscous, hysteretic, integer, fraction, ramp, stick
) -> None:
    """Write to `w.switch` the next mode of each pair that changes its mode at the event, and -1 for all other pairs.

    Events that differ only by rounding are simultaneous, so that a symmetric motion stays symmetric.
    """
    column, within = w.column[0], _AT_ONCE * at
    ending = _guards_end_with(w, order, at, within)
    for pair in range(PAIR_COUNT):
        w.switch[pair] = -1
        if pair == event:
            w.switch[pair] = target
        elif ending >> pair & 1:
            w.switch[pair] = _next_mode(p, state.mode[pair], viscous, fraction, ramp)
        elif penetrating and state.mode[pair] != OFF:
            guarded = _second_guard(p, state, w, order, pair, viscous, hysteretic, integer, fraction, ramp)
            if guarded and _ends_with(column, order, at, within):
                w.switch[pair] = CLIPPED if state.mode[pair] == ON else ON
            elif ramp is not None and state.mode[pair] != RELEASED:
                _ramp_guard(p, state, w, order, pair)
                if _ends_with(column, order, at, within):
                    w.switch[pair] = CROSSING
        if stick is not None and penetrating and w.switch[pair] < 0:
            for side in range(2):
                following = grip_guard(p, state, w, order, pair, side)
                if following != 0 and (column[0] < 0.0 or _ends_with(column, order, at, within)):
                    w.switch[pair] = following


@kernel()
def first_event(p, state, w, order, sigma, penetrating, viscous, hysteretic, integer, fraction, ramp, stick):
    """Return sigma, pair and next mode of the first event in [0, sigma), or (sigma, -1, 0) without an event."""
    if viscous is None and fraction is None and ramp is None and stick is None:  # noqa: SIM102 - left out by types
        if _nothing_ends(p, state, w, order, sigma, penetrating, hysteretic):
            return sigma, -1, 0
    _guards(p, state, w, order, penetrating, viscous, ramp)
    best, event, target = sigma, -1, 0
    unsafe = _unsafe_pairs(w, order, sigma)
    column = w.column[0]
    for pair in range(PAIR_COUNT):
        if unsafe >> pair & 1:
            for k in range(order + 1):
                column[k], w.halves[0, k] = w.guard[k, pair], w.bernstein[k, pair]
            if _stays(column, order, best):
                # it cannot become negative before the event at `best`
                continue
            state.guard_roots += 1
            root = first_root_within(column, order, sigma, w)
            if root < best:
                best, event, target = root, pair, _next_mode(p, state.mode[pair], viscous, fraction, ramp)
    if penetrating:
        for pair in range(PAIR_COUNT):
            if state.mode[pair] == OFF:
                continue
            if _second_guard(p, state, w, order, pair, viscous, hysteretic, integer, fraction, ramp):
                root = _sooner(state, w, order, best)
                if root < best:
                    best, event, target = root, pair, CLIPPED if state.mode[pair] == ON else ON
            if ramp is not None and state.mode[pair] != RELEASED:
                _ramp_guard(p, state, w, order, pair)
                root = _sooner(state, w, order, best)
                if root < best:
                    best, event, target = root, pair, CROSSING
            if stick is not None:
                for side in range(2):
                    following = grip_guard(p, state, w, order, pair, side)
                    if following != 0:
                        root = _sooner(state, w, order, best)
                        if root < best:
                            best, event, target = root, pair, following
    return best, event, target
