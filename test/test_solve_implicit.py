"""Overdamped contact: implicit steps agree with explicit ones, are taken only there, and cost no more when stiffer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import pose_error, preset, wall_and_point

from plow_twin import Contact, Friction, Scene, Twin, simulate
from plow_twin.solve import compiled_scene
from plow_twin.solve.state import Implicit


def damped(damping: float) -> Scene:
    scene = preset("bench_kv")
    return replace(scene, contact=replace(scene.contact, damping=damping))


def implicit_of(scene: Scene, tol: float = 1e-9) -> Implicit | None:
    return compiled_scene.compile_scene(scene, tol).parts.implicit


@pytest.mark.parametrize(("damping", "friction"), [(1e8, None), (1e9, None), (1e9, Friction(0.2, 0.02))])
def test_implicit_and_explicit_steps_agree(
    damping: float, friction: Friction | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = replace(damped(damping), friction=friction)
    implicit = simulate(scene, 0.5, output_dt=0.01, energy_balance=True)
    monkeypatch.setattr(compiled_scene, "_implicit", lambda *arguments: None)
    explicit = simulate(scene, 0.5, output_dt=0.01)
    assert implicit.solver["steps"] < 0.4 * explicit.solver["steps"]
    assert pose_error(scene, implicit.q, explicit.q) < 5e-9
    assert len(implicit.events) == len(explicit.events)
    assert implicit.events["time"] == pytest.approx(explicit.events["time"], abs=1e-7)
    assert implicit.energy_balance is not None and implicit.energy_balance.relative_imbalance < 1e-7


def test_the_work_hardly_grows_with_the_damping() -> None:
    steps = {}
    for damping in (1e9, 1e11):
        twin = Twin(damped(damping))
        twin.advance(0.3)
        steps[damping] = twin.steps
        assert twin._state.implicit_steps > 0
    # explicit steps would be a hundred times as many
    assert steps[1e11] < 10 * steps[1e9]


def test_a_damped_slide_has_its_closed_form() -> None:
    """C d' + K d = F far above the mass's own time: d = F / K (1 - exp(-K t / C))."""
    stiffness, damping, mass, g = 1e7, 1e9, 2.0, 9.81
    scene = wall_and_point(
        Contact("kelvin_voigt", stiffness, damping=damping), speed=0.0, mass=mass, gravity=g, gap=0.0
    )
    result = simulate(scene, 200.0, output_dt=10.0, tol=1e-6)
    expected = mass * g / stiffness * (1.0 - np.exp(-stiffness / damping * result.t))
    assert result.penetration[:, 0] == pytest.approx(expected, rel=1e-5, abs=1e-12)
    assert result.solver["steps"] < 2000


def test_scenes_that_are_not_overdamped_do_not_compile_it() -> None:
    for scene in (preset("paper"), preset("bench_kv"), preset("bench_hc"), damped(1e6)):
        assert implicit_of(scene) is None
    assert implicit_of(damped(1e9)) is not None


def test_a_restored_twin_goes_on_with_the_same_bits() -> None:
    twin, other = Twin(damped(1e9)), Twin(damped(1e9))
    for t in np.linspace(0.01, 0.4, 23):
        expected = twin.advance(t)
        other.restore(twin.snapshot())
        assert other.digest() == twin.digest()
        assert np.array_equal(other.advance(t + 0.007).q, Twin.advance(twin, t + 0.007).q)
        assert expected.status.name == "OK"
