"""Print the reports of `plow-twin live` as text, or as JSON lines for a program."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from contextlib import suppress

import click

from plow_twin.cli.console import say_error
from plow_twin.cli.outlet import Outlet
from plow_twin.live.part import Part

_LEVELS = ("OK", "WARN", "ERROR")


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
            said = {"topic": name, "stamp_ns": self._stamp_ns(), "level": level, "message": message, "values": typed}
            self._out.put(json.dumps(said))
        elif name in ("status", "alarms") and not self._quiet:
            self._errors.put(f"{_LEVELS[level]} {name}: {message}")


def _typed(value: str) -> int | float | str:
    for kind in (int, float):
        try:
            found = kind(value)
        except ValueError:
            continue
        return found if math.isfinite(found) else value
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
