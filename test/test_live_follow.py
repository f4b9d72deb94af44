"""A live twin that follows its machine: estimates are adopted, withdrawn, corrected, and replayed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from ros_processes import Probe, bench, value
from scenes import ROOT, gaps_at
from sensor_msgs.msg import JointState

from plow_twin import Clearance, Initial, Twin, Wear, simulate
from plow_twin.estimate.follow import Follower, follower
from plow_twin.estimate.followed import follow
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.members import Ensemble
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.live import diagnostics, parameters
from plow_twin.live.estimation import problems
from plow_twin.live.runtime import Runtime
from plow_twin.live.solver_start import Preparation
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.messages import Message
from plow_twin.record.replay import replay
from plow_twin.ros.messages import set_stamp
from plow_twin.run.batch import TwinBatch
from plow_twin.scene_file import dump_scene
from plow_twin.solve.state import FOLLOWED, ROW, WITH_INTERVALS
from plow_twin.stream import insertion
from plow_twin.stream.driven import PREPARATION_S
from plow_twin.stream.journal import (
    Digest,
    Entry,
    Estimated,
    Hold,
    Parameter,
    PartOfPose,
    Pose,
    Reset,
    Restore,
    Sample,
    SetModel,
    SetWear,
    Snapshot,
    Travel,
)
from plow_twin.stream.outputs import CLEARANCE_NAMES, NONE, Published
from plow_twin.stream.session import Session
from plow_twin.stream.topics import TOPICS
from plow_twin.study.analysis.analyse import analyse
from plow_twin.view import layout, to_rrd

sys.path.insert(0, str(ROOT / "benchmark"))
from estimate_truths import GROUPS, Truth, draw

Array = NDArray[np.float64]
MEMBERS, T0, SPAN_S = 24, 1_795_000_000_000_000_000, 1.0


@pytest.fixture(scope="module")
def truth() -> Truth:
    """Return a machine with a soft contact, 8 mm more horizontal clearance than assumed, and gain errors up to 10 %."""
    return draw(replace(GROUPS["plain"], stiffness=(3e6, 3e8), periods=2.2), 71003)


def _stamp(t: float) -> int:
    return T0 + round(t * 1e9)


def _samples(truth: Truth, begin: float, end: float) -> list[Sample]:
    return [
        Sample(_stamp(t), (fx, fy, m))
        for t, (fx, fy, m) in zip(truth.load.t.tolist(), truth.load.wrench.tolist(), strict=True)
        if begin <= t < end
    ]


def _poses(truth: Truth, begin: float, end: float) -> list[Pose]:
    return [
        Pose(_stamp(t), tuple(q))
        for t, q in zip(truth.poses.t.tolist(), truth.poses.q.tolist(), strict=True)
        if begin <= t < end
    ]


def _in_turn(truth: Truth, begin: float, end: float) -> list[Entry]:
    entries: list[Sample | Pose] = [*_samples(truth, begin, end), *_poses(truth, begin, end)]
    return sorted(entries, key=lambda entry: (entry.stamp_ns, isinstance(entry, Pose)))


def _known(truth: Truth, state: State = State.ESTIMATED) -> Estimated:
    """Return an estimate with the accuracy of an estimate from ten load periods."""
    clearance, contact = truth.scene.clearance, truth.scene.contact
    assert contact.damping is not None
    fx, fy, m = (Interval.normal(gain, 0.003) for gain in truth.gain)
    horizontal, vertical = (Interval.normal(value, 3e-5) for value in (clearance.horizontal_m, clearance.vertical_m))
    result = Estimate(
        0.0, 1.0, horizontal, vertical, state, state,
        Interval.normal(contact.stiffness, 2e-3 * contact.stiffness), Interval.normal(contact.damping, 5e-3),
        fx, fy, m, noise=(5e-4, 5e-4, 2e-3),
    )  # fmt: skip
    return Estimated(0, 1, 2, 3, (), (0.0,) * 6, json.dumps(result.as_dict()))


#: A change of the model: the horizontal clearance is smaller by 1 mm.
OTHER = SetModel(T0, json.dumps({"clearance.horizontal_m": 0.024}))


class Live:
    """A session of a twin that follows its machine, with its journal and its publications."""

    def __init__(self, scene: Scene, how: str = "full", *, defers: bool = False) -> None:
        self.journal: list[Entry] = []
        self.published: list[Published] = []
        twin = follower(scene, how, MEMBERS, 1e-9)
        twin.defers = defers
        self.session = Session(twin, on_entry=self.journal.append, rollback_span_s=SPAN_S)

    @property
    def twin(self) -> Follower:
        assert isinstance(self.session.following, Follower)
        return self.session.following

    def take(self, entries: Sequence[Entry]) -> None:
        for entry in entries:
            if isinstance(entry, Sample):
                self.published.append(self.session.apply_samples([entry], each=True).published)
                if len(self.published) % 3:
                    self.session.catch_up()
            else:
                self.session.apply(entry)

    def poses(self) -> Array:
        """Return the present pose of each member, shape (m, 3)."""
        self.session.catch_up()
        return self.twin._ensemble.pose.copy()

    def column(self, name: str) -> Array:
        return np.concatenate([publication.rows[name] for publication in self.published])

    def clearance(self) -> Array:
        """Return the newest published clearances, each with the ends of its interval, shape (2, 3)."""
        slow = next(one.slow for one in reversed(self.published) if len(one.slow))
        published = dict(zip(CLEARANCE_NAMES, slow["clearance"][-1].tolist(), strict=True))
        return np.array(
            [[published[f"{axis}{end}"] for end in ("", "/p05", "/p95")] for axis in ("horizontal", "vertical")]
        )


def _error(force: Array, true: Array) -> float:
    return float(np.sqrt(((force - true) ** 2).sum() / (true**2).sum()))


@pytest.mark.parametrize("how", ["parameters", "full"])
def test_a_valid_estimate_is_adopted_and_undone_after_its_withdrawal(truth: Truth, how: str) -> None:
    live = Live(truth.nominal, how)
    live.take(_in_turn(truth, 0.0, 3.0))
    nominal, prior = live.column("force"), live.clearance()
    assert 0.02 < prior[0, 2] - prior[0, 1] < 0.04 or how == "full"
    live.take([_known(truth)])
    live.published.clear()
    live.take(_in_turn(truth, 3.0, 6.0))
    adopted = live.clearance()
    assert adopted[:, 0] == pytest.approx(truth.clearance, abs=1e-6) and (np.ptp(adopted, axis=1) < 2e-4).all()
    fine = simulate(truth.scene, 6.0, 1e-3, 1e-6).force
    assert _error(nominal, fine[:3000:10][: len(nominal)]) > (0.3 if how == "parameters" else 0.1)
    # a single twin starts with a wrong pose and needs some load periods to forget it; twins steered by poses do not
    first, most, above = (150, 0.2, 1.3) if how == "parameters" else (50, 0.03, 1.1)
    assert _error(live.column("force")[first:], fine[3000::10][first : len(live.column("force"))]) < most
    # no impact occurs when the estimate is adopted
    assert (live.column("peak").max(axis=0) < above * fine[2900:].max(axis=0) + 2e3).all()
    assert (live.column("followed") == WITH_INTERVALS).all() == (how == "full")
    live.take([_known(truth, State.WITHDRAWN), *_in_turn(truth, 6.0, 6.3)])
    assert live.twin.estimate is None and (np.ptp(live.clearance(), axis=1) > 5e-3).all()


@pytest.mark.parametrize(
    "change",
    [
        Reset(T0, "asked for"),
        SetWear(T0, (0.0,) * 8, "new pads"),
        SetModel(T0, json.dumps({"clearance.horizontal_m": 0.020, "wear.coefficient_m2_n": 1e-13})),
    ],
)
def test_another_machine_is_followed_from_its_prior(truth: Truth, change: Entry) -> None:
    scene = replace(truth.nominal, wear=Wear(2e-14, 0.015, 2.0))
    live = Live(scene)
    live.take([*_in_turn(truth, 0.0, 0.5), _known(truth), *_in_turn(truth, 0.5, 0.7)])
    assert live.twin.estimate is not None and live.session.wear_depth.any()
    live.take([change, *_in_turn(truth, 0.7, 0.8)])
    assert live.twin.estimate is None
    prior = Live(live.session.twin.scene)
    prior.take(_samples(truth, 0.0, 0.1))
    assert live.clearance() == pytest.approx(prior.clearance(), abs=1e-6)


@pytest.mark.parametrize("before", ["nothing", "withdrawn", "other numbers"])
def test_without_an_estimate_poses_do_not_move_the_median_twin(truth: Truth, before: str) -> None:
    """The clearances of the machine are larger by 1.5 mm.

    The nominal twin, steered to its poses, would press its walls.
    """
    clearance, begin, end = truth.nominal.clearance, 0.0 if before == "nothing" else 1.0, 3.0
    wider = Clearance(clearance.horizontal_m + 1.5e-3, clearance.vertical_m + 1.5e-3)
    run = simulate(replace(truth.nominal, clearance=wider), end, 0.01, 1e-6)
    noise = np.random.default_rng(7).standard_normal(run.q.shape) * [5e-4, 5e-4, 2e-3]
    machine = replace(truth, poses=Poses(run.t, run.q + noise))
    with_poses, without = Live(truth.nominal), Live(truth.nominal)
    for live, later in ((with_poses, _in_turn), (without, _samples)):
        live.take(_in_turn(machine, 0.0, begin))
        if before != "nothing":
            live.take([_known(truth), *_in_turn(machine, begin, 1.5)])
            # the twins follow the prior from `PREPARATION_S` after the withdrawal
            withdrawn = [_known(truth, State.WITHDRAWN), *_in_turn(machine, 1.5, 1.53)]
            live.take(withdrawn if before == "withdrawn" else [OTHER])
            live.published.clear()
        live.take(later(machine, {"nothing": begin, "withdrawn": 1.53}.get(before, 1.5), end))
    followed, nominal = with_poses.column("force"), without.column("force")
    assert with_poses.twin.poses.used > without.twin.poses.used + 100
    assert _error(followed, nominal) < 1e-9
    assert before != "nothing" or _error(followed, run.force[: len(followed)]) < 0.08


def test_wear_continues_from_its_depth_and_widens_the_estimate(truth: Truth) -> None:
    wear = Wear(2e-11, 0.015, 2.0, initial_depth_m=(1e-3,) * 8)
    live = Live(replace(truth.nominal, wear=wear))
    live.take(_in_turn(truth, 0.0, 1.97))
    before = live.session.wear_depth
    live.take([_known(truth), *_in_turn(truth, 1.97, 2.011)])
    assert (live.session.wear_depth >= before).all() and before.min() >= 1e-3
    at_first, since = live.clearance(), live.session.wear_depth - before
    # the estimated clearance is that at the arrival of the estimate
    assert at_first[0, 0] == pytest.approx(truth.clearance[0] + 0.5 * since[[1, 3, 5, 7]].sum(), abs=2e-6)
    live.take(_in_turn(truth, 2.011, 4.0))
    growth = live.session.wear_depth - before
    assert (growth >= 0.0).all() and growth.max() > 1e-6
    # the last message is 0.1 s old, so it does not contain the wear of the last 0.1 s
    assert live.clearance()[0, 0] - at_first[0, 0] == pytest.approx(0.5 * growth[[1, 3, 5, 7]].sum(), rel=0.2)


def test_intervals_of_peaks_and_impulses_belong_to_the_published_span(truth: Truth) -> None:
    live = Live(truth.nominal)
    live.take(_in_turn(truth, 0.0, 1.0))
    for name in ("force", "peak", "impulse"):
        value, low, high = (live.column(f"{name}{end}") for end in ("", "_low", "_high"))
        assert (low <= value).all() and (value <= high).all() and (high > low).any()
    # each peak in a long publication is at least as large as the peaks in the short publications of its time
    other = Live(truth.nominal)
    for entry in _in_turn(truth, 0.0, 1.0):
        other.session.apply(entry)
    whole = other.session.outputs.pop().rows
    assert (whole["peak_high"][0] >= live.column("peak_high").max(axis=0)).all()
    assert (whole["peak_high"][0] >= whole["peak"][0]).all() and whole["followed"][0] == WITH_INTERVALS
    assert whole["impulse"][0] == pytest.approx(live.column("impulse").sum(axis=0))
    assert (whole["impulse_low"][0] >= 0.99 * live.column("impulse_low").sum(axis=0)).all()


def _again(journal: Sequence[Entry], scene: Scene, at_once: int = 1) -> Session:
    """Run a journal again in batches of samples, and compare the digests."""
    session, run = Session(follower(scene, "full", MEMBERS, 1e-9), rollback_span_s=SPAN_S), list[Sample]()

    def advance() -> None:
        if run:
            stamps = np.array([sample.stamp_ns for sample in run])
            session.advance(stamps, np.array([sample.wrench for sample in run]), np.zeros(len(run), ROW), NONE)
            run.clear()

    for entry in journal:
        late = isinstance(entry, Sample) and entry.stamp_ns <= (session.stamp_ns or 0)
        if isinstance(entry, Sample) and at_once > 1 and not late:
            if run and entry.stamp_ns <= run[-1].stamp_ns:
                advance()
            if entry.stamp_ns > (session.stamp_ns or 0):
                run.append(entry)
                if len(run) == at_once:
                    advance()
                continue
        advance()
        if isinstance(entry, Digest):
            assert session.twin.digest() == entry.digest
        elif not isinstance(entry, Snapshot):
            session.apply(entry)
    advance()
    return session


def test_late_samples_and_poses_give_the_same_bits_as_ordered_measurements(truth: Truth) -> None:
    entries = [*_in_turn(truth, 0.0, 0.7), _known(truth), *_in_turn(truth, 0.7, 1.4)]
    ordered, late = Live(truth.nominal), Live(truth.nominal)
    ordered.take(entries)
    # samples are late by up to 0.3 s, some after the estimate, so that poses are used late too
    rng = np.random.default_rng(1)

    def due(place: int) -> float:
        entry = entries[place]
        return place + (60.0 * float(rng.random()) if isinstance(entry, Sample) and place > 10 else 0.0)

    order = sorted(range(len(entries)), key=due)
    late.take([entries[place] for place in order])
    assert late.session.stamp_ns == ordered.session.stamp_ns
    again = _again(late.journal, truth.nominal)
    assert again.twin.digest() == late.twin.digest()
    assert again.following is not None and again.following.added == late.twin.added
    # a pose that is used again after a late sample counts once
    poses = late.twin.poses
    assert again.following.poses == poses and 0 < poses.used + poses.outlying <= len(_poses(truth, 0.0, 1.4))
    assert _again(ordered.journal, truth.nominal, 1000).twin.digest() == ordered.twin.digest()
    force, expected = (one.session.twin.advance(one.twin.time).force for one in (late, ordered))
    assert force == pytest.approx(expected, rel=0.02, abs=2e3)


def test_publications_do_not_change_the_motion_with_late_poses_samples_and_holds(truth: Truth) -> None:
    """The last publication limits how late a sample can be."""
    live, part = Live(truth.nominal), _in_turn(truth, 0.5, 1.5)
    live.take([*_in_turn(truth, 0.0, 0.5), _known(truth), *part[30:60], *part[:30], *part[90:120], *part[60:90]])
    live.take([Hold(_stamp(1.2)), *part[150:], _known(truth, State.WITHDRAWN), *_in_turn(truth, 1.5, 1.6)])
    live.session.close()
    assert isinstance(live.journal[-1], Digest)
    # the second run publishes nothing, and its state is bit-identical
    assert _again(live.journal, truth.nominal).twin.digest() == live.twin.digest()


def test_a_later_run_can_continue_from_a_snapshot(truth: Truth) -> None:
    live = Live(truth.nominal)
    live.take([*_in_turn(truth, 0.0, 0.6), _known(truth), *_in_turn(truth, 0.6, 0.8), *_poses(truth, 0.81, 0.85)])
    snapshot = live.session.renew()
    other = Live(truth.nominal)
    other.session.apply(snapshot)
    for one in (live, other):
        one.published.clear()
        part = PartOfPose(_stamp(0.995), (0, 2), (0.001, 0.0))
        one.take([*_in_turn(truth, 0.85, 1.0), part, *_samples(truth, 1.0, 1.1)])
    for name in ROW.names or ():
        assert np.array_equal(live.column(name), other.column(name)), name
    assert live.twin.digest() == other.twin.digest()
    # `restore` restores the earlier motion, but not the earlier wear
    live.take([Restore(_stamp(1.1), snapshot.data), *_in_turn(truth, 0.8, 0.9)])
    # the next sample continues from the restored time
    assert live.twin.time == pytest.approx(0.88) and np.isfinite(live.column("force")).all()
    assert _again(live.journal, truth.nominal).twin.digest() == live.twin.digest()


def test_live_and_offline_give_the_same_rows(truth: Truth) -> None:
    """The live run gets the estimates of the offline run at the same rows."""
    end = truth.load.t < 5.0
    load = replace(truth.load, t=truth.load.t[end], wrench=truth.load.wrench[end])
    early = truth.poses.t < 5.0
    poses = replace(truth.poses, t=truth.poses.t[early], q=truth.poses.q[early])
    offline = follow(truth.nominal, load, poses, MEMBERS)
    assert offline.taken_over
    live = Live(truth.nominal)
    entries = _in_turn(truth, 0.0, 5.0)
    for one in offline.taken_over:
        text = json.dumps(one.estimate.as_dict())
        later = (isinstance(entry, Sample) and entry.stamp_ns > _stamp(one.t) for entry in entries)
        place = next(place for place, is_later in enumerate(later) if is_later)
        entries.insert(place, Estimated(0, 1, 2, 3, (), (0.0,) * 6, text))
    live.take(entries)
    rows = offline.rows
    assert np.array_equal(live.column("force"), rows.force)
    assert np.array_equal(live.column("force_low"), rows.low) and np.array_equal(live.column("force_high"), rows.high)
    assert np.array_equal(live.column("known_clearance").reshape(-1, 2, 3), rows.clearance)


def test_twins_that_catch_up_later_give_the_same_bits(truth: Truth) -> None:
    """An event of any kind may occur before the delayed twins are advanced."""
    entries = [
        *_in_turn(truth, 0.0, 0.6), *_poses(truth, 0.3, 0.35), _known(truth), *_in_turn(truth, 0.6, 0.81),
        *_late(truth, 0.7), *_in_turn(truth, 0.81, 0.9), PartOfPose(_stamp(0.7), (0, 2), (0.001, 0.0)),
        *_in_turn(truth, 0.9, 1.0), Hold(_stamp(1.05)), *_samples(truth, 1.1, 1.2), OTHER, *_in_turn(truth, 1.2, 1.4),
        *_late(truth, 1.25), *_in_turn(truth, 1.4, 1.5),
    ]  # fmt: skip
    later, at_once = Live(truth.nominal, defers=True), Live(truth.nominal)
    for one in (later, at_once):
        one.take(entries)
        one.session.catch_up()
    assert later.twin.digest() == at_once.twin.digest()
    for name in ROW.names or ():
        assert np.array_equal(later.column(name), at_once.column(name)), name
    assert [entry for entry in later.journal if isinstance(entry, Digest)] == [
        entry for entry in at_once.journal if isinstance(entry, Digest)
    ]
    assert _again(later.journal, truth.nominal).twin.digest() == later.twin.digest()


@pytest.fixture
def ten_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the followers of these tests repeat ten samples at once."""
    monkeypatch.setattr(insertion, "MEMBER_SAMPLES", 10 * MEMBERS)


