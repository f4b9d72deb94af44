"""Stop a program cleanly at the signals SIGINT, SIGTERM and SIGHUP."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Self


class StopRequested(BaseException):
    """A stop signal arrived while the program could not check a flag."""


def stop_signals() -> list[signal.Signals]:
    """Return the signals that request a stop. SIGHUP, which a closing terminal sends, is omitted if it is ignored."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]


class StopSignals:
    """Context manager in which a stop signal sets the flag `stopped`.

    While the attribute `interrupt` is true, the signal raises `StopRequested` in addition.
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
        """Ignore further stop signals at the end of a program.

        If a program is started by `ros2 launch`, the terminal and `ros2 launch` may both send a signal. The interpreter
        restores the default handlers when it ends, so that the second signal would change the exit code.
        """
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        if self.interrupt:
            self.interrupt = False
            raise StopRequested
