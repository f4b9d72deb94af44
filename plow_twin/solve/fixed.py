"""Fixed-step methods without event location: RK4 as in the paper, and semi-implicit Euler.

They evaluate the equations of motion (paper, eq. 5) as they stand, in world axes about the centre of mass,
independently of the series: a check on them as much as a method.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.model.contact import normal_force
from plow_twin.model.friction import friction_force
from plow_twin.model.kernel import kernel
from plow_twin.solve.audit import audit_fixed, audit_start
from plow_twin.solve.layout import (
    BOUNDED,
    COEFFICIENTS,
    COS,
    EVENTS,
    LAST_LENGTH,
    NOW,
    OFF,
    OMEGA,
    ON,
    SIN,
    STALL,
    STEPS,
    T0,
    THETA,
    TOUCHED,
    TOUCHING,
    VX,
    VY,
    Status,
)
from plow_twin.solve.loads import combined, load_at
from plow_twin.solve.step import mode_inside, pair_outputs, pose_of, touch, within_range

_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_LOG_FULL = int(Status.LOG_FULL)


@kernel()
def _accelerations(p, parts, offset, free, slip, state, t, z, load, out) -> None:
    """Write the rate of z = (x, y, theta, vx, vy, omega) of the centre of mass, world axes."""
    load_at(p, parts.harmonics, parts.second, parts.segments, t, load)
    A, B = p.gap, p.arm
    c, s, om = math.cos(z[2]), math.sin(z[2]), z[5]
    x, y, vx, vy = c * z[0] + s * z[1], c * z[1] - s * z[0], c * z[3] + s * z[4], c * z[4] - s * z[3]
    fx = fy = torque = 0.0
    for pair in range(8):
        if p.enabled[pair] == 0:
            continue
        d = A[0, pair] * c + A[1, pair] * s + A[2, pair] * x + A[3, pair] * y + A[4, pair] - state.depth[pair]
        if d > 0.0:
            r = om * (A[1, pair] * c - A[0, pair] * s) + A[2, pair] * (vx + om * y) + A[3, pair] * (vy - om * x)
            f = normal_force(d, r, p.stiffness, p.exponent, state.factor[pair], p.viscous, p.ramp)
            fx -= A[2, pair] * f
            fy -= A[3, pair] * f
            torque += (B[0, pair] * c + B[1, pair] * s + B[2, pair] * x + B[3, pair] * y) * f
            if slip is not None:
                along = combined(slip.rows, pair, -om * s, om * c, vx + om * y, vy - om * x)
                drag = friction_force(f, along, slip.coefficient, slip.speed)
                # t is the normal turned by +90 degrees
                fx += A[3, pair] * drag
                fy -= A[2, pair] * drag
                torque += combined(slip.arm, pair, c, s, x, y) * drag
    moment = load[2] + torque * p.inverse_inertia
    if offset is not None:
        force_x, force_y = load[0], load[1] + p.gravity
        across = (c * offset[0] - s * offset[1]) * force_y - (s * offset[0] + c * offset[1]) * force_x
        moment -= across * p.inverse_inertia / p.inverse_mass
    out[0], out[1], out[2] = z[3], z[4], z[5]
    out[3] = load[0] + (c * fx - s * fy) * p.inverse_mass
    out[4] = load[1] + (s * fx + c * fy) * p.inverse_mass
    out[5] = moment
    if free is not None:
        for j in range(3):
            out[3 + j] *= free[j]


@kernel()
def _to_body(z, y) -> None:
    """Write body coordinates from z."""
    c, s = math.cos(z[2]), math.sin(z[2])
    y[0], y[1] = c * z[0] + s * z[1], c * z[1] - s * z[0]
    y[VX], y[VY], y[OMEGA] = c * z[3] + s * z[4], c * z[4] - s * z[3], z[5]
    y[COS], y[SIN], y[THETA] = c, s, z[2]


@kernel()
def _switch(p, state, penetration, rate, time, totals, log) -> None:
    """Note which pairs touch or part, at the step's resolution."""
    for pair in range(8):
        inside = p.enabled[pair] == 1 and penetration[pair] > 0.0
        mode = ON if inside else OFF
        if mode == state.mode[pair]:
            continue
        if mode == ON:
            touch(p, state, pair)
            totals.makes[pair] += 1
        if log is not None:
            i = log.length[0]
            log.time[i], log.pair[i], log.rate[i] = time, pair, rate[pair]
            log.mode_from[i], log.mode_to[i] = state.mode[pair], mode
            log.length[0] = i + 1
        state.mode[pair] = mode
        state.count[EVENTS] += 1


@kernel()
def _account(state, force_before, force, dt, totals) -> None:
    """Add one step to the totals by the trapezoidal rule."""
    sets = np.zeros(2, np.int64)
    for pair in range(8):
        totals.peak[pair] = max(totals.peak[pair], force[pair])
        totals.impulse[pair] += 0.5 * dt * (force_before[pair] + force[pair])
        if force[pair] > 0.0:
            totals.time_in_contact[pair] += dt
            corner = pair // 2
            sets[(pair + corner) % 2] |= 1 << corner
    for sense in range(2):
        if sets[sense] != 0:
            totals.set_time[sense, sets[sense]] += dt


@kernel()
def _to_world(y, z) -> None:
    """Write z from body coordinates."""
    c, s = y[COS], y[SIN]
    z[0], z[1], z[2] = c * y[0] - s * y[1], s * y[0] + c * y[1], y[THETA]
    z[3], z[4], z[5] = c * y[VX] - s * y[VY], s * y[VX] + c * y[VY], y[OMEGA]


