"""Call a function periodically."""

from __future__ import annotations

import time
from collections.abc import Callable


class Timer:
    """Timer that calls the function `do` every `period_s` seconds of the monotonic clock.

    Missed calls are omitted, so that calls stay at multiples of the period. `do` may return a time [s] for which it
    need not be called.
    """

    def __init__(self, period_s: float, do: Callable[[], float | None]) -> None:
        self._period_s, self._do = period_s, do
        self.restart()

    def restart(self) -> None:
        """Schedule the next call after one period."""
        self.due = time.monotonic() + self._period_s

    def look(self) -> None:
        """Call `do` if the call is due."""
        now = time.monotonic()
        if now >= self.due:
            self.due += self._period_s * (1 + (now - self.due) // self._period_s)
            idle_s = self._do()
            if idle_s:
                self.due += self._period_s * (idle_s // self._period_s)
