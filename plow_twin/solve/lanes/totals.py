"""Totals of the motions in the lanes (impulses, peaks and times in contact), from the series of each lane's step."""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import maximum
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, lowest_bit, magnitude, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.events import cross, isolate
from plow_twin.solve.lanes.maps import duration_of
from plow_twin.solve.lanes.record import WIDTH, linear_at, penetration_at, set_state, to_bernstein
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, X, Y
from plow_twin.solve.totals import add_set_times

#: Allowances for rounding: factor on the upper bound of a force, and ratio up to which a maximum equals a peak.
_ROUNDED, _SAME = 1.0 + 1e-9, 1.0 + 1e-12


@kernel()
def sum_step(lanes, w, order, power) -> None:
    """Write the change of the state over each lane's step, and the integrals of the changes of cosine, sine, X and Y.

    Only impulses with the exponent 1 need the integrals.
    """
    series, h = lanes.series, exact_row(lanes.step, 0)
    x = y = vx = vy = om = c = s = angle = sum_x = sum_y = sum_c = sum_s = exact_splat(0.0)
    # the processor adds independent sums in parallel
    for k in range(order, 0, -1):
        next_x, next_y = exact_row(series[X], k), exact_row(series[Y], k)
        next_c, next_s = exact_row(series[COS], k), exact_row(series[SIN], k)
        x, y, c, s = fused(x, h, next_x), fused(y, h, next_y), fused(c, h, next_c), fused(s, h, next_s)
        vx, vy = fused(vx, h, exact_row(series[VX], k)), fused(vy, h, exact_row(series[VY], k))
        om, angle = fused(om, h, exact_row(series[OMEGA], k)), fused(angle, h, exact_row(series[THETA], k))
        if power is None:
            part = w.inverse[k + 1]
            sum_x, sum_y = fused(sum_x, h, next_x * part), fused(sum_y, h, next_y * part)
            sum_c, sum_s = fused(sum_c, h, next_c * part), fused(sum_s, h, next_s * part)
    set_state(lanes.change, x * h, y * h, vx * h, vy * h, om * h, c * h, s * h, angle * h)
    if power is None:
        set_row(lanes.sum, 0, sum_c * h * h)
        set_row(lanes.sum, 1, sum_s * h * h)
        set_row(lanes.sum, 2, sum_x * h * h)
        set_row(lanes.sum, 3, sum_y * h * h)


@kernel()
def add_step(totals, lanes, w, order, full, viscous, hysteretic, power, fraction) -> None:
    """Add the current steps to the sums in the lanes, and the times of sets of corners to `totals`, if any.

    `order` and `full` are those of `first_events`.
    """
    last = order - 1
    if totals is None and hysteretic is None and power is None:
        # under sampled loads, a series that ends early has one more term
        last = order
    for slot in range(PAIR_COUNT):
        taken = lanes.taken[slot]
        if taken == 0:
            break
        if power is None:
            gained = _impulses(lanes, lanes.gear[slot], viscous, hysteretic)
        else:
            gained = _impulses_by_power(lanes, w, slot, last, fraction)
        set_row(lanes.gained, 0, gained)
        for lane in range(WIDTH):
            if taken >> lane & 1:
                pair = lanes.slot[slot, lane]
                lanes.impulse[pair, lane] += max(lanes.gained[0, lane], 0.0)
                lanes.time_in_contact[pair, lane] += duration_of(lanes, lane, fraction)
                lanes.gained[1, lane] = lanes.peak[pair, lane]
        raised = _raise_peaks(totals, lanes, w, slot, last, last + full - order, taken)
        while raised != 0:
            lane = lowest_bit(raised)
            raised &= raised - 1
            pair = lanes.slot[slot, lane]
            lanes.peak[pair, lane] = max(lanes.peak[pair, lane], lanes.gained[1, lane])
    if totals is None:
        return
    for lane in range(WIDTH):
        if lanes.member[lane] >= 0 and lanes.carrying[lane] != 0:
            add_set_times(totals[lanes.member[lane]], lanes.carrying[lane], duration_of(lanes, lane, fraction))


@kernel()
def _impulses(lanes, gear, viscous, hysteretic):
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
            # the dampers add lambda / 2 times the change of d^2 to the impulse per stiffness
            damped = exact_row(gear, 7) * (way * fused(way, exact_splat(0.5), depth))
            impulse = fused(exact_row(lanes.stiffness, 0), damped, impulse)
    return impulse


@kernel()
def _impulses_by_power(lanes, w, slot, order, fraction):
    """Return the impulses of a slot's pairs over the step, from the series of F / K."""
    h, push, first = exact_row(lanes.step, 0), lanes.push[slot], exact_splat(0.0)
    second = first
    for k in range(order, -1, -1):
        term = exact_row(push, k)
        first = fused(first, h, term * w.inverse[k + 1])
        if fraction is not None:
            second = fused(second, h, term * w.inverse[k + 2])
    if fraction is not None:
        first = fused(first, exact_row(lanes.alpha, 0), exact_row(lanes.beta, 0) * h * second)
    return exact_row(lanes.stiffness, 0) * h * first


