"""Choice of the variable sigma of each lane's Taylor series if the exponent of the contact law is not an integer.

The time since the start of a step is t = alpha sigma + beta sigma^2 / 2 (`method.series`). For the exponent 1.5, sigma
follows from the square root of the time since a touch or until a separation, as in `method.taylor`.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, exact_row, exact_splat, fused, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.lanes.record import WIDTH, linear_at, note_modes, penetration_at
from plow_twin.solve.lanes.series import expand, expand_loads
from plow_twin.solve.method.step_size import PARTING_ORDER, PARTING_REACH, parting_of
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
    for lane in range(WIDTH):
        touches = lanes.touched[lane] != 0
        near &= ~(1 << lane) if touches or lanes.exponent[lane] != 1.5 else -1
        lanes.alpha[lane], lanes.beta[lane] = 0.0 if touches else 1.0, 2.0 if touches else 0.0
        lanes.may_stop[lane] = 1 if lanes.whole[lane] < LONGEST_STEP else 0
    order = 0
    if near != 0:
        if waves is not None:
            expand_loads(harmonics, extent, second, fraction, lanes, w, PARTING_ORDER)
        order = expand(lanes, w, PARTING_ORDER, waves, second, None, hysteretic, 1, fraction, slip, segments)
    for lane in range(WIDTH):
        if lanes.member[lane] >= 0:
            _choose_map(lanes, w, lane, order, near >> lane & 1 == 1)


@kernel()
def _choose_map(lanes, w, lane, order, near) -> None:
    span = lanes.whole[lane]
    if lanes.touched[lane] != 0:
        lanes.whole[lane] = math.sqrt(span)
        return
    if lanes.inside[lane] == 0 or lanes.exponent[lane] != 1.5:
        return
    parting = _parting(lanes, w, lane, order) if near else 0.0
    since = lanes.time[lane] - lanes.touch_time[lane]
    if parting > 0.0:
        root = math.sqrt(parting)
        lanes.alpha[lane], lanes.beta[lane] = 2.0 * root, -2.0
        if parting <= span:
            lanes.whole[lane], lanes.may_stop[lane] = root, 0
        else:
            lanes.whole[lane] = root - math.sqrt(parting - span)
    elif 0.0 < since < TOUCH_REACH * lanes.before_it[lane]:
        root = math.sqrt(since)
        lanes.alpha[lane], lanes.beta[lane] = 2.0 * root, 2.0
        lanes.whole[lane] = math.sqrt(since + span) - root


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
    reach = exact_row(lanes.before_it, 0) * -PARTING_REACH
    least = exact_row(lanes.release, 0) * SHALLOW
    shallow = near = 0
    for slot in range(PAIR_COUNT):
        taken, gear = lanes.taken[slot], lanes.gear[slot]
        if taken == 0:
            break
        depth = penetration_at(gear, c, s, exact_row(y, X), exact_row(y, Y))
        rate = linear_at(gear, om * s * -1.0, om * c, dx, dy)
        set_row(lanes.depth[slot], 0, depth)
        near |= taken & below(rate, zero) & below(depth, rate * reach)
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


@kernel()
def _parting(lanes, w, lane, order) -> float:
    """Return the time until the first pair of a lane separates, or 0 without a near separation."""
    first, column = np.inf, w.column[0]
    for slot in range(PAIR_COUNT):
        if lanes.taken[slot] >> lane & 1 == 0:
            continue
        for k in range(order + 1):
            column[k] = lanes.depth[slot, k, lane]
        first = min(first, parting_of(column, order, PARTING_REACH * lanes.before_it[lane]))
    return first if 0.0 < first < np.inf else 0.0
