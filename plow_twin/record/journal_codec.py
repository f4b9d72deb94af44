"""Convert journal entries to ROS messages and back, without any loss of precision.

A sample (a load at a time) becomes a wrench. A digest (a hash of the exact state) becomes two integers. An entry that
is neither a sample nor a digest becomes a JSON text.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.record.messages import Integers, Message, Text, WrenchStamped
from plow_twin.record.template import Bytes, Indexes
from plow_twin.stream import journal


@dataclass(frozen=True)
class Dropped:
    """A note of the recorder that the preceding `count` messages on `topic` could not be written to the file."""

    topic: str
    count: int


_KINDS: Final[dict[str, type[Any]]] = {
    "hold": journal.Hold,
    "unload": journal.Unload,
    "travel": journal.Travel,
    "reset": journal.Reset,
    "wear": journal.SetWear,
    "model": journal.SetModel,
    "restore": journal.Restore,
    "mark": journal.Mark,
    "failed": journal.Failed,
    "spread": journal.Spread,
    "parameter": journal.Parameter,
    "pose": journal.Pose,
    "part_of_pose": journal.PartOfPose,
    "gaps": journal.Gaps,
    "unused": journal.Unused,
    "estimated": journal.Estimated,
    "snapshot": journal.Snapshot,
    "loss": journal.Loss,
    "dropped": Dropped,
}
#: First bytes of a message with a digest. They are the encoding, the number of dimensions (0), the offset (0), the
#: count of numbers (2), and the padding.
_DIGEST_HEAD: Final = np.frombuffer(struct.pack("<BBHIII4x", 0, 1, 0, 0, 0, 2), np.uint8)
_DIGEST_SIZE: Final = len(_DIGEST_HEAD) + 16
_MASK: Final = 2**64 - 1
_SIGN: Final = 2**63
_OPTIONAL: Final = frozenset({"deviation"})
_NAMES: Final = {kind: name for name, kind in _KINDS.items()}


def to_message(entry: journal.Entry | Dropped, frame_id: str) -> Message:
    """Return the message that represents a journal entry."""
    if isinstance(entry, journal.Sample):
        fx, fy, m = entry.wrench
        return WrenchStamped(entry.stamp_ns, frame_id, (fx, fy, 0.0), (0.0, 0.0, m))
    if isinstance(entry, journal.Digest):
        return Integers((entry.stamp_ns & _MASK, int(entry.digest, 16)))
    values = {spec.name: getattr(entry, spec.name) for spec in fields(entry)}
    if isinstance(entry, journal.Pose) and not entry.deviation:
        del values["deviation"]
    if isinstance(entry, journal.Snapshot | journal.Restore):
        values["data"] = base64.b64encode(entry.data).decode()
    elif isinstance(entry, journal.Unused):
        # infinity and NaN are written as strings, because JSON cannot represent them as numbers
        values["values"] = [
            [number if math.isfinite(number) else repr(number) for number in row] for row in entry.values
        ]
    return Text(json.dumps({"kind": _NAMES[type(entry)], **values}, allow_nan=False))


def from_message(message: Message, source: str = "journal") -> journal.Entry | Dropped:
    """Return the journal entry that a message represents.

    Raise `RecordingError` if the message does not represent a journal entry. The error begins with `source`.
    """
    if isinstance(message, WrenchStamped):
        wrench = (message.force[0], message.force[1], message.torque[2])
        if not all(map(math.isfinite, wrench)):
            raise RecordingError(f"{source}: sample at {message.stamp_ns}: got {wrench}, expected finite numbers")
        return journal.Sample(message.stamp_ns, wrench)
    if isinstance(message, Integers):
        if len(message.data) != 2:
            raise RecordingError(f"{source}: got {len(message.data)} integers, expected the two of a digest")
        stamp_ns, digest = message.data
        return journal.Digest((stamp_ns ^ _SIGN) - _SIGN, f"{digest:016x}")
    if not isinstance(message, Text):
        raise RecordingError(f"{source}: got a {message.TYPE}, expected a sample, a digest or a line of JSON")
    return _from_json(message.data, source)


def read_digests(
    buffer: Bytes, start: Indexes, length: Indexes
) -> tuple[NDArray[np.bool_], Indexes, NDArray[np.uint64]]:
    """Find the messages that are digests, among messages with offset `start` and `length`, shape (n,), in a buffer.

    Return whether each message is a digest, shape (n,), and the stamps [ns] and values of the digests, shape (m,).
    """
    complete = (length == _DIGEST_SIZE) & (start >= 0) & (start + _DIGEST_SIZE <= buffer.size)
    messages = buffer[start[complete, None] + np.arange(_DIGEST_SIZE)]
    good = (messages[:, : len(_DIGEST_HEAD)] == _DIGEST_HEAD).all(axis=1)
    complete[complete] = good
    numbers = np.ascontiguousarray(messages[good, len(_DIGEST_HEAD) :]).view("<u8")
    return complete, numbers[:, 0].astype(np.int64), numbers[:, 1]


def _from_json(text: str, source: str) -> journal.Entry | Dropped:
    try:
        values = json.loads(text, parse_constant=_no_number)
        kind = values["kind"]
        fields = [read(values[name]) for name, read in _FIELDS[kind] if name in values or name not in _OPTIONAL]
        entry: journal.Entry | Dropped = _KINDS[kind](*fields)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise RecordingError(f"{source}: got {text[:120]!r}, expected an entry of the journal ({error!r})") from error
    return entry


def _exactly(*kinds: type) -> Callable[[Any], Any]:
    """Return a function that refuses values of other types; unlike `isinstance`, it distinguishes 1 and True."""

    def read(value: Any) -> Any:
        if type(value) not in kinds:
            raise TypeError(f"{value!r} is not of type {' or '.join(kind.__name__ for kind in kinds)}")
        return value

    return read


def _no_number(text: str) -> Any:
    raise ValueError(f"{text} is not a JSON number")


def _integer(value: Any) -> int:
    number: int = _exactly(int)(value)
    if not -_SIGN <= number < _SIGN:
        raise ValueError(f"got an integer of {number.bit_length()} bits, expected a signed 64-bit integer")
    return number


_READERS: Final[dict[str, Callable[[Any], Any]]] = {
    "int": _integer,
    "float": _exactly(float, int),
    "str": _exactly(str),
    "bytes": partial(base64.b64decode, validate=True),
    "tuple[float, ...]": lambda row: tuple(map(_exactly(float), row)),
    "tuple[int, ...]": lambda row: tuple(map(_integer, row)),
    "tuple[tuple[float, ...], ...]": lambda rows: tuple(
        tuple(map(float, map(_exactly(float, str), row))) for row in rows
    ),
    "ParameterValue": _exactly(bool, int, float, str),
}
#: Functions that read the fields of each kind of entry, by name of the field.
_FIELDS: Final = {
    name: [(spec.name, _READERS[str(spec.type)]) for spec in fields(kind)] for name, kind in _KINDS.items()
}
