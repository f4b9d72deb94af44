"""Reading of a recording that is still being written: check whether its writer runs, wait for new content.

A writer locks its file; the operating system releases the lock however the process ends.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import IO, Final

#: Interval at which a waiting reader checks the file for new content [s].
POLL_S: Final = 0.1


def claim(descriptor: int) -> None:
    """Lock a file as being written until it is closed; do nothing on a file system without locks."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return


def is_claimed(descriptor: int) -> bool:
    """Return whether another process still writes to a file, which it has locked by `claim`."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return False


class Tail:
    """The wait of a reader at the end of a growing file. It calls `stop` meanwhile; True ends the reading."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        self.stopped = False

    def more(self, stream: IO[bytes], size: int) -> bool:
        """Wait until a file is longer than `size` [B]; return False if its writer ends or `stop` is true."""
        while True:
            # the lock is checked before the size, so that bytes are read that a writer adds just before it ends
            alive = is_claimed(stream.fileno())
            if os.fstat(stream.fileno()).st_size > size:
                return True
            self.stopped = self._stop()
            if self.stopped or not alive:
                return False
            time.sleep(POLL_S)
