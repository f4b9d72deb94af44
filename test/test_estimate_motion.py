"""The estimate from a measured motion: its intervals contain the true values, or the result states why not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import GROUPS, KINDS, draw, known, mismatched
from scenes import preset

from plow_twin import Clearance, Scene, Table, simulate
from plow_twin.estimate import tuning
from plow_twin.estimate.arrow import Arrow
from plow_twin.estimate.bouncing import bias_of_hard
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import State
from plow_twin.estimate.unknowns import GAIN, Unknowns
from plow_twin.model.loads import compile_loads


def test_intervals_contain_the_truth_and_equal_data_give_equal_bits() -> None:
    inside = [
        value.p05 <= true <= value.p95
        for truth, result in known()
        for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True)
    ]
    assert sum(inside) >= 3
    assert all((result.model, result.sensor) == ("ok", "ok") for _, result in known())
    truth, result = known()[0]
    assert estimate(truth.nominal, truth.load, truth.poses) == result


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("jam", marks=pytest.mark.stress),
        "shift",
        *(pytest.param(name, marks=pytest.mark.stress) for name in ("stuck", "noisier")),
    ],
)
def test_contradictory_data_give_a_withdrawn_estimate(name: str) -> None:
    truth = draw(replace(GROUPS[name], periods=6.0), 1)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert (result.model, result.sensor) == (truth.group.model, truth.group.sensor), result.reasons
    assert result.horizontal_state is result.vertical_state is State.WITHDRAWN
    assert result.reasons


def test_a_small_drift_of_the_sensor_widens_the_interval() -> None:
    truth = mismatched(replace(KINDS["drift"], periods=6.0, drift_m=1.6e-3), 1)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert any("shifted within the window" in reason for reason in result.reasons)
    assert result.horizontal_state is result.vertical_state is State.ROUGH
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert value.deviation < 1e-3 and abs(value.mean - true) < 2.0 * value.deviation


@pytest.mark.parametrize(
    "name",
    [
        "scale_xy",
        *(
            pytest.param(name, marks=pytest.mark.stress)
            for name in ("kelvin_voigt", "exponent", "shape", "scale", "hard_shape", "hard_kelvin_voigt")
        ),
    ],
)
def test_effects_outside_the_model_are_reported_and_at_best_rough(name: str) -> None:
    truth = draw(replace(GROUPS[name], periods=6.0), 1)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert (result.model, result.sensor) == (truth.group.model, truth.group.sensor), result.reasons
    for value, state, true in zip(
        (result.horizontal, result.vertical),
        (result.horizontal_state, result.vertical_state),
        truth.clearance,
        strict=True,
    ):
        assert state is not State.ESTIMATED
        assert abs(value.mean - true) < 3.0 * value.deviation


@pytest.mark.parametrize(
    ("name", "seed", "names", "size"),
    [
        ("lever", 80_000, ("lever_x", "lever_y"), 5e-3),
        pytest.param("filter_5", 96_001, ("filter",), 1e-3, marks=pytest.mark.stress),
    ],
)
def test_a_lever_arm_or_low_pass_of_the_sensor_is_found(
    name: str, seed: int, names: tuple[str, ...], size: float
) -> None:
    """Without these unknowns, the fit does not converge, or clearances have errors of 0.4 mm and 1.9 mm."""
    truth = mismatched(replace(KINDS[name], periods=6.0), seed)
    result = estimate(truth.nominal, truth.load, truth.poses)
    for value, state, true in zip(
        (result.horizontal, result.vertical),
        (result.horizontal_state, result.vertical_state),
        truth.clearance,
        strict=True,
    ):
        assert state is State.ESTIMATED
        assert abs(value.mean - true) < 3.0 * value.deviation and value.deviation < 4e-4
    differences = [result.differs[one] for one in names]
    assert max(share for share, _, _ in differences) > 0.95
    assert np.hypot.reduce([share * by for share, by, _ in differences]) == pytest.approx(size, rel=0.2)


def test_walls_with_different_damping_are_found() -> None:
    """Without these quantities, a constant part of the load explains the motion, with errors of 4 deviations."""
    truth = mismatched(KINDS["damping_walls"], 98_200)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert max(share for name, (share, _, _) in result.differs.items() if name.startswith("damping_")) > 0.9
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < min(2.0 * value.deviation, 2e-4)


def test_badly_fitted_swings_at_an_end_of_the_window_are_no_change_of_the_machine() -> None:
    """With a change after the third of 176 swings, the estimate would be withdrawn, although it is right to 4 um."""
    truth = mismatched(KINDS["load_steps"], 98_201)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.reasons == () and result.horizontal_state is State.ESTIMATED
    assert abs(result.horizontal.mean - truth.clearance[0]) < 3.0 * result.horizontal.deviation < 3e-4


def test_the_vertical_clearance_of_a_head_that_never_moves_sideways_is_estimated() -> None:
    truth = mismatched(replace(KINDS["vertical"], periods=6.0), 80_000)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is State.NOT_OBSERVABLE and result.vertical_state.known, result.reasons
    assert abs(result.vertical.mean - truth.clearance[1]) < 3.0 * result.vertical.deviation < 3e-3


@pytest.mark.parametrize(
    ("name", "quantity", "size"), [("theta_scale", "scale_theta", 0.01), ("corners", "corner_radius", 2e-3)]
)
def test_a_difference_that_explains_the_residuals_is_found(name: str, quantity: str, size: float) -> None:
    """With derivatives from coarse steps, other quantities would explain the residuals, with errors up to 0.2 mm."""
    truth = mismatched(KINDS[name], 84001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    share, by, _ = result.differs[quantity]
    assert share > 0.5 and abs(by) == pytest.approx(size, rel=0.45)
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        assert abs(value.mean - true) < min(value.deviation, 1e-4)


def test_intervals_of_a_machine_without_differences_stay_narrow() -> None:
    for truth, result in known():
        assert result.apparent is not None
        for value, exact, true in zip(
            (result.horizontal, result.vertical), result.apparent, truth.clearance, strict=True
        ):
            assert exact.deviation < value.deviation < 3.0 * exact.deviation and value.p05 < true < value.p95


@pytest.mark.stress
@pytest.mark.parametrize("seed", [43202, 43210])
def test_estimates_between_soft_and_hard_contacts_are_within_two_deviations(seed: int) -> None:
    """The first machine is treated as if its contact were hard.

    Errors of the frame, which are zero here, widen its intervals.
    """
    truth = draw(GROUPS["middle"], seed)
    result = estimate(truth.nominal, truth.load, truth.poses)
    values = result.horizontal, result.vertical
    for value, exact, state, true in zip(
        values,
        result.apparent or values,
        (result.horizontal_state, result.vertical_state),
        truth.clearance,
        strict=True,
    ):
        assert state is State.ESTIMATED and abs(value.mean - true) < 2.0 * value.deviation
        assert abs(exact.mean - true) < 2.0 * exact.deviation and exact.deviation < 2e-4


def test_another_law_of_a_soft_contact_is_found_although_residuals_hardly_repeat() -> None:
    truth = draw(GROUPS["kelvin_voigt"], 57001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.model == "suspect" and "law" in result.reasons[0] and result.figures["repeated"] < 2.0
    for _, right in known():
        assert abs(right.figures["law"]) < 4.0


def test_the_fit_finds_the_bias_of_a_sensor_with_a_soft_contact() -> None:
    truth, _ = known()[0]
    assert not bias_of_hard(Unknowns(truth.nominal), truth.poses).any()
    moved = estimate(truth.nominal, truth.load, truth.poses.moved(np.array([5e-3, -5e-3, 0.1])))
    assert moved.bias_theta is not None and moved.bias_theta.mean == pytest.approx(0.1, abs=3e-3)
    assert moved.apparent is not None
    for value, true in zip(moved.apparent, truth.clearance, strict=True):
        assert abs(value.mean - true) < value.p95 - value.p05 < 6e-4


def test_a_clearance_without_a_touched_wall_is_not_observable() -> None:
    """A head that is always pressed to the right never touches the left wall, so gx has its prior value."""
    nominal = preset("paper")
    t = np.arange(0.0, 20.0, 0.01)
    wrench = np.stack([5e4 + 2e4 * np.sin(2.0 * t), 0.0 * t, -1e3 * np.sin(2.0 * t)], axis=1)
    scene: Scene = replace(nominal, loads=(Table("one side", t, wrench),))
    run = simulate(scene, 19.9, 0.01, 1e-6)
    noise = np.random.default_rng(1).standard_normal(run.q.shape) * [5e-4, 5e-4, 2e-3]
    poses, _ = Poses.of(run.t, run.q + noise)
    load, _ = Load.of(t, wrench)
    result = estimate(nominal, load, poses)
    assert result.horizontal_state is not State.ESTIMATED
    assert result.horizontal.p05 <= scene.clearance.horizontal_m <= result.horizontal.p95
    assert result.horizontal.p95 - result.horizontal.p05 > 0.01


def test_an_unpredictable_motion_is_no_evidence_of_a_clearance(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, before = known()[0]
    monkeypatch.setattr(tuning, "PREDICTED", 1.1)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is result.vertical_state is State.NOT_OBSERVABLE
    assert (result.model, result.sensor) == ("ok", "ok") and before.horizontal_state is State.ESTIMATED
    assert all("is predicted, expected 110% or more" in reason for reason in result.reasons)
    assert [reason.split()[0] for reason in result.reasons] == ["horizontal", "vertical"]
    # no group is known better than the whole clearance, so each group has its value
    assert {value for value, _ in result.groups.values()} == {result.horizontal, result.vertical}
    assert result.horizontal.deviation > 10.0 * before.horizontal.deviation


@pytest.mark.stress
def test_a_clearance_without_evidence_is_not_estimated() -> None:
    """With theta locked, the head remains at the top walls.

    A fit would give 6.8 mm instead of 27.1 mm, with a deviation of 0.4 mm.
    """
    nominal = replace(preset("paper"), locked=("theta",))
    rng = np.random.default_rng([77, 2])
    fine = np.arange(0.0, 10.0 * np.pi + 1e-3, 1e-3)
    wrench = compile_loads(nominal.loads).at(fine)
    loads = (Table("true", fine, wrench * (1.0 + 0.05 * rng.standard_normal(3))),)
    clearance = Clearance(*rng.uniform(0.018, 0.034, 2).tolist())
    stiffness, damping = np.exp(rng.uniform(*np.log([5e6, 3e7]))), 0.72 * np.exp(rng.normal(0.0, 0.4))
    contact = replace(nominal.contact, stiffness=float(stiffness), damping=float(damping))
    run = simulate(replace(nominal, clearance=clearance, contact=contact, loads=loads), 10.0 * np.pi, 1e-3, 1e-7)
    rng.uniform(), rng.standard_normal(3)
    t = np.arange(0.0, 10.0 * np.pi, 0.01)
    q = np.stack([np.interp(t, run.t, column) for column in run.q.T], axis=1)
    q += rng.standard_normal(q.shape) * [5e-4, 5e-4, 2e-3]
    result = estimate(nominal, Load.of(fine[::10], wrench[::10])[0], Poses.of(t, q)[0])
    assert run.statistics["bottom_left_bottom"]["time_in_contact"] == 0.0
    assert result.vertical_state is not State.ESTIMATED
    assert result.vertical.p05 < clearance.vertical_m < result.vertical.p95


def test_stated_deviations_of_the_measurements_are_used() -> None:
    """The stated deviations, which are lower bounds, determine the intervals and the prior of the load's gains."""
    scene = preset("paper")
    t = np.arange(0.0, 10.0, 0.01)
    wrench = compile_loads(scene.loads).at(t)
    run = simulate(scene, 9.9, 0.02, 1e-6)
    poses, _ = Poses.of(run.t, run.q, (1e-3, 1e-3, 4e-3))
    load, _ = Load.of(t, wrench, (0.0, 0.0, 1.0 * float(np.sqrt((wrench[:, 2] ** 2).mean()))))
    assert Unknowns.stated(scene, load, poses).deviations()[GAIN].tolist() == [0.07, 0.07, 1.0]
    result = estimate(scene, load, poses)
    assert result.noise == (1e-3, 1e-3, 4e-3)
    assert result.horizontal.p95 - result.horizontal.p05 > 1e-4


