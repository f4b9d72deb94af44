"""The first event of each lane's step: guards of all pairs in all lanes at once, roots of one guard a lane at a time.

A clipped pair that parts changes no force and ends no step; the rest of the step is searched for its next touch.
"""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import first_root
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, magnitude, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import AGAIN, DC, DS, DX, DY, SECOND, WIDTH, damped_at, penetration_at
from plow_twin.solve.state import CLIPPED, COS, OFF, ON, SIN, X, Y

#: Events are one instant when they are closer than this share of the step before them.
_AT_ONCE = 1e-12
#: Change of a root that is small enough, as the next is of the order of its cube, and its roundings.
_FOUND, _STRAIGHT, _ROUNDED = 1e-6, 1e-3, 2e-16
_MOST_CHANGES = 80


@kernel()
def _write_guards(lanes, order, viscous, hysteretic) -> None:
    """Write the guards of all pairs, and to `lanes.todo` a bit for each that is not proved to stay positive.

    off: -d; on: F / K = d + (C / K) d', or d and 1 + lambda d'; clipped: d, and the force with the other sign. A guard
    g is positive on [0, h] where g_0 and g_0 + g_1 h - sum over k > 1 of max(-g_k, 0) h^k are: that bound is concave.
    """
    live = 0
    for lane in range(WIDTH):
        lanes.todo[lane] = 0
        live |= 1 << lane if lanes.member[lane] >= 0 else 0
    for pair in range(PAIR_COUNT):
        place, rate = (lanes.series[X], lanes.turning[DX]) if pair % 2 == 1 else (lanes.series[Y], lanes.turning[DY])
        unsafe, inside = _first_guard(lanes, pair, place, order) & live, (lanes.on[pair] | lanes.clipped[pair]) & live
        if viscous is None:
            _note(lanes, unsafe, pair)
        else:
            _note(lanes, unsafe & ~lanes.on[pair], pair)
        if inside == 0:
            continue
        if viscous is not None:
            _note(lanes, _force_guards(lanes, pair, rate, order) & lanes.on[pair] & live, pair)
        if (viscous is not None or hysteretic is not None) and lanes.clipped[pair] & live != 0:
            lanes.leaves[pair] = _leaves(lanes, pair, order)
        if viscous is not None and lanes.clipped[pair] & live != 0:
            _note(lanes, _second_guard(lanes, pair, order) & lanes.clipped[pair] & live, SECOND + pair)
        if hysteretic is not None:
            _note(lanes, _pull_guard(lanes, pair, rate, order) & inside, SECOND + pair)


@kernel(inline="code")
def _note(lanes, bits, guard) -> None:
    if bits != 0:
        for lane in range(WIDTH):
            lanes.todo[lane] |= (bits >> lane & 1) << guard


@kernel(inline="code")
def _reach(reach, term, h):
    """Return (reach + max(-term, 0)) h."""
    return fused(magnitude(term) - term, exact_splat(0.5), reach) * h


@kernel()
def _unsafe(guard, order, within):
    """Return a bit for each lane whose guard is not proved to stay positive up to `within`."""
    h, reach = exact_row(within, 0), exact_splat(0.0)
    for k in range(order, 1, -1):
        reach = _reach(reach, exact_row(guard, k), h)
    first = exact_row(guard, 0)
    return below(fused(exact_row(guard, 1), h, first), reach * h) | below(first, exact_splat(0.0))


@kernel()
def _first_guard(lanes, pair, place, order):
    """Write the penetration of a pair with the sign of its mode; return as `_unsafe`."""
    guard, sign, h = lanes.guard[pair], exact_row(lanes.sign, pair), exact_row(lanes.step, 0)
    rows, cosine, sine = lanes.rows[pair], lanes.series[COS], lanes.series[SIN]
    a, b, n = exact_row(rows, 0) * sign, exact_row(rows, 1) * sign, exact_row(rows, 2) * sign
    reach, term = exact_splat(0.0), exact_splat(0.0)
    for k in range(order, 0, -1):
        term = fused(a, exact_row(cosine, k), fused(b, exact_row(sine, k), n * exact_row(place, k)))
        set_row(guard, k, term)
        if k > 1:
            reach = _reach(reach, term, h)
    zero = exact_splat(0.0)
    first = sign * penetration_at(lanes, pair, exact_row(cosine, 0), exact_row(sine, 0), exact_row(place, 0))
    first = choose(below(zero, first), first, zero)
    first = first + (magnitude(sign) * -1.0 + 1.0)  # a pair that cannot touch
    set_row(guard, 0, first)
    return below(fused(term, h, first), reach * h)


