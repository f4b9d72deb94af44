"""The twin that follows its machine: its forces and clearances depend only on earlier measurements."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import plow_twin_here
from numpy.typing import NDArray
from scenes import ROOT

from plow_twin import Clearance, Contact, Friction, simulate
from plow_twin.errors import ArgumentError
from plow_twin.estimate.follow import LATEST_S, Follower
from plow_twin.estimate.followed import Stretch, follow, table
from plow_twin.estimate.forces import FEWEST, TOLERANCE
from plow_twin.estimate.harmonics import Harmonics
from plow_twin.estimate.learned import biases_of
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.members import Ensemble, rubs
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.window import Windows
from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Scene, Wear
from plow_twin.run.batch import TwinBatch
from plow_twin.solve.state import ROW
from plow_twin.stream.journal import Estimated, Restore, Sample, SetModel
from plow_twin.stream.model_changes import changed_twin
from plow_twin.stream.session import Session

sys.path.insert(0, str(ROOT / "benchmark"))
from estimate_truths import GROUPS, PERIOD, Truth, draw

Array = NDArray[np.float64]
MEMBERS = 48
#: Seed of a machine with a soft contact. Its horizontal clearance is 8 mm larger than assumed, and load gains have
#: errors up to 10 %.
SEED = 71003


@pytest.fixture(scope="module")
def truth() -> Truth:
    return draw(replace(GROUPS["plain"], stiffness=(3e6, 3e8), periods=2.2), SEED)


@pytest.fixture(scope="module")
def forces(truth: Truth) -> Array:
    return simulate(truth.scene, float(truth.load.t[-1]), 0.01, 1e-6).force


@pytest.fixture(scope="module")
def followed(truth: Truth) -> Stretch:
    return follow(truth.nominal, truth.load, truth.poses, MEMBERS)


def _known(truth: Truth, state: State = State.ESTIMATED) -> Estimate:
    """Return an estimate with the accuracy of an estimate from ten load periods."""
    clearance, contact = truth.scene.clearance, truth.scene.contact
    assert contact.damping is not None
    fx, fy, m = (Interval.normal(gain, 0.003) for gain in truth.gain)
    horizontal, vertical = (Interval.normal(value, 3e-5) for value in (clearance.horizontal_m, clearance.vertical_m))
    return Estimate(
        0.0, 1.0, horizontal, vertical, state, state,
        Interval.normal(contact.stiffness, 2e-3 * contact.stiffness), Interval.normal(contact.damping, 5e-3),
        fx, fy, m, noise=(5e-4, 5e-4, 2e-3),
    )  # fmt: skip


def _run(follower: Follower, truth: Truth, end: float, begin: float = -1.0, late: float = 0.0) -> Array:
    """Pass load and poses up to a time, with poses late by `late` [s]. Return the forces of the median twin."""
    load, poses = truth.load, truth.poses
    there = np.flatnonzero((load.t > begin) & (load.t <= end))
    rows, place = np.zeros(len(there), ROW), int(np.searchsorted(poses.t + late, begin, side="right"))
    for row, index in enumerate(there.tolist()):
        follower.advance_rows(load.t[index : index + 1], load.wrench[index : index + 1], rows[row : row + 1])
        while place < len(poses.t) and poses.t[place] + late <= load.t[index]:
            follower.add_pose(float(poses.t[place]), poses.q[place])
            place += 1
    return np.asarray(rows["force"])


def _take(follower: Follower, estimate: Estimate) -> bool:
    """Add an estimate at the present time. Return whether the twins follow it; if not, they follow the prior again."""
    before = follower.drawn
    follower.add_estimate(json.dumps(estimate.as_dict()), follower.time)
    return follower.drawn != before


def _error(force: Array, true: Array) -> float:
    return float(np.sqrt(((force - true) ** 2).sum() / (true**2).sum()))


def test_forces_follow_the_machine_within_two_load_periods(truth: Truth, forces: Array, followed: Stretch) -> None:
    nominal = simulate(truth.nominal, float(truth.load.t[-1]), 0.01, 1e-6).force
    late = followed.rows.t >= 1.2 * PERIOD
    true = forces[: len(late)][late]
    assert _error(nominal[: len(late)][late], true) > 0.3
    assert _error(followed.rows.force[late], true) < 0.02
    touching = true > 0.0
    inside = (followed.rows.low[late] <= true) & (true <= followed.rows.high[late])
    assert inside[touching].mean() > 0.8


def test_intervals_contain_the_truth_from_the_first_row_and_narrow(truth: Truth, followed: Stretch) -> None:
    clearance = followed.rows.clearance
    for axis, true in enumerate(truth.clearance):
        value, low, high = clearance[:, axis].T
        assert ((low <= true) & (true <= high)).mean() > 0.85
        assert 0.02 < high[0] - low[0] < 0.04  # at the start, the interval is that of the prior
        assert (low <= value).all() and (value <= high).all()
        assert high[-1] - low[-1] < 2e-3  # the interval includes errors of the frame and of the scales of the sensor


def test_a_row_uses_only_measurements_up_to_its_time(truth: Truth, followed: Stretch) -> None:
    end = 4.0
    cut = follow(truth.nominal, *_until(truth, end), MEMBERS)
    count = len(cut.rows.t)
    assert count == int((truth.load.t <= end).sum()) and cut.taken_over
    for name, values in vars(cut.rows).items():
        assert np.array_equal(values, getattr(followed.rows, name)[:count]), name


def _until(truth: Truth, end: float) -> tuple[Load, Poses]:
    load, poses = truth.load, truth.poses
    return (
        Load(load.t[load.t <= end], load.wrench[load.t <= end]),
        Poses(poses.t[poses.t <= end], poses.q[poses.t <= end]),
    )


def test_rows_on_a_grid_equal_rows_at_the_samples(truth: Truth) -> None:
    load, poses = _until(truth, 1.0)
    every = follow(truth.nominal, load, poses, MEMBERS).rows
    grid = follow(truth.nominal, load, poses, MEMBERS, dt=0.005).rows
    assert np.allclose(np.diff(grid.t), 0.005)
    load_on_grid = np.searchsorted(grid.t, load.t - 1e-9)[:-1]
    assert np.allclose(grid.force[load_on_grid], every.force[:-1], rtol=1e-6, atol=1.0)


def test_without_measurements_the_motion_stays_nominal(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    load, _ = _until(truth, 2.0)
    monkeypatch.setattr(TwinBatch, "move", lambda *_: pytest.fail("a member was moved"))
    followed = follow(truth.nominal, load, Poses(np.zeros(0), np.zeros((0, 3))), MEMBERS)
    alone = TwinBatch([replace(truth.nominal, loads=())], tol=TOLERANCE)
    rows = alone.advance_samples(load.t, load.wrench)
    assert _error(followed.rows.force, rows.force[0]) < 1e-6
    assert not followed.taken_over
    assert np.array_equal(followed.rows.clearance[0], followed.rows.clearance[-1])


def test_an_estimate_is_adopted_without_a_false_impact(
    truth: Truth, forces: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower = Follower(truth.nominal, MEMBERS)
    _run(follower, truth, 4.0)
    follower.span()
    assert _take(follower, _known(truth))
    monkeypatch.setattr(TwinBatch, "change", lambda *_: pytest.fail("nothing is left to learn"))
    followed = _run(follower, truth, 6.0, 4.0)
    assert _error(followed, forces[401:601]) < 0.04
    peak = simulate(truth.scene, 6.0, 1e-3, 1e-6).force[4000:].max(axis=0)
    assert (follower.span().peak[0] < 1.1 * peak + 2e3).all()


def test_a_withdrawn_estimate_is_undone(truth: Truth) -> None:
    follower = Follower(truth.nominal, MEMBERS)
    _run(follower, truth, 1.0)
    assert not _take(follower, _known(truth, State.WITHDRAWN))
    before = np.ptp(follower.clearance(), axis=1)
    assert _take(follower, _known(truth)) and (np.ptp(follower.clearance(), axis=1) < 2e-4).all()
    assert not _take(follower, _known(truth, State.NOT_OBSERVABLE))
    assert follower.estimate is not None
    assert _take(follower, _known(truth, State.WITHDRAWN)) and follower.estimate is None
    assert (np.ptp(follower.clearance(), axis=1) > 0.3 * before).all()


def test_an_estimate_of_one_clearance_is_replaced_by_a_later_estimate_of_the_same_clearance(truth: Truth) -> None:
    follower, both = Follower(truth.nominal, MEMBERS), _known(truth)
    _run(follower, truth, 1.0)
    horizontal = replace(both, vertical_state=State.NOT_OBSERVABLE)
    later = replace(horizontal, horizontal=Interval.normal(truth.clearance[0] + 1e-4, 3e-5))
    assert _take(follower, horizontal) and _take(follower, later)
    assert follower.clearance()[0, 0] == pytest.approx(later.horizontal.mean)
    assert not _take(follower, replace(both, horizontal_state=State.NOT_OBSERVABLE))
    assert _take(follower, both) and not _take(follower, later)


def test_a_rough_estimate_does_not_replace_an_accurate_estimate_of_the_same_motion(truth: Truth) -> None:
    follower = Follower(truth.nominal, MEMBERS)
    _run(follower, truth, 0.5)
    rough = _known(truth, State.ROUGH)
    assert _take(follower, rough) and _take(follower, _known(truth))
    same = Follower(truth.nominal, MEMBERS)
    same.restore(follower.snapshot())
    for one in (follower, same):
        _run(one, truth, 0.6, 0.5)
        assert not _take(one, rough)  # the estimate is refused, because only 0.1 s of its window of 1 s is new
        _run(one, truth, 0.8, 0.6)
        assert _take(one, rough)


def test_twins_have_the_friction_that_an_estimate_finds(truth: Truth) -> None:
    estimate = replace(_known(truth), differs={"friction.coefficient": (0.9, 0.1, 0.02)})
    members = Ensemble(truth.nominal, estimate, FEWEST, np.random.default_rng(0), 0.0, TOLERANCE, np.zeros(PAIR_COUNT))
    assert members.first.scene.friction == Friction(0.1)
    assert members.others is not None
    drawn = [scene.friction.coefficient for scene in members.others.scenes if scene.friction is not None]
    assert len(drawn) == FEWEST - 1 and 0.01 < np.std(drawn) < 0.03
    follower = Follower(truth.nominal, FEWEST)
    without = follower.signature
    _run(follower, truth, 0.2)
    # the nominal scene alone decides which changes of the model add terms
    assert _take(follower, estimate) and follower.signature == without
    restored = Follower(truth.nominal, FEWEST)
    restored.restore(follower.snapshot())
    assert np.array_equal(_run(restored, truth, 0.4, 0.2), _run(follower, truth, 0.4, 0.2))
    assert restored.digest() == follower.digest()
    # kernels with friction are compiled only for a friction that is more probable than not
    improbable = replace(estimate, differs={"friction.coefficient": (0.4, 0.1, 0.02)})
    members = Ensemble(
        truth.nominal, improbable, FEWEST, np.random.default_rng(0), 0.0, TOLERANCE, np.zeros(PAIR_COUNT)
    )
    assert members.first.scene.friction is None
    assert not rubs(replace(truth.nominal, wear=Wear(1e-14, pad_area_m2=0.02, travel_speed_m_s=0.5)), estimate)


def test_kernels_with_friction_are_compiled_at_the_start_only_without_a_cache(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled: list[Scene] = []
    monkeypatch.setattr("plow_twin.estimate.follow.compile_friction", lambda scene, tol: compiled.append(scene))
    follower = Follower(truth.nominal, FEWEST)
    for kept, expected in ((True, []), (False, [truth.nominal])):
        monkeypatch.setattr("plow_twin.estimate.follow.kept_on_disk", lambda kept=kept: kept)
        follower.warm_up()
        assert compiled == expected


def test_a_change_of_numbers_is_accepted_when_members_are_overdamped(truth: Truth) -> None:
    twin = Follower(truth.nominal, FEWEST)
    overdamped = replace(_known(truth), damping=Interval.normal(1e3, 1.0))
    twin._draw(json.dumps(overdamped.as_dict()), 0.0, np.zeros(PAIR_COUNT))
    changed = changed_twin(twin, truth.nominal, {"clearance.horizontal_m": 0.024})
    assert isinstance(changed, Follower)
    assert changed.scene.clearance.horizontal_m == 0.024


def test_a_changed_model_is_followed_from_its_prior(truth: Truth) -> None:
    session = Session(Follower(truth.nominal, MEMBERS), 0)
    load, following = truth.load, session.following
    assert isinstance(following, Follower)
    for t, wrench in zip(load.t[:101], load.wrench[:101].tolist(), strict=True):
        session.apply(Sample(round(t * 1e9), tuple(wrench)))
        if t == load.t[97]:
            session.apply(Estimated(0, 1, 1, 1, (), (0.0,) * 6, json.dumps(_known(truth).as_dict())))
    assert following.estimate is not None
    changes = {"clearance.horizontal_m": 0.010, "clearance.vertical_m": 0.012}
    session.apply(SetModel(10**9, json.dumps(changes)))
    other = session.following
    assert isinstance(other, Follower) and other.estimate is None and other.time == 1.0
    value, low, high = other.clearance().T
    assert (low < [0.010, 0.012]).all() and (high > [0.010, 0.012]).all() and (value < 0.02).all()


def test_a_restored_motion_keeps_the_harmonics_of_the_load_in_phase(truth: Truth) -> None:
    def applied(session: Session, rows: slice, later_s: float = 0.0) -> None:
        for t, wrench in zip(truth.load.t[rows].tolist(), truth.load.wrench[rows].tolist(), strict=True):
            session.apply(Sample(round((t + later_s) * 1e9), tuple(wrench)))

    session = Session(Follower(truth.nominal, MEMBERS), 0)
    applied(session, slice(51))
    wave = Harmonics(2.0, (2,), np.ones(3), np.array([[0.0] * 3, [1e3] * 3, [0.0] * 3]), np.zeros((3, 3)))
    text = json.dumps(replace(_known(truth), load_harmonics=wave).as_dict())
    session.apply(Estimated(200_000_000, 500_000_000, 1, 1, (), (0.0,) * 6, text))
    applied(session, slice(51, 54))
    following, saved = session.following, session.snapshot().data
    assert isinstance(following, Follower) and following.estimate is not None
    before = following.estimate.load_harmonics
    applied(session, slice(54, 101))
    session.apply(Restore(10**9, saved))
    assert following.estimate.load_harmonics is None and following.time == pytest.approx(0.53)
    again = Session(Follower(truth.nominal, MEMBERS))
    again.apply(session.snapshot())
    for one in (session, again):
        applied(one, slice(101, 103), 0.02)
        assert isinstance(one.following, Follower) and one.following.estimate is not None
        after = one.following.estimate.load_harmonics
        assert before is not None and after is not None and one.origin_ns is not None
        stamps = np.array([1.03, 1.4])
        assert after.at(stamps - 1e-9 * one.origin_ns) == pytest.approx(before.at(stamps), rel=1e-6)
    assert session.twin.digest() == again.twin.digest()


def test_late_poses_correct_the_motion_and_very_late_poses_have_no_effect(truth: Truth, forces: Array) -> None:
    def error(late: float) -> float:
        follower = Follower(truth.nominal, MEMBERS)
        _take(follower, replace(_known(truth), gain_m=Interval.normal(truth.gain[2] + 0.05, 0.05)))
        return _error(_run(follower, truth, 3.0, late=late)[100:], forces[100:301])

    alone = error(LATEST_S + 1.0)
    assert error(0.06) < 0.7 * alone
    follower, same = Follower(truth.nominal, MEMBERS), Follower(truth.nominal, MEMBERS)
    for one in (follower, same):
        _run(one, truth, 1.0)
    follower.add_pose(1.0 - 2.0 * LATEST_S, np.full(3, 0.1))
    assert np.array_equal(_run(follower, truth, 1.1, 1.005), _run(same, truth, 1.1, 1.005))


def test_intervals_allow_for_the_load_error_of_a_rough_estimate(truth: Truth, forces: Array) -> None:
    """The assumed load lacks a constant force of 4 kN, an eighth of the load's amplitude."""
    figures = {f"load_error_{name}": 0.01 for name in ("fx", "fy", "m")}
    rough = replace(_known(truth, State.ROUGH), figures=figures)
    wrench = truth.load.wrench + np.array([4e3, 0.0, 0.0])
    held, rows_used = {}, slice(200, 401)
    for name, estimate in (("plain", _known(truth)), ("rough", rough)):
        follower = Follower(truth.nominal, MEMBERS)
        follower.every_row = True
        _run(follower, truth, 1.0)
        assert _take(follower, estimate)
        off = replace(truth, load=replace(truth.load, wrench=wrench))
        _run(follower, off, 1.995, 1.0)
        saved, rows_given = follower.snapshot(), np.zeros(201, ROW)
        for one in (follower, Follower(truth.nominal, MEMBERS)):
            one.every_row = True
            one.restore(saved)
            rows = np.zeros(201, ROW)
            for row, index in enumerate(range(200, 401)):
                one.add_pose(float(truth.poses.t[index - 1]), truth.poses.q[index - 1])
                one.advance_rows(off.load.t[index : index + 1], wrench[index : index + 1], rows[row : row + 1])
            assert one is follower or np.array_equal(rows, rows_given)
            rows_given = rows
        true = forces[rows_used]
        inside = (rows_given["force_low"] <= true) & (true <= rows_given["force_high"])
        held[name] = float(inside[true > 0.0].mean())
    assert held["plain"] < 0.6 and held["rough"] > 0.8


