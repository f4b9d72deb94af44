"""What arrived and was not used, for the journal: from whom, why, with stamp and values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from plow_twin.stream.journal import Unused

#: Messages told in full by one entry of the journal; of those beyond it, until the entry is written, only the count.
_MOST: Final = 500


@dataclass
class _Pending:
    """Messages of one input, sender and reason since the last entry of them."""

    count: int = 0
    stamps_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)


class UnusedMessages:
    """Collect messages that are not used, so that a flood of them makes few entries of the journal."""

    def __init__(self) -> None:
        #: receives the entries; None: nobody wants them
        self.journal: Callable[[Unused], object] | None = None
        #: tells the name of a sender of an input
        self.name_of: Callable[[str, bytes], str] = lambda topic, sender: sender.decode(errors="replace")
        self._pending: dict[tuple[str, bytes, str], _Pending] = {}

    def note(self, topic: str, sender: bytes, reason: str, stamp_ns: int, values: Sequence[float]) -> None:
        """Take note of one message."""
        if self.journal is None:
            return
        pending = self._pending.setdefault((topic, sender, reason), _Pending())
        pending.count += 1
        if len(pending.stamps_ns) < _MOST:
            pending.stamps_ns.append(stamp_ns)
            pending.values.append(tuple(map(float, values)))

    def note_lost(self, topic: str, sender: bytes, count: int) -> None:
        """Take note of messages that were sent and have not arrived; a `count` below 0: that came after all."""
        if self.journal is not None and count:
            self._pending.setdefault((topic, sender, "lost"), _Pending()).count += count

    def flush(self) -> None:
        """Hand over what has been collected."""
        pending, self._pending = self._pending, {}
        for (topic, sender, reason), found in pending.items():
            if self.journal is not None and found.count:
                name = self.name_of(topic, sender)
                rows = tuple(found.stamps_ns), tuple(found.values)
                self.journal(Unused(topic, name, reason, found.count, *rows))
