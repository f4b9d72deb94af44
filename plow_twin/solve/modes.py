"""Contact modes, damping factors and range of validity of the eight pairs of corner and wall."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.by_field import by_field
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, row, splat
from plow_twin.model.geometry import STATE_SIZE
from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.grip import grasp, keep_grip, stretches, weigh_grips
from plow_twin.solve.kinematics import named_angle, penetration_of, rate_of, row_value, row_values
from plow_twin.solve.state import (
    ACTS,
    BASE,
    CLIPPED,
    COS,
    DAMPS,
    OFF,
    ON,
    RAMPS,
    RELEASED,
    RESTITUTIONS,
    SIN,
    THETA,
    VX,
    VY,
    X,
    Y,
)

#: Largest penetration that is treated as zero, divided by the release penetration. It also applies to speeds, relative
#: to the speed that reaches the release penetration.
SHALLOW = 1e-3
#: Number of iterations for damping and impact speed of a pair that starts in contact.
_ROUNDS = 8
#: Number of bisections for the impact speed, down to the last bit.
_BISECTIONS = 60
#: Largest |theta| in rad at which each corner faces its walls: 45 degrees, and a margin for rounding.
LARGEST_ANGLE = 0.25 * math.pi + 1e-12
_ALL_PAIRS = 2**PAIR_COUNT - 1


@kernel()
def penetration_and_rate(p, state, pair):
    """Return the penetration of one pair and its rate, at the start of the step."""
    return penetration_of(p, state, pair, state.y), rate_of(p, pair, state.y)


@kernel()
def _fallen_number(p, y, pair, speed):
    """Return D for a restitution that decreases with the impact speed (`model.scene.Contact`), at `speed` [m/s]."""
    arm = row_value(p.arm_rows, pair, y[COS], y[SIN], y[X], y[Y])
    mobility = 1.0 + p.free[2] * arm * arm * p.inverse_inertia / p.inverse_mass
    impact = speed * mobility**-p.fall_mass
    # rows 2 and 3 of the penetration are minus the wall's normal
    along = p.penetration_rows[2, pair] * y[VY] - p.penetration_rows[3, pair] * y[VX]
    e = p.restitution * max(impact / p.fall_speed, 1.0) ** -p.fall - p.fall_along * abs(along)
    at = max(e, 1.0 / RESTITUTIONS) * RESTITUTIONS
    index = min(int(at), RESTITUTIONS - 1)
    low, high = p.damping_numbers[index], p.damping_numbers[index + 1]
    return (low + (at - index) * (high - low)) * RESTITUTIONS / at


#: Return the damping number D of an impact at a speed.
_damping_number = by_field(
    "fall", lambda p, y, pair, speed: _fallen_number(p, y, pair, speed), lambda p, y, pair, speed: p.damping_number
)
_falls = by_field("fall", lambda p: 1, lambda p: None)


@kernel()
def touch(p, state, pair) -> None:
    """Start a contact, with the damping factor lambda = D / v0 of its impact speed v0."""
    if p.damping_number >= 0.0:
        _, speed = penetration_and_rate(p, state, pair)
        number = _damping_number(p, state.y, pair, speed)
        state.damping_factor[pair] = number / max(speed, p.speed_floor)


@kernel()
def _impact_speed(number, rate, energy) -> float:
    """Return the impact speed v0 in m/s that leads to the current penetration and rate of a pair.

    `number` is D, `rate` the penetration rate d' in m/s, and `energy` the elastic energy per mass E / m in m^2/s^2. v0
    solves the first integral of the free impact: u - ln(1 + u) + D^2 E / (m v0^2) = D - ln(1 + D) with u = D d' / v0.
    """
    if number <= 0.0 or (energy <= 0.0 and rate == 0.0):
        return 0.0
    full = number - math.log1p(number)
    # the impact at the speed `low` has this energy at its turning point, where the rate is zero
    low = math.sqrt(number * number * energy / full)
    high = max(low, abs(rate)) * (1.0 + number)
    low = max(low, rate, -number * rate)
    for _ in range(_BISECTIONS):
        speed = 0.5 * (low + high)
        u = number * rate / speed
        unspent = np.inf if u <= -1.0 else u - math.log1p(u)
        if unspent + number * number * energy / (speed * speed) > full:
            low = speed
        else:
            high = speed
    return high


@kernel()
def _start_inside(p, state, pair, energy) -> None:
    """Set the damping factor of a pair that starts in contact, as if an impact had led to its current state.

    `energy` is the elastic energy of all pairs, which may come from this impact.
    """
    if p.damping_number >= 0.0:
        y = state.y
        arm = row_value(p.arm_rows, pair, y[COS], y[SIN], y[X], y[Y])
        # mobility of a frame on springs, with the arm about its centre
        arm_of_frame = row_value(p.arm_rows, pair, y[COS], y[SIN], 0.0, 0.0)
        mobility = p.inverse_mass + p.free[2] * arm * arm * p.inverse_inertia
        mobility += p.frame_mobility[0] + arm_of_frame * arm_of_frame * p.frame_mobility[2]
        _, rate = penetration_and_rate(p, state, pair)
        number = p.damping_number
        speed = _impact_speed(number, rate, energy * mobility)
        if _falls(p) is not None:
            # speed and damping depend on each other
            for _ in range(_ROUNDS):
                number = _damping_number(p, y, pair, speed)
                speed = _impact_speed(number, rate, energy * mobility)
        state.damping_factor[pair] = number / max(speed, p.speed_floor)


@kernel()
def mode_inside(p, state, pair):
    """Return the mode of a penetrating pair, and record whether its penetration exceeds the damping ramp."""
    penetration, rate = penetration_and_rate(p, state, pair)
    state.beyond_ramp[pair] = 1 if penetration > p.ramp else 0
    if law_force(p, state, pair, penetration, rate) < 0.0:
        return CLIPPED
    return ON if penetration >= p.release else RELEASED


@kernel(entry=True)
def settle_modes(p, state, stick) -> None:
    """Set each pair's mode from its penetration at the start of a motion."""
    energy = 0.0
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            penetration = max(penetration_and_rate(p, state, pair)[0], 0.0)
            energy += p.stiffness * penetration ** (p.exponent + 1.0) / (p.exponent + 1.0)
    for pair in range(PAIR_COUNT):
        state.mode[pair] = OFF
        state.beyond_ramp[pair] = 0
        if p.enabled[pair] == 1 and penetration_and_rate(p, state, pair)[0] > 0.0:
            _start_inside(p, state, pair, energy)
            state.mode[pair] = mode_inside(p, state, pair)
            if stick is not None:
                grasp(p, state, pair, ON)
    state.elapsed = 0.0
    state.step_size = -1.0
    state.last_step_size = 0.0
    state.touch_time = -np.inf
    state.touching = 0
    state.events_at_once = 0