def test_a_machine_without_gravity_is_corrected_by_poses(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    moved, move = [], TwinBatch.move

    def counted(twins: TwinBatch, which: Array, q: Array, v: Array) -> None:
        moved.append(len(which))
        move(twins, which, q, v)

    monkeypatch.setattr(TwinBatch, "move", counted)
    nominal = replace(truth.nominal, gravity=replace(truth.nominal.gravity, acceleration_m_s2=0.0))
    _run(Follower(nominal, MEMBERS), truth, 1.0)
    # here the weight is zero; if a share of the weight limited the force of a wall, hardly any member would move
    assert np.mean(moved) > MEMBERS / 3


def test_a_member_is_never_pushed_into_a_hard_wall() -> None:
    truth = draw(replace(GROUPS["hard"], periods=0.7), 71102)
    follower = Follower(truth.nominal, MEMBERS)
    _take(follower, _known(truth))
    followed = _run(follower, truth, float(truth.load.t[-1]))
    true = simulate(truth.scene, float(truth.load.t[-1]), 1e-4, 1e-6).force
    assert np.isfinite(followed).all()
    assert follower.span().peak[0].max() < 3.0 * true.max()


def test_stiffness_and_gains_of_a_hard_contact_are_learned_from_the_poses() -> None:
    truth = draw(replace(GROUPS["hard"], periods=1.6), 71102)
    stiffness = truth.scene.contact.stiffness
    open_ = replace(
        _known(truth), stiffness=Interval(stiffness / 6.0, stiffness / 60.0, 6.0 * stiffness),
        gain_fx=Interval.normal(truth.gain[0] + 0.05, 0.05), gain_m=None,
    )  # fmt: skip
    follower, same = Follower(truth.nominal, MEMBERS), Follower(truth.nominal, MEMBERS)
    _take(follower, open_)
    _run(follower, truth, 2.5)
    same.restore(follower.snapshot())
    for one in (follower, same):
        _run(one, truth, 4.0, 2.5)
    assert follower.digest() == same.digest()
    follower.span()
    _run(follower, truth, 5.0, 4.0)
    peak = simulate(truth.scene, 5.0, 1e-4, 1e-6).force[40_000:].max()
    # twins with the stiffness of the estimate would have less than half of this peak
    assert follower.span().peak[0].max() == pytest.approx(peak, rel=0.25)
    # a twin that follows by parameters alone retains the parameters learned before
    follower.follow_parameters()
    _run(follower, truth, 5.02, 5.0)
    alone = Follower(truth.nominal, 1)
    alone.restore(follower.snapshot())
    assert alone.digest() == follower.digest()


def test_a_wrong_bias_of_the_sensor_is_learned_with_a_hard_contact() -> None:
    truth = draw(replace(GROUPS["hard"], periods=1.3), 71102)
    wrong = np.array([4e-4, -4e-4, 2e-3])  # the true sensor has no bias
    x, y, theta = (Interval.normal(value, abs(value) / 2.0) for value in wrong)
    follower = Follower(truth.nominal, MEMBERS)
    _take(follower, replace(_known(truth), bias_x=x, bias_y=y, bias_theta=theta))
    _run(follower, truth, 4.0)
    biases = biases_of(follower._ensemble.learned()[0])
    # first the bias of the median twin, then the mean bias of all twins
    assert (np.abs(biases[0]) < 0.6 * np.abs(wrong)).all()
    assert (np.abs(biases.mean(axis=0)) < 0.6 * np.abs(wrong)).all()


def test_twins_continue_with_changed_numbers_but_not_with_other_terms() -> None:
    scene = replace(draw(GROUPS["plain"], 3).scene, loads=())
    hard = replace(scene, contact=replace(scene.contact, stiffness=1e9, damping=0.3), clearance=Clearance(0.03, 0.02))
    changed, new = TwinBatch([scene] * 2), TwinBatch([scene, hard])
    assert changed.change([1], [hard]).all()
    for twins in (changed, new):
        twins.move([1], np.array([[0.001, 0.002, 0.01]]), np.array([[0.1, 0.0, 0.2]]))
        row = twins.advance(0.3, np.array([2e4, 0.0, 1e4]))
    assert changed.snapshot() == new.snapshot() and row.makes[1].any()
    damped = [replace(scene, contact=Contact("kelvin_voigt", 1e7, 1.0, damping=damping)) for damping in (1e4, 1e7)]
    twins = TwinBatch(damped[:1])
    assert not twins.change([0], damped[1:]).any() and twins.scenes[0] == damped[0]


def test_poses_with_missing_components_give_finite_numbers(truth: Truth) -> None:
    load, poses = _until(truth, 2.0)
    q = poses.q.copy()
    q[::3, 1], q[1::5, 0] = np.nan, np.nan
    followed = follow(truth.nominal, load, Poses(poses.t, q), MEMBERS, span=0.5)
    assert len(followed.spans) == 4
    for part in (*vars(followed.rows).values(), *(span.peak for span in followed.spans)):
        assert np.isfinite(part).all()
    assert (followed.rows.low <= followed.rows.force).all() and (followed.rows.force <= followed.rows.high).all()


def test_moving_a_twin_to_its_own_pose_changes_nothing() -> None:
    scenes = [
        replace(
            draw(GROUPS["plain"], 3).scene, loads=(), contact=Contact("exact_restitution", 1e7, 1.0, restitution=0.4)
        )
    ] * 2
    twins = TwinBatch(scenes, tol=1e-9)
    wrench = np.array([2e4, 0.0, 1e4])
    for index in range(1, 400):
        row = twins.advance(1e-3 * index, wrench)
        twins.move([1], row.q[1], row.v[1])
    assert row.makes.sum() >= 0 and np.allclose(row.force[0], row.force[1], rtol=1e-5, atol=1.0)
    assert np.allclose(row.q[0], row.q[1], atol=1e-9)


def test_too_few_members_are_refused(truth: Truth) -> None:
    with pytest.raises(ArgumentError, match="members: got 5, expected 1 or at least 20"):
        Follower(truth.nominal, 5)


def test_early_windows_grow_to_full_length_and_each_has_new_motion() -> None:
    windows = Windows(32.0, 10.0, 0.0, early=True)
    ends = []
    for index in range(4500):
        stamp = 10_000_000 * index
        windows.add_pose(stamp, (0.0, 0.0, 0.0))
        window = windows.add_load(stamp, (float(index % 7), 0.0, 0.0))
        if window is not None:
            ends.append(window.end_ns * 1e-9)
    # the window that would end at 10.8 s is skipped, because it is too early
    assert np.allclose(ends, [3.2, 4.8, 7.2, 10.0, 20.0, 30.0, 40.0])


def test_the_command_writes_a_row_for_each_sample(truth: Truth, tmp_path: Path) -> None:
    load, poses = _until(truth, 1.0)
    replace(truth, load=load, poses=poses).write(tmp_path / "in")
    done = plow_twin_here(
        "estimate", tmp_path / "in", "--follow", "--follow-members", "20", "--out", tmp_path / "out", "--quiet"
    )
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out" / "followed.csv").open() as stream:
        names, *rows = list(csv.reader(stream))
    points = ("", "/p05", "/p95")
    assert names == ["t", *(f"{name}{point}" for name in (*PAIR_NAMES, "horizontal", "vertical") for point in points)]
    assert np.allclose([float(row[0]) for row in rows], load.t, rtol=1e-12)
    followed = follow(truth.nominal, load, poses, 20)
    assert np.allclose(np.array(rows, dtype=float), table(followed.rows)[1], rtol=1e-6)
    refused = plow_twin_here("estimate", tmp_path / "in", "--follow")
    assert refused.returncode == 2 and "expected the folder for followed.csv" in refused.stderr
    dense = ("--follow", "--follow-dt", "1e-9", "--out", tmp_path / "dense")
    refused = plow_twin_here("estimate", tmp_path / "in", *dense)
    assert refused.returncode == 2 and "rows, expected at most 10000000 rows" in refused.stderr
    t = np.where(load.t < 0.5, load.t, load.t + 1e9)
    replace(truth, load=Load(t, load.wrench), poses=poses).write(tmp_path / "stepped")
    refused = plow_twin_here("estimate", tmp_path / "stepped", "--follow", "--out", tmp_path / "none")
    assert refused.returncode == 2 and "1e+09 s between two samples, expected at most 3600 s" in refused.stderr