@pytest.mark.usefixtures("ten_at_once")
def test_a_late_sample_waits_until_a_second_set_of_twins_has_caught_up(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The result equals that of a sample that arrives at the end of the insertion and is inserted at once."""
    live, other = Live(truth.nominal, defers=True), Live(truth.nominal)
    for one in (live, other):
        one.take([*_in_turn(truth, 0.0, 0.6), _known(truth), *_in_turn(truth, 0.6, 1.0)])
    late = _late(truth, 0.7)
    advance, samples = TwinBatch.advance_samples, list[int]()

    def counted(twins: TwinBatch, t: Array, wrench: Array) -> Any:
        samples[-1] += len(t)
        return advance(twins, t, wrench)

    with monkeypatch.context() as patch:
        patch.setattr(TwinBatch, "advance_samples", counted)
        samples.append(0)
        live.take(late)
        assert (live.session.waiting, samples) == (1, [0]) and not len(live.published[-1].rows)
        # poses, also late ones, and an estimate arrive meanwhile
        entries = [*_in_turn(truth, 1.0, 1.2), *_poses(truth, 0.985, 0.99), _known(truth), *_in_turn(truth, 1.2, 2.0)]
        for entry in entries:
            samples.append(0)
            waiting = live.session.waiting
            live.take([entry])
            live.session.catch_up()
            if waiting and not live.session.waiting:
                break
    place = entries.index(entry)
    # the motion since 0.7 s has 30 samples; for every five new samples, ten samples are repeated on the average
    assert 60 < place < 120 and max(samples) <= 16
    assert (
        live.column("corrected")[-2:].tolist() == [0, 1]
        and len(live.column("t")) == sum(isinstance(entry, Sample) for entry in live.journal) - 1
    )
    other.take(entries[:place])
    digests = [entry for entry in live.journal if isinstance(entry, Digest)]
    monkeypatch.setattr(insertion, "MEMBER_SAMPLES", 10**6)
    other.take([*late, entry])
    assert live.twin.digest() == other.twin.digest() and live.twin.added == other.twin.added
    for one in (live, other):
        one.published.clear()
        one.take(_in_turn(truth, 2.0, 2.2))
        one.session.catch_up()
    for name in set(ROW.names or ()) - {"marked"}:
        assert np.array_equal(live.column(name), other.column(name)), name
    assert digests == [entry for entry in live.journal if isinstance(entry, Digest)][: len(digests)]
    monkeypatch.setattr(insertion, "MEMBER_SAMPLES", 10 * MEMBERS)
    for at_once in (1, 7, 1000):
        assert _again(live.journal, truth.nominal, at_once).twin.digest() == live.twin.digest()


@pytest.mark.usefixtures("ten_at_once")
@pytest.mark.parametrize("wear", [None, Wear(2e-14, 0.015, 2.0)])
def test_many_late_samples_give_the_same_bits_live_and_later(truth: Truth, wear: Wear | None) -> None:
    """Samples that are late during an insertion wait for the next one. Other entries, of each kind, come between."""
    rng, scene = np.random.default_rng(5), replace(truth.nominal, wear=wear)
    arrivals: list[tuple[float, Entry]] = []
    for entry in _in_turn(truth, 0.0, 2.4):
        t = (entry.stamp_ns - T0) * 1e-9
        delay = 0.7 * float(rng.random()) if t > 0.1 and rng.random() < 0.08 else 0.0
        arrivals.append((t + delay, entry))
    arrivals += [(0.6, _known(truth)), (1.5, _known(truth, State.WITHDRAWN)), (1.7, _known(truth))]
    arrivals += [(1.4001, Hold(_stamp(1.405))), (1.9, OTHER)]
    for t in (0.1 + 2.2 * rng.random(20)).tolist() if wear else ():
        arrivals.append((t, Travel(_stamp(t - float(rng.choice([-0.05, 0.0, 0.004, 0.2]))), float(rng.random()))))
    entries = [*(entry for _, entry in sorted(arrivals, key=lambda arrival: arrival[0])), *_late(truth, 2.0)]
    later, at_once = Live(scene, defers=True), Live(scene)
    most = 0
    for entry in entries:
        for one in (later, at_once):
            oldest_ns = one.session.history.oldest_ns or 0
            if not isinstance(entry, Sample) or entry.stamp_ns > oldest_ns:
                one.take([entry])
        most = max(most, later.session.waiting)
    assert most > 1 and later.session.waiting
    for one in (later, at_once):
        one.session.close()
        assert not one.session.waiting
    assert later.journal == at_once.journal and isinstance(later.journal[-2], Hold)
    for name in ROW.names or ():
        assert np.array_equal(later.column(name), at_once.column(name)), name
    for count in (1, 13, 1000):
        session = _again(later.journal, scene, count)
        assert session.twin.digest() == later.twin.digest()
        assert session.travel_speed_m_s == later.session.travel_speed_m_s


@pytest.mark.usefixtures("ten_at_once")
def test_without_poses_late_samples_give_the_motion_of_ordered_samples(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Any] = []
    monkeypatch.setattr(
        Follower, "second", lambda twin, data, second=Follower.second: begun.append(second(twin, data)) or begun[-1]
    )
    ordered, late = Live(truth.nominal), Live(truth.nominal)
    samples = _samples(truth, 0.0, 2.6)
    ordered.take(samples)
    # a twin without late samples has no second set of twins
    assert not begun
    late.take(
        [*samples[:70], *samples[71:75], *samples[77:100], samples[75], samples[70], *samples[100:120], samples[76]]
    )
    assert late.session.waiting == 3 and samples[76].stamp_ns in late.session.history
    late.take(samples[120:])
    assert len(begun) == 2 and late.twin.digest() == ordered.twin.digest()


def _late(truth: Truth, t: float) -> list[Sample]:
    first, second = _samples(truth, t - 1e-6, t + 0.0101)[:2]
    return [replace(first, stamp_ns=(first.stamp_ns + second.stamp_ns) // 2)]


def _at_1_khz(truth: Truth, begin: float, end: float) -> list[Sample]:
    t = np.arange(begin, end - 1e-6, 1e-3)
    wrench = np.stack([np.interp(t, truth.load.t, column) for column in truth.load.wrench.T], axis=1)
    return [Sample(_stamp(now), (fx, fy, m)) for now, (fx, fy, m) in zip(t.tolist(), wrench.tolist(), strict=True)]


@pytest.mark.parametrize("wear", [None, Wear(2e-11, 0.015, 2.0)])
def test_twins_of_an_estimate_are_drawn_in_pieces(
    truth: Truth, wear: Wear | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_piece, prepare, pieces, compiled = Ensemble.draw_piece, Follower._prepare, [0], [0]

    def counted(ensemble: Ensemble) -> bool:
        more = draw_piece(ensemble)
        pieces[-1] += more
        return more

    def made(twins: TwinBatch, *args: Any, **kwargs: Any) -> None:
        compiled[-1] += kwargs.get("compiled") is None
        init(twins, *args, **kwargs)

    init = TwinBatch.__init__
    monkeypatch.setattr(Ensemble, "draw_piece", counted)
    monkeypatch.setattr(TwinBatch, "__init__", made)
    entries: list[Entry] = [_known(truth), _known(truth, State.WITHDRAWN), OTHER]
    digests = []
    for prepares in (True, False):
        monkeypatch.setattr(Follower, "_prepare", prepare if prepares else lambda follower: None)
        live = Live(replace(truth.nominal, wear=wear))
        live.take(_at_1_khz(truth, 0.0, 0.1))
        for begin, entry in zip((0.1, 0.2, 0.3), entries, strict=True):
            pieces[:], compiled[:] = [0], [0]
            live.take([entry])
            for sample in _at_1_khz(truth, begin, begin + 0.1):
                live.take([sample])
                live.session.catch_up()
                pieces.append(0)
                compiled.append(0)
            assert sum(pieces) >= 4
            # no sample has the work of two pieces, and none compiles the scenes of all twins with another piece
            assert (max(pieces[1:]) == 1) == prepares and not any(compiled)
        digests.append(live.twin.digest())
        # twins that were drawn early begin with the wear at their first use
        depth = live.column("wear_depth")
        assert (np.diff(depth, axis=0) >= 0.0).all() and depth.any() == (wear is not None)
    assert digests[0] == digests[1]


def test_the_median_twin_of_a_changed_model_goes_on_alone_until_others_join_it(truth: Truth) -> None:
    live, alone = Live(truth.nominal), Live(truth.nominal, "parameters")
    for one in (live, alone):
        one.take([*_at_1_khz(truth, 0.0, 0.1), OTHER, *_at_1_khz(truth, 0.1, 0.2)])
    followed, due = live.column("followed"), 100 + round(1e3 * PREPARATION_S)
    assert (followed[:100] == WITH_INTERVALS).all() and (followed[due:] == WITH_INTERVALS).all()
    assert (followed[100 : due - 1] == FOLLOWED).all()
    assert _error(live.column("force"), alone.column("force")) < 1e-6
    width = live.column("force_high")[due:] - live.column("force_low")[due:]
    assert (width >= 0.0).all() and width.any()
    assert _again(live.journal, truth.nominal).twin.digest() == live.twin.digest()


def test_members_with_overdamped_contact_need_no_other_kernel(truth: Truth) -> None:
    """Some of the drawn dampings are so large that the kernel of implicit steps would be compiled in the live twin."""
    twin = Follower(truth.nominal, 128)
    for drawn in range(20):
        twin.drawn = drawn
        twin._draw("", 0.0, np.zeros(len(PAIR_NAMES)))
        assert twin._ensemble.others is not None
        assert all(member.parts.implicit is None for member in twin._ensemble.others._compiled)


def test_penetrations_of_members_do_not_depend_on_the_centre_of_mass(truth: Truth) -> None:
    head = replace(truth.nominal.head, rotation="consistent", com_offset_m=(0.03, -0.02))
    gravity = replace(truth.nominal.gravity, arm_m=0.0)
    scene = replace(truth.nominal, head=head, gravity=gravity)
    poses = np.tile([1e-3, -2e-3, 0.01], (MEMBERS, 1))
    penetration = Follower(scene, MEMBERS)._ensemble._penetration(poses)
    # the pose is that of the cavity, so the penetrations do not depend on the centre of mass
    assert penetration[0] == pytest.approx(-gaps_at(truth.nominal, poses)[0], abs=1e-12)


@pytest.mark.parametrize("wear", [None, Wear(2e-14, 0.015, 2.0)])
def test_a_restored_motion_continues_with_the_present_estimate(truth: Truth, wear: Wear | None) -> None:
    live = Live(replace(truth.nominal, wear=wear))
    live.take(_in_turn(truth, 0.0, 0.5))
    before = live.session.snapshot()
    live.take([_known(truth), *_in_turn(truth, 0.5, 0.7)])
    adopted = live.clearance()
    live.take([Restore(_stamp(0.7), before.data), *_in_turn(truth, 0.7, 0.9)])
    assert live.twin.estimate is not None and live.clearance() == pytest.approx(adopted, abs=1e-7)
    known_then = live.session.snapshot()
    live.take([_known(truth, State.WITHDRAWN), Restore(_stamp(0.9), known_then.data), *_in_turn(truth, 0.9, 1.0)])
    assert live.twin.estimate is None
    assert _again(live.journal, live.session.twin.scene).twin.digest() == live.twin.digest()


def test_counts_of_poses_continue_after_a_change_of_the_model_and_a_restore(truth: Truth) -> None:
    live = Live(truth.nominal)
    start = live.session.snapshot()
    live.take(_in_turn(truth, 0.0, 0.5))
    used = live.twin.poses.used
    live.take([Restore(_stamp(0.5), start.data)])
    assert live.twin.poses.used == used > 0
    live.take([OTHER])
    assert live.twin.poses.used == used


def test_a_digest_can_be_requested_several_times_for_a_sample(truth: Truth) -> None:
    t, marks = np.array([0.01, 0.02, 0.03]), np.array([2, 2, 3])
    for twin in (Follower(truth.nominal, MEMBERS), Twin(truth.nominal, excitation="sampled")):
        digests = twin.advance_rows(t, np.zeros((3, 3)), np.zeros(3, ROW), marks).digests
        assert digests[0] == digests[1] and len(digests) == 3 and digests[2] == twin.digest()


def test_a_locked_degree_of_freedom_is_not_moved_by_measurements(truth: Truth) -> None:
    locked = replace(truth.nominal, locked=("theta", "x"), initial=Initial(q=(0.004, 0.0, 0.01)))
    live = Live(locked)
    change = SetModel(_stamp(0.7), json.dumps({"clearance.horizontal_m": 0.020}))
    live.take([*_in_turn(truth, 0.0, 0.5), _known(truth), *_in_turn(truth, 0.5, 0.7)])
    assert live.twin.poses.used > 10 and live.twin.drawn == 1
    live.take([change, *_in_turn(truth, 0.7, 0.8)])
    q = live.poses()
    assert q[:, [0, 2]] == pytest.approx(np.tile([0.004, 0.01], (MEMBERS, 1)), abs=1e-12) and np.ptp(q[:, 1]) > 0.0


@pytest.mark.parametrize("wrong", [(0.05, 0.0, 0.0), (-0.09, 0.09, -0.5), (0.0, 0.0, 1e200), (1e308, 1e308, 0.0)])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_single_wrong_pose_moves_nothing(truth: Truth, wrong: tuple[float, float, float]) -> None:
    live, other = Live(truth.nominal), Live(truth.nominal)
    for one, poses in ((live, [Pose(_stamp(0.505), wrong)]), (other, [])):
        one.take([*_in_turn(truth, 0.0, 0.505), *poses, *_in_turn(truth, 0.505, 0.6)])
    assert live.twin.poses.outlying == 1 and live.twin.digest() == other.twin.digest()
    value, low, high = live.clearance().T
    assert (low < value).all() and (value < high).all()


def test_a_jump_of_the_head_is_followed_and_angles_are_equal_up_to_full_turns(truth: Truth) -> None:
    live, other = Live(truth.nominal), Live(truth.nominal)
    entries = _in_turn(truth, 0.0, 1.0)
    for one, turn in ((live, 2.0 * np.pi), (other, 0.0)):
        one.take(
            Pose(entry.stamp_ns, (entry.pose[0], entry.pose[1], entry.pose[2] + turn))
            if isinstance(entry, Pose)
            else entry
            for entry in entries
        )
    assert live.twin.poses.outlying == 0
    assert live.column("force")[-1] == pytest.approx(other.column("force")[-1], rel=1e-3, abs=1e3)
    used = live.twin.poses.used
    side = -0.012 * np.sign(live.poses()[0, 0])
    for index in range(20):
        begin = 1.0 + 0.01 * index
        live.take([Pose(_stamp(begin), (side, 0.0, 0.0)), *_samples(truth, begin, begin + 0.01)])
    assert live.twin.poses.outlying >= 1 and live.twin.poses.used >= used + 10
    assert np.median(live.poses()[:, 0]) == pytest.approx(side, abs=3e-3)


def test_twins_outside_the_range_of_the_model_recover_at_the_next_pose(truth: Truth) -> None:
    live, lost = Live(truth.nominal), list[int]()
    for entry in _in_turn(truth, 0.0, 1.0):
        live.take([entry])
        lost.append(live.twin.lost)
    assert max(lost) > 0 and lost[-1] == 0


def test_waiting_poses_are_limited_and_counted_and_no_estimate_is_dropped(truth: Truth) -> None:
    live = Live(truth.nominal)
    live.take(_in_turn(truth, 0.0, 0.5))
    live.take([Pose(_stamp(t), (0.0, 0.0, 0.0)) for t in (3601.0, 7200.0)])
    assert live.session.poses_dropped == 2
    before, more = live.twin.added, 10_050
    # a late sample would need all of these poses, so they are stored while the load is silent
    live.take([Pose(_stamp(0.51) + 100_000 * index, (0.0, 0.0, 0.0)) for index in range(more)])
    assert live.session.poses_dropped == 2 + before + more - 10_000
    assert live.twin.poses.dropped == more - 10_000
    live.twin.add_estimate(_known(truth).result, 0.505)
    live.take(_samples(truth, 0.5, 0.52))
    assert live.twin.estimate is not None


def test_without_measurements_the_median_twin_is_the_nominal_twin(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TwinBatch, "move", lambda *_: pytest.fail("a member was moved"))
    live = Live(truth.nominal)
    live.take(_samples(truth, 0.0, 1.0))
    plain = Session(Twin(truth.nominal, excitation="sampled"))
    rows = np.concatenate([plain.apply_samples([sample]).rows for sample in _samples(truth, 0.0, 1.0)])
    assert _error(live.column("force"), rows["force"]) < 1e-3
    assert (live.clearance() == live.column("known_clearance")[0].reshape(2, 3)).all()
    assert not rows["followed"].any()


def test_twins_that_are_too_slow_are_replaced_by_a_single_twin(truth: Truth) -> None:
    live = Live(truth.nominal)
    live.take([*_in_turn(truth, 0.0, 0.5), _known(truth), *_in_turn(truth, 0.5, 1.0)])
    force, steered = live.column("force")[-1], live.session.snapshot()
    live.take([Parameter("follow", "parameters"), *_in_turn(truth, 1.0, 1.1)])
    assert live.twin.members == 1 and live.twin.estimate is not None
    assert live.column("force")[100] == pytest.approx(force, rel=0.2, abs=1e4)
    assert live.column("followed")[-1] == FOLLOWED
    live.take([Restore(_stamp(1.1), steered.data), *_in_turn(truth, 1.1, 1.2)])
    assert live.twin.members == 1 and live.twin.estimate is not None
    assert _again(live.journal, truth.nominal).twin.digest() == live.twin.digest()


def _play(
    probe: Probe, send: Any, poses: Any, truth: Truth, begin: float, end: float, forces: list[JointState]
) -> None:
    """Send load and poses of a part of a simulated machine's data as fast as the node publishes `forces`.

    Poses that wait for longer than `rollback_span` in the node are too late.
    """
    for index, entry in enumerate(_in_turn(truth, begin, end)):
        if index % 20 == 0 and entry.stamp_ns > _stamp(begin + 0.2):
            reached = 1e-9 * (entry.stamp_ns - T0) - 0.2
            probe.until(lambda reached=reached: forces and _seconds(forces[-1]) > reached, "forces at the samples")
        if isinstance(entry, Sample):
            send(entry.stamp_ns, entry.wrench)
        elif isinstance(entry, Pose):
            message = PoseStamped()
            set_stamp(message.header, entry.stamp_ns)
            message.pose.position.x, message.pose.position.y, theta = entry.pose
            message.pose.orientation.z, message.pose.orientation.w = np.sin(0.5 * theta), np.cos(0.5 * theta)
            poses.publish(message)


def test_a_real_node_publishes_the_forces_of_its_machine(tmp_path: Path) -> None:
    truth = draw(replace(GROUPS["plain"], stiffness=(3e6, 3e8), periods=5.5), 71003)
    scene = tmp_path / "believed.yaml"
    scene.write_text(dump_scene(truth.nominal), encoding="utf-8")
    settings = {
        "scene": scene, "estimate": "true", "estimate_window": 10.0, "estimate_interval": 2.0, "rollback_span": 0.5,
        "excitation_timeout": 3600.0, "follow_members": MEMBERS,
    }  # fmt: skip
    with bench(tmp_path, record_path=tmp_path / "run", **settings) as running:
        probe = running.probe
        send, poses = probe.excitation(), probe.publisher(PoseStamped, "head_pose")
        by_topic: dict[str, list[JointState]] = {
            topic: probe.listen(JointState, topic) for topic in ("contact_forces", "force_intervals", "clearance")
        }
        assert value(probe.status[-1], "follow") == "prior"
        _play(probe, send, poses, truth, 0.0, 13.0, by_topic["contact_forces"])
        probe.until(lambda: value(probe.status[-1], "horizontal") == "estimated", "an estimate", 100.0)
        # twins are drawn from the estimate while samples arrive
        _play(probe, send, poses, truth, 13.0, 13.5, by_topic["contact_forces"])
        probe.until(lambda: value(probe.status[-1], "follow") == "estimate", "an estimate that is taken over")
        _play(probe, send, poses, truth, 13.5, 17.0, by_topic["contact_forces"])
        probe.until(lambda: _seconds(by_topic["force_intervals"][-1]) > 16.98, "the last forces")
        assert probe.figures("follow")["members"] == str(MEMBERS)
        assert running.twin.stop() == 0
    forces = {_seconds(one): np.array(one.effort) for one in by_topic["contact_forces"]}
    t = np.array([time for time in forces if time > 14.0])
    published = np.array([forces[time] for time in t.tolist()])
    indices = np.round(100.0 * t).astype(int)
    true, nominal = (simulate(one, 17.0, 0.01, 1e-6).force[indices] for one in (truth.scene, truth.nominal))
    assert _error(published, true) < 0.08 and _error(nominal, true) > 0.2
    assert [_seconds(one) for one in by_topic["force_intervals"]] == list(forces)
    last = dict(zip(by_topic["force_intervals"][-1].name, by_topic["force_intervals"][-1].effort, strict=True))
    assert all(last[f"{pair}/p05"] <= last[pair] <= last[f"{pair}/p95"] for pair in PAIR_NAMES)
    assert [last[pair] for pair in PAIR_NAMES] == list(by_topic["contact_forces"][-1].effort)
    first, newest = (
        dict(zip(by_topic["clearance"][0].name, by_topic["clearance"][at].position, strict=True)) for at in (0, -1)
    )
    assert first["horizontal/p05"] < truth.clearance[0] < first["horizontal/p95"]
    assert first["horizontal/p95"] - first["horizontal/p05"] > 0.02
    assert newest["horizontal"] == pytest.approx(truth.clearance[0], abs=1e-3)
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.first_divergence) == (0, None)
    assert min(report.compared[topic] for topic in ("force_intervals", "peak_intervals", "contact_forces")) > 1000
    written = tmp_path / "again"
    assert replay(tmp_path / "run", write=written).exit_code == 0
    assert replay(written).exit_code == 0


def _seconds(message: JointState) -> float:
    return message.header.stamp.sec - T0 // 10**9 + 1e-9 * message.header.stamp.nanosec


class Front:
    """A front end that stores the messages of a runtime."""

    name, follows_samples, sends_motion = "/plow_twin", False, True
    topics = {topic.name: f"/{topic.name}" for topic in TOPICS}  # noqa: RUF012

    def __init__(self) -> None:
        self.sent: Counter[str] = Counter()

    def send(self, topic: str, message: memoryview | Message) -> None:
        self.sent[topic] += 1

    def now_ns(self) -> int:
        return T0

    def say_error(self, text: str) -> None:
        pytest.fail(text)

    def __getattr__(self, name: str) -> Any:
        return lambda *_: ""


def _started(truth: Truth, folder: Path, mode: str, front: Front) -> tuple[Path, Runtime]:
    """Return the nominal scene's file and an active runtime, which records in `run`."""
    scene = folder / "believed.yaml"
    scene.write_text(dump_scene(truth.nominal), encoding="utf-8")
    values = {"scene": str(scene), "estimate": True, "follow_members": MEMBERS, "excitation_timeout": 3600.0}
    settings = parameters.settings(values | {"publish_mode": mode, "record_path": str(folder / "run")})
    runtime = Runtime(front, settings, Preparation(settings).result(lambda: False))
    runtime.start()
    runtime.activate()
    return scene, runtime


@pytest.mark.parametrize("mode", ["on_sample", "fixed_rate"])
def test_a_runtime_reports_its_twins_and_follows_with_parameters_if_samples_wait(
    truth: Truth, tmp_path: Path, mode: str
) -> None:
    front = Front()
    scene, runtime = _started(truth, tmp_path, mode, front)

    def play(begin: float, end: float) -> None:
        for entry in _in_turn(truth, begin, end):
            if isinstance(entry, Pose):
                runtime.add_pose(entry.stamp_ns, (entry.pose[0], entry.pose[1], entry.pose[2]))
                continue
            assert isinstance(entry, Sample)
            for topic, message in runtime.step([(entry.stamp_ns, entry.wrench)]):
                front.send(topic, message)
            if mode == "fixed_rate" and entry.stamp_ns // 50_000_000 % 2:
                runtime.publish_due()

    def figures() -> dict[str, str]:
        return diagnostics.Health().parts("active", "", runtime, 0)["follow"][2]

    play(0.0, 1.0)
    assert runtime.follower is not None and int(figures()["poses_used"]) > 50
    runtime.driver.session.apply(_known(truth))
    play(1.0, 1.5)
    late = _samples(truth, 1.45, 1.47)[1]
    for topic, message in runtime.step([(late.stamp_ns + 1_000_000, late.wrench)]):
        front.send(topic, message)
    assert runtime.driver.rolled_back == 1
    assert (figures()["follow"], figures()["source"]) == ("full", "estimate")
    assert diagnostics.summary("active", "", runtime)[2]["follow"] == "estimate"
    sent = front.sent.copy()
    assert sent["force_intervals"] == sent["peak_intervals"] == sent["contact_forces"] > 40
    task = next(do for rate, do in runtime.periodic() if rate == 1.0)
    for waits in (True, True, False, True, True, True, True, True):
        runtime.inputs.waited(1, 1.0 if waits else 0.0)
        assert not runtime.reduced
        task()
    level, message, _ = diagnostics.summary("active", "", runtime)
    assert runtime.reduced and level == diagnostics.WARN and "too slow" in message
    play(1.5, 2.0)
    assert front.sent["force_intervals"] == sent["force_intervals"]
    assert front.sent["contact_forces"] > sent["contact_forces"]
    assert (figures()["follow"], figures()["members"], figures()["reduced"]) == ("parameters", "1", "1")
    assert runtime.close() == []
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.first_divergence) == (0, None)
    assert report.compared["force_intervals"] == sent["force_intervals"]
    residual = {}
    for name, given_scene in (("followed", None), ("nominal", scene)):
        analysis = analyse(tmp_path / "run", scene=given_scene)
        residual[name] = analysis.comparisons(analysis.predictions[0])["x"].rms
    assert residual["followed"] < 0.5 * residual["nominal"]
    drawn = to_rrd(tmp_path / "run", tmp_path / "run.rrd")
    entities = {chunk.entity_path for chunk in RrdReader(str(drawn.path)).stream() if not chunk.is_static}
    assert {f"/{name}" for name in (*layout.FORCE_BOUNDS, *layout.POSE, *layout.MEASURED)} <= entities


