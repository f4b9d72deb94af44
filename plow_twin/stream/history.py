"""Storage of the last seconds of a session, so that the motion can be computed again with a late sample.

A history divides the stored time into *cells*. A session that applies samples one by one takes a snapshot at the first
sample of each cell. A session that applies many samples at once takes fewer snapshots, but records the same stamps.
Whether a sample is too old is decided from these stamps, so that the decision depends on the journal alone.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import Iterable
from copy import copy
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.stream.journal import Travel

#: Number of cells in the stored time.
SNAPSHOTS: Final = 100
#: Stamps [ns], shape (n,), and wrenches, shape (n, 3), of samples.
Samples = tuple[NDArray[np.int64], NDArray[np.float64]]
NO_SAMPLES: Final[Samples] = np.zeros(0, np.int64), np.zeros((0, 3))


class History:
    """Snapshots at intervals, and the samples and travel speeds since the oldest snapshot.

    Data that are older than the newest sample by more than `span_ns` [ns] are dropped. With a span of 0, nothing is
    stored.
    """

    def __init__(self, span_ns: int) -> None:
        self._span_ns = span_ns
        self._cell_ns = max(1, span_ns // SNAPSHOTS)
        self._snapshots: list[tuple[int, bytes]] = []
        #: snapshots that will not be used. Each sample frees one, because a sample has no time to free all.
        self._dropped: list[tuple[int, bytes]] = []
        #: stamp of the first sample of each cell [ns]
        self._kept_ns: list[int] = []
        #: largest stamp [ns] that `_kept_ns` has contained; after `rewind`, old stamps are dropped only if newer stamps
        #: follow
        self._newest_kept_ns: int | None = None
        self._travels: list[Travel] = []
        #: stamps [ns] of samples that follow a held load
        self._resumed_ns: list[int] = []
        #: applied samples, as they were added
        self._samples: deque[Samples] = deque()
        #: stamps [ns] of late samples that wait for their insertion; a copy shares them
        self._waiting_ns: set[int] = set()
        self._due = True

    def copy(self) -> History:
        """Return a history with the same data, which also stores the data that waiting samples will need."""
        other = copy(self)
        other._snapshots, other._travels = self._snapshots.copy(), self._travels.copy()
        other._kept_ns, other._resumed_ns = self._kept_ns.copy(), self._resumed_ns.copy()
        other._samples, other._dropped = self._samples.copy(), []
        return other

    def replace_motion(self, other: History, waiting_ns: Iterable[int]) -> None:
        """Replace snapshots, samples and speeds by those of a copy in which late samples have been inserted.

        The stamps that decide whether a sample is too old are not replaced. They must not depend on the progress of the
        copy. The samples with the stamps `waiting_ns` [ns] still wait.
        """
        self._dropped += self._snapshots
        self._snapshots, self._samples, self._travels = other._snapshots, other._samples, other._travels
        self._due, self._waiting_ns = other._due, set(waiting_ns)
        self._drop_old()

    def wait(self, stamp_ns: int) -> None:
        """Store the data that are needed until a late sample with this stamp [ns] is inserted."""
        self._waiting_ns.add(stamp_ns)

    @property
    def is_due(self) -> bool:
        """Whether the session should add a snapshot before the next sample."""
        return self._due and self._span_ns > 0

    @property
    def oldest_ns(self) -> int | None:
        """Stamp [ns] after which late samples can be inserted; None if no late sample can be inserted."""
        return self._kept_ns[0] if self._kept_ns else None

    @property
    def earliest_ns(self) -> int | None:
        """Stamp of the oldest snapshot [ns], or None."""
        return self._snapshots[0][0] if self._snapshots else None

    @property
    def newest_sample_ns(self) -> int | None:
        """Stamp of the newest stored sample [ns], or None."""
        return self._samples[-1][0].item(-1) if self._samples else None

    def __contains__(self, stamp_ns: int) -> bool:
        if stamp_ns in self._waiting_ns:
            return True
        if stamp_ns <= (self._snapshots[0][0] if self._snapshots else 0):
            return False
        found = next((stamps_ns for stamps_ns, _ in reversed(self._samples) if stamps_ns[0] <= stamp_ns), NO_SAMPLES[0])
        return stamp_ns in found

    def clear(self) -> None:
        """Drop everything."""
        self._dropped += self._snapshots
        self._snapshots, self._travels, self._kept_ns, self._resumed_ns = [], [], [], []
        self._samples.clear()
        self._waiting_ns = set()
        self._newest_kept_ns, self._due = None, True

    def add(self, stamps_ns: NDArray[np.int64], wrench: NDArray[np.float64]) -> None:
        """Add applied samples: stamps [ns], shape (n,), and wrenches, shape (n, 3). They must not change later."""
        if not self._span_ns:
            return
        if self._dropped:
            self._dropped.pop()
        self._samples.append((stamps_ns, wrench))
        last_ns = self._kept_ns[-1] if self._kept_ns else None
        if last_ns is not None and stamps_ns.item(-1) // self._cell_ns == last_ns // self._cell_ns:
            return  # fast path for most samples
        cells = stamps_ns // self._cell_ns
        begins = np.ones(len(cells), bool)
        begins[1:] = cells[1:] != cells[:-1]
        if last_ns is not None:
            begins &= (stamps_ns > last_ns) & (cells != last_ns // self._cell_ns)
        self._due = self._due or bool(begins.any())
        self._keep(stamps_ns[begins])

    def _keep(self, stamps_ns: NDArray[np.int64]) -> None:
        """Append rising stamps to `_kept_ns`, and drop data that are older than the stored time."""
        if not len(stamps_ns):
            return
        newest_ns, before_ns = int(stamps_ns[-1]), self._newest_kept_ns
        if before_ns is not None and newest_ns <= before_ns:
            self._kept_ns += stamps_ns.tolist()
            return
        self._newest_kept_ns = newest_ns
        first_ns = newest_ns - self._span_ns
        old = int(np.searchsorted(stamps_ns, first_ns, side="right"))
        if old:
            self._kept_ns = stamps_ns[old - 1 :].tolist()
        else:
            self._kept_ns = self._kept_ns[max(0, bisect_right(self._kept_ns, first_ns) - 1) :] + stamps_ns.tolist()
        self._drop_old()

    def _drop_old(self) -> None:
        # a state before each waiting sample is needed
        oldest_ns, old = min([self._kept_ns[0], *(stamp_ns - 1 for stamp_ns in self._waiting_ns)]), 0
        while old + 1 < len(self._snapshots) and self._snapshots[old + 1][0] <= oldest_ns:
            old += 1
        if old:
            del self._snapshots[:old]
            while self._samples and self._samples[0][0][-1] <= self._snapshots[0][0]:
                self._samples.popleft()
            self._travels = [travel for travel in self._travels if travel.stamp_ns >= self._snapshots[0][0]]

    def add_travel(self, travel: Travel) -> None:
        """Add an applied travel speed; it replaces a speed with the same stamp."""
        if not self._span_ns:
            return
        place = bisect_right(self._travels, travel.stamp_ns, key=lambda item: item.stamp_ns)
        if place and self._travels[place - 1].stamp_ns == travel.stamp_ns:
            place -= 1
            del self._travels[place]
        self._travels.insert(place, travel)

    def add_snapshot(self, stamp_ns: int, data: bytes, *, kept: bool = True, resumed: bool = False) -> None:
        """Add a snapshot at `stamp_ns`.

        If `kept` is set, the stamp is recorded as the first stamp of a cell. If `resumed` is set, the load was held
        before the sample at this stamp.
        """
        if not self._span_ns:
            return
        if not self._snapshots or self._snapshots[-1][0] < stamp_ns:
            self._snapshots.append((stamp_ns, data))
        self._due = False
        if kept and not (self._kept_ns and stamp_ns <= self._kept_ns[-1]):
            self._keep(np.array([stamp_ns]))
        if resumed:
            self._resumed_ns = [
                *(resumed_ns for resumed_ns in self._resumed_ns if resumed_ns > self._kept_ns[0]),
                stamp_ns,
            ]

    def correction_limit_ns(self, stamp_ns: int) -> int:
        """Return the earliest stamp [ns] at which a correction may begin if it inserts a sample at `stamp_ns`.

        A load can be held before a sample, and the samples that `rewind` returns do not contain the held load. A
        correction must therefore not begin before a held load.
        """
        place = bisect_left(self._resumed_ns, stamp_ns)
        return max(self._resumed_ns[place - 1] if place else 0, self.oldest_ns or 0)

    def repeated(self, stamp_ns: int) -> int:
        """Return how many samples are applied again if a sample is inserted at `stamp_ns`.

        The result does not depend on the snapshots that have been added.
        """
        place = bisect_left(self._kept_ns, stamp_ns)
        from_ns, count = self._kept_ns[place - 1] if place else 0, 0
        for stamps_ns, _ in reversed(self._samples):
            if stamps_ns[0] <= from_ns:
                return count + len(stamps_ns) - int(stamps_ns.searchsorted(from_ns, "right"))
            count += len(stamps_ns)
        return count

    def until_snapshot(self, stamps_ns: NDArray[np.int64]) -> int:
        """Return the number of the next samples, with these stamps [ns], up to the first sample of a cell."""
        if self.is_due or not self._kept_ns:
            return 1
        begins = stamps_ns // self._cell_ns != self._kept_ns[-1] // self._cell_ns
        return int(begins.argmax()) + 1 if begins.any() else len(stamps_ns)

    def before(self, stamp_ns: int) -> bytes:
        """Return the last snapshot before `stamp_ns`."""
        return self._snapshots[bisect_left(self._snapshots, stamp_ns, key=lambda item: item[0]) - 1][1]

    def rewind(self, stamp_ns: int) -> tuple[bytes, Samples, list[Travel]]:
        """Go back to the last snapshot before `stamp_ns`; return the snapshot and the later samples and speeds."""
        while self._snapshots[-1][0] >= stamp_ns:
            self._snapshots.pop()
        for stamps_ns in (self._kept_ns, self._resumed_ns):
            del stamps_ns[bisect_left(stamps_ns, stamp_ns) :]
        reached_ns, data = self._snapshots[-1]
        later = [NO_SAMPLES]
        while self._samples and self._samples[-1][0][-1] > reached_ns:
            stamps, wrench = self._samples.pop()
            if stamps[0] <= reached_ns:
                first = stamps.searchsorted(reached_ns, "right")
                self._samples.append((stamps[:first], wrench[:first]))
                stamps, wrench = stamps[first:], wrench[first:]
            later.append((stamps, wrench))
        travels = [item for item in self._travels if item.stamp_ns >= reached_ns]
        self._travels = [item for item in self._travels if item.stamp_ns < reached_ns]
        stamps, wrench = map(np.concatenate, zip(*reversed(later), strict=True))
        return data, (stamps, wrench), travels


class RecentStamps:
    """Stamps of measurements that may arrive up to `span_s` [s] late and need no repeated computation of the motion."""

    def __init__(self, span_s: float) -> None:
        self._span_ns = round(span_s * 1e9)
        self._stamps_ns: list[int] = []

    @property
    def oldest_ns(self) -> int | None:
        """Stamp before which no measurement can be used [ns]; None before the first measurement."""
        return self._stamps_ns[-1] - self._span_ns if self._stamps_ns else None

    def __contains__(self, stamp_ns: int) -> bool:
        index = bisect_left(self._stamps_ns, stamp_ns)
        return self._stamps_ns[index : index + 1] == [stamp_ns]

    def clear(self) -> None:
        """Forget all stamps."""
        self._stamps_ns.clear()

    def add(self, stamp_ns: int) -> None:
        """Add a stamp, and drop stamps that have become too old."""
        insort(self._stamps_ns, stamp_ns)
        if self._stamps_ns[0] < self._stamps_ns[-1] - 2 * self._span_ns:
            del self._stamps_ns[: bisect_left(self._stamps_ns, self._stamps_ns[-1] - self._span_ns)]
