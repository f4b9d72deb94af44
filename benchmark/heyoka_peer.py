"""heyoka on the bench scenes: compiled Taylor series with event detection.

The contact modes of the eight pairs are parameters of the equations. Each pair has two terminal events, whose Python
callbacks set its mode: the penetration changes sign, or the force becomes attractive. The Hunt-Crossley force d^1.5 has
no Taylor series at d = 0, so the force begins here at a small penetration, at which it is negligible. The batch
integrator computes as many scenes at the same time as a SIMD vector has lanes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample, timed

#: Time [s] after an event in which heyoka ignores the same event. With its default, it would miss the next touch.
_COOLDOWN = 1e-7
#: Indices of the clearances in the parameters of heyoka, after the modes of the pairs.
_GX, _GY = 8, 9


def _pairs(p: Array, state: Sequence[Any], hy: Any) -> list[tuple[Any, ...]]:
    """Return for each pair the penetration, its rate, and the wrench of a unit force in body axes."""
    a, b, far_x, far_y = 0.5 * p[0], 0.5 * p[1], 0.5 * (p[0] + hy.par[_GX]), 0.5 * (p[1] + hy.par[_GY])
    x, y, th, vx, vy, om = state
    c, s = hy.cos(th), hy.sin(th)
    bx, by, bvx, bvy = c * x + s * y, c * y - s * x, c * vx + s * vy, c * vy - s * vx
    pairs = []
    for sx, sy in ((-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        px, py = c * (sx * a) + s * (sy * b) - bx, c * (sy * b) - s * (sx * a) - by
        pairs.append((sy * py - far_y, sy * (-bvy - om * px), 0.0, sy, sy * px))
        pairs.append((sx * px - far_x, sx * (-bvx + om * py), sx, 0.0, -sx * py))
    return pairs


def _equations(p: Array, begin: float) -> tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]]:
    """Return the rates of the state, and two functions for each pair.

    The first function is the penetration. The second is positive until the force of the pair would pull.
    """
    import heyoka as hy

    names = ("x", "y", "th", "vx", "vy", "om")
    state = hy.make_vars(*names)
    c, s, (vx, vy, om) = hy.cos(state[2]), hy.sin(state[2]), state[3:]
    load = hy.sin(p[14] * hy.time)
    fx: Any = 0.0
    fy: Any = 0.0
    torque: Any = 0.0
    guards = []
    for i, (d, rate, along_x, along_y, arm) in enumerate(_pairs(p, state, hy)):
        if p[9] == 1.0:
            law = p[8] * d + p[10] * rate
            force = hy.par[i] * law
        else:
            law = 1.0 + p[10] * rate
            # the power of a negative penetration is not real, so the base is 1 if the pair is not in contact
            force = hy.par[i] * p[8] * (hy.par[i] * d + (1.0 - hy.par[i])) ** p[9] * law
            d = d - begin
        fx, fy, torque = fx + along_x * force, fy + along_y * force, torque + arm * force
        guards.append((d, law))
    rates = (
        vx, vy, om,
        (p[11] * load + c * fx - s * fy) / p[4],
        (p[12] * load + s * fx + c * fy) / p[4] - p[6],
        (p[13] * load + torque) / p[5] - p[4] * p[6] * p[7] / p[5],
    )  # fmt: skip
    return list(zip(state, rates, strict=True)), guards


def _begin_of(tol: float) -> float:
    """Return the penetration [m] at which a force d^1.5 begins. The impulse of smaller penetrations is neglected."""
    return min(1e-6, max(1e-9, 1e-4 * math.pow(tol, 2.0 / 3.0)))


def _events(guards: list[tuple[Any, Any]], inside: Array, event: Any) -> list[Any]:
    """Return the terminal events that set the modes.

    In a batch, the callbacks receive the lane of the event. `inside` has the shape of the modes.
    """

    def touches(pair: int) -> Callable[..., bool]:
        def callback(integrator: Any, sign: int, *place: int) -> bool:
            inside[(pair, *place)] = sign > 0
            integrator.pars[(pair, *place)] = float(sign > 0)
            return True

        return callback

    def pulls(pair: int) -> Callable[..., bool]:
        def callback(integrator: Any, sign: int, *place: int) -> bool:
            integrator.pars[(pair, *place)] = float(sign > 0 and inside[(pair, *place)])
            return True

        return callback

    events = []
    for i, (depth, law) in enumerate(guards):
        events += [
            event(depth, callback=touches(i), cooldown=_COOLDOWN),
            event(law, callback=pulls(i), cooldown=_COOLDOWN),
        ]
    return events


@cache
def _integrator(numbers: tuple[float, ...], tol: float) -> Any:
    """Return an integrator, compiled once for both output grids, and the array of pairs inside their walls."""
    import heyoka as hy

    p = np.array(numbers)
    inside = np.zeros(8, dtype=bool)
    system, guards = _equations(p, _begin_of(tol))
    events = _events(guards, inside, hy.t_event)
    pars = np.zeros(10)
    pars[_GX], pars[_GY] = p[2], p[3]
    return hy.taylor_adaptive(system, np.zeros(6), tol=tol, pars=pars, t_events=events), inside


def prepare(p: Array, tol: float, output_dt: float) -> Callable[[], Sample]:
    integrator, inside = _integrator(tuple(p.tolist()), tol)
    grid = np.arange(round(T_END / output_dt) + 1) * output_dt

    def solve() -> Any:
        integrator.time = 0.0
        integrator.state[:], integrator.pars[:_GX], inside[:] = 0.0, 0.0, False
        integrator.reset_cooldowns()
        return integrator.propagate_grid(grid)

    def run() -> Sample:
        wall, found = timed(solve)
        poses = np.asarray(found[-1])[:, :3]
        if len(poses) != len(grid):
            raise RuntimeError(f"stopped: {found[0]}")
        return Sample(wall, poses.copy(), int(found[3]))

    return run


def prepare_batch(p: Array, clearances: Array, tol: float, output_dt: float) -> Callable[[], Sample]:
    """Prepare runs with many clearances, shape (n, 2), in batches of heyoka's recommended size.

    The poses of a run have shape (rows, 3, n).
    """
    import heyoka as hy

    width = int(hy.recommended_simd_size())
    inside = np.zeros((8, width), dtype=bool)

    system, guards = _equations(p, _begin_of(tol))
    events = _events(guards, inside, hy.t_event_batch)
    integrator = hy.taylor_adaptive_batch(
        system, np.zeros((6, width)), tol=tol, pars=np.zeros((10, width)), t_events=events
    )
    grid = np.arange(round(T_END / output_dt) + 1) * output_dt
    grids = np.ascontiguousarray(np.repeat(grid[:, None], width, axis=1))
    groups = -(-len(clearances) // width)
    # copies of the last pair of clearances fill the last batch
    filled = np.concatenate([clearances, np.repeat(clearances[-1:], groups * width - len(clearances), axis=0)])
    poses = np.zeros((len(grid), 3, len(filled)))

    def solve() -> None:
        for group in range(groups):
            chosen = slice(group * width, (group + 1) * width)
            integrator.set_time(np.zeros(width))
            integrator.state[:], integrator.pars[:_GX], inside[:] = 0.0, 0.0, False
            integrator.pars[_GX:] = filled[chosen].T
            integrator.reset_cooldowns()
            poses[:, :, chosen] = np.asarray(integrator.propagate_grid(grids)[-1])[:, :3]

    def run() -> Sample:
        wall, _ = timed(solve)
        if not np.isfinite(poses).all():
            raise RuntimeError("stopped: a pose is not finite")
        return Sample(wall, poses[:, :, : len(clearances)].copy())

    return run
