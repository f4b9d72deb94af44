"""Run time against error on the bench scenes: the project's solvers and all peers."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cvode
import exudyn_peer
import mujoco_peer
import numpy as np
import python_peers
from bench_scenes import DENSE, SPARSE, T_END, bench_scene, constants, error_scale, on_grid
from cases import Array, Case, Row, Sample, pose_error, timed
from lean import rk4

from plow_twin import Scene, SolverError, Status, simulate
from plow_twin.simulate import BUDGET, Motion, output_times, run_events
from plow_twin.solve.compiled import compile_scene
from plow_twin.solve.layout import new_work

SECTION = "work_precision"
OURS, OURS_BARE = "plow_twin events", "plow_twin events, poses only"
OURS_RK4, LEAN_RK4 = "plow_twin RK4", "lean RK4 (numba)"
TOLERANCES = tuple(10.0**-i for i in range(1, 13))
FIXED_STEPS = (1e-3, 2e-4, 1e-4, 2e-5, 1e-5)
_LADDER = tuple(10.0**-i for i in range(2, 15))
_SHORT_LADDER = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
_SCIPY = {"DOP853": _SHORT_LADDER, "Radau": (1e-3, 1e-5, 1e-7), "BDF": (1e-3, 1e-5, 1e-7), "LSODA": _SHORT_LADDER}
_MUJOCO = (("Euler", 1e-3), ("Euler", 1e-4), ("implicitfast", 1e-3), ("RK4", 1e-3), ("RK4", 1e-4))
_EXUDYN = (
    ("VelocityVerlet", 1e-3, None), ("VelocityVerlet", 1e-4, None), ("RK44", 1e-3, None), ("RK44", 2e-4, None),
    ("RK67", 1e-3, None), ("DOPRI5", 1e-3, 1e-3), ("DOPRI5", 1e-3, 1e-8),
)  # fmt: skip


def _case(
    scene_name: str, solver: str, setting: str, output_dt: float, prepare: Callable[[], Callable[[], Sample]]
) -> Case:
    reference, stride = on_grid(scene_name, output_dt)
    compare = pose_error(reference, error_scale(bench_scene(scene_name)))
    row = Row(SECTION, scene_name, solver, setting, output_dt, T_END)
    return Case(row, prepare, lambda q: compare(q[::stride]))


def prepare_simulate(
    scene: Scene, output_dt: float | None, t_end: float = T_END, tol: float = 1e-9, dt: float | None = None
) -> Callable[[], Sample]:
    """Prepare `simulate` with everything it gives: poses, rates, forces, penetrations, events, statistics."""

    def run() -> Sample:
        if dt is None:
            result = simulate(scene, t_end, output_dt, tol)
        else:
            result = simulate(scene, t_end, output_dt, method="rk4", dt=dt)
        solver = result.solver
        return Sample(result.wall_s, result.q, solver["steps"], solver["evaluations"], len(result.events))

    return run


def prepare_bare(scene: Scene, output_dt: float, tol: float) -> Callable[[], Sample]:
    """Prepare the compiled loop alone, with poses and rates as its only output, as the peers have it."""
    compiled, work, times = compile_scene(scene, tol), new_work(), output_times(T_END, output_dt)

    def run() -> Sample:
        motion = Motion.start(compiled, np.zeros((len(times), 3)), np.zeros((len(times), 3)))
        wall, (code, _) = timed(lambda: run_events(compiled, motion, times, T_END, work, BUDGET))
        if code != Status.OK:
            raise SolverError(Status(code).text)
        return Sample(wall, motion.q)

    return run


def _prepare_lean(p: Array, dt: float, output_dt: float) -> Callable[[], Sample]:
    steps, stride = round(T_END / dt), round(output_dt / dt)
    q = np.zeros((steps // stride + 1, 3))
    rk4(p, dt, stride, stride, q)

    def run() -> Sample:
        wall, _ = timed(lambda: rk4(p, dt, steps, stride, q))
        return Sample(wall, q.copy(), steps, 4 * steps)

    return run


def own_cases(scene_name: str) -> Iterator[Case]:
    """Yield the project's own solvers."""
    scene = bench_scene(scene_name)
    for output_dt in (SPARSE, DENSE):
        for tol in TOLERANCES:
            yield _case(
                scene_name,
                OURS,
                f"tol={tol:g}",
                output_dt,
                lambda o=output_dt, e=tol: prepare_simulate(scene, o, tol=e),
            )
            yield _case(
                scene_name, OURS_BARE, f"tol={tol:g}", output_dt, lambda o=output_dt, e=tol: prepare_bare(scene, o, e)
            )
        for dt in FIXED_STEPS:
            yield _case(
                scene_name,
                OURS_RK4,
                f"dt={dt:g}",
                output_dt,
                lambda o=output_dt, h=dt: prepare_simulate(scene, o, dt=h),
            )


