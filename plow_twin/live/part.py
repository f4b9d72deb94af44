"""A part of the messages on `/diagnostics`, and other messages in the same form."""

from __future__ import annotations

import math

from plow_twin.record.messages import DiagnosticStatus, JointState, Message

#: Level (0 OK, 1 WARN, 2 ERROR), message and values of one part.
Part = tuple[int, str, dict[str, str]]


def part_of(message: Message) -> Part:
    """Return a status or named numbers as a part. A message of another type gives an empty part."""
    if isinstance(message, DiagnosticStatus):
        return message.level, message.message, dict(message.values)
    if not isinstance(message, JointState):
        return 0, "", {}
    values = message.position if len(message.position) else message.effort
    return 0, "", {name: repr(value) for name, value in zip(message.name, values.tolist(), strict=False)}


def number_of(text: str) -> float | None:
    """Return the number that a value contains, or None if the value is not a finite number."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
