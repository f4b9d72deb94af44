"""The estimate of a hard contact, by comparison with simulated motions for random parameters."""

from __future__ import annotations

import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from estimate_support import GROUPS, draw, known
from numpy.typing import NDArray
from scenes import preset

from plow_twin.estimate import tuning
from plow_twin.estimate.bouncing import (
    Bounced,
    MotionFeatures,
    bias_of_hard,
    class_deviate,
    hidden_by_geometry,
    path_delay,
    path_deviate,
    regress_near,
)
from plow_twin.estimate.combined import with_bounced
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.forces import draw_scenes
from plow_twin.estimate.laws import Draws, log_odds
from plow_twin.estimate.likely import PathFeatures, likeliest
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.summary import MOST_OTHER_LAW, summarise_bounced
from plow_twin.estimate.unknowns import Unknowns
from plow_twin.model.scene import Mark, Provenance


@pytest.mark.stress
def test_a_hard_contact_is_estimated_by_its_bounces() -> None:
    truth = draw(GROUPS["hard"], 1)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert "distance" in result.figures, "the bounces were compared"
    assert (result.model, result.sensor) == ("ok", "ok"), result.reasons
    # the other law is so unlikely that half of its planned simulations are sufficient
    assert result.figures["law_odds"] < tuning.CLEAR_ODDS[0]
    assert result.figures["work"] < tuning.MOST_WORK[1] + 0.5 * tuning.MOST_WORK[2]
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < 1.5 * (value.p95 - value.p05)
    assert result.stiffness.p05 < truth.scene.contact.stiffness < result.stiffness.p95


