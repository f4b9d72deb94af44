"""Gap sensors in addition to poses, or instead of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import Truth, draw, known
from scenes import gaps_at

from plow_twin.estimate.combined import with_gaps
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.gaps import Gaps, GapsError, GapsFit, fit_gaps
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import State
from plow_twin.model.pairs import PAIR_NAMES

SENSOR_ERROR = 1e-4


@pytest.fixture(scope="module")
def gapped() -> tuple[Truth, np.ndarray]:
    """Return a simulated machine and measured gaps of all pairs, with constant errors, noise and missing times."""
    truth = known()[0][0]
    still = draw(replace(truth.group, noise_m=0.0), 2).poses.q
    rng = np.random.default_rng(6)
    gap = gaps_at(truth.scene, still) + 3e-4 * rng.standard_normal((len(still), 8))
    return truth, gap + SENSOR_ERROR * rng.standard_normal(8)


@pytest.mark.parametrize("pairs", [range(8), (0, 1, 3, 6, 7), (0, 1, 3, 6)])
def test_gaps_give_the_clearances_without_a_contact_model(
    gapped: tuple[Truth, np.ndarray], pairs: tuple[int, ...]
) -> None:
    truth, gap = gapped
    some = np.full_like(gap, np.nan)
    some[:, list(pairs)] = gap[:, list(pairs)]
    gaps, _ = Gaps.of(truth.poses.t, some)
    gap_fit = fit_gaps(truth.nominal, gaps, truth.poses)
    assert isinstance(gap_fit, GapsFit)
    assert (np.abs(gap_fit.clearance - truth.clearance) < 3.0 * gap_fit.deviation).all() and (
        gap_fit.deviation < 1.5e-4
    ).all()
    assert len(gap_fit.poses.t) == (len(gap) if len(pairs) > 4 else 0)
    if len(pairs) > 4:
        assert np.abs(np.median(gap_fit.poses.q - truth.poses.q, axis=0)).max() < 1e-3
    assert gap_fit.groups.keys() == ({"horizontal_top", "vertical_left"} if len(pairs) < 8 else set(gap_fit.groups))
    for name, value in gap_fit.groups.items():
        true = truth.clearance[0 if name.startswith("horizontal") else 1]
        assert abs(value.mean - true) < 4.0 * SENSOR_ERROR


def test_gaps_that_do_not_determine_the_clearances_are_not_used_and_the_reason_names_the_sensors(
    gapped: tuple[Truth, np.ndarray],
) -> None:
    truth, gap = gapped
    gap = gap.copy()
    gap[:, [3, 5]] = np.nan  # there is no gap sensor at the right wall
    gaps, _ = Gaps.of(truth.poses.t, gap)
    names = ", ".join(PAIR_NAMES[pair] for pair in (0, 1, 2, 4, 6, 7))
    reason = f"gaps: got sensors at {names}, expected five pairs that determine theta, or one pair at each wall"
    assert fit_gaps(truth.nominal, gaps, truth.poses) == reason
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t[:0], truth.poses.q[:0]), gaps=gaps)
    assert result.horizontal_state is State.PRIOR and result.reasons[-1] == reason
    few, _ = Gaps.of(truth.poses.t[:9], gapped[1][:9])
    assert str(fit_gaps(truth.nominal, few, truth.poses)).endswith("expected at least 20")
    late = few.between(1e6, 2e6)
    assert fit_gaps(truth.nominal, late, truth.poses) == "gaps: got no message within the load's span"
    with pytest.raises(GapsError, match=r"gap \(4, 3\), expected \(n,\) and \(n, 8\)"):
        Gaps.of(np.arange(4.0), np.zeros((4, 3)))


def test_gaps_with_theta_alone_give_the_clearances_and_the_reason_names_the_missing_components(
    gapped: tuple[Truth, np.ndarray],
) -> None:
    """With four sensors, theta is taken from the poses, so the gaps alone give no pose."""
    truth, gap = gapped
    four, q = np.full_like(gap, np.nan), truth.poses.q.copy()
    four[:, [0, 1, 3, 6]], q[:, :2] = gap[:, [0, 1, 3, 6]], np.nan
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, q), gaps=Gaps.of(truth.poses.t, four)[0])
    assert result.horizontal_state is result.vertical_state is State.ESTIMATED
    assert result.reasons == tuple(f"{name}: measured 0 times, expected at least 20" for name in "xy")


def test_gaps_without_a_pose_give_an_estimate_and_a_shifted_gap_is_found(gapped: tuple[Truth, np.ndarray]) -> None:
    truth, gap = gapped
    gaps, lost = Gaps.of(truth.poses.t, gap)
    nothing, _ = Poses.of([], np.zeros((0, 3)))
    result = estimate(truth.nominal, truth.load, nothing, lost, gaps)
    assert (result.horizontal_state, result.model, result.sensor) == (State.ESTIMATED, "ok", "ok")
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < 1e-4 and value.p95 - value.p05 < 3e-4
    shifted = gap.copy()
    shifted[:, 1] += 2e-3
    gap_fit = fit_gaps(truth.nominal, Gaps.of(truth.poses.t, shifted)[0], truth.poses)
    assert isinstance(gap_fit, GapsFit) and gap_fit.contradiction > 5.0
    result = with_gaps(known()[0][1], gap_fit)
    assert result.horizontal_state is result.vertical_state is State.WITHDRAWN and result.sensor == "suspect"
    assert "gaps:" in result.reasons[0]
