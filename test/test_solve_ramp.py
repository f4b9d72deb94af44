"""Ramped damping: its limits, both solvers, and laws that a user adds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
from scenes import pose_error, preset, wall_and_point, with_presets_terms

from plow_twin import (
    ArgumentError,
    Clearance,
    Contact,
    ContactLaw,
    Frame,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Scene,
    SceneError,
    add_law,
    simulate,
)
from plow_twin.model import contact_laws
from plow_twin.model.contact_laws import exact_damping_number


def delivered(contact: Contact, mass: float = 2.0) -> float:
    result = simulate(with_presets_terms(wall_and_point(contact, speed=1.0, mass=mass)), 0.1, tol=1e-11)
    return float(result.v[-1, 1])


def test_a_short_ramp_is_kelvin_voigt_and_a_long_one_elastic() -> None:
    stiffness, mass = 1e6, 2.0
    damping = 2.0 * 0.1 * math.sqrt(stiffness * mass)
    errors = [
        abs(delivered(Contact("ramped_damping", stiffness, damping=damping, ramp_m=ramp)) - 0.7441)
        for ramp in (1e-4, 1e-5, 1e-6)
    ]
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1e-4
    assert delivered(Contact("ramped_damping", stiffness, damping=damping, ramp_m=10.0)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("stiffness", "exponent"),
    [
        (1e8, 1.5),
        (5e8, 2.2),
        *(pytest.param(*both, marks=pytest.mark.stress) for both in ((2e7, 1.0), (1e9, 2.0))),
    ],
)
def test_both_solvers_agree(stiffness: float, exponent: float) -> None:
    contact = Contact("ramped_damping", stiffness, exponent, damping=6e4, ramp_m=1e-3)
    scene = replace(preset("paper"), contact=contact)
    events = simulate(scene, 2.0, output_dt=0.1)
    coarse, steps = (
        simulate(scene, 2.0, output_dt=0.1, method="rk4", dt=dt, energy_balance=True) for dt in (4e-5, 1e-5)
    )
    assert pose_error(scene, steps.q, events.q) < 1e-6
    # the energy of fixed steps balances to their order
    assert coarse.energy_balance is not None and steps.energy_balance is not None
    assert steps.energy_balance.relative_imbalance < 0.15 * coarse.energy_balance.relative_imbalance < 1e-6
    assert 2 in events.events["mode_to"]


def test_a_ramp_is_accepted_only_with_the_ramped_law() -> None:
    for contact in (Contact("ramped_damping", 1e7, damping=1e4), Contact("hertz", 1e7, ramp_m=1e-3)):
        with pytest.raises(SceneError, match=r"contact\.ramp_m"):
            replace(preset("paper"), contact=contact)


@pytest.fixture
def laws_restored() -> Iterator[None]:
    before = dict(contact_laws._LAWS)
    yield
    contact_laws._LAWS.clear()
    contact_laws._LAWS.update(before)


@pytest.mark.usefixtures("laws_restored")
def test_a_user_defined_law_works_like_the_others() -> None:
    """Scenes, checks and all solvers use a single definition of the law."""
    add_law("half_exact", ContactLaw("half exact", "of this test", lambda e: 0.5 * exact_damping_number(e)))
    stiffness, e = 1e8, 0.6
    contact = Contact("half_exact", stiffness, restitution=e, impact_speed_floor_m_s=0.05)
    scene = replace(preset("paper"), contact=contact)
    assert delivered(scene.contact) > e + 0.1
    damping = 0.5 * exact_damping_number(e)
    assert delivered(scene.contact) == pytest.approx(
        delivered(Contact("hunt_crossley", stiffness, damping=damping)), abs=1e-9
    )
    steps = simulate(scene, 1.0, output_dt=0.1, method="rk4", dt=1e-5)
    assert pose_error(scene, steps.q, simulate(scene, 1.0, output_dt=0.1).q) < 1e-3
    with pytest.raises(ValueError, match="half_exact"):
        add_law("half_exact", ContactLaw("again", ""))


def test_a_clipped_pair_pushes_again_before_it_parts_at_every_tolerance() -> None:
    """The damping decreases with the ramp faster than the spring relaxes.

    The pair therefore pushes again and separates within a microsecond.
    """
    scene = replace(preset("bench_kv"), contact=Contact("ramped_damping", 1e9, 1.5, damping=1e4, ramp_m=1e-4))
    tight, loose = (simulate(scene, 1.0, output_dt=0.01, tol=tol) for tol in (1e-12, 1e-9))
    assert pose_error(scene, loose.q, tight.q) < 1e-11
    assert len(tight.events) == len(loose.events)
    clipped = tight.events["mode_from"] == 2
    assert clipped.sum() > 20 and (tight.events["mode_to"][clipped] == 1).all()


def test_a_clipped_pair_does_not_push_before_its_time() -> None:
    """The force is a cubic in penetration / ramp, which becomes large, so its series needs many terms.

    With steps as long as the motion allows, the force would begin too early, with an error of 28 tolerances.
    """
    scene = Scene(
        Head(9678.65468622175, 6223.158278044431), Frame(0.5358668741978295, 0.8164604022979493),
        Clearance(0.0010744492074319203, 0.0013309842731401734),
        Contact("ramped_damping", 39789124432.568474, damping=41315573.98844641, ramp_m=1.859904061158338e-06),
        Gravity(9.81),
        (Harmonic("swing", (136407.79207032567, 78091.2651934814), 2.13280634928262, 6.183084803690521, -11577.53909),),
        Initial((0.0, 0.0, 0.0), (0.08018584619312634, 0.08016477931228669, -0.04463423756155122)),
    )  # fmt: skip
    exact = simulate(scene, 1.0, output_dt=0.005, tol=1e-12)
    for tol in (1e-4, 1e-6, 1e-8, 1e-10):
        result = simulate(scene, 1.0, output_dt=0.005, tol=tol)
        assert pose_error(scene, result.q, exact.q) < 0.1 * tol


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"additive": True}, "exponent: got None"),
        ({"additive": True, "exponent": 1.0, "number_of": lambda e: 1.0 - e}, "number_of: expected None"),
        ({"ramped": True}, "ramped=True: expected additive=True"),
    ],
)
def test_a_law_with_contradictory_options_is_refused(options: dict[str, object], named: str) -> None:
    with pytest.raises(ArgumentError, match=named):
        ContactLaw("mine", "nowhere", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("number", [-0.1, math.nan])
def test_a_negative_damping_number_is_refused(number: float) -> None:
    with pytest.raises(ArgumentError, match=r"mine: D\(0.5\): got"):
        ContactLaw("mine", "nowhere", lambda e: number).damping_number(0.5)
