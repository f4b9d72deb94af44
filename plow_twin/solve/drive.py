"""The loop: steps one after the other, read out wherever output is wanted."""

from __future__ import annotations

import numba
import numpy as np

from plow_twin.solve.layout import AT_HARD_END, LENGTH, STEPS, T0, USED, Status
from plow_twin.solve.step import account, begin, evaluate, finish, pair_outputs, pose_of, sigma_at, within_range

_OK, _STALLED = int(Status.OK), int(Status.STALLED)
_RANGE, _NON_FINITE = int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_BUDGET, _LOG_FULL = int(Status.BUDGET), int(Status.LOG_FULL)


@numba.njit(cache=True, error_model="numpy")
def _next(p, state, w, hard_time, harmonics, second, segments, law, wear, offset, free, budget) -> int:  # type: ignore[no-untyped-def]
    """Lay out the next step unless one is under way."""
    if state.clock[LENGTH] >= 0.0:
        return _OK
    if state.count[STEPS] >= budget:
        return _BUDGET
    if not within_range(p, state):
        return _RANGE
    if not begin(
        p, state, w, hard_time, harmonics, second, segments, law.viscous, law.factor, law.integer, law.fraction, wear, offset, free
    ):
        return _NON_FINITE
    return _OK


@numba.njit(cache=True, error_model="numpy")
def advance(p, parts, state, w, totals, log, target, hard_time, budget) -> int:  # type: ignore[no-untyped-def]
    """Bring the motion to `target`; steps may reach beyond it, up to `hard_time`. Returns a `Status`."""
    harmonics, segments, law = parts.harmonics, parts.segments, parts.law
    while True:
        t0 = state.clock[T0]
        if t0 >= target and state.clock[LENGTH] < 0.0:
            return _OK
        if log is not None and log.length[0] >= log.time.size:
            return _LOG_FULL
        code = _next(p, state, w, hard_time, harmonics, parts.second, segments, law, parts.wear, parts.offset, parts.free, budget)
        if code != _OK:
            return code
        low = sigma_at(state, state.clock[USED])
        end = t0 + state.clock[LENGTH]
        if target < end or (target == end and state.step[AT_HARD_END] == 0):
            account(state, w, low, sigma_at(state, target - t0), totals)
            state.clock[USED] = target - t0
            return _OK
        account(state, w, low, sigma_at(state, state.clock[LENGTH]), totals)
        finish(p, state, w, totals, log, parts.wear, law.fraction)


@numba.njit(cache=True, error_model="numpy")
def read(p, parts, state, w, q, v, penetration, rate, force) -> None:  # type: ignore[no-untyped-def]
    """Write pose, rate and the pairs' outputs at the present time; a step must be under way."""
    sigma = sigma_at(state, state.clock[USED])
    y = np.empty(8)
    evaluate(state, w, sigma, y)
    pose_of(y, parts.offset, q, v)
    pair_outputs(p, state, w, sigma, penetration, rate, force)


@numba.njit(cache=True, error_model="numpy")
def record(p, parts, state, w, totals, log, t_end, budget, first, t, q, v, penetration, force) -> int:  # type: ignore[no-untyped-def]
    """Advance to `t_end` and fill the rows of t, q, v, penetration, force from row `first[0]` on. Returns a `Status`.

    `penetration` and `force` may be None. The rows' times do not change the steps.
    """
    harmonics, segments, law = parts.harmonics, parts.segments, parts.law
    rate, y = np.empty(8), np.empty(8)
    row = first[0]
    while True:
        t0 = state.clock[T0]
        if t0 >= t_end and row >= t.size:
            return _OK
        if log is not None and log.length[0] >= log.time.size:
            return _LOG_FULL
        code = _next(p, state, w, t_end, harmonics, parts.second, segments, law, parts.wear, parts.offset, parts.free, budget)
        if code != _OK:
            return code
        length = state.clock[LENGTH]
        end = t0 + length
        last = state.step[AT_HARD_END] == 1 and end >= t_end * (1.0 - 1e-15)
        while row < t.size and (t[row] < end or last):
            sigma = sigma_at(state, min(max(t[row] - t0, 0.0), length))
            evaluate(state, w, sigma, y)
            pose_of(y, parts.offset, q[row], v[row])
            if force is not None:
                pair_outputs(p, state, w, sigma, penetration[row], rate, force[row])
            row += 1
            first[0] = row
        account(state, w, 0.0, sigma_at(state, length), totals)
        finish(p, state, w, totals, log, parts.wear, law.fraction)
