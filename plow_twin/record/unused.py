"""Count the input messages of a run, and list the unused messages, from the journal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plow_twin.record.entries import Entries
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.reader import RunReader
from plow_twin.stream.journal import Entry, Gaps, PartOfPose, Pose, Sample, Travel, Unused


@dataclass
class InputCounts:
    """Number of input messages, by input and by outcome.

    The outcome is `used`, or the reason in an entry of the type `Unused`. The counts of the input `source`, without
    `not_followed`, add up to the number of messages that the publisher sent.
    """

    source: str
    counts: dict[str, Counter[str]] = field(default_factory=dict)

    def add(self, entries: Entries) -> None:
        """Count the messages in a batch of journal entries."""
        self._count(self.source, "used", int(entries.sample.sum()))
        for entry in entries.rest.values():
            self.add_entry(entry)

    def add_entry(self, entry: Entry | Dropped) -> None:
        """Count the messages in one journal entry."""
        match entry:
            case Sample():
                self._count(self.source, "used", 1)
            case Unused(topic, _, reason, count):
                self._count(topic, reason, count)
            case Travel():
                self._count("travel", "used", 1)
            case Pose() | PartOfPose():
                self._count("head_pose", "used", 1)
            case Gaps():
                self._count("gaps", "used", 1)

    def facts(self) -> dict[str, dict[str, int]]:
        """Return all counts except zeros."""
        return {
            topic: {reason: count for reason, count in reasons.items() if count}
            for topic, reasons in self.counts.items()
        }

    def _count(self, topic: str, reason: str, count: int) -> None:
        if count:
            self.counts.setdefault(topic, Counter())[reason] += count


def unused_messages(path: Path) -> Iterator[dict[str, Any]]:
    """Yield a row for each unused message in the journal of a run: input, sender, reason, stamp and values.

    For some messages, the journal contains only their number. These messages have one common row, which contains the
    number as `count` and has no stamp. Raise `RecordingError` if the path is not a recording of plow_twin, or its
    journal cannot be decoded.
    """
    for batch in RunReader(path).batches(outputs=False):
        for _, entry in sorted(batch.entries.others.items()):
            if not isinstance(entry, Unused):
                continue
            common = {"input": entry.topic, "sender": entry.sender, "reason": entry.reason}
            for stamp_ns, values in zip(entry.stamps_ns, entry.values, strict=True):
                yield common | {"count": 1, "stamp_ns": stamp_ns, "values": values}
            untold = entry.count - len(entry.stamps_ns)
            if untold:
                yield common | {"count": untold, "stamp_ns": None, "values": ()}