@kernel(entry=True)
def settle_moved(params, states, which, places, time, stick) -> None:
    """Set the states `which` to the body coordinates `places` at `time`, and set their modes.

    A continuing contact keeps the damping factor of its touch, and the force of the spring that holds its corner.
    """
    touched = np.zeros(PAIR_COUNT, np.int64)
    damping = np.zeros(PAIR_COUNT)
    pushed, grip, stretch = np.zeros(PAIR_COUNT, np.int64), np.zeros(PAIR_COUNT, np.int64), np.zeros(PAIR_COUNT)
    for i in range(which.size):
        p, state = params[which[i]], states[which[i]]
        for pair in range(PAIR_COUNT):
            touched[pair] = 0 if state.mode[pair] == OFF else 1
            damping[pair] = state.damping_factor[pair]
        if stick is not None:
            stretches(p, state, stretch)
            for pair in range(PAIR_COUNT):
                pushed[pair] = 1 if state.mode[pair] == ON else 0
                grip[pair] = state.grip[pair]
        for k in range(STATE_SIZE):
            state.y[k] = places[i, k]
        state.step_start = time
        state.time = time
        settle_modes(p, state, stick)
        for pair in range(PAIR_COUNT):
            if touched[pair] == 1:
                state.damping_factor[pair] = damping[pair]
        if stick is not None:
            for pair in range(PAIR_COUNT):
                if pushed[pair] == 1 and state.mode[pair] == ON:
                    keep_grip(p, state, pair, stretch[pair], grip[pair])


