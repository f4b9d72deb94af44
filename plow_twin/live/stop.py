"""SIGINT, SIGTERM and SIGHUP as a clean stop."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Self


class StopRequested(BaseException):
    """The process was asked to stop while it could not check a flag."""


def stop_signals() -> list[signal.Signals]:
    """Return the signals that ask for a stop; SIGHUP, which a closing terminal sends, unless it is ignored."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]


class StopSignals:
    """Context manager in which stop signals set a flag, or raise `StopRequested` while `interrupt` is set."""

    def __init__(self) -> None:
        self.stopped = False
        self.interrupt = True
        self._before = {number: signal.signal(number, self._handle) for number in stop_signals()}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def ignore(self) -> None:
        """Ignore the signals at the end of a program.

        The interpreter restores their default handlers while it ends, and a second signal, sent by terminal and launch
        alike, would turn success into an error.
        """
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        if self.interrupt:
            self.interrupt = False
            raise StopRequested
