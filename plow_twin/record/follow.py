"""Read a recording that is still being written: check whether the writer still runs, and wait for new content.

A writer locks its file. When the process ends, even by a crash, the operating system releases the lock.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import IO, Final

#: Interval at which a waiting reader checks the file for new content [s].
POLL_S: Final = 0.1


def claim(descriptor: int) -> None:
    """Lock a file until it is closed, as a sign that it is being written.

    On a file system without locks, the function does nothing.
    """
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return


def is_claimed(descriptor: int) -> bool:
    """Return whether another process has locked a file by `claim` and is still writing to it."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return False


class Tail:
    """Wait at the end of a growing file, until the file grows or `stop` returns True."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        self.stopped = False

    def more(self, stream: IO[bytes], size: int) -> bool:
        """Wait until a file is longer than `size` [B].

        Returns False if the writer ends or `stop` returns True before the file grows.
        """
        while True:
            # checking the size first would miss bytes that the writer adds between the two checks, just before it ends
            alive = is_claimed(stream.fileno())
            if os.fstat(stream.fileno()).st_size > size:
                return True
            self.stopped = self._stop()
            if self.stopped or not alive:
                return False
            time.sleep(POLL_S)
