"""Frames that yield to the contact forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from estimate_support import KINDS, mismatched
from mismatched_machine import Machine, poses_of
from scenes import preset

from plow_twin.estimate.compliance import by_compliance
from plow_twin.estimate.discrepancy import _halves
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.fit import Problem, Window
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import NORMAL_P95
from plow_twin.estimate.unknowns import Unknowns
from plow_twin.model.loads import compile_loads


def test_the_derivative_with_respect_to_the_compliance_agrees_with_another_integrator() -> None:
    paper, t = preset("paper"), np.arange(0.0, 3.0, 1e-3)
    contact = replace(paper.contact, law="hunt_crossley", stiffness=1.5e7, exponent=1.0, damping=0.7)
    scene, wrench, stiff = replace(paper, contact=contact), compile_loads(paper.loads).at(t), 4e9
    fixed, yielding = (
        poses_of(scene, Machine(np.ones(8), np.zeros(8), spring=spring), t, wrench, t[::10]) for spring in (0.0, stiff)
    )
    unknowns = Unknowns(scene)
    window = Window(Poses(t[::10], fixed), np.array([0.0, 3.0]), np.zeros((1, 6)))
    problem = Problem(Forward(scene, Load(t, wrench)), unknowns, window)
    point = problem.evaluate(unknowns.nominal(), window.states)
    assert point is not None and np.nanmax(np.abs(point.residual)) < 1e-5
    derivative, true = by_compliance(problem, point), stiff * (yielding - fixed)
    assert derivative is not None
    error, size = derivative - true, true.std(axis=0)
    assert (error.std(axis=0) < 0.1 * size).all(), error.std(axis=0) / size


def test_a_frame_on_springs_is_found_and_intervals_contain_the_truth() -> None:
    truth = mismatched(KINDS["spring"], 30403)
    result = estimate(truth.nominal, truth.load, truth.poses)
    probability, compliance, _ = result.differs["compliance"]
    assert probability > 0.9 and 0.5 < compliance * KINDS["spring"].spring < 1.5
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        # with a fixed frame, both errors are 0.12 mm
        assert value.p05 <= true <= value.p95 and abs(value.mean - true) < 6e-5


def test_the_halves_of_a_clearance_have_the_quantiles_of_its_samples() -> None:
    rng = np.random.default_rng(0)
    means, deviations = np.array([[0.0, 1.0]] * 9 + [[-5.0, 1.0]]), np.array([[1.0, 0.5]] * 10)
    drawn = means + deviations * rng.standard_normal((40_000, 10, 2))
    mean = means.mean(axis=0)
    below, above = _halves(mean, means, deviations)
    low, high = np.quantile(drawn.reshape(-1, 2), (0.05, 0.95), axis=0)
    assert np.allclose([mean - NORMAL_P95 * below, mean + NORMAL_P95 * above], [low, high], atol=0.05)
    assert np.allclose([below[1], above[1]], 0.5, rtol=1e-4)