@pytest.mark.usefixtures("ten_at_once")
@pytest.mark.parametrize("mode", ["on_sample", "fixed_rate"])
def test_a_written_replay_with_late_samples_and_a_snapshot_has_the_recorded_motion(
    truth: Truth, tmp_path: Path, mode: str
) -> None:
    _, runtime = _started(truth, tmp_path, mode, Front())
    chance, order = np.random.default_rng(3), list[tuple[float, Sample | Pose]]()
    for entry in _in_turn(truth, 0.0, 2.0):
        assert isinstance(entry, Sample | Pose)
        is_late = isinstance(entry, Sample) and entry.stamp_ns > T0 + 100_000_000 and chance.random() < 0.05
        order.append((entry.stamp_ns + 1.2e9 * chance.random() * is_late, entry))
    waiting = 0
    for number, (_, entry) in enumerate(sorted(order, key=lambda item: item[0])):
        if number == len(order) // 2:
            runtime.driver.snapshot()
        if isinstance(entry, Pose):
            runtime.add_pose(entry.stamp_ns, (entry.pose[0], entry.pose[1], entry.pose[2]))
            continue
        list(runtime.step([(entry.stamp_ns, entry.wrench)]))
        if mode == "fixed_rate" and number % 10 == 0:
            runtime.publish_due()
        waiting = max(waiting, runtime.driver.session.waiting)
    assert runtime.close() == [] and waiting > 1
    assert replay(tmp_path / "run", write=tmp_path / "written").exit_code == 0
    for run in ("run", "written"):
        report = replay(tmp_path / run)
        assert (report.exit_code, report.first_divergence) == (0, None), run
        assert report.snapshots_compared > 0 and report.compared["contact_forces"] > 20