@kernel()
def _force_guards(lanes, pair, rate, order):
    """Write F / K as the guard of pairs that are on; return as `_unsafe`."""
    guard, h, ratio = lanes.guard[pair], exact_row(lanes.step, 0), exact_row(lanes.ratio, pair)
    cosine, sine = lanes.turning[DC], lanes.turning[DS]
    reach, term, zero = _reach(exact_splat(0.0), exact_row(guard, order), h), exact_splat(0.0), exact_splat(0.0)
    for k in range(order - 1, -1, -1):
        before = term
        term = damped_at(
            lanes, pair, ratio, exact_row(guard, k), exact_row(cosine, k), exact_row(sine, k), exact_row(rate, k)
        )
        set_row(guard, k, term)
        if k > 1:
            reach = _reach(reach, term, h)
    first = choose(below(zero, term), term, zero)
    set_row(guard, 0, first)
    return below(fused(before, h, first), reach * h)


@kernel()
def _second_guard(lanes, pair, order):
    """Write -F / K of clipped pairs: it turns negative where the force would push again; return as `_unsafe`."""
    first, guard = lanes.guard[pair], lanes.guard[SECOND + pair]
    rate = lanes.turning[DX] if pair % 2 == 1 else lanes.turning[DY]
    ratio = exact_row(lanes.viscous, 0) / exact_row(lanes.stiffness, 0)
    cosine, sine, zero = lanes.turning[DC], lanes.turning[DS], exact_splat(0.0)
    set_row(guard, order, exact_row(first, order) * -1.0)
    for k in range(order - 1, -1, -1):
        force = damped_at(
            lanes, pair, ratio, exact_row(first, k), exact_row(cosine, k), exact_row(sine, k), exact_row(rate, k)
        )
        set_row(guard, k, force * -1.0)
    start = exact_row(guard, 0)
    set_row(guard, 0, choose(below(zero, start), start, zero))
    return _unsafe(guard, order, lanes.step)


@kernel()
def _pull_guard(lanes, pair, rate, order):
    """Write 1 + lambda d' of pairs that are on, and its negative of clipped pairs; return as `_unsafe`."""
    guard, rows, zero = lanes.guard[SECOND + pair], lanes.rows[pair], exact_splat(0.0)
    sense = choose(lanes.on[pair], exact_splat(1.0), exact_splat(-1.0))
    factor, cosine, sine = sense * exact_row(lanes.factor, pair), lanes.turning[DC], lanes.turning[DS]
    a, b, n = exact_row(rows, 0) * factor, exact_row(rows, 1) * factor, exact_row(rows, 2) * factor
    h, reach, term = exact_row(lanes.step, 0), exact_splat(0.0), exact_splat(0.0)
    set_row(guard, order, zero)
    for k in range(order - 1, -1, -1):
        before = term
        term = fused(a, exact_row(cosine, k), fused(b, exact_row(sine, k), n * exact_row(rate, k)))
        set_row(guard, k, term)
        if k > 1:
            reach = _reach(reach, term, h)
    first = term + sense
    first = choose(below(zero, first), first, zero)
    set_row(guard, 0, first)
    return below(fused(before, h, first), reach * h)


@kernel()
def _leaves(lanes, pair, order):
    """Return a bit for each lane in which the penetration of a clipped pair surely falls all the time."""
    guard, h, rise, half = lanes.guard[pair], exact_row(lanes.step, 0), exact_splat(0.0), exact_splat(0.5)
    for k in range(order, 1, -1):
        term = exact_row(guard, k)
        rise = fused((magnitude(term) + term) * half, exact_splat(1.0 * k), rise) * h
    return below(rise + exact_row(guard, 1), exact_splat(0.0))


