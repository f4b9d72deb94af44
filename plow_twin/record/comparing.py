"""Compare the recorded messages of a run, byte for byte, with the messages that a replay computes.

The *kind* of a message is the index of its topic in `REPLAYED`, or -1 if `REPLAYED` does not contain the topic.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from plow_twin.record.chunks import Messages
from plow_twin.record.entries import OutputRecord, Outputs
from plow_twin.record.outputs import PUBLICATION_TOPICS, REPLAYED
from plow_twin.record.template import STAMP_AT, Indexes, Templates, compiled, stamp_word
from plow_twin.record.words import word, word_at
from plow_twin.stream.outputs import Published
from plow_twin.stream.topics import Cadence

_KINDS = len(REPLAYED)
_IS_SLOW = np.array([topic.cadence is Cadence.SLOW for topic in REPLAYED])


@dataclass(frozen=True)
class SentMessages:
    """Recorded messages of several chunks in the order of their sequence numbers."""

    #: messages of each chunk
    parts: list[Outputs]
    #: index of the first message of each part in the whole sequence, shape (k + 1,); the last element is the number of
    #: all messages
    begins: Indexes
    #: sequence number of each message, shape (n,)
    sequence: Indexes
    #: kind of each message, shape (n,)
    kind: Indexes

    @classmethod
    def of(cls, outputs: list[Outputs], topics: Mapping[str, str]) -> Self:
        """Collect messages; `topics` maps the topics that a replay can compute to their base names."""
        # many parts have the same dictionary of topics, so one table is created for each dictionary
        tables = {id(part.topics): _kinds(part.topics, topics) for part in outputs}
        sequence = _joined(part.sequence for part in outputs)
        kind = _joined(tables[id(part.topics)][part.messages.channel] for part in outputs)
        begins = np.cumsum([0, *map(len, outputs)])
        if (sequence[1:] < sequence[:-1]).any():
            # the messages are not in order, because another program wrote the file; a part of one message can be sorted
            order = np.argsort(sequence, kind="stable")
            owner = np.searchsorted(begins, order, side="right") - 1
            places = zip(owner.tolist(), (order - begins[owner]).tolist(), strict=True)
            outputs = [outputs[part][place : place + 1] for part, place in places]
            begins, sequence, kind = np.arange(len(order) + 1), sequence[order], kind[order]
        return cls(outputs, begins, sequence, kind)

    def __len__(self) -> int:
        return len(self.sequence)

    def before(self, sequence: int) -> int:
        """Return the number of messages that were sent before the journal entry with this sequence number."""
        return int(np.searchsorted(self.sequence, sequence))

    def record(self, index: int) -> OutputRecord:
        """Return the message at `index`."""
        part = int(np.searchsorted(self.begins, index, side="right")) - 1
        return self.parts[part].record(index - int(self.begins[part]))

    def pieces(self, begin: int, end: int) -> Iterator[tuple[Messages, int, int]]:
        """Yield the messages with the indexes `begin` to `end - 1`, chunk by chunk.

        The first integer is the index of the first message of a piece. The second integer is the index of the last
        message plus one.
        """
        first = int(np.searchsorted(self.begins, begin, side="right")) - 1
        while begin < end:
            origin, behind = self.begins[first : first + 2].tolist()
            stop, messages = min(end, behind), self.parts[first].messages
            whole = begin == origin and stop == behind
            yield messages if whole else messages[begin - origin : stop - origin], begin, stop
            begin, first = stop, first + 1


def _joined(arrays: Iterable[Indexes]) -> Indexes:
    return np.concatenate([np.zeros(0, np.int64), *arrays])


def _kinds(channels: Mapping[int, tuple[str, str]], topics: Mapping[str, str]) -> Indexes:
    lookup = np.full(max(channels, default=-1) + 1, -1)
    for channel, (topic, _) in channels.items():
        if topic in topics:
            lookup[channel] = PUBLICATION_TOPICS.index(topics[topic])
    return lookup


class Sent:
    """Find the advance of the twin after which each message was sent, for a series of journal entries.

    `sequence`, shape (n,), is the number of the journal entry before each message, in ascending order. `kind`, shape
    (n,), is the kind of each message. `done`, shape (k,), is the number of advances up to and including each entry of
    the series, which begins with the entry `first`.
    """

    def __init__(self, sequence: Indexes, kind: Indexes, done: Indexes, first: int, advances: int) -> None:
        self.kind = kind
        #: index of the advance before each message
        self.after = np.empty(len(kind), np.int64)
        #: number of messages of each kind
        self.counts = np.zeros(_KINDS, np.int64)
        numbers = np.full(advances, -1)
        find_advances(sequence, kind, done, first, self.after, self.counts, numbers)
        #: indexes of the advances after which messages were sent; each of these advances is a publication
        self.taken = np.flatnonzero(numbers >= 0)
        #: sequence number of the first message of each publication
        self.first_sequence = numbers[self.taken]
        #: index of the publication that follows each advance
        self.publication = np.empty(advances, np.int64)
        self.publication[self.taken] = np.arange(len(self.taken))

    def expect(self, published: Published, templates: Templates, kinds: NDArray[np.bool_]) -> None:
        """Set the publications that a replay computed; `kinds` is True for each kind of message to compare."""
        rows, slow = published
        slow_of = np.full(len(rows), -1)
        slow_of[slow["row"]] = np.arange(len(slow))
        numbers = [topic.numbers(topic.record_of(published)) for topic in REPLAYED]
        #: arrays with contiguous rows, which compiled code reads by address; this attribute keeps them in memory
        self._numbers = [
            [part if part.strides[1] == part.itemsize else np.ascontiguousarray(part) for part in parts]
            for parts in numbers
        ]
        self._expected = (
            self.publication, slow_of, kinds, np.ascontiguousarray(rows["stamp_ns"]),
            *_pieces(self._numbers, templates), templates.data, templates.fixed, templates.ends,
        )  # fmt: skip

    def differing(self, messages: Messages, chosen: slice) -> list[int]:
        """Return the indexes of the messages that differ; `chosen` is the slice of the series for `messages`."""
        wrong = np.empty(len(messages), bool)
        places = messages.start, messages.length
        count = compare(messages.buffer, *places, self.kind[chosen], self.after[chosen], *self._expected, wrong)
        return np.flatnonzero(wrong).tolist() if count else []


@compiled
def find_advances(sequence, kind, done, first, after, counts, numbers):  # type: ignore[no-untyped-def]
    """Fill the arrays of `Sent`.

    `numbers`, shape (advances,), receives the sequence number of the first message after each advance. An element stays
    -1 if no message follows the advance.
    """
    for n in range(sequence.size):
        advance = done[sequence[n] - first] - 1
        after[n] = advance
        if kind[n] >= 0:
            counts[kind[n]] += 1
            if numbers[advance] < 0:
                numbers[advance] = sequence[n]


def _pieces(numbers: list[list[NDArray[np.float64]]], templates: Templates) -> tuple[Indexes, Indexes]:
    """Return the pieces of all kinds of messages, and the index at which the pieces of each kind end.

    A piece is a series of numbers that is contiguous in the message and in a row of the publications. It has four
    values: offset in the message [B], count of numbers, address in the first row, and distance of rows [B].
    """
    found, ends = [], [0]
    for kind, parts in enumerate(numbers):
        place = int(templates.place_ends[kind])
        for part in parts:
            count = part.shape[1]
            places = templates.places[place : place + count]
            begins = [0, *(np.flatnonzero(np.diff(places) != part.itemsize) + 1).tolist(), count]
            for begin, end in pairwise(begins):
                address = part.ctypes.data + begin * part.itemsize
                found.append((int(places[begin]), end - begin, address, part.strides[0]))
            place += count
        ends.append(len(found))
    return np.array(found, np.int64), np.array(ends, np.int64)


@compiled
def compare(  # type: ignore[no-untyped-def]
    buffer, starts, lengths, kinds, after, publication, slow, compared, stamps, pieces, piece_ends,
    data, fixed, ends, different,
):  # fmt: skip
    """Compare each message with its template, filled with the stamp and the numbers of the publication.

    `kinds` and `after`, shape (n,), are arrays of `Sent`. `publication` is the index of the publication after each
    advance, and `slow` the index of the slow part of each publication, below 0 without a slow part. `compared` states
    for each kind whether it is compared. `pieces` and `piece_ends` are the results of `_pieces`, and `data`, `fixed`
    and `ends` the attributes of `Templates`. `different`, shape (n,), receives True for each message that differs.
    Return the number of these messages.
    """
    count = 0
    for n in range(starts.size):
        k, start = kinds[n], starts[n]
        different[n] = k >= 0 and compared[k]
        if not different[n]:
            continue
        count += 1
        row, first, size = publication[after[n]], ends[k], ends[k + 1] - ends[k]
        place = slow[row] if _IS_SLOW[k] else row
        if place < 0 or lengths[n] != size or start < 0 or start + size > buffer.size:
            continue
        last = size - 8
        wrong = (word(buffer, start + last) ^ word(data, first + last)) & word(fixed, first + last)
        for i in range(size >> 3):
            wrong |= (word(buffer, start + 8 * i) ^ word(data, first + 8 * i)) & word(fixed, first + 8 * i)
        wrong |= word(buffer, start + STAMP_AT) ^ stamp_word(stamps[row])
        for piece in range(piece_ends[k], piece_ends[k + 1]):
            begin, length = start + pieces[piece, 0], pieces[piece, 1]
            address = pieces[piece, 2] + place * pieces[piece, 3]
            for i in range(length):
                wrong |= word(buffer, begin + 8 * i) ^ word_at(address + 8 * i)
        different[n] = wrong != 0
        count -= wrong == 0
    return count
