"""Detection of the first event of each lane's step, the time at which a guard function becomes negative.

Each lane lists the few guard functions that can become negative, and each iteration searches eight of them, from any
lanes.

The separation of a CLIPPED or RELEASED pair changes no force and does not end the step. The rest of the step is
searched for its next touch.
"""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import first_root
from plow_twin.kernel.simd import (
    below,
    choose,
    exact_row,
    exact_splat,
    fused,
    gathered,
    lowest_bit,
    magnitude,
    picked,
    set_row,
)
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.events import LET_GO, ON_THE_WALL
from plow_twin.solve.lanes.record import (
    AGAIN,
    GUARD_ROOTS,
    GUARDS,
    SECOND,
    WIDTH,
    linear_at,
    penetration_at,
    places_of,
    to_bernstein,
)
from plow_twin.solve.state import CLIPPED, COS, OFF, ON, RELEASED, SIN, X, Y

#: Largest difference of the times of two simultaneous events, divided by the size of the step that ends with them.
_AT_ONCE = 1e-12
#: Conditions for the end of a search for a root. `_FOUND`: relative change of the root; the cube of the change is
#: negligible. `_STRAIGHT`: effect of the curvature on the change. `_ROUNDED`: relative change due to rounding.
_FOUND, _STRAIGHT, _ROUNDED = 1e-6, 1e-3, 2e-16
_MOST_CHANGES = 80
#: Indices in `lanes.chosen` after the five coefficients of a penetration: factor of d, factor of d', constant.
_DEPTH, _RATE, _CONSTANT = 5, 6, 7


@kernel()
def _list_guards(lanes, order, hysteretic, power, fraction) -> None:
    """Write to `lanes.todo` a bit mask of the guard functions of each lane that may become negative.

    The guard functions depend on the mode and on the penetration d:

    - OFF: -d.
    - ON, with the damping C d': F / K = d + (C / K) d'.
    - ON, with the damping lambda d': d and 1 + lambda d'.
    - CLIPPED: d, and the force with the opposite sign.
    - RELEASED (`modes`): d, and the distance to the release penetration.
    """
    for lane in range(WIDTH):
        lanes.todo[lane] = lanes.watched[lane]
    _list_off(lanes, order)
    if power is not None:
        _list_powers(lanes, order, hysteretic, fraction)
        return
    one, none, h = exact_splat(1.0), exact_splat(0.0), exact_row(lanes.step, 0)
    damped = exact_row(lanes.damped, 0)
    for slot in range(PAIR_COUNT):
        taken, gear = lanes.taken[slot], lanes.gear[slot]
        if taken == 0:
            break
        if hysteretic is None:
            ends = _write_guard(lanes, None, gear, one, damped, none, lanes.push[slot], order, h, None)
            _note(lanes, slot, 0, ends & taken)
        else:
            ends = _write_guard(lanes, None, gear, one, none, none, lanes.guard, order, h, None)
            _note(lanes, slot, 0, ends & taken)
            pull = _write_guard(lanes, None, gear, none, exact_row(gear, 7), one, lanes.guard, order, h, None)
            _note(lanes, slot, SECOND, pull & taken)


@kernel()
def _list_powers(lanes, order, hysteretic, fraction) -> None:
    """List the guard functions of pairs that are ON, for exponents other than 1."""
    one, none, h = exact_splat(1.0), exact_splat(0.0), exact_row(lanes.step, 0)
    for slot in range(PAIR_COUNT):
        taken = lanes.taken[slot]
        if taken == 0:
            break
        depth = exact_row(lanes.depth[slot], 0)
        first = choose(below(none, depth), depth, none)
        if fraction is not None:
            let_go, half = exact_row(lanes.release, 0) * LET_GO, first * 0.5
            first = first - choose(below(half, let_go), half, let_go)
        _note(lanes, slot, 0, _may_end(lanes.depth[slot], one, first, order, h) & taken)
        if hysteretic is not None:
            factor = exact_row(lanes.gear[slot], 7)
            first = fused(factor, exact_row(lanes.rate[slot], 0), one)
            _note(lanes, slot, SECOND, _may_end(lanes.rate[slot], factor, first, order - 1, h) & taken)


