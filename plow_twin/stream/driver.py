"""The driver, which feeds a session with the samples of a live stream and advances it while no samples arrive.

An *intake* accepts or rejects each sample. A time without samples is called a *silence*. During a silence, the model
follows the steady clock.
"""

from __future__ import annotations

import json
import math
from bisect import insort
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from operator import attrgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.stream import journal
from plow_twin.stream.failures import Failures
from plow_twin.stream.health import RealTimeFactor
from plow_twin.stream.intake import NS_PER_S, Intake, Verdict
from plow_twin.stream.outputs import NONE, NOTHING, Published, Rows
from plow_twin.stream.session import Series, Session
from plow_twin.stream.silences import Silences
from plow_twin.stream.steps import Steps

#: Stamp [ns] and wrench (Fx, Fy [N], M [N m]) of a sample that has arrived.
Arrival = tuple[int, tuple[float, float, float]]

#: Longest model time [ns] by which a single call of `silence` advances the model.
_LARGEST_HOLD_NS: Final = NS_PER_S
#: Longest time [ns] between two checks for a silence, which is short so that a changed policy soon has an effect.
_LONGEST_QUIET_NS: Final = NS_PER_S // 10
#: Largest number of resets by jumps of the clock within `_RESET_WINDOW_NS`. Without this limit, two senders with
#: different clocks would reset the model at each of their samples.
_MOST_RESETS: Final = 5
_RESET_WINDOW_NS: Final = 10 * NS_PER_S


class StreamState(Enum):
    """State of the stream of samples."""

    WAITING = "waiting for the first sample"
    RUNNING = "running"
    STALE = "excitation stale"
    ENDED = "excitation stale for longer than hold_limit, the model stands still"
    FAILED = "solver failed, last good state kept"


@dataclass
class Policy:
    """Treatment of silences and failures. The settings may change at run time."""

    #: time without a sample [s] after which the model follows the steady clock; the model lags behind the clock by
    #: `excitation_timeout_s`, so that a sample with a smaller delay can still be used
    excitation_timeout_s: float = 0.5
    #: with `hold`, the last load acts during a silence; with `zero`, the load falls to zero within one call of
    #: `Driver.silence`
    hold: str = "hold"
    #: time without a sample [s], counted from the end of `excitation_timeout_s`, after which the model stands still
    hold_limit_s: float = 60.0
    #: number of consecutive failed advances after which the model is reset (see `Failures.wants_restart`); 0: never
    failure_limit: int = 10


@dataclass(frozen=True, eq=False)
class Block:
    """Samples that have arrived and may be applied together: `stamps` [ns], shape (n,), and `wrench`, shape (n, 3)."""

    stamps: NDArray[np.int64]
    wrench: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, place: int) -> Arrival:
        fx, fy, moment = self.wrench[place].tolist()
        return self.stamps.item(place), (fx, fy, moment)

    def __iter__(self) -> Iterator[Arrival]:
        return map(self.__getitem__, range(len(self)))

    def part(self, begin: int, end: int) -> Block:
        """Return the samples with indices from `begin` to `end` - 1."""
        return Block(self.stamps[begin:end], self.wrench[begin:end])