@kernel()
def _take_column(lanes, lane, guard, order, full) -> None:
    """Write one guard of a lane to its column, and how far it is searched to `lanes.reach`.

    A column has `full` orders, however many the series have: Bernstein coefficients depend on the number.
    """
    lanes.guarded[lane] = guard
    for k in range(order + 1, full + 1):
        lanes.column[k, lane] = 0.0
    if guard < AGAIN:
        lanes.reach[lane] = lanes.step[lane]
        for k in range(order + 1):
            lanes.column[k, lane] = lanes.guard[guard, k, lane]
        return
    # a pair that has parted: minus its penetration, from there on
    pair = guard - AGAIN
    x = lanes.parted[pair, lane]
    lanes.reach[lane] = lanes.step[lane] - x
    for k in range(order + 1):
        lanes.column[k, lane] = -lanes.guard[pair, k, lane]
    for r in range(order):
        for j in range(order - 1, r - 1, -1):
            lanes.column[j, lane] += x * lanes.column[j + 1, lane]
    lanes.column[0, lane] = 0.0


@kernel()
def _next_columns(lanes, order, full) -> int:
    """Take the next guard of each lane that has one; return a bit for each such lane."""
    bits = 0
    for lane in range(WIDTH):
        if lanes.todo[lane] == 0:
            lanes.reach[lane] = 0.0
            continue
        guard = 0
        while lanes.todo[lane] >> guard & 1 == 0:
            guard += 1
        lanes.todo[lane] &= ~(1 << guard)
        _take_column(lanes, lane, guard, order, full)
        bits |= 1 << lane
    return bits


@kernel()
def _isolate(lanes, w, order, bits):
    """Return bits for the lanes whose column has one root in [0, reach), and several; write the chord's root to `root`.

    The Bernstein coefficients have as many sign changes as roots, or an even number more.
    """
    h, b, zero = exact_row(lanes.reach, 0), lanes.bernstein, exact_splat(0.0)
    power = exact_splat(1.0)
    for k in range(order + 1):
        set_row(b, k, exact_row(lanes.column, k) * (power * w.binomial[order, k]))
        power = power * h
    for r in range(1, order + 1):
        before = exact_row(b, r - 1)
        for j in range(r, order + 1):
            here = exact_row(b, j)
            set_row(b, j, here + before)
            before = here
    negative, once, more, before, root = 0, 0, 0, exact_row(b, 0), zero
    for k in range(1, order + 1):
        here = exact_row(b, k)
        now = below(here, zero) & bits
        changed = now ^ negative
        if changed != 0:
            at = (before / (before - here) + (k - 1.0)) * h * (1.0 / order)
            root = choose(changed & ~once, at, root)
            more |= once & changed
            once |= changed
        negative, before = now, here
    set_row(lanes.root, 0, root)
    return once & ~more, more


@kernel()
def _cross(lanes, order, bits) -> None:
    """Follow each column to its only root in [0, reach] by Halley's method within the bracket (`polynomial`)."""
    low, high, x = exact_splat(0.0), exact_row(lanes.reach, 0), exact_row(lanes.root, 0)
    zero, open_bits = exact_splat(0.0), bits
    for _ in range(_MOST_CHANGES):
        value, slope, bend = exact_row(lanes.column, order), zero, zero
        for k in range(order - 1, -1, -1):
            bend = fused(bend, x, slope)
            slope = fused(slope, x, value)
            value = fused(value, x, exact_row(lanes.column, k))
        behind = below(value, zero)
        low, high = choose(behind, low, x), choose(behind, x, high)
        steepness = slope * slope - value * bend
        change = value * slope / steepness
        falls = below(slope, zero) & below(zero, steepness)
        new, middle = x - change, (low + high) * 0.5
        within = falls & ~below(new, low) & ~below(high, new)
        new = choose(within, new, middle)
        small = below(magnitude(change), new * _FOUND) & below(magnitude(bend * change), magnitude(slope) * _STRAIGHT)
        rounded = high * _ROUNDED
        done = (within & small) | ~below(rounded, magnitude(new - x)) | ~below(rounded, high - low)
        x = choose(open_bits, new, x)
        open_bits &= ~done
        if open_bits == 0:
            break
    set_row(lanes.root, 0, x)


@kernel()
def _note_root(lanes, lane, root) -> None:
    """Take a root of the column of a lane: it ends the step there, or is a pair that parts."""
    guard = lanes.guarded[lane]
    pair = guard % PAIR_COUNT
    if guard < SECOND and lanes.mode[pair, lane] == CLIPPED:
        lanes.parted[pair, lane] = root
        lanes.parting[0] |= 1 << lane
        if lanes.leaves[pair] >> lane & 1 == 0:
            lanes.todo[lane] |= 1 << AGAIN + pair
        return
    if guard >= AGAIN:
        root += lanes.parted[pair, lane]
    elif guard >= SECOND and root >= lanes.parted[pair, lane]:
        return
    if root < lanes.step[lane]:
        lanes.step[lane], lanes.event[lane] = root, guard