@kernel(entry=True)
def settle_many(params, states, members) -> None:
    """Call `settle_modes` for each of `members`. The scenes must not have friction with stick."""
    for member in members:
        settle_modes(params[member], states[member], None)


@kernel(inline="source")
def any_penetrates(state) -> bool:
    """Return whether any pair penetrates, with or without force."""
    inside = 0
    for pair in range(PAIR_COUNT):
        inside += 0 if state.mode[pair] == OFF else 1
    return inside > 0


@kernel()
def weigh_pairs(p, state, w, viscous, fraction, ramp, stick) -> bool:
    """Write the factors of each pair's force to `w.per_pair`, and return whether any pair penetrates."""
    mode, per_pair = state.mode, w.per_pair
    for pair in range(PAIR_COUNT):
        per_pair[BASE, pair] = 0.0
        per_pair[RAMPS, pair] = 1.0 - state.beyond_ramp[pair]
        raised = mode[pair] == ON or (ramp is not None and mode[pair] == CLIPPED)
        if fraction is not None and raised and state.touching >> pair & 1 == 0:
            penetration = penetration_and_rate(p, state, pair)[0]
            if penetration > SHALLOW * p.release:
                per_pair[BASE, pair] = 0.5 / math.sqrt(penetration) if p.exponent == 1.5 else 1.0 / penetration
            else:
                # after a short step, the penetration d is still too small for a series of d^n
                mode[pair] = RELEASED
        acts = mode[pair] == ON
        per_pair[ACTS, pair] = p.stiffness if acts else 0.0
        per_pair[DAMPS, pair] = 0.0
        if acts:
            per_pair[DAMPS, pair] = p.viscous if viscous is not None else p.stiffness * state.damping_factor[pair]
    if stick is not None:
        weigh_grips(p, state, w)
    return any_penetrates(state)


@kernel(inline="source")
def slow_touch(p) -> float:
    """Return the speed in m/s below which a touch does not lead to the release penetration by its speed alone."""
    acceleration = p.threshold[0] * p.weight / p.radius
    return SHALLOW * math.sqrt(2.0 * acceleration * p.release)


@kernel(fast=True)
def _all_shallow(p, state, y) -> bool:
    """Return whether every penetration is less than half the cavity, including pairs that cannot touch."""
    penetration = row_values(p.penetration_rows, y[COS], y[SIN], y[X], y[Y])
    penetration = penetration + (row(p.penetration_rows, 4) - row(state.wear_depth, 0))
    return bool(below(penetration, splat(p.half_cavity)) == _ALL_PAIRS)


@kernel()
def read_range(p, state, y, out) -> None:
    """Write the values that `within_range` checks: angle [rad], largest penetration [m], and index of its pair."""
    out[0], out[1], out[2] = named_angle(p, y, y[THETA]), -np.inf, 0.0
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            penetration = penetration_of(p, state, pair, y)
            if penetration > out[1]:
                out[1], out[2] = penetration, pair


@kernel(entry=True)
def range_of(p, state, out) -> None:
    """Write the values that `within_range` checks at the state, as `read_range` does."""
    read_range(p, state, state.y, out)


def beyond_range(beyond: NDArray[np.float64], half_cavity: float) -> str:
    """Return a text about the angle or penetration from `read_range`, shape (3,), and the limit of the model."""
    angle, penetration, pair = beyond.tolist()
    if abs(angle) <= LARGEST_ANGLE:
        return (
            f"{PAIR_NAMES[int(pair)]} penetrated {1e3 * penetration:.1f} mm deep; "
            f"the model is valid up to half the cavity, {1e3 * half_cavity:.1f} mm"
        )
    return f"the head turned to {math.degrees(angle):.1f} degrees; the model is valid up to 45"


@kernel()
def within_range(p, state, y) -> bool:
    """Return whether |theta| is at most 45 degrees and all penetrations are at most half the cavity at y."""
    if _all_shallow(p, state, y):
        return abs(named_angle(p, y, y[THETA])) <= LARGEST_ANGLE
    deepest = 0.0
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            deepest = max(deepest, penetration_of(p, state, pair, y))
    return abs(named_angle(p, y, y[THETA])) <= LARGEST_ANGLE and deepest <= p.half_cavity
