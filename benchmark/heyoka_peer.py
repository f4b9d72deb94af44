"""heyoka: Taylor series in compiled code with event detection, called from Python; the nearest peer.

Modes of the eight pairs are parameters of the equations; terminal events, of which Python callbacks set them, are each
pair's penetration and, as Kelvin-Voigt contact may not pull, its force. The Hunt-Crossley force d^1.5 has no Taylor
series at a touch, where an event ends a step: it cannot be run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample, timed

#: How long an event that has just fired is not looked for [s]; heyoka's own choice takes in the next touch of a pair.
_COOLDOWN = 1e-7


def _pairs(p: Array, x: Any, y: Any, th: Any, vx: Any, vy: Any, om: Any, hy: Any) -> list[tuple[Any, ...]]:
    """Return penetration, its rate, and the wrench in body axes per newton, of each pair (see `lean`)."""
    a, b, far_x, far_y = 0.5 * p[0], 0.5 * p[1], 0.5 * (p[0] + p[2]), 0.5 * (p[1] + p[3])
    c, s = hy.cos(th), hy.sin(th)
    bx, by, bvx, bvy = c * x + s * y, c * y - s * x, c * vx + s * vy, c * vy - s * vx
    pairs = []
    for sx, sy in ((-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        px, py = c * (sx * a) + s * (sy * b) - bx, c * (sy * b) - s * (sx * a) - by
        pairs.append((sy * py - far_y, sy * (-bvy - om * px), 0.0, sy, sy * px))
        pairs.append((sx * px - far_x, sx * (-bvx + om * py), sx, 0.0, -sx * py))
    return pairs


def _integrator(p: Array, tol: float) -> Any:
    import heyoka as hy

    names = ("x", "y", "th", "vx", "vy", "om")
    state = hy.make_vars(*names)
    c, s, (vx, vy, om) = hy.cos(state[2]), hy.sin(state[2]), state[3:]
    load = hy.sin(p[14] * hy.time)
    fx: Any = 0.0
    fy: Any = 0.0
    torque: Any = 0.0
    events = []
    inside = np.zeros(8, dtype=bool)

    def touches(pair: int) -> Callable[[Any, int], bool]:
        def callback(integrator: Any, sign: int) -> bool:
            inside[pair] = sign > 0
            integrator.pars[pair] = float(sign > 0)
            return True

        return callback

    def pulls(pair: int) -> Callable[[Any, int], bool]:
        def callback(integrator: Any, sign: int) -> bool:
            integrator.pars[pair] = float(sign > 0 and inside[pair])
            return True

        return callback

    for i, (d, rate, along_x, along_y, arm) in enumerate(_pairs(p, *state, hy)):
        law = p[8] * d + p[10] * rate
        force = hy.par[i] * law
        fx, fy, torque = fx + along_x * force, fy + along_y * force, torque + arm * force
        events += [
            hy.t_event(d, callback=touches(i), cooldown=_COOLDOWN),
            hy.t_event(law, callback=pulls(i), cooldown=_COOLDOWN),
        ]
    rates = (
        vx, vy, om,
        (p[11] * load + c * fx - s * fy) / p[4],
        (p[12] * load + s * fx + c * fy) / p[4] - p[6],
        (p[13] * load + torque) / p[5] - p[4] * p[6] * p[7] / p[5],
    )  # fmt: skip
    return hy.taylor_adaptive(
        list(zip(state, rates, strict=True)), np.zeros(6), tol=tol, pars=np.zeros(8), t_events=events
    ), inside


def prepare(p: Array, tol: float, output_dt: float) -> Callable[[], Sample]:
    """Prepare a run of the Kelvin-Voigt scene; what compiling takes is not timed."""
    integrator, inside = _integrator(p, tol)
    grid = np.arange(round(T_END / output_dt) + 1) * output_dt

    def solve() -> Any:
        integrator.time = 0.0
        integrator.state[:], integrator.pars[:], inside[:] = 0.0, 0.0, False
        integrator.reset_cooldowns()
        return integrator.propagate_grid(grid)

    def run() -> Sample:
        wall, found = timed(solve)
        poses = np.asarray(found[-1])[:, :3]
        if len(poses) != len(grid):
            raise RuntimeError(f"stopped: {found[0]}")
        return Sample(wall, poses.copy(), int(found[3]))

    return run
