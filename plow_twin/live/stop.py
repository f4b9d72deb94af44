"""SIGINT and SIGTERM as a clean stop."""

from __future__ import annotations

import signal
from types import FrameType


class StopRequested(BaseException):
    """The process was asked to stop while it could not look at a flag."""


class StopSignals:
    """SIGINT and SIGTERM as a flag; while `interrupt` is set (a long start), as `StopRequested`."""

    def __init__(self) -> None:
        self.stopped = False
        self.interrupt = True
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        if self.interrupt:
            self.interrupt = False
            raise StopRequested