@kernel()
def first_events(states, lanes, w, order, full, viscous, hysteretic) -> None:
    """Let each lane's step end at its first event; note the guard in `lanes.event`, -1 without one.

    `order` is the order of the series, `full` their largest.
    """
    never = exact_splat(np.inf)
    for pair in range(PAIR_COUNT):
        set_row(lanes.parted, pair, never)
    lanes.parting[0] = 0
    for lane in range(WIDTH):
        lanes.event[lane] = -1
    _write_guards(lanes, order, viscous, hysteretic)
    while True:
        bits = _next_columns(lanes, order, full)
        if bits == 0:
            return
        # the event found before may be earlier
        bits &= _unsafe(lanes.column, full, lanes.reach)
        if bits == 0:
            continue
        single, several = _isolate(lanes, w, full, bits)
        if single != 0:
            _cross(lanes, full, single)
        for lane in range(WIDTH):
            if (single | several) >> lane & 1:
                states[lanes.member[lane]].guard_roots += 1
                if several >> lane & 1:
                    column = w.column[0]
                    for k in range(full + 1):
                        column[k] = lanes.column[k, lane]
                    lanes.root[lane] = first_root(column, full, lanes.reach[lane], w)
                if lanes.root[lane] < lanes.reach[lane]:
                    _note_root(lanes, lane, lanes.root[lane])


@kernel()
def _next_mode(mode, viscous):
    """Return the mode that follows when a pair's first guard ends it."""
    if mode == OFF:
        return ON
    return CLIPPED if mode == ON and viscous is not None else OFF


@kernel(inline="source")
def _other_mode(mode):
    """Return the mode that follows when a pair's second guard ends it."""
    return CLIPPED if mode == ON else ON


@kernel()
def _ends_with(guard, order, at, within):
    """Return a bit for each lane whose guard turns negative at most `within` after `at`."""
    value, slope, zero = exact_row(guard, order), exact_splat(0.0), exact_splat(0.0)
    for k in range(order - 1, -1, -1):
        slope = fused(slope, at, value)
        value = fused(value, at, exact_row(guard, k))
    return below(slope, zero) & below(fused(slope, within, value), zero)


@kernel()
def note_switches(lanes, order, viscous, hysteretic) -> None:
    """Write the modes that pairs take at the end of the steps to `lanes.switch`, -1 for those that stay.

    Events that differ in time by rounding only happen together: a symmetric motion stays symmetric.
    """
    ending = 0
    for lane in range(WIDTH):
        ending |= 1 << lane if lanes.event[lane] >= 0 else 0
    if ending == 0:
        return
    at = exact_row(lanes.step, 0)
    within = at * _AT_ONCE
    for pair in range(PAIR_COUNT):
        for lane in range(WIDTH):
            lanes.switch[pair, lane] = -1
        first, again = _ends_with(lanes.guard[pair], order, at, within) & ending, 0
        guarded = 0
        if hysteretic is not None:
            guarded = (lanes.on[pair] | lanes.clipped[pair]) & ending
        elif viscous is not None:
            guarded = lanes.clipped[pair] & ending
        if guarded != 0:
            again = _ends_with(lanes.guard[SECOND + pair], order, at, within) & guarded
        if first | again == 0:
            continue
        for lane in range(WIDTH):
            if lanes.parted[pair, lane] < lanes.step[lane]:
                continue
            if first >> lane & 1:
                lanes.switch[pair, lane] = _next_mode(lanes.mode[pair, lane], viscous)
            elif again >> lane & 1:
                lanes.switch[pair, lane] = _other_mode(lanes.mode[pair, lane])
    for lane in range(WIDTH):
        event = lanes.event[lane]
        if event >= AGAIN:
            lanes.switch[event - AGAIN, lane] = ON
        elif event >= SECOND:
            lanes.switch[event - SECOND, lane] = _other_mode(lanes.mode[event - SECOND, lane])
        elif event >= 0:
            lanes.switch[event, lane] = _next_mode(lanes.mode[event, lane], viscous)
