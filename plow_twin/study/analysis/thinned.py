"""Series in bounded memory. If a series becomes too long, every second stored row is removed."""

from __future__ import annotations

from array import array
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Largest number of stored rows. A prediction with this number of rows needs 150 MB.
MOST_ROWS: Final = 1_000_000


class Thinned:
    """Rows of several columns, with stamps. Every `stride`-th received row is stored."""

    def __init__(self, columns: int) -> None:
        self._stamps: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
        self._values: list[Array] = [np.zeros((0, columns))]
        self._kept = self.rows = 0
        self.stride = 1

    def add(self, stamp_ns: NDArray[np.int64], values: Array) -> None:
        """Add stamps [ns], shape (n,), and rows, shape (n, columns)."""
        chosen = slice(-self.rows % self.stride, None, self.stride)
        self._stamps.append(stamp_ns[chosen].copy())
        self._values.append(values[chosen].copy())
        self.rows += len(stamp_ns)
        self._kept += len(self._stamps[-1])
        while self._kept > MOST_ROWS:
            stamps, kept = self.series()
            self._stamps, self._values = [stamps[::2].copy()], [kept[::2].copy()]
            self._kept, self.stride = len(self._stamps[0]), 2 * self.stride

    def series(self) -> tuple[NDArray[np.int64], Array]:
        """Return the stamps [ns], shape (m,), and the stored rows, shape (m, columns)."""
        self._stamps, self._values = [np.concatenate(self._stamps)], [np.concatenate(self._values)]
        return self._stamps[0], self._values[0]


class ThinnedSignal:
    """Single values, each with its stamp and the number of the stretch in which it arrived."""

    def __init__(self) -> None:
        self._stamps, self._values, self._stretches = array("q"), array("d"), array("I")
        self._came, self._stride = 0, 1

    def add(self, stamp_ns: int, value: float, stretch: int = 0) -> None:
        """Add a value with its stamp [ns] and the number of its stretch."""
        if self._came % self._stride == 0:
            self._stamps.append(stamp_ns)
            self._values.append(value)
            self._stretches.append(stretch)
        self._came += 1
        if len(self._stamps) > MOST_ROWS:
            self._stamps, self._values, self._stride = self._stamps[::2], self._values[::2], 2 * self._stride
            self._stretches = self._stretches[::2]

    @property
    def came(self) -> int:
        """Number of values received, including the values that are not stored."""
        return self._came

    def series(self) -> tuple[NDArray[np.int64], Array]:
        """Return the stamps [ns] and the stored values, shape (m,) each."""
        return np.array(self._stamps, np.int64), np.array(self._values)

    def stretches(self) -> NDArray[np.int64]:
        """Return the stretch of each stored value, shape (m,)."""
        return np.array(self._stretches, np.int64)
