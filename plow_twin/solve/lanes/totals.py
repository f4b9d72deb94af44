"""Totals of the motions in the lanes: impulses, peaks and times from the series of one step of each."""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import maximum
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, magnitude, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import COMPONENTS, WIDTH, penetration_at
from plow_twin.solve.state import COS, SIN, X, Y
from plow_twin.solve.totals import add_set_times

#: Most Newton steps to a maximum, and the change, as a share of the step, that is small enough: its cube remains.
_MOST_CHANGES, _NEAR = 60, 1e-5
#: Allowance of a force's bound for rounding.
_ROUNDED = 1.0 + 1e-9


@kernel()
def sum_step(lanes, w, order) -> None:
    """Write the change of the state over each lane's step, and the integrals of cosine, sine, X and Y.

    The integrals are those of the change, without the values at the start.
    """
    h = exact_row(lanes.step, 0)
    for i in range(COMPONENTS):
        series, change = lanes.series[i], exact_splat(0.0)
        for k in range(order, 0, -1):
            change = fused(change, h, exact_row(series, k))
        set_row(lanes.change, i, change * h)
    for i in range(4):
        component = COS if i == 0 else SIN if i == 1 else X if i == 2 else Y
        series, total = lanes.series[component], exact_splat(0.0)
        for k in range(order, 0, -1):
            total = fused(total, h, exact_row(series, k) * w.inverse[k + 1])
        set_row(lanes.sum, i, total * h * h)


@kernel()
def add_step(totals, lanes, w, order, full, viscous, hysteretic) -> None:
    """Add the steps that have been laid out to the sums in the lanes, and the times of sets to totals if there are any.

    `order` and `full` are as for `first_events`.
    """
    h, last = exact_row(lanes.step, 0), order - 1
    if totals is None:
        # under samples the series of a lane may end before; then its guard has one more term
        last = order
    for pair in range(PAIR_COUNT):
        on = lanes.on[pair]
        if on == 0:
            continue
        place, which = (3, Y) if pair % 2 == 0 else (2, X)
        rows, zero = lanes.rows[pair], exact_splat(0.0)
        a, b, n = exact_row(rows, 0), exact_row(rows, 1), exact_row(rows, 2)
        depth = penetration_at(lanes, pair, exact_row(lanes.y, COS), exact_row(lanes.y, SIN), exact_row(lanes.y, which))
        swept = fused(a, exact_row(lanes.sum, 0), fused(b, exact_row(lanes.sum, 1), n * exact_row(lanes.sum, place)))
        impulse = exact_row(lanes.stiffness, 0) * fused(depth, h, swept)
        if viscous is not None or hysteretic is not None:
            way = fused(b, exact_row(lanes.change, SIN), n * exact_row(lanes.change, which))
            way = fused(a, exact_row(lanes.change, COS), way)
            if viscous is not None:
                impulse = fused(exact_row(lanes.viscous, 0), way, impulse)
            else:
                # lambda / 2 times the change of d^2
                damped = exact_row(lanes.factor, pair) * (way * fused(way, exact_splat(0.5), depth))
                impulse = fused(exact_row(lanes.stiffness, 0), damped, impulse)
        impulse = choose(below(zero, impulse) & on, impulse, zero)
        set_row(lanes.impulse, pair, exact_row(lanes.impulse, pair) + impulse)
        time = exact_row(lanes.time_in_contact, pair)
        set_row(lanes.time_in_contact, pair, choose(on, time + h, time))
        if hysteretic is not None:
            _raise_peaks(lanes, w, lanes.push[pair], pair, order - 1, full - 1, on)
        else:
            _raise_peaks(lanes, w, lanes.guard[pair], pair, last, last + full - order, on)
    if totals is None:
        return
    for lane in range(WIDTH):
        if lanes.member[lane] >= 0 and lanes.carrying[lane] != 0:
            add_set_times(totals[lanes.member[lane]], lanes.carrying[lane], lanes.step[lane])


@kernel()
def _raise_peaks(lanes, w, push, pair, order, full, on) -> None:
    """Raise the peaks of a pair by the series of F / K: first a bound, the maximum only where that exceeds the peak.

    Between its ends a function exceeds them at most by h^2 / 8 times its largest downward curvature.
    """
    h, zero, half = exact_row(lanes.step, 0), exact_splat(0.0), exact_splat(0.5)
    end = fall = bend = zero
    for k in range(order, -1, -1):
        term = exact_row(push, k)
        fall = fused(fall, h, end)
        end = fused(end, h, term)
        if k > 1:
            downward = (magnitude(term) - term) * half
            bend = fused(downward, exact_splat(0.125 * k * (k - 1)), bend) * h
    start, stiffness, peak = exact_row(push, 0), exact_row(lanes.stiffness, 0), exact_row(lanes.peak, pair)
    most = choose(below(start, end), end, start)
    exceeds = below(peak, stiffness * fused(bend, h, most) * _ROUNDED) & on
    if exceeds == 0:
        return
    # convex terms count against the curvature, all against the slope
    curve, slope = zero, zero
    for k in range(order, 1, -1):
        term = exact_row(push, k)
        slope = fused(magnitude(term), exact_splat(1.0 * k), slope) * h
        upward = (magnitude(term) + term) * half if k > 2 else term
        curve = fused(upward, exact_splat(1.0 * k * (k - 1)), curve * h)
    first = exact_row(push, 1)
    monotonic, concave = ~below(magnitude(first), slope), below(curve, zero)
    bulges = concave & below(zero, first) & below(fall, zero) & ~monotonic
    inside = bulges & exceeds
    if inside != 0:
        most = choose(inside, _top(push, order, h, first, fall, inside), most)
    known = exceeds & (monotonic | concave)
    reached = stiffness * most
    set_row(lanes.peak, pair, choose(known & below(peak, reached), reached, peak))
    if exceeds & ~known != 0:
        for lane in range(WIDTH):
            if (exceeds & ~known) >> lane & 1:
                column, k = w.column[0], lanes.stiffness[lane]
                for i in range(full + 1):
                    column[i] = k * push[i, lane] if i <= order else 0.0
                lanes.peak[pair, lane] = maximum(column, full, lanes.step[lane], lanes.peak[pair, lane], w)


@kernel()
def _top(push, order, h, rise, fall, bits):
    """Return the maxima of concave polynomials that rise at 0 and fall at h, by Newton's method for the slope."""
    low, high, x = exact_splat(0.0), h, h * (rise / (rise - fall))
    top = exact_splat(0.0)
    for _ in range(_MOST_CHANGES):
        value = slope = bend = exact_splat(0.0)
        for k in range(order, -1, -1):
            bend = fused(bend, x, slope)
            slope = fused(slope, x, value)
            value = fused(value, x, exact_row(push, k))
        # a chord's slope bounds the rest: once the change is small, its square does not count
        change = slope / (bend * -2.0)
        rises = below(exact_splat(0.0), slope)
        low, high = choose(rises, x, low), choose(rises, high, x)
        top = choose(bits, fused(slope * change, exact_splat(0.5), value), top)
        new = x + change
        within = ~below(new, low) & ~below(high, new)
        new = choose(within, new, (low + high) * 0.5)
        bits &= ~(within & below(magnitude(change), h * _NEAR))
        x = new
        if bits & 255 == 0:
            break
    return top
