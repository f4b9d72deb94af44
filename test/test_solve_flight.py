"""Free flight in closed form, compared with the formula and with the series. It never passes through a wall."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import preset
from scipy.interpolate import PPoly

from plow_twin import Gravity, Harmonic, Initial, Scene, Table, Twin, simulate
from plow_twin.run.motion import Motion, run_events
from plow_twin.run.simulate import output_times
from plow_twin.solve.compiled_scene import CompiledScene, compile_scene
from plow_twin.solve.state import new_work


def swaying(drift: tuple[float, float, float] = (0.0, 0.0, 0.0), amplitude: float = 1e-3, omega: float = 20.0) -> Scene:
    """Return a weightless head that drifts while a load moves it back and forth by `amplitude` [m]."""
    scene = preset("bench_kv")
    m, inertia = scene.head.mass_kg, scene.head.inertia_kg_m2
    force, moment = np.array([m, 0.5 * m]) * amplitude * omega**2, inertia * amplitude * omega**2
    load = Harmonic("swing", tuple(force), omega, 0.0, moment)
    v = np.array(drift) - np.array([*force / m, moment / inertia]) / omega
    return dataclasses.replace(scene, gravity=Gravity(0.0), loads=(load,), initial=Initial(v=tuple(v)))


def without_flight(scene: Scene, tol: float) -> CompiledScene:
    compiled = compile_scene(scene, tol)
    return dataclasses.replace(
        compiled, parts=compiled.parts._replace(terms=compiled.parts.terms._replace(flight=None))
    )


def run(compiled: CompiledScene, t_end: float, output_dt: float) -> Motion:
    times = output_times(t_end, output_dt)
    motion = Motion.start(compiled, np.zeros((len(times), 3)), np.zeros((len(times), 3)), outputs=True)
    assert run_events(compiled, motion, times, t_end, new_work(), 10**7) == (0, len(times))
    return motion


def test_an_hour_of_swinging_takes_36_steps_and_is_exact() -> None:
    scene, amplitude, omega = swaying(), 1e-3, 20.0
    result = simulate(scene, 3600.0, 3.7, energy_balance=True)
    assert result.solver["steps"] == 36 and len(result.events) == 0
    # the errors are rounding errors: a phase of 72,000 rad is rounded by 1e-11
    shape = np.array([1.0, 0.5, 1.0]) * amplitude
    assert np.abs(result.q + shape * np.sin(omega * result.t)[:, None]).max() < 1e-13
    assert np.abs(result.v + shape * omega * np.cos(omega * result.t)[:, None]).max() < 2e-12
    assert (
        result.energy_balance is not None
        and result.energy_balance.imbalance_j < 1e-12 * result.energy_balance.turnover_j
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_drifting_head_meets_the_same_walls_as_the_series_find(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drift = rng.uniform(-3e-3, 3e-3, 3)
    scene = swaying(tuple(drift), 10.0 ** rng.uniform(-5, -3), 10.0 ** rng.uniform(1.0, 2.5))
    flown, expanded = run(compile_scene(scene, 1e-10), 20.0, 0.01), run(without_flight(scene, 1e-10), 20.0, 0.01)
    assert flown.state.steps < expanded.state.steps
    first = np.flatnonzero(expanded.force.any(axis=1))
    until = int(first[0]) + 1 if len(first) else len(flown.q)
    assert until < len(flown.q), "the head should meet a wall"
    assert np.abs(flown.q - expanded.q)[:until].max() < 1e-11
    assert flown.log["pair"][0] == expanded.log["pair"][0]
    assert flown.log["time"][0] == pytest.approx(expanded.log["time"][0], rel=1e-9)
    assert flown.log["rate"][0] == pytest.approx(expanded.log["rate"][0], rel=1e-6)


@pytest.mark.stress  # this test compiles additional kernels
def test_long_linear_pieces_and_harmonics_are_flown_together() -> None:
    scene = swaying()
    knots = np.array([0.0, 7.0, 31.0, 40.0])
    force = np.array([[0.0, 0.0, 0.0], [0.02, -0.01, 0.0], [-0.02, 0.01, 0.005], [0.0, 0.0, 0.0]])
    scene = dataclasses.replace(scene, loads=(*scene.loads, Table("drift", knots, force)))
    flown, t = run(compile_scene(scene, 1e-11), 40.0, 0.1), output_times(40.0, 0.1)
    assert flown.state.steps < 20
    inertia = np.array([scene.head.mass_kg] * 2 + [scene.head.inertia_kg_m2])
    pieces = np.stack([np.diff(force, axis=0) / np.diff(knots)[:, None], force[:-1]])
    rate = PPoly(pieces, knots).antiderivative()
    shape = np.array([1.0, 0.5, 1.0]) * 1e-3
    q, v = rate.antiderivative()(t) / inertia, rate(t) / inertia
    assert np.abs(flown.q - q + shape * np.sin(20.0 * t)[:, None]).max() < 1e-11
    assert np.abs(flown.v - v + 20.0 * shape * np.cos(20.0 * t)[:, None]).max() < 1e-10


def test_advances_and_snapshots_in_flight_do_not_change_the_motion() -> None:
    # with this law, the kernels of other twins are used
    scene = dataclasses.replace(swaying((2e-4, 0.0, 0.0)), contact=preset("paper").contact)
    twin, other = Twin(scene), Twin(scene)
    advances = [twin.advance(t) for t in np.linspace(0.1, 40.0, 700)]
    assert twin._state.in_flight == 1
    assert other.advance(40.0).q.tolist() == advances[-1].q.tolist()
    restored = Twin(scene)
    restored.restore(twin.snapshot())
    for t in (41.0, 130.0):
        assert restored.advance(t).q.tolist() == twin.advance(t).q.tolist()
    assert restored.digest() == twin.digest()


def test_without_harmonics_or_with_an_offset_mass_flight_is_not_compiled() -> None:
    scene = swaying()
    still = dataclasses.replace(scene, loads=())
    offset = dataclasses.replace(
        scene, head=dataclasses.replace(scene.head, rotation="consistent", com_offset_m=(0.01, 0.0))
    )
    assert [compile_scene(one, 1e-9).parts.terms.flight for one in (scene, still, offset)] == [1, None, None]
