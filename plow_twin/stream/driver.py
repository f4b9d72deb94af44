"""What to do with arriving samples and with silence: the one place where intake, hold policy and session meet."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from plow_twin.stream.health import RealTimeFactor
from plow_twin.stream.intake import NS_PER_S, Intake, Verdict
from plow_twin.stream.journal import Entry, Hold, Parameter, ParameterValue, Reset, Sample, Travel
from plow_twin.stream.session import Session

if TYPE_CHECKING:
    from plow_twin.run.advance import Advance

#: Most model time that one call may catch up when the excitation is silent [ns]: the work of a call stays bounded.
_LARGEST_HOLD_NS: Final = NS_PER_S


class StreamState(Enum):
    """What the stream is doing."""

    WAITING = "waiting for the first sample"
    RUNNING = "running"
    STALE = "excitation stale"
    FAILED = "solver failed, last good state kept"


@dataclass
class Policy:
    """What may change at run time.

    After `excitation_timeout_s` without a sample the model goes on by the steady clock, that far behind it, so that a
    sample late by less is still used. `hold` is `hold` (the last load stays) or `zero` (it falls to zero within the
    first call). After `failure_limit` failed advances in a row the model is reset; 0: never.
    """

    excitation_timeout_s: float = 0.5
    hold: str = "hold"
    failure_limit: int = 10


class Driver:
    """Feed a session from live events. Times are passed in: `now_ns` on a steady clock, stamps on the samples' own."""

    def __init__(self, session: Session, intake: Intake, policy: Policy) -> None:
        self.session = session
        self.intake = intake
        self.policy = policy
        self.real_time = RealTimeFactor()
        self.state = StreamState.WAITING
        #: text of the last failed advance
        self.failure = ""
        self.failures = 0
        self.resets = 0
        self.holds = 0
        self.clock = Intake(jump_back_s=intake.jump_back_s, jump_forward_s=intake.jump_forward_s)
        self._failures_in_row = 0
        self._received_ns = 0
        self._newest_ns: int | None = None
        self._zeroed = False
        #: what the stamps of the scene's own loads lie behind the clock [ns]: time spent inactive
        self._behind_ns = 0
        self._resumed = False

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample used [ns]; None before the first and after a reset."""
        return self._newest_ns

    def sample(self, stamp_ns: int, wrench: tuple[float, float, float], now_ns: int) -> Advance | None:
        """Judge a sample and, when it is used, advance to it."""
        verdict = self.intake.judge(stamp_ns, wrench, self.session.stamp_ns)
        if not verdict.used:
            return None
        if verdict.resets:
            self._restart_model(stamp_ns, verdict.value)
        self._received_ns, self._newest_ns, self._zeroed = now_ns, stamp_ns, False
        return self._advance(Sample(stamp_ns, wrench), now_ns, StreamState.RUNNING)

    def silence(self, now_ns: int) -> Advance | None:
        """Go on under the hold policy when the excitation has been silent for too long; called at intervals."""
        if self._newest_ns is None:
            return None
        overdue_ns = now_ns - self._received_ns - round(self.policy.excitation_timeout_s * NS_PER_S)
        if overdue_ns <= 0:
            return None
        reached_ns = self.session.stamp_ns if self.session.stamp_ns is not None else self._newest_ns
        stamp_ns = min(self._newest_ns + overdue_ns, reached_ns + _LARGEST_HOLD_NS)
        if stamp_ns <= reached_ns:
            return None
        self.holds += 1
        if self.policy.hold == "zero" and not self._zeroed:
            self._zeroed = True
            return self._advance(Sample(stamp_ns, (0.0, 0.0, 0.0)), now_ns, StreamState.STALE)
        return self._advance(Hold(stamp_ns), now_ns, StreamState.STALE)

    def clock_tick(self, stamp_ns: int, now_ns: int) -> Advance | None:
        """Advance under the scene's own loads to the time `stamp_ns` of the node's clock, less the time spent inactive.

        The first call after `resume` only finds out how long that was.
        """
        reached_ns = self.session.stamp_ns
        if reached_ns is None:
            self._behind_ns = 0
        elif self._resumed and stamp_ns > 0:
            self._behind_ns = stamp_ns - reached_ns
        self._resumed = self._resumed and stamp_ns <= 0
        stamp_ns -= self._behind_ns
        verdict = self.clock.judge(stamp_ns, (), self.session.stamp_ns)
        if not verdict.used:
            return None
        if verdict.resets:
            # the model starts anew: on the clock itself
            stamp_ns += self._behind_ns
            self._behind_ns = 0
            self.clock.restart()
            self.clock.judge(stamp_ns, ())
            self._restart_model(stamp_ns, f"clock {verdict.value}")
        return self._advance(Hold(stamp_ns), now_ns, StreamState.RUNNING)

    def travel(self, stamp_ns: int, speed_m_s: float) -> None:
        """Take over the speed along the face [m/s]; its sign is a direction and does not wear."""
        self.session.apply(Travel(stamp_ns, abs(speed_m_s)))

    def parameter(self, name: str, value: ParameterValue) -> None:
        """Journal a parameter that has changed."""
        self.session.apply(Parameter(name, value))

    def reset(self, stamp_ns: int, reason: str) -> None:
        """Put the model back to its initial state; the next sample starts its time anew."""
        self._restart_model(stamp_ns, reason)
        self.intake.restart()
        self.clock.restart()

    def resume(self, now_ns: int) -> None:
        """Let silence and the clock count from now on: the time spent inactive is not caught up."""
        self._received_ns = now_ns
        self._resumed = True

    def close(self) -> None:
        """End the journal."""
        self.session.close()

    def _restart_model(self, stamp_ns: int, reason: str) -> None:
        self.session.apply(Reset(stamp_ns, reason))
        self.resets += 1
        self._failures_in_row = 0
        self._newest_ns = None
        self.state = StreamState.WAITING

    def _advance(self, entry: Entry, now_ns: int, state: StreamState) -> Advance | None:
        before_ns = self.session.stamp_ns
        advance = self.session.apply(entry)
        after_ns = self.session.stamp_ns
        if before_ns is not None and after_ns is not None:
            self.real_time.advanced((after_ns - before_ns) * 1e-9, now_ns)
        if advance is None or not advance.status:
            self._failures_in_row = 0
            self.state = state
            return advance
        self.failures += 1
        self._failures_in_row += 1
        self.state = StreamState.FAILED
        self.failure = advance.status.text
        if 0 < self.policy.failure_limit <= self._failures_in_row:
            self.reset(after_ns or 0, f"{self._failures_in_row} failed advances: {self.failure}")
        return advance


def counters(driver: Driver) -> dict[str, int]:
    """Return every counter of a driver under its published name."""
    intake = driver.intake
    return {
        "samples_in": intake.arrived,
        "samples_used": intake.used,
        "samples_missing": intake.missing,
        **{f"dropped_{verdict.value}": intake.counts[verdict] for verdict in Verdict if not verdict.used},
        "jumps_back": intake.counts[Verdict.JUMP_BACK],
        "jumps_forward": intake.counts[Verdict.JUMP_FORWARD],
        "out_of_plane": intake.out_of_plane,
        "holds": driver.holds,
        "resets": driver.resets,
        "solver_failures": driver.failures,
    }
