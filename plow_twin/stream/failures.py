"""Count and journal failed advances, and decide when the motion restarts after failures."""

from __future__ import annotations

from collections.abc import Callable

from plow_twin.stream.journal import Failed


class Failures:
    """Failed advances of a run.

    A *stretch* consists of consecutive failures. `emit` receives a `Failed` entry for the first failure of a stretch,
    and an entry for all others at the end of the stretch.
    """

    def __init__(self, emit: Callable[[Failed], object]) -> None:
        self._emit = emit
        #: number of failed advances, and number of stretches
        self.count = self.stretches = 0
        self.reason = ""
        #: stamps of the first and the last failed advance of the newest stretch [ns]
        self.since_ns = self.until_ns = 0
        #: whether the motion has restarted since the newest stretch began
        self.restarts = False
        self._in_a_row = 0
        #: length [ns] of the stretch that led to the newest restart
        self._before_ns = 0
        self._restarted_ns: int | None = None

    @property
    def lasts(self) -> bool:
        """Whether the newest advance failed."""
        return self._in_a_row > 0

    def add(self, stamp_ns: int, reason: str) -> None:
        """Count a failed advance."""
        self.count += 1
        self._in_a_row += 1
        self.reason, self.until_ns = reason, stamp_ns
        if self._in_a_row == 1:
            self.stretches += 1
            self.since_ns, self.restarts = stamp_ns, False
            self._emit(Failed(stamp_ns, stamp_ns, 1, reason))

    def end(self) -> None:
        """End the present stretch, if any, because an advance has succeeded or the motion restarts."""
        if self._in_a_row > 1:
            self._emit(Failed(self.until_ns, self.since_ns, self._in_a_row - 1, self.reason))
        self._in_a_row = 0

    def wants_restart(self, limit: int) -> bool:
        """Return whether the model should restart. If `limit` is 0, the model never restarts.

        The first restart comes after `limit` consecutive failed advances. If the model fails soon after a restart, the
        next restart waits until the new stretch is twice as long as the previous stretch. The number of restarts
        therefore grows only with the logarithm of time.
        """
        if not 0 < limit <= self._in_a_row:
            return False
        at_once = self._restarted_ns is not None and self.since_ns - self._restarted_ns < self._before_ns
        return self.until_ns - self.since_ns >= (2 * self._before_ns if at_once else 0)

    def restarted(self) -> str:
        """Record that the model restarts; return the reason as text."""
        self.restarts = True
        self._before_ns, self._restarted_ns = self.until_ns - self.since_ns, self.until_ns
        return f"{self._in_a_row} failed advances: {self.reason}"
