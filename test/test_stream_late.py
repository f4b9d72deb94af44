"""Late, reordered and batched samples take effect at their stamps. Only the service for the wear sets the wear."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from plow_twin.model.scene import Wear
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.driver import Arrival, Driver, Policy, StreamState, counters
from plow_twin.stream.intake import NS_PER_S, Intake
from plow_twin.stream.journal import Digest, Entry, Hold, Sample, SetWear, Snapshot, Travel
from plow_twin.stream.limits import excitation_limits
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Session

WEAR = Wear(coefficient_m2_n=1e-12, pad_area_m2=0.015, travel_speed_m_s=2.0)
SCENE = replace(load_scene(scene_path("paper")), wear=WEAR)
T0 = 1_795_000_000_000_000_000
MS = NS_PER_S // 1000
SPAN_S = 2.0


def _arrival(index: int) -> Arrival:
    share = math.sin(0.02 * index)
    return T0 + index * MS, (32e3 * share, 0.0, -45e3 * share)


def _newest(frame: Published, name: str) -> Any:
    return frame.rows[name][-1]


def _marks(frame: Published) -> tuple[bool, ...]:
    return tuple(bool(_newest(frame, name)) for name in ("corrected", "held", "marked"))


class Live:
    """A driver on a real twin that can go back by `SPAN_S` seconds, with its journal and its publications."""

    def __init__(self, *, every_sample: bool = True, policy: Policy | None = None) -> None:
        self.journal: list[Entry] = []
        self.frames: list[Published] = []
        session = Session(Twin(SCENE, excitation="sampled"), on_entry=self.journal.append, rollback_span_s=SPAN_S)
        intake = Intake(limits=excitation_limits(SCENE))
        self.driver = Driver(session, intake, policy or Policy(), every_sample=every_sample)

    def send(self, *arrived: Arrival, now_ns: int = 0) -> None:
        self.frames += self.driver.samples(arrived, now_ns)

    def silence(self, now_ns: int) -> None:
        frame = self.driver.silence(now_ns)
        if len(frame.rows):
            self.frames.append(frame)

    @property
    def wear(self) -> np.ndarray:
        return self.driver.session.wear_depth

    @property
    def motion(self) -> tuple[int | None, str]:
        return self.driver.session.stamp_ns, self.driver.session.twin.digest()


def _replayed(journal: list[Entry]) -> Session:
    """Run a journal again, entry by entry, and compare its digests."""
    session = Session(Twin(SCENE, excitation="sampled"), rollback_span_s=SPAN_S)
    for entry in journal:
        if isinstance(entry, Digest):
            assert session.twin.digest() == entry.digest
        elif not isinstance(entry, Snapshot):
            session.apply(entry)
    return session


@settings(max_examples=12, phases=(Phase.explicit, Phase.generate))
@given(
    st.lists(st.integers(0, 60), min_size=160, max_size=160),
    st.lists(st.integers(1, 40), min_size=1, max_size=20),
    st.booleans(),
)
def test_samples_in_any_order_and_batches_give_the_bits_of_ordered_samples(
    delays: list[int], sizes: list[int], every_sample: bool
) -> None:
    ordered, live = Live(), Live(every_sample=every_sample)
    ordered.send(*(_arrival(index) for index in range(160)))
    arriving = [0, *sorted(range(1, 160), key=lambda index: (index + delays[index], index))]
    travels = {20: 1.0, 55: 2.5, 90: 3.0}
    for index, speed in travels.items():
        ordered.driver.travel(T0 + index * MS + MS // 3, speed)
    begin, number = 0, 0
    while begin < 160:
        size = sizes[number % len(sizes)]
        live.send(*(_arrival(index) for index in arriving[begin : begin + size]), now_ns=begin * MS)
        # every third time, the clock advances by 0.9 s, so that the model runs ahead of the samples
        live.silence(begin * MS + 900 * MS * (number % 3 == 0))
        if number == 0:
            for index, speed in travels.items():
                live.driver.travel(T0 + index * MS + MS // 3, speed)
        begin, number = begin + size, number + 1
    live.send(_arrival(160))
    ordered.send(_arrival(160))
    assert live.motion == ordered.motion
    counted = counters(live.driver)
    assert (counted["samples_used"], counted["samples_in"]) == (161, 161)
    assert (live.wear > 0.0).any() or not (ordered.wear > 0.0).any()
    due, ours = live.driver.due(), ordered.frames[-1]
    frame = due if len(due.rows) else live.frames[-1]
    assert (_newest(frame, "makes") == _newest(ours, "makes")).all()
    assert (_newest(frame, "force") == _newest(ours, "force")).all()
    again = _replayed(live.journal)
    assert (again.stamp_ns, again.twin.digest()) == live.motion
    assert again.snapshot().data[: 8 * 5] == live.driver.session.snapshot().data[: 8 * 5]


@settings(max_examples=25, phases=(Phase.explicit, Phase.generate))
@given(
    st.lists(
        st.tuples(st.sampled_from(("sample", "hold", "late", "travel")), st.integers(1, 12), st.booleans()),
        min_size=10, max_size=40,
    )
)  # fmt: skip
@example([*[("sample", 10, False)] * 10, *[("hold", 2, False), ("hold", 13, False), ("late", 5, False)],
          *[("hold", 1, False), ("sample", 4, False), ("hold", 5, False), ("late", 2, False)]])  # fmt: skip
def test_the_motion_after_holds_and_late_samples_does_not_depend_on_the_publications(
    steps: list[tuple[str, int, bool]],
) -> None:
    never, often = (Session(Twin(SCENE, excitation="sampled"), rollback_span_s=SPAN_S) for _ in range(2))
    used: set[int] = set()
    for kind, step_ms, publishes in [("sample", 1, False), *steps]:
        reached_ms = 0 if never.stamp_ns is None else (never.stamp_ns - T0) // MS
        stamp_ms = reached_ms - step_ms if kind == "late" else reached_ms + step_ms
        if kind in ("sample", "late") and (stamp_ms < 1 or stamp_ms in used):
            continue
        stamp_ns, wrench = _arrival(stamp_ms)
        oldest_ns = never.history.oldest_ns
        if oldest_ns is not None and stamp_ns <= oldest_ns:
            continue
        # holds and speeds have stamps between those of two samples
        between: dict[str, Entry] = {"hold": Hold(stamp_ns + MS // 2), "travel": Travel(stamp_ns + MS // 4, step_ms)}
        entry = between.get(kind, Sample(stamp_ns, wrench))
        if isinstance(entry, Sample):
            used.add(stamp_ms)
        for session in (never, often):
            session.apply(entry)
        if publishes:
            often.outputs.pop()
    assert (often.stamp_ns, often.twin.digest()) == (never.stamp_ns, never.twin.digest())
    assert (often.wear_depth == never.wear_depth).all()


def test_the_load_at_the_stamp_of_a_speed_is_computed_again_from_a_late_sample() -> None:
    live, ordered = Live(), Live()
    for model in (live, ordered):
        model.send(*(_arrival(index) for index in range(21)))
        model.driver.travel(T0 + 25 * MS, 1.0)
    live.send(_arrival(30))
    live.send(_arrival(27))
    ordered.send(_arrival(27), _arrival(30))
    assert live.motion == ordered.motion


def test_a_lasting_delay_does_not_stop_the_twin() -> None:
    live, ordered = Live(policy=Policy(excitation_timeout_s=0.1)), Live()
    ordered.send(*(_arrival(index) for index in range(1500)))
    for index in range(500):
        live.send(_arrival(index), now_ns=index * MS)
    for now in range(500, 1300, 10):  # there is no sample for 0.8 s
        live.silence(now * MS)
    assert _newest(live.frames[-1], "held") and _newest(live.frames[-1], "stamp_ns") > T0 + 1100 * MS
    held = len(live.frames)
    for index in range(500, 1500):  # from then on, all samples are late by 0.8 s
        live.send(_arrival(index), now_ns=(index + 800) * MS)
        live.silence((index + 800) * MS)
    assert live.motion == ordered.motion
    assert counters(live.driver)["samples_used"] == 1500
    assert counters(live.driver)["rolled_back"] == 1
    first, second, third = live.frames[held : held + 3]
    assert _marks(first) == (True, False, True)
    assert _marks(second) == (False, False, True)
    assert _marks(third) == (False, False, False)


def test_samples_older_than_the_memory_are_counted() -> None:
    live = Live()
    live.driver.intake.jump_back_s = 60.0
    live.send(*(_arrival(index) for index in range(0, 5000, 2)))
    digest = live.driver.session.twin.digest()
    live.send(_arrival(1001))
    assert counters(live.driver)["dropped_out_of_order"] == 1
    assert live.driver.session.twin.digest() == digest
    live.send(_arrival(4001), _arrival(4001))
    assert (counters(live.driver)["rolled_back"], counters(live.driver)["dropped_duplicate"]) == (1, 1)


def test_wear_survives_resets_failures_and_clock_steps() -> None:
    live = Live(policy=Policy(excitation_timeout_s=0.1, failure_limit=2))
    live.driver.intake.limits = None
    live.send(*(_arrival(index) for index in range(1000)), now_ns=1000 * MS)
    worn = live.wear.copy()
    assert worn.max() > 0.0
    for now in range(1100, 13_000, 100):
        live.silence(now * MS)
    assert _newest(live.frames[-1], "held") and _newest(live.frames[-1], "stamp_ns") > T0 + 12_000 * MS
    assert (live.wear == worn).all()
    live.driver.reset(T0, "service")
    live.send((T0 + 5, (0.0, 0.0, 0.0)), (T0 + MS, (1e200, 0.0, 0.0)), (T0 + 2 * MS, (1e200, 0.0, 0.0)))
    assert live.driver.resets == 2
    for stamp_ms in (3, -3000, -2999, 60_000, 60_001):
        live.send((T0 + stamp_ms * MS, (0.0, 0.0, 0.0)))
    assert live.driver.resets == 4
    assert (live.wear >= worn).all() and (live.wear - worn).max() < 1e-3 * worn.max()
    pads = tuple(1e-4 * index for index in range(8))
    live.driver.set_wear(T0, pads, "other pads")
    assert isinstance(live.journal[-1], SetWear)
    assert live.wear.tolist() == list(pads)
    live.send((T0, (0.0, 0.0, 0.0)))
    assert live.frames[-1].slow["clearance"][0, 2:10].tolist() == list(pads)
    for bad in ((0.0,) * 7, (math.nan,) * 8, (-1e-9,) * 8):
        with pytest.raises(ValueError, match="wear depth"):
            live.driver.set_wear(T0, bad, "nonsense")
    assert _replayed(live.journal).wear_depth.tolist() == list(pads)


def test_speeds_of_another_clock_act_at_once_and_are_counted() -> None:
    right = None
    for ahead_s in (0, 3600, -3600):
        live = Live()
        live.send(*(_arrival(index) for index in range(300)))
        for _ in range(50):
            live.driver.travel(T0 + 299 * MS + ahead_s * NS_PER_S, 5.0)
        live.send(*(_arrival(index) for index in range(300, 600)))
        assert live.driver.travel_misplaced == (50 if ahead_s else 0)
        right = live.wear if right is None else right
        assert (live.wear == right).all()
    live = Live()
    # while no sample arrives, speeds are queued if their stamps are within a clock step of the newest sample
    live.send(*(_arrival(index) for index in range(10)))
    for index in range(0, 30_000, 10):
        live.driver.travel(T0 + index * MS, 2.0 + 1e-6 * index)
    session = live.driver.session
    assert len(session._travels) <= 1000 and len(session.history._travels) <= 2
    live.send(*(_arrival(index) for index in range(10, 600)))
    assert _replayed(live.journal).wear_depth.tolist() == live.wear.tolist()


def test_an_endless_hold_ends_at_its_limit() -> None:
    live = Live(policy=Policy(excitation_timeout_s=0.1, hold_limit_s=2.0))
    live.send(_arrival(0))
    for now in range(0, 9000, 100):
        live.silence(now * MS)
    assert live.driver.session.stamp_ns == T0 + 2000 * MS
    assert live.driver.state is StreamState.ENDED
    live.send(_arrival(9000), now_ns=9000 * MS)
    assert live.driver.state is StreamState.RUNNING


def test_different_clocks_cause_an_error_and_not_endless_resets() -> None:
    live = Live()
    for index in range(0, 200, 2):
        for behind in (2000, 0):
            live.send(_arrival(behind + index), _arrival(behind + index + 1), now_ns=index * MS)
    assert live.driver.resets == 5
    assert live.driver.unsteady(200 * MS)
    counted = counters(live.driver)
    dropped = sum(count for key, count in counted.items() if key.startswith("dropped_"))
    assert counted["samples_used"] + dropped + (live.driver._steps.delayed is not None) == 400
    assert counted["dropped_unsteady"] > 50
    # when the stamps are steady again, a jump is treated as a step of the clock again
    live.send(_arrival(60_000), _arrival(60_001), now_ns=20_000 * MS)
    assert live.driver.resets == 6 and not live.driver.unsteady(20_000 * MS)


@pytest.mark.parametrize("absurd", [(1e8, 0.0, 0.0), (0.0, -1e8, 0.0), (0.0, 0.0, 1e8)])
def test_a_refused_sample_does_not_affect_the_interpolated_load(absurd: tuple[float, float, float]) -> None:
    live, without = Live(), Live()
    good = [_arrival(index) for index in range(100)]
    without.send(*good[:50], *good[51:])
    live.send(*good[:50], (good[50][0], absurd), *good[51:])
    assert live.motion == without.motion
    assert counters(live.driver)["dropped_implausible"] == 1
    largest = max(float(frame.rows["force"].max()) for frame in live.frames)
    assert largest < 1e6


def test_a_change_faster_than_possible_is_refused() -> None:
    live = Live()
    limit = excitation_limits(SCENE, force=1e6, force_rate=1e6)
    live.driver.intake.limits = limit
    live.send((T0, (0.0, 0.0, 0.0)), (T0 + MS, (900.0, 0.0, 0.0)), (T0 + 2 * MS, (2000.0, 0.0, 0.0)))
    assert counters(live.driver)["dropped_implausible"] == 1
    live.send((T0 + 3 * MS, (2000.0, 0.0, 0.0)))
    assert counters(live.driver)["samples_used"] == 3


@pytest.mark.parametrize("seed", range(1, 7))
def test_the_journal_repeats_any_input_at_every_entry(seed: int) -> None:
    random = Random(seed)
    hold = random.choice(["hold", "zero"])
    live = Live(every_sample=bool(seed % 2), policy=Policy(excitation_timeout_s=0.05, hold=hold, hold_limit_s=0.3))
    again = Session(Twin(SCENE, excitation="sampled"), rollback_span_s=SPAN_S)
    now = index = done = 0
    skipped: list[int] = []
    for _ in range(300):
        chance = random.random()
        if chance < 0.6:
            live.send(*(_arrival(index + offset) for offset in range(5)), now_ns=now)
            index, now = index + 5, now + 5 * MS
        elif chance < 0.7:
            skipped.append(index)
            index += 1
        elif chance < 0.8 and skipped:
            live.send(_arrival(skipped.pop(random.randrange(len(skipped)))), now_ns=now)
        elif chance < 0.88:
            now += 80 * MS
            live.silence(now)
        elif chance < 0.92:
            skipped.clear()
            if chance < 0.9:
                live.driver.reset(T0 + index * MS, "asked for")
            else:
                live.driver.set_wear(T0 + index * MS, [1e-5 * random.random()] * 8, "other pads")
        elif chance < 0.96:  # the speeds are late, on time, early or far too late
            live.driver.travel(T0 + (index + random.randrange(-200, 50)) * MS, 3.0 * random.random())
        else:
            live.driver.due()
        for entry in live.journal[done:]:
            if not isinstance(entry, Digest):
                again.apply(entry)
        done = len(live.journal)
        assert (again.stamp_ns, again.twin.digest()) == live.motion
        assert (again.wear_depth == live.wear).all()
