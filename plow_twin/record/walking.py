"""Advance sessions by many samples at a time, from the journal of a run or from the load in any recording.

A *walker* advances one session. The load is interpolated linearly between all samples, however far apart they are.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.record.entries import Entries, Holes
from plow_twin.record.journal_codec import Dropped
from plow_twin.run.advance import AdvanceSeries
from plow_twin.solve.state import ROW
from plow_twin.stream import journal
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import DIGEST_INTERVAL, Applied, Session

if TYPE_CHECKING:
    from plow_twin.record.writer import RunWriter

#: Largest number of samples by which a session advances in one call.
BATCH: Final = 4096
#: Types of entries that change the session. Samples and speeds between two entries of these types are sorted by their
#: stamps.
_ACTING: Final = (
    journal.Reset,
    journal.Loss,
    journal.Restore,
    journal.Snapshot,
    journal.SetModel,
    journal.SetWear,
)
#: Types of entries that change the session only if the motion of the session follows measurements.
_FOLLOWED: Final = (journal.Pose, journal.PartOfPose, journal.Estimated, journal.Parameter)
#: Number of consecutive failed advances after which the model is reset.
_FAILURE_LIMIT: Final = 10


@dataclass(frozen=True)
class Walked:
    """Result of several advances of a session."""

    #: stamps [ns], shape (n,)
    stamp_ns: NDArray[np.int64]
    #: load at the stamps [N, N, N m], shape (n, 3)
    wrench: NDArray[np.float64]
    #: motion at the stamps, with the number of touches since the start of the run
    rows: AdvanceSeries
    published: Published
    #: number of touches of each pair since the previous advance, shape (n, 8)
    makes: NDArray[np.int64]
    #: travel speed during the advances [m/s]
    speed_m_s: float
    #: scene of the run, including all changes of the model up to these advances
    scene: Scene


class Walker:
    """Advance a session by many samples at a time.

    The walker writes the journal and the outputs of the session to `writer`, and calls `on_walked` with the result of
    each batch. No other code may change the session.
    """

    def __init__(
        self, session: Session, on_walked: Callable[[Walked], object], writer: RunWriter | None = None
    ) -> None:
        self.session = session
        self._on_walked = on_walked
        self._writer = writer
        self._sequence = -1
        self._advances = 0
        self._log_time_ns = 0
        self.failures = 0
        self.on_reset: Callable[[], object] = lambda: None
        self._opening: journal.Snapshot | None = session.snapshot()

    def _open(self, log_time_ns: int) -> None:
        opening, self._opening = self._opening, None
        if opening is not None:
            self._sequence += 1
            if self._writer is not None:
                self._writer.write_entry(self._sequence, log_time_ns, opening)

    def _entry(self, entry: journal.Entry) -> None:
        self._open(self._log_time_ns)
        self._sequence += 1
        if self._writer is not None:
            self._writer.write_entry(self._sequence, self._log_time_ns, entry)

    def apply(self, entry: journal.Entry, log_time_ns: int = 0) -> None:
        """Apply a journal entry that is not a sample."""
        self._log_time_ns = log_time_ns or self._log_time_ns
        self._entry(entry)
        self.session.apply(entry)
        if isinstance(entry, journal.Reset | journal.SetWear | journal.Restore):
            self.on_reset()

    def samples(self, stamp_ns: NDArray[np.int64], wrench: NDArray[np.float64], log_time_ns: NDArray[np.int64]) -> None:
        """Advance the session by samples, whose stamps must not descend."""
        for begin in range(0, len(stamp_ns), BATCH):
            part = slice(begin, begin + BATCH)
            self._walk(stamp_ns[part], wrench[part], log_time_ns[part])

    def _walk(self, stamp_ns: NDArray[np.int64], wrench: NDArray[np.float64], log_ns: NDArray[np.int64]) -> None:
        count = len(stamp_ns)
        numbers = self._advances + 1 + np.arange(count)
        marks = 1 + np.flatnonzero(numbers % DIGEST_INTERVAL == 0)
        before = self.session.outputs.makes
        done = self.session.advance(stamp_ns, wrench, np.zeros(count, ROW), np.arange(count), marks)
        self._advances += count
        self.failures += done.failed
        if self._writer is not None:
            self._write(stamp_ns, wrench, log_ns, marks, done)
        rows = AdvanceSeries(done.rows)
        makes = np.diff(rows.makes, axis=0, prepend=before[None])
        scene, speed = self.session.twin.scene, self.session.travel_speed_m_s
        self._on_walked(Walked(stamp_ns, wrench, rows, done.published, makes, speed, scene))
        if count >= _FAILURE_LIMIT and rows.status[-_FAILURE_LIMIT:].all():
            self.apply(journal.Reset(int(stamp_ns[-1]), f"{_FAILURE_LIMIT} failed advances"), int(log_ns[-1]))

    def _write(
        self,
        stamp_ns: NDArray[np.int64],
        wrench: NDArray[np.float64],
        log_ns: NDArray[np.int64],
        marks: NDArray[np.int64],
        done: Applied,
    ) -> None:
        assert self._writer is not None
        self._open(int(log_ns[0]))
        digests = dict(zip(marks.tolist(), done.digests, strict=True))
        sequence = self._writer.write_series(self._sequence + 1, log_ns, stamp_ns, wrench, digests)
        self._sequence += len(stamp_ns) + len(marks)
        self._log_time_ns = int(log_ns[-1])
        if not done.failed:
            self._writer.write_publications(sequence, log_ns, done.published)

    def close(self) -> None:
        """Write a digest of the final state to the journal."""
        if self.session.stamp_ns is not None:
            self._entry(journal.Digest(self.session.stamp_ns, self.session.twin.digest()))


class JournalWalk:
    """Pass the journal of a run to walkers.

    After missing entries, the motion of all walkers is reset. A late sample is inserted at its stamp, unless the
    walkers have already reached the stamp.

    The walkers `own` restore the first snapshot after a loss, and apply settings of the wear. With `same_scene`, they
    have the scene of the run, and apply changes of the model, restored motions and, if their twins follow measurements,
    the measurements. The walkers `others` have other scenes, and never restore a state. If the journal is not `whole`,
    that is, begins after the first entry of the run, the walkers `own` restore the first snapshot.

    `used` and `late` count the samples that were used, and that were too late. `missing` counts missing entries.
    """

    def __init__(
        self, own: Sequence[Walker], others: Sequence[Walker], *, whole: bool = True, same_scene: bool = True
    ) -> None:
        self._own, self._all = own, (*own, *others)
        self._same = own if same_scene else ()
        self._following = [walker for walker in self._same if walker.session.following is not None]
        self._acting = (*_ACTING, *_FOLLOWED) if self._following else _ACTING
        #: changes of the travel speed whose stamps have not been reached, in the order of the stamps
        self._travels: list[journal.Travel] = []
        self._lost = not whole
        self._reached_ns = -1
        self.used = self.late = self.missing = 0
        self._holes = Holes()

    def add(self, entries: Entries) -> None:
        """Process a batch of journal entries."""
        begin = 0
        for place, count in self._holes.find(entries).items():
            self._whole(entries[begin:place])
            self.missing += count
            self._entry(journal.Loss(count))
            begin = place
        self._whole(entries[begin:])

    def _whole(self, entries: Entries) -> None:
        stamps, wrench, begin = entries.stamp_ns, entries.wrench, 0
        acting = sorted(place for place, entry in entries.rest.items() if isinstance(entry, self._acting))
        numbered = ((place, entry) for place, entry in entries.rest.items() if isinstance(entry, journal.Travel))
        travels = deque(sorted(numbered, key=lambda item: item[0]))
        for place in (*acting, len(entries)):
            samples = begin + np.flatnonzero(entries.sample[begin:place])
            while travels and travels[0][0] < place:
                insort(self._travels, travels.popleft()[1], key=lambda travel: travel.stamp_ns)
            if samples.size:
                self._samples(stamps[samples], wrench[samples])
            if place < len(entries):
                self._entry(entries.rest[place])
            begin = place + 1

    def _samples(self, stamps: NDArray[np.int64], wrench: NDArray[np.float64]) -> None:
        order = np.argsort(stamps, kind="stable")
        order = order[stamps[order] > self._reached_ns]
        self.used, self.late = self.used + len(order), self.late + len(stamps) - len(order)
        stamps, wrench = stamps[order], wrench[order]
        while len(stamps):
            count = len(stamps)
            if self._travels:  # the samples after the next change of speed are processed in the next iteration
                count = int(np.searchsorted(stamps, self._travels[0].stamp_ns, "right"))
            if count:
                self._reached_ns = int(stamps[count - 1])
                for walker in self._all:
                    walker.samples(stamps[:count], wrench[:count], stamps[:count])
                stamps, wrench = stamps[count:], wrench[count:]
            if len(stamps):
                travel = self._travels.pop(0)
                self._speed(max(travel.stamp_ns, self._reached_ns), travel.speed_m_s)

    def _speed(self, stamp_ns: int, speed_m_s: float) -> None:
        for walker in self._all:
            walker.apply(journal.Travel(stamp_ns, speed_m_s))

    def _begin_anew(self) -> None:
        for travel in self._travels:
            self._speed(max(0, self._reached_ns), travel.speed_m_s)
        self._travels, self._reached_ns = [], -1

    def _entry(self, entry: journal.Entry | Dropped) -> None:
        match entry:
            case journal.Reset() | journal.Loss():
                self._begin_anew()
                for walker in self._all:
                    walker.apply(journal.Reset(0, "loss") if isinstance(entry, journal.Loss) else entry)
            case journal.Restore():
                self._begin_anew()
                for walker in self._all:
                    walker.apply(entry if walker in self._same else journal.Reset(0, "restore"))
            case journal.SetModel():
                for walker in self._same:
                    walker.apply(entry)
            case journal.Pose() | journal.PartOfPose() | journal.Estimated() | journal.Parameter():
                for walker in self._following:
                    walker.apply(entry)
            case journal.Snapshot() if self._lost:
                for walker in self._own:
                    walker.apply(entry)
                    self._reached_ns = walker.session.stamp_ns or -1
            case journal.SetWear():
                for walker in self._all:
                    walker.apply(entry) if walker in self._own else walker.on_reset()
        self._lost = isinstance(entry, journal.Loss) or (self._lost and not isinstance(entry, journal.Snapshot))