def test_without_measurements_the_prior_is_returned() -> None:
    nominal = preset("paper")
    load, _ = Load.of([0.0, 1.0], np.zeros((2, 3)))
    poses, lost = Poses.of([0.1, 0.2, 0.2, np.nan], np.zeros((4, 3)))
    result = estimate(nominal, load, poses, lost)
    assert (result.horizontal_state, result.vertical_state, result.lost) == (State.PRIOR, State.PRIOR, 2)
    assert result.horizontal.p05 < 0.025 < result.horizontal.p95
    few = "got 2 poses within the load's span, 0 s to 1 s, expected at least 20: model and sensor are not checked"
    assert result.reasons == (few,)


def test_poses_too_sparse_for_a_fit_are_refused() -> None:
    """At 5 Hz, or with 1.5 % or 10 % of the poses, swings cannot be located, and a wrong fit would seem certain."""
    nominal = preset("paper")
    load, _ = Load.of([0.0, 20.0], np.ones((2, 3)))
    rng = np.random.default_rng(1)
    rare, some, more = np.arange(0.0, 20.0, 0.2), np.arange(0.0, 20.0, 0.005), np.arange(0.0, 20.0, 0.01)
    sparse = [(t, np.where(rng.random((len(t), 3)) < share, 0.0, np.nan)) for t, share in ((some, 0.015), (more, 0.1))]
    for t, rows in ((rare, np.zeros((len(rare), 3))), *sparse):
        poses, _ = Poses.of(t, rows)
        result = estimate(nominal, load, poses)
        assert result.horizontal_state is result.vertical_state is State.NOT_OBSERVABLE
        assert "a second, expected at least 8.0" in result.reasons[0]


