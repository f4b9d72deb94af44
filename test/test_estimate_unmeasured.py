"""Clearances from poses that lack one or two components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import KINDS, known, mismatched

from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import State


@pytest.mark.parametrize(
    ("kept", "deviation", "reasons", "most"),
    [
        pytest.param(
            (None,) * 3, (0.0, 1.0, 0.0), ("y: stated deviation 1, expected at most 0.05",), 2e-4, id="y",
            marks=pytest.mark.stress,
        ),
        pytest.param((None, None, 7), (0.0,) * 3, ("theta: measured 7 times, expected at least 20",), 4e-4, id="theta"),
        pytest.param(
            (0, 0, None), (0.0,) * 3, tuple(f"{name}: measured 0 times, expected at least 20" for name in "xy"), 1e-3,
            id="x and y", marks=pytest.mark.stress,
        ),
    ],
)  # fmt: skip
def test_the_load_gives_clearances_if_components_are_missing(
    kept: tuple[int | None, ...], deviation: tuple[float, float, float], reasons: tuple[str, ...], most: float
) -> None:
    """A component with few values, or with a large stated deviation, is treated as not measured."""
    truth, _ = known()[0]
    q = truth.poses.q.copy()
    for column, count in zip(q.T, kept, strict=True):
        column[len(q) if count is None else count :] = np.nan
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, q, deviation))
    assert result.horizontal_state is result.vertical_state is State.ESTIMATED and result.model == "ok"
    assert result.reasons == reasons
    assert result.motion is not None and np.isfinite(result.motion.model).mean() > 0.9
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert value.deviation < most and abs(value.mean - true) < 3.0 * value.deviation


def test_a_machine_whose_load_does_not_explain_the_motion_gives_no_narrow_interval() -> None:
    truth = mismatched(replace(KINDS["load_5"], periods=5.0), 501)
    q = truth.poses.q.copy()
    q[:, 1] = np.nan
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, q))
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < 3.0 * value.deviation


@pytest.mark.stress
def test_a_start_is_improved_even_if_its_neighbours_cannot_be_simulated() -> None:
    """The drawn start of this machine has unknowns whose derivatives come from the prior alone."""
    truth = mismatched(KINDS["no_theta"], 99004)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is result.vertical_state is State.ESTIMATED
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert value.deviation < 1e-3 and abs(value.mean - true) < 3.0 * value.deviation
