"""Totals of the motions in the lanes: impulses, peaks and times from the series of one step of each."""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import maximum
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, magnitude, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import COMPONENTS, WIDTH, linear_at, penetration_at, to_bernstein
from plow_twin.solve.state import COS, SIN, X, Y
from plow_twin.solve.totals import add_set_times

#: Allowance for rounding in a force's bound, and between a peak and the maximum.
_ROUNDED, _SAME = 1.0 + 1e-9, 1.0 + 1e-12


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
    last = order - 1
    if totals is None:
        # under samples the series of a lane may end earlier; its guard then has one more term
        last = order
    for slot in range(PAIR_COUNT):
        taken = lanes.taken[slot]
        if taken == 0:
            break
        set_row(lanes.gained, 0, _impulses(lanes, lanes.gear[slot], viscous, hysteretic))
        for lane in range(WIDTH):
            if taken >> lane & 1:
                pair = lanes.slot[slot, lane]
                lanes.impulse[pair, lane] += max(lanes.gained[0, lane], 0.0)
                lanes.time_in_contact[pair, lane] += lanes.step[lane]
                lanes.gained[1, lane] = lanes.peak[pair, lane]
        if hysteretic is not None:
            raised = _raise_peaks(lanes, w, lanes.push[slot], order - 1, full - 1, taken)
        else:
            raised = _raise_peaks(lanes, w, lanes.push[slot], last, last + full - order, taken)
        if raised != 0:
            for lane in range(WIDTH):
                if raised >> lane & 1:
                    lanes.peak[lanes.slot[slot, lane], lane] = lanes.gained[1, lane]
    if totals is None:
        return
    for lane in range(WIDTH):
        if lanes.member[lane] >= 0 and lanes.carrying[lane] != 0:
            add_set_times(totals[lanes.member[lane]], lanes.carrying[lane], lanes.step[lane])


@kernel()
def _impulses(lanes, gear, viscous, hysteretic):
    """Return the impulses of a slot's pairs over the step."""
    y, sums, change = lanes.y, lanes.sum, lanes.change
    depth = penetration_at(gear, exact_row(y, COS), exact_row(y, SIN), exact_row(y, X), exact_row(y, Y))
    swept = linear_at(gear, exact_row(sums, 0), exact_row(sums, 1), exact_row(sums, 2), exact_row(sums, 3))
    impulse = exact_row(lanes.stiffness, 0) * fused(depth, exact_row(lanes.step, 0), swept)
    if viscous is not None or hysteretic is not None:
        way = linear_at(
            gear, exact_row(change, COS), exact_row(change, SIN), exact_row(change, X), exact_row(change, Y)
        )
        if viscous is not None:
            impulse = fused(exact_row(lanes.viscous, 0), way, impulse)
        else:
            # lambda / 2 times the change of d^2
            damped = exact_row(gear, 7) * (way * fused(way, exact_splat(0.5), depth))
            impulse = fused(exact_row(lanes.stiffness, 0), damped, impulse)
    return impulse


@kernel()
def _raise_peaks(lanes, w, push, order, full, on) -> int:
    """Raise the peaks in `lanes.gained` by the series of F / K; return a bit for each lane that was looked at.

    First comes a bound; where it exceeds the peak, the larger end; only where the maximum may lie in between, the
    maximum.
    """
    h, zero, half = exact_row(lanes.step, 0), exact_splat(0.0), exact_splat(0.5)
    end = bend = slope = zero
    for k in range(order, -1, -1):
        term = exact_row(push, k)
        end = fused(end, h, term)
        if k > 1:
            size = magnitude(term)
            slope = fused(size, exact_splat(1.0 * k), slope) * h
            # between its ends a function exceeds them at most by h^2 / 8 times its largest downward curvature
            bend = fused((size - term) * half, exact_splat(0.125 * k * (k - 1)), bend) * h
    start, stiffness, peak = exact_row(push, 0), exact_row(lanes.stiffness, 0), exact_row(lanes.gained, 1)
    most = choose(below(start, end), end, start)
    exceeds = below(peak, stiffness * fused(bend, h, most) * _ROUNDED) & on
    if exceeds == 0:
        return 0
    reached = stiffness * most
    peak = choose(exceeds & below(peak, reached), reached, peak)
    set_row(lanes.gained, 1, peak)
    bulges = exceeds & below(magnitude(exact_row(push, 1)), slope)
    if bulges != 0:
        for k in range(order + 1, full + 1):
            set_row(push, k, zero)
        bulges &= below(peak * _SAME, stiffness * _hull_top(lanes, push, w, full))
        for lane in range(WIDTH):
            if bulges >> lane & 1:
                column, k = w.column[0], lanes.stiffness[lane]
                for i in range(full + 1):
                    column[i] = k * push[i, lane]
                lanes.gained[1, lane] = maximum(column, full, lanes.step[lane], lanes.gained[1, lane], w)
    return exceeds


@kernel()
def _hull_top(lanes, push, w, order):
    """Return the largest Bernstein coefficient over each lane's step."""
    to_bernstein(lanes, push, w, order, exact_row(lanes.step, 0))
    top = exact_row(lanes.bernstein, 0)
    for k in range(1, order + 1):
        here = exact_row(lanes.bernstein, k)
        top = choose(below(top, here), here, top)
    return top
