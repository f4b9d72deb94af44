"""Ensembles with many pairs of clearances, compared with runs of our solver at the tightest tolerance."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from statistics import median

import heyoka_peer
import numpy as np
from bench_scenes import SPARSE, T_END, bench_scene, constants, error_scale
from cases import Array, Row, Sample, pose_error, timed
from lean import rk4
from work_precision import HEYOKA, LEAN_RK4, OURS, OURS_BARE, prepare_bare

from plow_twin import Clearance, Initial, Scene
from plow_twin.run.ensemble import simulate_many

Notify = Callable[[str], None]
SECTION = "ensemble"
LANES_SECTION = "ensemble_hc"
BATCH = f"{HEYOKA}, batch"
COLUMNS, ROWS = 40, 25
PAIRS = f"kv, {COLUMNS * ROWS} clearance pairs"
#: Tolerances from loose to tight. The first tolerance at which all pairs have an error below `LISTED` is timed
#: repeatedly.
TOLERANCES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
_BATCH_TOLERANCES = (1e-6, 1e-7, 1e-8)
EXACT = 1e-12
#: Error, relative to the clearance, above which a pair is listed.
LISTED = 1e-4
#: Displacement at t = 0, relative to the clearance. It is much larger than rounding errors; its growth is the
#: amplification.
PERTURBATION = 1e-8


def clearance_pairs(columns: int, rows: int, name: str = "kv") -> list[Scene]:
    scene = bench_scene(name)
    return [
        dataclasses.replace(scene, clearance=Clearance(float(gx), float(gy)))
        for gx in np.linspace(0.020, 0.030, columns)
        for gy in np.linspace(0.020, 0.030, rows)
    ]


def ensemble_rows(columns: int, rows: int, lean_steps: Sequence[float], repeats: int, notify: Notify) -> Iterator[Row]:
    """Yield rows of an ensemble for several tolerances, and rows of peers and of listed pairs.

    The tolerances end at the first tolerance that is tight enough for all pairs. The peers are run only if `lean_steps`
    are given.
    """
    scenes = clearance_pairs(columns, rows)
    name = f"kv, {len(scenes)} clearance pairs"
    notify(f"ensemble at {EXACT:g}")
    exact = simulate_many(scenes, T_END, SPARSE, EXACT).q
    error = np.zeros(0)
    for tol in TOLERANCES:
        notify(f"ensemble tol={tol:g}")
        row, error = _own_row(name, scenes, exact, tol, 1, 1)
        if row.error is not None and row.error <= LISTED:
            break
        yield row
    for workers in dict.fromkeys((1, os.cpu_count() or 1)):
        notify(f"ensemble tol={tol:g}, {workers} threads")
        yield _own_row(name, scenes, exact, tol, workers, repeats)[0]
    for dt in lean_steps:
        notify(f"ensemble lean RK4 dt={dt:g}")
        yield _lean_row(name, scenes, exact, dt)
    if lean_steps:
        yield from _heyoka_rows(name, scenes, exact, notify)
    notify("ensemble amplification")
    growth = _amplification(scenes, exact)
    for index in sorted({*np.flatnonzero(error > LISTED), *np.argsort(-growth)[:10]}, key=lambda i: -growth[i]):
        yield _member_row(scenes[index], tol, float(error[index]), float(growth[index]))


def lanes_rows(columns: int, rows: int, repeats: int, notify: Notify) -> Iterator[Row]:
    """Yield rows of pairs with the HC scene on one core, computed in SIMD lanes and one by one in alternating order.

    The tolerance is the first from 1e-4 on at which all pairs have an error below `LISTED`. The value of a row is its
    time relative to that of the lanes.
    """
    scenes = clearance_pairs(columns, rows, "hc")
    name = f"hc, {len(scenes)} clearance pairs"
    notify(f"{name}, at {EXACT:g}")
    exact = simulate_many(scenes, T_END, SPARSE, EXACT).q
    for tol in TOLERANCES[TOLERANCES.index(1e-4) :]:
        in_lanes, error = _own_row(name, scenes, exact, tol, 1, 1)
        if (error <= LISTED).all():
            break
    alone = [prepare_bare(scene, SPARSE, tol) for scene in scenes]
    lanes, loop, last = list[float](), list[float](), list[Sample]()
    for _ in range(repeats):
        notify(f"{name}, tol={tol:g}")
        lanes.append(timed(lambda: simulate_many(scenes, T_END, SPARSE, tol, 1))[0])
        last = [run() for run in alone]
        loop.append(sum(result.wall_s for result in last))
    one_by_one = Row(LANES_SECTION, f"{name}, one by one", OURS_BARE, f"tol={tol:g}, threads=1", SPARSE, T_END)
    poses = [result.q for result in last if result.q is not None]
    one_by_one.error = float(_member_errors(scenes, np.array(poses), exact).max())
    one_by_one.steps = sum(result.steps or 0 for result in last)
    one_by_one.events = sum(result.events or 0 for result in last)
    in_lanes.section, in_lanes.scene = LANES_SECTION, f"{name}, in lanes"
    for row, walls in ((in_lanes, lanes), (one_by_one, loop)):
        row.time(walls)
        row.value = median(walls) / median(lanes)
        yield row


def core_row(rows: Sequence[Row]) -> Row | None:
    """Return the row of one core at the tolerance that all pairs need."""
    own = [row for row in rows if row.section == SECTION and row.solver == OURS and row.setting.endswith(", threads=1")]
    return own[-1] if own else None


def batch_row(rows: Sequence[Row]) -> Row | None:
    """Return the row of heyoka in batches at the tolerance that all pairs need, or None."""
    matching = [row for row in rows if row.section == SECTION and row.solver == BATCH and row.error is not None]
    return next((row for row in matching if (row.error or 0.0) <= LISTED), None)


def _own_row(
    name: str, scenes: Sequence[Scene], exact: Array, tol: float, workers: int, repeats: int
) -> tuple[Row, Array]:
    walls: list[float] = []
    for _ in range(repeats):
        wall, ensemble = timed(lambda: simulate_many(scenes, T_END, SPARSE, tol, workers))
        walls.append(wall)
    error = _member_errors(scenes, ensemble.q, exact)
    row = Row(SECTION, name, OURS, f"tol={tol:g}, threads={workers}", SPARSE, T_END)
    row.time(walls)
    row.error, row.steps, row.events = float(error.max()), int(ensemble.steps.sum()), int(ensemble.events.sum())
    row.value = float((error > LISTED).sum())
    return row, error


def _member_errors(scenes: Sequence[Scene], q: Array, exact: Array) -> Array:
    return np.array([pose_error(b, error_scale(s))(a) for s, a, b in zip(scenes, q, exact, strict=True)])


def _amplification(scenes: Sequence[Scene], exact: Array) -> Array:
    """Return the growth of a displacement along x or theta, whichever is larger."""
    growth = np.zeros(len(scenes))
    for axis in (0, 2):
        moved = []
        for scene in scenes:
            q = [0.0, 0.0, 0.0]
            q[axis] = PERTURBATION * error_scale(scene)[axis]
            moved.append(dataclasses.replace(scene, initial=Initial(q=(q[0], q[1], q[2]))))
        away = simulate_many(moved, T_END, SPARSE, EXACT).q
        growth = np.maximum(growth, _member_errors(scenes, away, exact) / PERTURBATION)
    return growth


def _member_row(scene: Scene, tol: float, error: float, growth: float) -> Row:
    gx, gy = scene.clearance.horizontal_m, scene.clearance.vertical_m
    name = f"kv, gx={1e3 * gx:.4g} mm, gy={1e3 * gy:.4g} mm"
    status = f"error beyond {LISTED:g}" if error > LISTED else "ok"
    return Row(SECTION, name, OURS, f"tol={tol:g}", SPARSE, T_END, error=error, amplification=growth, status=status)


def _heyoka_rows(name: str, scenes: Sequence[Scene], exact: Array, notify: Notify) -> Iterator[Row]:
    pairs = np.array([[scene.clearance.horizontal_m, scene.clearance.vertical_m] for scene in scenes])
    for tol in _BATCH_TOLERANCES:
        notify(f"ensemble heyoka in batches tol={tol:g}")
        row = Row(SECTION, name, BATCH, f"tol={tol:g}, threads=1", SPARSE, T_END)
        try:
            run = heyoka_peer.prepare_batch(constants(scenes[0]), pairs, tol, SPARSE)
            sample: Sample = run()
        except Exception as problem:
            row.status = f"{'not run' if isinstance(problem, ImportError) else 'failed'}: {problem}"
            yield row
            return
        assert sample.q is not None
        error = _member_errors(scenes, np.moveaxis(sample.q, 2, 0), exact)
        row.time([sample.wall_s])
        row.error, row.value = float(error.max()), float((error > LISTED).sum())
        yield row
        if row.error <= LISTED:
            return


def _lean_row(name: str, scenes: Sequence[Scene], exact: Array, dt: float) -> Row:
    steps, stride = round(T_END / dt), round(SPARSE / dt)
    q = np.zeros_like(exact)
    parameters = [constants(scene) for scene in scenes]
    rk4(parameters[0], dt, stride, stride, q[0])

    def run() -> None:
        for p, rows in zip(parameters, q, strict=True):
            rk4(p, dt, steps, stride, rows)

    wall, _ = timed(run)
    error = _member_errors(scenes, q, exact)
    return Row(SECTION, name, LEAN_RK4, f"dt={dt:g}, threads=1", SPARSE, T_END, 1e3 * wall, 1e3 * wall, 1,
               float(error.max()), steps * len(scenes), value=float((error > LISTED).sum()))  # fmt: skip
