"""Calls of kernels in slices of work, between which limits and Ctrl-C are handled."""

from __future__ import annotations

import time as _time
from collections.abc import Callable
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError, LimitError, RunInterrupted
from plow_twin.solve.state import PACE, first_of, new_records

#: Default wall-clock time in s after which a call ends with an error.
MOST_SECONDS: Final = 3600.0
#: Number of steps in a slice without and with implicit steps. An implicit step takes up to a millisecond.
_SLICE, _SLICE_IMPLICIT = 2048, 64


class OutOfTimeError(Exception):
    """The wall-clock time of a call has expired, or the call was stopped."""


def raise_stopped(stop: BaseException, max_wall_s: float, progress: str, result: Any, time_s: float) -> NoReturn:
    """Raise the error of a call that `OutOfTimeError` or Ctrl-C has stopped, with the result up to the stop."""
    if isinstance(stop, OutOfTimeError):
        raise LimitError(f"max_wall_s = {max_wall_s:g} reached {progress}", result, time_s) from None
    raise RunInterrupted(f"interrupted {progress}", result, time_s) from None


def clear_sums(totals: NDArray[np.void]) -> None:
    """Set the sums since the previous advance to zero."""
    for name in ("peak", "impulse", "time_in_contact", "makes"):
        totals[name] = 0


class Pace:
    """Runs kernels in slices within the time limit of a call.

    Parameters
    ----------
    state_type : dtype
        Type of the state. The attribute `saved` contains the state at the beginning of the current advance.
    implicit : bool
        Whether the scene may need implicit steps.
    max_wall_s : float
        Largest wall-clock time in s of a call.
    """

    def __init__(self, state_type: np.dtype[np.void], implicit: bool, max_wall_s: float) -> None:
        self._records = new_records(PACE, 1)
        self.record = first_of(self._records)
        #: the record as an argument of kernels, which numba reads faster than `record`
        self.argument = self._records[0]
        #: number of failed advances in the last call, shape (1,), as a view of the record
        self.failed = self._records["failed"]
        self.record.slice = _SLICE_IMPLICIT if implicit else _SLICE
        # numpy copies bytes five times as fast as a record
        self._bytes = self._records.view(np.uint8).data
        self._start = self._bytes.tobytes()
        self.saved = new_records(state_type, 1)
        self.max_wall_s = max_wall_s
        self.stopped = False

    def run(self, work: Callable[..., bool], arguments: tuple[Any, ...] = ()) -> None:
        """Call `work` repeatedly until it returns True. Each call is a slice of the work.

        Raise `OutOfTimeError` if the time limit was reached, or `stopped` was set during the call. `record` contains
        the progress.
        """
        self._bytes[:] = self._start
        begin = _time.perf_counter()
        while not work(*arguments):
            if self.stopped or _time.perf_counter() - begin >= self.max_wall_s:
                raise OutOfTimeError


def check_limits(max_steps: int, max_wall_s: float) -> None:
    """Raise `ArgumentError` if a limit is not valid."""
    # for a float, numba would compile the kernels again
    if isinstance(max_steps, bool) or not isinstance(max_steps, (int, np.integer)) or not max_steps >= 1:
        raise ArgumentError(f"max_steps: got {max_steps!r}, expected an integer >= 1")
    if not max_wall_s > 0.0:
        raise ArgumentError(f"max_wall_s: got {max_wall_s!r}, expected a time > 0 [s]")
