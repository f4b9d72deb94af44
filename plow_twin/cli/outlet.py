"""Write lines to a reader that may be slow, without waiting for the reader."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

#: Largest number of lines in the queue. If there are more lines, the oldest lines are dropped.
MOST_WAITING: Final = 1000
#: Longest wait at the end for a reader that does not read a line [s].
_PATIENCE_S: Final = 2.0


class Outlet:
    """Queue of lines that a separate thread writes in order.

    `write` writes a line and returns whether it succeeded. `on_loss` is called when the first line is dropped.
    """

    def __init__(self, write: Callable[[str], bool], on_loss: Callable[[], object] = lambda: None) -> None:
        self._write, self._on_loss = write, on_loss
        self._waiting: deque[str] = deque()
        self._news = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = self._broken = False
        #: number of lines that were dropped or could not be written
        self.lost = 0

    def put(self, line: str) -> None:
        """Add a line to the queue; raise `BrokenPipeError` if the reader has ended."""
        if self._broken:
            raise BrokenPipeError
        with self._news:
            first = len(self._waiting) == MOST_WAITING and not self.lost
            if len(self._waiting) == MOST_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(line)
            self._news.notify()
        if first:
            self._on_loss()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="outlet", daemon=True)
            self._thread.start()

    def close(self) -> bool:
        """Wait until all lines are written; return False if the reader does not read all lines.

        Raises
        ------
        BrokenPipeError
            The reader has ended.
        """
        with self._news:
            self._closed = True
            self._news.notify()
        while self._thread is not None and self._thread.is_alive():
            left = len(self._waiting)
            self._thread.join(_PATIENCE_S)
            if self._thread.is_alive() and len(self._waiting) == left:
                self.lost += left + 1  # the lines in the queue, and the line that is being written
                return False
        if self._broken:
            raise BrokenPipeError
        return True

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                line = self._waiting.popleft()
            try:
                taken = self._write(line)
            except BrokenPipeError:
                self._broken = True
                return
            with self._news:
                self.lost += not taken
