"""Reports of `plow-twin live`: lines for a person, or JSON lines for a program."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable

import click

from plow_twin.cli.console import say_error

_LEVELS = ("OK", "WARN", "ERROR")

#: Level, message and values of a status, the alarms or a part of the diagnostics.
Part = tuple[int, str, dict[str, str]]


class Report:
    """Says status and alarms when they change, and with `lines` all parts as JSON lines.

    An alarm is reported when it is raised and when it is acknowledged, not each time its quantity passes a threshold.

    Parameters
    ----------
    lines, quiet : bool
        JSON lines on standard output; no text for a person.
    stamp_ns
        Returns the stamp that the twin has reached [ns].
    """

    def __init__(self, *, lines: bool, quiet: bool, stamp_ns: Callable[[], int]) -> None:
        self._lines, self._quiet, self._stamp_ns = lines, quiet, stamp_ns
        self._alarms: list[str] = []
        #: lines that standard output did not take
        self.lost = 0

    def say(self, name: str, part: Part) -> None:
        """Say a part."""
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
            self.lost += not _printed(json.dumps(said))
        elif name in ("status", "alarms") and not self._quiet:
            say_error(f"{_LEVELS[level]} {name}: {message}")


def _typed(value: str) -> int | float | str:
    """Return a number as a number."""
    for kind in (int, float):
        try:
            found = kind(value)
        except ValueError:
            continue
        return found if math.isfinite(found) else value
    return value


def _printed(line: str) -> bool:
    """Print a line; return False where standard output fails, as on a full disk: the twin goes on."""
    try:
        click.echo(line)
        sys.stdout.flush()
    except BrokenPipeError:  # no reader any more
        raise
    except OSError:
        return False
    return True
