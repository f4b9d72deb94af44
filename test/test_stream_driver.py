"""Effects of silences, jumps, failures and loads of the scene on journal and motion."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from plow_twin.model.loads import compile_loads
from plow_twin.record.sending import Messages
from plow_twin.run.twin import DEFAULT_BUDGET, Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.driver import Arrival, Driver, Policy, StreamState, counters
from plow_twin.stream.intake import NS_PER_S, Intake
from plow_twin.stream.journal import Digest, Entry, Failed, Hold, Reset, Sample, Unload
from plow_twin.stream.limits import excitation_limits
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Session
from plow_twin.stream.silences import Silences

SCENE = load_scene(scene_path("paper"))
T0 = 1_795_000_000_000_000_000
MS = NS_PER_S // 1000
LOAD = (32e3, 0.0, -45e3)


def test_silences_are_counted_equally_for_single_and_many_samples() -> None:
    stamps = T0 + MS * np.array([0, 40, 1100, 600, 1150, 2000, 2001])
    single, many = Silences(0.5), Silences(0.5)
    for stamp in stamps.tolist():
        single.add_one(stamp)
    silences = [(index, (begin - T0) // MS, (end - T0) // MS) for index, begin, end in many.add(stamps)]
    assert silences == [(2, 40, 1100), (5, 1150, 2000)]
    assert single.facts() == many.facts()
    longest = "the longest from 0.040 s to 1.100 s after the first"
    assert single.text() == f"1.910 s without samples, in 2 stretches, {longest}"
    many.restart()
    assert many.add(stamps[-1:] + 3600 * NS_PER_S) == [] and many.count == 2


def test_a_log_with_long_intervals_has_a_silence_only_at_its_end() -> None:
    random = np.random.default_rng(0)
    stamps = T0 + np.cumsum(random.integers(900, 1100, 200)) * MS
    stamps[60:] += 30 * NS_PER_S
    stamps[150:] += 60 * NS_PER_S
    single, parts = Silences(0.5), Silences(0.5)
    for stamp in stamps.tolist():
        single.add_one(stamp)
    for part in np.split(stamps, [1, 7, 60, 61, 150]):
        parts.add(part)
    assert single.count == 2 and single.facts() == parts.facts()
    assert single.longest_ns == (stamps[149], stamps[150])


def _some(published: Published) -> Published | None:
    return published if len(published.rows) else None


class Bench:
    def __init__(self, policy: Policy | None = None, excitation: str = "sampled", *, every_sample: bool = True) -> None:
        self.journal: list[Entry] = []
        twin = Twin(SCENE, excitation="sampled" if excitation == "sampled" else "scene")
        session = Session(twin, on_entry=self.journal.append)
        self.driver = Driver(session, Intake(), policy or Policy(), every_sample=every_sample)

    def sample(self, stamp_ns: int, wrench: tuple[float, float, float], now_ns: int) -> Published | None:
        return _some(Published.joined(list(self.driver.samples([(stamp_ns, wrench)], now_ns))))

    def silence(self, now_ns: int) -> Published | None:
        return _some(self.driver.silence(now_ns))

    def tick(self, stamp_ns: int, now_ns: int) -> Published | None:
        return _some(self.driver.clock_tick(stamp_ns, now_ns))

    def kinds(self) -> list[str]:
        return [type(entry).__name__ for entry in self.journal]


@pytest.mark.parametrize("hold", ["hold", "zero"])
def test_in_a_silence_the_model_lags_behind_the_clock_by_the_timeout(hold: str) -> None:
    bench = Bench(Policy(excitation_timeout_s=0.1, hold=hold))
    driver = bench.driver
    assert bench.silence(5 * NS_PER_S) is None
    bench.sample(T0, LOAD, now_ns=0)
    bench.sample(T0 + MS, LOAD, now_ns=MS)
    assert bench.silence(101 * MS) is None
    for now_ms in (121, 131):
        assert bench.silence(now_ms * MS) is not None
    held = bench.journal[2:]
    first: Entry = Unload(T0 + 21 * MS) if hold == "zero" else Hold(T0 + 21 * MS)
    assert held == [first, Hold(T0 + 31 * MS)]
    assert driver.state is StreamState.STALE

    # a sample with a stamp that the model has passed is late; the next sample is used at once
    assert bench.sample(T0 + 31 * MS, LOAD, now_ns=132 * MS) is None
    assert bench.sample(T0 + 32 * MS, LOAD, now_ns=132 * MS) is not None
    assert driver.state is StreamState.RUNNING
    assert counters(driver)["dropped_late"] == 1
    assert counters(driver)["holds"] == 2


def test_a_long_silence_is_processed_in_bounded_calls() -> None:
    bench = Bench(Policy(excitation_timeout_s=0.1))
    bench.sample(T0, LOAD, now_ns=0)
    for _ in range(3):
        bench.driver.silence(3600 * NS_PER_S)
    assert [entry.stamp_ns - T0 for entry in bench.journal[1:]] == [NS_PER_S, 2 * NS_PER_S, 3 * NS_PER_S]


def test_the_model_does_not_advance_over_inactive_time() -> None:
    bench = Bench(Policy(excitation_timeout_s=0.1))
    bench.sample(T0, LOAD, now_ns=0)
    bench.driver.resume(100 * NS_PER_S)
    assert bench.silence(100 * NS_PER_S + 50 * MS) is None


@pytest.mark.parametrize(("jump_ns", "key"), [(-5 * NS_PER_S, "jumps_back"), (60 * NS_PER_S, "jumps_forward")])
def test_a_jump_of_the_stamps_resets_the_model(jump_ns: int, key: str) -> None:
    bench = Bench()
    for index in range(300):
        bench.sample(T0 + index * MS, LOAD, now_ns=index * MS)
    fresh = Bench()
    for index in range(50):
        jumped = bench.sample(T0 + jump_ns + index * MS, LOAD, now_ns=(400 + index) * MS)
        direct = fresh.sample(T0 + jump_ns + index * MS, LOAD, now_ns=index * MS)
    assert jumped is not None and direct is not None
    assert (jumped.rows["q"] == direct.rows["q"]).all() and (jumped.rows["force"] == direct.rows["force"]).all()
    assert bench.kinds().count("Reset") == counters(bench.driver)[key] == counters(bench.driver)["resets"] == 1


def test_a_late_burst_after_a_long_silence_is_dropped_and_the_model_continues() -> None:
    bench = Bench(Policy(excitation_timeout_s=0.1))
    driver = bench.driver
    bench.sample(T0, LOAD, now_ns=0)
    for tick in range(1, 31):
        driver.silence(tick * 100 * MS)
    digest = driver.session.twin.digest()
    for index in range(1, 2000, 100):
        assert bench.sample(T0 + index * MS, LOAD, now_ns=3000 * MS) is None
    assert counters(driver)["dropped_late"] == 20
    assert "Reset" not in bench.kinds()
    assert driver.session.twin.digest() == digest
    assert bench.sample(T0 + 3000 * MS, LOAD, now_ns=3000 * MS) is not None
    # a repeated jump is not a step of the clock, and a duplicate after a jump is not late
    assert bench.sample(T0 - 60 * NS_PER_S, LOAD, now_ns=3001 * MS) is None
    assert bench.sample(T0 - 60 * NS_PER_S, LOAD, now_ns=3001 * MS) is None
    assert bench.sample(T0 - 60 * NS_PER_S + MS, LOAD, now_ns=3001 * MS) is not None
    assert bench.sample(T0 - 60 * NS_PER_S + MS, LOAD, now_ns=3001 * MS) is None
    assert counters(driver)["dropped_duplicate"] == 2 and bench.kinds().count("Reset") == 1


def test_a_failed_advance_publishes_nothing_and_after_the_limit_the_model_is_reset() -> None:
    bench = Bench(Policy(failure_limit=3))
    driver = bench.driver
    for index in range(20):
        assert (frame := bench.sample(T0 + index * MS, LOAD, now_ns=index * MS)) is not None and frame.finite
    for index in range(20, 23):
        assert bench.sample(T0 + index * MS, (1e200, -1e200, 1e200), now_ns=index * MS) is None
    assert driver.failed.count == 3
    assert driver.failed.reason
    assert isinstance(bench.journal[-1], Reset)
    recovered = bench.sample(T0 + 30 * MS, LOAD, now_ns=30 * MS)
    assert recovered is not None and recovered.finite
    assert driver.state is StreamState.RUNNING


def test_a_model_outside_its_range_reports_the_value_and_restarts_soon() -> None:
    bench, direct = Bench(), Twin(SCENE, excitation="sampled")
    failed = bench.driver.failed
    load = compile_loads(SCENE.loads).at(np.arange(4000) * 1e-3) * 3.0
    for index, wrench in enumerate(load.tolist()):
        # the stamps of the load advance, but the clock does not
        bench.sample(T0 + index * MS, (wrench[0], wrench[1], wrench[2]), now_ns=0)
        if failed.count == 1:
            status = direct.advance_samples(np.arange(index + 1) * 1e-3, load[: index + 1]).status
            assert failed.reason == direct.failure(status[-1]) and not status[:-1].any()
            failed_ns = T0 + index * MS
    angle = float(failed.reason.split()[4])
    assert failed.reason.endswith("degrees; the model is valid up to 45") and 45.0 < abs(angle) < 46.0
    assert failed.count < 100 and counters(bench.driver)["resets"] == failed.stretches > 5 and not failed.lasts
    entries = [entry for entry in bench.journal if isinstance(entry, Failed)]
    assert sum(entry.advances for entry in entries) == failed.count
    assert [(entry.stamp_ns, entry.since_ns, entry.advances) for entry in entries[:2]] == [
        (failed_ns, failed_ns, 1),
        (failed_ns + 9 * MS, failed_ns, 9),
    ]


def test_a_model_that_fails_after_each_restart_restarts_less_and_less_often() -> None:
    bench, absurd, count = Bench(), (1e200, -1e200, 1e200), 3000
    for index in range(count):
        bench.sample(T0 + index * MS, absurd if index % 2 else LOAD, now_ns=0)
    assert 5 < bench.kinds().count("Reset") < 12
    back = next(index for index in range(count, 2 * count) if bench.sample(T0 + index * MS, LOAD, now_ns=0))
    assert back - count < count


def test_the_scenes_own_loads_follow_the_clock_that_is_passed_in() -> None:
    bench = Bench(excitation="scene")
    stamps = [T0, T0 + 250 * MS, T0 + 250 * MS, T0 + 1700 * MS]
    advances = [bench.tick(stamp, now_ns=0) for stamp in stamps]
    assert advances[2] is None  # while the clock is paused, nothing moves
    direct = Twin(SCENE)
    for stamp, advance in zip(stamps, advances, strict=True):
        if advance is not None:
            assert (advance.rows["q"][0] == direct.advance((stamp - T0) * 1e-9).q).all()
    bench.driver.clock_tick(T0 - 100 * NS_PER_S, now_ns=0)
    assert isinstance(bench.journal[-2], Reset)


def test_model_time_continues_unchanged_after_an_inactive_hour() -> None:
    bench, hour = Bench(excitation="scene"), 3600 * NS_PER_S
    driver = bench.driver
    driver.resume(0)
    for now in (0, 500 * MS):
        driver.clock_tick(T0 + now, now)
    driver.resume(hour)
    assert bench.tick(T0 + hour, hour) is None
    advance = bench.tick(T0 + hour + 200 * MS, hour + 200 * MS)
    assert advance is not None
    direct = Twin(SCENE)
    direct.advance(0.5)
    assert advance.rows["q"][0].tobytes() == direct.advance(700 * MS * 1e-9).q.tobytes()
    assert "Reset" not in bench.kinds()
    # after a step of the clock and after a reset, the motion starts at the time of the clock
    driver.clock_tick(T0 + 2 * hour, hour)
    assert bench.journal[-2:] == [Reset(T0 + 2 * hour, "clock jump_forward"), Hold(T0 + 2 * hour)]
    driver.resume(3 * hour)
    driver.reset(T0 + 2 * hour, "service")
    driver.clock_tick(T0 + 3 * hour, 3 * hour)
    assert bench.journal[-1] == Hold(T0 + 3 * hour)


@pytest.mark.parametrize("batch", [1, 7, 300, 900])
def test_batches_give_the_bits_and_the_journal_of_single_samples(batch: int) -> None:
    def arrivals(index: int) -> tuple[int, tuple[float, float, float]]:
        share = math.sin(0.01 * index)
        return T0 + index * MS, (share * LOAD[0], 0.0, share * LOAD[2])

    single, batched = Bench(), Bench(every_sample=False)
    series = [arrivals(index) for index in range(900)]
    for stamp_ns, wrench in series:
        single.driver.session.apply(Sample(stamp_ns, wrench))
    for begin in range(0, len(series), batch):
        assert list(batched.driver.samples(series[begin : begin + batch], now_ns=0)) == []
    assert batched.journal == single.journal
    one, other = single.driver.due(), batched.driver.due()
    assert one.rows["makes"].sum() > 0
    for name in ("stamp_ns", "q", "v", "force", "makes", "impulse", "peak"):
        assert one.rows[name].tobytes() == other.rows[name].tobytes(), name


@pytest.mark.parametrize("batch", [1, 40])
@pytest.mark.parametrize("every", [900, 100, 2])
def test_single_wrong_stamps_have_no_effect_and_exclude_no_correct_stamp(every: int, batch: int) -> None:
    right, bench = Bench(every_sample=False), Bench(every_sample=False)
    arrived, wrong = [], 0
    for index in range(2000):
        if index % every == every - 1:
            wrong += 1
            arrived.append((T0 + (index + (86_400_000 if wrong % 2 else -3_600_000)) * MS, LOAD))
        arrived.append((T0 + index * MS, LOAD))
    for begin in range(0, len(arrived), batch):
        list(bench.driver.samples(arrived[begin : begin + batch], now_ns=begin * MS))
    list(right.driver.samples([arrival for arrival in arrived if 0 <= arrival[0] - T0 < 2000 * MS], now_ns=0))
    counted = counters(bench.driver)
    assert (counted["resets"], counted["dropped_stray"], counted["samples_used"]) == (0, wrong, 2000)
    assert bench.journal == right.journal
    assert bench.driver.unsteady(len(arrived) * MS) == (wrong >= 5)


def test_successive_wrong_stamps_cause_at_most_five_resets() -> None:
    bench = Bench()
    for index in range(2000):
        ahead_ns = (86_400 if index % 3 else -3600) * NS_PER_S if index % 100 >= 97 else 0
        bench.sample(T0 + index * MS + ahead_ns, LOAD, now_ns=index * MS)
    bench.driver.pause()
    counted = counters(bench.driver)
    # within ten seconds, there may be five steps of the clock and five steps back, so at most ten resets
    assert counted["resets"] <= 10
    assert counted["samples_used"] >= 1900
    assert counted["samples_used"] + counted["dropped_unsteady"] + counted["dropped_stray"] == 2000


def test_a_sample_with_a_jump_is_used_at_a_silence_and_counted_at_a_pause() -> None:
    bench = Bench(Policy(excitation_timeout_s=0.1))
    bench.sample(T0, LOAD, now_ns=0)
    assert bench.sample(T0 + 60 * NS_PER_S, LOAD, now_ns=MS) is None
    assert bench.silence(50 * MS) is None and bench.kinds() == ["Sample"]
    published = bench.silence(102 * MS)
    assert published is not None and published.rows["stamp_ns"].tolist() == [T0 + 60 * NS_PER_S]
    assert bench.kinds() == ["Sample", "Reset", "Sample"]
    assert bench.sample(T0, LOAD, now_ns=103 * MS) is None
    bench.driver.pause()
    counted = counters(bench.driver)
    assert (counted["samples_in"], counted["samples_used"], counted["dropped_stray"]) == (3, 2, 1)


@pytest.mark.parametrize("every_sample", [True, False])
def test_a_silence_is_detected_after_a_reset_in_the_last_batch(every_sample: bool) -> None:
    bench = Bench(Policy(failure_limit=3), every_sample=every_sample)
    absurd = (1e200, -1e200, 1e200)
    batch = [(T0 + i * MS, absurd if 95 <= i < 99 else LOAD) for i in range(110)]
    list(bench.driver.samples(batch, now_ns=0))
    assert bench.kinds().count("Reset") == 1 and bench.driver.newest_ns == T0 + 109 * MS
    assert bench.silence(NS_PER_S) is None or every_sample
    assert bench.driver.state is StreamState.STALE


def test_failures_in_a_batch_cause_a_reset() -> None:
    bench = Bench(Policy(failure_limit=3), every_sample=False)
    absurd = (1e200, -1e200, 1e200)
    list(bench.driver.samples([(T0 + i * MS, absurd if 10 <= i < 13 else LOAD) for i in range(13)], now_ns=0))
    assert (bench.driver.failed.count, bench.kinds()[-1]) == (3, "Reset")
    list(bench.driver.samples([(T0 + i * MS, LOAD) for i in range(13, 20)], now_ns=0))
    frame = bench.driver.due()
    assert len(frame.rows) and frame.finite and bench.driver.state is StreamState.RUNNING


def _troubled(seed: int, count: int) -> list[tuple[str, list[tuple[int, tuple[float, float, float]]], int]]:
    """Return calls of a driver: mostly one sample each, sometimes unusual calls."""
    rng = np.random.default_rng(seed)
    calls, stamp, now = [], T0, 0
    kinds = ["late", "twice", "stray", "jump", "nan", "wild", "batch", "travel", "silence", "reset"]
    for _ in range(count):
        kind = str(rng.choice([*["usual"] * 120, *kinds]))
        steps = 3 if kind == "batch" else 1
        arrived = []
        for _ in range(steps):
            stamp, now = stamp + MS, now + MS
            phase = 6.0 * (stamp - T0) * 1e-9
            arrived.append((stamp, (90e3 * math.sin(phase), -11e3 * math.sin(phase), 85e3 * math.cos(1.7 * phase))))
        match kind:
            case "late":
                arrived[0] = (stamp - int(rng.integers(2, 300)) * MS - 1, arrived[0][1])
            case "twice":
                arrived *= 2
            case "stray":
                arrived[0] = (stamp + 100 * NS_PER_S, arrived[0][1])
            case "jump":
                # the intake rejects a second step of the clock that follows too soon
                stamp, now = stamp - 50 * NS_PER_S, now + 4 * NS_PER_S
            case "nan":
                arrived[0] = (stamp, (math.nan, 0.0, 0.0))
            case "wild":
                arrived[0] = (stamp, (1e9, 0.0, 0.0))
        calls.append((kind, arrived, now))
        if kind == "silence":
            now += NS_PER_S
    return calls


@pytest.mark.parametrize("max_steps", [DEFAULT_BUDGET, 3])
def test_the_session_alone_gives_the_driver_s_bits_for_any_input(max_steps: int) -> None:
    """Messages, journal and the state for later samples are equal. With 3 steps, an advance sometimes fails."""

    def new_session(journal: list[Entry]) -> Session:
        twin = Twin(SCENE, excitation="sampled", max_steps=max_steps)
        return Session(twin, on_entry=journal.append, rollback_span_s=1.0)

    journal, again, messages = list[Entry](), list[Entry](), Messages("slide", "head")
    session, single = new_session(journal), new_session(again)
    driver = Driver(session, Intake(limits=excitation_limits(SCENE)), Policy(excitation_timeout_s=0.5))
    done = 0

    def follow() -> None:
        """Apply the driver's journal, entry by entry."""
        nonlocal done
        for entry in journal[done:]:
            if not isinstance(entry, Digest):
                single.apply(entry)
        done = len(journal)

    def calls(kind: str, arrived: list[Arrival], now: int) -> Iterator[Published]:
        yield from driver.samples(arrived, now)
        if kind == "silence":
            yield driver.silence(now + NS_PER_S)
        elif kind == "travel":
            driver.travel(arrived[0][0] + 20 * MS, 0.4)
        elif kind == "reset":
            driver.reset(arrived[0][0], "asked for")

    for call in _troubled(3, 3000):
        for published in calls(*call):
            follow()
            same = single.outputs.pop()
            assert len(same.rows) == len(published.rows)
            if len(published.rows):
                sent = [(topic, bytes(data)) for topic, data in messages.write(published)]
                assert sent == [(topic, bytes(data)) for topic, data in messages.write(same)]
        follow()
        assert single.twin.digest() == session.twin.digest()
        assert (single.wear_depth == session.wear_depth).all() and single.stamp_ns == session.stamp_ns
        assert single.history.oldest_ns == session.history.oldest_ns
    assert again == journal
    counted_as = counters(driver)
    wanted = (
        "rolled_back",
        "holds",
        "resets",
        "jumps_back",
        "dropped_stray",
        "dropped_implausible",
        "dropped_duplicate",
    )
    assert [name for name in wanted if not counted_as[name]] == []
    assert bool(counted_as["solver_failures"]) == (max_steps == 3)
