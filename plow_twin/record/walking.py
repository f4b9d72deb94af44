"""Advance of a session by many samples at a time, from the journal of a run or from the load of any recording.

A *walker* advances one session. Time follows the stamps; the load is linear from sample to sample and is never held.
"""

from __future__ import annotations

from bisect import insort
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
from plow_twin.stream.journal import (
    Digest,
    Entry,
    Estimated,
    Loss,
    Parameter,
    PartOfPose,
    Pose,
    Reset,
    Restore,
    SetModel,
    SetWear,
    Snapshot,
    Travel,
)
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import DIGEST_INTERVAL, Applied, Session

if TYPE_CHECKING:
    from plow_twin.record.writer import RunWriter

#: Number of samples by which the session advances at once.
BATCH: Final = 4096
#: Entries at which a walk stops; late samples are sorted in across all other entries.
_ACTING: Final = (Travel, Reset, Loss, Restore, Snapshot, SetModel, SetWear)
#: Further entries at which a walk stops if the motion follows measurements.
_FOLLOWED: Final = (Pose, PartOfPose, Estimated, Parameter)
#: Number of failed advances in a row after which the model is reset.
_FAILURE_LIMIT: Final = 10


@dataclass(frozen=True)
class Walked:
    """Several advances: stamps (n,) [ns], wrench (n, 3), and the rows to be published after each advance."""

    stamp_ns: NDArray[np.int64]
    wrench: NDArray[np.float64]
    #: the rows of `published`, with the number of touches so far
    rows: AdvanceSeries
    published: Published
    #: touches since the previous advance, shape (n, 8)
    makes: NDArray[np.int64]
    speed_m_s: float
    #: scene with all changes of the model so far
    scene: Scene


class Walker:
    """Advance a session by many samples at a time, write its journal and outputs to `writer`, and pass the rows on.

    Only the walker may change the session. `on_walked` receives the rows of each batch.
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
        self.speed_m_s = 0.0
        self._opening: Snapshot | None = session.snapshot()

    def _open(self, log_time_ns: int) -> None:
        opening, self._opening = self._opening, None
        if opening is not None:
            self._sequence += 1
            if self._writer is not None:
                self._writer.write_entry(self._sequence, log_time_ns, opening)

    def _entry(self, entry: Entry) -> None:
        self._open(self._log_time_ns)
        self._sequence += 1
        if self._writer is not None:
            self._writer.write_entry(self._sequence, self._log_time_ns, entry)

    def apply(self, entry: Entry, log_time_ns: int = 0) -> None:
        """Apply an entry other than a sample."""
        self._log_time_ns = log_time_ns or self._log_time_ns
        self._entry(entry)
        self.session.apply(entry)
        if isinstance(entry, Reset | SetWear | Restore):
            self.on_reset()

    def samples(self, stamp_ns: NDArray[np.int64], wrench: NDArray[np.float64], log_time_ns: NDArray[np.int64]) -> None:
        """Apply samples whose stamps do not fall."""
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
        scene = self.session.twin.scene
        self._on_walked(Walked(stamp_ns, wrench, rows, done.published, makes, self.speed_m_s, scene))
        if count >= _FAILURE_LIMIT and rows.status[-_FAILURE_LIMIT:].all():
            self.apply(Reset(int(stamp_ns[-1]), f"{_FAILURE_LIMIT} failed advances"), int(log_ns[-1]))

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
        """End the journal."""
        if self.session.stamp_ns is not None:
            self._entry(Digest(self.session.stamp_ns, self.session.twin.digest()))


class JournalWalk:
    """Pass the journal of a run through walkers of its scene (`own`) and of other scenes (`others`).

    `used` and `late` count samples; a late sample is sorted in unless the walkers have passed its stamp. `missing`
    counts missing entries; after each gap a new part of the motion begins.

    The walkers `own` take over the state in the journal after a loss, and after wear was set. If `same_scene` is set,
    their scene is that of the run: they also apply changes of the model and restored motions, and measurements if their
    twin follows these. Unless the journal is `whole`, its first snapshot is restored.
    """

    def __init__(
        self, own: Sequence[Walker], others: Sequence[Walker], *, whole: bool = True, same_scene: bool = True
    ) -> None:
        self._own, self._all = own, (*own, *others)
        self._same = own if same_scene else ()
        self._following = [walker for walker in self._same if walker.session.following is not None]
        self._acting = (*_ACTING, *_FOLLOWED) if self._following else _ACTING
        #: speeds whose stamps have not been reached, in order of the stamps
        self._travels: list[Travel] = []
        self._lost = not whole
        self._reached_ns = -1
        self.used = self.late = self.missing = 0
        self._holes = Holes()

    def add(self, entries: Entries) -> None:
        """Process entries."""
        begin = 0
        for place, count in self._holes.find(entries).items():
            self._whole(entries[begin:place])
            self._hole(count)
            begin = place
        self._whole(entries[begin:])

    def _hole(self, count: int) -> None:
        """Begin a new part of the motion: no load is interpolated over missing entries."""
        self.missing += count
        self._entry(Loss(count))

    def _whole(self, entries: Entries) -> None:
        stamps, wrench, begin = entries.stamp_ns, entries.wrench, 0
        acting = sorted(place for place, entry in entries.rest.items() if isinstance(entry, self._acting))
        for place in (*acting, len(entries)):
            samples = begin + np.flatnonzero(entries.sample[begin:place])
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
            if self._travels:  # a speed acts from its stamp on
                count = int(np.searchsorted(stamps, self._travels[0].stamp_ns, "right"))
            if count:
                self._reached_ns = int(stamps[count - 1])
                for walker in self._all:
                    walker.samples(stamps[:count], wrench[:count], stamps[:count])
                stamps, wrench = stamps[count:], wrench[count:]
            if len(stamps):
                self._speed(self._travels.pop(0).speed_m_s)

    def _speed(self, speed_m_s: float) -> None:
        for walker in self._all:
            walker.speed_m_s = speed_m_s
            # a speed with a stamp that is already reached acts at once
            walker.apply(Travel(max(0, self._reached_ns), speed_m_s))

    def _begin_anew(self) -> None:
        for travel in self._travels:
            self._speed(travel.speed_m_s)
        self._travels, self._reached_ns = [], -1

    def _entry(self, entry: Entry | Dropped) -> None:
        match entry:
            case Travel(stamp_ns, speed) if 0 <= self._reached_ns < stamp_ns:
                insort(self._travels, entry, key=lambda travel: travel.stamp_ns)
            case Travel(_, speed):
                self._speed(speed)
            case Reset() | Loss():
                self._begin_anew()
                for walker in self._all:
                    walker.apply(Reset(0, "loss") if isinstance(entry, Loss) else entry)
            case Restore():
                self._begin_anew()
                for walker in self._all:
                    walker.apply(entry if walker in self._same else Reset(0, "restore"))
            case SetModel():
                for walker in self._same:
                    walker.apply(entry)
            case Pose() | PartOfPose() | Estimated() | Parameter():
                for walker in self._following:
                    walker.apply(entry)
            case Snapshot() if self._lost:
                for walker in self._own:
                    walker.apply(entry)
                    self._reached_ns = walker.session.stamp_ns or -1
            case SetWear():
                for walker in self._all:
                    walker.apply(entry) if walker in self._own else walker.on_reset()
        self._lost = isinstance(entry, Loss) or (self._lost and not isinstance(entry, Snapshot))
