"""Fixed-step methods without event detection: RK4, as in the paper, and semi-implicit Euler.

They check the Taylor series, with which they share only the geometry and the contact law. The equations of motion
(paper, eq. 5) are integrated in world axes about the centre of mass.
"""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.arrays import all_finite, copy_into
from plow_twin.kernel.compiler import kernel
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.dense_output import pair_outputs
from plow_twin.solve.dynamics import accelerate, acting
from plow_twin.solve.energy_balance import balance_fixed_step, start_balance
from plow_twin.solve.grip import settle_grips
from plow_twin.solve.kinematics import pose_of, to_body, to_world
from plow_twin.solve.modes import mode_inside, touch, within_range
from plow_twin.solve.rubbing import rubbing
from plow_twin.solve.state import OFF, ON, Status
from plow_twin.solve.support import to_body_both, to_world_both
from plow_twin.solve.totals import add_set_times, log_event
from plow_twin.solve.tumbling import turn_corners

_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_LOG_FULL = int(Status.LOG_FULL)


@kernel()
def _switch(p, state, penetration, rate, time, totals, log) -> None:
    """Update the modes of pairs that have touched or separated during a step, and log these changes."""
    for pair in range(PAIR_COUNT):
        inside = p.enabled[pair] == 1 and penetration[pair] > 0.0
        mode = ON if inside else OFF
        if mode == state.mode[pair]:
            continue
        if mode == ON:
            touch(p, state, pair)
            if totals is not None:
                totals.makes[pair] += 1
        if log is not None:
            log_event(log, totals, time, pair, state.mode[pair], mode, rate[pair])
        state.mode[pair] = mode
        state.events += 1


@kernel()
def _add_to_totals(force_before, force, dt, totals) -> None:
    """Add one step to the totals by the trapezoidal rule."""
    carrying = 0
    for pair in range(PAIR_COUNT):
        totals.peak[pair] = max(totals.peak[pair], force[pair])
        totals.impulse[pair] += 0.5 * dt * (force_before[pair] + force[pair])
        if force[pair] > 0.0:
            totals.time_in_contact[pair] += dt
            carrying |= 1 << pair
    add_set_times(totals, carrying, dt)


@kernel()
def _runge_kutta(p, acts, state, t, dt, z, trial, k, load) -> None:
    """Take one step of the classical Runge-Kutta method from the state z, shape (n,), with stages k, shape (4, n)."""
    accelerate(p, acts, False, state, t, z, load, k[0])
    for stage in range(1, 4):
        part = dt if stage == 3 else 0.5 * dt
        for j in range(z.size):
            trial[j] = z[j] + part * k[stage - 1, j]
        accelerate(p, acts, False, state, t + part, trial, load, k[stage])
    for j in range(z.size):
        z[j] += dt / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
    state.evaluations += 4


@kernel()
def end_coarsely(p, parts, state, totals, target, bound) -> int:
    """Advance the state to `target` by the Runge-Kutta steps of `bound`, and estimate the error. Return a `Status`.

    The error of a step is |k2 - k3| dt / 3 by the two middle stages. Errors of the velocity are multiplied by the
    remaining time. If a pair touches or separates within a step, the error F dt / 2 of its impulse is multiplied by the
    time in which the largest load moves the head across the clearance.
    """
    terms = parts.terms
    acts, y, size = acting(parts), state.y, 6 if terms.support is None else 12
    z, trial, k = bound.z[0, :size], bound.z[1, :size], bound.z[2:, :size]
    pen, rate, now, before = bound.pairs[0], bound.pairs[1], bound.pairs[2], bound.pairs[3]
    start = state.step_start
    dt = (target - start) / bound.steps
    _to_world(p, parts.terms.support, state, z)
    for pair in range(PAIR_COUNT):
        # CLIPPED and RELEASED pairs penetrate their walls
        state.mode[pair] = OFF if state.mode[pair] == OFF else ON
    pair_outputs(p, state, state.wear_depth, y, pen, rate, now)
    state.bounded += 1
    for n in range(bound.steps):
        _runge_kutta(p, acts, state, start + n * dt, dt, z, trial, k, bound.load)
        remaining = target - start - (n + 1) * dt
        for j in range(3):
            radius = p.radius if j == 2 else 1.0
            moving = size // 2 + j
            off, drift = abs(k[1, j] - k[2, j]), abs(k[1, moving] - k[2, moving])
            bound.error += radius * dt / 3.0 * (off + (remaining + dt) * drift)
        if not all_finite(z):
            return _NON_FINITE
        state.steps += 1
        _to_body(p, parts.terms.support, state, z)
        turn_corners(p, state, terms.stick, totals, None)
        _wear(p, terms.wear, terms.sliding, terms.running_in, state, now, dt)
        copy_into(before, now)
        pair_outputs(p, state, state.wear_depth, y, pen, rate, now)
        _switch(p, state, pen, rate, start + (n + 1) * dt, totals, None)
        pair_outputs(p, state, state.wear_depth, y, pen, rate, now)
        _settle_grips(p, parts.terms.stick, state, now)
        for pair in range(PAIR_COUNT):
            if (before[pair] > 0.0) != (now[pair] > 0.0):
                doubt = 0.5 * dt * (before[pair] + now[pair]) * p.inverse_mass
                bound.error += doubt * p.position_tolerance / p.velocity_tolerance
        if totals is not None:
            _add_to_totals(before, now, dt, totals)
        if not within_range(p, state, y):
            return _RANGE
    state.step_start = state.time = target
    state.last_step_size, state.touch_time = 0.0, -np.inf
    state.touching = state.events_at_once = 0
    for pair in range(PAIR_COUNT):
        if state.mode[pair] == ON:
            state.mode[pair] = mode_inside(p, state, pair)
    return _OK


