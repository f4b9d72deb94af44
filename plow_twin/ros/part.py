"""What one part of `/diagnostics` says."""

from __future__ import annotations

#: Level, message and values of one part.
Part = tuple[bytes, str, dict[str, str]]
