"""Journal entries as ROS messages: samples as wrenches, all others as one line of JSON each, exact to the bit."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.record.messages import Message, Text, WrenchStamped
from plow_twin.record.template import compiled
from plow_twin.record.words import word
from plow_twin.stream.journal import (
    Digest,
    Entry,
    Estimated,
    Gaps,
    Hold,
    Loss,
    Mark,
    Parameter,
    PartOfPose,
    Pose,
    Reset,
    Restore,
    Sample,
    SetModel,
    SetWear,
    Snapshot,
    Spread,
    Travel,
    Unload,
    Unused,
)


@dataclass(frozen=True)
class Dropped:
    """The recorder's own note: `count` messages on `topic` before this place did not reach the file."""

    topic: str
    count: int


_KINDS: Final[dict[str, type[Any]]] = {
    "hold": Hold,
    "unload": Unload,
    "travel": Travel,
    "reset": Reset,
    "wear": SetWear,
    "model": SetModel,
    "restore": Restore,
    "mark": Mark,
    "spread": Spread,
    "parameter": Parameter,
    "pose": Pose,
    "part_of_pose": PartOfPose,
    "gaps": Gaps,
    "unused": Unused,
    "estimated": Estimated,
    "snapshot": Snapshot,
    "digest": Digest,
    "loss": Loss,
    "dropped": Dropped,
}
#: A digest as it is written, before, between and after stamp and digest.
_BEGIN: Final = np.frombuffer(b'{"kind": "digest", "stamp_ns": ', np.uint8)
_MIDDLE: Final = np.frombuffer(b', "digest": "', np.uint8)
_END: Final = np.frombuffer(b'"}\x00', np.uint8)
_SHORTEST: Final = len(_BEGIN) + 1 + len(_MIDDLE) + 16 + len(_END)
_ZERO, _A, _MINUS = ord("0"), ord("a"), ord("-")
#: Place of the characters in a string message.
_TEXT_AT: Final = 8
#: Most of a stamp: the largest of 64 bits has as many.
_FIGURES: Final = 19
#: Fields that a line may lack.
_OPTIONAL: Final = frozenset({"deviation"})
_NAMES: Final = {kind: name for name, kind in _KINDS.items()}


def to_message(entry: Entry | Dropped, frame_id: str) -> Message:
    """Return the message that stands for an entry."""
    if isinstance(entry, Sample):
        fx, fy, m = entry.wrench
        return WrenchStamped(entry.stamp_ns, frame_id, (fx, fy, 0.0), (0.0, 0.0, m))
    values = {spec.name: getattr(entry, spec.name) for spec in fields(entry)}
    if isinstance(entry, Pose) and not entry.deviation:
        del values["deviation"]
    if isinstance(entry, Snapshot | Restore):
        values["data"] = base64.b64encode(entry.data).decode()
    elif isinstance(entry, Unused):
        # JSON has no number that is not finite
        values["values"] = [
            [number if math.isfinite(number) else repr(number) for number in row] for row in entry.values
        ]
    return Text(json.dumps({"kind": _NAMES[type(entry)], **values}, allow_nan=False))


def from_message(message: Message, source: str = "journal") -> Entry | Dropped:
    """Return the entry that a message stands for.

    Raises
    ------
    RecordingError
        The message is no entry; `source` names it in the error.
    """
    if isinstance(message, WrenchStamped):
        wrench = (message.force[0], message.force[1], message.torque[2])
        if not all(map(math.isfinite, wrench)):
            raise RecordingError(f"{source}: sample at {message.stamp_ns}: got {wrench}, expected finite numbers")
        return Sample(message.stamp_ns, wrench)
    if not isinstance(message, Text):
        raise RecordingError(f"{source}: got a {message.TYPE}, expected a sample or a line of JSON")
    return _from_json(message.data, source)


