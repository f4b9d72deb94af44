"""Collect unused messages for the journal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from plow_twin.stream.journal import Unused

#: Largest number of messages with stamps and values in a journal entry. If there are more messages, the excess is only
#: counted.
_MOST: Final = 500


@dataclass
class _Pending:
    count: int = 0
    stamps_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)


class UnusedMessages:
    """Collector of unused messages, which combines many messages in one journal entry.

    If `wanted` is False, messages are ignored.
    """

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted
        self._pending: dict[tuple[str, bytes, str], _Pending] = {}

    def note(self, topic: str, sender: bytes, reason: str, stamp_ns: int, values: Sequence[float]) -> None:
        """Add an unused message."""
        if not self._wanted:
            return
        pending = self._pending.setdefault((topic, sender, reason), _Pending())
        pending.count += 1
        if len(pending.stamps_ns) < _MOST:
            pending.stamps_ns.append(stamp_ns)
            pending.values.append(tuple(map(float, values)))

    def note_lost(self, topic: str, sender: bytes, count: int) -> None:
        """Add messages that have not arrived. A negative `count` removes messages that have arrived late."""
        if self._wanted and count:
            self._pending.setdefault((topic, sender, "lost"), _Pending()).count += count

    def pop_all(self, name_of: Callable[[str, bytes], str]) -> list[Unused]:
        """Return and remove the journal entries; `name_of` returns the name of a sender of an input."""
        pending, self._pending = self._pending, {}
        return [
            Unused(topic, name_of(topic, sender), reason, count.count, tuple(count.stamps_ns), tuple(count.values))
            for (topic, sender, reason), count in pending.items()
            if count.count
        ]
