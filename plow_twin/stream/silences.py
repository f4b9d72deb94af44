"""Detection of silences, which are long intervals without samples, from the stamps."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.stream.intake import NS_PER_S

Indexes = NDArray[np.int64]
#: A silence is longer than `_LONGER` times the interval before it, so a log with one sample per minute has no silences.
_LONGER: Final = 5


class Silences:
    """Count the silences of a stream.

    A silence is an interval between two stamps that is longer than `timeout_s` [s] and than `_LONGER` times the
    interval before it. The attribute `timeout_s` may be changed later.
    """

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self.count = 0
        self.total_ns = 0
        self.longest_ns = (0, 0)
        self._first_ns: int | None = None
        self._newest_ns: int | None = None
        #: newest interval that is not a silence [ns]
        self._interval_ns: int | None = None

    def add(self, stamps_ns: Indexes) -> list[tuple[int, int, int]]:
        """Add the stamps of samples, shape (n,) [ns]; return the silences that end at these samples.

        Each silence is a tuple of the index of the sample that ends it, its begin [ns] and its end [ns]. A sample that
        is older than the newest stamp does not end a silence.
        """
        if not len(stamps_ns):
            return []
        newest_ns = self._begin(int(stamps_ns[0]))
        reached = np.maximum.accumulate(np.concatenate((np.array([newest_ns]), stamps_ns)))
        self._newest_ns = int(reached[-1])
        intervals = np.diff(reached)
        moved = np.flatnonzero(intervals)
        silences, done = list[tuple[int, int, int]](), 0
        for place in np.flatnonzero(intervals[moved] > self.timeout_s * NS_PER_S).tolist():
            if place > done:
                self._interval_ns = int(intervals[moved[place - 1]])
            end = int(moved[place])
            if self._is_silence(int(intervals[end])):
                silences.append((end, int(reached[end]), int(reached[end + 1])))
                self._count(*silences[-1][1:])
            done = place + 1
        if done < len(moved):
            self._interval_ns = int(intervals[moved[-1]])
        return silences

    def _is_silence(self, interval_ns: int) -> bool:
        before_ns = self._interval_ns
        is_long = before_ns is not None and interval_ns > max(self.timeout_s * NS_PER_S, _LONGER * before_ns)
        if not is_long:
            self._interval_ns = interval_ns
        return is_long

    def add_one(self, stamp_ns: int) -> None:
        """Add the stamp of one sample [ns]."""
        newest_ns = self._begin(stamp_ns)
        if stamp_ns > newest_ns:
            if self._is_silence(stamp_ns - newest_ns):
                self._count(newest_ns, stamp_ns)
            self._newest_ns = stamp_ns

    def restart(self) -> None:
        """Continue after a reset; the time across the reset is not a silence."""
        self._newest_ns = None

    def text(self) -> str:
        """Return a description of the silences, with times since the first sample; empty without a silence."""
        if not self.count:
            return ""
        begin_s, end_s = ((at - (self._first_ns or 0)) * 1e-9 for at in self.longest_ns)
        where = f"from {begin_s:.3f} s to {end_s:.3f} s after the first"
        if self.count > 1:
            where = f"in {self.count} stretches, the longest {where}"
        return f"{self.total_ns * 1e-9:.3f} s without samples, {where}"

    def facts(self) -> dict[str, int | float]:
        """Return the number of silences, their total length [s], and the start of the longest [s], if any."""
        begin_s = (self.longest_ns[0] - (self._first_ns or 0)) * 1e-9
        return {"count": self.count, "total_s": self.total_ns * 1e-9, "longest_from_s": begin_s} if self.count else {}

    def _begin(self, stamp_ns: int) -> int:
        if self._first_ns is None:
            self._first_ns = stamp_ns
        if self._newest_ns is None:
            self._newest_ns = stamp_ns
        return self._newest_ns

    def _count(self, begin_ns: int, end_ns: int) -> None:
        self.count += 1
        self.total_ns += end_ns - begin_ns
        if end_ns - begin_ns > self.longest_ns[1] - self.longest_ns[0]:
            self.longest_ns = begin_ns, end_ns
