"""The first event of each lane's step.

Few guards can turn negative within a step. Each lane lists its guards; in each round every lane searches one of them. A
clipped pair that parts changes no force and ends no step; the rest of the step is searched for its next touch.
"""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import first_root
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, magnitude, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import AGAIN, GUARDS, SECOND, WIDTH, linear_at, penetration_at, to_bernstein
from plow_twin.solve.state import CLIPPED, COS, OFF, ON, SIN, X, Y

#: Events are one instant when they are closer than this share of the step before them.
_AT_ONCE = 1e-12
#: Change of a root that ends its search, as the next change is of the order of its cube, and rounding errors of the
#: root.
_FOUND, _STRAIGHT, _ROUNDED = 1e-6, 1e-3, 2e-16
_MOST_CHANGES = 80
#: Rows of `lanes.chosen` after those of a penetration.
_DEPTH, _RATE, _CONSTANT = 5, 6, 7


@kernel()
def _list_guards(lanes, order, hysteretic) -> None:
    """Write to `lanes.todo` a bit for each guard of a lane that is not proved to stay positive.

    off: -d; on: F / K = d + (C / K) d', or d and 1 + lambda d'; clipped: d, and the force with the other sign.
    """
    for lane in range(WIDTH):
        lanes.todo[lane] = lanes.watched[lane]
    _list_off(lanes, order)
    one, none, h = exact_splat(1.0), exact_splat(0.0), exact_row(lanes.step, 0)
    damped = exact_row(lanes.viscous, 0) / exact_row(lanes.stiffness, 0)
    for slot in range(PAIR_COUNT):
        taken, gear = lanes.taken[slot], lanes.gear[slot]
        if taken == 0:
            break
        if hysteretic is None:
            _note(lanes, slot, 0, _write_guard(lanes, gear, one, damped, none, lanes.push[slot], order, h) & taken)
        else:
            _note(lanes, slot, 0, _write_guard(lanes, gear, one, none, none, lanes.guard[0], order, h) & taken)
            pull = _write_guard(lanes, gear, none, exact_row(gear, 7), one, lanes.guard[0], order, h)
            _note(lanes, slot, SECOND, pull & taken)


@kernel()
def _note(lanes, slot, kind, bits) -> None:
    if bits != 0:
        for lane in range(WIDTH):
            lanes.todo[lane] |= (bits >> lane & 1) << kind + lanes.slot[slot, lane]


@kernel()
def _later(series, order, h):
    """Return the sum of abs(term k) h^k for k > 1."""
    reach = exact_splat(0.0)
    for k in range(order, 1, -1):
        reach = fused(reach, h, magnitude(exact_row(series, k)))
    return reach * h * h


@kernel()
def _list_off(lanes, order) -> None:
    """List the guards of pairs that are off.

    A guard is left out if its first terms, with bounds of the later terms, prove that the pair stays off.
    """
    h, series, cosine, sine = exact_row(lanes.step, 0), lanes.series, lanes.series[COS], lanes.series[SIN]
    x, y = series[X], series[Y]
    later_c, later_s = _later(cosine, order, h), _later(sine, order, h)
    later_x, later_y = _later(x, order, h), _later(y, order, h)
    for pair in range(PAIR_COUNT):
        if lanes.off[pair] == 0:
            continue
        rows = lanes.rows[pair]
        depth = penetration_at(rows, exact_row(cosine, 0), exact_row(sine, 0), exact_row(x, 0), exact_row(y, 0))
        rate = linear_at(rows, exact_row(cosine, 1), exact_row(sine, 1), exact_row(x, 1), exact_row(y, 1))
        bound = fused(magnitude(exact_row(rows, 0)), later_c, magnitude(exact_row(rows, 1)) * later_s)
        bound = bound + (later_y if pair % 2 == 0 else later_x)
        unsafe = lanes.off[pair] & ~below(fused(rate, h, depth) + bound, exact_splat(0.0))
        if unsafe != 0:
            for lane in range(WIDTH):
                lanes.todo[lane] |= (unsafe >> lane & 1) << pair