@pytest.mark.stress
@pytest.mark.parametrize(("missing", "noise_m"), [(0.9, 5e-4), (0.85, 5e-4), (0.0, 5e-3)])
def test_sparse_or_noisy_poses_give_no_narrow_wrong_interval(missing: float, noise_m: float) -> None:
    truth = draw(replace(GROUPS["plain"], periods=6.0, noise_m=noise_m), 2)
    q = truth.poses.q.copy()
    q[np.random.default_rng(2).random(q.shape) < missing] = np.nan
    poses, _ = Poses.of(truth.poses.t, q)
    result = estimate(truth.nominal, truth.load, poses)
    for value, state, true in zip(
        (result.horizontal, result.vertical), (result.horizontal_state, result.vertical_state), truth.clearance,
        strict=True,
    ):  # fmt: skip
        assert state is not State.ESTIMATED or abs(value.mean - true) < 1.5 * (value.p95 - value.p05)


def test_a_silence_of_the_load_is_not_bridged() -> None:
    """If a lost period of the load were interpolated linearly, the sensor would seem faulty."""
    truth, _ = known()[0]
    kept = (truth.load.t < 11.0) | (truth.load.t > 14.0)
    load = Load(truth.load.t[kept], truth.load.wrench[kept])
    assert load.longest_stretch().t[-1] < 11.0
    result = estimate(truth.nominal, load, truth.poses)
    assert (result.model, result.sensor, result.horizontal_state) == ("ok", "ok", State.ESTIMATED)
    assert result.t_end < 11.0 and result.lost > 400
    few = Load(np.array([0.0, 3.0, 4.0, 20.0]), np.ones((4, 3)))
    assert few.longest_stretch() is few, "a load given by few knots"


