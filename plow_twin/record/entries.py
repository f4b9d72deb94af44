"""Records of a recording, as single objects and in batches of arrays.

A record is a journal entry or an output, that is, a message that the twin sent.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import decode
from plow_twin.record.chunks import Messages
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import DiagnosticStatus, Message
from plow_twin.record.template import Indexes, compiled
from plow_twin.stream.journal import Digest, Entry, Sample

_HALF, _WHOLE = 2**31, 2**32
#: Names of the arrays of `Entries` with a value for each entry.
_COLUMNS: Final = ("sequence", "log_time_ns", "sample", "stamp_ns", "wrench")


@dataclass(frozen=True, slots=True)
class EntryRecord:
    """A journal entry, or a note of the recorder about lost messages, with its sequence number."""

    sequence: int
    log_time_ns: int
    entry: Entry | Dropped


@dataclass(frozen=True, slots=True)
class OutputRecord:
    """A message that the twin sent.

    `sequence` is the sequence number of the journal entry before the message, and `data` contains the CDR bytes.
    """

    sequence: int
    log_time_ns: int
    publish_time_ns: int
    topic: str
    message_type: str
    data: bytes

    def message(self) -> Message:
        """Return the decoded message."""
        return decode(self.data, self.message_type)


@dataclass(frozen=True)
class Entries:
    """Journal entries in the order in which the twin used them.

    A sample is a load at a time. A digest is a hash of the exact state of the twin.
    """

    #: sequence number of each entry, without the wrap at 2^32, shape (n,)
    sequence: Indexes
    #: receive time of each entry, shape (n,)
    log_time_ns: Indexes
    #: whether an entry is a sample of the load, shape (n,)
    sample: NDArray[np.bool_]
    #: stamp of each sample and digest, shape (n,)
    stamp_ns: Indexes
    #: load of each sample [N, N, N m], shape (n, 3)
    wrench: NDArray[np.float64]
    #: index of each digest in the arrays of shape (n,), shape (m,)
    digest_at: Indexes
    #: value of each digest, shape (m,)
    digest: NDArray[np.uint64]
    #: entries that are neither samples nor digests, by index
    rest: Mapping[int, Entry | Dropped]

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, chosen: slice) -> Entries:
        first, last, _ = chosen.indices(len(self))
        begin, end = np.searchsorted(self.digest_at, (first, last)).tolist()
        rest = {index - first: entry for index, entry in self.rest.items() if first <= index < last}
        digest_at, digest = self.digest_at[begin:end] - first, self.digest[begin:end]
        columns = {name: getattr(self, name)[chosen] for name in _COLUMNS}
        return replace(self, digest_at=digest_at, digest=digest, rest=rest, **columns)

    def samples(self) -> tuple[Indexes, NDArray[np.float64]]:
        """Return the stamps and wrenches of the samples."""
        places = np.flatnonzero(self.sample)
        # selection by indices is five times as fast as selection by a mask
        return self.stamp_ns[places], self.wrench.take(places, axis=0)

    @cached_property
    def others(self) -> Mapping[int, Entry | Dropped]:
        """All entries that are not samples, by index."""
        stamps = self.stamp_ns[self.digest_at].tolist()
        digests: dict[int, Entry | Dropped] = {
            index: Digest(stamp_ns, f"{digest:016x}")
            for index, stamp_ns, digest in zip(self.digest_at.tolist(), stamps, self.digest.tolist(), strict=True)
        }
        return digests | dict(self.rest)

    def record(self, index: int) -> EntryRecord:
        """Return the entry at `index` as a record."""
        entry: Entry | Dropped
        if self.sample[index]:
            fx, fy, moment = self.wrench[index].tolist()
            entry = Sample(int(self.stamp_ns[index]), (fx, fy, moment))
        else:
            entry = self.others[index]
        return EntryRecord(int(self.sequence[index]) % _WHOLE, int(self.log_time_ns[index]), entry)

    @classmethod
    def joined(cls, parts: list[Entries]) -> Entries:
        """Return one series with the entries of all parts."""
        if len(parts) == 1:
            return parts[0]
        begins = np.cumsum([0, *map(len, parts)]).tolist()
        placed = list(zip(begins, parts, strict=False))
        digest_at = np.concatenate([begin + part.digest_at for begin, part in placed])
        rest = {begin + index: entry for begin, part in placed for index, entry in part.rest.items()}
        columns = dict(zip((*_COLUMNS, "digest"), concatenated(parts, *_COLUMNS, "digest"), strict=True))
        return cls(digest_at=digest_at, rest=rest, **columns)


def concatenated(parts: Sequence[Any], *names: str) -> list[Any]:
    """Return the concatenation of the attribute with each name in all parts."""
    return [np.concatenate([getattr(part, name) for part in parts]) for name in names]


_NONE: Final = np.zeros(0, np.int64)
NO_ENTRIES: Final = Entries(_NONE, _NONE, np.zeros(0, bool), _NONE, np.zeros((0, 3)), _NONE, np.zeros(0, np.uint64), {})


@dataclass(frozen=True)
class Outputs:
    """Messages of one chunk that the twin sent.

    `sequence` is the sequence number of each message without the wrap at 2^32, and `topics` maps the number of each
    channel to its topic and message type.
    """

    messages: Messages
    sequence: Indexes
    topics: Mapping[int, tuple[str, str]]

    def __len__(self) -> int:
        return len(self.sequence)

    @cached_property
    def newest(self) -> int:
        """The highest sequence number. There must be at least one message."""
        return int(self.sequence.max())

    def __getitem__(self, chosen: slice) -> Outputs:
        return Outputs(self.messages[chosen], self.sequence[chosen], self.topics)

    def on(self, topics: Container[str]) -> Iterator[OutputRecord]:
        """Yield the records of the given topics, one topic after another."""
        for channel in [number for number, (topic, _) in self.topics.items() if topic in topics]:
            yield from map(self.record, np.flatnonzero(self.messages.channel == channel).tolist())

    def record(self, index: int) -> OutputRecord:
        """Return the message at `index` as a record."""
        messages = self.messages
        topic, message_type = self.topics[int(messages.channel[index])]
        return OutputRecord(
            int(self.sequence[index]) % _WHOLE,
            int(messages.log_time_ns[index]),
            int(messages.publish_time_ns[index]),
            topic,
            message_type,
            messages.data(index),
        )


@dataclass(frozen=True)
class Batch:
    """Journal entries, and the outputs that the twin sent after these entries and before the next batch.

    If a chunk since the previous batch could not be read, `damaged` is True, and any record of this batch may be
    missing.
    """

    entries: Entries
    outputs: list[Outputs]
    damaged: bool = False

    def parted(self, places: Sequence[int]) -> Iterator[Batch]:
        """Split the batch before the entries at the indexes `places`, which must ascend, and yield the pieces."""
        outputs, begin = self.outputs, 0
        for place in places:
            now, outputs = parted_at(outputs, int(self.entries.sequence[place]))
            yield Batch(self.entries[begin:place], now, self.damaged)
            begin = place
        yield Batch(self.entries[begin:], outputs, self.damaged)


class Holes:
    """Find missing journal entries, batch by batch, by the sequence numbers of the entries."""

    def __init__(self) -> None:
        self._next: int | None = None

    def find(self, entries: Entries) -> dict[int, int]:
        """Return the number of entries that are missing before each entry that follows a gap.

        The keys are the indexes of the entries, in ascending order.
        """
        if not len(entries):
            return {}
        reached = np.maximum.accumulate(entries.sequence) + 1
        start = int(entries.sequence[0]) if self._next is None else self._next
        expected = np.maximum(np.concatenate(([start], reached[:-1])), start)
        self._next = max(start, int(reached[-1]))
        places = np.flatnonzero(entries.sequence > expected)
        return dict(zip(places.tolist(), (entries.sequence - expected)[places].tolist(), strict=True))


def parted_at(outputs: Sequence[Outputs], end: int) -> tuple[list[Outputs], list[Outputs]]:
    """Split messages into those with sequence numbers below `end` and those with higher or equal numbers."""
    before, after = [], []
    for part in outputs:
        place = len(part) if part.newest < end else int((part.sequence >= end).argmax())
        before += [part[:place]] if place else []
        after += [part[place:]] if place < len(part) else []
    return before, after


def first_difference(record: OutputRecord, computed: Message) -> tuple[str, str, str]:
    """Return the first field in which two messages differ, with the recorded and the computed value of the field."""
    try:
        recorded = record.message()
    except RecordingError:
        return "encoding", "bytes that are not a message", "a message"
    if type(recorded) is not type(computed):
        return "type", record.message_type, computed.TYPE
    if isinstance(recorded, DiagnosticStatus) and isinstance(computed, DiagnosticStatus):
        for (name, old), (key, new) in zip(recorded.values, computed.values, strict=False):
            if (name, old) != (key, new):
                return key, old if key == name else name, new
    for name in type(computed).__dataclass_fields__:
        old, new = getattr(recorded, name), getattr(computed, name)
        if isinstance(new, np.ndarray) and np.shape(old) == np.shape(new):
            places = np.flatnonzero(np.asarray(old).view(np.int64) != new.view(np.int64))
            if places.size:
                place = int(places[0])
                return f"{name}[{place}]", repr(float(old[place])), repr(float(new[place]))
        elif repr(old) != repr(new):
            return name, repr(old), repr(new)
    return "encoding", "these bytes", "other bytes for the same values"


@compiled
def unwrap(sequence: Indexes, base: int, out: Indexes) -> None:
    """Unwrap 32-bit sequence numbers: `out` receives the value nearest to `base` with the same lower 32 bits."""
    for n in range(sequence.size):
        out[n] = base + ((sequence[n] - base + _HALF) & (_WHOLE - 1)) - _HALF
