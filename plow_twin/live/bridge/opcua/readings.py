"""Convert values of OPC UA to numbers with stamps."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from plow_twin.live.bridge.opcua.samples import NOT_MEASURED, Value
from plow_twin.record.times import EPOCH, FARTHEST_NS, datetime_ns

_SEVERITY: Final = 0xC0000000
_UNCERTAIN: Final = 0x40000000
#: These status bits of a value show that the server's queue dropped earlier values.
_OVERFLOW: Final = 0x00000480


@dataclass
class Counts:
    """Numbers of values from a server, of lost messages, and of broken connections."""

    values: int = 0
    bad: int = 0
    uncertain: int = 0
    not_numbers: int = 0
    unstamped: int = 0
    #: messages that are missing by their sequence numbers, and that the server could not repeat
    notifications_lost: int = 0
    #: values before which the queue of the server overflowed
    overflows: int = 0
    breaks: int = 0
    breaks_filled: int = 0
    values_filled: int = 0
    #: values of the history with stamps that were not requested
    history_strays: int = 0
    #: time without values in the messages and in the history [s]
    unfilled_s: float = 0.0


def overflowed(value: Any) -> bool:
    """Return whether the server dropped values before this value."""
    return value.StatusCode is not None and value.StatusCode.value & _OVERFLOW == _OVERFLOW


def reading(data: Any, by_server: bool, counts: Counts) -> tuple[int, Value] | None:
    """Return the stamp [ns] and the value of a `DataValue`, or None if it has no stamp.

    With `by_server`, the stamp is the timestamp of the server. Without `by_server`, the stamp is the source timestamp
    or, if it is missing, the timestamp of the server. If the value is not a number, or if its status is Bad or
    Uncertain, the value in the result is `NOT_MEASURED`.
    """
    counts.values += 1
    stamp_ns = None if by_server else _stamp_ns(data.SourceTimestamp, data.SourcePicoseconds)
    if stamp_ns is None:
        stamp_ns = _stamp_ns(data.ServerTimestamp, data.ServerPicoseconds)
    if stamp_ns is None:
        counts.unstamped += 1
        return None
    severity = 0 if data.StatusCode is None else data.StatusCode.value & _SEVERITY
    value = data.Value.Value if data.Value is not None else None
    if severity:
        counts.uncertain += severity == _UNCERTAIN
        counts.bad += severity != _UNCERTAIN
        return stamp_ns, NOT_MEASURED
    if isinstance(value, bool) or not isinstance(value, int | float):
        counts.not_numbers += 1
        return stamp_ns, NOT_MEASURED
    return stamp_ns, float(value)


def _stamp_ns(time: datetime | None, picoseconds: int | None) -> int | None:
    """Return a time as a stamp [ns], or None if the time is missing or invalid.

    `picoseconds` is the remainder of the time below 100 ns, which is the resolution of times in OPC UA.
    """
    if time is None:
        return None
    stamp_ns = datetime_ns(time) + (picoseconds or 0) // 100
    return stamp_ns if 0 < stamp_ns < FARTHEST_NS else None  # without a time, servers send a date in 1601 or 9999


def date_of(stamp_ns: int) -> datetime:
    """Return a stamp as a date, truncated to microseconds."""
    return EPOCH + timedelta(microseconds=stamp_ns // 1000)
