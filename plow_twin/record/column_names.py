"""Recognise the column of the time and the unit in the name of a column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from plow_twin.record.times import TIMES

#: Pattern of the names of a column of times. It is matched with the result of `plain_name`.
TIME_NAMES: Final = r"t|time|timestamp|stamp|zeit|zeitstempel|date|datetime|datum"
#: Description of the names of a column of times, for messages.
TIME_EXPECTED: Final = "t, time, timestamp or stamp, also with a unit such as time_ms"
_UNIT: Final = re.compile(
    r"(.+?)\s*(?:[\[(]\s*([^\])]+?)\s*[\])]|[ _](kN ?m|N ?m|kN|N|mm|cm|m|mrad|rad|deg|ms|us|ns|s))"
)


def time_column(names: Sequence[str]) -> str | None:
    """Return the name of the column of times, or None if no name or several names fit.

    A column `t` or `time` precedes a column with a similar name.
    """
    exact = next((name for name in TIMES if name in names), None)
    alike = [name for name in names if re.fullmatch(TIME_NAMES, plain_name(name))]
    return exact or (alike[0] if len(alike) == 1 else None)


def unit_of(name: str) -> str:
    """Return the unit at the end of a column's name, or an empty text without a unit."""
    match = _UNIT.fullmatch(name)
    unit = (match[2] or match[3]) if match else ""
    return {"Nm": "N m", "kNm": "kN m", "°": "deg", "µm": "um", "sec": "s"}.get(unit, unit)


def plain_name(name: str) -> str:
    """Return a column's name in lower case, without its unit and without signs other than letters and digits."""
    match = _UNIT.fullmatch(name)
    return re.sub(r"[^a-z0-9]", "", (match[1] if match else name).lower())