@kernel()
def _write_guard(lanes, rows, of_depth, of_rate, constant, guard, order, h):
    """Write a guard, given by factors of d and d' and a constant; return a bit for each lane where it may end.

    A guard g is positive on [0, h] where g_0 and g_0 + g_1 h - sum over k > 1 of max(-g_k, 0) h^k are: that bound is
    concave.
    """
    cosine, sine, x, y = lanes.series[COS], lanes.series[SIN], lanes.series[X], lanes.series[Y]
    reach = term = deeper = zero = exact_splat(0.0)
    for k in range(order, 0, -1):
        depth = linear_at(rows, exact_row(cosine, k), exact_row(sine, k), exact_row(x, k), exact_row(y, k))
        term = fused(of_rate * (k + 1.0), deeper, of_depth * depth)
        deeper = depth
        set_row(guard, k, term)
        if k > 1:
            reach = fused(magnitude(term) - term, exact_splat(0.5), reach) * h
    depth = penetration_at(rows, exact_row(cosine, 0), exact_row(sine, 0), exact_row(x, 0), exact_row(y, 0))
    first = fused(of_rate, deeper, of_depth * depth) + constant
    first = choose(below(zero, first), first, zero)
    set_row(guard, 0, first)
    return below(fused(term, h, first), reach * h)


@kernel()
def _choose_guards(lanes, at, hysteretic):
    """Choose the next guard of each lane, if any; return bits for lanes with a guard, and with a new touch."""
    bits = again = 0
    for lane in range(WIDTH):
        lanes.guarded[at, lane] = -1
        lanes.reach[lane] = 0.0
        if lanes.todo[lane] == 0:
            continue
        guard = 0
        while lanes.todo[lane] >> guard & 1 == 0:
            guard += 1
        lanes.todo[lane] &= ~(1 << guard)
        lanes.guarded[at, lane] = guard
        lanes.reach[lane] = lanes.step[lane]
        bits |= 1 << lane
        if guard >= AGAIN:
            again |= 1 << lane
            lanes.reach[lane] -= lanes.parted[guard % PAIR_COUNT, lane]
        _write_choice(lanes, lane, guard, hysteretic)
    return bits, again


@kernel()
def _write_choice(lanes, lane, guard, hysteretic) -> None:
    """Write the factors of a guard of a lane."""
    chosen, pair = lanes.chosen, guard % PAIR_COUNT
    mode, sign, constant, rate = lanes.mode[pair, lane], 1.0, 0.0, lanes.viscous[lane] / lanes.stiffness[lane]
    for i in range(5):
        chosen[i, lane] = lanes.rows[pair, i, lane]
    if guard < SECOND:
        sign, rate = -1.0 if mode == OFF else 1.0, rate if mode == ON else 0.0
    elif guard >= AGAIN:
        sign, rate = -1.0, 0.0
    elif hysteretic is None:
        sign, rate = -1.0, -rate
    else:
        constant = 1.0 if mode == ON else -1.0
        sign, rate = 0.0, constant * lanes.factor[pair, lane]
    chosen[_DEPTH, lane], chosen[_RATE, lane], chosen[_CONSTANT, lane] = sign, rate, constant


@kernel()
def _shift(lanes, guard, pair, lane, order) -> None:
    """Let the guard of a pair that has parted begin at that point."""
    x = lanes.parted[pair, lane]
    for r in range(order):
        for j in range(order - 1, r - 1, -1):
            guard[j, lane] += x * guard[j + 1, lane]
    guard[0, lane] = 0.0


@kernel()
def _isolate(lanes, column, w, order, bits):
    """Return bits for lanes whose column has one root in [0, reach), and for several; write the chord's root to `root`.

    The Bernstein coefficients have as many sign changes as roots, or an even number more.
    """
    h, b, zero = exact_row(lanes.reach, 0), lanes.bernstein, exact_splat(0.0)
    to_bernstein(lanes, column, w, order, h)
    negative = once = more = 0
    before, root = exact_row(b, 0), zero
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
def _cross(lanes, column, order, bits) -> None:
    """Follow each column to its only root in [0, reach] by Halley's method within the bracket (`polynomial`)."""
    low, high, x = exact_splat(0.0), exact_row(lanes.reach, 0), exact_row(lanes.root, 0)
    zero, open_bits = exact_splat(0.0), bits
    for _ in range(_MOST_CHANGES):
        value, slope, bend = exact_row(column, order), zero, zero
        for k in range(order - 1, -1, -1):
            bend = fused(bend, x, slope)
            slope = fused(slope, x, value)
            value = fused(value, x, exact_row(column, k))
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
def _leaves(guard, lane, order, h) -> bool:
    """Return whether a penetration surely falls all the time."""
    rise = 0.0
    for k in range(order, 1, -1):
        rise = (rise + k * max(guard[k, lane], 0.0)) * h
    return rise + guard[1, lane] < 0.0


