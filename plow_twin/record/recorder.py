"""The recorder of a live node: takes entries and messages without ever waiting, writes them in a thread of its own.

The caller's cost is a clock reading and an append. When the thread falls behind, what does not fit in the queue is
dropped, counted by topic, and noted in the file at the place where it is missing.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Final, Self

from plow_twin.record.header import RunHeader
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import Message
from plow_twin.stream.journal import Entry, Loss, Snapshot

if TYPE_CHECKING:
    from plow_twin.record.writer import RunWriter

#: Key of the journal in the loss counters.
JOURNAL: Final = "journal"
#: The thread looks at the queue that often [s].
_POLL_S: Final = 0.01
#: The thread sleeps after each so many items, so that a caller that waits for the interpreter gets it then and not
#: after its switch interval of 5 ms. Releasing it without sleep does not do: the thread would take it back at once.
_BURST: Final = 4


@dataclass(frozen=True)
class RecorderCounters:
    """How a recorder is doing. `lost` counts by topic what did not reach the file; its journal is under `journal`."""

    written: int
    queued: int
    bytes_written: int
    lost: Mapping[str, int]
    error: str | None


@dataclass(frozen=True)
class LossReport:
    """How a recording ended: what was lost by topic, whether the file was closed, and the error that stopped it."""

    lost: Mapping[str, int]
    closed: bool
    error: str | None

    @property
    def complete(self) -> bool:
        """Nothing was lost and the file has its index."""
        return self.closed and not self.lost and self.error is None


class Recorder:
    """Record a run to the folder `path`.

    Parameters
    ----------
    path
        Folder to make, e.g. `runs/monday`; the file is `runs/monday/monday_0.mcap`.
    header
        What replay needs besides the journal.
    queue_size
        Items waiting for the thread; the last quarter is kept for the journal.
    flush_period_s
        A killed process loses at most what came in that time [s].
    chunk_size
        Bytes [B] in one compressed chunk.
    min_free_bytes
        Recording stops when the disk has less free space [B].
    now_ns
        Receive times [ns], read in the caller's thread.
    on_error
        Called once, from the recorder's thread, with the reason when recording stops early.

    Raises
    ------
    RecordingError
        The folder holds something already or cannot be made.
    """

    def __init__(
        self,
        path: Path,
        header: RunHeader,
        *,
        queue_size: int = 20_000,
        flush_period_s: float = 1.0,
        chunk_size: int = 64 * 1024,
        min_free_bytes: int = 64 * 1024 * 1024,
        now_ns: Callable[[], int] = time.time_ns,
        on_error: Callable[[str], None] | None = None,
    ) -> None:
        from plow_twin.record.writer import RunWriter

        self._writer = RunWriter(Path(path), header, chunk_size, min_free_bytes)
        self.path = self._writer.path
        self._queue: deque[_EntryItem | _OutputItem] = deque()
        self._queue_size = queue_size
        self._flush_period_s = flush_period_s
        self._now_ns = now_ns
        self._on_error = on_error
        self._lock = threading.Lock()  # held for microseconds; the thread never writes while it holds it
        self._sequence = -1
        self._journal_gap = 0
        self._snapshot_due = False
        self._output_gaps: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()
        self._unflushed: Counter[str] = Counter()  # written, but not yet safe
        self._written = 0
        self._error: str | None = None
        self._closed = False
        self._accepting = True
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plow_twin recorder", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    @property
    def snapshot_wanted(self) -> bool:
        """Something was lost and there is room again: journal a `Snapshot` now so that replay can go on from it."""
        return self._snapshot_due and self._accepting and len(self._queue) < self._queue_size // 2

    @property
    def counters(self) -> RecorderCounters:
        """Counters as of now."""
        with self._lock:
            lost = dict(self._lost)
        return RecorderCounters(self._written, len(self._queue), self._writer.bytes_written, lost, self._error)

    def journal(self, entry: Entry) -> bool:
        """Take a journal entry; False when it was lost.

        After a loss all entries but a `Snapshot` are refused: without the state they would be of no use to replay.
        """
        now = self._now_ns()
        with self._lock:
            snapshot = isinstance(entry, Snapshot)
            if (self._journal_gap == 0 or snapshot) and self._room(2 if self._journal_gap else 1, self._queue_size):
                if self._journal_gap:
                    self._push_entry(now, Loss(self._journal_gap))
                    self._journal_gap = 0
                self._push_entry(now, entry)
                self._snapshot_due = self._snapshot_due and not snapshot
                return True
            self._snapshot_due = True
            if not (self._journal_gap and snapshot):
                self._sequence += 1  # a lost entry leaves its number free: messages sent meanwhile point to it
                self._journal_gap += 1
                self._lost[JOURNAL] += 1
            return False

    def output(self, topic: str, stamp_ns: int, message: Message) -> bool:
        """Take a message that was sent on the resolved name `topic` for time `stamp_ns`; False when it was lost."""
        now = self._now_ns()
        with self._lock:
            if self._room(2, self._queue_size * 3 // 4):
                gap = self._output_gaps.pop(topic, 0)
                if gap:
                    self._push_entry(now, Dropped(topic, gap))
                self._queue.append(_OutputItem(self._sequence, now, topic, stamp_ns, message))
                return True
            self._snapshot_due = True
            self._output_gaps[topic] += 1
            self._lost[topic] += 1
            return False

    def _room(self, items: int, limit: int) -> bool:
        return self._accepting and len(self._queue) + items <= limit

    def _push_entry(self, now: int, entry: Entry | Dropped) -> None:
        self._sequence += 1
        self._queue.append(_EntryItem(self._sequence, now, entry))

    def close(self, timeout_s: float = 5.0) -> LossReport:
        """Write what is queued, close the file and say what was lost; waits at most `timeout_s` [s].

        A second call only returns the report.
        """
        atexit.unregister(self.close)
        with self._lock:
            if self._accepting:
                now = self._now_ns()
                self._accepting = False
                for topic, count in self._output_gaps.items():
                    self._push_entry(now, Dropped(topic, count))
                if self._journal_gap:
                    self._push_entry(now, Loss(self._journal_gap))
        self._stopping.set()
        self._thread.join(timeout_s)
        with self._lock:
            error = self._error
            if error is None and not self._closed:
                error = f"{self.path}: not closed within {timeout_s:g} s, {len(self._queue)} item(s) unwritten"
            return LossReport(dict(self._lost), self._closed, error)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        try:
            reason = None
            next_flush = time.monotonic()
            stopping = False
            while not stopping and reason is None:
                stopping = self._stopping.wait(_POLL_S)
                self._drain()
                if time.monotonic() >= next_flush:
                    reason = self._flush()
                    next_flush = time.monotonic() + self._flush_period_s
            if reason is not None:
                self._give_up(reason)
            with self._lock:  # callers go on counting what they lose
                lost = dict(self._lost)
            self._writer.close(lost, reason)
            self._closed = True
        except Exception as error:  # whatever it is: the twin goes on without its recorder
            self._give_up(str(error), self._unflushed)
            self._writer.abandon()

    def _drain(self) -> None:
        backlog = len(self._queue)
        burst = _BURST if backlog < self._queue_size // 10 else 16 * _BURST
        for index in range(backlog):
            item = self._queue.popleft()
            self._unflushed[item.key] += 1
            item.write(self._writer)
            self._written += 1
            if index % burst == 0:
                time.sleep(1e-6)

    def _flush(self) -> str | None:
        self._writer.flush()
        self._unflushed.clear()
        return self._writer.reason_to_stop()

    def _give_up(self, reason: str, unsafe: Mapping[str, int] = MappingProxyType({})) -> None:
        """Stop taking in, count as lost what is queued and what is `unsafe`, by topic, and say so once."""
        first = self._error is None
        with self._lock:
            self._accepting = False
            self._error = self._error or f"{self.path}: recording stopped: {reason}"
            unwritten, self._queue = self._queue, deque()
            self._lost.update(unsafe)
            self._lost.update(item.key for item in unwritten)
        if first and self._on_error is not None:
            self._on_error(self._error)


@dataclass(frozen=True, slots=True)
class _EntryItem:
    """A journal entry on its way to the file."""

    sequence: int
    log_time_ns: int
    entry: Entry | Dropped

    @property
    def key(self) -> str:
        return JOURNAL

    def write(self, writer: RunWriter) -> None:
        writer.write_entry(self.sequence, self.log_time_ns, self.entry)


@dataclass(frozen=True, slots=True)
class _OutputItem:
    """A message on its way to the file."""

    sequence: int
    log_time_ns: int
    key: str
    stamp_ns: int
    message: Message

    def write(self, writer: RunWriter) -> None:
        writer.write_output(self.key, self.sequence, self.log_time_ns, self.stamp_ns, self.message)
