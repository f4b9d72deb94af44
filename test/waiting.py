"""Waiting until other threads and processes have reached a state."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Longest wait [s]: long enough for a compilation on a machine that does other work. No result depends on it.
LONGEST_S = 200.0


def until(reached: Callable[[], object], event: object = "", pause_s: float = 0.01) -> None:
    """Call `reached` until it returns a true value."""
    give_up = time.monotonic() + LONGEST_S
    while not reached():
        assert time.monotonic() < give_up, event
        time.sleep(pause_s)