def test_after_a_step_of_the_clock_the_longest_part_is_used() -> None:
    """The step is not a period of the load, by which the units of the estimate would be chosen."""
    truth, _ = known()[0]
    load, poses = truth.load, truth.poses
    first, second = (np.where(part.t < 3.0, part.t - 1e9, part.t) for part in (load, poses))
    result = estimate(truth.nominal, Load(first, load.wrench), Poses(second, poses.q))
    assert (result.model, result.sensor, result.horizontal_state) == ("ok", "ok", State.ESTIMATED)
    assert result.t_start >= 3.0 and result.lost > 400
    two = estimate(truth.nominal, Load(load.t[:2], load.wrench[:2]), poses)
    assert two.horizontal_state is State.PRIOR, "poses after the load are not used"


def test_a_constant_load_is_suspect_and_only_the_newest_part_of_long_data_is_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # the comparison with drawn motions takes many seconds and has its own tests; here it finds no motion
    monkeypatch.setattr("plow_twin.estimate.estimate.under_uncertain_load", lambda nothing, *_: nothing)
    nominal = preset("paper")
    t = np.arange(0.0, 300.0, 0.02)
    q = np.stack([0.01 * np.sin(2.0 * t), 0.01 * np.cos(2.0 * t), 0.0 * t], axis=1)
    q += np.random.default_rng(1).standard_normal(q.shape) * 1e-4
    result = estimate(nominal, Load.of(t, np.zeros((len(t), 3)))[0], Poses.of(t, q)[0])
    assert (result.model, result.horizontal_state) == ("suspect", State.WITHDRAWN)
    assert result.reasons == ("load: the same value throughout, while the head moves",)
    assert (result.t_start, result.t_end) == (pytest.approx(t[-1] - 60.0, abs=0.03), pytest.approx(t[-1]))


