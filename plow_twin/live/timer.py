"""A call repeated at intervals of a steady clock."""

from __future__ import annotations

import time
from collections.abc import Callable


class Timer:
    """Calls `do` every `period_s`; missed calls are left out, and later calls keep their phase.

    `do` may return the time [s] before which it need not be called.
    """

    def __init__(self, period_s: float, do: Callable[[], float | None]) -> None:
        self._period_s, self._do = period_s, do
        self.restart()

    def restart(self) -> None:
        """Make the next call due after one period."""
        self.due = time.monotonic() + self._period_s

    def look(self) -> None:
        """Call `do` when it is due."""
        now = time.monotonic()
        if now >= self.due:
            self.due += self._period_s * (1 + (now - self.due) // self._period_s)
            idle_s = self._do()
            if idle_s:
                self.due += self._period_s * (idle_s // self._period_s)
