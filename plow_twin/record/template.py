"""Messages of fixed length as bytes with holes for their numbers: made once, filled in or compared many at a time.

A message whose texts do not change differs from the next message of its kind only in the stamp and some float64. CDR
keeps them at fixed places, which are found by encoding the message once with numbers that occur nowhere else.
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

#: Place of the stamp, seconds and nanoseconds, behind the four bytes that name the encoding.
STAMP_AT: Final = 4
_SECOND_NS: Final = 1_000_000_000


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that works on bytes."""
    dispatcher: Callable[..., Any] = kept(function)
    return dispatcher


@dataclass(frozen=True)
class Template:
    """The bytes of a message (`data`), where its numbers stand (`places`, shape (count,)), and a mask of the others.

    `fixed` has all bits set in the bytes that never change.
    """

    message_type: str
    data: Bytes
    places: Indexes
    fixed: Bytes

    @classmethod
    def of(cls, build: Callable[[NDArray[np.float64]], Message], count: int) -> Self:
        """Make the template of messages that `build` makes of `count` numbers, with stamp 0.

        Raises
        ------
        RecordingError
            A number does not stand in the message as it was given.
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
        """How many numbers a message has."""
        return len(self.places)


@compiled
def _fits(buffer: Bytes, start: int, length: int, data: Bytes, fixed: Bytes) -> bool:
    """Return whether the bytes from `start` on are a message of a template, with any numbers."""
    if length != data.size or start < 0 or start + length > buffer.size:
        return False
    last = length - 8  # the last word may overlap the word before
    wrong = (word(buffer, start + last) ^ word(data, last)) & word(fixed, last)
    for k in range(length >> 3):
        wrong |= (word(buffer, start + 8 * k) ^ word(data, 8 * k)) & word(fixed, 8 * k)
    return bool(wrong == 0)


@compiled
def stamp_word(stamp_ns: int) -> int:
    """Return seconds and nanoseconds side by side, as they stand in a message."""
    seconds = stamp_ns // _SECOND_NS
    return (seconds & 0xFFFFFFFF) | ((stamp_ns - seconds * _SECOND_NS) << 32)


@compiled
def read_numbers(buffer, starts, lengths, data, fixed, places, stamps, values, good):  # type: ignore[no-untyped-def]
    """Read stamp and numbers of each message that fits the template; the others are not `good`."""
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
    """Several templates one behind the other, to compare messages of any of them in one pass.

    `ends` (k + 1,) and `place_ends` (k + 1,) say where the bytes and the places of each begin and end.
    """

    data: Bytes
    fixed: Bytes
    ends: Indexes
    places: Indexes
    place_ends: Indexes

    @classmethod
    def of(cls, templates: Iterable[Template]) -> Self:
        """Put templates together; a message's kind is its template's place."""
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
    """Write the template with stamp and numbers of row n from `starts[n]` on."""
    last = data.size - 8
    for n in range(starts.size):
        start = starts[n]
        for k in range(data.size >> 3):
            set_word(buffer, start + 8 * k, word(data, 8 * k))
        set_word(buffer, start + last, word(data, last))
        set_word(buffer, start + STAMP_AT, stamp_word(stamps[n]))
        for k in range(places.size):
            set_word(buffer, start + places[k], word(values, 8 * (n * places.size + k)))
