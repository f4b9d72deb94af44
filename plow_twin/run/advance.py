"""What an advance of a twin tells: at one time, at many, and of many twins at many."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final, Self

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
    makes: NDArray[np.int64]
    wear_depth: NDArray[np.float64]
    steps: NDArray[np.int64]
    status: NDArray[np.int64]
    error_estimate_m: NDArray[np.float64]

    @classmethod
    def of(cls, times: NDArray[np.float64], rows: NDArray[np.void]) -> Self:
        """Return the fields of the rows that the kernels fill; they share memory.

        Parameters
        ----------
        times : ndarray, shape (n,)
            Model times in s.
        rows : ndarray of `ROW`, shape (n,), of a batch (m, n)
            What the kernels filled.
        """
        return cls(times, *(rows[name] for name in _NAMES))


@dataclass(frozen=True)
class AdvanceSeries(_Rows):
    """Many advances at once: the fields of `Advance`, each with a leading axis of length n."""

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, index: int) -> Advance:
        arrays = {name: getattr(self, name)[index] for name in _ARRAYS}
        return Advance(
            t=float(self.t[index]),
            steps=int(self.steps[index]),
            status=Status(int(self.status[index])),
            error_estimate_m=float(self.error_estimate_m[index]),
            **arrays,
        )


@dataclass(frozen=True)
class AdvanceBatch(_Rows):
    """Advances of m twins: the fields of `AdvanceSeries`, each but `t` with a leading axis of length m."""

    def __len__(self) -> int:
        return len(self.status)

    def __getitem__(self, member: int) -> AdvanceSeries:
        return AdvanceSeries(self.t, *(getattr(self, field.name)[member] for field in fields(_Rows)[1:]))


_NAMES: Final = ROW.names or ()
#: Fields of a row that are arrays.
_ARRAYS: Final = _NAMES[: _NAMES.index("steps")]


def check_times(now: float, times: NDArray[np.float64]) -> None:
    """Raise `ValueError` for times that are not finite or go back."""
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ArgumentError(f"t: got {times!r}, expected finite times in s, shape (n,)")
    if len(times) and (times[0] < now or (times[1:] < times[:-1]).any()):
        before = np.concatenate([[now], times[:-1]])
        index = int(np.flatnonzero(times < before)[0])
        raise ArgumentError(f"t: got {times[index]!r} s, expected a time not before {before[index]!r} s")
