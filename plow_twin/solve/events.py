"""The first event of a step.

A guard is a polynomial over the step that is positive as long as a pair keeps its mode. The event is at the first point
where a guard turns negative, found by `polynomial.first_root`.
"""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import first_root, first_root_within, sum_to_bernstein
from plow_twin.kernel.simd import below, magnitude, row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.grip import grip_guard
from plow_twin.solve.state import CLIPPED, CROSSING, OFF, ON, RATIO, RELEASED, SIGN

#: Two events are simultaneous if the time between them is less than this share of the step that ends with them.
_AT_ONCE = 1e-12
#: Penetration at which a pair changes from ON to RELEASED, as a share of `Params.release`. The pair is ON again at
#: `Params.release` itself.
LET_GO = 0.25
#: Allowances for rounding in the proof that no guard turns negative: a factor on the sums of terms, and an absolute
#: error of the guard 1 + lambda d'.
_ROUNDED, _ROUNDING = 1.0 + 1e-9, 1e-9
_ALL_PAIRS = 2**PAIR_COUNT - 1
#: Penetration below which a RELEASED pair counts as resting on its wall, as a share of `Params.release`.
ON_THE_WALL = 1e-6


@kernel(fast=True)
def _guards(p, state, w, order, penetrating, viscous, ramp) -> None:
    """Write each pair's first guard to `w.guard`.

    The guard of a pair that is OFF is -d, with the penetration d. The guard of a pair that is ON is F / K = d + (C / K)
    d' for Kelvin-Voigt; for other laws it is d, less a small penetration if the exponent is not an integer. All other
    guards are d.
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
            # a pair becomes RELEASED at a quarter of the depth at which it is ON again; it therefore cannot alternate
            # between the modes
            first -= min(LET_GO * p.release, 0.5 * first)
        elif state.mode[pair] == RELEASED and first <= ON_THE_WALL * p.release:
            # a RELEASED pair that rests on its wall parts a little outside the wall, at the depth -LET_GO * release;
            # its guard is raised by this distance
            first = max(guard[0, pair] + LET_GO * p.release, 0.0)
        guard[0, pair] = first if p.enabled[pair] == 1 else 1.0


@kernel()
def _second_guard(p, state, w, order, pair, viscous, hysteretic, integer, fraction, ramp) -> bool:
    """Write the second guard of a penetrating pair to `w.column[0]`; return whether it has one.

    For a pair that is ON the second guard is 1 + lambda d', or the force F with a ramp. For a CLIPPED pair it is
    positive as long as the force would pull. For a RELEASED pair it is p.release - d.
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
    """Return order k of the series of d^n, with the penetration d of a pair."""
    if integer is not None:
        return w.power[int(p.exponent) - 2, k, pair]
    if fraction is not None:
        return w.power[0, k, pair]
    return w.penetration[k, pair]


@kernel()
def _pull(p, w, order, pair, mode, integer, fraction) -> None:
    """Write the force of a ramped law to `w.column[0]`, with the opposite sign for a CLIPPED pair."""
    g, sign = w.column[0], 1.0 if mode == ON else -1.0
    for k in range(order):
        elastic = elastic_term(p, w, k, pair, integer, fraction)
        g[k] = sign * (p.stiffness * elastic + p.viscous * w.damped[k, pair])


@kernel()
def _ramp_guard(p, state, w, order, pair) -> None:
    """Write to `w.column[0]` a guard that is positive while the pair stays on its side of the ramp's end."""
    g, sign = w.column[0], 1.0 if state.beyond_ramp[pair] == 1 else -1.0
    for k in range(order + 1):
        g[k] = sign * w.penetration[k, pair]
    g[0] = max(g[0] - sign * p.ramp, 0.0)


@kernel(fast=True)
def _unsafe_pairs(w, order, h):
    """Return a bit for each guard that may turn negative on [0, h].

    A guard stays positive if g_0 and g_0 + g_1 h - sum over k > 1 of max(-g_k, 0) h^k are positive, because this lower
    bound is concave in h. If this fails for any guard, the guards are tested by the sign of their Bernstein
    coefficients.
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
    """Return whether every pair is proved to keep its mode on [0, h], for an integer exponent without a ramp.

    The function makes the first test of `_unsafe_pairs` and the test of `_stays` for all pairs side by side, without
    credit for a rising linear term. An allowance for rounding makes sure that guards that pass this test would also
    pass those two tests.
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
    """Return the mode that follows `mode` when the pair's first guard turns negative."""
    if mode == OFF:
        return ON if fraction is None or p.exponent == 1.5 else RELEASED
    if mode == ON and viscous is not None and ramp is None:
        return CLIPPED
    return RELEASED if mode == ON and fraction is not None else OFF


@kernel()
def _stays(column, order, h) -> bool:
    """Return whether the lower bound of `_unsafe_pairs` proves that a guard does not turn negative on [0, h]."""
    reach = 0.0
    for k in range(order, 1, -1):
        reach = (reach + max(-column[k], 0.0)) * h
    return column[0] + column[1] * h >= reach * h


@kernel()
def _sooner(state, w, order, best) -> float:
    """Return the sigma at which the guard in `w.column[0]` first turns negative, or `best` if that comes first."""
    column = w.column[0]
    if _stays(column, order, best):
        return best
    state.guard_roots += 1
    return min(best, first_root(column, order, best, w))


@kernel()
def _ends_with(column, order, at, within) -> bool:
    """Return whether a guard that is positive before `at` turns negative no later than `within` after it."""
    value, slope = column[order], 0.0
    for k in range(order - 1, -1, -1):
        slope = slope * at + value
        value = value * at + column[k]
    return slope < 0.0 and value + slope * within <= 0.0


@kernel(fast=True)
def _guards_end_with(w, order, at, within):
    """Return a bit for each pair whose first guard turns negative with the event at `at` (see `_ends_with`)."""
    value, slope, zero = row(w.guard, order), splat(0.0), splat(0.0)
    for k in range(order - 1, -1, -1):
        slope = slope * at + value
        value = value * at + row(w.guard, k)
    return below(slope, zero) & below(value + slope * within, zero)


@kernel()
def note_switches(
    p, state, w, order, at, event, target, penetrating, viscous, hysteretic, integer, fraction, ramp, stick
) -> None:
    """Write to `w.switch` the next mode of each pair that switches at the event, -1 for the others.

    Pairs whose events differ in time only by rounding switch together, so that a symmetric motion stays symmetric.
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
    """Return (sigma, pair, next mode) of the first event in [0, sigma), or (sigma, -1, 0) without an event."""
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
                # this guard cannot turn negative before the event that has already been found
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