@compiled
def read_digests(buffer, starts, lengths, is_sample, chosen, stamps, digests, found):  # type: ignore[no-untyped-def]
    """Read those of the `chosen` messages that are digests as they are written: most lines of a journal are.

    `stamps` has an item for each message, `digests` and `found` for each chosen one. What is no sample and not found is
    left to `from_message`: another kind, or a digest in other words.
    """
    for k in range(chosen.size):
        n = chosen[k]
        start, length = starts[n], lengths[n]
        found[k] = False
        if is_sample[n] or length < _TEXT_AT + _SHORTEST or start < 0 or start + length > buffer.size:
            continue
        end = start + length
        place = start + _TEXT_AT
        good = buffer[start] == 0 and buffer[start + 1] == 1
        good &= word(buffer, start + 4) & 0xFFFFFFFF == length - _TEXT_AT
        for i in range(_BEGIN.size):
            good &= buffer[place + i] == _BEGIN[i]
        place += _BEGIN.size
        negative = buffer[place] == _MINUS
        place += 1 if negative else 0
        stamp, first = np.int64(0), place
        while place < end and _ZERO <= buffer[place] <= _ZERO + 9:
            stamp = 10 * stamp + np.int64(buffer[place] - _ZERO)
            place += 1
        good &= place == first + 1 or buffer[first] != _ZERO
        good &= first < place <= first + _FIGURES and end - place == _MIDDLE.size + 16 + _END.size
        if not good:
            continue
        for i in range(_MIDDLE.size):
            good &= buffer[place + i] == _MIDDLE[i]
        place += _MIDDLE.size
        digest = np.uint64(0)
        for i in range(16):
            letter = np.int64(buffer[place + i])
            figure = letter - _ZERO if letter <= _ZERO + 9 else letter - _A + 10
            good &= _ZERO <= letter <= _ZERO + 9 or _A <= letter <= _A + 5
            digest = digest << np.uint64(4) | np.uint64(figure & 15)
        for i in range(_END.size):
            good &= buffer[place + 16 + i] == _END[i]
        if good and stamp >= 0:  # else it has gone round
            stamps[n], digests[k], found[k] = -stamp if negative else stamp, digest, True


def _from_json(text: str, source: str) -> Entry | Dropped:
    try:
        values = json.loads(text)
        kind = values["kind"]
        given = [read(values[name]) for name, read in _FIELDS[kind] if name in values or name not in _OPTIONAL]
        entry: Entry | Dropped = _KINDS[kind](*given)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{source}: got {text[:120]!r}, expected an entry of the journal ({error!r})") from error
    return entry


def _exactly(*kinds: type) -> Callable[[Any], Any]:
    """Return a reader that takes only these types, so that 1, 1.0 and True stay apart."""

    def read(value: Any) -> Any:
        if type(value) not in kinds:
            raise TypeError(f"{value!r} is not of type {' or '.join(kind.__name__ for kind in kinds)}")
        return value

    return read


def _bytes(value: Any) -> bytes:
    return base64.b64decode(value, validate=True)


def _floats(value: Any) -> tuple[float, ...]:
    read = _exactly(float)
    return tuple(read(item) for item in value)


def _ints(value: Any) -> tuple[int, ...]:
    read = _exactly(int)
    return tuple(read(item) for item in value)


def _rows(value: Any) -> tuple[tuple[float, ...], ...]:
    """Return rows of numbers; one that is not finite stands there as a text."""
    read = _exactly(float, str)
    rows = tuple(tuple(float(read(item)) for item in row) for row in value)
    return rows


_READERS: Final[dict[str, Callable[[Any], Any]]] = {
    "int": _exactly(int),
    "float": _exactly(float, int),
    "str": _exactly(str),
    "bytes": _bytes,
    "tuple[float, ...]": _floats,
    "tuple[int, ...]": _ints,
    "tuple[tuple[float, ...], ...]": _rows,
    "ParameterValue": _exactly(bool, int, float, str),
}
#: Name and reader of each field by kind.
_FIELDS: Final = {
    name: [(spec.name, _READERS[str(spec.type)]) for spec in fields(kind)] for name, kind in _KINDS.items()
}