@kernel()
def _raise_peaks(totals, lanes, w, slot, order, full, on) -> int:
    """Increase the peaks in `lanes.gained` by the series of F / K, and return a bit mask of the checked lanes.

    The peak is increased to the larger end value of the force. A force whose maximum may be within the step is stored
    for `find_peaks`. Under sampled loads its maximum is computed at once, because each row needs its peak.
    """
    h, zero, push = exact_row(lanes.step, 0), exact_splat(0.0), lanes.push[slot]
    end = bend = slope = zero
    for k in range(order, -1, -1):
        term = exact_row(push, k)
        end = fused(end, h, term)
        if k > 1:
            # a function exceeds its end values by at most h^2 / 8 times its largest downward curvature
            bend = fused(bend, h, choose(below(term, zero), term, zero) * (-0.125 * k * (k - 1)))
    start, stiffness, peak = exact_row(push, 0), exact_row(lanes.stiffness, 0), exact_row(lanes.gained, 1)
    most = choose(below(start, end), end, start)
    exceeds = below(peak, stiffness * fused(bend * h, h, most) * _ROUNDED) & on
    if exceeds == 0:
        return 0
    reached = stiffness * most
    peak = choose(exceeds & below(peak, reached), reached, peak)
    set_row(lanes.gained, 1, peak)
    for k in range(order, 1, -1):
        slope = fused(magnitude(exact_row(push, k)), exact_splat(1.0 * k), slope) * h
    bulges = exceeds & below(magnitude(exact_row(push, 1)), slope)
    if totals is None:
        if bulges != 0:
            top = stiffness * _hull_top(lanes, push, w, order, full)
            _raise_at_once(lanes, w, push, full, bulges & below(peak * _SAME, top))
        return exceeds
    while bulges != 0:
        lane = lowest_bit(bulges)
        bulges &= bulges - 1
        _keep_bulge(lanes, push, lanes.slot[slot, lane], lane, order)
        if lanes.bulges[0] == WIDTH:
            find_peaks(lanes, w, order)
    return exceeds


@kernel()
def _hull_top(lanes, push, w, order, full):
    """Return the largest Bernstein coefficient of `push`, an upper bound over each lane's step."""
    zero = exact_splat(0.0)
    for k in range(order + 1, full + 1):
        set_row(push, k, zero)
    to_bernstein(lanes, push, w, full, exact_row(lanes.step, 0))
    top = exact_row(lanes.bernstein, 0)
    for k in range(1, full + 1):
        here = exact_row(lanes.bernstein, k)
        top = choose(below(top, here), here, top)
    return top


@kernel()
def _raise_at_once(lanes, w, push, full, bulges) -> None:
    while bulges != 0:
        lane = lowest_bit(bulges)
        bulges &= bulges - 1
        column, stiffness = w.column[0], lanes.stiffness[lane]
        for k in range(full + 1):
            column[k] = stiffness * push[k, lane]
        lanes.gained[1, lane] = maximum(column, full, lanes.step[lane], lanes.gained[1, lane], w)


@kernel()
def _keep_bulge(lanes, push, pair, lane, order) -> None:
    i, stiffness = lanes.bulges[0], lanes.stiffness[lane]
    for k in range(order + 1):
        lanes.bulge[k, i] = stiffness * push[k, lane]
    lanes.bulge_step[i], lanes.bulge_pair[i], lanes.bulge_lane[i] = lanes.step[lane], pair, lane
    lanes.bulges[0] = i + 1


@kernel()
def find_peaks(lanes, w, order) -> None:
    """Increase the peaks by the maxima of the forces in `lanes.bulge`, which may be from any lanes and steps.

    Each maximum is a root of F', independent of the current peak, so the bits of a peak do not depend on other lanes.
    """
    if lanes.bulges[0] == 0:
        return
    column, zero, bits = lanes.guard, exact_splat(0.0), (1 << lanes.bulges[0]) - 1
    lanes.bulges[0] = 0
    for k in range(order):
        set_row(column, k, exact_row(lanes.bulge, k + 1) * (k + 1.0))
    set_row(lanes.reach, 0, exact_row(lanes.bulge_step, 0))
    single, several = isolate(lanes, column, w, order - 1, bits)
    falls = below(exact_row(column, 0), zero)
    several |= single & falls
    single &= ~falls
    if single != 0:
        cross(lanes, column, order - 1, single)
    top, at = zero, exact_row(lanes.root, 0)
    for k in range(order, -1, -1):
        top = fused(top, at, exact_row(lanes.bulge, k))
    set_row(lanes.root, 0, top)
    remaining = single | several
    while remaining != 0:
        i = lowest_bit(remaining)
        remaining &= remaining - 1
        if several >> i & 1:
            force = w.column[0]
            for k in range(order + 1):
                force[k] = lanes.bulge[k, i]
            lanes.root[i] = maximum(force, order, lanes.bulge_step[i], 0.0, w)
        pair, lane = lanes.bulge_pair[i], lanes.bulge_lane[i]
        lanes.peak[pair, lane] = max(lanes.peak[pair, lane], lanes.root[i])
