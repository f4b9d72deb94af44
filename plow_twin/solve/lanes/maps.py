"""Choice of the variable sigma of each lane's Taylor series if the exponent of the contact law is not an integer.

The time since the start of a step is t = alpha sigma + beta sigma^2 / 2 (`method.series`). For the exponent 1.5, sigma
follows from the square root of the time since a touch or until a separation, as in `method.taylor`.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, choose, equal, exact_row, exact_splat, fused, set_row, square_root
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import WIDTH, linear_at, note_modes, penetration_at
from plow_twin.solve.lanes.series import expand, expand_loads
from plow_twin.solve.method.step_size import PARTING_REACH
from plow_twin.solve.method.taylor import TOUCH_REACH
from plow_twin.solve.modes import SHALLOW
from plow_twin.solve.state import COS, OMEGA, RELEASED, SIN, VX, VY, X, Y
from plow_twin.solve.step import LONGEST_STEP


@kernel(inline="code")
def duration_of(lanes, lane, fraction) -> float:
    """Return the duration of a lane's step in s."""
    if fraction is None:
        return lanes.step[lane]
    return lanes.duration[lane]


@kernel()
def note_durations(lanes) -> None:
    """Write the durations of the steps in s."""
    h = exact_row(lanes.step, 0)
    set_row(lanes.duration, 0, h * fused(exact_row(lanes.beta, 0) * 0.5, h, exact_row(lanes.alpha, 0)))


@kernel(inline="code")
def sigma_of(lanes, lane, used, fraction) -> float:
    """Return the sigma at `used` seconds after the start of a lane's step (`dense_output.sigma_at`)."""
    if fraction is None:
        return used
    alpha, beta = lanes.alpha[lane], lanes.beta[lane]
    if beta == 0.0 or used == 0.0:
        return used
    return 2.0 * used / (alpha + math.sqrt(max(alpha * alpha + 2.0 * beta * used, 0.0)))


@kernel()
def choose_maps(harmonics, extent, waves, second, hysteretic, fraction, slip, segments, lanes, w) -> None:
    """Choose the series variable of each lane, convert `lanes.whole` to it, and release pairs that are too shallow."""
    shallow, near = _look_at_pairs(lanes)
    if shallow != 0:
        _release(lanes)
        shallow, near = _look_at_pairs(lanes)
    live, exponent, half = lanes.live[0], exact_row(lanes.exponent, 0), exact_splat(1.5)
    one, two, zero = exact_splat(1.0), exact_splat(2.0), exact_splat(0.0)
    touches = live & ~equal(lanes.touched, 0, 0)
    rooted = live & ~(touches | below(exponent, half) | below(half, exponent) | equal(lanes.inside, 0, 0))
    set_row(lanes.alpha, 0, choose(touches, zero, one))
    set_row(lanes.beta, 0, choose(touches, two, zero))
    near &= rooted
    if near != 0:
        if waves is not None:
            expand_loads(harmonics, extent, second, fraction, lanes, w, 1)
        expand(lanes, w, 1, waves, second, None, hysteretic, 1, fraction, slip, segments)
        near = _find_partings(lanes, near)
    _use_roots(lanes, touches, near, rooted & ~near)


@kernel()
def _find_partings(lanes, near) -> int:
    """Write the time until the first pair separates to `lanes.root`, and return a bit mask of lanes with such a pair.

    The time is a root of the penetration's series of order 2. The next step corrects its error.
    """
    series, zero, first, found = lanes.series, exact_splat(0.0), exact_splat(np.inf), 0
    om, turning = exact_row(series[OMEGA], 0), exact_row(series[OMEGA], 1)
    c, s, x, y = exact_row(series[COS], 0), exact_row(series[SIN], 0), exact_row(series[X], 0), exact_row(series[Y], 0)
    dc, ds, dx, dy = (
        exact_row(series[COS], 1), exact_row(series[SIN], 1), exact_row(series[X], 1), exact_row(series[Y], 1),
    )  # fmt: skip
    # derivatives of c' = -s theta', s' = c theta', X' = VX + Y theta' and Y' = VY - X theta'
    bent_c, bent_s = fused(turning, s, om * ds) * -1.0, fused(turning, c, om * dc)
    bent_x = fused(turning, y, fused(om, dy, exact_row(series[VX], 1)))
    bent_y = exact_row(series[VY], 1) - fused(turning, x, om * dx)
    for slot in range(PAIR_COUNT):
        taken, gear = lanes.taken[slot] & near, lanes.gear[slot]
        if lanes.taken[slot] == 0:
            break
        depth, rate = exact_row(lanes.depth[slot], 0), linear_at(gear, dc, ds, dx, dy)
        bend = linear_at(gear, bent_c, bent_s, bent_x, bent_y)
        under_root = fused(rate, rate, bend * depth * -2.0)
        time = depth * 2.0 / (square_root(under_root) - rate)
        separates = taken & below(rate, zero) & below(depth, rate * _reach(lanes)) & below(zero, under_root)
        first = choose(separates & below(time, first), time, first)
        found |= separates
    set_row(lanes.root, 0, first)
    return found


