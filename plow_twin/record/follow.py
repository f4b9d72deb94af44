"""A recording that is still being written: whether its writer lives, how to wait for more of it.

A writer holds a lock on its file, which the operating system gives back when the process ends, however it ends.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import IO, Final

#: A waiting reader looks that often [s].
POLL_S: Final = 0.1


def claim(descriptor: int) -> None:
    """Mark a file as being written until it is closed; where the file system has no locks, nothing is marked."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return


def is_claimed(descriptor: int) -> bool:
    """Tell whether somebody writes to a file."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return False


class Tail:
    """How a reader goes on at the end of what has been written.

    Parameters
    ----------
    stop
        Asked while it waits: True ends the reading.
    """

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        #: whether reading was ended by `stop`
        self.stopped = False

    def more(self, stream: IO[bytes], size: int) -> bool:
        """Wait until a file is longer than `size` [B]; False when it will not be."""
        while True:
            alive = is_claimed(stream.fileno())  # before the size: what a writer leaves behind is read
            if os.fstat(stream.fileno()).st_size > size:
                return True
            self.stopped = self._stop()
            if self.stopped or not alive:
                return False
            time.sleep(POLL_S)
