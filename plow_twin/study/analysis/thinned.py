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
        self._columns = columns
        self._stamps, self._values = array("q"), array("d")
        #: Number of rows received.
        self.rows = 0
        self.stride = 1

    def add(self, stamp_ns: NDArray[np.int64], values: Array) -> None:
        """Add stamps [ns], shape (n,), and rows, shape (n, columns)."""
        chosen = slice(-self.rows % self.stride, None, self.stride)
        self._stamps.frombytes(stamp_ns[chosen].tobytes())
        self._values.frombytes(values[chosen].tobytes())
        self.rows += len(stamp_ns)
        self._thin()

    def add_row(self, stamp_ns: int, *values: float) -> None:
        """Add a row with its stamp [ns]."""
        if self.rows % self.stride == 0:
            self._stamps.append(stamp_ns)
            self._values.extend(values)
        self.rows += 1
        self._thin()

    def _thin(self) -> None:
        while len(self._stamps) > MOST_ROWS:
            stamps, values = self.series()
            self._stamps, self._values = array("q", stamps[::2].tobytes()), array("d", values[::2].tobytes())
            self.stride *= 2

    def series(self) -> tuple[NDArray[np.int64], Array]:
        """Return the stamps [ns], shape (m,), and the stored rows, shape (m, columns)."""
        return np.array(self._stamps, np.int64), np.array(self._values).reshape(-1, self._columns)
