"""Overdamped contact: implicit steps agree with explicit steps, and are used only if they are needed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scenes import TURNING_NOTHING, pose_error, preset, wall_and_point, with_presets_terms

from plow_twin import (
    Clearance,
    Contact,
    Frame,
    Friction,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Scene,
    SceneError,
    ToleranceWarning,
    Twin,
    Wear,
    simulate,
)
from plow_twin.model.contact_laws import LAWS
from plow_twin.solve import compiled_scene
from plow_twin.solve.state import Implicit


def damped(damping: float) -> Scene:
    scene = preset("bench_kv")
    return replace(scene, contact=replace(scene.contact, damping=damping))


def implicit_of(scene: Scene, tol: float = 1e-9) -> Implicit | None:
    return compiled_scene.compile_scene(scene, tol).parts.implicit


# runs with Kelvin-Voigt compute the balance, and thus share kernels; friction needs additional ones
balanced = partial(simulate, energy_balance=True)


@pytest.mark.parametrize(
    ("damping", "friction"),
    [(1e8, None), *(pytest.param(1e9, one, marks=pytest.mark.stress) for one in (None, Friction(0.2, 0.02)))],
)
def test_implicit_and_explicit_steps_agree(
    damping: float, friction: Friction | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = replace(damped(damping), friction=friction)
    implicit = balanced(scene, 0.5, output_dt=0.01)
    monkeypatch.setattr(compiled_scene, "_overdamped", lambda *numbers: np.zeros(len(numbers[-1]), bool))
    explicit = balanced(scene, 0.5, output_dt=0.01)
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
    # with explicit steps, the number of steps would grow by a factor of a hundred
    assert steps[1e11] < 10 * steps[1e9]


def test_a_damped_slide_has_its_closed_form() -> None:
    """After the time constant of the mass, C d' + K d = F, so d = F / K (1 - exp(-K t / C)) at both corners."""
    stiffness, damping, mass, g = 1e7, 1e9, 2.0, 9.81
    contact, corners = Contact("kelvin_voigt", stiffness, damping=damping), ("top_left_top", "top_right_top")
    scene = wall_and_point(contact, speed=0.0, mass=mass, gravity=g, gap=0.0, pairs=corners)
    result = balanced(with_presets_terms(scene), 200.0, output_dt=10.0, tol=1e-9)
    expected = 0.5 * mass * g / stiffness * (1.0 - np.exp(-stiffness / damping * result.t))
    assert result.penetration[:, [0, 2]] == pytest.approx(np.stack([expected] * 2, axis=1), rel=1e-5, abs=1e-12)
    assert result.solver["steps"] < 2000


BENCH = replace(preset("bench_kv"), frame=replace(preset("bench_kv").frame, width_m=0.33, height_m=0.27))
THROWN = replace(BENCH, initial=Initial((0.0, 0.0, 0.0), (0.5, 0.4, 1.0)))
CLAMPED = replace(BENCH, clearance=Clearance(-1e-3, -1e-3))


def overdamped(law: str, damping: float) -> Contact:
    """Return a contact with a damping or, for laws with a restitution up to 1, with this restitution."""
    linear = law in ("kelvin_voigt", "ramped_damping") or damping > 1.0
    return Contact(
        law, 1e9, 1.5 if law == "ramped_damping" else 1.0, damping=damping if linear else None,
        restitution=None if linear else damping, ramp_m=1e-4 if law == "ramped_damping" else None,
    )  # fmt: skip


def assert_within_the_gate(scene: Scene, tolerances: tuple[float, ...], inaccurate: tuple[float, ...] = ()) -> None:
    """Check that errors are within ten tolerances of a more accurate run, and that the number of steps is limited.

    At the tolerances in `inaccurate`, only the number of steps is checked.
    """
    run = balanced if scene.contact.law == "kelvin_voigt" else simulate
    exact = run(scene, 2.0, output_dt=0.01, tol=1e-12)
    growth = 0.0
    for moved in ((1e-12, 0.0, 0.0), (0.0, 0.0, 1e-12)):
        nudged = replace(scene, initial=replace(scene.initial, q=moved))
        growth = max(growth, np.abs(run(nudged, 2.0, output_dt=0.01, tol=1e-12).q - exact.q).max() / 1e-12)
    wide = abs(scene.clearance.horizontal_m), abs(scene.clearance.vertical_m)
    shown = replace(scene, clearance=Clearance(*wide))
    for tol in tolerances:
        result = run(scene, 2.0, output_dt=0.01, tol=tol)
        assert result.solver["steps"] <= (15_000 if tol >= 1e-8 else 30_000), tol
        # if displacements grow by more than this factor, no method can keep the tolerance
        if growth < 1e3 and tol not in inaccurate:
            assert pose_error(shown, result.q, exact.q) <= 10.0 * tol, (tol, growth)


@pytest.mark.parametrize("damping", [1e8, 1e9, 1e10])
def test_even_a_loose_tolerance_is_met(damping: float) -> None:
    """The tolerance affects the accuracy of a step, but not the choice of its method."""
    scene = replace(BENCH, contact=overdamped("kelvin_voigt", damping))
    assert_within_the_gate(scene, (1e-2, 1e-4, 1e-6, 1e-8, 1e-10))
    for other in (THROWN, CLAMPED):
        assert_within_the_gate(replace(other, contact=scene.contact), (1e-4,))


