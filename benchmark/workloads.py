"""What users do with the solver: ensembles, stiff walls, long times, sampled loads, random scenes."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import random_scenes
from bench_scenes import SPARSE, T_END, bench_scene, constants, error_scale
from cases import Array, Case, Row, pose_error, timed
from lean import rk4
from work_precision import OURS, prepare_simulate

from plow_twin import Clearance, Gravity, Initial, Scene, SolverError, Table, Twin, simulate
from plow_twin.ensemble import Ensemble, simulate_many

Notify = Callable[[str], None]
ENSEMBLE_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6)
#: Error of a member beyond which it is listed by name.
LISTED = 1e-4
RANDOM_TOLERANCES = (1e-6, 1e-9)


def clearance_pairs(columns: int, rows: int) -> list[Scene]:
    """Return KV scenes with horizontal and vertical clearances over 20..30 mm."""
    scene = bench_scene("kv")
    return [
        dataclasses.replace(scene, clearance=Clearance(float(gx), float(gy)))
        for gx in np.linspace(0.020, 0.030, columns)
        for gy in np.linspace(0.020, 0.030, rows)
    ]


def ensemble_rows(columns: int, rows: int, repeats: int, notify: Notify) -> Iterator[Row]:
    """Yield the ensemble at each tolerance on one core and on all, plain RK4, and the members that amplify."""
    scenes = clearance_pairs(columns, rows)
    section, name = "ensemble", f"kv, {len(scenes)} clearance pairs"
    notify("ensemble at 1e-12")
    exact = simulate_many(scenes, T_END, SPARSE, 1e-12)
    cores = os.cpu_count() or 1
    for tol in ENSEMBLE_TOLERANCES:
        for workers in dict.fromkeys((1, cores)):
            notify(f"ensemble tol={tol:g}, {workers} threads")
            walls, ensemble = _repeat(lambda t=tol, w=workers: simulate_many(scenes, T_END, SPARSE, t, w), repeats)
            error = _member_errors(scenes, ensemble.q, exact.q)
            row = Row(section, name, OURS, f"tol={tol:g}, threads={workers}", SPARSE, T_END)
            row.wall_ms, row.wall_min_ms, row.runs = 1e3 * float(np.median(walls)), 1e3 * min(walls), len(walls)
            row.error, row.steps, row.events = float(error.max()), int(ensemble.steps.sum()), int(ensemble.makes.sum())
            row.value = float((error > LISTED).sum())
            yield row
        for index in np.flatnonzero(error > LISTED):
            yield _member_row(section, scenes[index], tol, float(error[index]))
    for dt in (1e-3, 1e-4):
        notify(f"ensemble lean RK4 dt={dt:g}")
        yield _lean_ensemble(section, name, scenes, exact.q, dt)


def _repeat(run: Callable[[], Ensemble], repeats: int) -> tuple[list[float], Ensemble]:
    walls: list[float] = []
    for _ in range(repeats):
        wall, ensemble = timed(run)
        walls.append(wall)
    return walls, ensemble


def _member_errors(scenes: Sequence[Scene], q: Array, exact: Array) -> Array:
    return np.array([pose_error(b, error_scale(s))(a) for s, a, b in zip(scenes, q, exact, strict=True)])


def _member_row(section: str, scene: Scene, tol: float, error: float) -> Row:
    gx, gy = scene.clearance.horizontal_m, scene.clearance.vertical_m
    name, status = f"kv, gx={1e3 * gx:.4g} mm, gy={1e3 * gy:.4g} mm", f"error beyond {LISTED:g}"
    return Row(section, name, OURS, f"tol={tol:g}", SPARSE, T_END, error=error, status=status)


def _lean_ensemble(section: str, name: str, scenes: Sequence[Scene], exact: Array, dt: float) -> Row:
    steps, stride = round(T_END / dt), round(SPARSE / dt)
    q = np.zeros_like(exact)
    parameters = [constants(scene) for scene in scenes]
    rk4(parameters[0], dt, stride, stride, q[0])

    def run() -> None:
        for p, rows in zip(parameters, q, strict=True):
            rk4(p, dt, steps, stride, rows)

    wall, _ = timed(run)
    error = _member_errors(scenes, q, exact)
    return Row(section, name, "lean RK4 (numba)", f"dt={dt:g}, threads=1", SPARSE, T_END, 1e3 * wall, 1e3 * wall, 1,
               float(error.max()), steps * len(scenes), value=float((error > LISTED).sum()))  # fmt: skip


def stiffness_cases() -> Iterator[Case]:
    """Yield the KV scene from soft to stiff at its damping ratio; error over 2 s against our own run at 1e-12."""
    scene = bench_scene("kv")
    contact = scene.contact
    for exponent in range(5, 13):
        k = 10.0**exponent
        damping = (contact.damping or 0.0) * (k / contact.stiffness) ** 0.5
        stiff = dataclasses.replace(scene, contact=dataclasses.replace(contact, stiffness=k, damping=damping))
        row = Row("stiffness", f"kv, K={k:g} N/m", OURS, "tol=1e-06", SPARSE, T_END)
        yield Case(row, lambda s=stiff: prepare_simulate(s, SPARSE, tol=1e-6), _against_own(stiff, 2.0))


def _against_own(scene: Scene, t_end: float) -> Callable[[Array], float]:
    rows = round(t_end / SPARSE) + 1

    def error(q: Array) -> float:
        return pose_error(simulate(scene, t_end, SPARSE, 1e-12).q, error_scale(scene))(q[:rows])

    return error


def horizon_cases(longest: float) -> Iterator[Case]:
    """Yield the KV scene over growing machine time."""
    for t_end in (1.0, 10.0, 60.0, 600.0, 3600.0):
        if t_end <= longest:
            row = Row("machine_time", "kv", OURS, "tol=1e-06", 1.0, t_end)
            yield Case(row, lambda t=t_end: prepare_simulate(bench_scene("kv"), 1.0, t, 1e-6))


def event_cases() -> Iterator[Case]:
    """Yield scenes with few and many contact events over the same 20 s."""
    scene = bench_scene("kv")
    (load,) = scene.loads
    still = dataclasses.replace(scene, loads=())
    flight = dataclasses.replace(still, gravity=Gravity(0.0), initial=Initial(v=(1e-5, 1e-5, 0.0)))
    yield _event_case("free flight", flight)
    yield _event_case("falls and comes to rest", still)
    for omega in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0):
        yield _event_case(
            f"kv, omega={omega:g} rad/s",
            dataclasses.replace(scene, loads=(dataclasses.replace(load, omega_rad_s=omega),)),
        )


def _event_case(name: str, scene: Scene) -> Case:
    row = Row("contact_events", name, OURS, "tol=1e-06", 1.0, T_END)
    return Case(row, lambda: prepare_simulate(scene, 1.0, tol=1e-6))


def sampled_rows(repeats: int, notify: Notify) -> Iterator[Row]:
    """Yield the KV load sampled at 1 kHz: one twin in one call, 256 twins in turn; `value` is the times real time."""
    notify("sampled load")
    scene, t = bench_scene("kv"), np.arange(1, 20_001) * 1e-3
    p = constants(scene)
    wrench = np.sin(p[14] * t)[:, None] * p[11:14]
    twin = Twin(scene, tol=1e-6, excitation="sampled")
    twin.warm_up()
    walls = []
    for _ in range(repeats):
        twin.reset(0.0)
        wall, series = timed(lambda: twin.advance_samples(t, wrench))
        walls.append(wall)
    samples = Table("sampled", np.concatenate([[0.0], t]), np.concatenate([np.zeros((1, 3)), wrench]))
    exact = simulate(dataclasses.replace(scene, loads=(samples,)), T_END, 0.1, 1e-12)
    row = Row("sampled_load", "kv, 1 kHz", "plow_twin Twin", "tol=1e-06", 1e-3, T_END, 1e3 * float(np.median(walls)),
              1e3 * min(walls), repeats, steps=int(series.steps.sum()), events=int(series.makes.sum()))  # fmt: skip
    row.error = pose_error(exact.q[1:], error_scale(scene))(series.q[99::100])
    row.value = T_END / float(np.median(walls))
    yield row
    twins = [Twin(scene, tol=1e-6, excitation="sampled") for _ in range(256)]
    notify("256 twins")
    wall, _ = timed(lambda: _advance_in_turn(twins, t[:1000], wrench[:1000]))
    name = "kv, 1 kHz, 256 twins, 10 samples a call"
    yield Row(
        "sampled_load", name, "plow_twin Twin", "tol=1e-06", 1e-3, 1.0, 1e3 * wall, 1e3 * wall, 1, value=1.0 / wall
    )


def _advance_in_turn(twins: Sequence[Twin], t: Array, wrench: Array) -> None:
    for first in range(0, len(t), 10):
        for twin in twins:
            twin.advance_samples(t[first : first + 10], wrench[first : first + 10])


def random_rows(few: bool, notify: Notify) -> Iterator[Row]:
    """Yield the random scenes: error in tolerances (`value`) against the reference, and the scene's amplification.

    `few` takes twenty of those that need no other kernels than the bench scenes.
    """
    saved = random_scenes.load()
    for tol in RANDOM_TOLERANCES:
        chaotic = saved.chaotic(tol)
        chosen = (
            [i for i, scene in enumerate(saved.scenes) if _is_plain(scene)][:20] if few else range(len(saved.scenes))
        )
        for index in chosen:
            scene = saved.scenes[index]
            notify(f"random scene {index}, tol={tol:g}")
            row = Row(
                "random_scenes",
                _describe(index, scene),
                OURS,
                f"tol={tol:g}",
                random_scenes.OUTPUT_DT,
                random_scenes.T_END,
            )
            yield _random_row(row, scene, saved, index, tol, bool(chaotic[index]))


def _is_plain(scene: Scene) -> bool:
    contact = scene.contact
    law = contact.law == "kelvin_voigt" or (contact.exponent == 1.5 and contact.restitution != 1.0)
    return law and len(scene.loads) == 1 and not any(scene.head.com_offset_m)


def _random_row(
    row: Row, scene: Scene, saved: random_scenes.RandomScenes, index: int, tol: float, chaotic: bool
) -> Row:
    try:
        result = simulate(scene, random_scenes.T_END, random_scenes.OUTPUT_DT, tol)
    except SolverError as problem:
        row.status = f"failed: {problem}"
        return row
    row.wall_ms = row.wall_min_ms = 1e3 * result.wall_s
    row.runs, row.steps, row.events = 1, result.solver["steps"], len(result.events)
    row.error = random_scenes.distance(scene, result.q, saved.q[index])
    row.value = row.error / tol
    row.amplification = float(saved.amplification[index])
    if chaotic:
        row.status = f"chaotic: references part by {saved.disagreement[index]:.1g}"
    return row


def _describe(index: int, scene: Scene) -> str:
    contact = scene.contact
    damping = f"e={contact.restitution:.3g}" if contact.restitution is not None else f"damping={contact.damping:.3g}"
    gx, gy = 1e3 * scene.clearance.horizontal_m, 1e3 * scene.clearance.vertical_m
    return (
        f"#{index} {contact.law} K={contact.stiffness:.3g} n={contact.exponent:g} {damping} "
        f"m={scene.head.mass_kg:.4g} kg gaps={gx:.3g}x{gy:.3g} mm"
    )