@kernel()
def _may_end(series, factor, first, order, h):
    """Return a bit mask of the lanes whose guard function may become negative.

    Term 0 of the guard function is `first`. Every higher term is the term of `series` times `factor`. `_write_guard`
    describes the test.
    """
    lowest = term = zero = exact_splat(0.0)
    for k in range(order, 0, -1):
        term = exact_row(series, k) * factor
        if k > 1:
            lowest = fused(lowest, h, choose(below(term, zero), term, zero))
    return below(fused(lowest * h, h, fused(term, h, first)), zero)


@kernel()
def _note(lanes, slot, kind, bits) -> None:
    if bits != 0:
        for lane in range(WIDTH):
            lanes.todo[lane] |= (bits >> lane & 1) << kind + lanes.slot[slot, lane]


@kernel()
def _list_off(lanes, order) -> None:
    """List the guard functions of OFF pairs, unless their first terms and bounds of the later terms exclude a touch."""
    h, series, cosine, sine = exact_row(lanes.step, 0), lanes.series, lanes.series[COS], lanes.series[SIN]
    x, y = series[X], series[Y]
    # bounds of the terms after the second term: the sums of abs(term k) h^k for k > 1
    later_c = later_s = later_x = later_y = exact_splat(0.0)
    for k in range(order, 1, -1):
        later_c = fused(later_c, h, magnitude(exact_row(cosine, k)))
        later_s = fused(later_s, h, magnitude(exact_row(sine, k)))
        later_x = fused(later_x, h, magnitude(exact_row(x, k)))
        later_y = fused(later_y, h, magnitude(exact_row(y, k)))
    later_c, later_s, later_x, later_y = later_c * h * h, later_s * h * h, later_x * h * h, later_y * h * h
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


@kernel(inline="code")
def _row_of(array, k, places):
    if places is None:
        return exact_row(array, k)
    return picked(array, k, places)


@kernel()
def _write_guard(lanes, places, rows, of_depth, of_rate, constant, guard, order, h, fraction):
    """Write the guard functions `of_depth` d + `of_rate` d' + `constant` to `guard`, with the penetrations d.

    `places` contains the lanes of the guard functions; None means one guard function of each lane, in order. Returns a
    bit mask of the guard functions that may become negative, by the lower bound in `solve.events._unsafe_pairs`.
    """
    cosine, sine, x, y = lanes.series[COS], lanes.series[SIN], lanes.series[X], lanes.series[Y]
    lowest = term = deeper = zero = exact_splat(0.0)
    dc, ds, dx, dy = lanes.rates[0], lanes.rates[1], lanes.rates[2], lanes.rates[3]
    damped = below(zero, magnitude(of_rate))
    for k in range(order, 0, -1):
        depth = linear_at(
            rows, _row_of(cosine, k, places), _row_of(sine, k, places), _row_of(x, k, places), _row_of(y, k, places)
        )
        if fraction is None:
            term = fused(of_rate * (k + 1.0), deeper, of_depth * depth)
            deeper = depth
        else:
            # if the series variable is a root of time, the series of d' is not the derivative of the series of d
            term = of_depth * depth
            if damped != 0 and k < order:
                deeper = linear_at(
                    rows, _row_of(dc, k, places), _row_of(ds, k, places), _row_of(dx, k, places), _row_of(dy, k, places)
                )
                term = fused(of_rate, deeper, term)
        set_row(guard, k, term)
        if k > 1:
            lowest = fused(lowest, h, choose(below(term, zero), term, zero))
    depth = penetration_at(
        rows, _row_of(cosine, 0, places), _row_of(sine, 0, places), _row_of(x, 0, places), _row_of(y, 0, places)
    )
    if fraction is not None:  # noqa: SIM102 - left out by types
        if damped != 0:
            deeper = linear_at(
                rows, _row_of(dc, 0, places), _row_of(ds, 0, places), _row_of(dx, 0, places), _row_of(dy, 0, places)
            )
    first = fused(of_rate, deeper, of_depth * depth) + constant
    kept = below(zero, first)
    if fraction is not None:
        # a pair that separates within the step penetrates at the start
        kept |= below(zero, exact_row(lanes.begin, 0))
    first = choose(kept, first, zero)
    set_row(guard, 0, first)
    return below(fused(lowest * h, h, fused(term, h, first)), zero)


