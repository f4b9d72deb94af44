"""The inputs of a live twin from any transport: choice of the sender, counts, and checks of the optional inputs."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from numpy.typing import NDArray

from plow_twin.live.unused import UnusedMessages
from plow_twin.stream.history import RecentStamps
from plow_twin.stream.intake import Intake, Verdict
from plow_twin.stream.limits import Limits
from plow_twin.stream.senders import OneSender, Senders

if TYPE_CHECKING:
    from plow_twin.live.publishing import Front

TOPICS: Final = ("excitation", "tool_forces", "travel", "head_pose", "gaps")
#: The inputs besides the load.
OPTIONAL: Final = ("travel", "head_pose", "gaps")
#: Another sender counts as present for this time after its last sample [ns].
_OTHER_SENDER_NS: Final = 3_000_000_000
#: An optional input that was heard counts as silent after this time without a message [ns].
_SILENT_NS: Final = 10_000_000_000


class Inputs:
    """The inputs of a live twin.

    `source` is the input that gives the load, `depth` the length of its queue, and `intake` has the arguments of the
    `Intake` that judges it. `late_span_s` is the largest delay with which a measured pose or gap is still used. If
    `journaled`, unused messages are collected for the journal.
    """

    def __init__(
        self, front: Front, source: str, depth: int, late_span_s: float, *, journaled: bool, **intake: Any
    ) -> None:
        self._front, self._source = front, source
        self.intake = Intake(on_unused=self._sample_unused, **intake)
        self.unused = UnusedMessages(journaled)
        #: topic and sender of the message being processed, unless the selected source has sent it
        self.arriving = ("", b"")
        self._poses, self._gap_stamps = RecentStamps(late_span_s), RecentStamps(late_span_s)
        self.depth = depth
        self.active = False
        self.ended = False
        #: whether the journal is open
        self.started = False
        self.senders = Senders()
        self.optional = {topic: OneSender() for topic in OPTIONAL}
        self._queue_peak = (0, 0.0)
        #: longest wait of a sample since the last report [s]
        self.wait_s = 0.0
        self._heard_ns: dict[str, int] = {}
        self._other_heard_ns: dict[str, int] = {}
        #: number of messages that could not be read
        self.lost = 0
        self.travel, self.head_pose, self.gaps = (Intake(on_unused=self._unused) for _ in OPTIONAL)
        self._gap_limits: Limits | None = None
        #: newest stamp [ns] and gap [m] of each pair
        self._newest_gaps: dict[int, tuple[int, float]] = {}
        self._newest_pose = (0.0, 0.0, 0.0)
        self.measured: tuple[float, float, float] | None = None
        self.refused_publishers = 0
        #: number of senders to which each input is connected
        self.publishers = dict.fromkeys(TOPICS, 0)

    def set_limits(self, travel: Limits, pose: Limits, gap: Limits) -> None:
        """Set the limits of speed [m/s], pose (x, y [m], theta [rad]) and gap [m]."""
        self.travel.limits, self.head_pose.limits, self._gap_limits = travel, pose, gap

    def other_senders(self) -> list[str]:
        """Return the inputs on which a sender that is not followed sends too."""
        if not self._other_heard_ns:
            return []
        now_ns = time.monotonic_ns()
        return [topic for topic, heard_ns in self._other_heard_ns.items() if now_ns - heard_ns < _OTHER_SENDER_NS]

    def silent(self) -> list[str]:
        """Return the optional inputs that have become silent."""
        if self.ended:
            return []
        now_ns = time.monotonic_ns()
        return [topic for topic, heard_ns in self._heard_ns.items() if now_ns - heard_ns > _SILENT_NS]

    def waited(self, messages: int, longest_s: float) -> None:
        """Record how many messages waited, and how long the first of them waited [s]."""
        self.wait_s = max(self.wait_s, longest_s)
        most, before_s = self._queue_peak
        if messages > most or longest_s > before_s:
            self._queue_peak = (max(most, messages), max(before_s, longest_s))

    def pop_queue_peak(self) -> tuple[int, float]:
        """Return the largest number of messages that waited, and their longest wait [s], since the last call."""
        peak, self._queue_peak = self._queue_peak, (0, 0.0)
        return peak

    def wanted(self, sender: bytes, number: int, stamp_ns: int, values: Sequence[float], fits: bool = True) -> bool:
        """Register message `number` (from 1) of a sender; if it cannot be used, count it and return False.

        `fits` states whether the message can be read as a sample; `values` are all its numbers.
        """
        lost = self.senders.lost
        followed = self.senders.hear(sender, number)
        if self.senders.lost != lost:
            self.unused.note_lost(self._source, sender, self.senders.lost - lost)
        if followed and self.active and fits:
            return True
        if not followed:
            self._other_heard(self._source, sender, stamp_ns, values)
        elif not self.active:
            self.intake.refuse(Verdict.INACTIVE, stamp_ns, values)
        else:
            self.intake.refuse(Verdict.MALFORMED, stamp_ns, values)
        return False

    def lost_at_first(self, sender: bytes, more: int) -> bool:
        """Count `more` samples before a sender's first sample as lost; return False unless it is followed."""
        if sender != self.senders.followed:
            return False
        self.senders.lost += more
        self.unused.note_lost(self._source, sender, more)
        return True

    def _other_heard(self, topic: str, sender: bytes, stamp_ns: int, values: Sequence[float]) -> None:
        if topic not in self.other_senders():
            self._front.look_for_senders(topic)
        self._other_heard_ns[topic] = time.monotonic_ns()
        self.unused.note(topic, sender, "not_followed", stamp_ns, values)

    def _follows(self, topic: str, stamp_ns: int, values: Sequence[float]) -> bool:
        """Return whether a message on an optional input comes from the followed sender; count other senders."""
        sender = self.arriving[1]
        followed = self.optional[topic].hear(sender, time.monotonic_ns())
        if not followed:
            self._other_heard(topic, sender, stamp_ns, values)
        return followed

    def uses_travel(self, stamp_ns: int, speed_m_s: float) -> bool:
        """Judge a speed along the face; return whether it is used."""
        if not self._follows("travel", stamp_ns, (speed_m_s,)):
            return False
        return self._judged("travel", self.travel, stamp_ns, (speed_m_s,)).used

    def uses_pose(self, stamp_ns: int, pose: tuple[float, float, float], deviation: tuple[float, ...] = ()) -> bool:
        """Judge a measured pose x, y [m], theta [rad] and its standard deviations; return whether it is used.

        A component that was not measured is NaN; a pose of three NaN is refused.
        """
        if not self._follows("head_pose", stamp_ns, (*pose, *deviation)):
            return False
        missing = [math.isnan(value) for value in pose]
        # a component that was not measured cannot exceed its limit
        judged = pose if all(missing) else _filled(pose, self._newest_pose)
        verdict = self._judged("head_pose", self.head_pose, stamp_ns, (*judged, *deviation), self._poses)
        if verdict.used and verdict is not Verdict.WORKED_IN:
            self._newest_pose = judged
            if not any(missing):
                self.measured = pose
        return verdict.used

    def uses_gaps(self, stamp_ns: int, gaps: Mapping[int, float]) -> bool:
        """Judge measured gaps [m] by number of their pairs; return whether they are used."""
        values = tuple(gaps.values())
        if not self._follows("gaps", stamp_ns, values):
            return False
        if self.active and self._is_implausible(stamp_ns, gaps):
            self.gaps.refuse(Verdict.IMPLAUSIBLE, stamp_ns, values)
            return False
        verdict = self._judged("gaps", self.gaps, stamp_ns, values, self._gap_stamps)
        if verdict.used and verdict is not Verdict.WORKED_IN:
            self._newest_gaps |= {pair: (stamp_ns, gap) for pair, gap in gaps.items()}
        return verdict.used

    def _is_implausible(self, stamp_ns: int, gaps: Mapping[int, float]) -> bool:
        """Return whether a gap is too large, or has changed too fast since the newest gap of its pair."""
        limits = self._gap_limits
        if limits is None or not all(map(math.isfinite, gaps.values())):
            return False  # the intake refuses a value that is not finite
        for pair, gap in gaps.items():
            before_ns, before = self._newest_gaps.get(pair, (stamp_ns, gap))
            passed_s = (stamp_ns - before_ns) * 1e-9
            if limits.exceeded((gap,)) or (passed_s > 0.0 and limits.too_fast((before,), (gap,), passed_s)):
                return True
        return False

    def _judged(
        self, topic: str, intake: Intake, stamp_ns: int, values: tuple[float, ...], history: RecentStamps | None = None
    ) -> Verdict:
        if not self.active or (not self.started and self._front.now_ns() == 0):
            refused = Verdict.NO_CLOCK if self.active else Verdict.INACTIVE
            intake.refuse(refused, stamp_ns, values)
            return refused
        verdict = intake.judge(stamp_ns, values, history=history)
        if verdict.used:
            self._heard_ns[topic] = time.monotonic_ns()
            if history is not None:
                if verdict.resets:
                    history.clear()
                history.add(stamp_ns)
        return verdict

    def _sample_unused(self, verdict: Verdict, stamp_ns: int, values: Sequence[float]) -> None:
        if verdict is Verdict.NOT_SELECTED:
            self._unused(verdict, stamp_ns, values)
        else:
            self.unused.note(self._source, self.senders.followed or b"", verdict.value, stamp_ns, values)

    def _unused(self, verdict: Verdict, stamp_ns: int, values: Sequence[float]) -> None:
        self.unused.note(*self.arriving, verdict.value, stamp_ns, values)

    def residual(self, q: NDArray[Any]) -> tuple[float, float, float] | None:
        """Return model minus measured pose, or None without a measurement."""
        if self.measured is None:
            return None
        x, y, theta = (float(model) - data for model, data in zip(q, self.measured, strict=True))
        # angles that differ by a full turn are the same
        return x, y, math.remainder(theta, 2.0 * math.pi)


def _filled(pose: tuple[float, float, float], newest: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, theta = (before if math.isnan(value) else value for value, before in zip(pose, newest, strict=True))
    return x, y, theta