@kernel()
def _note_root(lanes, lane, at, order) -> None:
    """Use a root of a lane's guard: it ends the step, or marks the parting of a pair."""
    guard, root = lanes.guarded[at, lane], lanes.root[lane]
    pair = guard % PAIR_COUNT
    if guard < SECOND and lanes.mode[pair, lane] == CLIPPED:
        lanes.parted[pair, lane] = root
        lanes.parting[0] |= 1 << lane
        if not _leaves(lanes.guard[at], lane, order, lanes.step[lane]):
            lanes.todo[lane] |= 1 << AGAIN + pair
        return
    if guard >= AGAIN:
        root += lanes.parted[pair, lane]
    elif guard >= SECOND and root >= lanes.parted[pair, lane]:
        return
    if root < lanes.step[lane]:
        lanes.step[lane], lanes.event[lane] = root, guard


@kernel()
def first_events(states, lanes, w, order, full, hysteretic) -> None:
    """Let each lane's step end at its first event; note the guard in `lanes.event`, -1 without one.

    `order` is the order of the series. Guards have `full` orders, the largest: Bernstein coefficients depend on them.
    """
    never = exact_splat(np.inf)
    for pair in range(PAIR_COUNT):
        set_row(lanes.parted, pair, never)
    lanes.parting[0] = 0
    for lane in range(WIDTH):
        lanes.event[lane] = -1
    _list_guards(lanes, order, hysteretic)
    for at in range(GUARDS):
        lanes.rounds[0] = at
        bits, again = _choose_guards(lanes, at, hysteretic)
        if bits == 0:
            return
        bits &= again | _write_chosen(lanes, lanes.guard[at], order, full)
        if again != 0:
            for lane in range(WIDTH):
                if again >> lane & 1:
                    _shift(lanes, lanes.guard[at], lanes.guarded[at, lane] - AGAIN, lane, order)
        if bits != 0:
            _search(states, lanes, w, at, full, bits)
    lanes.rounds[0] = GUARDS


@kernel()
def _write_chosen(lanes, guard, order, full):
    """Write the chosen guards; return as `_write_guard`."""
    chosen, zero = lanes.chosen, exact_splat(0.0)
    for k in range(order + 1, full + 1):
        set_row(guard, k, zero)
    return _write_guard(
        lanes, chosen, exact_row(chosen, _DEPTH), exact_row(chosen, _RATE), exact_row(chosen, _CONSTANT), guard, order,
        exact_row(lanes.reach, 0),
    )  # fmt: skip


@kernel()
def _search(states, lanes, w, at, order, bits) -> None:
    """Look for the first root of each lane's guard."""
    guard = lanes.guard[at]
    single, several = _isolate(lanes, guard, w, order, bits)
    if single != 0:
        _cross(lanes, guard, order, single)
    for lane in range(WIDTH):
        if (single | several) >> lane & 1:
            states[lanes.member[lane]].guard_roots += 1
            if several >> lane & 1:
                column = w.column[0]
                for k in range(order + 1):
                    column[k] = guard[k, lane]
                lanes.root[lane] = first_root(column, order, lanes.reach[lane], w)
            if lanes.root[lane] < lanes.reach[lane]:
                _note_root(lanes, lane, at, order)


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
def note_switches(lanes, order, viscous) -> None:
    """Write the modes that pairs take at the end of the steps to `lanes.switch`, -1 for those that stay.

    Events that differ in time only by rounding happen together, so that a symmetric motion stays symmetric.
    """
    ending = 0
    for lane in range(WIDTH):
        ending |= 1 << lane if lanes.event[lane] >= 0 else 0
        for pair in range(PAIR_COUNT):
            lanes.switch[pair, lane] = -1
    if ending == 0:
        return
    step = exact_row(lanes.step, 0)
    for at in range(lanes.rounds[0]):
        ended = _ends_with(lanes.guard[at], order, step, step * _AT_ONCE) & ending
        for lane in range(WIDTH):
            if ended >> lane & 1 and 0 <= lanes.guarded[at, lane] < AGAIN:
                pair = lanes.guarded[at, lane] % PAIR_COUNT
                # a first guard comes before a second
                if lanes.switch[pair, lane] < 0 and lanes.parted[pair, lane] >= lanes.step[lane]:
                    _note_switch(lanes, lane, lanes.guarded[at, lane], viscous)
    for lane in range(WIDTH):
        if lanes.event[lane] >= 0:
            _note_switch(lanes, lane, lanes.event[lane], viscous)


@kernel()
def _note_switch(lanes, lane, guard, viscous) -> None:
    """Note the mode that follows when a guard ends."""
    pair = guard % PAIR_COUNT
    mode = lanes.mode[pair, lane]
    if guard >= AGAIN:
        mode = ON
    elif guard >= SECOND:
        mode = _other_mode(mode)
    else:
        mode = _next_mode(mode, viscous)
    lanes.switch[pair, lane] = mode
