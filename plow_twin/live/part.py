"""Type of a part of the messages on `/diagnostics`."""

from __future__ import annotations

import math

#: Level (0 OK, 1 WARN, 2 ERROR), message and values of one part.
Part = tuple[int, str, dict[str, str]]


def number_of(text: str) -> float | None:
    """Return the number that a value contains, or None if the value is not a finite number."""
    try:
        found = float(text)
    except ValueError:
        return None
    return found if math.isfinite(found) else None
