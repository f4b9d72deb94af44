"""The decision whether an arriving sample is used, and counts of unused samples by reason.

A stamp *jumps* if it differs from the previous stamps by more than late or missing samples can explain. A jump is
usually caused by a step of the sender's clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from plow_twin.stream.limits import Limits

NS_PER_S = 1_000_000_000
#: First stamp that no message can contain, because the seconds of a ROS message have 32 bits (in the year 2038).
_END_NS = 2**31 * NS_PER_S


#: Least number of successive late samples, in the order of their stamps, that show a step of the sender's clock. Late
#: samples of a network are single samples or a few, and a step of the clock by d seconds makes d times the rate late.
_STEP_BACK = 10


class KnownStamps(Protocol):
    """Stamps of earlier samples, among which a late sample can be inserted."""

    @property
    def oldest_ns(self) -> int | None:
        """Stamp [ns] after which late samples can be inserted; None if no late sample can be inserted."""

    def __contains__(self, stamp_ns: int) -> bool:
        """Return whether an earlier sample has this stamp."""


class Verdict(Enum):
    """Decision on a sample; the value is the name of its counter."""

    ACCEPTED = "accepted"
    #: accepted after a reset, because the stamps stepped back by more than `jump_back_s`
    JUMP_BACK = "jump_back"
    #: accepted after a reset, because the stamps stepped forward by more than `jump_forward_s`
    JUMP_FORWARD = "jump_forward"
    NON_FINITE = "non_finite"
    UNSTAMPED = "unstamped"
    DUPLICATE = "duplicate"
    #: older than the newest sample and all stored states of the model, so the sample cannot be inserted
    OUT_OF_ORDER = "out_of_order"
    #: newer than the newest sample, but older than all stored states of a model that has moved ahead of the stamps
    LATE = "late"
    #: older than the time reached by the model, and inserted into the motion at its stamp
    INSERTED = "inserted"
    #: a value or its rate of change exceeds the `Limits`
    IMPLAUSIBLE = "implausible"
    #: the stamps have jumped too often, so a further jump does not reset the model
    UNSTEADY = "unsteady"
    #: the next sample did not confirm the jump of the stamp, so the stamp was wrong
    STRAY = "stray"
    #: names or array lengths of the message do not match the scene
    MALFORMED = "malformed"
    #: arrived on a topic that is not the selected excitation source
    NOT_SELECTED = "not_selected"
    #: arrived while the node was not active
    INACTIVE = "inactive"
    #: arrived before the first message on /clock
    NO_CLOCK = "without_clock"

    # `Enum.__hash__` hashes the name on each call; hashing by identity is faster
    __hash__ = object.__hash__

    def __init__(self, name: str) -> None:
        #: whether the model must be reset before it uses the sample
        self.resets = name in ("jump_back", "jump_forward")
        self.used = self.resets or name in ("accepted", "inserted")


class Intake:
    """Judge the samples of one stream in order of arrival.

    Parameters
    ----------
    jump_back_s
        Largest age [s] of a late sample relative to the newest stamp; an older stamp is a jump.
    jump_forward_s
        Largest time [s] by which a stamp may be ahead of the model; a later stamp is a jump.
    expected_rate_hz
        Expected rate of the samples [Hz], from which the number of missing samples is computed. With 0, missing samples
        are not counted.
    limits
        Largest plausible values and rates of change. With None, every finite value is plausible.
    on_unused
        Function that receives the reason, stamp [ns] and values of each unused sample.
    """

    def __init__(
        self,
        *,
        jump_back_s: float = 1.0,
        jump_forward_s: float = 10.0,
        expected_rate_hz: float = 0.0,
        limits: Limits | None = None,
        on_unused: Callable[[Verdict, int, Sequence[float]], object] = lambda verdict, stamp_ns, values: None,
    ) -> None:
        self._on_unused = on_unused
        self.jump_back_s = jump_back_s
        self.jump_forward_s = jump_forward_s
        self.expected_rate_hz = expected_rate_hz
        self.limits = limits
        self.counts: dict[Verdict, int] = dict.fromkeys(Verdict, 0)
        #: number of used samples, and of poses, with components outside the plane of the motion
        self.out_of_plane = 0
        self._newest_ns: int | None = None
        self._newest_values: Sequence[float] = ()
        self._before_jump_ns: int | None = None
        #: whether the last sample returned to the stamps before a jump, so that the stamps since the jump were wrong
        self.returned = False
        #: number of steps back of the stamps by at most `jump_back_s`, and the largest step [ns]
        self.steps_back = self.largest_step_back_ns = 0
        #: number of successive late samples in the order of their stamps, the last of their stamps, and the step before
        #: the first of these samples [ns]
        self._late_in_order = self._late_ns = self._step_ns = 0
        #: number of missing samples before the last jump
        self._missing_before = 0
        self._first_ns = 0
        self._since_first = 0

    @property
    def arrived(self) -> int:
        """Number of samples judged."""
        return sum(self.counts.values())

    @property
    def missing(self) -> int:
        """Number of missing samples, from the expected rate and the time between the first and the newest stamp."""
        if self._newest_ns is None or self.expected_rate_hz <= 0.0:
            return self._missing_before
        expected = round((self._newest_ns - self._first_ns) * self.expected_rate_hz / NS_PER_S) + 1
        return self._missing_before + max(0, expected - self._since_first)

    @property
    def used(self) -> int:
        """Number of samples used."""
        return sum(count for verdict, count in self.counts.items() if verdict.used)

    def judge(
        self,
        stamp_ns: int,
        values: Sequence[float],
        reached_ns: int | None = None,
        history: KnownStamps | None = None,
        may_reset: bool = True,
    ) -> Verdict:
        """Judge one sample, count it under its verdict, and return the verdict.

        `values` are all numbers of the sample, `reached_ns` is the stamp that the model has reached [ns], and `history`
        contains the stamps of earlier samples, among which late samples are inserted. Unless `may_reset` is true, a
        jump resets the model only if it returns to the stamps before the last jump. Without this exception, a single
        wrong stamp could exclude all correct stamps.
        """
        verdict = self._judge(stamp_ns, values, reached_ns, history)
        self._follow_late(stamp_ns, verdict)
        self.returned = verdict.resets and self._goes_on_from_before(stamp_ns)
        if verdict.resets and not (may_reset or self.returned):
            verdict = Verdict.UNSTEADY
        self.counts[verdict] += 1
        if not verdict.used:
            self._on_unused(verdict, stamp_ns, values)
            return verdict
        if self._newest_ns is None or verdict.resets:
            self._missing_before, self._first_ns, self._since_first = self.missing, stamp_ns, 0
            # after a return, the newest stamp is known to be wrong, so it is not stored as a stamp to return to
            self._before_jump_ns = None if self.returned else self._newest_ns
        self._since_first += 1
        if self._newest_ns is None or verdict.resets or stamp_ns > self._newest_ns:
            self._newest_ns, self._newest_values = stamp_ns, values
        return verdict

    def jumps(self, stamp_ns: int, reached_ns: int | None = None) -> bool:
        """Return whether `judge` would treat a stamp as a jump."""
        newest_ns = self._newest_ns if self._newest_ns is not None else reached_ns
        if newest_ns is None or not 0 < stamp_ns < _END_NS:
            return False
        return not self.near(stamp_ns, newest_ns, reached_ns)

    def near(self, stamp_ns: int, newest_ns: int, reached_ns: int | None = None) -> bool:
        """Return whether a stamp is near `newest_ns` and the time of the model, `reached_ns`."""
        ahead_ns = stamp_ns - (newest_ns if reached_ns is None else max(newest_ns, reached_ns))
        return ahead_ns <= self.jump_forward_s * NS_PER_S and newest_ns - stamp_ns <= self.jump_back_s * NS_PER_S

    def goes_on(self, stamp_ns: int, values: Sequence[float], reached_ns: int) -> bool:
        """Return whether a quick check accepts a sample; if it does not, `jumps` and `judge` decide."""
        newest_ns = self._newest_ns
        if newest_ns is None or self.limits is None:
            return False
        ahead_ns = stamp_ns - max(newest_ns, reached_ns)
        if not 0 < ahead_ns <= self.jump_forward_s * NS_PER_S:
            return False
        return self.limits.keep(self._newest_values, values, (stamp_ns - newest_ns) * 1e-9)

    def go_on(self, stamps_ns: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the result of `goes_on` for the second and each further of n samples, shape (n-1,)."""
        if self.limits is None:
            return np.zeros(len(stamps_ns) - 1, bool)
        ahead_ns = np.diff(stamps_ns)
        near = (ahead_ns > 0) & (ahead_ns <= self.jump_forward_s * NS_PER_S)
        return near & self.limits.kept(values, ahead_ns * 1e-9)

    def accept(self, stamp_ns: int, values: Sequence[float], count: int = 1) -> None:
        """Count `count` samples for which `goes_on` is True; stamp and values are of the last of these samples."""
        self.returned = False
        self._late_in_order = 0
        self.counts[Verdict.ACCEPTED] += count
        self._since_first += count
        self._newest_ns, self._newest_values = stamp_ns, values

    def refuse(self, verdict: Verdict, stamp_ns: int = 0, values: Sequence[float] = ()) -> None:
        """Count a sample that is dropped without a call of `judge`."""
        self.counts[verdict] += 1
        self._on_unused(verdict, stamp_ns, values)

    def restart(self) -> None:
        """Forget the newest stamp, so that the next sample is treated as the first sample. The counts do not change."""
        self._missing_before = self.missing
        self._newest_ns = None

    def _follow_late(self, stamp_ns: int, verdict: Verdict) -> None:
        newest_ns = self._newest_ns
        if newest_ns is None or verdict not in (Verdict.DUPLICATE, Verdict.INSERTED, Verdict.OUT_OF_ORDER):
            self._late_in_order = 0
            return
        if not self._late_in_order or stamp_ns <= self._late_ns:
            self._late_in_order, self._step_ns = 0, newest_ns - stamp_ns
        self._late_in_order += 1
        self._late_ns = stamp_ns
        if self._late_in_order == _STEP_BACK:
            self.steps_back += 1
            self.largest_step_back_ns = max(self.largest_step_back_ns, self._step_ns)

    def _judge(
        self, stamp_ns: int, values: Sequence[float], reached_ns: int | None, history: KnownStamps | None
    ) -> Verdict:
        if not all(map(math.isfinite, values)):
            return Verdict.NON_FINITE
        if not 0 < stamp_ns < _END_NS:
            return Verdict.UNSTAMPED
        if self.limits is not None and self.limits.exceeded(values):
            return Verdict.IMPLAUSIBLE
        newest_ns = self._newest_ns if self._newest_ns is not None else reached_ns
        if newest_ns is None:
            return Verdict.ACCEPTED
        if stamp_ns == self._newest_ns:
            return Verdict.DUPLICATE
        ahead_ns = stamp_ns - (newest_ns if reached_ns is None else max(newest_ns, reached_ns))
        if ahead_ns > self.jump_forward_s * NS_PER_S:
            return Verdict.JUMP_FORWARD
        if ahead_ns > 0:
            before_ns = self._newest_ns
            if self.limits is None or before_ns is None:
                return Verdict.ACCEPTED
            kept = self.limits.keep(self._newest_values, values, (stamp_ns - before_ns) * 1e-9)
            return Verdict.ACCEPTED if kept else Verdict.IMPLAUSIBLE
        # the stamp is compared with the newest stamp, because during a silence the model may have moved ahead of the
        # stamps
        if newest_ns - stamp_ns > self.jump_back_s * NS_PER_S:
            return Verdict.JUMP_BACK
        if history is not None and history.oldest_ns is not None and stamp_ns > history.oldest_ns:
            return Verdict.DUPLICATE if stamp_ns in history else Verdict.INSERTED
        return Verdict.LATE if self._newest_ns is None or stamp_ns > newest_ns else Verdict.OUT_OF_ORDER

    def _goes_on_from_before(self, stamp_ns: int) -> bool:
        before_ns = self._before_jump_ns
        return before_ns is not None and 0 < stamp_ns - before_ns <= self.jump_forward_s * NS_PER_S
