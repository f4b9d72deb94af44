"""Harmonics that are missing in the measured load."""

from __future__ import annotations

import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from estimate_support import GROUPS, KINDS, Truth, draw, mismatched

from plow_twin import simulate
from plow_twin.estimate import estimate as estimating
from plow_twin.estimate import lacking
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.follow import Follower
from plow_twin.estimate.forces import forces_of
from plow_twin.estimate.harmonics import Harmonics, frequency
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.result import Estimate, State
from plow_twin.solve.state import ROW
from plow_twin.stream.journal import Estimated, Pose, Sample
from plow_twin.stream.session import Session

OMEGA = 2.0
#: Amplitude of the third harmonic, relative to the amplitude of the load.
SHARE = 0.1


@pytest.fixture(scope="module")
def truth() -> Truth:
    return draw(replace(GROUPS["plain"], periods=4.0, third_harmonic=SHARE), 3)


@pytest.fixture(scope="module")
def found(truth: Truth) -> Estimate:
    return estimate(truth.nominal, truth.load, truth.poses)


@pytest.mark.parametrize("span", [6.6, 11.0, 32.0])
def test_the_frequency_of_a_load_is_found_within_a_window_of_two_periods(span: float) -> None:
    t = np.arange(0.0, span, 0.01)
    wave = np.sin(OMEGA * t + 0.3) + 0.1 * np.sin(3.0 * OMEGA * t)
    wrench = np.array([3e3, 0.0, 1e3]) + np.outer(wave, [32e3, -11e3, -45e3])
    assert frequency(Load(t, wrench)) == pytest.approx(OMEGA, rel=2e-3)


def test_a_load_without_two_periods_has_no_frequency() -> None:
    t = np.arange(0.0, 6.0, 0.01)
    noise = np.random.default_rng(1).standard_normal((len(t), 3))
    assert frequency(Load(t, np.outer(np.sin(OMEGA * t), [32e3, 0.0, 0.0]))) is None
    assert frequency(Load(t, noise)) is None
    assert Harmonics.of(Load(t, noise)) is None


def test_a_missing_third_harmonic_of_the_load_is_found(truth: Truth, found: Estimate) -> None:
    assert found.model == "suspect" and "at 3 times its frequency" in found.reasons[0]
    assert found.horizontal_state is found.vertical_state is State.ROUGH
    for value, true in zip((found.horizontal, found.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < min(3.0 * value.deviation, 3e-4)
    harmonics = found.load_harmonics
    assert harmonics is not None and harmonics.omega == pytest.approx(OMEGA, rel=1e-4)
    third = 1 + 2 * harmonics.multiples.index(3)
    wave = harmonics.amplitude[third : third + 2, 2] / SHARE
    assert wave == pytest.approx([np.cos(1.0), np.sin(1.0)], abs=0.1)


def test_harmonics_are_restored_from_json_with_their_phases(found: Estimate) -> None:
    harmonics = found.load_harmonics
    assert harmonics is not None
    data = json.loads(json.dumps(found.as_dict()))
    t = np.linspace(0.0, 4.0, 50)
    back = Estimate.from_dict(data).load_harmonics
    assert back is not None and back.at(t) == pytest.approx(harmonics.at(t), abs=1e-6)
    data["load_harmonics"]["begin_s"] = 1.5
    later = Estimate.from_dict(data).load_harmonics
    assert later is not None and later.at(t + 1.5) == pytest.approx(back.at(t), abs=1e-6)
    units = harmonics.in_units(4.0, 0.5, 2.0)
    assert units.at(2.0 * t) == pytest.approx(harmonics.at(t) * [4.0, 4.0, 2.0])


def test_a_load_that_explains_the_motion_is_fitted_without_harmonics(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = Mock(side_effect=estimating.with_harmonics)
    monkeypatch.setattr(estimating, "with_harmonics", fitted)
    truth = draw(replace(GROUPS["plain"], periods=4.0), 3)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.model == "ok" and result.load_harmonics is None and "load_harmonics" not in result.as_dict()
    assert fitted.call_count == 0


def test_harmonics_are_found_where_the_residuals_do_not_repeat_with_the_load() -> None:
    """The motion differs from period to period, so the residuals without the harmonics differ too."""
    truth = draw(replace(GROUPS["plain"], third_harmonic=SHARE), 78000)
    load, poses = truth.load, truth.poses.between(0.0, 10.0)
    result = estimate(truth.nominal, Load(load.t[:1001], load.wrench[:1001]), poses)
    assert result.load_harmonics is not None
    assert abs(result.vertical.mean - truth.clearance[1]) < 3e-4


def test_harmonics_that_explain_nothing_are_dropped_before_whole_swings_are_fitted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stages = Mock(side_effect=lacking.Problem)
    monkeypatch.setattr(lacking, "Problem", stages)
    truth = mismatched(replace(KINDS["load_5"], periods=6.0), 97001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.model == "suspect" and result.load_harmonics is None
    horizons = [call.kwargs["horizon"] for call in stages.call_args_list]
    assert horizons and np.isfinite(horizons).all()


def _error(force: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(((force - true) ** 2).sum() / (true**2).sum()))


def test_twins_follow_with_the_harmonics_of_their_window(truth: Truth, found: Estimate) -> None:
    """The window begins 1.5 s before the first sample of the session, whose state is unchanged, bit for bit."""
    text, begin, end = json.dumps(found.as_dict()), 150, 700
    run = simulate(truth.scene, end * 0.01, 0.01, 1e-6)
    errors = {}
    for name in ("with", "without"):
        data = json.loads(text)
        if name == "without":
            del data["load_harmonics"]
        follower = Follower(truth.nominal, 32)
        session = Session(follower)
        stamps = np.round(truth.load.t * 1e9).astype(np.int64).tolist()
        session.apply(Sample(stamps[begin], tuple(truth.load.wrench[begin])))
        session.apply(Estimated(0, 1, 1, 1, (), (0.0,) * 6, json.dumps(data)))
        rows = np.zeros(end, ROW)
        for index in range(begin + 1, end):
            session.apply(Pose(stamps[index - 1], tuple(truth.poses.q[index - 1])))
            rows[index] = session.apply(Sample(stamps[index], tuple(truth.load.wrench[index])))[0]
            if index == 500:
                saved, same = follower.snapshot(), Follower(truth.nominal, 32)
                same.restore(saved)
                assert same.digest() == follower.digest()
                again = [one.advance(follower.time + 0.01, truth.load.wrench[501]) for one in (same, follower)]
                assert np.array_equal(again[0].rows, again[1].rows)
                follower.restore(saved)
        errors[name] = _error(rows["force"][400:], run.force[400:end])
    assert errors["with"] < 0.04 and errors["with"] < 0.5 * errors["without"]


def test_forces_from_the_estimate_include_the_harmonics(truth: Truth, found: Estimate) -> None:
    run = simulate(truth.scene, float(truth.load.t[-1]), 0.01, 1e-6)
    late = truth.load.t > 3.0
    for result, least, most in ((found, 0.0, 0.1), (replace(found, load_harmonics=None), 0.2, 9.0)):
        forces = forces_of(truth.nominal, result, truth.load, 20, 3.0)
        at_forces = np.isin(truth.load.t, forces.t) & late
        error = _error(
            forces.force[1][np.isin(forces.t, truth.load.t[at_forces])], run.force[: len(truth.load.t)][at_forces]
        )
        assert least < error < most
