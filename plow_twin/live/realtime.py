"""Set the processors and the memory lock of this process, and the priority of a thread."""

from __future__ import annotations

import ctypes
import os
from typing import Final

from plow_twin.live.parameters import Settings

#: Flags of `mlockall` that lock the existing pages and the future pages of memory.
_MCL_CURRENT: Final = 1
_MCL_FUTURE: Final = 2


def raise_priority(settings: Settings) -> list[str]:
    """Request the real-time priority for the calling thread, and return a text if it is refused.

    Threads and processes that the thread starts later have the normal priority.
    """
    if settings.priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(settings.priority))
        except OSError as error:
            hint = "allow it by ulimit -r or LimitRTPRIO="
            return [f"priority {settings.priority}: {error.strerror}; {hint}"]
    return []


def apply_realtime(settings: Settings) -> list[str]:
    """Request the processors and the memory lock, and return a text for each refused setting."""
    refused = []
    if settings.cpu_affinity:
        try:
            os.sched_setaffinity(0, {int(number) for number in settings.cpu_affinity.split(",")})
        except (OSError, ValueError) as error:
            available = ",".join(map(str, sorted(os.sched_getaffinity(0))))
            refused.append(f"cpu_affinity {settings.cpu_affinity!r}: {error}; expected numbers among {available}")
    if settings.lock_memory:
        library = ctypes.CDLL(None, use_errno=True)
        if library.mlockall(_MCL_CURRENT | _MCL_FUTURE):
            reason = os.strerror(ctypes.get_errno())
            refused.append(f"lock_memory: {reason}; allow it by ulimit -l or LimitMEMLOCK=")
    return refused
