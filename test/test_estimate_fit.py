"""Algebra of the fit: links between swings, normal equations and intervals."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from estimate_support import GROUPS, draw
from scipy.stats import truncnorm

from plow_twin.estimate import search
from plow_twin.estimate.arrow import Arrow
from plow_twin.estimate.fit import fit, link_weights, unmoved_span
from plow_twin.estimate.forward import Forward, Start
from plow_twin.estimate.result import Interval, State
from plow_twin.estimate.summary import summarise
from plow_twin.estimate.unknowns import BIAS, GAIN, GX, LEAST_CLEARANCE, MOVING, SIZE, SOFTNESS, Unknowns
from plow_twin.estimate.verdict import Verdict
from plow_twin.kernel.low_pass import lagged
from plow_twin.model.scene import Scene


def test_links_have_the_weight_of_white_acceleration_noise() -> None:
    rng = np.random.default_rng(4)
    span, drift, steps = 0.3, np.array([2.0, 0.5, 1.0]), 300
    rate = np.cumsum(rng.standard_normal((20_000, steps, 1)) * np.sqrt(span / steps), axis=1)
    added = np.hstack((rate.mean(axis=1) * span, rate[:, -1]))
    weights = link_weights(np.array([span]), drift)[0]
    for axis, density in enumerate(drift):
        covariance = np.linalg.inv(weights[np.ix_([axis, axis + 3], [axis, axis + 3])])
        assert covariance == pytest.approx(np.cov(added.T) * density, rel=0.05)


@pytest.mark.parametrize("moment", [0.0, 0.5])
def test_a_load_with_a_certain_component_limits_swings_by_the_other_components(moment: float) -> None:
    noise, drift = np.array([3e-4, 3e-4, 1e-3]), np.array([2.0, 0.5, moment])
    assert 2.0 * unmoved_span(noise, drift) ** 3 / 3.0 == pytest.approx(9e-8)  # the variance after white noise
    assert 0.0 < unmoved_span(noise, np.zeros(3)) < 10.0


@pytest.mark.parametrize("swings", [1, 2, 9])
def test_the_normal_equations_of_linked_swings_agree_with_dense_equations(swings: int) -> None:
    rng = np.random.default_rng(swings)
    arrow, size = Arrow.empty(3, swings), 3 + 6 * swings
    dense = np.zeros((size, size))
    for swing, count in [(index, 6) for index in range(swings)] + [(one, 12) for one in range(swings - 1)]:
        rows = rng.standard_normal((30, 3 + count))
        arrow.add(swing, rows.T @ rows)
        places = np.concatenate([np.arange(3), 3 + 6 * swing + np.arange(count)])
        dense[np.ix_(places, places)] += rows.T @ rows
    assert arrow.diagonal() == pytest.approx(np.diag(dense))
    more, right = rng.random(size), rng.standard_normal((size, 2))
    factor = arrow.plus(more).factorised()
    inverse = np.linalg.inv(dense + np.diag(more))
    assert factor.solve(right) == pytest.approx(inverse @ right, rel=1e-9, abs=1e-12)
    assert factor.covariance() == pytest.approx(inverse[:3, :3], rel=1e-9, abs=1e-12)


def test_a_low_pass_of_a_cubic_is_exact() -> None:
    tau, t = 0.03, np.linspace(0.01, 0.5, 50)
    powers = np.array([0.4, -2.0, 5.0, 30.0])
    place = np.polynomial.Polynomial(powers)
    rate, steady = place.deriv(), place - tau * place.deriv() + tau**2 * place.deriv(2) - tau**3 * place.deriv(3)
    start = np.full((1, 3), 0.7)
    q, v = (np.repeat(part(t)[:, None], 3, axis=1) for part in (place, rate))
    begin = np.full((1, 3), place(0.0)), np.full((1, 3), rate(0.0))
    out, slope = lagged(tau, np.array([0, len(t)]), np.zeros(1), *begin, start, t, q, v)
    expected = steady(t) + (0.7 - steady(0.0)) * np.exp(-t / tau)
    assert out == pytest.approx(np.repeat(expected[:, None], 3, axis=1), rel=1e-9)
    assert slope == pytest.approx((q - out) / tau)


def test_an_interval_ends_at_the_range_of_motion() -> None:
    cut = Interval.normal(0.025, 0.008).above(0.03)
    assert 0.03 < cut.p05 < cut.mean < cut.p95
    assert Interval.normal(0.025, 0.001).above(0.0) == Interval.normal(0.025, 0.001)
    for least in (-3.0, 0.0, 2.0, 20.0, 40.0):
        one, other = Interval.normal(0.0, 1.0).above(least), truncnorm(least, np.inf)
        assert (one.mean, one.p05, one.p95) == pytest.approx((other.mean(), *other.ppf([0.05, 0.95])), abs=2e-4)


def test_a_clearance_at_its_bound_is_not_observable() -> None:
    truth = draw(replace(GROUPS["plain"], periods=3.0), 2)
    unknowns = Unknowns(truth.nominal)
    forward = Forward(truth.nominal, truth.load)
    problem, fit_found = search.candidate(forward, unknowns, truth.poses, truth.load.period()) or (None, None)
    assert problem is not None and fit_found is not None
    shared = fit_found.shared.copy()
    shared[GX] = LEAST_CLEARANCE
    bound = replace(fit_found, point=replace(fit_found.point, shared=shared))
    for fitted, state in ((fit_found, State.ESTIMATED), (bound, State.NOT_OBSERVABLE)):
        result = summarise(problem, fitted, Verdict(broken=True))
        assert result.horizontal_state is state and result.vertical_state is State.ESTIMATED
    assert result.horizontal.p95 - result.horizontal.p05 > 5e-3


def test_a_wall_that_is_not_touched_is_behind_the_range_of_motion_minus_the_penetrations() -> None:
    truth = draw(replace(GROUPS["plain"], periods=3.0), 2)
    unknowns = Unknowns(truth.nominal)
    problem, fit_found = search.candidate(
        Forward(truth.nominal, truth.load), unknowns, truth.poses, truth.load.period()
    ) or (None, None)
    assert problem is not None and fit_found is not None
    contact, turn = fit_found.point.contact.copy(), np.array([0.0, 0.0, 0.1])
    contact[:, [1, 7]] = 0.0
    ends = []
    for bias in (0.0 * turn, turn):  # an angle of the sensor makes the range of motion larger
        window, shared = problem.window, fit_found.shared.copy()
        shared[BIAS] += bias
        problem.window = replace(window, poses=window.poses.moved(bias))
        point = replace(fit_found.point, contact=contact, shared=shared)
        result = summarise(problem, replace(fit_found, point=point), Verdict(broken=True))
        problem.window = window
        assert result.horizontal_state is State.NOT_OBSERVABLE
        ends.append(result.horizontal.p05)
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)
    assert 0.016 < ends[0] < truth.clearance[0], "the prior's interval begins at 0.012"


def test_a_change_without_effect_on_the_motion_has_no_derivative() -> None:
    """If mass, inertia, stiffness and load grow by the same factor, the motion is unchanged."""
    truth = draw(replace(GROUPS["plain"], periods=3.0), 2)
    unknowns, share = Unknowns(truth.nominal), 1e-5
    forward = Forward(truth.nominal, truth.load)
    problem, fit_found = search.candidate(forward, unknowns, truth.poses, truth.load.period()) or (None, None)
    assert problem is not None and fit_found is not None
    point, step = fit_found.point, np.zeros(SIZE)

    def heavier(scene: Scene) -> Scene:
        head = scene.head
        inertia, mass = head.inertia_kg_m2 * (1.0 + share), head.mass_kg * (1.0 + share)
        return replace(scene, head=replace(head, inertia_kg_m2=inertia, mass_kg=mass))

    stiffer = unknowns.stiffness_of(float(point.shared[SOFTNESS])) * (1.0 + share)
    step[SOFTNESS] = unknowns.softness_of(stiffer) - point.shared[SOFTNESS]
    step[GAIN] = share * point.shared[GAIN]
    moved = problem.evaluate(point.shared, point.states, change=heavier)
    assert moved is not None
    by_mass = np.nan_to_num(moved.predicted - point.predicted)
    remaining = by_mass + problem.with_fine_steps().linearise(point).rows[:, :, :SIZE] @ step
    assert (np.linalg.norm(remaining, axis=0) < 0.02 * np.linalg.norm(by_mass, axis=0)).all()


def test_motions_in_lanes_agree_with_motions_alone() -> None:
    """A motion that leaves the range of the model has no poses, and does not change the others."""
    truth = draw(replace(GROUPS["plain"], periods=1.0), 2)
    forward, unknowns, times = Forward(truth.nominal, truth.load), Unknowns(truth.nominal), truth.poses.t
    starts = []
    for stiffness in (3e9, 1e3, 1e7):
        scene = unknowns.scene_of(unknowns.nominal())
        scene = replace(scene, contact=replace(scene.contact, stiffness=stiffness))
        starts.append(Start(scene, np.array([1.0, 0.9, 1.1]), np.array([1e-3, 0.0, 0.0, 0.1, 0.0, 0.0])))
    together, edges = forward.run_many(starts, 0.0, times), np.array([0, len(times)])
    alone = [forward.run(start.scene, start.gain, np.zeros(1), start.state[None], edges, times) for start in starts]
    assert together[1] is None and alone[1] is None
    assert together[2] == pytest.approx(alone[2].q, abs=1e-5)
    early = times < 0.3  # a hard contact forgets its start
    assert together[0][early] == pytest.approx(alone[0].q[early], abs=1e-5)


@pytest.mark.parametrize(("group", "least", "most"), [("plain", 3, 4), ("noisy", 8, 11)])
def test_equal_results_of_different_starts_end_the_search(
    group: str, least: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """If two starts lead to the same optimum, no third start is fitted. With noise, all six starts are fitted."""
    truth = draw(replace(GROUPS[group], periods=3.0), 2)
    fitted = Mock(side_effect=fit)
    monkeypatch.setattr(search, "fit", fitted)
    forward, unknowns = Forward(truth.nominal, truth.load), Unknowns(truth.nominal)
    problem, fit_found = search.candidate(forward, unknowns, truth.poses, truth.load.period()) or (None, None)
    assert problem is not None and fit_found is not None
    assert least <= fitted.call_count <= most
    # one call gives the derivatives with respect to all six initial values; each other unknown needs one call
    run = Mock(side_effect=forward.run)
    monkeypatch.setattr(forward, "run", run)
    problem.linearise(fit_found.point)
    swings = problem.window.swings
    assert sorted(len(call.args[3]) for call in run.call_args_list) == [swings] * len(MOVING) + [6 * swings]