@kernel()
def _choose_guards(lanes, at, hysteretic, fraction) -> int:
    """Choose up to eight guard functions, first the next function of each lane, and return their number."""
    count = busy = 0
    for lane in range(WIDTH):
        busy |= 1 << lane if lanes.todo[lane] != 0 else 0
    while busy != 0 and count < WIDTH:
        remaining = busy
        while remaining != 0 and count < WIDTH:
            lane = lowest_bit(remaining)
            remaining &= remaining - 1
            todo = lanes.todo[lane]
            guard, todo = lowest_bit(todo), todo & todo - 1
            lanes.todo[lane] = todo
            busy ^= 1 << lane if todo == 0 else 0
            lanes.guarded[at, count], lanes.owner[at, count] = guard, lane
            _write_choice(lanes, lane, guard, count, hysteretic, fraction)
            count += 1
    for i in range(count, WIDTH):
        lanes.guarded[at, i], lanes.owner[at, i] = -1, 0
    return count


@kernel()
def _write_choice(lanes, lane, guard, i, hysteretic, fraction) -> None:
    """Write the guard function `i` of an iteration: factors of d and d', constant, and interval."""
    chosen, pair = lanes.chosen, guard % PAIR_COUNT
    mode, sign, constant, rate = lanes.mode[pair, lane], 1.0, 0.0, lanes.damped[lane]
    begin = 0.0
    if guard < SECOND:
        sign, rate = -1.0 if mode == OFF else 1.0, rate if mode == ON else 0.0
    elif guard >= AGAIN:
        sign, rate, begin = -1.0, 0.0, lanes.parted[pair, lane]
    elif hysteretic is None:
        sign, rate = -1.0, -rate
    else:
        constant = 1.0 if mode == ON else -1.0
        sign, rate = 0.0, constant * lanes.factor[pair, lane]
    if fraction is not None:
        if guard < AGAIN and mode == RELEASED and guard >= SECOND:
            sign, rate, constant = -1.0, 0.0, lanes.release[lane]
        elif guard < SECOND and mode != OFF:
            constant = _allowance(lanes, pair, lane, mode)
    chosen[_DEPTH, i], chosen[_RATE, i], chosen[_CONSTANT, i] = sign, rate, constant
    # other lanes influence when a step is shortened, and the bits of a root depend on the searched interval
    lanes.begin[i], lanes.reach[i] = begin, lanes.accurate[lane] - begin
    lanes.row_place[i] = pair * 5 * WIDTH + lane


@kernel()
def _allowance(lanes, pair, lane, mode) -> float:
    """Return the constant term of the guard function d for exponents that are not integers (`solve.events`)."""
    rows, y, let_go = lanes.rows[pair], lanes.y, LET_GO * lanes.release[lane]
    depth = rows[0, lane] * y[COS, lane] + rows[1, lane] * y[SIN, lane] + rows[4, lane]
    depth = max(depth + rows[2, lane] * y[X, lane] + rows[3, lane] * y[Y, lane], 0.0)
    if mode == ON:
        return -min(let_go, 0.5 * depth)
    return let_go if mode == RELEASED and depth <= ON_THE_WALL * lanes.release[lane] else 0.0


@kernel()
def _shift(lanes, guard, order, again, fraction) -> None:
    """Shift the guard functions of pairs that have separated to the time of separation."""
    x, zero = exact_row(lanes.begin, 0), exact_splat(0.0)
    for r in range(order):
        after = exact_row(guard, order)
        for j in range(order - 1, r - 1, -1):
            after = exact_row(guard, j) + x * after
            set_row(guard, j, after)
    first = zero
    if fraction is not None:
        # a RELEASED pair may separate slightly outside its wall (`LET_GO`), where -d is positive
        first = choose(below(zero, exact_row(guard, 0)), exact_row(guard, 0), zero)
    set_row(guard, 0, choose(again, first, exact_row(guard, 0)))


