"""Prior deviations of the unknowns: stated in the scene, given by marks, or defaults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import preset

from plow_twin import Contact, Frame, Friction, Mark, Provenance
from plow_twin.estimate.bouncing import hidden_by_geometry
from plow_twin.estimate.discrepancy import variants
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.similar import Units
from plow_twin.estimate.uncertain_load import _with_exponent
from plow_twin.estimate.unknowns import OF_SCENE, SIZE, Unknowns, with_other_law
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import MOST_DAMPING_FACTOR


def test_the_scene_or_the_mark_determines_the_prior() -> None:
    scene = preset("paper")
    t = np.arange(0.0, 10.0, 0.1)
    load, poses = Load(t, compile_loads(scene.loads).at(t)), Poses(t, np.zeros((len(t), 3)))
    by_mark = Unknowns.stated(scene, load, poses).deviations()
    np.testing.assert_array_equal(by_mark[:4], [8e-3, 8e-3, 2.5, 1.2])
    marks = {
        "clearance.horizontal_m": Provenance(Mark.ASSUMED, "", 2e-3),
        "clearance.vertical_m": Provenance(Mark.MEASURED),
        "contact.stiffness": Provenance(Mark.ASSUMED, "", 0.1 * scene.contact.stiffness),
        "contact.damping": Provenance(Mark.ASSUMED, "", 0.2 * (scene.contact.damping or 0.0)),
    }
    stated = Unknowns.stated(replace(scene, marks=marks), load, poses).deviations()
    # 10 % more stiffness gives 10 % less penetration; a penetration of 0.1 mm is treated as zero
    np.testing.assert_allclose(stated[:4], [2e-3, 2e-3, 0.1, 0.2], rtol=0.02)
    # in the units of another machine, the deviations have other numbers but describe the same lengths and shares
    units = Units(0.5, 2.0, 0.25)
    other = units.scene(replace(scene, marks=marks))
    far = Unknowns.stated(other, units.load(load), units.poses(poses)).deviations()
    assert far[0] == 2.0 * stated[0] and far[3] == pytest.approx(stated[3])


@pytest.mark.parametrize("number", ["stiffness", "damping"])
def test_a_deviation_far_above_its_number_gives_a_log_normal_prior(number: str) -> None:
    scene, load = preset("paper"), Load.unmeasured(1.0)
    marks = {f"contact.{number}": Provenance(Mark.ASSUMED, "", 100.0 * getattr(scene.contact, number))}
    stated = Unknowns.stated(replace(scene, marks=marks), load, Poses(np.zeros(0), np.zeros((0, 3)))).deviations()
    assert stated[2:4].max() == pytest.approx(np.sqrt(np.log(1.0 + 100.0**2)), rel=1e-2)


def test_a_stated_deviation_of_a_zero_clearance_is_converted_to_other_units() -> None:
    scene = replace(preset("paper"), marks={"clearance.horizontal_m": Provenance(Mark.ASSUMED, "", 1e-3)})
    tight = replace(scene, clearance=replace(scene.clearance, horizontal_m=0.0))
    assert Units(0.5, 2.0, 0.25).scene(tight).marks["clearance.horizontal_m"].deviation == 2e-3


def test_the_scene_of_a_vector_depends_only_on_the_quantities_that_are_declared_for_it() -> None:
    """`Problem` does not build a new scene while these quantities are unchanged."""
    scene = preset("paper")
    t = np.arange(0.0, 10.0, 0.1)
    unknowns = Unknowns.stated(scene, Load(t, compile_loads(scene.loads).at(t)), Poses(t, np.zeros((len(t), 3))))
    nominal = unknowns.nominal()
    for place in range(SIZE):
        moved = nominal.copy()
        moved[place] += 1e-3
        depends = unknowns.scene_of(moved) != unknowns.scene_of(nominal)
        assert depends == (place in range(SIZE)[OF_SCENE])


@pytest.mark.parametrize(
    ("contact", "exponents"),
    [(Contact("kelvin_voigt", 1e7, damping=4e4), set()), (Contact("hertz", 1e7, 4.0), set()),
     (Contact("hertz", 1e7, 1.5), {1.52})],
)  # fmt: skip
def test_the_estimate_changes_a_scene_within_its_contact_law_and_friction(
    contact: Contact, exponents: set[float]
) -> None:
    stuck = Friction(0.2, stick_stiffness_n_m=1e7, static_coefficient=0.2)
    scene = replace(preset("paper"), contact=contact, friction=stuck)
    changed = variants(scene)
    assert {one.contact.exponent for one in changed} - {contact.exponent} == exponents
    assert max(one.friction.coefficient for one in changed if one.friction) == pytest.approx(0.21)
    drawn = [_with_exponent(Unknowns(scene), np.random.default_rng(seed)).scene.contact.exponent for seed in range(9)]
    assert (max(drawn) > contact.exponent) == bool(exponents)


def test_the_alternative_law_has_no_options_of_the_scene_s_law() -> None:
    falling = Contact(
        "hunt_crossley", 1e7, restitution=0.4, restitution_fall=0.25, restitution_speed_m_s=0.05,
        restitution_mass_power=0.5, restitution_fall_along_s_m=0.1,
    )  # fmt: skip
    other = with_other_law(Unknowns(replace(preset("paper"), contact=falling)))
    assert other is not None and other.scene.contact == Contact("kelvin_voigt", 1e7, damping=1.0)


def test_no_drawn_damping_factor_exceeds_the_admissible_factor() -> None:
    stiff = Contact("hunt_crossley", 1e7, damping=0.1 * MOST_DAMPING_FACTOR)
    unknowns = Unknowns(replace(preset("paper"), contact=stiff))
    vector = unknowns.nominal() + 3.0 * unknowns.deviations()
    assert unknowns.scene_of(unknowns.within(vector)).contact.damping == MOST_DAMPING_FACTOR


def test_rounded_corners_may_be_larger_than_a_thin_frame() -> None:
    """The prior radius of a corner, 3 mm, would take both sides of the frame."""
    t = np.arange(0.0, 20.0, 0.02)
    poses = Poses(t, np.outer(np.sin(2.0 * t), [0.0125, 0.015, 0.01]))
    scene = replace(preset("paper"), frame=Frame(0.005, 0.4))
    unseen, rounded = hidden_by_geometry(Unknowns(scene), poses, np.pi, np.array([0.025, 0.030]))
    assert np.isfinite(unseen).all() and np.isfinite(rounded).all()
