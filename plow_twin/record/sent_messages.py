"""The recorded messages of a run as one sequence in the order of the journal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from plow_twin.record.chunks import Messages
from plow_twin.record.entries import OutputRecord, Outputs
from plow_twin.record.outputs import PUBLICATION_TOPICS
from plow_twin.record.template import Indexes


@dataclass(frozen=True)
class SentMessages:
    """Recorded messages of several chunks in the order of their sequence numbers.

    Attributes
    ----------
    parts : list of Outputs
        Messages of each chunk.
    begins : ndarray of int64, shape (k + 1,)
        Index of the first message of each part in the whole sequence. The last element is the number of all messages.
    sequence : ndarray of int64, shape (n,)
        Sequence number of each message.
    kind : ndarray of int64, shape (n,)
        Index of the topic of each message in `PUBLICATION_TOPICS`, or -1 if the topic is not in `PUBLICATION_TOPICS`.
    """

    parts: list[Outputs]
    begins: Indexes
    sequence: Indexes
    kind: Indexes

    @classmethod
    def of(cls, outputs: list[Outputs], topics: Mapping[str, str]) -> Self:
        """Collect messages; `topics` maps the topics that a replay can compute to their base names."""
        # many parts have the same dictionary of topics, so one table is created for each dictionary
        tables = {id(part.topics): _kinds(part.topics, topics) for part in outputs}
        sequence = _joined(part.sequence for part in outputs)
        kind = _joined(tables[id(part.topics)][part.messages.channel] for part in outputs)
        begins = np.cumsum([0, *map(len, outputs)])
        if (sequence[1:] < sequence[:-1]).any():
            # the messages are not in order, because another program wrote the file; a part of one message can be sorted
            order = np.argsort(sequence, kind="stable")
            owner = np.searchsorted(begins, order, side="right") - 1
            places = zip(owner.tolist(), (order - begins[owner]).tolist(), strict=True)
            outputs = [outputs[part][place : place + 1] for part, place in places]
            begins, sequence, kind = np.arange(len(order) + 1), sequence[order], kind[order]
        return cls(outputs, begins, sequence, kind)

    def __len__(self) -> int:
        return len(self.sequence)

    def before(self, sequence: int) -> int:
        """Return the number of messages that were sent before the journal entry with this sequence number."""
        return int(np.searchsorted(self.sequence, sequence))

    def record(self, index: int) -> OutputRecord:
        """Return the message at `index`."""
        part = int(np.searchsorted(self.begins, index, side="right")) - 1
        return self.parts[part].record(index - int(self.begins[part]))

    def pieces(self, begin: int, end: int) -> Iterator[tuple[Messages, int, int]]:
        """Yield the messages with the indexes `begin` to `end - 1`, chunk by chunk.

        The first integer is the index of the first message of a piece. The second integer is the index of the last
        message plus one.
        """
        first = int(np.searchsorted(self.begins, begin, side="right")) - 1
        while begin < end:
            origin, behind = self.begins[first : first + 2].tolist()
            stop, messages = min(end, behind), self.parts[first].messages
            whole = begin == origin and stop == behind
            yield messages if whole else messages[begin - origin : stop - origin], begin, stop
            begin, first = stop, first + 1


def _joined(arrays: Iterable[Indexes]) -> Indexes:
    return np.concatenate([np.zeros(0, np.int64), *arrays])


def _kinds(channels: Mapping[int, tuple[str, str]], topics: Mapping[str, str]) -> Indexes:
    lookup = np.full(max(channels, default=-1) + 1, -1)
    for channel, (topic, _) in channels.items():
        if topic in topics:
            lookup[channel] = PUBLICATION_TOPICS.index(topics[topic])
    return lookup
