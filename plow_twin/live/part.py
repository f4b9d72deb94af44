"""The form of a part of `/diagnostics`."""

from __future__ import annotations

#: Level (0 OK, 1 WARN, 2 ERROR), message and values of one part.
Part = tuple[int, str, dict[str, str]]