def lean_cases(scene_name: str) -> Iterator[Case]:
    """Yield plain RK4."""
    p = constants(bench_scene(scene_name))
    for output_dt in (SPARSE, DENSE):
        for dt in (*FIXED_STEPS, 1e-6):
            yield _case(scene_name, LEAN_RK4, f"dt={dt:g}", output_dt, lambda o=output_dt, h=dt: _prepare_lean(p, h, o))


def cvode_cases(scene_name: str) -> Iterator[Case]:
    """Yield CVODE called from C, with and without its own rootfinding."""
    p = constants(bench_scene(scene_name))
    for output_dt in (SPARSE, DENSE):
        for method in ("adams", "bdf"):
            for roots in (False, True):
                for rtol in _LADDER:
                    name = "Adams" if method == "adams" else "BDF"
                    solver = f"CVODE {name} (C{', rootfinding' if roots else ''})"
                    yield _case(
                        scene_name, solver, f"rtol={rtol:g}", output_dt,
                        lambda m=method, r=roots, e=rtol, o=output_dt: cvode.prepare(p, scene_name, m, r, e, o),
                    )  # fmt: skip


def python_cases(scene_name: str) -> Iterator[Case]:
    """Yield solvers called from Python."""
    p = constants(bench_scene(scene_name))
    for output_dt in (SPARSE, DENSE):
        for rtol in _LADDER[1:-1]:
            yield _case(
                scene_name, "LSODA (SciPy odeint)", f"rtol={rtol:g}", output_dt,
                lambda e=rtol, o=output_dt: python_peers.prepare_odeint(p, e, o),
            )  # fmt: skip
        for method in ("Adams", "BDF"):
            for rtol in _LADDER[1:-1]:
                yield _case(
                    scene_name, f"CVODE {method} (scikit-sundae)", f"rtol={rtol:g}", output_dt,
                    lambda m=method, e=rtol, o=output_dt: python_peers.prepare_sundae(p, m, e, o),
                )  # fmt: skip
        for method, ladder in _SCIPY.items():
            for rtol in ladder:
                yield _case(
                    scene_name, f"{method} (SciPy solve_ivp)", f"rtol={rtol:g}", output_dt,
                    lambda m=method, e=rtol, o=output_dt: python_peers.prepare_solve_ivp(p, m, e, o),
                )  # fmt: skip


def multibody_cases(scene_name: str) -> Iterator[Case]:
    """Yield MuJoCo and Exudyn; both write rows at each of their steps or each 1 ms."""
    p = constants(bench_scene(scene_name))
    for integrator, dt in _MUJOCO if scene_name == "kv" else ():
        yield _case(
            scene_name, f"MuJoCo {integrator}", f"dt={dt:g}", DENSE,
            lambda i=integrator, h=dt: mujoco_peer.prepare(p, i, h, DENSE),
        )  # fmt: skip
    for solver, dt, rtol in _EXUDYN:
        setting = f"dt={dt:g}" if rtol is None else f"rtol={rtol:g}"
        yield _case(
            scene_name, f"Exudyn {solver}", setting, DENSE,
            lambda s=solver, h=dt, e=rtol: exudyn_peer.prepare(p, s, h, e, DENSE),
        )  # fmt: skip


def unmodelled(scene_name: str) -> Iterator[Row]:
    """Yield rows for what a peer cannot model."""
    if scene_name == "hc":
        yield Row(
            SECTION, "hc", "MuJoCo", "", DENSE, T_END, status="not run: no contact force with d^1.5 (1 + lambda d')"
        )
