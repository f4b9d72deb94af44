"""The recorder of a live node.

Callers put journal entries and publications in a queue, and never wait for the disk. A thread empties the queue every
50 ms and writes the items to the file. If the thread is too slow, items that do not fit in the queue are dropped.
Dropped items are counted by topic, and a note in the file marks the place of each loss.

A *ring* is a recording of the last seconds of a run in memory. The method `Recorder.mark` writes the ring to the disk.
"""

from __future__ import annotations

import atexit
import errno
import shlex
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError, TakenError
from plow_twin.record.header import JOURNAL, RunHeader
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import Message
from plow_twin.stream.journal import Entry, Loss, Sample, Snapshot
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Series
from plow_twin.stream.topics import Cadence, names_of

if TYPE_CHECKING:
    from plow_twin.record.ring import RingWriter
    from plow_twin.record.writer import RunWriter

#: Interval at which the thread empties the queue [s].
_POLL_S: Final = 0.05
#: Error numbers of a full disk. These errors only pause the recording, because space may become free.
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
#: Number of items after which the thread sleeps for a moment, so that the twin can acquire the interpreter lock.
_BURST: Final = 128


@dataclass(frozen=True)
class RecorderCounters:
    """State of a recorder: numbers of items, and of rings (the last seconds of a run).

    The key of lost journal entries in `lost` is `journal`. `error` is the reason why recording stopped, or why the last
    ring was not written.
    """

    written: int
    queued: int
    bytes_written: int
    lost: Mapping[str, int]
    error: str | None
    marks: int = 0
    marks_lost: int = 0


@dataclass(frozen=True)
class LossReport:
    """Losses of a recording by topic, whether the file was closed, and the error that stopped the recording."""

    lost: Mapping[str, int]
    closed: bool
    error: str | None

    @property
    def complete(self) -> bool:
        """Whether the file was closed and nothing was lost."""
        return self.closed and not self.lost and self.error is None

    def sentence(self, folder: Path) -> str:
        """Return a text with the losses and with the commands that show and repair the recording in `folder`."""
        lacks = [f"{count} lost of {topic}" for topic, count in self.lost.items()]
        if self.error is not None:
            lacks.append(self.error)
        quoted = shlex.quote(str(folder))
        remedy = f"plow-twin info {quoted} shows its content"
        if not self.closed:
            lacks.append("its last file has no end")
            remedy += f", plow-twin doctor --repair {quoted} completes its files"
        return f"the recording {folder} is incomplete: {'; '.join(lacks)}. {remedy}"


