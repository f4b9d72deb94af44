"""Poses whose signs, order or units contradict the load are named instead of fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import GROUPS, KINDS, Mismatch, Truth, draw, known, mismatched

from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.orientation import misfits_of_axes
from plow_twin.estimate.result import State
from plow_twin.estimate.screening import thinned
from plow_twin.estimate.unknowns import Unknowns

#: Machines and loads that resemble the model least.
_DIFFERENT = (
    "load_10", "averages_1hz", "cutting_10hz", "friction_10", "pressed", "chatter", "vertical", "no_theta",
    "hard_theta",
)  # fmt: skip


def _misfits(truth: Truth | Mismatch, q: np.ndarray) -> list[str]:
    poses = Poses(truth.poses.t, q)
    load, _ = thinned(truth.load, truth.load.period())
    unknowns = Unknowns.stated(truth.nominal, load, poses)
    return misfits_of_axes(Forward(unknowns.scene, load), unknowns, poses)


def _hard() -> Truth:
    return draw(replace(GROUPS["hard"], periods=4.0), 30100)


@pytest.mark.parametrize(
    ("factor", "named"),
    [
        ([1.0, 1.0, -1.0], ["theta: opposite"]),
        ([-1.0, 1.0, 1.0], ["x: opposite"]),
        ([1.0, -1.0, 1.0], ["y: opposite"]),
        ([-1.0, -1.0, 1.0], ["x: opposite", "y: opposite"]),
        ([1.0, 1.0, np.degrees(1.0)], ["theta: "]),
        ([1.0, 1.0, np.radians(1.0)], ["theta: 0.0"]),
        ([1e3, 1e3, 1.0], ["x: ", "y: "]),
    ],
)
def test_a_wrong_sign_or_unit_of_a_component_is_named(factor: list[float], named: list[str]) -> None:
    for truth in (known()[0][0], _hard()):
        messages = _misfits(truth, truth.poses.q * factor)
        assert len(messages) == len(named)
        assert all(message.startswith(name) for message, name in zip(messages, named, strict=True))
        assert all(("sign" if min(factor) < 0.0 else "unit") in message for message in messages)


def test_swapped_axes_are_named() -> None:
    for truth in (known()[0][0], _hard()):
        (message,) = _misfits(truth, truth.poses.q[:, [1, 0, 2]])
        assert message.startswith("x and y seem swapped")


def test_a_mirrored_angle_withdraws_the_estimate() -> None:
    """A fit would be published with an error of some millimetres, for example of 12 mm."""
    truth, _ = known()[0]
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, truth.poses.q * [1.0, 1.0, -1.0]))
    assert result.states == (State.WITHDRAWN, State.WITHDRAWN) and result.sensor == "suspect"
    assert len(result.reasons) == 1 and "the sign of theta or of m is wrong" in result.reasons[0]


def test_a_mirrored_component_is_named_if_another_was_not_measured() -> None:
    truth, _ = known()[0]
    result = estimate(truth.nominal, truth.load, Poses(truth.poses.t, truth.poses.q * [-1.0, 1.0, np.nan]))
    assert result.states == (State.WITHDRAWN, State.WITHDRAWN)
    assert [reason.split(":")[0] for reason in result.reasons] == ["theta", "x"]


@pytest.mark.parametrize("name", _DIFFERENT)
def test_right_signs_raise_no_alarm_if_load_or_machine_differ(name: str) -> None:
    truth = mismatched(replace(KINDS[name], periods=6.0), 700031)
    assert _misfits(truth, truth.poses.q) == []


def test_few_poses_show_no_sign() -> None:
    truth, _ = known()[0]
    poses = truth.poses.between(0.0, 0.4)
    assert _misfits(replace(truth, poses=poses), -poses.q) == []
