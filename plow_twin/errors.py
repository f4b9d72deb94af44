"""Exceptions of the package, with one base class; a message names the thing, the value got and the value expected."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final


class PlowTwinError(Exception):
    """Base of every error that the package raises on purpose."""


#: Longest value that a message shows in full [characters].
_LONGEST_SHOWN: Final = 500
#: Largest number of problems that a message lists.
_MOST_SHOWN: Final = 50


#: Unicode categories of the characters that control a terminal or change the writing direction.
_ACTING: Final = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def printable(text: str) -> str:
    """Return a text that is safe for a terminal: control characters are escaped, line ends are kept."""
    if text.isprintable():
        return text
    return "".join(
        sign if sign in "\n\t" or unicodedata.category(sign) not in _ACTING else sign.encode("unicode_escape").decode()
        for sign in text
    )


@dataclass(frozen=True)
class Problem:
    """One thing wrong with an input.

    Attributes
    ----------
    key : str
        Where the problem is: the path of a number, a file or a row.
    got : object
        The value found there.
    expected : str
        The expected value, in words.
    """

    key: str
    got: object
    expected: str

    def __str__(self) -> str:
        got = repr(self.got)
        if len(got) > _LONGEST_SHOWN:
            got = f"{got[:_LONGEST_SHOWN]}... ({len(got)} characters)"
        return f"{self.key}: got {got}, expected {self.expected}"


class InputError(PlowTwinError, ValueError):
    """A file or values that a user wrote cannot be used; the message lists the first 50 problems.

    Attributes
    ----------
    problems : tuple of Problem
        All problems.
    source : str
        Name of the file or other input.
    """

    def __init__(self, problems: Iterable[Problem], source: str) -> None:
        self.problems = tuple(problems)
        self.source = source
        lines = [f"  {problem}" for problem in self.problems[:_MOST_SHOWN]]
        if len(self.problems) > _MOST_SHOWN:
            lines.append(f"  and {len(self.problems) - _MOST_SHOWN} more")
        text = lines[0].strip() if len(lines) == 1 else "\n".join([f"{len(self.problems)} problems", *lines])
        super().__init__(f"{source}: {text}")


class SceneError(InputError):
    """A scene cannot be used."""

    def __init__(self, problems: Iterable[Problem], source: str = "scene") -> None:
        super().__init__(problems, source)


class ArgumentError(PlowTwinError, ValueError):
    """An argument of a call cannot be used; the message names it, the value got and the value expected."""


class SolverError(PlowTwinError, RuntimeError):
    """The motion could not be continued; the message says when and why."""


class _StoppedError(PlowTwinError):
    """A run was stopped before its end."""

    def __init__(self, message: str, result: Any, time_s: float) -> None:
        super().__init__(message)
        self.result = result
        self.time_s = time_s


class LimitError(_StoppedError, SolverError):
    """A run has reached a limit that its caller set; `result` is the motion up to `time_s`.

    Attributes
    ----------
    result : Result
        The motion so far.
    time_s : float
        Model time reached in s.
    """


class RunInterrupted(_StoppedError, KeyboardInterrupt):
    """A run was interrupted by the user; `result` is the motion up to `time_s`.

    Attributes
    ----------
    result : Result
        The motion so far.
    time_s : float
        Model time reached in s.
    """


class ToleranceWarning(UserWarning):
    """A motion amplifies errors so much that the requested tolerance does not hold."""


class RecordingError(PlowTwinError, ValueError):
    """A recording cannot be written or read; the message names the file and the record."""


class ExcessError(RecordingError):
    """A file is larger, deeper or wider than the bounds; the message names the bound."""


class UnitError(RecordingError):
    """A unit is unknown, or numbers look as if they had another unit; the message says how to state the unit."""


class TakenError(RecordingError):
    """A recording cannot be written, because another recording exists at the same place."""


class ForeignRecordingError(RecordingError):
    """A recording is not a run of plow_twin, but perhaps of another program."""
