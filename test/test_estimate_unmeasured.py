"""Clearances from poses that lack one or two components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import KINDS, known, mismatched

from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import Estimate, State

COMPONENTS = ("x", "y", "theta")


def _without(*missing: int) -> tuple[Estimate, tuple[float, float]]:
    """Estimate the first known machine from poses without some components; return the estimate and the clearances."""
    truth, _ = known()[0]
    q = truth.poses.q.copy()
    q[:, missing] = np.nan
    return estimate(truth.nominal, truth.load, Poses(truth.poses.t, q)), truth.clearance


@pytest.mark.parametrize(("missing", "most"), [((1,), 2e-4), ((2,), 4e-4), ((0, 1), 1e-3)])
def test_the_believed_load_gives_clearances_where_components_are_missing(missing: tuple[int, ...], most: float) -> None:
    result, truth = _without(*missing)
    assert result.horizontal_state is result.vertical_state is State.ESTIMATED
    assert result.reasons == tuple(f"{COMPONENTS[index]}: measured 0 times, expected at least 20" for index in missing)
    for value, true in zip((result.horizontal, result.vertical), truth, strict=True):
        assert value.deviation < most and abs(value.mean - true) < 3.0 * value.deviation


def test_a_component_that_is_hardly_measured_counts_as_missing() -> None:
    truth, _ = known()[0]
    q = truth.poses.q.copy()
    q[7:, 1] = np.nan
    result, _ = _without(1)
    again = estimate(truth.nominal, truth.load, Poses(truth.poses.t, q))
    assert again.reasons == ("y: measured 7 times, expected at least 20",)
    assert (again.horizontal, again.vertical) == (result.horizontal, result.vertical)


def test_a_machine_whose_load_does_not_explain_the_motion_gives_no_narrow_interval() -> None:
    truth = mismatched(replace(KINDS["load_5"], periods=5.0), 501)
    q = truth.poses.q.copy()
    q[:, 1] = np.nan
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, q))
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < 3.0 * value.deviation
