"""Clearances of the groups of pads, and pads that are unevenly worn."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from estimate_support import KINDS, known, mismatched
from scenes import preset

from plow_twin import Clearance, Table, Wear, simulate
from plow_twin.estimate import pads
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import Estimate, State
from plow_twin.model.loads import compile_loads


def test_the_motion_gives_the_clearance_of_each_group_of_pads() -> None:
    held = 0
    for truth, result in known():
        for name, (value, state) in result.groups.items():
            true = truth.clearance[0 if name.startswith("horizontal") else 1]
            assert state is State.ESTIMATED and value.p95 - value.p05 < 1e-3
            held += value.p05 <= true <= value.p95
    assert held >= 6, "of 8, whose errors go together"


#: Wear of the pads [m] near the end of a life under the paper's load.
UNEVEN = np.array([2.8, 3.3, 4.5, 2.3, 2.2, 2.2, 3.2, 1.3]) * 1e-3


def worn_askew(depth: np.ndarray, seed: int) -> tuple[Estimate, dict[str, float]]:
    """Return the estimate of a machine with unevenly worn pads, and the true clearance of each group."""
    nominal = preset("paper")
    t = np.arange(0.0, 5.0 * np.pi, 0.01)
    wrench = compile_loads(nominal.loads).at(t)
    worn = replace(nominal, wear=Wear(0.0, 0.015, 0.0, initial_depth_m=tuple(depth.tolist())))
    run = simulate(worn, float(t[-1]), 0.02, 1e-6)
    noise = np.random.default_rng(seed).standard_normal(run.q.shape) * [5e-4, 5e-4, 2e-3]
    result = estimate(nominal, Load.of(t, wrench)[0], Poses.of(run.t, run.q + noise)[0])
    return result, {
        "horizontal_top": 0.025 + depth[1] + depth[3], "horizontal_bottom": 0.025 + depth[7] + depth[5],
        "vertical_left": 0.030 + depth[0] + depth[6], "vertical_right": 0.030 + depth[2] + depth[4],
    }  # fmt: skip


def test_rotated_walls_are_estimated_and_the_model_is_not_suspect(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wear is as uneven as near the end of a life. A fit with evenly worn pads fails."""
    fitted = Mock(side_effect=pads.fit)
    monkeypatch.setattr(pads, "fit", fitted)
    result, true = worn_askew(UNEVEN, 1)
    assert fitted.call_count == 2, "the walls are not fitted again once their turns change by less than their noise"
    assert (result.model, result.horizontal_state) == ("ok", State.ESTIMATED), result.reasons
    assert result.horizontal.mean == pytest.approx(0.5 * (true["horizontal_top"] + true["horizontal_bottom"]), abs=3e-4)
    assert result.vertical.mean == pytest.approx(0.5 * (true["vertical_left"] + true["vertical_right"]), abs=3e-4)
    for name, (value, state) in result.groups.items():
        assert state is State.ESTIMATED and abs(value.mean - true[name]) < 1.5 * (value.p95 - value.p05)
    # the walls are inclined, so the horizontal clearance at the top exceeds that at the bottom by 2 mm
    assert result.groups["horizontal_top"][0].p05 > result.groups["horizontal_bottom"][0].p95


def test_slightly_rotated_walls_do_not_make_the_clearance_too_small() -> None:
    """A fit with evenly worn pads passes all checks here, but its error is 0.26 mm, with a deviation of 0.29 mm."""
    result, true = worn_askew(0.6 * UNEVEN, 2)
    off = result.vertical.mean - 0.5 * (true["vertical_left"] + true["vertical_right"])
    assert result.apparent is not None
    assert abs(off) < 1.5e-4 and result.apparent[1].deviation < 2e-4


def test_untouched_pads_leave_a_clearance_between_rotated_walls_unknown() -> None:
    """The lower left pad is never touched, so the lower and the mean horizontal clearance are undetermined."""
    truth, _ = known()[0]
    depth = tuple(1e-3 * value for value in (3.0, 0.0, 0.0, 2.0, 0.0, 4.0, 1.0, 0.0))
    scene = replace(
        truth.scene,
        clearance=Clearance(0.0324, 0.0185),
        contact=replace(truth.scene.contact, stiffness=2.9e7, damping=1.2),
        wear=Wear(0.0, 0.015, 0.0, initial_depth_m=depth),
        loads=(Table("true", truth.load.t, truth.load.wrench * [0.98, 0.925, 0.912]),),
    )
    run = simulate(scene, float(truth.poses.t[-1]), 0.01, 1e-6)
    noise = np.random.default_rng(1).standard_normal(run.q.shape) * [5e-4, 5e-4, 2e-3]
    result = estimate(truth.nominal, truth.load, Poses.of(run.t, run.q + noise)[0])
    assert run.statistics["bottom_left_left"]["time_in_contact"] == 0.0
    # an overconfident fit would have an error of 1.1 mm and a stated deviation of 0.03 mm
    assert abs(result.horizontal.mean - 0.0354) < 3.0 * result.horizontal.deviation
    assert abs(result.vertical.mean - 0.0205) < 3.0 * result.vertical.deviation < 9e-4
    assert result.groups["horizontal_bottom"][1] is State.NOT_OBSERVABLE
    assert result.groups["horizontal_top"][0].deviation < 2.5e-4


def test_an_untouched_pad_of_a_pressed_head_leaves_the_clearance_unknown() -> None:
    """The rotation of the right wall is fitted up to the touch of its lower pad, with an error of six deviations."""
    truth = mismatched(KINDS["pressed"], 99001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state.known and result.apparent is not None
    assert result.apparent[0].deviation < 3e-4
    assert abs(result.horizontal.mean - truth.clearance[0]) < 3.0 * result.horizontal.deviation < 2.4e-3