@pytest.mark.stress  # this test compiles additional kernels
def test_growth_while_dampers_hold_the_head_is_reported() -> None:
    """Rest on two corners at a depth of 1e-8 m amplifies rounding errors, but not during the whole rest."""
    scene = replace(BENCH, contact=overdamped("kelvin_voigt", 1e11), friction=Friction(0.2, 0.02))
    with pytest.warns(ToleranceWarning, match=r"an error grows \S+ times"):
        result = simulate(scene, 1.77, output_dt=0.01, sensitivity=True)
    assert result.sensitivity is not None and 1e4 < result.sensitivity.growth[-1] < 1e6
    exact = simulate(scene, 1.77, output_dt=0.01, tol=1e-12)
    assert 10.0 < pose_error(scene, result.q, exact.q) / 1e-9 < result.sensitivity.growth[-1]


@pytest.mark.parametrize(("law", "damping"), [("exact_restitution", 0.05), ("hunt_crossley", 1e8)])
def test_the_tolerance_is_met_for_laws_with_a_damping_factor(law: str, damping: float) -> None:
    assert_within_the_gate(replace(BENCH, contact=overdamped(law, damping)), (1e-2, 1e-6, 1e-10))


@pytest.mark.stress
@pytest.mark.parametrize("start", [BENCH, THROWN, CLAMPED], ids=["driven", "thrown", "clamped"])
@pytest.mark.parametrize(
    ("law", "damping"),
    [(law, 10.0**k) for law in ("kelvin_voigt", "ramped_damping") for k in range(4, 14)]
    + [("hunt_crossley", 10.0**k) for k in range(4, 10)]
    + [(law, e) for law, entry in LAWS.items() if entry.takes_restitution for e in (0.0, 0.05, 0.4, 0.9)],
)
def test_every_law_meets_the_tolerance_in_bounded_work(start: Scene, law: str, damping: float) -> None:
    scene = replace(start, contact=overdamped(law, damping))
    tolerances = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
    # the exception on the page of the solver
    sensitive = start is THROWN and law == "hunt_crossley" and damping >= 1e8
    assert_within_the_gate(scene, tolerances, inaccurate=(1e-4, 1e-5) if sensitive else ())


@pytest.mark.parametrize("damping", [10.0**k for k in range(10, 14)])
def test_damping_beyond_double_precision_or_the_model_is_refused(damping: float) -> None:
    """A damping is rejected above its limit, or if a pad wears faster than the damper lets the head move."""
    with pytest.raises(SceneError, match=r"contact.damping: got \S+, expected at most 1e\+09 s/m for hunt_crossley"):
        replace(BENCH, contact=overdamped("hunt_crossley", damping))
    wear = Wear(1e-12, 0.015, 2.0)
    for law in ("kelvin_voigt", "ramped_damping"):
        worn = replace(BENCH, wear=wear)
        if damping * 1e-12 * 2.0 / 0.015 > 1.0:
            with pytest.raises(SceneError, match=r"expected at most 7.5e\S+ N s/m"):
                replace(worn, contact=overdamped(law, damping))
        else:
            replace(worn, contact=overdamped(law, damping))


def test_a_start_inside_a_wall_continues_like_an_impact() -> None:
    """The head starts at depth d and leaves with e v0, as after an impact at v0 that turns back at d.

    At e = 1, v0 = d sqrt(2 K / m).
    """
    depth, stiffness, mass = 1e-3, 1e9, 2430.0
    for e, contact in (
        (1.0, Contact("kelvin_voigt", stiffness, damping=1e-6)),
        (0.4, Contact("exact_restitution", stiffness, restitution=0.4)),
    ):
        scene = Scene(
            Head(mass, 1265.0), Frame(0.33, 0.27), Clearance(0.025, 0.030), contact, Gravity(0.0),
            initial=Initial((0.0, 0.015 + depth, 0.0)),
        )  # fmt: skip
        factor = LAWS["exact_restitution"].damping_number(e)
        work = 0.5 if factor == 0.0 else (factor - np.log1p(factor)) / factor**2
        impact = depth * np.sqrt(stiffness / mass / work)
        # beside the preload, a smaller moment would select the kernels that search for rest
        large = replace(TURNING_NOTHING, moment_n_m=1e6)
        leaving = -simulate(replace(with_presets_terms(scene), loads=(large,)), 0.01).v[-1, 1]
        assert leaving == pytest.approx(e * impact, rel=1e-8)
        assert e < 1.0 or leaving == pytest.approx(0.9072, abs=1e-4)


@pytest.mark.parametrize("damping", [2e5, 1e9])
def test_a_symmetric_drop_stays_symmetric(damping: float) -> None:
    # a load along the line of symmetry selects the kernels of the tests above
    load = Harmonic("up and down", (0.0, 500.0), omega_rad_s=2.0)
    scene = replace(BENCH, loads=(load,), gravity=Gravity(9.81), contact=overdamped("kelvin_voigt", damping))
    result = balanced(scene, 3.0, output_dt=0.01)
    assert abs(result.q[:, [0, 2]]).max() < 1e-17 and len(result.events) >= 2


def test_scenes_that_are_not_overdamped_do_not_compile_implicit_steps() -> None:
    for scene in (preset("paper"), preset("bench_kv"), preset("bench_hc"), damped(1e6)):
        assert implicit_of(scene) is None
    assert implicit_of(damped(1e9)) is not None


def test_a_restored_twin_continues_with_the_same_bits() -> None:
    twin, other = Twin(damped(1e9)), Twin(damped(1e9))
    for t in np.linspace(0.01, 0.4, 23):
        expected = twin.advance(t)
        other.restore(twin.snapshot())
        assert other.digest() == twin.digest()
        assert np.array_equal(other.advance(t + 0.007).q, Twin.advance(twin, t + 0.007).q)
        assert expected.status.name == "OK"
