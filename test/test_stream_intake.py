"""The intake decides which samples are used. Each unused sample is counted with its reason."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plow_twin.stream.intake import NS_PER_S, Intake, Verdict

T0 = 1_000 * NS_PER_S
MS = NS_PER_S // 1000


@pytest.mark.parametrize(
    ("stamp_ns", "value", "reached_ns", "verdict"),
    [
        (T0 + MS, 1.0, T0, Verdict.ACCEPTED),
        (T0 + MS, math.nan, T0, Verdict.NON_FINITE),
        (T0 + MS, -math.inf, T0, Verdict.NON_FINITE),
        (0, 1.0, T0, Verdict.UNSTAMPED),
        (-MS, 1.0, T0, Verdict.UNSTAMPED),
        (2**31 * NS_PER_S, 1.0, T0, Verdict.UNSTAMPED),
        (T0, 1.0, T0, Verdict.DUPLICATE),
        (T0, 1.0, T0 + 5 * MS, Verdict.DUPLICATE),
        (T0 - MS, 1.0, T0, Verdict.OUT_OF_ORDER),
        (T0 - NS_PER_S, 1.0, T0, Verdict.OUT_OF_ORDER),
        (T0 + MS, 1.0, T0 + 5 * MS, Verdict.LATE),
        (T0 + 5 * MS, 1.0, T0 + 5 * MS, Verdict.LATE),
        # these samples arrive in a burst after a long silence, during which the hold policy was applied
        (T0 + MS, 1.0, T0 + 9 * NS_PER_S, Verdict.LATE),
        (T0 - MS, 1.0, T0 + 9 * NS_PER_S, Verdict.OUT_OF_ORDER),
        (T0 - NS_PER_S - 1, 1.0, T0 + 9 * NS_PER_S, Verdict.JUMP_BACK),
        (T0 - NS_PER_S - 1, 1.0, T0, Verdict.JUMP_BACK),
        (T0 + 10 * NS_PER_S, 1.0, T0, Verdict.ACCEPTED),
        (T0 + 10 * NS_PER_S + 1, 1.0, T0, Verdict.JUMP_FORWARD),
    ],
)
def test_each_reason_has_its_own_verdict(stamp_ns: int, value: float, reached_ns: int, verdict: Verdict) -> None:
    intake = Intake(jump_back_s=1.0, jump_forward_s=10.0)
    assert intake.judge(T0, (1.0, 2.0, 3.0)) is Verdict.ACCEPTED
    assert intake.judge(stamp_ns, (1.0, value, 3.0), reached_ns) is verdict
    assert intake.counts[verdict] == 1 + (verdict is Verdict.ACCEPTED)
    assert intake.arrived == 2
    assert intake.used == 1 + verdict.used


_ARRIVALS = st.lists(
    st.tuples(st.integers(-50, 3000), st.sampled_from((0.0, 1e5, math.nan, math.inf))), min_size=1, max_size=60
)


@given(_ARRIVALS)
def test_used_samples_rise_strictly_and_every_sample_is_counted(arrivals: list[tuple[int, float]]) -> None:
    intake = Intake(jump_back_s=0.5, jump_forward_s=1.0)
    reached_ns = None
    for number, (offset_ms, value) in enumerate(arrivals, 1):
        stamp_ns = offset_ms * MS
        verdict = intake.judge(stamp_ns, (value, 0.0, 0.0), reached_ns)
        assert intake.arrived == number
        if verdict.used:
            assert math.isfinite(value) and stamp_ns > 0
            step_ns = 0 if reached_ns is None else stamp_ns - reached_ns
            expected = (
                Verdict.JUMP_BACK
                if step_ns < -NS_PER_S // 2
                else Verdict.JUMP_FORWARD
                if step_ns > NS_PER_S
                else Verdict.ACCEPTED
            )
            assert verdict is expected
            assert reached_ns is None or step_ns > 0 or verdict is Verdict.JUMP_BACK
            reached_ns = stamp_ns


@given(st.permutations(range(1, 12)), st.integers(0, 3))
def test_of_samples_in_any_order_only_rising_stamps_are_used(order: list[int], repeats: int) -> None:
    intake = Intake(jump_back_s=1.0)
    arriving = [number for number in order for _ in range(repeats + 1)]
    used = [number for number in arriving if intake.judge(T0 + number * MS, (0.0,)).used]
    records = [number for index, number in enumerate(order) if number > max(order[:index], default=0)]
    assert used == records
    assert intake.counts[Verdict.DUPLICATE] == repeats * len(records)
    assert intake.counts[Verdict.OUT_OF_ORDER] == (repeats + 1) * (len(order) - len(records))


@given(st.sets(st.integers(1, 200), max_size=150))
def test_missing_samples_are_counted_by_the_gaps_in_the_stamps(left_out: set[int]) -> None:
    intake = Intake(expected_rate_hz=1000.0)
    for number in range(202):
        if number not in left_out:
            # the stamps of the sender jitter by 40 % of a period, but this must not make a sample missing
            intake.judge(T0 + number * MS + (number % 3 - 1) * MS // 5, (0.0,))
    assert intake.missing == len(left_out)


def test_a_restart_forgets_the_stamps_and_keeps_the_counts() -> None:
    intake = Intake()
    intake.judge(T0, (0.0,))
    intake.restart()
    assert intake.judge(T0 - MS, (0.0,)) is Verdict.ACCEPTED
    assert intake.used == 2
