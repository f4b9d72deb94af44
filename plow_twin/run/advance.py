"""What an advance of a twin tells: at one time, at many, and of many twins at many."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError
from plow_twin.solve.state import ROW, Status


@dataclass(frozen=True)
class Advance:
    """What the head does at a time, and what happened since the advance before.

    Attributes
    ----------
    t : float
        Model time in s.
    q, v : ndarray, shape (3,)
        Pose x, y [m], theta [rad] of the cavity's centre, and its rate.
    penetration, rate, force : ndarray, shape (8,)
        Signed penetration [m], its rate [m/s] and normal force [N] of each pair at `t`.
    peak, impulse : ndarray, shape (8,)
        Largest force [N] and impulse [N s] since the advance before.
    time_in_contact : ndarray, shape (8,)
        Time in contact since the advance before [s].
    makes : ndarray of int64, shape (8,)
        Touches since the advance before.
    wear_depth : ndarray, shape (8,)
        Wear depth of each pad in m, in total.
    steps : int
        Steps the solver took.
    status : Status
        Anything but `OK` means that the state is the last good one.
    error_estimate_m : float
        Estimated error of the pose in m where `max_evaluations` did not suffice for the tolerance, else 0.
    """

    t: float
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    penetration: NDArray[np.float64]
    rate: NDArray[np.float64]
    force: NDArray[np.float64]
    peak: NDArray[np.float64]
    impulse: NDArray[np.float64]
    time_in_contact: NDArray[np.float64]
    makes: NDArray[np.int64]
    wear_depth: NDArray[np.float64]
    steps: int
    status: Status
    error_estimate_m: float


@dataclass(frozen=True)
class _Rows:
    t: NDArray[np.float64]
    q: NDArray[np.float64]
    v: NDArray[np.float64]
    penetration: NDArray[np.float64]
    rate: NDArray[np.float64]
    force: NDArray[np.float64]
    peak: NDArray[np.float64]
    impulse: NDArray[np.float64]
    time_in_contact: NDArray[np.float64]
    makes: NDArray[np.int64]
    wear_depth: NDArray[np.float64]
    steps: NDArray[np.int64]
    status: NDArray[np.int64]
    error_estimate_m: NDArray[np.float64]

    @classmethod
    def of(cls, times: NDArray[np.float64], rows: NDArray[np.void], *, own: bool = False) -> Self:
        """Return the fields of the rows that the kernels fill; they share memory.

        Parameters
        ----------
        times : ndarray, shape (n,)
            Model times in s.
        rows : ndarray of `ROW`, shape (n,), of a batch (m, n)
            What the kernels filled.
        own : bool
            Whether nobody else writes to the rows: a copy of one, field by field, takes as long as two advances.
        """
        made = cls.__new__(cls)
        made.__dict__.update(t=times, _rows=rows, _own=own)
        return made

    def __getattr__(self, name: str) -> NDArray[Any]:
        # fields of `of` are taken out of the rows when they are asked for: all of them take longer than one advance
        if name not in _ROW_NAMES:
            raise AttributeError(name)
        found: NDArray[Any] = self.__dict__["_rows"][_ROW_NAMES[name]]
        self.__dict__[name] = found
        return found


@dataclass(frozen=True)
class AdvanceSeries(_Rows):
    """Many advances at once: the fields of `Advance`, each with a leading axis of length n."""

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, index: int) -> Advance:
        rows = self.__dict__.get("_rows")
        if rows is None:
            row = tuple(getattr(self, name)[index] for name in _ROW_NAMES)
        else:
            # a copy: it does not keep all the rows, nor change with their memory
            row = (rows[index] if self.__dict__["_own"] else rows[index].copy()).item()
        made = Advance.__new__(Advance)  # all at once: a frozen class sets its fields one by one
        made.__dict__.update(zip(_ROW_NAMES, row, strict=True), t=float(self.t[index]))
        made.__dict__.update(steps=int(made.steps), status=_STATUS[made.status])
        made.__dict__["error_estimate_m"] = float(made.error_estimate_m)
        return made


@dataclass(frozen=True)
class AdvanceBatch(_Rows):
    """Advances of m twins: the fields of `AdvanceSeries`, each but `t` with a leading axis of length m."""

    def __len__(self) -> int:
        return len(self.status)

    def __getitem__(self, member: int) -> AdvanceSeries:
        return AdvanceSeries(self.t, *(getattr(self, field.name)[member] for field in fields(_Rows)[1:]))


#: Names in the rows of the kernels, by field.
_ROW_NAMES: Final = dict(zip((field.name for field in fields(_Rows)[1:]), ROW.names or (), strict=True))
_STATUS: Final = {int(status): status for status in Status}


def check_times(now: float, times: NDArray[np.float64]) -> None:
    """Raise `ArgumentError` for times that are not finite or go back."""
    if times.shape == (1,) and now <= times[0] < math.inf:
        return  # one after the other, as a live twin asks
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ArgumentError(f"t: got {times!r}, expected finite times in s, shape (n,)")
    if len(times) and (times[0] < now or (times[1:] < times[:-1]).any()):
        before = np.concatenate([[now], times[:-1]])
        index = int(np.flatnonzero(times < before)[0])
        raise ArgumentError(f"t: got {times[index]!r} s, expected a time not before {before[index]!r} s")