class Recorder:
    """Record a run to the folder `path`.

    In the folder `runs/monday`, the first file is `runs/monday/monday_0.mcap`. The last quarter of the queue is
    reserved for journal entries. If the process is killed, journal entries of up to `flush_period_s` [s] are lost, and
    messages of up to twice this time. A chunk is written when it has `chunk_size` [B]. If the disk has less than
    `min_free_bytes` [B], recording pauses.

    A new part (file) is started after `part_bytes` [B] or `part_s` [s]. The oldest parts are removed while the
    completed parts have more than `keep_bytes` [B]. With 0, these three are not limited. With `ring_s` [s], the
    recorder has a ring of this duration, and does not write all data to the disk. With `sync`, written data survive a
    loss of power.

    `now_ns` returns the receive time [ns], in the thread of the caller. `on_error` receives the reason when recording
    stops early, once, in the thread of the recorder. Raise `RecordingError` if the folder is not empty or cannot be
    created.
    """

    def __init__(
        self,
        path: Path,
        header: RunHeader,
        *,
        queue_size: int = 20_000,
        flush_period_s: float = 0.5,
        chunk_size: int = 1024 * 1024,
        min_free_bytes: int = 64 * 1024 * 1024,
        part_bytes: int = 0,
        part_s: float = 0.0,
        keep_bytes: int = 0,
        ring_s: float = 0.0,
        sync: bool = False,
        now_ns: Callable[[], int] = time.time_ns,
        on_error: Callable[[str], None] | None = None,
    ) -> None:
        from plow_twin.record.writer import RunWriter, warm_up_writer

        warm_up_writer(header)
        self._folder = Path(path)
        self._ring: RingWriter | None = None
        self._ring_s = ring_s
        if ring_s:
            from plow_twin.record.ring import PARTS, RingWriter

            self._ring = RingWriter(self._folder, header, chunk_size, min_free_bytes, ring_s, sync_dumps=sync)
            part_bytes, part_s, keep_bytes = 0, ring_s / PARTS, 0
        self._writer = self._ring or RunWriter(self._folder, header, chunk_size, min_free_bytes, sync=sync)
        self.path = self._writer.path
        self._mark: Path | None = None  # folder to which the ring will be written
        self._marks = self._marks_lost = 0
        self._mark_error: str | None = None
        each, slow, marked = (
            tuple(map(header.topic, names_of(cadence))) for cadence in (Cadence.EACH, Cadence.SLOW, Cadence.MARKED)
        )
        if header.follow == "full":
            each += tuple(map(header.topic, names_of(Cadence.FOLLOWED)))
        #: topics of a publication; the key states whether the publication has a slow part, and whether it is marked
        self._topics_of = {
            (False, False): each, (True, False): each + slow, (False, True): each + marked,
            (True, True): each + slow + marked,
        }  # fmt: skip
        self._limits = (part_bytes, part_s, keep_bytes)
        self._split_due = False
        self._part_since = time.monotonic()
        self._queue: deque[_Item] = deque()
        #: number of entries and publications in the queue beyond one for each item
        self._more = 0
        self._queue_size = queue_size
        self._flush_period_s = flush_period_s
        self._now_ns = now_ns
        self._on_error = on_error
        self._lock = threading.Lock()  # the thread releases this lock before it writes to the disk
        self._sequence = -1
        self._journal_gap = 0
        self._snapshot_due = False
        self._output_gaps: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()
        #: numbers of messages that the writer has received since the last flush, and of messages in the files then
        self._unflushed: Counter[str] = Counter()
        self._flushed: Counter[str] = Counter()
        self._sync = sync
        self._written = 0
        self._error: str | None = None
        self._paused: str | None = None
        self._closed = False
        self._accepting = True
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plow_twin recorder", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    @property
    def snapshot_wanted(self) -> bool:
        """Whether the caller should add a `Snapshot` to the journal, because of a loss or the end of a part."""
        if not (self._snapshot_due or self._split_due):
            return False
        return self._accepting and not self._paused and self._queued < self._queue_size // 2

    @property
    def counters(self) -> RecorderCounters:
        """The current state of the recorder."""
        with self._lock:
            lost = dict(self._lost)
            error = self._error or self._mark_error
            marks = self._marks, self._marks_lost
        return RecorderCounters(self._written, self._queued, self._writer.bytes_written, lost, error, *marks)

    def mark(self) -> Path | None:
        """Request that the ring is written to a new folder. Return the folder, or None if the recorder has no ring.

        The ring is written before the next `Snapshot` in the journal, or when the recorder is closed. Until then,
        further calls have no effect.
        """
        from plow_twin.record.writer import free_folder

        if self._ring is None:
            return None
        with self._lock:
            if self._mark is None:
                self._mark, self._split_due = free_folder(self._folder), True
            return self._mark

    def journal(self, entry: Entry) -> bool:
        """Add a journal entry to the queue; return False if the entry is lost.

        After a loss, all entries are refused until a `Snapshot` arrives, because a replay can continue only from a
        snapshot.
        """
        now = self._now_ns()
        with self._lock:
            snapshot = isinstance(entry, Snapshot)
            if not (snapshot or self._journal_gap) and self._room(1, self._queue_size):
                self._push_entry(now, entry)
                return True
            notes = len(self._output_gaps) if snapshot else 0
            room = self._room(notes + (2 if self._journal_gap else 1), self._queue_size)
            if (self._journal_gap == 0 or snapshot) and room:
                if self._journal_gap:
                    self._push_entry(now, Loss(self._journal_gap))
                    self._journal_gap = 0
                # notes of losses are written before the snapshot, so that a replay can compare all later messages
                if snapshot:
                    self._push_notes(now)
                self._push_entry(now, entry)
                self._snapshot_due = self._snapshot_due and not snapshot
                self._split_due = self._split_due and not snapshot
                return True
            self._snapshot_due = True
            if not (self._journal_gap and snapshot):
                self._sequence += 1  # a lost entry uses up a number, because messages refer to the number
                self._journal_gap += 1
                self._lost[JOURNAL] += 1
            return False

    def output(self, topic: str, stamp_ns: int, message: Message) -> bool:
        """Add a message that was sent on `topic`, a resolved name, to the queue; return False if it is lost."""
        now = self._now_ns()
        with self._lock:
            if fits := self._admitted(now, 2, (topic,)):
                place = topic, self._sequence, now, stamp_ns, message
                self._queue.append(_Call(lambda writer: writer.write_output(*place), {topic: 1}))
        return fits

    def publication(self, published: Published, sent: Mapping[str, bytes] = MappingProxyType({})) -> bool:
        """Add the messages of a publication with one row to the queue; return False if the messages are lost.

        `sent` maps the base names of the topics to the bytes of the messages. If it is empty, the recorder encodes the
        messages of all topics that a replay can compute.
        """
        now = self._now_ns()
        topics = self._topics_of[len(published.slow) > 0, bool(sent) and bool(published.rows["marked"][0])]
        with self._lock:
            if fits := self._admitted(now, 1 + len(self._topics_of[True, True]), topics):
                self._queue.append(_PublicationItem(self._sequence, now, published, sent, topics))
        return fits

    def series(self, series: Series) -> NDArray[np.int64]:
        """Add the samples and digests of a series to the queue as journal entries. The queue accepts all or none.

        Return the sequence number for the publication after each sample, shape (n,): the number of the sample or, if a
        digest follows the sample, the number of the digest.
        """
        now, samples = self._now_ns(), len(series.stamps)
        count = samples + len(series.digests)
        with self._lock:
            first = self._sequence + 1
            if self._journal_gap == 0 and self._room(count, self._queue_size):
                self._push_many(lambda writer: _write_series(writer, first, now, series), {JOURNAL: count}, count)
            else:
                self._snapshot_due = True
                self._journal_gap += count
                self._lost[JOURNAL] += count
            self._sequence += count
        ends = np.zeros(samples, np.int64)
        ends[series.digest_after - 1] = 1
        return first + np.arange(samples) + np.cumsum(ends)

    def publications(self, published: Published, sequence: NDArray[np.int64]) -> bool:
        """Add publications that the node has not sent to the queue; return False if the publications are lost.

        `sequence`, shape (n,), is the number of the journal entry before each publication.
        """
        now, count = self._now_ns(), len(published.rows)
        log_times = np.full(count, now, np.int64)
        topics = Counter(dict.fromkeys(self._topics_of[False, False], count))
        topics.update(dict.fromkeys(set(self._topics_of[True, False]) - topics.keys(), len(published.slow)))
        with self._lock:
            if fits := self._admitted(now, count + len(topics), topics):
                self._push_many(lambda writer: writer.write_publications(sequence, log_times, published), topics, count)
        return fits

    def _admitted(self, now: int, items: int, topics: Iterable[str]) -> bool:
        """Return whether the queue has space for messages on `topics`.

        If the queue has space, notes about earlier losses on the topics are queued. If it has no space, the messages
        are counted as lost.
        """
        if not self._room(items, self._queue_size * 3 // 4):
            self._snapshot_due = True
            self._output_gaps.update(topics)
            self._lost.update(topics)
            return False
        for topic in topics if self._output_gaps else ():
            if gap := self._output_gaps.pop(topic, 0):
                self._push_entry(now, Dropped(topic, gap))
        return True

    def _room(self, items: int, limit: int) -> bool:
        return self._accepting and not self._paused and self._queued + items <= limit

    @property
    def _queued(self) -> int:
        return len(self._queue) + self._more

    def _push_many(self, write: Callable[[RunWriter], object], keys: Mapping[str, int], count: int) -> None:
        self._more += count - 1
        self._queue.append(_Call(write, keys, count))

    def _push_entry(self, now: int, entry: Entry | Dropped) -> None:
        self._sequence += 1
        self._queue.append(_EntryItem(self._sequence, now, entry))

    def _push_notes(self, now: int) -> None:
        for topic, count in self._output_gaps.items():
            self._push_entry(now, Dropped(topic, count))
        self._output_gaps.clear()

    def close(self, timeout_s: float = 5.0) -> LossReport:
        """Write the queued items, close the file and return the losses. Any further call only returns the losses.

        If the thread writes no item within `timeout_s` [s], the method returns although the file is not closed.
        """
        atexit.unregister(self.close)
        with self._lock:
            if self._accepting:
                now = self._now_ns()
                self._accepting = False
                self._push_notes(now)
                if self._journal_gap:
                    self._push_entry(now, Loss(self._journal_gap))
        self._stopping.set()
        before = None
        while self._thread.is_alive() and before != (before := (self._written, self._queued)):
            self._thread.join(timeout_s)
        with self._lock:
            error = self._error or self._mark_error
            if error is None and not self._closed:
                error = f"no data were written for {timeout_s:g} s, {self._queued} messages and entries are unwritten"
            return LossReport(dict(self._lost), self._closed, error)

    def _run(self) -> None:
        try:
            reason = None
            next_flush = time.monotonic()
            stopping = False
            while not stopping and reason is None:
                stopping = self._stopping.wait(_POLL_S)
                try:
                    self._drain()
                    if time.monotonic() >= next_flush:
                        reason = self._flush()
                        next_flush = time.monotonic() + self._flush_period_s
                except OSError as error:
                    if error.errno not in _FULL:
                        raise
                    self._pause(error.strerror or str(error))
            if reason is not None:
                self._give_up(reason)
            if self._mark is not None:
                self._split()
            with self._lock:  # other threads may still change the counters
                lost = dict(self._lost)
            self._writer.close(lost, reason or self._paused)
            self._closed = True
        except Exception as error:  # the twin continues without a recorder after any error
            self._give_up(str(error), self._unsafe())
            self._writer.abandon()

    def _drain(self) -> None:
        backlog = len(self._queue)
        while backlog > 0:
            items = [self._queue.popleft() for _ in range(min(backlog, _BURST))]
            backlog -= len(items)
            _add_keys(self._unflushed, items)
            self._write(items)
            count = sum(item.size if isinstance(item, _Call) else 1 for item in items)
            self._written += count
            if count > len(items):
                with self._lock:
                    self._more -= count - len(items)
            if backlog:
                time.sleep(1e-6)

    def _write(self, items: list[_Item]) -> None:
        """Write items in the order of the entries and of the outputs, consecutive items of one kind in one call."""
        samples: list[_EntryItem] = []
        publications: list[_PublicationItem] = []
        for item in items:
            if isinstance(item, _PublicationItem):
                publications.append(item)
            elif isinstance(item, _EntryItem) and isinstance(item.entry, Sample):
                samples.append(item)
            elif isinstance(item, _Call):
                samples, publications = self._write_samples(samples), self._write_publications(publications)
                item.write(self._writer)
            else:
                samples = self._write_samples(samples)
                if isinstance(item.entry, Snapshot) and (self._mark is not None or self._part_is_full()):
                    publications = self._write_publications(publications)
                    self._split()
                self._writer.write_entry(*item)
        # in the file, the chunk of samples precedes the chunk of the messages that were sent after the samples
        self._write_samples(samples)
        self._write_publications(publications)

    def _write_samples(self, items: list[_EntryItem]) -> list[_EntryItem]:
        if items:
            samples = [item.entry for item in items if isinstance(item.entry, Sample)]
            stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
            wrench = np.fromiter(chain.from_iterable(sample.wrench for sample in samples), np.float64, 3 * len(items))
            self._writer.write_samples(*_numbers(items), stamps, wrench.reshape(-1, 3))
        return []

    def _write_publications(self, items: list[_PublicationItem]) -> list[_PublicationItem]:
        sent = [item.sent for item in items]
        if items and all(sent):
            stamps = np.concatenate([item.published.rows["stamp_ns"] for item in items])
            self._writer.write_sent(*_numbers(items), stamps, sent)
        elif items:
            self._writer.write_publications(*_numbers(items), Published.joined([item.published for item in items]))
        return []

    def _part_is_full(self) -> bool:
        part_bytes, part_s, _ = self._limits
        full = bool(part_bytes) and self._writer.part_bytes >= part_bytes
        return full or (part_s > 0.0 and time.monotonic() - self._part_since >= part_s)

    def _split(self) -> None:
        """Start a new part. The caller writes a snapshot next, so that a replay can begin with this part."""
        with self._lock:
            lost = dict(self._lost)
        self._writer.split(lost, self._limits[2])
        self._part_since = time.monotonic()
        if self._ring is not None and self._mark is not None:
            error = None
            try:
                self._dump(self._ring, self._mark, lost)
            except (OSError, RecordingError) as failed:  # the ring stays in memory
                error = f"{self._mark}: the last {self._ring_s:g} s not written: {failed}"
            # `_mark` and the counts change under one lock, because a caller may read a count and then call `mark`
            with self._lock:
                self._mark = None
                if error is None:
                    self._marks += 1
                else:
                    self._marks_lost, self._mark_error = self._marks_lost + 1, error
            if error is not None and self._on_error is not None:
                self._on_error(error)

    def _dump(self, ring: RingWriter, folder: Path, lost: Mapping[str, int]) -> None:
        from plow_twin.record.writer import in_free_folder

        try:
            ring.dump(folder, lost)
        except TakenError:  # another process has created the folder in the meantime
            in_free_folder(self._folder, lambda other: ring.dump(other, lost))

    def _flush(self) -> str | None:
        self._writer.flush()
        self._unflushed.clear()
        self._flushed = self._writer.counts
        reason = self._writer.reason_to_stop()
        if reason is not None:  # the folder may not exist any more, so `shortage` could fail
            return reason
        if self._part_is_full():
            self._split_due = True
        shortage = self._writer.shortage()
        if shortage is not None and not self._paused:
            self._pause(shortage)
        elif shortage is None and self._paused:
            with self._lock:
                self._paused = self._error = None
        return None

    def _pause(self, reason: str) -> None:
        """Refuse items until the disk has enough space again; queued and unflushed items are lost."""
        with self._lock:
            first = not self._paused
            self._paused = reason
            self._error = f"{self.path}: recording stopped: {reason}"
            unwritten, self._queue, self._more = self._queue, deque(), 0
            self._lost.update(self._unsafe())
            _add_keys(self._lost, unwritten)
            # a note of an earlier loss may be lost too, so that its number must be noted again
            self._output_gaps = self._lost - self._writer.noted
            self._journal_gap = self._output_gaps.pop(JOURNAL, 0)
            self._snapshot_due = True
            error = self._error
        self._unflushed.clear()
        self._flushed = self._writer.counts
        if first and self._on_error is not None:
            self._on_error(error)

    def _unsafe(self) -> Counter[str]:
        """Return the numbers of messages that the writer has received since the last flush and that may be lost.

        With `sync`, a chunk is safe only after a flush. Otherwise a chunk that is in the file is safe.
        """
        return self._unflushed if self._sync else self._unflushed - (self._writer.counts - self._flushed)

    def _give_up(self, reason: str, unsafe: Mapping[str, int] = MappingProxyType({})) -> None:
        """Refuse all further items and report `reason`; queued items and the unflushed items `unsafe` are lost."""
        first = self._error is None
        with self._lock:
            self._accepting, self._paused = False, None
            self._error = self._error or f"{self.path}: recording stopped: {reason}"
            unwritten, self._queue, self._more = self._queue, deque(), 0
            self._lost.update(unsafe)
            _add_keys(self._lost, unwritten)
        if first and self._on_error is not None:
            self._on_error(self._error)


def _write_series(writer: RunWriter, first: int, log_time_ns: int, series: Series) -> None:
    digests = dict(zip(series.digest_after.tolist(), series.digests, strict=True))
    log_times = np.full(len(series.stamps), log_time_ns, np.int64)
    writer.write_series(first, log_times, series.stamps, series.wrench, digests)


def _numbers(items: Sequence[_EntryItem | _PublicationItem]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    sequence, log_time_ns, *_ = zip(*items, strict=True)
    return np.array(sequence, np.int64), np.array(log_time_ns, np.int64)


class _Call(NamedTuple):
    """A call of the writer.

    The attribute `keys`, which every kind of item has, contains the topics of the messages that are lost with the item,
    and `size` is the number of entries and publications of the item.
    """

    write: Callable[[RunWriter], object]
    keys: Mapping[str, int]
    size: int = 1


# A live node creates thousands of items each second, and a named tuple is created four times as fast as a frozen
# dataclass.
class _EntryItem(NamedTuple):
    sequence: int
    log_time_ns: int
    entry: Entry | Dropped

    @property
    def keys(self) -> tuple[str, ...]:
        return (JOURNAL,)


class _PublicationItem(NamedTuple):
    sequence: int
    log_time_ns: int
    published: Published
    sent: Mapping[str, bytes]
    keys: tuple[str, ...]


_Item: TypeAlias = _EntryItem | _PublicationItem | _Call


def _add_keys(counts: Counter[str], items: Iterable[_Item]) -> None:
    if any(isinstance(item, _Call) for item in items):
        for item in items:
            counts.update(item.keys)
    else:
        counts.update(chain.from_iterable(item.keys for item in items))