@kernel()
def _runge_kutta(p, parts, state, t, dt, z, trial, k, load) -> None:
    """Take one step of the classical Runge-Kutta method; z (6,) in place, the four stages stay in k (4, 6)."""
    _accelerations(p, parts, parts.offset, parts.free, parts.slip, state, t, z, load, k[0])
    for stage in range(1, 4):
        part = dt if stage == 3 else 0.5 * dt
        for j in range(6):
            trial[j] = z[j] + part * k[stage - 1, j]
        _accelerations(p, parts, parts.offset, parts.free, parts.slip, state, t + part, trial, load, k[stage])
    for j in range(6):
        z[j] += dt / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
    state.count[COEFFICIENTS] += 4


@kernel()
def end_coarsely(p, parts, state, totals, target, bound) -> int:
    """Bring the state to `target` by the bound's few Runge-Kutta steps; estimate the error. Returns a `Status`.

    The estimate is the two middle stages' difference, |k2 - k3| dt / 3, of the order below the method's, with errors of
    the velocity counted over the time left; and where a pair has touched or parted within a step the impulse in doubt,
    F dt / 2, over the time in which the largest load crosses the clearance.
    """
    y, clock, z, k = state.y, state.clock, bound.z[0], bound.z[2:]
    pen, rate, now, before = bound.pairs[0], bound.pairs[1], bound.pairs[2], bound.pairs[3]
    start = clock[T0]
    dt = (target - start) / bound.steps
    _to_world(y, z)
    for pair in range(8):
        # a pair that was clipped or released is inside all the same
        state.mode[pair] = OFF if state.mode[pair] == OFF else ON
    pair_outputs(p, state, state.depth, y, pen, rate, now)
    state.count[BOUNDED] += 1
    for n in range(bound.steps):
        _runge_kutta(p, parts, state, start + n * dt, dt, z, bound.z[1], k, bound.load)
        left = target - start - (n + 1) * dt
        for j in range(3):
            radius = p.radius if j == 2 else 1.0
            off, drift = abs(k[1, j] - k[2, j]), abs(k[1, 3 + j] - k[2, 3 + j])
            bound.error[0] += radius * dt / 3.0 * (off + (left + dt) * drift)
        if not np.isfinite(z).all():
            return _NON_FINITE
        state.count[STEPS] += 1
        _to_body(z, y)
        _wear(parts.wear, state, now, dt)
        for pair in range(8):
            before[pair] = now[pair]
        pair_outputs(p, state, state.depth, y, pen, rate, now)
        _switch(p, state, pen, rate, start + (n + 1) * dt, totals, None)
        pair_outputs(p, state, state.depth, y, pen, rate, now)
        for pair in range(8):
            if (before[pair] > 0.0) != (now[pair] > 0.0):
                doubt = 0.5 * dt * (before[pair] + now[pair]) * p.inverse_mass
                bound.error[0] += doubt * p.position_tolerance / p.velocity_tolerance
        _account(state, before, now, dt, totals)
        if not within_range(p, state, y):
            return _RANGE
    clock[T0] = clock[NOW] = target
    clock[LAST_LENGTH], clock[TOUCHED] = 0.0, -np.inf
    state.step[TOUCHING] = state.step[STALL] = 0
    for pair in range(8):
        if state.mode[pair] == ON:
            state.mode[pair] = mode_inside(p, state, pair)
    return _OK


@kernel()
def march(p, parts, state, totals, log, done, steps, dt, euler, stride, q, v, penetration, force, audit) -> int:
    """Take `steps` steps of `dt` from step `done[0]` on; row i is written after step i stride. Returns a `Status`."""
    z, trial = np.empty(6), np.empty(6)
    k = np.empty((4, 6))
    load, y = np.empty(3), state.y
    pen, rate, now, before = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    _to_world(y, z)
    pair_outputs(p, state, state.depth, y, pen, rate, now)
    if audit is not None and done[0] == 0:
        audit_start(p, parts, state, y, 0.0, audit)
    while True:
        n = done[0]
        if not within_range(p, state, y):
            return _RANGE
        if n % stride == 0 or n == steps:
            # the last row may lie closer than the others
            row = (n + stride - 1) // stride
            pose_of(y, parts.offset, q[row], v[row])
            if force is not None:
                pair_outputs(p, state, state.depth, y, penetration[row], rate, force[row])
        if n >= steps:
            return _OK
        if log.length[0] + 8 > log.time.size:
            return _LOG_FULL
        t = n * dt
        if euler:
            _accelerations(p, parts, parts.offset, parts.free, parts.slip, state, t, z, load, k[0])
            for j in range(3):
                z[3 + j] += dt * k[0, 3 + j]
                z[j] += dt * z[3 + j]
            state.count[COEFFICIENTS] += 1
        else:
            _runge_kutta(p, parts, state, t, dt, z, trial, k, load)
        if not np.isfinite(z).all():
            return _NON_FINITE
        state.count[STEPS] += 1
        _to_body(z, y)
        _wear(parts.wear, state, now, dt)
        before[:] = now
        pair_outputs(p, state, state.depth, y, pen, rate, now)
        _switch(p, state, pen, rate, t + dt, totals, log)
        pair_outputs(p, state, state.depth, y, pen, rate, now)
        _account(state, before, now, dt, totals)
        if audit is not None:
            audit_fixed(p, parts, state, y, t + dt, dt, audit)
        done[0] = n + 1


@kernel()
def _wear(rate, state, force, dt) -> None:
    if rate is not None:
        for pair in range(8):
            state.depth[pair] += rate[pair] * force[pair] * dt