def test_the_deviate_of_a_path_is_normal_for_a_correct_model_and_large_for_a_wrong_model() -> None:
    """Correct paths scatter widely along a few common directions, so a correct path may be far from the mean.

    A wrong path deviates in another direction, and is detected although its mean square over the phases is smaller.
    """
    rng = np.random.default_rng(5)
    modes, slopes = rng.standard_normal((3, 60)), rng.standard_normal((14, 60))
    across = rng.standard_normal(60)
    across -= modes.T @ np.linalg.lstsq(modes.T, across, rcond=None)[0]

    def run(count: int, about: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        features = about * rng.standard_normal((count, 14))
        common = rng.standard_t(5, (count, 3)) @ modes
        return features, features @ slopes + common + 0.1 * rng.standard_normal((count, 60))

    right, wrong = [], []
    for _ in range(16):
        features, paths = run(90)
        drawn = [np.tile(path, (9, 1)) for path in paths]
        (measured,), (path,) = run(1, 0.5)
        right.append(path_deviate(np.tile(path, (11, 1)), features, drawn, measured))
        wrong.append(path_deviate(np.tile(path + 2.5 * across, (11, 1)), features, drawn, measured))
    assert np.mean(np.array(right) > tuning.MOST_PATH) < 0.06
    assert abs(np.mean(right)) < 0.8 and np.std(right) < 1.6
    assert np.mean(np.array(wrong) > tuning.MOST_PATH) > 0.9


def test_a_method_that_disagrees_widens_the_interval() -> None:
    values = {"horizontal": Interval.normal(0.03, 3e-5), "vertical": Interval.normal(0.02, 3e-5)}
    fitted = replace(known()[0][1], **values, apparent=None)
    clearances, zero, deviation = np.array([0.03003, 0.0204]), np.zeros(3), np.full(2, 4e-5)
    bounced = Bounced(clearances, deviation, zero, zero, (-7.0, 0.1), (0.0, 0.1), zero, 0.2, 0.0, 0.0, -np.inf)
    both = with_bounced(fitted, bounced, 0)
    assert both.horizontal.deviation == pytest.approx(2.4e-5)
    assert both.horizontal.mean == pytest.approx(0.0300108)
    # the two vertical results differ by 8 deviations, so the interval is widened to contain both
    assert both.vertical.p05 < 0.0201 and both.vertical.p95 > 0.0202
    assert both.vertical.deviation == pytest.approx(8.0 * 2.4e-5)
    unlike = with_bounced(fitted, replace(bounced, distance=2.0 * tuning.MOST_DISTANCE), 0)
    assert (unlike.horizontal, unlike.vertical) == (fitted.horizontal, fitted.vertical)


@pytest.mark.parametrize("turn", [0.0, -0.1])
def test_the_bias_of_a_sensor_with_a_hard_contact_is_found(turn: float) -> None:
    """An undetected angle of half a degree would withdraw the estimate. 9 mm along y would cause an error of 1 mm."""
    truth = draw(replace(GROUPS["hard"], periods=4.0), 3)
    bias = np.array([1e-3, -9e-3, turn])
    found = bias_of_hard(Unknowns(truth.nominal), truth.poses.moved(bias))
    assert (np.abs(found - bias) < [5e-4, 5e-4, 1.5e-3]).all()


def test_a_bias_hardly_changes_the_other_features_of_a_hard_motion() -> None:
    """A remaining angle of 3e-4 rad would separate the measured motion from the simulated motions."""
    truth = draw(replace(GROUPS["hard"], periods=4.0), 3)
    motion_features = MotionFeatures(Unknowns(truth.nominal), truth.poses, truth.load.period())
    bias = np.array([1e-4, -1e-4, 6e-4])
    plain, moved = motion_features.features(motion_features.q), motion_features.features(motion_features.q + bias)
    np.testing.assert_allclose(moved[2:5] - plain[2:5], bias, atol=5e-5)
    np.testing.assert_allclose(moved[:2], plain[:2], atol=3e-6)
    np.testing.assert_allclose(moved[5:], plain[5:], rtol=0.02, atol=1e-5)


def test_the_delay_is_the_lag_at_which_the_measured_path_is_nearest_to_drawn_paths() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(2000) * 0.01

    def seen(delay: float) -> NDArray[np.float64]:
        phase = 2.0 * np.pi * (t - delay) / 2.0
        path = 1e-2 * np.stack([np.sin(phase), np.cos(2.0 * phase), np.sin(3.0 * phase)], axis=1)
        return np.asarray(path + 1e-3 * rng.standard_normal((len(t), 3)))

    motion_features = MotionFeatures(Unknowns(preset("paper")), Poses.of(t, seen(0.05))[0], 2.0)
    features, drawn = rng.standard_normal((40, 3)), [seen(0.0) for _ in range(40)]
    assert path_delay(motion_features, features, drawn, np.zeros(3)) == pytest.approx(0.05, abs=3e-3)


def test_a_classifier_of_drawn_motions_finds_another_law() -> None:
    """The classes differ in one direction, in which they scatter little. No single feature separates them."""
    rng = np.random.default_rng(5)
    across = np.array([1.0, -1.0, 0.0, 0.0, 0.0, 0.0]) / np.sqrt(2.0)

    def like(count: int, label: float) -> NDArray[np.float64]:
        common = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        rows = 0.1 * rng.standard_normal((count, 6)) + rng.standard_normal((count, 1)) * common
        return np.asarray(rows + 0.4 * label * across)

    own, other = like(100, 0.0), like(60, 1.0)
    right = np.array([class_deviate(own, other, row) for row in like(100, 0.0)])
    wrong = np.array([class_deviate(own, other, row) for row in like(100, 1.0)])
    assert abs(right.mean()) < 0.4
    assert right.std() == pytest.approx(1.0, abs=0.3)
    assert (right > MOST_OTHER_LAW).mean() < 0.05
    assert (wrong > MOST_OTHER_LAW).mean() > 0.8


def test_log_odds_find_another_law_even_if_drawn_numbers_have_more_effect() -> None:
    """The parameters move the features along a curve, ten times as far as law and noise do."""
    rng = np.random.default_rng(5)
    slope, curve, apart = rng.standard_normal((3, 40))

    def motions(count: int, law: float, spread: float = 1.0) -> Draws:
        drawn = spread * rng.standard_normal((count, 7))
        like = 2.0 * np.outer(drawn[:, 0], slope) + np.outer(drawn[:, 0] ** 2 + drawn[:, 1], curve)
        return Draws(like + 0.1 * law * apart + 0.1 * rng.standard_normal(like.shape), drawn)

    own, other = motions(100, 0.0), motions(60, 1.0)
    right, wrong = (np.array([log_odds(own, other, row) for row in motions(100, law, 0.6).like]) for law in (0.0, 1.0))
    assert (right > tuning.MOST_ODDS[0]).mean() < 0.03
    assert (wrong > tuning.MOST_ODDS[0]).mean() > 0.97


@pytest.mark.stress
def test_a_hard_contact_is_estimated_from_a_sensor_with_bias_delay_and_gaps() -> None:
    truth = draw(GROUPS["hard_sensor"], 25_003)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert (result.model, result.sensor) == ("ok", "ok"), result.reasons
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < 2e-4


def test_a_contact_of_any_hardness_gives_finite_numbers() -> None:
    """The extrapolation of a regression can give a softness of e^800 m, for which JSON has no number."""
    unknowns = Unknowns(preset("paper"))
    poses, _ = Poses.of(np.arange(100) * 0.01, np.zeros((100, 3)))
    two = np.full(2, 1e-2)
    bounced = Bounced(two, two, np.zeros(3), np.ones(3), (-8.0, 500.0), (0.0, 1.0), np.ones(3), 1.0, 1.0, 0.0, -np.inf)
    text = json.dumps(summarise_bounced(unknowns, poses, bounced, 0).as_dict(), allow_nan=False)
    assert json.loads(text)["stiffness"]["p95"] > 1e9


@pytest.mark.parametrize(
    ("deviate", "odds", "model"),
    [(2.5, -5.0, "suspect"), (2.5, -np.inf, "suspect"), (2.5, -44.0, "ok"), (2.0, -44.0, "ok"), (0.0, -2.0, "suspect")],
)
def test_a_motion_like_those_of_another_law_is_suspect_unless_that_law_is_unlikely(
    deviate: float, odds: float, model: str
) -> None:
    moved = np.random.default_rng(1).standard_normal((100, 3))
    two, poses = np.full(2, 1e-3), Poses.of(np.arange(100) * 0.01, 1e-3 * moved)[0]
    logarithms = (-8.0, 0.5), (0.0, 1.0)
    bounced = Bounced(two, 0.1 * two, np.zeros(3), np.ones(3), *logarithms, np.ones(3), 1.0, 1.0, deviate, odds)
    assert summarise_bounced(Unknowns(preset("paper")), poses, bounced, 0).model == model


def test_quantities_hidden_by_a_hard_motion_widen_the_clearances_and_not_the_twins() -> None:
    """Corners rounded by 5 mm make the estimated clearances 0.7 mm too large, which is ten standard deviations."""
    truth = draw(replace(GROUPS["hard"], periods=4.0), 3)
    unknowns, period = Unknowns(truth.nominal), truth.load.period()
    motion_features = MotionFeatures(unknowns, truth.poses, period)
    unseen, rounded = hidden_by_geometry(unknowns, truth.poses, period, motion_features.features(motion_features.q)[:2])
    assert (unseen > 1.5e-4).all() and (rounded > 3e-4).all()
    zero, narrow = np.zeros(3), np.full(2, 5e-5)
    found = (-12.0, 1.0), (0.0, 1.0), np.ones(3), 1.0, 1.0, 0.0, -np.inf
    bounced = Bounced(truth.clearance, narrow, zero, zero, *found, unseen, rounded)
    result = summarise_bounced(unknowns, truth.poses, bounced, 0)
    below, above = (abs(end - result.horizontal.mean) for end in (result.horizontal.p05, result.horizontal.p95))
    assert below > 1.9 * rounded[0] and below > 1.1 * above
    assert result.apparent is not None and result.apparent[0].deviation == pytest.approx(5e-5)
    back = Estimate.from_dict(json.loads(json.dumps(result.as_dict())))
    assert back.apparent == result.apparent
    scenes, _ = draw_scenes(truth.nominal, back, 50, np.random.default_rng(0))
    assert np.std([scene.clearance.horizontal_m for scene in scenes]) < 7e-5
    # the stated deviation of the sides covers the corners too, so that rounded corners add no variance
    exact = Provenance(Mark.MEASURED, deviation=0.0)
    marks = {**truth.nominal.marks, "frame.width_m": exact, "frame.height_m": exact}
    stated = replace(unknowns, scene=replace(truth.nominal, marks=marks))
    unseen, rounded = hidden_by_geometry(stated, truth.poses, period, motion_features.features(motion_features.q)[:2])
    assert not rounded.any() and (unseen > 7e-4).all(), "scales of the sensor and turned walls are left"


def test_a_hard_motion_unlike_the_model_is_rough() -> None:
    rng = np.random.default_rng(1)
    poses = Poses.of(np.arange(100) * 0.01, 1e-3 * rng.standard_normal((100, 3)))[0]
    found = (-12.0, 1.0), (0.0, 1.0), np.ones(3), 2.0 * tuning.MOST_DISTANCE, 1.0, 0.0, -np.inf
    bounced = Bounced(np.full(2, 0.02), np.full(2, 5e-5), np.zeros(3), np.zeros(3), *found)
    result = summarise_bounced(Unknowns(preset("paper")), poses, bounced, 0)
    assert result.model == "suspect" and result.horizontal_state is State.ROUGH
    assert result.horizontal.deviation > 2.0 * tuning.UNEXPLAINED_HARD


@pytest.mark.parametrize(("deviation", "horizontal"), [(1e-4, State.ESTIMATED), (5e-4, State.NOT_OBSERVABLE)])
def test_a_clearance_whose_walls_do_not_limit_the_motion_is_not_observable(deviation: float, horizontal: State) -> None:
    """The other clearance is not observable either if it is rough."""
    poses = Poses.of(np.arange(100) * 0.01, 1e-3 * np.random.default_rng(1).standard_normal((100, 3)))[0]
    found = (-7.0, 1.0), (0.0, 1.0), np.ones(3), 1.0, 1.0, 0.0, -np.inf
    two = np.full(2, 0.02), np.full(2, deviation)
    bounced = Bounced(*two, np.zeros(3), np.zeros(3), *found, follows=np.array([0.9, 0.4]))
    result = summarise_bounced(Unknowns(preset("paper")), poses, bounced, 0)
    assert (result.horizontal_state, result.vertical_state) == (horizontal, State.NOT_OBSERVABLE)
    assert result.reasons[-1] == "vertical clearance not observable: the reach follows 40% of a clearance, expected 50%"


def test_a_clearance_at_its_bound_is_not_observable() -> None:
    rng = np.random.default_rng(1)
    poses = Poses.of(np.arange(100) * 0.01, 1e-3 * rng.standard_normal((100, 3)))[0]
    found = np.zeros(3), np.zeros(3), (-12.0, 1.0), (0.0, 1.0), np.ones(3), 1.0, 1.0, 0.0, -np.inf
    two = np.full(2, 0.02)
    bounced = Bounced(np.array([-2e-3, 0.02]), np.full(2, 5e-5), *found)
    result = summarise_bounced(Unknowns(preset("paper")), poses, bounced, 0)
    assert result.horizontal_state is State.NOT_OBSERVABLE and result.vertical_state is State.ESTIMATED
    assert result.horizontal.p95 - result.horizontal.p05 > 0.02
    contact = np.ones((4, 8))
    contact[:, [4, 6]] = 0.0  # the head never touches the bottom
    first = Mock(point=Mock(contact=contact))
    result = summarise_bounced(Unknowns(preset("paper")), poses, replace(bounced, clearance=two), 0, first)
    assert result.horizontal_state is State.ESTIMATED and result.vertical_state is State.NOT_OBSERVABLE


def test_the_most_likely_clearances_are_found_from_few_drawn_motions() -> None:
    """The clearances of each simulated motion are found like those of a new motion, for all parameters and delays."""
    rng = np.random.default_rng(5)
    slopes, curve, common, late = (rng.standard_normal((rows, 150)) for rows in (7, 1, 3, 1))
    scale, middle = np.array([3e-4, 3e-4, 0.3, 0.3, 0.06, 0.06, 0.06]), np.array([0.02, 0.03, -7.0, 0.0, 1.0, 1.0, 1.0])

    def motions(count: int) -> tuple[np.ndarray, PathFeatures]:
        points = rng.standard_normal((count, 7))
        like = points @ slopes + (points[:, :1] * points[:, 2:3]) @ curve + rng.standard_normal((count, 3)) @ common
        like += 2e-3 * rng.standard_normal((count, 1)) @ (200.0 * late) + rng.standard_normal(like.shape)
        return middle + scale * points, PathFeatures(like, np.tile(200.0 * late, (count, 1)))

    drawn, measured_motions = motions(120)
    fresh, others = motions(60)
    rows = zip(others.like[:, None], others.late[:, None], strict=True)
    clearances = np.array([likeliest(drawn, 0.06, measured_motions, PathFeatures(*row))[-1] for row in rows])
    off = (clearances - fresh[:, :2]).std(axis=0)
    of_drawn = (likeliest(drawn, 0.06, measured_motions, motions(1)[1])[:-1] - drawn[:, :2]).std(axis=0)
    assert (off < 0.15 * scale[:2]).all()
    assert of_drawn == pytest.approx(off, rel=0.25)


def test_the_regression_gives_the_value_at_the_measured_features() -> None:
    rng = np.random.default_rng(5)
    features = rng.standard_normal((200, 3))
    targets = np.stack([2.0 + features @ [1.0, -1.0, 0.0], features[:, 2] ** 2], axis=1)
    targets[:, 0] += 0.1 * rng.standard_normal(200)
    found = regress_near(features, targets, np.array([0.5, 0.2, 0.0]))
    assert found.value[0] == pytest.approx(2.3, abs=0.1)
    assert 0.05 < found.deviation[0] < 0.2
    # the relation is partly nonlinear, and the deviation includes the nonlinear part
    assert found.deviation[1] > 0.2
    assert found.distance < 1.5 < regress_near(features, targets, np.full(3, 6.0)).distance