def test_a_machine_at_rest_does_not_make_the_model_suspect() -> None:
    truth, _ = known()[0]
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 32.0, 0.01)
    rests = [-9e-3, -4e-3, 2e-3] + 5e-4 * rng.standard_normal((len(t), 3))
    idle = np.full((len(t), 3), 500.0)
    for load in (idle, idle + 100.0 * rng.standard_normal(idle.shape)):
        result = estimate(truth.nominal, Load.of(t, load)[0], Poses.of(t, rests)[0])
        assert result.horizontal_state is result.vertical_state is State.NOT_OBSERVABLE
        assert (result.model, result.sensor) == ("ok", "ok") and "the head rests" in result.reasons[0]
    # just after a head has come to rest, its poses scatter as little as at a hard wall, but nothing else indicates a
    # hard wall
    rests[:200] += np.linspace(1e-2, 0.0, 200)[:, None]
    result = estimate(truth.nominal, Load.of(t, idle)[0], Poses.of(t, rests)[0])
    assert (result.horizontal_state, result.model) == (State.NOT_OBSERVABLE, "ok")
    # if the head does not move although it is pushed, the head or its sensor is stuck
    pushed = Load.of(t, idle + np.outer(np.sin(2.0 * t), [3e4, 1e4, 4e4]))[0]
    result = estimate(truth.nominal, pushed, Poses.of(t, rests)[0])
    assert result.horizontal_state is State.WITHDRAWN


def test_a_fit_that_cannot_be_computed_is_withdrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    truth, _ = known()[0]
    monkeypatch.setattr(Arrow, "factorised", singular)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is State.WITHDRAWN and "Singular matrix" in result.reasons[0]


def test_a_rough_load_costs_little_accuracy() -> None:
    truth = draw(replace(GROUPS["stochastic"], periods=5.0), 20004)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert (result.model, result.sensor) == ("ok", "ok")
    for value, true in zip((result.horizontal, result.vertical), truth.clearance, strict=True):
        # without links between the swings, the interval would be twice as wide, and the error 0.2 mm
        assert value.p95 - value.p05 < 2.5e-4 and abs(value.mean - true) < 1.5e-4


def test_ten_poses_a_second_suffice_and_the_sensor_is_not_suspect() -> None:
    """The residuals of a fit that has not converged must not be mistaken for a sensor with variable noise."""
    truth = draw(GROUPS["slow"], 33001)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert (result.sensor, result.horizontal_state) == ("ok", State.ESTIMATED), result.reasons
    assert [result.horizontal.mean, result.vertical.mean] == pytest.approx(truth.clearance, abs=2e-4)


def test_a_load_with_a_little_noise_is_followed_in_long_swings() -> None:
    """If each change of the load began a new swing, the estimate of this correct model would be withdrawn."""
    truth = draw(replace(GROUPS["plain"], load_step=1e-3, periods=8.0), 42004)
    noise = 0.01 * truth.load.wrench.std(axis=0) * np.random.default_rng(1).standard_normal(truth.load.wrench.shape)
    result = estimate(truth.nominal, Load(truth.load.t, truth.load.wrench + noise), truth.poses)
    assert result.horizontal_state is State.ESTIMATED, result.reasons
    means = [result.horizontal.mean, result.vertical.mean]
    assert means == pytest.approx(truth.clearance, abs=1e-4)


def test_a_machine_with_a_locked_rotation_is_estimated() -> None:
    """The noise of the locked angle must not become a rate of rotation, with which the fitted motions would turn."""
    locked = replace(GROUPS["plain"], stiffness=(3e6, 3e8), machine=lambda scene: replace(scene, locked=("theta",)))
    truth = draw(replace(locked, periods=6.0), 74000)
    result = estimate(truth.nominal, truth.load, truth.poses)
    assert result.horizontal_state is State.ESTIMATED
    assert result.horizontal.p05 <= truth.clearance[0] <= result.horizontal.p95
    # the head always lies on the frame, so it does not show the vertical clearance
    assert result.vertical_state is State.NOT_OBSERVABLE