def test_forces_are_sent_before_the_other_twins_are_advanced(
    truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "believed.yaml"
    scene.write_text(dump_scene(truth.nominal), encoding="utf-8")
    settings = parameters.settings({"scene": str(scene), "estimate": True, "follow_members": MEMBERS})
    runtime = Runtime(Front(), settings, Preparation(settings).result(lambda: False))
    advance, done = TwinBatch.advance_samples, list[float]()

    def counted(twins: TwinBatch, t: Array, wrench: Array) -> Any:
        done.extend(t)
        return advance(twins, t, wrench)

    runtime.start()
    runtime.activate()
    monkeypatch.setattr(TwinBatch, "advance_samples", counted)
    order = list[tuple[str, int]]()
    for sample in _samples(truth, 0.0, 0.5):
        order += [(topic, len(done)) for topic, _ in runtime.step([(sample.stamp_ns, sample.wrench)])]
    assert runtime.close() == []
    for topic, before in (("contact_forces", 0), ("contact_peaks", 0), ("head_state", 0), ("force_intervals", 1)):
        assert [count for name, count in order if name == topic] == list(range(before, 50 + before)), topic


def test_without_following_its_code_is_not_loaded(tmp_path: Path) -> None:
    code = """
import sys
from plow_twin.live import parameters
from plow_twin.live.runtime import Runtime
from plow_twin.live.solver_start import Preparation
import test_live_follow_front as front
for follow in ("off", "full"):
    given = parameters.settings({"estimate": True, "follow": follow})
    runtime = Runtime(front.Front(), given, Preparation(given).result(lambda: False))
    runtime.start()
    runtime.activate()
    for index in range(20):
        for _ in runtime.step([(10**18 + index * 10**6, (1e4, 0.0, 0.0))]):
            pass
    print(follow, "plow_twin.estimate.follow" in sys.modules)
    runtime.close()
"""
    (tmp_path / "test_live_follow_front.py").write_text(
        "class Front:\n"
        "    name, follows_samples, sends_motion, topics = '/plow_twin', False, True, {}\n"
        "    now_ns = lambda self: 10**18\n"
        "    __getattr__ = lambda self, name: lambda *_: ''\n",
        encoding="utf-8",
    )
    completed = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert completed.stdout.splitlines() == ["off False", "full True"], completed.stderr


def test_hard_real_time_excludes_following(truth: Truth) -> None:
    values = {"estimate": True, "max_evaluations": 1000}
    assert [one.key for one in problems(parameters.settings(values), truth.nominal)] == ["max_evaluations"]
    assert not problems(parameters.settings(values | {"follow": "off"}), truth.nominal)
