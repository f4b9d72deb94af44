"""Names of the services of a live twin, and a check for the texts of marks."""

from __future__ import annotations

from typing import Final

SERVICES: Final = (
    "reset", "switch_publisher", "set_wear", "acknowledge_alarms", "snapshot", "restore", "mark", "forecast",
)  # fmt: skip
#: Largest length of the text of a mark [characters].
MOST_MARK: Final = 200


def mark_problem(text: str) -> str | None:
    """Return a message if the text of a mark is invalid, otherwise None."""
    if not text.strip() or len(text) > MOST_MARK:
        return f"text of a mark: got {len(text.strip())} characters, expected 1 to {MOST_MARK}"
    if not text.isprintable():
        return f"text of a mark: got {text[:60]!r}, expected printable characters in one line"
    return None
