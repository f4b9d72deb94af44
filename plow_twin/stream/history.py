"""What a session remembers of its last seconds, so that a late sample can be worked in: snapshots and all since.

What can be worked in follows from the journal alone. A replay, which advances many samples at once, has fewer
snapshots; it notes where a live session has its own, by which both tell what is too old.
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
        #: stamps at which a session that advances sample by sample has snapshots
        self._kept_ns: list[int] = []
        #: largest stamp of these so far: running again up to there forgets nothing
        self._newest_kept_ns: int | None = None
        self._samples: list[Sample] = []
        self._stamps_ns: list[int] = []
        self._travels: list[Travel] = []
        #: samples as arrays, made into samples when they are needed
        self._later: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest snapshot [ns]: what is newer can be worked in; None without one."""
        return self._kept_ns[0] if self._kept_ns else None

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
        for part in (self._snapshots, self._kept_ns, self._samples, self._stamps_ns, self._travels, self._later):
            part.clear()
        self._newest_kept_ns = None

    def add_later(self, before_ns: int, data: bytes, stamps_ns: NDArray[np.int64], wrench: NDArray[np.float64]) -> None:
        """Take in samples (n,), (n, 3) that have been applied at once, from the state `data` at `before_ns` on."""
        if not self._span_ns:
            return
        self._add_data(before_ns, data)
        self._later.append((stamps_ns, wrench))
        cells = stamps_ns // self._spacing_ns
        begins = np.ones(len(cells), bool)
        begins[1:] = cells[1:] != cells[:-1]
        if self._kept_ns:
            last_ns = self._kept_ns[-1]
            begins &= (stamps_ns > last_ns) & (cells != last_ns // self._spacing_ns)
        self._keep(stamps_ns[begins])

    def _keep(self, stamps_ns: NDArray[np.int64]) -> None:
        """Note rising stamps of snapshots behind all others, and forget what is older than the time remembered."""
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
        self._forget_old()

    def _forget_old(self) -> None:
        """Forget what is not needed to go back to the oldest stamp."""
        oldest_ns, old = self._kept_ns[0], 0
        while old + 1 < len(self._snapshots) and self._snapshots[old + 1][0] <= oldest_ns:
            old += 1
        if old:
            del self._snapshots[:old]
            self._later = [item for item in self._later if item[0][-1] > self._snapshots[0][0]]
            kept = bisect_right(self._stamps_ns, self._snapshots[0][0])
            del self._samples[:kept], self._stamps_ns[:kept]
            self._travels = [travel for travel in self._travels if travel.stamp_ns >= self._snapshots[0][0]]

    def _add_data(self, stamp_ns: int, data: bytes) -> None:
        if not self._snapshots or self._snapshots[-1][0] < stamp_ns:
            self._snapshots.append((stamp_ns, data))

    def _make_samples(self) -> None:
        oldest_ns = self._snapshots[0][0] if self._snapshots else 0
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

    def add_snapshot(self, stamp_ns: int, data: bytes, *, due: bool = False) -> None:
        """Take in the state at `stamp_ns`, and forget what is older than the time remembered.

        `due`: for no other reason than that `add` asked for it.
        """
        if not self._span_ns:
            return
        self._add_data(stamp_ns, data)
        last_ns = self._kept_ns[-1] if self._kept_ns else None
        same_cell = last_ns is not None and stamp_ns // self._spacing_ns == last_ns // self._spacing_ns
        if last_ns is None or (stamp_ns > last_ns and not (due and same_cell)):
            self._keep(np.array([stamp_ns]))

    def rewind(self, stamp_ns: int) -> tuple[bytes, list[Sample], list[Travel]]:
        """Forget all from the newest snapshot before `stamp_ns` on; return it, and what came after it."""
        self._make_samples()
        while self._snapshots[-1][0] >= stamp_ns:
            self._snapshots.pop()
        while self._kept_ns[-1] >= stamp_ns:
            self._kept_ns.pop()
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
