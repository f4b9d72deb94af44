"""What a session remembers of its last seconds, so that a late sample can be worked in: snapshots and all since.

All of it follows from the journal alone: a replay has the same history at the same place.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.stream.journal import Sample, Travel

#: Snapshots in the time remembered: going back costs the samples between two of them on top.
SNAPSHOTS: Final = 100


class History:
    """Snapshots at intervals, with the samples and speeds since the oldest of them.

    Parameters
    ----------
    span_ns
        Time remembered before the newest sample [ns]; 0: none.
    """

    def __init__(self, span_ns: int) -> None:
        self._span_ns = span_ns
        self._spacing_ns = max(1, span_ns // SNAPSHOTS)
        self._snapshots: list[tuple[int, bytes]] = []
        self._samples: list[Sample] = []
        self._stamps_ns: list[int] = []
        self._travels: list[Travel] = []
        #: samples as arrays, made into samples when they are needed
        self._later: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest snapshot [ns]: what is newer can be worked in; None without one."""
        return self._snapshots[0][0] if self._snapshots else None

    @property
    def newest_sample_ns(self) -> int | None:
        """Stamp of the newest sample [ns]."""
        if self._later:
            return int(self._later[-1][0][-1])
        return self._stamps_ns[-1] if self._stamps_ns else None

    def __contains__(self, stamp_ns: int) -> bool:
        """Tell whether there is a sample of that stamp."""
        self._make_samples()
        index = bisect_left(self._stamps_ns, stamp_ns)
        return self._stamps_ns[index : index + 1] == [stamp_ns]

    def clear(self) -> None:
        """Forget everything."""
        for part in (self._snapshots, self._samples, self._stamps_ns, self._travels, self._later):
            part.clear()

    def cut(self, stamp_ns: int | None) -> None:
        """Forget all after `stamp_ns`; None: everything."""
        if stamp_ns is None:
            self.clear()
            return
        self._make_samples()
        kept = bisect_right(self._stamps_ns, stamp_ns)
        del self._samples[kept:], self._stamps_ns[kept:]
        self._snapshots = [item for item in self._snapshots if item[0] <= stamp_ns]
        self._travels = [item for item in self._travels if item.stamp_ns <= stamp_ns]

    def add_later(self, stamps_ns: NDArray[np.int64], wrench: NDArray[np.float64]) -> None:
        """Take in samples (n,), (n, 3) that have been applied; no snapshot of them is wanted."""
        if self._span_ns:
            self._later.append((stamps_ns, wrench))

    def _make_samples(self) -> None:
        oldest_ns = self.oldest_ns or 0
        for stamps_ns, wrench in self._later:
            wanted = stamps_ns > oldest_ns
            rows = [(row[0], row[1], row[2]) for row in wrench[wanted].tolist()]
            stamps = stamps_ns[wanted].tolist()
            self._samples += [Sample(stamp, row) for stamp, row in zip(stamps, rows, strict=True)]
            self._stamps_ns += stamps
        self._later.clear()

    def until_snapshot(self, samples: list[Sample]) -> int:
        """Return how many samples can be applied before a snapshot is due."""
        if not self._span_ns or len(samples) == 1:
            return len(samples)
        if not self._snapshots:
            return 1
        cell = self._snapshots[-1][0] // self._spacing_ns
        stamps_ns = (sample.stamp_ns // self._spacing_ns != cell for sample in samples)
        return next((count for count, due in enumerate(stamps_ns, 1) if due), len(samples))

    def add(self, samples: list[Sample]) -> bool:
        """Take in samples that have been applied; True when a snapshot is due."""
        if not self._span_ns:
            return False
        self._make_samples()
        self._samples += samples
        self._stamps_ns += [sample.stamp_ns for sample in samples]
        return not self.follows(self._stamps_ns[-1])

    def follows(self, stamp_ns: int) -> bool:
        """Tell whether a sample of that stamp asks for no snapshot."""
        if not self._span_ns:
            return True
        return bool(self._snapshots) and stamp_ns // self._spacing_ns == self._snapshots[-1][0] // self._spacing_ns

    def add_one(self, sample: Sample) -> None:
        """Take in a sample that has been applied and that `follows`."""
        if self._span_ns:
            if self._later:
                self._make_samples()
            self._samples.append(sample)
            self._stamps_ns.append(sample.stamp_ns)

    def add_travel(self, travel: Travel) -> None:
        """Take in a speed that has been applied; of those with one stamp the last one counts."""
        if not self._span_ns:
            return
        place = bisect_right(self._travels, travel.stamp_ns, key=lambda item: item.stamp_ns)
        if place and self._travels[place - 1].stamp_ns == travel.stamp_ns:
            place -= 1
            del self._travels[place]
        self._travels.insert(place, travel)

    def add_snapshot(self, stamp_ns: int, data: bytes) -> None:
        """Take in the state at `stamp_ns`, and forget what is older than the time remembered."""
        if not self._span_ns or (self._snapshots and self._snapshots[-1][0] >= stamp_ns):
            return
        self._snapshots.append((stamp_ns, data))
        first_ns = stamp_ns - self._span_ns
        old = 0
        while old + 1 < len(self._snapshots) and self._snapshots[old + 1][0] <= first_ns:
            old += 1
        if old:
            del self._snapshots[:old]
            self._later = [item for item in self._later if item[0][-1] > self._snapshots[0][0]]
            kept = bisect_right(self._stamps_ns, self._snapshots[0][0])
            del self._samples[:kept], self._stamps_ns[:kept]
            self._travels = [travel for travel in self._travels if travel.stamp_ns >= self._snapshots[0][0]]

    def rewind(self, stamp_ns: int) -> tuple[bytes, list[Sample], list[Travel]]:
        """Forget all from the newest snapshot before `stamp_ns` on; return it, and what came after it."""
        self._make_samples()
        while self._snapshots[-1][0] >= stamp_ns:
            self._snapshots.pop()
        reached_ns, data = self._snapshots[-1]
        kept = bisect_right(self._stamps_ns, reached_ns)
        samples, travels = self._samples[kept:], [item for item in self._travels if item.stamp_ns >= reached_ns]
        del self._samples[kept:], self._stamps_ns[kept:]
        self._travels = [item for item in self._travels if item.stamp_ns < reached_ns]
        return data, samples, travels


class RecentStamps:
    """The stamps of a stream that only has to be in order: what is late by less than `span_s` can still be used."""

    def __init__(self, span_s: float) -> None:
        self._span_ns = round(span_s * 1e9)
        self._stamps_ns: list[int] = []

    @property
    def oldest_ns(self) -> int | None:
        """Stamp before which nothing can be used any more [ns]; None before the first."""
        return self._stamps_ns[-1] - self._span_ns if self._stamps_ns else None

    def __contains__(self, stamp_ns: int) -> bool:
        """Tell whether that stamp has been there."""
        index = bisect_left(self._stamps_ns, stamp_ns)
        return self._stamps_ns[index : index + 1] == [stamp_ns]

    def clear(self) -> None:
        """Forget all."""
        self._stamps_ns.clear()

    def add(self, stamp_ns: int) -> None:
        """Remember a stamp, and forget those that are too old by now."""
        insort(self._stamps_ns, stamp_ns)
        if self._stamps_ns[0] < self._stamps_ns[-1] - 2 * self._span_ns:
            del self._stamps_ns[: bisect_left(self._stamps_ns, self._stamps_ns[-1] - self._span_ns)]