@kernel()
def isolate(lanes, column, w, order, bits):
    """Return bit masks of the polynomials with one root in [0, reach), and of those that may have several roots.

    `column` contains one polynomial for each lane. The number of sign changes of its Bernstein coefficients is the
    number of roots plus an even number. The root of the chord between the coefficients that change sign, a first
    estimate, is written to `lanes.root`.
    """
    h, b, zero = exact_row(lanes.reach, 0), lanes.bernstein, exact_splat(0.0)
    to_bernstein(lanes, column, w, order, h)
    once = more = 0
    before, root = exact_row(b, 0), zero
    negative = below(before, zero) & bits
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
def _isolate_first(lanes, column, w, order, bits):
    """Return a bit mask of the polynomials of `bits` whose first root is the only root up to their lowest coefficient.

    The intervals of `bits` are shortened to the place of their lowest Bernstein coefficients. A function that becomes
    negative for a short time usually has one root there.
    """
    b, h, root = lanes.bernstein, exact_row(lanes.reach, 0), exact_row(lanes.root, 0)
    lowest, place = exact_row(b, 0), exact_splat(0.0)
    for k in range(1, order + 1):
        lower = below(exact_row(b, k), lowest)
        lowest, place = choose(lower, exact_row(b, k), lowest), choose(lower, exact_splat(1.0 * k), place)
    set_row(lanes.reach, 0, choose(bits, place * h * (1.0 / order), h))
    once, _ = isolate(lanes, column, w, order, bits)
    set_row(lanes.root, 0, choose(once, exact_row(lanes.root, 0), root))
    return once


@kernel()
def cross(lanes, column, order, bits) -> None:
    """Compute each polynomial's only root in [0, reach], by Halley's method with bisection as fallback."""
    low, high, x, zero = exact_splat(0.0), exact_row(lanes.reach, 0), exact_row(lanes.root, 0), exact_splat(0.0)
    # each iteration toward a double zero at 0 would only divide x by three
    falls_from_zero = below(exact_row(column, 2), zero) & ~below(zero, magnitude(exact_row(column, 0)))
    x = choose(falls_from_zero & ~below(zero, magnitude(exact_row(column, 1))), zero, x)
    open_bits = bits & below(zero, x)
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
def _note_root(lanes, lane, guard, root, is_only_root) -> None:
    """End the step at a root, or record the separation of a CLIPPED or RELEASED pair."""
    pair = guard % PAIR_COUNT
    if guard < SECOND and lanes.mode[pair, lane] > ON:
        lanes.parted[pair, lane] = root
        lanes.parting[0] |= 1 << lane
        if not is_only_root:
            # the pair may touch again within the step
            lanes.todo[lane] |= 1 << AGAIN + pair
    elif guard < SECOND or guard >= AGAIN or root < lanes.parted[pair, lane]:
        lanes.step[lane], lanes.event[lane] = root, guard


@kernel()
def first_events(lanes, w, order, full, hysteretic, power, fraction) -> None:
    """Shorten each lane's step to its first event. Write the number of the guard function, or -1, to `lanes.event`.

    Guard functions have the order `full`, because the rounding of their Bernstein coefficients would otherwise depend
    on `order`, the order of the series.
    """
    never = exact_splat(np.inf)
    for pair in range(PAIR_COUNT):
        set_row(lanes.parted, pair, never)
    lanes.parting[0] = 0
    for lane in range(WIDTH):
        lanes.event[lane] = -1
    _list_guards(lanes, order, hysteretic, power, fraction)
    # an iteration searches at least one listed guard function of each lane
    for at in range(GUARDS):
        lanes.rounds[0] = at
        count = _choose_guards(lanes, at, hysteretic, fraction)
        if count == 0:
            return
        bits = _write_chosen(lanes, at, order, full, fraction) & ((1 << count) - 1)
        set_row(lanes.ending, at, never)
        if bits != 0:
            _search(lanes, w, at, full, bits)
    lanes.rounds[0] = GUARDS


