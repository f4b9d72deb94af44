"""Encode the messages of a publication; one compiled call writes all messages that contain the same record."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from plow_twin.record.outputs import template
from plow_twin.record.template import STAMP_AT, compiled, stamp_word
from plow_twin.record.words import bits, set_word, word
from plow_twin.solve.state import ROW
from plow_twin.stream.outputs import NOTHING, Published
from plow_twin.stream.topics import Cadence, Topic, topics_of

#: Size of each number in a record [B].
_WORD: Final = 8


class Messages:
    """Encoder that writes the messages of each publication to the same memory.

    `frame_id` and `child_frame_id` are the frames in the messages. With `intervals`, the encoder has additional
    messages that contain the intervals from the 5 % to the 95 % quantile of the forces.
    """

    def __init__(self, frame_id: str, child_frame_id: str, *, intervals: bool = False) -> None:
        self._each, self._slow, self._marked, followed = groups = [
            _Group.of(topics_of(cadence), frame_id, child_frame_id)
            for cadence in (Cadence.EACH, Cadence.SLOW, Cadence.MARKED, Cadence.FOLLOWED)
        ]
        self._followed = followed if intervals else None
        #: memory that contains the message of each topic, by base name
        self.memory = dict(part for group in groups[: 3 + intervals] for part in group.parts)

    def write(self, published: Published) -> tuple[tuple[str, memoryview], ...]:
        """Return the base names and bytes of the messages of a publication that has one row, in the order of sending.

        The result is empty if a number is not finite. The method `intervals` returns the messages with intervals. The
        next call of `write` overwrites the bytes.
        """
        rows, slow = published
        if not self._each.fill(rows) or (len(slow) and not self._slow.fill(slow)):
            return ()
        parts = self._each.parts
        if len(slow):
            parts += self._slow.parts
        if rows["marked"][0]:
            self._marked.fill(rows)
            parts += self._marked.parts
        return parts

    def intervals(self, published: Published) -> tuple[tuple[str, memoryview], ...]:
        """Return the messages with the intervals of a publication, in the form of `write`."""
        followed = self._followed
        return followed.parts if followed and published.with_intervals and followed.fill(published.rows) else ()


class _Group(NamedTuple):
    """Buffer with the messages that contain the same record. Only the stamps and numbers change."""

    #: base name of each topic, and the part of `buffer` that contains its message
    parts: tuple[tuple[str, memoryview], ...]
    buffer: NDArray[np.uint8]
    #: offset of each message in the buffer [B]
    starts: NDArray[np.int64]
    #: offset of each number in the buffer [B]
    places: NDArray[np.int64]
    #: offset of each number in the record [words of 8 bytes]
    sources: NDArray[np.int64]
    #: whether each number is an integer in the record
    integers: NDArray[np.bool_]

    @classmethod
    def of(cls, topics: tuple[Topic, ...], frame_id: str, child_frame_id: str) -> Self:
        templates = [template(topic, frame_id, child_frame_id) for topic in topics]
        ends = np.cumsum([0, *map(len, templates)])
        buffer = np.concatenate([template.data for template in templates])
        parts = [
            (topic.name, buffer.data[begin:end]) for topic, begin, end in zip(topics, ends, ends[1:], strict=False)
        ]
        places = np.concatenate([begin + template.places for begin, template in zip(ends, templates, strict=False)])
        sources, integers = (np.concatenate(columns) for columns in zip(*map(_sources, topics), strict=True))
        return cls(tuple(parts), buffer, ends[:-1].copy(), places, sources, integers)

    def fill(self, records: NDArray[np.void]) -> bool:
        stamp_ns, numbers = records["stamp_ns"], records.view(np.float64)
        return bool(_write(numbers, stamp_ns, self.buffer, self.starts, self.places, self.sources, self.integers))


def _sources(topic: Topic) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the offset of each number of a message in the record [words of 8 bytes], and whether it is an integer."""
    fields: Any = topic.record_type.fields
    places = [fields[name][1] // _WORD + np.arange(count) for name, count in topic.parts]
    integers = [np.full(count, fields[name][0].base.kind == "i") for name, count in topic.parts]
    return np.concatenate(places), np.concatenate(integers)


def warm_up() -> None:
    """Compile the kernel, or load it from the cache on the disk."""
    Messages("", "").write(Published(np.zeros(1, ROW), NOTHING.slow))


@compiled
def _write(numbers, stamps, buffer, starts, places, sources, integers):  # type: ignore[no-untyped-def]
    stamp = stamp_word(stamps[0])
    for start in starts:
        set_word(buffer, start + STAMP_AT, stamp)
    total = 0.0
    for k in range(places.size):
        number = numbers[sources[k]]
        if integers[k]:
            number = float(word(numbers, 8 * sources[k]))
        set_word(buffer, places[k], bits(number))
        total += number
    return np.isfinite(total)
