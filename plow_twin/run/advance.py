"""Results of advances for one time, for many times or for many twins, as views of the kernel's rows."""

from __future__ import annotations

import math
from typing import Any, Final, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError
from plow_twin.solve.state import Status

Number = TypeVar("Number", bound=np.generic)


class _Column(Generic[Number]):
    """A field of the rows as an array, without a copy."""

    def __init__(self, name: str = "") -> None:
        self._name = name

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = self._name or name

    @overload
    def __get__(self, view: None, owner: type) -> _Column[Number]: ...
    @overload
    def __get__(self, view: object, owner: type) -> NDArray[Number]: ...
    def __get__(self, view: Any, owner: type) -> Any:
        return self if view is None else view.rows[self._name]


class _View:
    """Columns of one row or of many rows."""

    __slots__ = ("rows",)

    q = _Column[np.float64]()
    v = _Column[np.float64]()
    penetration = _Column[np.float64]()
    rate = _Column[np.float64]()
    force = _Column[np.float64]()
    peak = _Column[np.float64]()
    impulse = _Column[np.float64]()
    time_in_contact = _Column[np.float64]()
    makes = _Column[np.int64]()
    wear_depth = _Column[np.float64]()

    def __init__(self, rows: Any) -> None:
        self.rows = rows


class Advance(_View):
    """State at one time, and sums since the previous advance, as a view of a row.

    Attributes
    ----------
    rows : numpy.void of `ROW`
        The underlying row.
    t : float
        Model time in s.
    q : ndarray, shape (3,)
        Pose x, y [m], theta [rad] of the cavity's centre.
    v : ndarray, shape (3,)
        Rates of the pose in m/s, m/s and rad/s.
    penetration : ndarray, shape (8,)
        Signed penetration of each pair at `t` in m.
    rate : ndarray, shape (8,)
        Rate of each penetration in m/s.
    force : ndarray, shape (8,)
        Normal force of each pair in N.
    peak : ndarray, shape (8,)
        Largest force of each pair since the previous advance in N.
    impulse : ndarray, shape (8,)
        Impulse of each pair since the previous advance in N s.
    time_in_contact : ndarray, shape (8,)
        Time in contact since the previous advance [s].
    makes : ndarray of int64, shape (8,)
        Number of touches since the previous advance.
    wear_depth : ndarray, shape (8,)
        Total wear depth of each pad in m.
    steps : int
        Number of steps that the solver took.
    status : Status
        Status of the advance. After a failure, the state is the last valid state.
    error_estimate_m : float
        Estimated error of the pose in m if `max_evaluations` was too small for the tolerance. Otherwise it is 0.
    """

    __slots__ = ()

    @property
    def t(self) -> float:
        """Model time in s."""
        return float(self.rows["t"])

    @property
    def steps(self) -> int:
        """Number of steps that the solver took."""
        return int(self.rows["steps"])

    @property
    def status(self) -> Status:
        """Status of the advance."""
        return _STATUS[int(self.rows["status"])]

    @property
    def error_estimate_m(self) -> float:
        """Estimated error of the pose in m."""
        return float(self.rows["error_estimate"])


class _Rows(_View):
    """Columns of many rows, where the status is an array of integers."""

    __slots__ = ()

    steps = _Column[np.int64]()
    status = _Column[np.int64]()
    error_estimate_m = _Column[np.float64]("error_estimate")

    def __len__(self) -> int:
        return len(self.rows)


class AdvanceSeries(_Rows):
    """Results of n advances. The fields are those of `Advance` with a leading axis of length n.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Model times in s.
    """

    __slots__ = ()

    t = _Column[np.float64]()

    def __getitem__(self, index: int) -> Advance:
        # a view would keep the memory of all rows alive
        return Advance(self.rows[index].copy())


class AdvanceBatch(_Rows):
    """Results of m twins. All fields but `t` are those of `AdvanceSeries` with an additional leading axis, length m."""

    __slots__ = ()

    @property
    def t(self) -> NDArray[np.float64]:
        """Model times in s, shape (n,)."""
        times: NDArray[np.float64] = self.rows["t"][0]
        return times

    def __getitem__(self, member: int) -> AdvanceSeries:
        return AdvanceSeries(self.rows[member])


_STATUS: Final = {int(status): status for status in Status}


def check_times(now: float, times: NDArray[np.float64]) -> None:
    """Raise `ArgumentError` if the times are not finite, decrease, or begin before `now`."""
    if times.shape == (1,) and now <= times[0] < math.inf:
        return  # the general check takes 8 us
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ArgumentError(f"t: got {times.tolist()!r}, expected finite times in s, shape (n,)")
    if len(times) and (times[0] < now or (times[1:] < times[:-1]).any()):
        before = np.concatenate([[now], times[:-1]])
        index = int(np.flatnonzero(times < before)[0])
        raise ArgumentError(f"t: got {float(times[index])!r} s, expected a time not before {float(before[index])!r} s")
