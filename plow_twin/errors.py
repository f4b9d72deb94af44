"""Exceptions of the package. A message names the cause, the value that was found and the expected value."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final


class PlowTwinError(Exception):
    """Base class of every error that the package raises on purpose."""


#: Longest text of a value that a message contains [characters]. Longer texts are cut.
_LONGEST_SHOWN: Final = 500
#: Largest number of problems that a message lists.
_MOST_SHOWN: Final = 50


#: Unicode categories of characters that control a terminal or change the writing direction.
_ACTING: Final = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def printable(text: str) -> str:
    """Return a text that is safe for a terminal. Control characters are escaped, except tabs and line ends."""
    if text.isprintable():
        return text
    return "".join(
        sign if sign in "\n\t" or unicodedata.category(sign) not in _ACTING else sign.encode("unicode_escape").decode()
        for sign in text
    )


@dataclass(frozen=True)
class Problem:
    """One problem of an input.

    Attributes
    ----------
    key : str
        Place of the problem: the path of a number, the name of a file, or a row.
    got : object
        The invalid value.
    expected : str
        Description of the expected value.
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
    """A file or value from a user is not valid. The message lists the first 50 problems.

    Attributes
    ----------
    problems : tuple of Problem
        All problems.
    source : str
        Name of the file or other input that contains the problems.
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
    """A scene is not valid."""

    def __init__(self, problems: Iterable[Problem], source: str = "scene") -> None:
        super().__init__(problems, source)


class ArgumentError(PlowTwinError, ValueError):
    """An argument of a call is not valid. The message contains the argument's name, value and expected value."""


class SolverError(PlowTwinError, RuntimeError):
    """The solver cannot continue the motion. The message states the time and the reason."""


class _StoppedError(PlowTwinError):
    """A run was stopped before its end."""

    def __init__(self, message: str, result: Any, time_s: float) -> None:
        super().__init__(message)
        self.result = result
        self.time_s = time_s


class LimitError(_StoppedError, SolverError):
    """A run has reached a limit that its caller set.

    Attributes
    ----------
    result : Result
        The motion up to `time_s`.
    time_s : float
        Model time in s at which the run stopped.
    """


class RunInterrupted(_StoppedError, KeyboardInterrupt):
    """The user interrupted a run.

    Attributes
    ----------
    result : Result
        The motion up to `time_s`.
    time_s : float
        Model time in s at which the run stopped.
    """


class ToleranceWarning(UserWarning):
    """The motion amplifies errors so much that its error may exceed the requested tolerance."""


class RecordingError(PlowTwinError, ValueError):
    """A recording cannot be written or read. The message names the file and the record."""


class ExcessError(RecordingError):
    """A file exceeds a bound on size, nesting depth or number of columns. The message names the bound."""


class UnitError(RecordingError):
    """A unit is unknown, or values suggest a unit that was not stated. The message shows how to state the unit."""


class TakenError(RecordingError):
    """A recording cannot be written because a recording already exists under the same path."""


class ForeignRecordingError(RecordingError):
    """A recording was not written by plow_twin."""
