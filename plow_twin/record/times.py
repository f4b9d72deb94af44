"""Convert the times in messages and tables, which are numbers or dates, to stamps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: Names of the column or key that contains the time, unless the mapping states another name.
TIMES: Final = ("t", "time")
#: Length of each unit of time [ns].
STAMP_UNITS: Final = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
#: Time of a message whose time is unknown [ns].
NO_TIME: Final = -1
NUMBER: Final = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|inf|nan)", re.IGNORECASE)
EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_NANOSECONDS: Final = re.compile(r"[.,]\d{6}(\d{1,3})")
#: Smallest time that is read as a date [s]. `START_NS` is added to a smaller time, because a stamp of 0 means that the
#: stamp is missing.
EPOCH_S: Final = 1e9
#: Stamp of the time 0 [ns].
START_NS: Final = 1_000_000_000
OF_NUMBERS: Final = b"0123456789+-.eE "
#: Latest time that is accepted [ns]. Databases and servers write a later date, such as 9999-12-31, for a missing date.
FARTHEST_NS: Final = 4_000_000_000_000_000_000


def time_ns(value: Any, unit: str = "s") -> int | None:
    """Return the stamp [ns] of a number or of an ISO 8601 text, or None for any other value.

    A text without a time zone is in UTC.
    """
    if isinstance(value, str):
        value = value.strip()
        # a text such as 20260102 is a valid date, but it is read as a number
        if value.isascii() and value.isdigit() and len(value) < 20:
            value = int(value)
        elif NUMBER.fullmatch(value):
            value = float(value)
        else:
            return _within(_date_ns(value))
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e19:
        return None
    scale = STAMP_UNITS[unit]
    # an integer is not converted to a float, which resolves the time since 1970 only to 0.2 us
    stamp_ns = _within(value * scale if isinstance(value, int) else round(value * scale))
    return stamp_ns if stamp_ns is None or stamp_ns >= EPOCH_S * 1e9 else stamp_ns + START_NS


def likely_unit(value: Any) -> str | None:
    """Return the coarsest unit in which a number is a date, or None if the number is a valid time in seconds."""
    if time_ns(value) is not None:
        return None
    return next((unit for unit in STAMP_UNITS if (time_ns(value, unit) or 0) >= EPOCH_S * 1e9), None)


def times_ns(texts: Sequence[bytes], unit: str) -> NDArray[np.int64] | None:
    """Return the stamps [ns] that `time_ns` returns for each text, shape (n,), or None if a text is not a time."""
    try:
        numbers = np.array(list(map(float, texts))) * STAMP_UNITS[unit]
    except ValueError:
        numbers = None
    if numbers is None or not (np.abs(numbers) < FARTHEST_NS).all() or b"".join(texts).translate(None, OF_NUMBERS):
        found = [time_ns(text.decode(errors="replace"), unit) for text in texts]
        return None if None in found else np.array(found, np.int64)
    stamps: NDArray[np.int64] = np.rint(numbers).astype(np.int64)
    stamps[stamps < EPOCH_S * 1e9] += START_NS
    for place, text in enumerate(texts):
        if b"." not in text:  # an integer is exact to the nanosecond, and a float is not
            stamp_ns = time_ns(text.decode(), unit)
            if stamp_ns is None:
                return None
            stamps[place] = stamp_ns
    return stamps


def time_text(stamp_ns: int, *, own_start: bool = False) -> str:
    """Return a stamp as a date or, if it is below `EPOCH_S`, as a number of seconds.

    With `own_start`, `START_NS` is subtracted from the number of seconds, because `time_ns` has added it.
    """
    if stamp_ns < EPOCH_S * 1e9:
        return f"{(stamp_ns - (START_NS if own_start else 0)) * 1e-9:.3f} s"
    date = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
    return f"{date:%Y-%m-%d %H:%M:%S}.{stamp_ns // 10**6 % 1000:03d} UTC"


def _within(stamp_ns: int | None) -> int | None:
    return None if stamp_ns is None or abs(stamp_ns) > FARTHEST_NS else stamp_ns


def _date_ns(text: str) -> int | None:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    digits = _NANOSECONDS.search(text)  # the digits after the microseconds, which a datetime drops
    return datetime_ns(time) + (int(digits[1].ljust(3, "0")) if digits else 0)


def datetime_ns(time: datetime) -> int:
    """Return a date as a stamp [ns]. A date without a time zone is in UTC."""
    time = time if time.tzinfo else time.replace(tzinfo=UTC)
    return (time - EPOCH) // timedelta(microseconds=1) * 1000
