"""Run time against error on the bench scenes, for the solvers of this project and all peers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import cvode
import exudyn_peer
import heyoka_peer
import located_dop853
import mujoco_peer
import numpy as np
import python_peers
from bench_scenes import DENSE, SPARSE, T_END, bench_scene, constants, error_scale, on_grid
from cases import Array, Case, Row, Sample, pose_error, timed
from lean import rk4

from plow_twin import Result, Scene, SolverError, Status, simulate
from plow_twin.run.motion import BUDGET, Motion, run_events
from plow_twin.run.simulate import Method, output_times
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene
from plow_twin.solve.state import new_work

SECTION = "work_precision"
OURS, OURS_BARE = "plow_twin events", "plow_twin events, poses only"
OURS_RK4, LEAN_RK4 = "plow_twin RK4", "lean RK4 (numba)"
OURS_CALL = "plow_twin simulate(), whole call"
HEYOKA, LOCATED = "heyoka (Taylor, events)", "DOP853 (numba, events located)"


def _decades(loosest: int, tightest: int, per_decade: int = 2) -> tuple[float, ...]:
    """Return tolerances from 10^-loosest to 10^-tightest, beginning with the loosest."""
    return tuple(10.0 ** (-i / per_decade) for i in range(per_decade * loosest, per_decade * tightest + 1))


TOLERANCES = _decades(1, 12)
QUICK_TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12)
FIXED_STEPS = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)
LEAN_STEPS = (*FIXED_STEPS, 1e-5, 5e-6)
_LADDER = _decades(2, 13)
#: BDF is slower than Adams at errors below 1e-3.
_C_LADDERS = {"adams": _decades(2, 14), "bdf": _decades(2, 6, 1)}
#: Tolerances of peers that are slower than `odeint` at every error; they are run with sparse output only.
_SUNDAE = _decades(2, 6, 1)
_SOLVE_IVP = {"LSODA": _decades(3, 8, 1), "DOP853": _decades(3, 8, 1), "Radau": (1e-3, 1e-5), "BDF": (1e-3,)}
_MUJOCO = {"Euler": (1e-3, 5e-4, 2e-4, 1e-4), "implicitfast": (1e-3, 5e-4), "RK4": (1e-3, 5e-4)}
_EXUDYN = {"VelocityVerlet": (1e-3, 5e-4, 2e-4, 1e-4), "RK44": (1e-3, 5e-4)}
_EXUDYN_CONTROLLED = (1e-3, 1e-5, 1e-8)


def _case(
    scene_name: str, solver: str, setting: str, output_dt: float, prepare: Callable[[], Callable[[], Sample]]
) -> Case:
    reference, stride = on_grid(scene_name, output_dt)
    compare = pose_error(reference, error_scale(bench_scene(scene_name)))
    row = Row(SECTION, scene_name, solver, setting, output_dt, T_END)
    return Case(row, prepare, lambda q: compare(q[::stride]))


def prepare_simulate(
    scene: Scene,
    output_dt: float,
    tol: float = 1e-9,
    dt: float | None = None,
    *,
    energy_balance: bool = False,
    sensitivity: bool | tuple[str, ...] = False,
    whole_call: bool = False,
) -> Callable[[], Sample]:
    """Prepare `simulate` with all its outputs.

    The measured time is the time that `simulate` reports or, with `whole_call`, the time from call to return.
    """
    method: Method = "events" if dt is None else "rk4"

    def call(end: float) -> Result:
        return simulate(scene, end, output_dt, tol, method, dt, energy_balance, sensitivity=sensitivity)

    if sensitivity or whole_call:
        call(output_dt)  # this call compiles the code

    def run() -> Sample:
        wall, result = timed(lambda: call(T_END))
        solver = result.solver
        return Sample(
            wall if whole_call else result.wall_s, result.q, solver["steps"], solver["evaluations"], len(result.events)
        )

    return run


def prepare_bare(scene: Scene, output_dt: float, tol: float, t_end: float = T_END) -> Callable[[], Sample]:
    """Prepare the compiled loop alone. Its only outputs are poses and rates, as for the peers."""
    return prepare_compiled(compile_scene(scene, tol), output_dt, t_end)


def prepare_compiled(compiled: CompiledScene, output_dt: float, t_end: float) -> Callable[[], Sample]:
    """Prepare the compiled loop alone, as `prepare_bare` does."""
    work, times = new_work(), output_times(t_end, output_dt)

    def solve() -> tuple[int, Motion]:
        motion = Motion.start(compiled, np.zeros((len(times), 3)), np.zeros((len(times), 3)))
        return run_events(compiled, motion, times, t_end, work, BUDGET)[0], motion

    def run() -> Sample:
        wall, (code, motion) = timed(solve)
        if code != Status.OK:
            raise SolverError(f"at t = {motion.state.step_start:.9g} s: {Status(code).text}")
        state = motion.state
        return Sample(wall, motion.q, int(state.steps), int(state.evaluations), int(motion.totals.logged))

    nothing = Motion.start(compiled, np.zeros((1, 3)), np.zeros((1, 3)))
    run_events(compiled, nothing, np.zeros(1), 0.0, work, BUDGET)  # this call compiles the code
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
    scene = bench_scene(scene_name)
    for output_dt in (SPARSE, DENSE):
        for tol in TOLERANCES:
            setting = f"tol={tol:.3g}"
            yield _case(scene_name, OURS, setting, output_dt, partial(prepare_simulate, scene, output_dt, tol=tol))
            yield _case(
                scene_name, OURS_CALL, setting, output_dt,
                partial(prepare_simulate, scene, output_dt, tol=tol, whole_call=True),
            )  # fmt: skip
            yield _case(scene_name, OURS_BARE, setting, output_dt, partial(prepare_bare, scene, output_dt, tol))
        for dt in FIXED_STEPS:
            yield _case(
                scene_name, OURS_RK4, f"dt={dt:g}", output_dt, partial(prepare_simulate, scene, output_dt, dt=dt)
            )


def quick_cases() -> Iterator[Case]:
    """Yield a few cases of our solver that need only one compiled kernel."""
    scene = bench_scene("kv")
    for output_dt in (SPARSE, DENSE):
        for tol in QUICK_TOLERANCES:
            prepare = partial(prepare_bare, scene, output_dt, tol)
            yield _case("kv", OURS_BARE, f"tol={tol:.3g}", output_dt, prepare)


def lean_cases(scene_name: str) -> Iterator[Case]:
    p = constants(bench_scene(scene_name))
    for output_dt in (SPARSE, DENSE):
        for dt in LEAN_STEPS:
            yield _case(scene_name, LEAN_RK4, f"dt={dt:g}", output_dt, partial(_prepare_lean, p, dt, output_dt))


def cvode_cases(scene_name: str) -> Iterator[Case]:
    p = constants(bench_scene(scene_name))
    for output_dt, method, roots in product((SPARSE, DENSE), _C_LADDERS, (False, True)):
        name = "Adams" if method == "adams" else "BDF"
        for rtol in _C_LADDERS[method]:
            yield _case(
                scene_name, f"CVODE {name} (C{', rootfinding' if roots else ''})", f"rtol={rtol:.3g}", output_dt,
                partial(cvode.prepare, p, scene_name, method, roots, rtol, output_dt),
            )  # fmt: skip


def python_cases(scene_name: str) -> Iterator[Case]:
    p = constants(bench_scene(scene_name))
    for output_dt in (SPARSE, DENSE):
        for rtol in _LADDER:
            yield _case(
                scene_name, "LSODA (SciPy odeint)", f"rtol={rtol:.3g}", output_dt,
                partial(python_peers.prepare_odeint, p, rtol, output_dt),
            )  # fmt: skip
    for method, rtol in product(("Adams", "BDF"), _SUNDAE):
        prepare = partial(python_peers.prepare_sundae, p, method, rtol, SPARSE)
        yield _case(scene_name, f"CVODE {method} (scikit-sundae)", f"rtol={rtol:.3g}", SPARSE, prepare)
    for method, rtol in ((method, rtol) for method, ladder in _SOLVE_IVP.items() for rtol in ladder):
        prepare = partial(python_peers.prepare_solve_ivp, p, method, rtol, SPARSE)
        yield _case(scene_name, f"{method} (SciPy solve_ivp)", f"rtol={rtol:.3g}", SPARSE, prepare)


def heyoka_cases(scene_name: str) -> Iterator[Case]:
    p = constants(bench_scene(scene_name))
    for output_dt, tol in product((SPARSE, DENSE), _LADDER):
        prepare = partial(heyoka_peer.prepare, p, tol, output_dt)
        yield _case(scene_name, HEYOKA, f"tol={tol:.3g}", output_dt, prepare)


def located_cases(scene_name: str) -> Iterator[Case]:
    p = constants(bench_scene(scene_name))
    for output_dt, rtol in product((SPARSE, DENSE), _LADDER):
        prepare = partial(located_dop853.prepare, p, rtol, output_dt)
        yield _case(scene_name, LOCATED, f"rtol={rtol:.3g}", output_dt, prepare)


def multibody_cases(scene_name: str) -> Iterator[Case]:
    p = constants(bench_scene(scene_name))
    for integrator, steps in _MUJOCO.items() if scene_name == "kv" else ():
        for dt in steps:
            prepare = partial(mujoco_peer.prepare, p, integrator, dt, DENSE)
            yield _case(scene_name, f"MuJoCo {integrator}", f"dt={dt:g}", DENSE, prepare)
    for solver, steps in _EXUDYN.items():
        for dt in steps:
            prepare = partial(exudyn_peer.prepare, p, solver, dt, None, DENSE)
            yield _case(scene_name, f"Exudyn {solver}", f"dt={dt:g}", DENSE, prepare)
    for rtol in _EXUDYN_CONTROLLED:
        prepare = partial(exudyn_peer.prepare, p, "DOPRI5", 1e-3, rtol, DENSE)
        yield _case(scene_name, "Exudyn DOPRI5", f"rtol={rtol:g}", DENSE, prepare)


def unmodelled(scene_name: str) -> Iterator[Row]:
    """Yield a row for each peer that cannot model the scene."""
    if scene_name == "hc":
        yield Row(
            SECTION, "hc", "MuJoCo", "", DENSE, T_END, status="not run: no contact force with d^1.5 (1 + lambda d')"
        )
