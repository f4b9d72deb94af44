"""Fits with the friction that a linearised step has found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import KINDS, mismatched
from scenes import preset

from plow_twin import Friction, Mark, Provenance
from plow_twin.estimate import relinearised
from plow_twin.estimate.discrepancy import CREEP, EXPONENT, FRICTION, can_move, graded, least_change, moved_scene
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.relinearised import with_other_law_numbers
from plow_twin.estimate.search import refine
from plow_twin.estimate.unknowns import DAMPING, GX, GY, SOFTNESS, Unknowns
from plow_twin.estimate.verdict import Verdict


def test_friction_is_found_in_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    # the kernels of other exponents and of the other law, both with friction, take long to compile
    monkeypatch.setattr(relinearised, "judge", lambda *_: Verdict())
    truth = mismatched(replace(KINDS["friction_05"], periods=3.0), 98300)
    scene = replace(truth.nominal, marks={EXPONENT: Provenance(Mark.GIVEN, "", 0.0)})
    unknowns = Unknowns.stated(scene, truth.load, truth.poses)
    start = unknowns.nominal()
    start[[GX, GY]], start[DAMPING] = truth.clearance, np.log(truth.scene.contact.damping or 1.0)
    start[SOFTNESS] = unknowns.softness_of(truth.scene.contact.stiffness)
    load = truth.load.thinned()
    begun = refine(Forward(scene, load), unknowns, truth.poses, np.pi, start, np.array([5e-4, 5e-4, 2e-3]), None)
    assert begun is not None
    found = with_other_law_numbers(*begun, np.pi)
    assert found is not None
    (problem, fitted), verdict = found
    assert f"{FRICTION}: 0.05" in verdict.added and "the scene has 0" in verdict.added
    assert problem.unknowns.nominal_scene is scene
    assert problem.unknowns.changes[FRICTION] == pytest.approx(0.05, abs=5e-3)
    before, after = (np.abs(graded(*one).clearance - truth.clearance).max() for one in (begun, (problem, fitted)))
    assert after < 1e-4 < before


def test_friction_and_exponent_have_least_values() -> None:
    scene = preset("paper")
    assert least_change(scene, EXPONENT) == 0.0 and least_change(scene, FRICTION) == 0.0
    assert least_change(replace(scene, friction=Friction(0.1)), FRICTION) == -0.1
    assert least_change(scene, "head.mass_kg") == -np.inf


def test_the_speed_of_viscous_friction_can_differ_only_for_friction_without_stick() -> None:
    scene = preset("paper")
    rubbing = moved_scene(moved_scene(scene, FRICTION, 0.1, 1e-3), CREEP, -0.5, 1e-3)
    assert rubbing.friction == Friction(0.1, 0.005)
    sticking = replace(scene, friction=Friction(0.1, stick_stiffness_n_m=1e7))
    assert [can_move(one, CREEP) for one in (scene, rubbing, sticking)] == [False, True, False]
