"""Distinction between a step of the sender's clock and a *stray* stamp, which is a single wrong stamp."""

from __future__ import annotations

from collections import deque
from typing import Final

from plow_twin.stream.intake import NS_PER_S, Intake, Verdict

#: Number of stray stamps within `_WINDOW_NS` that makes the clock of the samples unsteady.
_MOST_STRAYS: Final = 5
_WINDOW_NS: Final = 10 * NS_PER_S

#: Stamp [ns], wrench (Fx, Fy [N], M [N m]) and time of arrival [ns] of a sample.
Timed = tuple[int, tuple[float, float, float], int]


class Steps:
    """Delay a sample with a jump of the stamp until the next sample confirms the jump."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        #: sample that is being delayed
        self.delayed: Timed | None = None
        #: times of the latest stray stamps [ns]
        self._strays_ns: deque[int] = deque(maxlen=_MOST_STRAYS)

    def settle(
        self, stamp_ns: int, wrench: tuple[float, float, float], now_ns: int, reached_ns: int | None
    ) -> tuple[Timed, ...]:
        """Add a sample; return the samples that the intake can judge now, in order of arrival."""
        jumped, jumps = self.delayed, self._intake.jumps(stamp_ns, reached_ns)
        arrival = stamp_ns, wrench, now_ns
        if jumped is not None and stamp_ns > 0:  # a sample without a stamp gives no evidence about the clock
            if stamp_ns == jumped[0]:
                self._intake.refuse(Verdict.DUPLICATE, stamp_ns, wrench)
                return ()
            self.delayed = None
            if jumps and self._intake.near(stamp_ns, jumped[0]):
                return jumped, arrival
            self._intake.refuse(Verdict.STRAY, *jumped[:2])
            self._strays_ns.append(now_ns)
        if not jumps:
            return (arrival,)
        self.delayed = arrival
        return ()

    def unopposed(self, now_ns: int, silence_ns: int) -> Timed | None:
        """Return the delayed sample and end its delay if no further sample has arrived for `silence_ns`."""
        jumped = self.delayed
        if jumped is None or now_ns - jumped[2] <= silence_ns:
            return None
        self.delayed = None
        return jumped

    def end(self) -> None:
        """Count a delayed sample as stray, because no further sample will come."""
        jumped, self.delayed = self.delayed, None
        if jumped is not None:
            self._intake.refuse(Verdict.STRAY, *jumped[:2])

    def unsteady(self, now_ns: int) -> bool:
        """Return whether `_MOST_STRAYS` recent stamps were stray."""
        strays_ns = self._strays_ns
        if len(strays_ns) < _MOST_STRAYS or now_ns - strays_ns[-1] >= _WINDOW_NS:
            return False
        return strays_ns[-1] - strays_ns[0] < _WINDOW_NS
