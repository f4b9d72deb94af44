"""Tumbling of a block: its corners are renamed when it turns beyond 45 degrees, and after each further quarter turn.

Beyond 45 degrees, another corner becomes the lower left corner and receives its name. The state of each pair (mode,
damping, anchor) is copied to the pair with the same wall and the corner's new name. The coefficients of a square
block's geometry do not change, but the angle whose cosine and sine are in the state changes by 90 degrees
(`kinematics.named_angle`).
"""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import first_root
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.solve.kinematics import QUARTER_TURN, may_tumble, named_angle
from plow_twin.solve.modes import penetration_and_rate
from plow_twin.solve.state import COS, OFF, OMEGA, ON, RELEASED, SIN, THETA
from plow_twin.solve.totals import log_event

#: The two pairs of each wall, first that of the leading corner in a counter-clockwise turn.
_HANDED_OVER = tuple(
    (PAIR_NAMES.index(leading), PAIR_NAMES.index(following))
    for leading, following in (
        ("top_left_top", "top_right_top"),
        ("bottom_left_left", "top_left_left"),
        ("bottom_right_bottom", "bottom_left_bottom"),
        ("top_right_right", "bottom_right_right"),
    )
)
#: Largest angle [rad] short of 45 degrees at which the corners are renamed, the rounding error of a root.
_THERE = 1e-12


@kernel()
def turn_at(p, state, w, order, best) -> float:
    """Return the sigma at which the block reaches 45 degrees, at most `best`."""
    if not may_tumble(p):
        return best
    column, angle = w.column[0], named_angle(p, state.y, state.y[THETA])
    for side in range(2):
        sign = 1.0 if side == 0 else -1.0
        for k in range(1, order + 1):
            column[k] = -sign * w.series[k, THETA]
        column[0] = max(0.5 * QUARTER_TURN - sign * angle, 0.0)
        best = min(best, first_root(column, order, best, w))
    return best


@kernel()
def turn_corners(p, state, stick, totals, log) -> None:
    """Rename the corners of a block that has reached 45 degrees."""
    if not may_tumble(p):
        return
    y = state.y
    angle = math.atan2(y[SIN], y[COS])
    if abs(angle) < 0.5 * QUARTER_TURN - _THERE or angle * y[OMEGA] <= 0.0:
        return
    ahead = angle > 0.0
    for leading, following in _HANDED_OVER:
        new, old = (leading, following) if ahead else (following, leading)
        _hand_over(p, state, stick, totals, log, old, new)
    angle += -QUARTER_TURN if ahead else QUARTER_TURN
    y[COS], y[SIN] = math.cos(angle), math.sin(angle)
    state.events += 1


@kernel()
def _hand_over(p, state, stick, totals, log, old, new) -> None:
    """Copy the state of the pair `old` to the pair `new` at the same wall, if it can touch."""
    mode = state.mode[old] if p.enabled[new] == 1 else OFF
    if log is not None:
        rate = penetration_and_rate(p, state, old)[1]
        _log(log, totals, state.step_start, new, state.mode[new], mode, rate)
        _log(log, totals, state.step_start, old, state.mode[old], OFF, rate)
    state.mode[new], state.mode[old] = mode, OFF
    state.damping_factor[new] = state.damping_factor[old]
    state.beyond_ramp[new], state.beyond_ramp[old] = state.beyond_ramp[old], 0
    touching = state.touching >> old & 1
    state.touching &= ~(1 << old | 1 << new)
    state.touching |= touching << new
    if stick is not None:
        state.anchor[new], state.grip[new] = state.anchor[old], state.grip[old]


@kernel()
def _log(log, totals, time, pair, old, new, rate) -> None:
    # the log has ON in place of RELEASED
    old, new = ON if old == RELEASED else old, ON if new == RELEASED else new
    if old != new:
        log_event(log, totals, time, pair, old, new, rate)
