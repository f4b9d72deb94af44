"""A plain compiled solver: classical RK4 with the equations of motion in world axes, without statistics or events."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from cases import Array
from numba import njit

#: Decorators of numba with other types, because the types of numba do not declare compiled functions as callable.
compiled: Final[Callable[[Any], Any]] = njit
fast: Final[Callable[[Any], Any]] = njit(fastmath=True)
inlined: Final[Callable[[Any], Any]] = njit(inline="always", fastmath=True)


@njit(inline="always")
def _push(d: float, rate: float, k: float, n: float, c: float) -> float:
    if d <= 0.0:
        return 0.0
    f = k * d + c * rate if n == 1.0 else k * d * math.sqrt(d) * (1.0 + c * rate)
    return max(f, 0.0)


@inlined
def accelerations(t: float, x: float, y: float, th: float, vx: float, vy: float, om: float, p: Array):  # type: ignore[no-untyped-def]
    """Return x'', y'', theta'' of a bench scene with constants `p` (see `bench_scenes.constants`)."""
    c, s = math.cos(th), math.sin(th)
    a, b = 0.5 * p[0], 0.5 * p[1]
    far_x, far_y = 0.5 * (p[0] + p[2]), 0.5 * (p[1] + p[3])
    bx, by, bvx, bvy = c * x + s * y, c * y - s * x, c * vx + s * vy, c * vy - s * vx
    fx = fy = torque = 0.0
    for i in range(4):
        sx, sy = (-1.0 if i == 0 or i == 3 else 1.0), (1.0 if i < 2 else -1.0)
        px, py = c * sx * a + s * sy * b - bx, c * sy * b - s * sx * a - by
        d = sy * py - far_y
        if d > 0.0:
            f = sy * _push(d, sy * (-bvy - om * px), p[8], p[9], p[10])
            fy += f
            torque += px * f
        d = sx * px - far_x
        if d > 0.0:
            f = sx * _push(d, sx * (-bvx + om * py), p[8], p[9], p[10])
            fx += f
            torque -= py * f
    load = math.sin(p[14] * t)
    return (
        (p[11] * load + c * fx - s * fy) / p[4],
        (p[12] * load + s * fx + c * fy) / p[4] - p[6],
        (p[13] * load + torque) / p[5] - p[4] * p[6] * p[7] / p[5],
    )


@compiled
def rhs_into(t: float, y: Array, out: Array, p: Array) -> None:
    """Write the time derivative of y = (x, y, theta, vx, vy, omega) to `out`."""
    out[0], out[1], out[2] = y[3], y[4], y[5]
    out[3], out[4], out[5] = accelerations(t, y[0], y[1], y[2], y[3], y[4], y[5], p)


@fast
def rk4(p: Array, dt: float, steps: int, stride: int, q: Array) -> None:
    """Integrate from rest at the origin. Row i of `q` becomes the pose after i * stride steps."""
    x = y = th = vx = vy = om = 0.0
    half = 0.5 * dt
    for n in range(steps):
        if n % stride == 0:
            q[n // stride, 0], q[n // stride, 1], q[n // stride, 2] = x, y, th
        t = n * dt
        a1, b1, c1 = accelerations(t, x, y, th, vx, vy, om, p)
        u2, v2, w2 = vx + half * a1, vy + half * b1, om + half * c1
        a2, b2, c2 = accelerations(t + half, x + half * vx, y + half * vy, th + half * om, u2, v2, w2, p)
        u3, v3, w3 = vx + half * a2, vy + half * b2, om + half * c2
        a3, b3, c3 = accelerations(t + half, x + half * u2, y + half * v2, th + half * w2, u3, v3, w3, p)
        u4, v4, w4 = vx + dt * a3, vy + dt * b3, om + dt * c3
        a4, b4, c4 = accelerations(t + dt, x + dt * u3, y + dt * v3, th + dt * w3, u4, v4, w4, p)
        x += dt / 6.0 * (vx + 2.0 * (u2 + u3) + u4)
        y += dt / 6.0 * (vy + 2.0 * (v2 + v3) + v4)
        th += dt / 6.0 * (om + 2.0 * (w2 + w3) + w4)
        vx += dt / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
        vy += dt / 6.0 * (b1 + 2.0 * (b2 + b3) + b4)
        om += dt / 6.0 * (c1 + 2.0 * (c2 + c3) + c4)
    q[steps // stride, 0], q[steps // stride, 1], q[steps // stride, 2] = x, y, th
