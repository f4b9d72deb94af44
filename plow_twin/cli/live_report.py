"""Print the reports of `plow-twin live` as text, or as JSON lines for a program."""

from __future__ import annotations

import json
import math
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import click

from plow_twin.cli.console import say_error

if TYPE_CHECKING:
    from plow_twin.live.part import Part

#: Largest number of lines in the queue. If there are more lines, the oldest lines are dropped.
MOST_WAITING: Final = 1000
#: Longest time at the end without progress of the reader [s].
_PATIENCE_S: Final = 2.0
_LEVELS: Final = ("OK", "WARN", "ERROR")


class Report:
    """Printer of reports.

    Status and alarms are printed as text when they change, unless `quiet` is true. With `lines`, all parts are printed
    as JSON lines. If the reader is slow, lines are dropped and counted, so that the twin is not delayed.
    """

    def __init__(self, *, lines: bool, quiet: bool, stamp_ns: Callable[[], int]) -> None:
        self._lines, self._quiet, self._stamp_ns = lines, quiet, stamp_ns
        self._alarms: list[str] = []
        self._out = Outlet(_printed, lambda: self.error("standard output is not read, so lines are lost"))
        self._errors = Outlet(_said)

    def __enter__(self) -> Report:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # if there is no error, the caller has closed the two outputs
            with suppress(BrokenPipeError):
                self.close_lines()
            self.close()

    @property
    def lost(self) -> int:
        """Number of JSON lines that could not be written."""
        return self._out.lost

    def error(self, text: str) -> None:
        """Report an error. The method may be called from any thread."""
        self._errors.put(f"plow-twin: {text}")

    def close_lines(self) -> bool:
        """Write the last JSON lines; return False if the reader does not read all lines."""
        return self._out.close()

    def close(self) -> bool:
        """Write the last lines of text; return False if the reader does not read all lines."""
        return self._errors.close()

    def say(self, name: str, part: Part) -> None:
        """Report `status`, `alarms`, or a part of the diagnostics."""
        level, message, values = part
        if name == "alarms":
            from plow_twin.record.alarms import alarm_texts

            texts = alarm_texts(values, own_start=True)
            if texts == self._alarms:
                return
            new = [text for text in texts if text not in self._alarms]
            self._alarms, message = texts, "; ".join(new or texts) or "none"
        if self._lines:
            typed = {key: _typed(value) for key, value in values.items()}
            message_facts = {
                "topic": name,
                "stamp_ns": self._stamp_ns(),
                "level": level,
                "message": message,
                "values": typed,
            }
            self._out.put(json.dumps(message_facts))
        elif name in ("status", "alarms") and not self._quiet:
            self._errors.put(f"{_LEVELS[level]} {name}: {message}")


def _typed(value: str) -> int | float | str:
    for kind in (int, float):
        try:
            message = kind(value)
        except ValueError:
            continue
        return message if math.isfinite(message) else value
    return value


def _printed(line: str) -> bool:
    """Print a line; return False if standard output fails, for example on a full disk."""
    try:
        click.echo(line)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has ended
        raise
    except OSError:
        return False
    return True


def _said(line: str) -> bool:
    say_error(line)
    return True


class Outlet:
    """Queue of lines that a separate thread writes in order, so that no caller waits for a slow reader.

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

        Raise `BrokenPipeError` if the reader has ended.
        """
        with self._news:
            self._closed = True
            self._news.notify()
        while self._thread is not None and self._thread.is_alive():
            waiting = len(self._waiting)
            self._thread.join(_PATIENCE_S)
            if self._thread.is_alive() and len(self._waiting) == waiting:
                self.lost += waiting + 1  # the lines in the queue, and the line that is being written
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
                written = self._write(line)
            except BrokenPipeError:
                self._broken = True
                return
            with self._news:
                self.lost += not written
