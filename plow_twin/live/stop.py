"""SIGINT, SIGTERM and SIGHUP as a clean stop."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Self


class StopRequested(BaseException):
    """The process was asked to stop while it could not check a flag, as during a long start."""


def stop_signals() -> list[signal.Signals]:
    """Return the signals that ask for a stop: SIGHUP, when the terminal closes, unless it is ignored, as by `nohup`."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]


class StopSignals:
    """SIGINT, SIGTERM and SIGHUP set a flag, or raise `StopRequested` while `interrupt` is set (a long start).

    It is a context manager, which restores the signals' handlers on exit.
    """

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
        """Ignore the signals, at the end of a program.

        The interpreter restores their default handlers while it ends. A second signal, as when terminal and launch both
        send one, would then end the process with an error after its work is done.
        """
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        if self.interrupt:
            self.interrupt = False
            raise StopRequested