@kernel()
def _write_chosen(lanes, at, order, full, fraction):
    """Write the guard functions of an iteration, and return a bit mask of those that may become negative."""
    chosen, guard, zero = lanes.chosen, lanes.guard, exact_splat(0.0)
    places = places_of(lanes.row_place)
    for i in range(5):
        set_row(chosen, i, gathered(lanes.rows, i, places))
    for k in range(order + 1, full + 1):
        set_row(guard, k, zero)
    bits = _write_guard(
        lanes, exact_row(lanes.owner, at), chosen, exact_row(chosen, _DEPTH), exact_row(chosen, _RATE),
        exact_row(chosen, _CONSTANT), guard, order, exact_row(lanes.reach, 0), fraction,
    )  # fmt: skip
    again = below(zero, exact_row(lanes.begin, 0))
    if again != 0:
        _shift(lanes, guard, order, again, fraction)
    return bits | again & below(zero, exact_row(lanes.reach, 0))


@kernel()
def _search(lanes, w, at, order, bits) -> None:
    """Search the first root of each guard function within the step of its lane."""
    guard = lanes.guard
    single, several = isolate(lanes, guard, w, order, bits)
    found = single
    if several != 0:
        found |= _isolate_first(lanes, guard, w, order, several)
    if found != 0:
        cross(lanes, guard, order, found)
    remaining = single | several
    while remaining != 0:
        i = lowest_bit(remaining)
        remaining &= remaining - 1
        lane, begin, root = lanes.owner[at, i], lanes.begin[i], lanes.root[i]
        if found >> i & 1 == 0:
            column = w.column[0]
            for k in range(order + 1):
                column[k] = guard[k, i]
            root = first_root(column, order, lanes.accurate[lane] - begin, w)
        root += begin
        lanes.ending[at, i] = root
        if root < lanes.step[lane]:
            lanes.counts[GUARD_ROOTS, lane] += 1
            _note_root(lanes, lane, lanes.guarded[at, i], root, single >> i & 1 == 1)


@kernel()
def _next_mode(lanes, lane, mode, viscous, fraction):
    """Return the mode that follows `mode` when the first guard function of a pair becomes negative."""
    if mode == OFF:
        return ON if fraction is None or lanes.exponent[lane] == 1.5 else RELEASED
    if fraction is not None:  # noqa: SIM102 - left out by types
        if mode == ON:
            return RELEASED
    return CLIPPED if mode == ON and viscous is not None else OFF


@kernel(inline="source")
def _other_mode(mode):
    """Return the mode that follows `mode` when the second guard function of a pair becomes negative."""
    return CLIPPED if mode == ON else ON


@kernel()
def note_switches(lanes, viscous, fraction) -> None:
    """Write the pairs that change their modes after the steps to `lanes.switching`, and the modes to `lanes.switch`.

    Events that differ only by rounding are simultaneous, so that a symmetric motion stays symmetric.
    """
    ending = 0
    for lane in range(WIDTH):
        ending |= 1 << lane if lanes.event[lane] >= 0 else 0
        lanes.switching[lane] = 0
    if ending == 0:
        return
    for at in range(lanes.rounds[0]):
        step = picked(lanes.step, 0, exact_row(lanes.owner, at))
        ended = below(exact_row(lanes.ending, at), step * (1.0 + _AT_ONCE))
        while ended != 0:
            i = lowest_bit(ended)
            ended &= ended - 1
            guard, lane = lanes.guarded[at, i], lanes.owner[at, i]
            if lanes.event[lane] >= 0 and 0 <= guard < AGAIN:
                pair = guard % PAIR_COUNT
                # the first guard function of a pair takes precedence over the second
                if lanes.switching[lane] >> pair & 1 == 0 and lanes.parted[pair, lane] >= lanes.step[lane]:
                    _note_switch(lanes, lane, guard, viscous, fraction)
    for lane in range(WIDTH):
        if lanes.event[lane] >= 0:
            _note_switch(lanes, lane, lanes.event[lane], viscous, fraction)


@kernel()
def _note_switch(lanes, lane, guard, viscous, fraction) -> None:
    pair = guard % PAIR_COUNT
    mode = lanes.mode[pair, lane]
    if guard >= AGAIN:
        mode = _next_mode(lanes, lane, OFF, viscous, fraction)
    elif guard >= SECOND:
        mode = _other_mode(mode)
    else:
        mode = _next_mode(lanes, lane, mode, viscous, fraction)
    lanes.switch[pair, lane] = mode
    lanes.switching[lane] |= 1 << pair