@kernel(entry=True)
def integrate_fixed(
    p, parts, state, totals, log, z, done, steps, dt, euler, stride, q, v, penetration, force, frame, balance
) -> int:
    """Take the steps `done[0]` to `steps` of size `dt`, and write a row every `stride` steps. Return a `Status`.

    z, shape (6,) or (12,), contains the integrated variables between calls (`support.to_world_both`), because a
    conversion to body coordinates and back would change their last bits.
    """
    trial, k = np.empty(z.size), np.empty((4, z.size))
    load, y, acts = np.empty(3), state.y, acting(parts)
    pen, rate, now, before = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    terms = parts.terms
    support, half = terms.support, z.size // 2
    if done[0] == 0:
        _to_world(p, support, state, z)
    pair_outputs(p, state, state.wear_depth, y, pen, rate, now)
    if balance is not None and done[0] == 0:
        start_balance(p, parts, state, y, 0.0, balance)
    while True:
        n = done[0]
        if not within_range(p, state, y):
            return _RANGE
        if n % stride == 0 or n == steps:
            # rounded up, because the last row may follow after fewer steps
            row = (n + stride - 1) // stride
            pose_of(p, y, parts.terms.offset, q[row], v[row])
            if frame is not None:
                copy_into(frame[row], state.frame)
            if force is not None:
                pair_outputs(p, state, state.wear_depth, y, penetration[row], rate, force[row])
        if n >= steps:
            return _OK
        if totals.logged + PAIR_COUNT > log.size:
            return _LOG_FULL
        t = n * dt
        if euler:
            accelerate(p, acts, False, state, t, z, load, k[0])
            for j in range(half):
                z[half + j] += dt * k[0, half + j]
                z[j] += dt * z[half + j]
            state.evaluations += 1
        else:
            _runge_kutta(p, acts, state, t, dt, z, trial, k, load)
        if not all_finite(z):
            return _NON_FINITE
        state.steps += 1
        _to_body(p, support, state, z)
        turn_corners(p, state, terms.stick, totals, log)
        _wear(p, terms.wear, terms.sliding, terms.running_in, state, now, dt)
        copy_into(before, now)
        pair_outputs(p, state, state.wear_depth, y, pen, rate, now)
        _switch(p, state, pen, rate, t + dt, totals, log)
        pair_outputs(p, state, state.wear_depth, y, pen, rate, now)
        _settle_grips(p, parts.terms.stick, state, now)
        _add_to_totals(before, now, dt, totals)
        if balance is not None:
            balance_fixed_step(p, parts, state, y, t + dt, dt, balance)
        done[0] = n + 1


@kernel()
def _to_world(p, support, state, z) -> None:
    if support is not None:
        to_world_both(p, state.y, state.frame, z)
    else:
        to_world(p, state.y, z)


@kernel()
def _to_body(p, support, state, z) -> None:
    if support is not None:
        to_body_both(p, z, state.y, state.frame)
    else:
        to_body(p, state.y, z, state.y)


@kernel()
def _settle_grips(p, stick, state, force) -> None:
    if stick is not None:
        settle_grips(p, state, force)


@kernel()
def _wear(p, wear, sliding, running_in, state, force, dt) -> None:
    if wear is not None:
        for pair in range(PAIR_COUNT):
            faster = rubbing(p, pair, state.y, state.wear_depth[pair], sliding, running_in)
            state.wear_depth[pair] += p.wear_per_impulse[pair] * faster * force[pair] * dt
