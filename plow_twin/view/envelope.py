"""Storage of curves of any length for a picture, as all rows or as extremes in bins of equal width."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.record.entries import concatenated

Array = NDArray[np.float64]
Indexes = NDArray[np.int64]

#: Largest number of rows that are stored without bins.
MOST_ROWS: Final = 8000
#: Largest number of bins, about one for each pixel.
_MOST_BINS: Final = 700


class Envelope:
    """Rows of `width` numbers over time, in bounded memory.

    Above `most_rows` rows, the whole time span is divided into bins of equal width. A bin contains the least and the
    largest value of each column, so that no peak is lost. A segment is a line between two gaps.
    """

    def __init__(self, width: int, most_rows: int = MOST_ROWS, most_bins: int = _MOST_BINS) -> None:
        self._most_rows, self._most_bins = most_rows, most_bins
        self._segment = 0
        #: Width of a bin [s]; 0 as long as all rows are stored.
        self._bin_s = 0.0
        # `place` is the time [s] of a row, or the number of its bin
        self._merged = _Rows(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, width)), np.zeros((0, width)))
        self._added: list[_Rows] = []
        self._added_rows = 0

    def __bool__(self) -> bool:
        return bool(self._added_rows or len(self._merged.place))

    def add(self, times_s: Array, values: Array) -> None:
        """Add times [s], shape (n,), and values, shape (n, width)."""
        if len(times_s):
            segment = np.full(len(times_s), self._segment, np.int64)
            self._added.append(_Rows(segment, np.array(times_s, np.float64), values, values))
            self._added_rows += len(times_s)
        if self._added_rows > self._most_rows:
            self._merge()

    def break_line(self) -> None:
        """End the lines. The next rows begin new lines."""
        self._segment += 1

    @property
    def bin_s(self) -> float:
        """Width of a bin [s]; 0 as long as all rows are stored."""
        self._merge()
        return self._bin_s

    def bands(self, column: int) -> tuple[Array, Array, Array]:
        """Return times [s], least and largest values of a column, shape (n,) each. NaN interrupts a line.

        The time of a bin is the middle of the bin.
        """
        self._merge()
        rows = self._merged
        times = (rows.place + 0.5) * self._bin_s if self._bin_s else rows.place
        breaks = np.flatnonzero(np.diff(rows.segment)) + 1
        times, least, largest = (
            np.insert(part, breaks, np.nan) for part in (times, rows.least[:, column], rows.largest[:, column])
        )
        return times, least, largest

    def _merge(self) -> None:
        added = _Rows.joined(self._added) if self._added else None
        self._added, self._added_rows = [], 0
        if added is None:
            return
        if self._bin_s:
            added = added.binned(self._bin_s)
        self._merged = _Rows.joined([self._merged, added])
        if not self._bin_s:
            if len(self._merged.place) <= self._most_rows:
                return
            self._bin_s = max(2.0 * float(np.ptp(self._merged.place)) / self._most_bins, 1e-9)
            self._merged = self._merged.binned(self._bin_s)
        self._merged = self._merged.merged()
        # bins of different segments are never merged, so the limit may not be reached
        while len(self._merged.place) > self._most_bins and np.ptp(self._merged.place) > 1.0:
            self._bin_s *= 2.0
            self._merged = self._merged.binned(2.0).merged()


class _Rows:
    """Rows with their segment and their place: a time [s], or the number of a bin."""

    def __init__(self, segment: Indexes, place: Array, least: Array, largest: Array) -> None:
        self.segment, self.place, self.least, self.largest = segment, place, least, largest

    @classmethod
    def joined(cls, parts: list[_Rows]) -> _Rows:
        return cls(*concatenated(parts, "segment", "place", "least", "largest"))

    def binned(self, width: float) -> _Rows:
        return _Rows(self.segment, np.floor(self.place / width), self.least, self.largest)

    def merged(self) -> _Rows:
        order = np.lexsort((self.place, self.segment))
        segment, place = self.segment[order], self.place[order]
        first = np.flatnonzero(np.r_[True, (np.diff(segment) != 0) | (np.diff(place) != 0)])
        least = np.minimum.reduceat(self.least[order], first)
        largest = np.maximum.reduceat(self.largest[order], first)
        return _Rows(segment[first], place[first], least, largest)
