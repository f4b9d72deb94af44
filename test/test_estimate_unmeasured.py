"""Clearances from poses that lack one or two components."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import KINDS, known, mismatched

from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import State

COMPONENTS = ("x", "y", "theta")


@pytest.mark.parametrize(("missing", "kept", "most"), [((1,), 7, 2e-4), ((2,), 0, 4e-4), ((0, 1), 0, 1e-3)])
def test_the_believed_load_gives_clearances_where_components_are_missing(
    missing: tuple[int, ...], kept: int, most: float
) -> None:
    """A component with few values is treated as not measured."""
    truth, _ = known()[0]
    q = truth.poses.q.copy()
    q[kept:, missing] = np.nan
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, q))
    assert result.horizontal_state is result.vertical_state is State.ESTIMATED
    assert result.reasons == tuple(
        f"{COMPONENTS[index]}: measured {kept} times, expected at least 20" for index in missing
    )
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