class Driver:
    """Feed a session from live events and return the publications.

    The driver reads no clock. The argument `now_ns` is the time of a steady clock, while stamps are times of the
    samples' clock. If `every_sample` is set, each advance is published. If not, only `due` publishes.
    """

    def __init__(self, session: Session, intake: Intake, policy: Policy, *, every_sample: bool = True) -> None:
        self.session = session
        self.intake = intake
        self.silences = Silences(policy.excitation_timeout_s)
        self.policy = policy
        self.every_sample = every_sample
        self.real_time = RealTimeFactor()
        self.state = StreamState.WAITING
        self.failed = Failures(session.emit)
        self.resets = 0
        self.holds = 0
        #: number of late samples that were used; some may wait for their insertion (`Session.waiting`)
        self.rolled_back = 0
        #: number of travel speeds that could not take effect at their stamps
        self.travel_misplaced = 0
        #: times of the latest resets by jumps of the clock, on the steady clock [ns]
        self._resets_ns: deque[int] = deque(maxlen=_MOST_RESETS)
        #: time of the latest refused reset, on the steady clock [ns]
        self._unsteady_ns: int | None = None
        self._steps = Steps(intake)
        self.clock = Intake(jump_back_s=intake.jump_back_s, jump_forward_s=intake.jump_forward_s)
        self._received_ns = 0
        #: stamp of the newest sample used [ns]; None before the first sample and after a reset
        self.newest_ns: int | None = None
        #: stamp of the last advance that `real_time` has counted [ns]
        self._counted_ns: int | None = None
        self._zeroed = False
        #: time that the node has been inactive [ns], by which the model lags behind the node's clock under the scene's
        #: own loads
        self._behind_ns = 0
        self._resumed = False

    @property
    def policy(self) -> Policy:
        """The settings for silences and failures. A changed policy takes effect at once."""
        return self._policy

    @policy.setter
    def policy(self, policy: Policy) -> None:
        self._policy = policy
        self.silences.timeout_s = policy.excitation_timeout_s

    def samples(self, arrived: Sequence[Arrival] | Block, now_ns: int) -> Iterator[Published | Series]:
        """Judge samples in order of arrival, advance to the accepted samples, and yield the publications.

        The caller must send each publication before it requests the next item, so that a recording contains the
        publications in order. If the stamp of a sample jumps, the sample waits until the next sample arrives or a
        silence begins.

        Plausible samples of a `Block` are applied in one call, which is faster, and yielded as a `Series`. The caller
        must journal and publish the series before it requests the next item.
        """
        run: list[journal.Sample] = []
        place, block = 0, arrived if isinstance(arrived, Block) else None
        ends = NONE
        if block is not None:
            ends = np.append(1 + np.flatnonzero(~self.intake.go_on(block.stamps, block.wrench)), len(block))
        while place < len(arrived):
            end, arrival = place + 1, arrived[place]
            goes_on = (block is not None or self.every_sample) and self._may_go_on(*arrival)
            if goes_on and run:
                yield from self._use(run, now_ns)
                goes_on = self._may_go_on(*arrival)
            if not goes_on:
                for settled in self._steps.settle(*arrival, now_ns, self.session.stamp_ns):
                    yield from self._use_samples(run, *settled[:2], now_ns)
            elif block is not None:
                end = int(ends[ends.searchsorted(place, "right")])
                yield from self._use_together(block.part(place, end), now_ns)
            else:
                self._accept(*arrival, now_ns)
                self.silences.add_one(arrival[0])
                yield from self._apply([journal.Sample(*arrival)], now_ns)
            place = end
        if run or self.newest_ns is None:
            yield from self._use(run, now_ns)

    def _use_together(self, block: Block, now_ns: int) -> Iterator[Published | Series]:
        series = self.session.apply_series(block.stamps, block.wrench, each=self.every_sample)
        if series is None:
            yield from self.samples(list(block), now_ns)
            return
        self._accept(*block[-1], now_ns, len(block))
        self.silences.add(block.stamps)
        self._advanced(now_ns)
        self.failed.end()
        self.state = StreamState.RUNNING
        yield series

    def _accept(self, stamp_ns: int, wrench: tuple[float, float, float], now_ns: int, count: int = 1) -> None:
        self.intake.accept(stamp_ns, wrench, count)
        self.newest_ns, self._received_ns, self._zeroed = stamp_ns, now_ns, False

    def _may_go_on(self, stamp_ns: int, wrench: tuple[float, float, float]) -> bool:
        reached_ns = self.session.stamp_ns
        if reached_ns is None or self._steps.delayed is not None:
            return False
        return self.intake.goes_on(stamp_ns, wrench, reached_ns)

    def _use_samples(
        self, run: list[journal.Sample], stamp_ns: int, wrench: tuple[float, float, float], now_ns: int
    ) -> Iterator[Published]:
        """Judge a sample and append it to `run`, whose samples are applied together.

        If the sample cannot be judged or applied together with the others, the others are applied first.
        """
        late = bool(run) and self._is_late(run[0].stamp_ns)
        # if the stamp does not rise, `run` must be applied before the sample can be judged as late or as a jump back
        if run and not late and stamp_ns <= run[-1].stamp_ns:
            yield from self._use(run, now_ns)
            late = False
        if late and any(sample.stamp_ns == stamp_ns for sample in run):
            self.intake.refuse(Verdict.DUPLICATE, stamp_ns, wrench)
            return
        verdict = self._judge(stamp_ns, wrench, now_ns)
        if not verdict.used:
            return
        if run and (verdict.resets or (late and self.every_sample and verdict is Verdict.ACCEPTED)):
            yield from self._use(run, now_ns)
        if verdict.resets:
            self._restart_model(stamp_ns, verdict.value, None if self.intake.returned else now_ns)
        if self.newest_ns is None or stamp_ns > self.newest_ns:
            self.newest_ns = stamp_ns
        self.silences.add_one(stamp_ns)
        self._received_ns, self._zeroed = now_ns, False
        insort(run, journal.Sample(stamp_ns, wrench), key=attrgetter("stamp_ns"))

    def due(self) -> Published:
        """Return the publication of all advances since the last publication."""
        return self.session.outputs.pop()

    def silence(self, now_ns: int) -> Published:
        """Advance without samples if the last sample is older than `excitation_timeout_s`."""
        if self.newest_ns is None:
            return NOTHING
        timeout_ns = round(self.policy.excitation_timeout_s * NS_PER_S)
        jumped = self._steps.unopposed(now_ns, timeout_ns)
        if jumped is not None:
            run: list[journal.Sample] = []
            return Published.joined([*self._use_samples(run, *jumped[:2], now_ns), *self._use(run, now_ns)])
        silent_ns = now_ns - self._received_ns - timeout_ns
        if silent_ns <= 0:
            return NOTHING
        limit_ns = round(self.policy.hold_limit_s * NS_PER_S)
        reached_ns = self.session.stamp_ns if self.session.stamp_ns is not None else self.newest_ns
        stamp_ns = min(self.newest_ns + min(silent_ns, limit_ns), reached_ns + _LARGEST_HOLD_NS)
        if stamp_ns <= reached_ns:
            if silent_ns > limit_ns:
                self.state = StreamState.ENDED
            return NOTHING
        self.holds += 1
        if self.policy.hold == "zero" and not self._zeroed:
            self._zeroed = True
            return self._advance(journal.Unload(stamp_ns), now_ns, StreamState.STALE)
        return self._advance(journal.Hold(stamp_ns), now_ns, StreamState.STALE)

    def quiet_ns(self, now_ns: int) -> int:
        """Return a time [ns] during which a call of `silence` would have no effect."""
        timeout_ns = round(self.policy.excitation_timeout_s * NS_PER_S)
        left_ns = timeout_ns if self.newest_ns is None else self._received_ns + timeout_ns - now_ns
        return max(0, min(left_ns, _LONGEST_QUIET_NS))

    def clock_tick(self, stamp_ns: int, now_ns: int) -> Published:
        """Advance under the scene's own loads to the node's time `stamp_ns` minus the time without activity.

        The first call after `resume` measures how long the node has been inactive. It does not advance the model.
        """
        reached_ns = self.session.stamp_ns
        if reached_ns is None:
            self._behind_ns = 0
        elif self._resumed and stamp_ns > 0:
            self._behind_ns = stamp_ns - reached_ns
        self._resumed = self._resumed and stamp_ns <= 0
        stamp_ns -= self._behind_ns
        verdict = self.clock.judge(stamp_ns, (), self.session.stamp_ns, may_reset=self._may_reset(now_ns))
        if verdict is Verdict.UNSTEADY:
            self._unsteady_ns = now_ns
        if not verdict.used:
            return NOTHING
        if verdict.resets:
            stamp_ns += self._behind_ns
            self._behind_ns = 0
            self.clock.restart()
            self.clock.judge(stamp_ns, ())
            self._restart_model(stamp_ns, f"clock {verdict.value}", now_ns)
        return self._advance(journal.Hold(stamp_ns), now_ns, StreamState.RUNNING)

    def travel(self, stamp_ns: int, speed_m_s: float) -> None:
        """Apply a travel speed along the face [m/s] from its stamp on; the sign gives the direction.

        A stamp that is more than `jump_forward_s` ahead of the model, or older than all stored states, must come from a
        different clock. In this case, the speed takes effect at once and is counted in `travel_misplaced`.
        """
        reached_ns, oldest_ns = self.session.stamp_ns, self.session.history.oldest_ns
        if reached_ns is not None:
            ahead = stamp_ns - reached_ns > self.intake.jump_forward_s * NS_PER_S
            if ahead or (oldest_ns is not None and stamp_ns <= oldest_ns):
                self.travel_misplaced += 1
            if ahead:
                stamp_ns = reached_ns
        self.session.apply(journal.Travel(stamp_ns, speed_m_s))

    def snapshot(self) -> journal.Snapshot:
        """Journal and return the exact state; samples older than this state can no longer be inserted."""
        snapshot = self.session.renew()
        self.session.emit(snapshot)
        return snapshot

    def restore(self, stamp_ns: int, snapshot: journal.Snapshot) -> None:
        """Return to the motion of a snapshot. The next sample is at the model time of the snapshot."""
        self._restart_motion(journal.Restore(stamp_ns, snapshot.data))
        self._restart_stamps()

    def set_model(self, stamp_ns: int, changes: Mapping[str, float]) -> None:
        """Continue with changed numbers of the scene; a number without a key in `changes` is that of the scene file.

        Raise `ArgumentError` if a change is impossible while the twin runs. The twin is unchanged.
        """
        if dict(changes) != self.session.changes:
            self.session.apply(journal.SetModel(stamp_ns, json.dumps(dict(changes))))

    def set_wear(self, stamp_ns: int, depth_m: Sequence[float], reason: str) -> None:
        """Set the wear depth of each pad [m], for example after pads were replaced, and restart the motion.

        Raise `ValueError` if `depth_m` does not contain 8 finite depths of at least 0. The twin is unchanged.
        """
        depth = tuple(float(value) for value in depth_m)
        if len(depth) != PAIR_COUNT or not all(0.0 <= value < math.inf for value in depth):
            raise ValueError(f"wear depth: got {list(depth_m)!r}, expected {PAIR_COUNT} finite depths >= 0 in m")
        self._restart_motion(journal.SetWear(stamp_ns, depth, reason))
        self._restart_stamps()

    def unsteady(self, now_ns: int) -> bool:
        """Return whether stamps have jumped repeatedly, so that resets were refused or many stamps were stray."""
        refused = self._unsteady_ns is not None and now_ns - self._unsteady_ns < _RESET_WINDOW_NS
        return refused or self._steps.unsteady(now_ns)

    def reset(self, stamp_ns: int, reason: str) -> None:
        """Reset the motion to its initial state without a change of the wear; the next stamp is the new time origin."""
        self._restart_model(stamp_ns, reason, None)
        self._restart_stamps()

    def resume(self, now_ns: int) -> None:
        """Continue after a pause of the node; a silence is measured from `now_ns`."""
        self._received_ns = now_ns
        self._resumed = True

    def pause(self) -> None:
        """Count a waiting sample as stray, because no sample will confirm it while the node is inactive."""
        self._steps.end()

    def close(self) -> None:
        """End the journal."""
        self.failed.end()
        self.session.close()

    def _is_late(self, stamp_ns: int) -> bool:
        reached_ns = self.session.stamp_ns
        return reached_ns is not None and stamp_ns <= reached_ns

    def _judge(self, stamp_ns: int, wrench: tuple[float, float, float], now_ns: int) -> Verdict:
        session = self.session
        verdict = self.intake.judge(stamp_ns, wrench, session.stamp_ns, session.history, self._may_reset(now_ns))
        if verdict is Verdict.UNSTEADY:
            self._unsteady_ns = now_ns
        return verdict

    def _may_reset(self, now_ns: int) -> bool:
        return len(self._resets_ns) < _MOST_RESETS or now_ns - self._resets_ns[0] >= _RESET_WINDOW_NS

    def _restart_model(self, stamp_ns: int, reason: str, now_ns: int | None) -> None:
        """Reset the model.

        `now_ns` is the time of a reset by a jump of the clock, which counts towards `_MOST_RESETS`; None for other
        resets.
        """
        if now_ns is not None:
            self._resets_ns.append(now_ns)
        self._restart_motion(journal.Reset(stamp_ns, reason))
        self.resets += 1

    def _restart_motion(self, entry: journal.Reset | journal.Restore | journal.SetWear) -> None:
        self.failed.end()
        self.session.apply(entry)
        self.newest_ns = self._counted_ns = None
        self.silences.restart()
        self.state = StreamState.WAITING

    def _restart_stamps(self) -> None:
        self.intake.restart()
        self.clock.restart()

    def _use(self, run: list[journal.Sample], now_ns: int) -> Iterator[Published]:
        samples = run.copy()
        run.clear()
        for part in self.session.parts(samples, each=self.every_sample):
            yield from self._apply(part, now_ns)
        if self.newest_ns is None:
            # after a reset, a silence is measured from the stamp that the model has reached
            self.newest_ns = self.session.stamp_ns

    def _apply(self, samples: Sequence[journal.Sample], now_ns: int) -> Iterator[Published]:
        applied = self.session.apply_samples(samples, each=self.every_sample)
        self.rolled_back += applied.late
        self._advanced(now_ns)
        if applied.failed:
            self._judge_rows(applied.rows)
        else:
            self.failed.end()
            self.state = StreamState.RUNNING
        if len(applied.published.rows):
            yield applied.published
        if applied.failed:
            # a restart is journalled after the publication, because a replay publishes nothing of the motion before it
            self._restart_after_failures()

    def _advance(self, entry: journal.Hold | journal.Unload, now_ns: int, state: StreamState) -> Published:
        rows = self.session.apply(entry)
        assert rows is not None, "a hold or an unload makes an advance"
        self._advanced(now_ns)
        self._judge_advance(int(rows["status"][0]), entry.stamp_ns, state)
        self._restart_after_failures()
        return self.due() if self.every_sample else NOTHING

    def _advanced(self, now_ns: int) -> None:
        reached_ns = self.session.stamp_ns
        if self._counted_ns is not None and reached_ns is not None:
            self.real_time.advanced((reached_ns - self._counted_ns) * 1e-9, now_ns)
        self._counted_ns = reached_ns

    def _judge_rows(self, rows: Rows) -> None:
        stamps = (self.session.origin_ns or 0) + np.rint(rows["t"] * NS_PER_S).astype(np.int64)
        for status, stamp_ns in zip(rows["status"].tolist(), stamps.tolist(), strict=True):
            self._judge_advance(status, stamp_ns, StreamState.RUNNING)

    def _judge_advance(self, status: int, stamp_ns: int, state: StreamState) -> None:
        if status:
            self.failed.add(stamp_ns, self.session.twin.failure(status))
            self.state = StreamState.FAILED
        else:
            self.failed.end()
            self.state = state

    def _restart_after_failures(self) -> None:
        if self.failed.wants_restart(self.policy.failure_limit):
            self._restart_model(self.session.stamp_ns or 0, self.failed.restarted(), None)
            self._restart_stamps()


def counters(driver: Driver) -> dict[str, int]:
    """Return all counters of a driver, by the names under which they are published."""
    intake = driver.intake
    return {
        "samples_in": intake.arrived,
        "samples_used": intake.used,
        "rolled_back": driver.rolled_back,
        "samples_missing": intake.missing,
        **{f"dropped_{verdict.value}": intake.counts[verdict] for verdict in Verdict if not verdict.used},
        "jumps_back": intake.counts[Verdict.JUMP_BACK],
        "jumps_forward": intake.counts[Verdict.JUMP_FORWARD],
        "out_of_plane": intake.out_of_plane,
        "holds": driver.holds,
        "silences": driver.silences.count,
        "travel_misplaced": driver.travel_misplaced,
        "resets": driver.resets,
        "solver_failures": driver.failed.count,
    }
