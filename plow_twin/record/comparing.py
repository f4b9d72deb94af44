"""Messages that were sent beside the publications that a replay gives: found and compared byte for byte, compiled."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.chunks import Messages
from plow_twin.record.outputs import REPLAYED
from plow_twin.record.template import STAMP_AT, Indexes, Templates, compiled, stamp_word
from plow_twin.record.words import eight_differ, word, word_at
from plow_twin.stream.outputs import Published
from plow_twin.stream.topics import Cadence

_KINDS = len(REPLAYED)
_IS_SLOW = np.array([topic.cadence is Cadence.SLOW for topic in REPLAYED])


class Sent:
    """Which advance of a run each message was sent after.

    Parameters
    ----------
    sequence, kind : ndarray of int64, shape (n,)
        Numbers of the journal, rising, and the messages' places in `REPLAYED` (-1: another topic).
    done : ndarray of int64, shape (k,)
        Advances up to each entry of the run, whose first one has the number `first`.
    advances
        How many the run has.
    """

    def __init__(self, sequence: Indexes, kind: Indexes, done: Indexes, first: int, advances: int) -> None:
        self.kind = kind
        #: advance, from 0, after which each was sent
        self.after = np.empty(len(kind), np.int64)
        #: messages of each kind
        self.counts = np.zeros(_KINDS, np.int64)
        numbers = np.full(advances, -1)
        find_advances(sequence, kind, done, first, self.after, self.counts, numbers)
        #: advances after which a message was sent, and the sequence number of the message
        self.taken = np.flatnonzero(numbers >= 0)
        self.first_sequence = numbers[self.taken]
        #: publication by advance
        self.publication = np.empty(advances, np.int64)
        self.publication[self.taken] = np.arange(len(self.taken))

    def expect(self, published: Published, templates: Templates, kinds: NDArray[np.bool_]) -> None:
        """Set the publications after the advances `taken`; only `kinds` of their messages are compared."""
        rows, slow = published
        slow_of = np.full(len(rows), -1)
        slow_of[slow["row"]] = np.arange(len(slow))
        numbers = [topic.numbers(topic.record_of(published)) for topic in REPLAYED]
        #: kept alive: they are read by their addresses
        self._numbers = [[_with_whole_rows(part) for part in parts] for parts in numbers]
        self._expected = (
            self.publication, slow_of, kinds, np.ascontiguousarray(rows["stamp_ns"]),
            *_pieces(self._numbers, templates), templates.data, templates.fixed, templates.ends,
        )  # fmt: skip

    def differing(self, messages: Messages, chosen: slice) -> list[int]:
        """Return which messages, `chosen` among all, differ from those of their publication."""
        wrong = np.empty(len(messages), bool)
        places = messages.start, messages.length
        count = compare(messages.buffer, *places, self.kind[chosen], self.after[chosen], *self._expected, wrong)
        return np.flatnonzero(wrong).tolist() if count else []


@compiled
def find_advances(sequence, kind, done, first, after, counts, numbers):  # type: ignore[no-untyped-def]
    """Fill the arrays of `Sent`; `numbers` receives the number of the first message after each advance."""
    for n in range(sequence.size):
        advance = done[sequence[n] - first] - 1
        after[n] = advance
        if kind[n] >= 0:
            counts[kind[n]] += 1
            if numbers[advance] < 0:
                numbers[advance] = sequence[n]


def _with_whole_rows(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers whose rows have no gaps; they may have some between them."""
    return numbers if numbers.strides[1] == numbers.itemsize else np.ascontiguousarray(numbers)


def _pieces(numbers: list[list[NDArray[np.float64]]], templates: Templates) -> tuple[Indexes, Indexes]:
    """Return the runs of numbers that are contiguous both in messages and in rows, and the end of each kind.

    A piece is its place in the message [B], how many they are, their address in the first row, and from row to row [B].
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
    """Compare each message with its template filled with stamp and numbers of its publication, byte for byte.

    Parameters
    ----------
    kinds, after : ndarray of int64, shape (n,)
        As in `Sent`.
    publication, slow : ndarray of int64
        Publication by advance, and by publication the row of its slow part, below 0 without one.
    compared : ndarray of bool
        By kind.
    pieces, piece_ends
        As in `_pieces`.
    data, fixed, ends
        As in `Templates`.
    different : ndarray of bool, shape (n,)
        Receives the result for each message; the number of True is returned.
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
            if length == PAIR_COUNT:
                wrong |= eight_differ(buffer, begin, address)
            else:
                for i in range(length):
                    wrong |= word(buffer, begin + 8 * i) ^ word_at(address + 8 * i)
        different[n] = wrong != 0
        count -= wrong == 0
    return count
