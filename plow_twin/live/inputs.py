"""Process the inputs of a live twin: choose the sender, count messages, and check the optional inputs."""

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
#: Inputs that are not the load.
OPTIONAL: Final = ("travel", "head_pose", "gaps")
#: Time for which a sender that is not followed counts as present after its last sample [ns].
_OTHER_SENDER_NS: Final = 3_000_000_000
#: Time without a message after which an input counts as silent [ns].
SILENT_NS: Final = 10_000_000_000


class Inputs:
    """Inputs of a live twin.

    The input `source` provides the load, from a queue of `depth` messages. `late_span_s` is the largest delay at which
    a measured pose or gap is used [s]. With `journaled`, unused messages are collected for the journal. The other
    arguments are those of the `Intake` of the load.
    """

    def __init__(
        self, front: Front, source: str, depth: int, late_span_s: float, *, journaled: bool, **intake: Any
    ) -> None:
        self._front, self._source = front, source
        self.intake = Intake(on_unused=self._sample_unused, **intake)
        self.unused = UnusedMessages(journaled)
        #: topic and sender of the message that is being processed; not set for the input `source`
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
        #: number of messages that the transport has lost
        self.lost = 0
        self.travel, self.head_pose, self.gaps = (Intake(on_unused=self._unused) for _ in OPTIONAL)
        self._gap_limits: Limits | None = None
        #: stamp [ns] and value [m] of the newest gap of each pair
        self._newest_gaps: dict[int, tuple[int, float]] = {}
        self._newest_pose = (0.0, 0.0, 0.0)
        self.measured: tuple[float, float, float] | None = None
        self.refused_publishers = 0
        #: number of senders that are connected to each input
        self.publishers = dict.fromkeys(TOPICS, 0)

    def set_limits(self, travel: Limits, pose: Limits, gap: Limits) -> None:
        """Set the limits of the speed [m/s], the pose (x, y [m], theta [rad]) and the gaps [m]."""
        self.travel.limits, self.head_pose.limits, self._gap_limits = travel, pose, gap

    def other_senders(self) -> list[str]:
        """Return the inputs on which a sender that is not followed is sending."""
        if not self._other_heard_ns:
            return []
        now_ns = time.monotonic_ns()
        return [topic for topic, heard_ns in self._other_heard_ns.items() if now_ns - heard_ns < _OTHER_SENDER_NS]

    def silent(self) -> list[str]:
        """Return the optional inputs that have received messages, but none in the last 10 s."""
        if self.ended:
            return []
        now_ns = time.monotonic_ns()
        return [topic for topic, heard_ns in self._heard_ns.items() if now_ns - heard_ns > SILENT_NS]

    def waited(self, messages: int, longest_s: float) -> None:
        """Register the number of messages in the queue, and the time that the first message waited [s]."""
        self.wait_s = max(self.wait_s, longest_s)
        most, before_s = self._queue_peak
        if messages > most or longest_s > before_s:
            self._queue_peak = (max(most, messages), max(before_s, longest_s))

    def pop_queue_peak(self) -> tuple[int, float]:
        """Return the largest number of messages in the queue, and the longest wait [s], since the last call."""
        peak, self._queue_peak = self._queue_peak, (0, 0.0)
        return peak

    def wanted(self, sender: bytes, number: int, stamp_ns: int, values: Sequence[float], fits: bool = True) -> bool:
        """Register a message of a sender, and return whether it is used. An unused message is counted.

        `number` counts the messages of each sender from 1. `fits` states whether the message can be read as a sample.
        """
        lost = self.senders.lost
        followed = self.senders.count_arrival(sender, number)
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
        """Count `more` samples before the first sample of a sender as lost.

        Returns False, without an effect, if the sender is not followed.
        """
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
        """Return whether the current message on an optional input comes from the followed sender; if not, count it."""
        sender = self.arriving[1]
        followed = self.optional[topic].count_arrival(sender, time.monotonic_ns())
        if not followed:
            self._other_heard(topic, sender, stamp_ns, values)
        return followed

    def uses_travel(self, stamp_ns: int, speed_m_s: float) -> bool:
        """Check a speed along the face, and return whether it is used."""
        if not self._follows("travel", stamp_ns, (speed_m_s,)):
            return False
        return self._judged("travel", self.travel, stamp_ns, (speed_m_s,)).used

    def uses_pose(self, stamp_ns: int, pose: tuple[float, float, float], deviation: tuple[float, ...] = ()) -> bool:
        """Check a measured pose x, y [m], theta [rad] and its standard deviations, and return whether it is used.

        A component that was not measured is NaN. A pose whose components are all NaN is refused.
        """
        if not self._follows("head_pose", stamp_ns, (*pose, *deviation)):
            return False
        missing = [math.isnan(value) for value in pose]
        # a component that was not measured is replaced by its last value, so that the limits can be checked
        judged = pose if all(missing) else _filled(pose, self._newest_pose)
        verdict = self._judged("head_pose", self.head_pose, stamp_ns, (*judged, *deviation), self._poses)
        if verdict.used and verdict is not Verdict.INSERTED:
            self._newest_pose = judged
            if not any(missing):
                self.measured = pose
        return verdict.used

    def uses_gaps(self, stamp_ns: int, gaps: Mapping[int, float]) -> bool:
        """Check measured gaps [m], by number of the pair, and return whether they are used."""
        values = tuple(gaps.values())
        if not self._follows("gaps", stamp_ns, values):
            return False
        if self.active and self._is_implausible(stamp_ns, gaps):
            self.gaps.refuse(Verdict.IMPLAUSIBLE, stamp_ns, values)
            return False
        verdict = self._judged("gaps", self.gaps, stamp_ns, values, self._gap_stamps)
        if verdict.used and verdict is not Verdict.INSERTED:
            self._newest_gaps |= {pair: (stamp_ns, gap) for pair, gap in gaps.items()}
        return verdict.used

    def _is_implausible(self, stamp_ns: int, gaps: Mapping[int, float]) -> bool:
        limits = self._gap_limits
        if limits is None or not all(map(math.isfinite, gaps.values())):
            return False  # the gaps contain NaN or infinity, which the intake will refuse
        for pair, gap in gaps.items():
            before_ns, before = self._newest_gaps.get(pair, (stamp_ns, gap))
            passed_s = (stamp_ns - before_ns) * 1e-9
            if limits.exceeded((gap,)) or (passed_s > 0.0 and not limits.keep((before,), (gap,), passed_s)):
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
        """Return the pose `q` of the model minus the measured pose, or None without a measurement."""
        if self.measured is None:
            return None
        x, y, theta = (float(model) - data for model, data in zip(q, self.measured, strict=True))
        # the difference of two angles is between -pi and pi
        return x, y, math.remainder(theta, 2.0 * math.pi)


def _filled(pose: tuple[float, float, float], newest: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, theta = (before if math.isnan(value) else value for value, before in zip(pose, newest, strict=True))
    return x, y, theta
