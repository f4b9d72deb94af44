"""Rough clearances if the load does not explain the motion, or if no angle was measured."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from estimate_support import GROUPS, KINDS, draw, known, mismatched

from plow_twin.estimate import estimate as of_window
from plow_twin.estimate import tuning
from plow_twin.estimate.equation_error import EquationError
from plow_twin.estimate.estimate import estimate, under_uncertain_load
from plow_twin.estimate.measurements import Load, Poses, filled
from plow_twin.estimate.reason import Reason
from plow_twin.estimate.result import Estimate, State
from plow_twin.estimate.screening import thinned
from plow_twin.estimate.start import range_of_motion
from plow_twin.estimate.summary import unobserved_because, without_fit
from plow_twin.estimate.uncertain_load import Compared, compare_under_uncertain_load
from plow_twin.estimate.unknowns import Unknowns


def _holds(result: Estimate, truth: np.ndarray) -> bool:
    values = (result.horizontal, result.vertical)
    return all(abs(value.mean - true) < 3.0 * value.deviation for value, true in zip(values, truth, strict=True))


def test_the_equations_of_motion_give_walls_and_stiffness_without_a_simulation() -> None:
    truth, _ = known()[0]
    equations = EquationError(Unknowns(truth.nominal), truth.load, truth.poses.t)
    q = filled(truth.poses)
    walls = equations.search(q, range_of_motion(truth.nominal, truth.poses)[0])
    assert walls.clearance == pytest.approx(truth.clearance, abs=4e-3)
    assert 1e5 / np.exp(walls.ln_depth) == pytest.approx(truth.scene.contact.stiffness, rel=0.4)
    assert (equations.touched(q, walls, 1e-3) > 1.0).all()


def test_a_load_that_does_not_explain_the_motion_gives_a_rough_clearance() -> None:
    truth = mismatched(replace(KINDS["load_10"], periods=6.0), 80001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.model == "suspect" and result.reasons
    assert result.horizontal_state is result.vertical_state is State.ROUGH
    assert 5e-4 < result.horizontal.deviation < 1.2e-3 and _holds(result, truth.clearance)
    assert result.figures["load_error"] > 0.03


def test_rare_samples_are_averages_of_unknown_amplitude() -> None:
    t = np.arange(0.0, 20.0, 1e-3)
    true = np.stack([3e4 * np.sin(2.0 * t), 1e4 * np.cos(2.0 * t), 0.0 * t], axis=1)
    means = Load(t.reshape(-1, 1000).mean(axis=1), true.reshape(-1, 1000, 3).mean(axis=1))
    smooth = means.smooth(0.02)
    inner = (smooth.t > 3.0) & (smooth.t < 17.0)
    amplitude = np.sin(1.0) * np.stack([3e4 * np.sin(2.0 * smooth.t), 1e4 * np.cos(2.0 * smooth.t)], axis=1)
    off = (smooth.wrench[:, :2] - amplitude)[inner]
    lines = np.stack([np.interp(smooth.t, means.t, column) for column in means.wrench[:, :2].T], axis=1)
    assert off.std() < 0.4 * (lines - amplitude)[inner].std()
    assert smooth.gain_deviations()[:2] == pytest.approx(tuning.COARSE_GAIN, rel=0.1)


@pytest.mark.stress
def test_averages_taken_for_samples_are_no_shift_of_the_sensor() -> None:
    truth = mismatched(KINDS["averages_1hz"], 99003)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is result.vertical_state is State.ROUGH and "taken as averages" in result.reasons[0]
    assert _holds(result, truth.clearance)


def test_without_an_angle_the_range_of_motion_gives_the_clearance() -> None:
    truth, _ = known()[0]
    q = truth.poses.q.copy()
    q[:, 2] = np.nan
    unknowns, period = Unknowns.stated(truth.nominal, truth.load, truth.poses), truth.load.period()
    poses = Poses(truth.poses.t, q)
    compared, _ = compare_under_uncertain_load(thinned(truth.load, period)[0], unknowns, poses, period)
    assert compared is not None and compared.touched.all() and (compared.deviation < 2.5e-3).all()
    assert (np.abs(compared.clearance - truth.clearance) < 3.0 * compared.deviation).all()


def test_a_clearance_beyond_all_drawn_motions_is_no_result() -> None:
    """With soft walls, unevenly worn pads have the effect of a negative clearance."""
    truth = mismatched(replace(KINDS["hard_askew"], periods=4.0), 99002)
    unknowns, period = Unknowns.stated(truth.nominal, truth.load, truth.poses), truth.load.period()
    compared, work = compare_under_uncertain_load(thinned(truth.load, period)[0], unknowns, truth.poses, period)
    assert compared is None and work > 0


def test_a_fast_load_does_not_change_the_units_of_the_poses() -> None:
    """In units in which a load of 8 Hz has the paper's period, poses at 100 Hz would be too sparse."""
    truth = mismatched(replace(KINDS["chatter"], periods=6.0), 80001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is State.ROUGH and _holds(result, truth.clearance)


def test_poses_without_any_load_give_a_rough_clearance() -> None:
    """Soft walls yield by more than half of the clearance; hard walls leave the range of motion."""
    for truth in (known()[0][0], draw(replace(GROUPS["hard"], periods=4.0), 30100)):
        result = estimate(truth.nominal, Load.unmeasured(float(truth.load.t[-1])), truth.poses)
        assert (result.model, result.sensor) == ("suspect", "ok")
        assert result.reasons[0].startswith("load: not measured (no load.csv, or no sample)")
        assert result.horizontal_state is result.vertical_state is State.ROUGH and _holds(result, truth.clearance)
        assert max(result.horizontal.deviation, result.vertical.deviation) < 4e-3


def test_a_clearance_withheld_under_an_uncertain_load_has_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason of the fit, which another method has replaced, is not repeated."""
    truth, _ = known()[0]
    unknowns, period = Unknowns.stated(truth.nominal, truth.load, truth.poses), truth.load.period()
    failed = without_fit(unknowns, truth.poses)
    failed = replace(failed, reasons=(*failed.reasons, unobserved_because(0, Reason("deviation of the fit"))))
    pair, compared = (math.log(5e-3), 0.1), np.array([0.025, 0.03])
    for deviation, touched, why in (
        (7e-3, True, "deviation of 0.0053 m under an uncertain load, expected less than 0.004 m"),
        (1e-3, False, "a wall is hardly touched"),
    ):
        result = Compared(compared, np.array([deviation, 1e-3]), np.array([touched, True]), pair, (0.0, 0.1), 0.5, 0.1)
        monkeypatch.setattr(of_window, "compare_under_uncertain_load", lambda *_, found=result: (found, 0))
        graded = under_uncertain_load(failed, unknowns, truth.load, truth.poses, period)
        assert graded.states == (State.NOT_OBSERVABLE, State.ROUGH)
        assert graded.reasons == (failed.reasons[0], f"horizontal clearance not observable: {why}")
