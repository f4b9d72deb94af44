"""Templates of messages of fixed length: bytes with places for numbers, which are filled in or compared many at a time.

Messages with equal texts differ only in the stamp and in some float64 numbers. Their places are found by encoding the
message once with numbers that occur nowhere else.
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

#: Offset of the stamp, after the four bytes that name the encoding.
STAMP_AT: Final = 4
_SECOND_NS: Final = 1_000_000_000


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function whose arguments are arrays of bytes."""
    dispatcher: Callable[..., Any] = kept(function)
    return dispatcher


@dataclass(frozen=True)
class Template:
    """The bytes of a message (`data`) and the offsets of its numbers (`places`, shape (count,)).

    `fixed` is a mask whose bits are set in the bytes that do not change.
    """

    message_type: str
    data: Bytes
    places: Indexes
    fixed: Bytes

    @classmethod
    def of(cls, build: Callable[[NDArray[np.float64]], Message], count: int) -> Self:
        """Make the template of the messages that `build` makes from `count` numbers, with stamp 0.

        Raises
        ------
        RecordingError
            The message does not contain a number as given.
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
        """Count of the numbers in a message."""
        return len(self.places)


@compiled
def _fits(buffer: Bytes, start: int, length: int, data: Bytes, fixed: Bytes) -> bool:
    """Return whether the bytes from `start` on are a message of a template, with any numbers."""
    if length != data.size or start < 0 or start + length > buffer.size:
        return False
    last = length - 8  # this word may overlap the word before it
    wrong = (word(buffer, start + last) ^ word(data, last)) & word(fixed, last)
    for k in range(length >> 3):
        wrong |= (word(buffer, start + 8 * k) ^ word(data, 8 * k)) & word(fixed, 8 * k)
    return bool(wrong == 0)


@compiled
def stamp_word(stamp_ns: int) -> int:
    """Return the stamp as one 64-bit word: seconds and nanoseconds as in a message."""
    seconds = stamp_ns // _SECOND_NS
    return (seconds & 0xFFFFFFFF) | ((stamp_ns - seconds * _SECOND_NS) << 32)


@compiled
def read_numbers(buffer, starts, lengths, data, fixed, places, stamps, values, good):  # type: ignore[no-untyped-def]
    """Read stamp and numbers of each message that fits the template; `good` is False for any other message."""
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
    """Several templates one after the other; messages of different kinds are compared in one pass.

    `ends` (k + 1,) and `place_ends` (k + 1,) are the bounds of each template's bytes and places.
    """

    data: Bytes
    fixed: Bytes
    ends: Indexes
    places: Indexes
    place_ends: Indexes

    @classmethod
    def of(cls, templates: Iterable[Template]) -> Self:
        """Join templates; the kind of a message is the index of its template."""
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
    """Write the template with the stamp and numbers of each row n from `starts[n]` on."""
    last = data.size - 8
    for n in range(starts.size):
        start = starts[n]
        for k in range(data.size >> 3):
            set_word(buffer, start + 8 * k, word(data, 8 * k))
        set_word(buffer, start + last, word(data, last))
        set_word(buffer, start + STAMP_AT, stamp_word(stamps[n]))
        for k in range(places.size):
            set_word(buffer, start + places[k], word(values, 8 * (n * places.size + k)))
