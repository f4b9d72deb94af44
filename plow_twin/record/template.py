"""Messages of fixed length as bytes with holes for their numbers: made once, filled in or compared many at a time.

A message whose texts do not change differs from the next one of its kind in the stamp and in some float64 only. CDR
keeps them at fixed places, which are found by encoding the message once with numbers that occur nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Self

import numba
import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import encode
from plow_twin.record.messages import Message

Bytes = NDArray[np.uint8]
Indexes = NDArray[np.int64]

#: Place of the stamp, seconds and nanoseconds, behind the four bytes that name the encoding.
_STAMP_AT: Final = 4
_SECOND_NS: Final = 1_000_000_000

compiled: Final[Callable[[Callable[..., Any]], Callable[..., Any]]] = numba.njit(
    cache=True, nogil=True, error_model="numpy"
)


@dataclass(frozen=True)
class Template:
    """The bytes of a message (`data`), where its numbers stand, and which bytes never change (`fixed`).

    `runs` are the numbers that stand side by side, shape (m, 3): place in the message, place in a row of numbers,
    length, in bytes.
    """

    message_type: str
    data: Bytes
    runs: Indexes
    fixed: Bytes
    count: int

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
        fixed[_STAMP_AT : _STAMP_AT + 8] = 0
        for place in places:
            fixed[place : place + 8] = 0
            array[place : place + 8] = 0
        runs: list[list[int]] = []
        for index, place in enumerate(places):
            if runs and place == runs[-1][0] + runs[-1][2]:
                runs[-1][2] += 8
            else:
                runs.append([place, 8 * index, 8])
        return cls(message.TYPE, array, np.array(runs, np.int64), fixed, count)

    def __len__(self) -> int:
        return len(self.data)


@compiled
def fits(buffer: Bytes, start: int, length: int, data: Bytes, fixed: Bytes) -> bool:
    """Tell whether the bytes from `start` on are a message of a template, whatever its numbers."""
    if length != data.size or start < 0 or start + length > buffer.size:
        return False
    message = buffer[start : start + length]  # its own array: the index needs no check and the loop is wide
    wrong = np.uint8(0)
    for i in range(data.size):
        wrong = np.uint8(wrong | np.uint8(np.uint8(message[i] ^ data[i]) & fixed[i]))  # bytes stay bytes: wide lanes
    return bool(wrong == 0)


@compiled
def _copy(target: Bytes, place: int, source: Bytes, begin: int, count: int) -> None:
    """Copy `count` bytes."""
    to, taken = target[place : place + count], source[begin : begin + count]
    for i in range(count):
        to[i] = taken[i]


@compiled
def _unequal(left: Bytes, place: int, right: Bytes, begin: int, count: int) -> bool:
    """Compare `count` bytes."""
    one, other = left[place : place + count], right[begin : begin + count]
    wrong = np.uint8(0)
    for i in range(count):
        wrong = np.uint8(wrong | np.uint8(one[i] ^ other[i]))
    return bool(wrong != 0)


@compiled
def read_numbers(buffer, starts, lengths, data, fixed, runs, stamps, values, good):  # type: ignore[no-untyped-def]
    """Read stamp and numbers of each message that fits the template; the others are not `good`."""
    stamp = np.empty(2, np.int32)
    stamp8, row8 = stamp.view(np.uint8), values.view(np.uint8)
    for n in range(starts.size):
        start = starts[n]
        good[n] = fits(buffer, start, lengths[n], data, fixed)
        if not good[n]:
            continue
        _copy(stamp8, 0, buffer, start + _STAMP_AT, 8)
        stamps[n] = np.int64(stamp[0]) * _SECOND_NS + np.int64(np.uint32(stamp[1]))
        for k in range(len(runs)):
            _copy(row8[n], runs[k, 1], buffer, start + runs[k, 0], runs[k, 2])


@compiled
def differs(buffer, starts, lengths, data, fixed, runs, index, stamps, values, different):  # type: ignore[no-untyped-def]
    """Compare each message with the template filled with stamp and numbers of row `index[n]`, byte for byte."""
    stamp = np.empty(2, np.int32)
    stamp8, rows8 = stamp.view(np.uint8), values.view(np.uint8)
    for n in range(starts.size):
        start, row = starts[n], index[n]
        if not fits(buffer, start, lengths[n], data, fixed):
            different[n] = True
            continue
        stamp[0], stamp[1] = stamps[row] // _SECOND_NS, stamps[row] % _SECOND_NS
        wrong = _unequal(stamp8, 0, buffer, start + _STAMP_AT, 8)
        row8 = rows8[row]
        for k in range(len(runs)):
            wrong |= _unequal(row8, runs[k, 1], buffer, start + runs[k, 0], runs[k, 2])
        different[n] = wrong


@compiled
def fill(buffer, starts, data, runs, stamps, values):  # type: ignore[no-untyped-def]
    """Write the template with stamp and numbers of row n from `starts[n]` on."""
    stamp = np.empty(2, np.int32)
    stamp8, rows8 = stamp.view(np.uint8), values.view(np.uint8)
    for n in range(starts.size):
        start = starts[n]
        _copy(buffer, start, data, 0, data.size)
        stamp[0], stamp[1] = stamps[n] // _SECOND_NS, stamps[n] % _SECOND_NS
        _copy(buffer, start + _STAMP_AT, stamp8, 0, 8)
        row8 = rows8[n]
        for k in range(len(runs)):
            _copy(buffer, start + runs[k, 0], row8, runs[k, 1], runs[k, 2])
