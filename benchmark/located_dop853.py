"""DOP853 compiled by numba. It locates each change of contact on its dense output, and restarts at this time.

Method and step control are those of Hairer, Norsett and Wanner, Solving ODEs I, sec. II.5 and II.6, with the
coefficients of SciPy. Contact modes are constant within a step. Output rows are read from the dense output.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample, timed
from lean import compiled, fast, inlined
from numpy.typing import NDArray
from scipy.integrate._ivp import dop853_coefficients as table

Indexes = NDArray[np.int64]

_STAGES = table.N_STAGES
_A = np.ascontiguousarray(table.A)
_B, _C = np.ascontiguousarray(table.B), np.ascontiguousarray(table.C)
_E3, _E5, _D = np.ascontiguousarray(table.E3), np.ascontiguousarray(table.E5), np.ascontiguousarray(table.D)
_ROWS = len(_C)
#: Absolute tolerances divided by rtol: a tenth of the usual magnitude of poses (1e-2) and velocities (1).
_ATOL = np.array([1e-3, 1e-3, 1e-3, 1e-1, 1e-1, 1e-1])
_OFF, _ON, _CLIPPED = 0, 1, 2
#: Number of equal parts of a step. The guards are checked at the end of each part.
_LOOKS = 4
_AT_ONE_INSTANT = 64


@inlined
def _pair(i, c, s, bx, by, bvx, bvy, om, p):  # type: ignore[no-untyped-def]
    """Return penetration and rate of a pair, its normal in body axes and its arm (see `lean`)."""
    corner = i // 2
    sx, sy = (-1.0 if corner == 0 or corner == 3 else 1.0), (1.0 if corner < 2 else -1.0)
    px = c * sx * 0.5 * p[0] + s * sy * 0.5 * p[1] - bx
    py = c * sy * 0.5 * p[1] - s * sx * 0.5 * p[0] - by
    if i % 2 == 0:
        return sy * py - 0.5 * (p[1] + p[3]), sy * (-bvy - om * px), 0.0, sy, sy * px
    return sx * px - 0.5 * (p[0] + p[2]), sx * (-bvx + om * py), sx, 0.0, -sx * py


@fast
def _rate(t: float, y: Array, mode: Indexes, p: Array, out: Array) -> None:
    """Write the time derivative of y = (x, y, theta, vx, vy, omega). Forces of pairs in mode ON may pull."""
    c, s, om = math.cos(y[2]), math.sin(y[2]), y[5]
    bx, by, bvx, bvy = c * y[0] + s * y[1], c * y[1] - s * y[0], c * y[3] + s * y[4], c * y[4] - s * y[3]
    fx = fy = torque = 0.0
    for i in range(8):
        if mode[i] == _ON:
            d, rate, along_x, along_y, arm = _pair(i, c, s, bx, by, bvx, bvy, om, p)
            damped = 1.0 + p[10] * rate
            force = p[8] * d + p[10] * rate if p[9] == 1.0 else p[8] * d * math.sqrt(abs(d)) * damped
            fx += along_x * force
            fy += along_y * force
            torque += arm * force
    load = math.sin(p[14] * t)
    out[0], out[1], out[2] = y[3], y[4], y[5]
    out[3] = (p[11] * load + c * fx - s * fy) / p[4]
    out[4] = (p[12] * load + s * fx + c * fy) / p[4] - p[6]
    out[5] = (p[13] * load + torque) / p[5] - p[4] * p[6] * p[7] / p[5]


@fast
def _guards(y: Array, mode: Indexes, p: Array, out: Array) -> None:
    """Write two guards of each pair, which are positive as long as its mode is unchanged."""
    c, s, om = math.cos(y[2]), math.sin(y[2]), y[5]
    bx, by, bvx, bvy = c * y[0] + s * y[1], c * y[1] - s * y[0], c * y[3] + s * y[4], c * y[4] - s * y[3]
    for i in range(8):
        d, rate, _, _, _ = _pair(i, c, s, bx, by, bvx, bvy, om, p)
        law = d + p[10] / p[8] * rate if p[9] == 1.0 else 1.0 + p[10] * rate
        out[2 * i], out[2 * i + 1] = d, 1.0
        if mode[i] == _OFF:
            out[2 * i] = -d
        else:
            out[2 * i + 1] = law if mode[i] == _ON else -law
            if p[9] == 1.0 and mode[i] == _ON:
                out[2 * i] = 1.0


@fast
def _dense(f: Array, y: Array, x: float, out: Array) -> None:
    """Write the state at the share x of a step, from the seven interpolation terms `f`, shape (7, 6)."""
    for j in range(6):
        value = 0.0
        for i in range(6, -1, -1):
            value = (value + f[i, j]) * (x if i % 2 == 0 else 1.0 - x)
        out[j] = y[j] + value


@fast
def _stages(
    t: float, y: Array, h: float, mode: Indexes, p: Array, k: Array, trial: Array, first: int, last: int
) -> None:
    for s in range(first, last):
        for j in range(6):
            total = 0.0
            for i in range(s):
                total += _A[s, i] * k[i, j]
            trial[j] = y[j] + h * total
        _rate(t + _C[s] * h, trial, mode, p, k[s])


@fast
def _error(y: Array, new: Array, h: float, k: Array, rtol: float) -> float:
    fifth = third = 0.0
    for j in range(6):
        scale = rtol * (_ATOL[j] + max(abs(y[j]), abs(new[j])))
        e5 = e3 = 0.0
        for i in range(_STAGES + 1):
            e5 += _E5[i] * k[i, j]
            e3 += _E3[i] * k[i, j]
        fifth += (e5 / scale) ** 2
        third += (e3 / scale) ** 2
    if fifth == 0.0 and third == 0.0:
        return 0.0
    return h * fifth / math.sqrt((fifth + 0.01 * third) * 6.0)


@fast
def _interpolate(y: Array, new: Array, h: float, k: Array, f: Array) -> None:
    for j in range(6):
        change = new[j] - y[j]
        f[0, j], f[1, j] = change, h * k[0, j] - change
        f[2, j] = 2.0 * change - h * (k[_STAGES, j] + k[0, j])
        for r in range(len(_D)):
            total = 0.0
            for i in range(_ROWS):
                total += _D[r, i] * k[i, j]
            f[3 + r, j] = h * total


@compiled
def _first_change(y: Array, f: Array, mode: Indexes, p: Array, at: Array, guards: Array):  # type: ignore[no-untyped-def]
    """Return the share of the step at which a guard first becomes negative, and the index of the guard, or (2, -1)."""
    for index in range(_LOOKS):
        low, high = index / _LOOKS, (index + 1) / _LOOKS
        _dense(f, y, high, at)
        _guards(at, mode, p, guards)
        if guards.min() >= 0.0:
            continue
        while high - low > 1e-15:
            middle = 0.5 * (low + high)
            _dense(f, y, middle, at)
            _guards(at, mode, p, guards)
            if guards.min() < 0.0:
                high = middle
            else:
                low = middle
        _dense(f, y, high, at)
        _guards(at, mode, p, guards)
        return high, int(guards.argmin())
    return 2.0, -1


@compiled
def integrate(p: Array, rtol: float, output_dt: float, q: Array) -> tuple[int, int, int]:
    """Integrate from rest at the origin into the rows of q. Return the numbers of steps, evaluations and events."""
    k, f = np.zeros((_ROWS, 6)), np.zeros((7, 6))
    y, new, trial, at, guards = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(16)
    mode = np.zeros(8, np.int64)
    t, h, row, steps, evaluations, changes, at_once = 0.0, 1e-3, 0, 0, 0, 0, 0
    fresh = True
    while row < len(q):
        if fresh:
            _rate(t, y, mode, p, k[0])
            evaluations += 1
        _stages(t, y, h, mode, p, k, trial, 1, _STAGES)
        for j in range(6):
            total = 0.0
            for i in range(_STAGES):
                total += _B[i] * k[i, j]
            new[j] = y[j] + h * total
        _rate(t + h, new, mode, p, k[_STAGES])
        evaluations += _STAGES
        error = _error(y, new, h, k, rtol)
        if not error <= 1.0:
            h *= max(0.2, 0.9 * error**-0.125)
            fresh = False
            continue
        _stages(t, y, h, mode, p, k, trial, _STAGES + 1, _ROWS)
        evaluations += _ROWS - _STAGES - 1
        _interpolate(y, new, h, k, f)
        share, guard = _first_change(y, f, mode, p, at, guards)
        end = t + h * min(share, 1.0)
        while row < len(q) and row * output_dt <= end:
            _dense(f, y, (row * output_dt - t) / h, trial)
            q[row, 0], q[row, 1], q[row, 2] = trial[0], trial[1], trial[2]
            row += 1
        steps += 1
        longer = h * (10.0 if error == 0.0 else min(10.0, 0.9 * error**-0.125))
        fresh = guard >= 0
        if fresh:
            at_once = at_once + 1 if end == t else 0
            if at_once > _AT_ONE_INSTANT:
                break
            pair, law = guard // 2, guard % 2 == 1
            if mode[pair] == _OFF:
                mode[pair] = _ON
            elif law:
                mode[pair] = _CLIPPED if mode[pair] == _ON else _ON
            else:
                mode[pair] = _OFF
            changes += 1
            y[:] = at
            longer = min(longer, h)
        else:
            y[:] = new
            k[0] = k[_STAGES]
        t, h = end, longer
    return steps, evaluations, changes


def prepare(p: Array, rtol: float, output_dt: float) -> Callable[[], Sample]:
    q = np.zeros((round(T_END / output_dt) + 1, 3))
    integrate(p, 1e-3, 1.0, np.zeros((1, 3)))

    def run() -> Sample:
        q[:] = np.nan
        wall, counts = timed(lambda: integrate(p, rtol, output_dt, q))
        steps, evaluations, changes = (int(count) for count in counts)
        if not np.isfinite(q).all():
            raise RuntimeError("stopped: modes flip without end at one instant")
        return Sample(wall, q.copy(), steps, evaluations, changes)

    return run