@kernel(inline="code")
def _reach(lanes):
    """Return minus the time within which a separation is searched."""
    return exact_row(lanes.before_it, 0) * -PARTING_REACH


@kernel()
def _use_roots(lanes, touches, parts, others) -> None:
    """Choose a root of time where it suits the series, and convert `lanes.whole` to the chosen variable.

    `parts` is a bit mask of the lanes with a separation after the time `lanes.root`, and `others` of the lanes in which
    a touch may be recent.
    """
    span, parting = exact_row(lanes.whole, 0), exact_row(lanes.root, 0)
    since = exact_row(lanes.time, 0) - exact_row(lanes.touch_time, 0)
    two, zero = exact_splat(2.0), exact_splat(0.0)
    recent = others & below(zero, since) & below(since, exact_row(lanes.before_it, 0) * TOUCH_REACH)
    ends_before = parts & ~below(span, parting)
    near = square_root(choose(parts, parting, choose(recent, since, zero)))
    far = square_root(choose(ends_before, zero, choose(parts, parting - span, choose(recent, since + span, span))))
    changed = parts | recent
    set_row(lanes.alpha, 0, choose(changed, near * 2.0, exact_row(lanes.alpha, 0)))
    set_row(lanes.beta, 0, choose(parts, two * -1.0, choose(recent, two, exact_row(lanes.beta, 0))))
    set_row(lanes.whole, 0, choose(parts, near - far, choose(recent, far - near, choose(touches, far, span))))
    may_stop = below(span, exact_splat(LONGEST_STEP)) & ~ends_before
    for lane in range(WIDTH):
        lanes.may_stop[lane] = may_stop >> lane & 1


@kernel()
def _mark_touching(lanes) -> None:
    """Write for each slot a bit mask of the lanes whose pair touches at the start of the step."""
    for slot in range(PAIR_COUNT):
        lanes.touching[slot] = 0
    for lane in range(WIDTH):
        touched = lanes.touched[lane]
        if touched != 0:
            for slot in range(PAIR_COUNT):
                bit = lanes.taken[slot] & 1 << lane
                lanes.touching[slot] |= bit if touched >> lanes.slot[slot, lane] & 1 else 0


@kernel()
def _look_at_pairs(lanes):
    """Return bit masks of lanes with a pair too shallow for a series of d^n, and with a pair near separation."""
    _mark_touching(lanes)
    y, zero = lanes.y, exact_splat(0.0)
    c, s, om = exact_row(y, COS), exact_row(y, SIN), exact_row(y, OMEGA)
    dx, dy = fused(om, exact_row(y, Y), exact_row(y, VX)), exact_row(y, VY) - om * exact_row(y, X)
    least = exact_row(lanes.release, 0) * SHALLOW
    shallow = near = 0
    for slot in range(PAIR_COUNT):
        taken, gear = lanes.taken[slot], lanes.gear[slot]
        if taken == 0:
            break
        depth = penetration_at(gear, c, s, exact_row(y, X), exact_row(y, Y))
        rate = linear_at(gear, om * s * -1.0, om * c, dx, dy)
        set_row(lanes.depth[slot], 0, depth)
        near |= taken & below(rate, zero) & below(depth, rate * _reach(lanes))
        shallow |= taken & ~lanes.touching[slot] & ~below(least, depth)
    return shallow, near


@kernel()
def _release(lanes) -> None:
    """Set the pairs that are too shallow for a series of d^n to RELEASED."""
    any_found = False
    for lane in range(WIDTH):
        if lanes.member[lane] < 0:
            continue
        for slot in range(PAIR_COUNT):
            rests_on_power = lanes.taken[slot] & ~lanes.touching[slot]
            if rests_on_power >> lane & 1 and not lanes.depth[slot, 0, lane] > SHALLOW * lanes.release[lane]:
                lanes.mode[lanes.slot[slot, lane], lane] = RELEASED
                any_found = True
    if any_found:
        note_modes(lanes)
