"""Templates with which one compiled call writes or reads many messages of the same length.

If all strings of two messages are equal, the messages differ only in the stamp and in float64 numbers. A template
contains the bytes that are equal, and the offsets of the numbers. The offsets are found by encoding a message with
numbers that occur nowhere else in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.kernel.compiler import kept
from plow_twin.record.cdr import encode
from plow_twin.record.messages import Message
from plow_twin.record.words import set_word, word

Bytes = NDArray[np.uint8]
Indexes = NDArray[np.int64]

#: Offset of the stamp in a message [B]. The first four bytes of the message identify the encoding.
STAMP_AT: Final = 4
_SECOND_NS: Final = 1_000_000_000


#: Decorator that compiles a function whose arguments are arrays of bytes.
compiled: Final[Callable[[Callable[..., Any]], Callable[..., Any]]] = kept


@dataclass(frozen=True)
class Template:
    """Template of messages."""

    message_type: str
    #: bytes of a message in which the stamp and the numbers are 0, shape (size,)
    data: Bytes
    #: offset of each number [B], shape (count,)
    places: Indexes
    #: mask of the bytes that are equal in all messages: 255 for an equal byte, otherwise 0, shape (size,)
    fixed: Bytes

    @classmethod
    def of(cls, build: Callable[[NDArray[np.float64]], Message], count: int) -> Self:
        """Return the template of the messages that `build` creates from an array of `count` numbers.

        Raise `RecordingError` if a message does not contain one of the numbers unchanged.
        """
        marks = np.frombuffer(np.arange(0x3FD1_2345_6789_0000, 0x3FD1_2345_6789_0000 + count, dtype=np.int64).tobytes())
        message = build(marks)
        data = encode(message)
        places = [data.find(mark.tobytes()) for mark in marks]
        if -1 in places:
            raise RecordingError(f"{message.TYPE}: number {places.index(-1)} is not in its message")
        array = np.frombuffer(data, np.uint8).copy()
        fixed = np.full(len(array), 0xFF, np.uint8)
        for place in (STAMP_AT, *places):
            fixed[place : place + 8] = 0
            array[place : place + 8] = 0
        return cls(message.TYPE, array, np.array(places, np.int64), fixed)

    def __len__(self) -> int:
        return len(self.data)

    @property
    def count(self) -> int:
        """Number of float64 numbers in a message."""
        return len(self.places)


@compiled
def _fits(buffer: Bytes, start: int, length: int, data: Bytes, fixed: Bytes) -> bool:
    """Return whether the message at offset `start` matches a template. The stamp and the numbers are not compared."""
    if length != data.size or start < 0 or start + length > buffer.size:
        return False
    last = length - 8  # the last word may overlap the word before it, because the length may be no multiple of 8
    wrong = (word(buffer, start + last) ^ word(data, last)) & word(fixed, last)
    for k in range(length >> 3):
        wrong |= (word(buffer, start + 8 * k) ^ word(data, 8 * k)) & word(fixed, 8 * k)
    return bool(wrong == 0)


@compiled
def stamp_word(stamp_ns: int) -> int:
    """Return the 64-bit word that represents a stamp in a message. It consists of the seconds and the nanoseconds."""
    seconds = stamp_ns // _SECOND_NS
    return (seconds & 0xFFFFFFFF) | ((stamp_ns - seconds * _SECOND_NS) << 32)


@compiled
def read_numbers(buffer, starts, lengths, data, fixed, places, stamps, values, good):  # type: ignore[no-untyped-def]
    """Read the stamp and the numbers of each message that matches the template.

    The arrays `stamps`, shape (n,), and `values`, shape (n, count), receive the results. `good`, shape (n,), receives
    False for a message that does not match.
    """
    for n in range(starts.size):
        start = starts[n]
        good[n] = _fits(buffer, start, lengths[n], data, fixed)
        if not good[n]:
            continue
        stamp = word(buffer, start + STAMP_AT)
        stamps[n] = np.int64(np.int32(stamp)) * _SECOND_NS + (stamp >> 32 & 0xFFFFFFFF)
        for k in range(places.size):
            set_word(values, 8 * (n * places.size + k), word(buffer, start + places[k]))


@dataclass(frozen=True)
class Templates:
    """Several templates in common arrays, so that messages of different kinds can be compared in one call.

    The kind of a message is the index `k` of its template. Template `k` consists of the bytes
    `data[ends[k] : ends[k + 1]]` and of the offsets `places[place_ends[k] : place_ends[k + 1]]`.
    """

    data: Bytes
    fixed: Bytes
    ends: Indexes
    places: Indexes
    place_ends: Indexes

    @classmethod
    def of(cls, templates: Iterable[Template]) -> Self:
        """Concatenate templates."""
        parts = list(templates)
        return cls(
            np.concatenate([part.data for part in parts]),
            np.concatenate([part.fixed for part in parts]),
            np.cumsum([0, *map(len, parts)]),
            np.concatenate([part.places for part in parts]),
            np.cumsum([0, *(part.count for part in parts)]),
        )


@compiled
def fill(buffer, starts, data, places, stamps, values):  # type: ignore[no-untyped-def]
    """Fill the template with the stamp `stamps[n]` and the numbers `values[n]`, and write it to `starts[n]`."""
    last = data.size - 8
    for n in range(starts.size):
        start = starts[n]
        for k in range(data.size >> 3):
            set_word(buffer, start + 8 * k, word(data, 8 * k))
        set_word(buffer, start + last, word(data, last))
        set_word(buffer, start + STAMP_AT, stamp_word(stamps[n]))
        for k in range(places.size):
            set_word(buffer, start + places[k], word(values, 8 * (n * places.size + k)))
