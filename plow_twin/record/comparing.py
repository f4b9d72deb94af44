"""Messages that were sent beside the publications that a replay gives: found and compared byte for byte, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.chunks import Messages
from plow_twin.record.outputs import PUBLICATION_TOPICS, SLOW_TOPICS, head_numbers
from plow_twin.record.template import STAMP_AT, Indexes, Templates, compiled, stamp_word
from plow_twin.record.words import bits, word
from plow_twin.stream.outputs import Publications

_KINDS = len(PUBLICATION_TOPICS)
_FORCES, _PEAKS, _HEAD, _CLEARANCE, _WEAR_RATE = range(_KINDS)
_IS_SLOW = np.array([name in SLOW_TOPICS for name in PUBLICATION_TOPICS])


class Sent:
    """Which advance of a run each message was sent after.

    Parameters
    ----------
    sequence, kind : ndarray of int64, shape (n,)
        Numbers of the journal, rising, and the messages' places in `PUBLICATION_TOPICS` (-1: another topic).
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
        #: advances after which something was sent, and the number of the journal that it has
        self.taken = np.flatnonzero(numbers >= 0)
        self.first_sequence = numbers[self.taken]
        #: publication by advance
        self.publication = np.empty(advances, np.int64)
        self.publication[self.taken] = np.arange(len(self.taken))

    def expect(self, publications: Publications, templates: Templates, kinds: NDArray[np.bool_]) -> None:
        """Take the publications after the advances `taken`; only `kinds` of their messages are compared."""
        now = publications
        slow, motion = np.full(len(now), -1), np.empty((len(now), 7))
        slow[now.slow_index] = np.arange(len(now.slow_index))
        head_numbers(now.q, now.v, motion)
        pairs = now.penetration, now.rate, now.force, now.makes, now.impulse, now.peak
        self._expected = (
            self.publication, slow, kinds, now.stamp_ns, pairs, motion, (now.clearance, now.wear_rate),
            templates.data, templates.fixed, templates.ends, templates.places, templates.place_ends,
        )  # fmt: skip

    def differing(self, messages: Messages, chosen: slice) -> NDArray[np.bool_]:
        """Tell which of some of the messages, `chosen` among all, are not those of their publication."""
        wrong = np.zeros(len(messages), bool)
        places = messages.start, messages.length
        compare(messages.buffer, *places, self.kind[chosen], self.after[chosen], *self._expected, wrong)
        return wrong


@compiled
def find_advances(sequence, kind, done, first, after, counts, numbers):  # type: ignore[no-untyped-def]
    """Fill what `Sent` holds; `numbers` receives the number of the first message after each advance."""
    for n in range(sequence.size):
        advance = done[sequence[n] - first] - 1
        after[n] = advance
        if kind[n] >= 0:
            counts[kind[n]] += 1
            if numbers[advance] < 0:
                numbers[advance] = sequence[n]


@compiled
def compare(  # type: ignore[no-untyped-def]
    buffer, starts, lengths, kinds, after, publication, slow, compared, stamps, pairs, motion, slow_numbers,
    data, fixed, ends, places, place_ends, different,
):  # fmt: skip
    """Compare each message with its template filled with stamp and numbers of its publication, byte for byte.

    Parameters
    ----------
    kinds, after : ndarray of int64, shape (n,)
        As in `Sent`.
    publication, slow : ndarray of int64
        Publication by advance, and by publication the row of its slow part, below 0 where there should be none.
    compared : ndarray of bool
        By kind.
    pairs : tuple of ndarray, shape (m, 8)
        Numbers of `contact_forces`, then of `contact_peaks`.
    slow_numbers : tuple of ndarray
        Numbers of `clearance` and of `wear_rate`.
    data, fixed, ends, places, place_ends
        As in `Templates`.
    different : ndarray of bool, shape (n,)
        Receives what was found.
    """
    penetration, rate, force, makes, impulse, peak = pairs
    clearance, wear_rate = slow_numbers
    for n in range(starts.size):
        k, start = kinds[n], starts[n]
        if k < 0 or not compared[k]:
            continue
        row, first, size = publication[after[n]], ends[k], ends[k + 1] - ends[k]
        different[n] = True
        missing = _IS_SLOW[k] and slow[row] < 0
        if missing or lengths[n] != size or start < 0 or start + size > buffer.size:
            continue
        last = size - 8
        wrong = (word(buffer, start + last) ^ word(data, first + last)) & word(fixed, first + last)
        for i in range(size >> 3):
            wrong |= (word(buffer, start + 8 * i) ^ word(data, first + 8 * i)) & word(fixed, first + 8 * i)
        wrong |= word(buffer, start + STAMP_AT) ^ stamp_word(stamps[row])
        place = place_ends[k]
        if k == _FORCES:
            wrong |= _differ(buffer, start, places, place, penetration, row)
            wrong |= _differ(buffer, start, places, place + PAIR_COUNT, rate, row)
            wrong |= _differ(buffer, start, places, place + 2 * PAIR_COUNT, force, row)
        elif k == _PEAKS:
            wrong |= _differ(buffer, start, places, place, makes, row)
            wrong |= _differ(buffer, start, places, place + PAIR_COUNT, impulse, row)
            wrong |= _differ(buffer, start, places, place + 2 * PAIR_COUNT, peak, row)
        elif k == _HEAD:
            wrong |= _differ(buffer, start, places, place, motion, row)
        elif k == _CLEARANCE:
            wrong |= _differ(buffer, start, places, place, clearance, slow[row])
        else:
            wrong |= _differ(buffer, start, places, place, wear_rate, slow[row])
        different[n] = wrong != 0


@compiled
def _differ(buffer, start, places, first, numbers, row):  # type: ignore[no-untyped-def]
    """Return 0 when a row of numbers stands at its places, from number `first` of all on."""
    wrong = np.int64(0)
    for i in range(numbers.shape[1]):
        wrong |= word(buffer, start + places[first + i]) ^ bits(float(numbers[row, i]))
    return wrong
