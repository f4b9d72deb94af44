"""Read the numbers in the messages of a batch as arrays, which is faster than decoding each message."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.geometry import angle_of
from plow_twin.record.entries import Outputs, concatenated
from plow_twin.record.messages import JointState, Message, Odometry
from plow_twin.record.template import Indexes, Template, read_numbers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rows:
    """Numbers of the messages on one topic."""

    #: sequence number and stamp [ns] of each message, shape (n,)
    sequence: Indexes
    stamp_ns: Indexes
    #: numbers of each message, in the order of the template, shape (n, k)
    numbers: Array

    def __len__(self) -> int:
        return len(self.sequence)

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Return the rows of several chunks in one object."""
        return parts[0] if len(parts) == 1 else cls(*concatenated(parts, "sequence", "stamp_ns", "numbers"))


def poses_of(numbers: Array) -> Array:
    """Return x, y [m], theta [rad], shape (..., 3), of the numbers of `head_state`, shape (..., 7)."""
    theta = angle_of(numbers[..., 2:3], numbers[..., 3:4])
    return np.concatenate((numbers[..., :2], theta), axis=-1)


def rows_by_topic(
    outputs: list[Outputs], topics: Mapping[str, str], templates: Mapping[str, Template]
) -> dict[str, Rows]:
    """Return the numbers of all messages on each topic that has messages.

    `topics` maps each topic to its base name, and `templates` maps each base name to its template. A message with a
    string that differs from the template is decoded. A message with more or fewer values than the template is omitted.
    """
    by_topic: dict[str, list[Rows]] = {}
    for part in outputs:
        for channel, (topic, _) in part.topics.items():
            name = topics.get(topic)
            if name is None:
                continue
            chosen = np.flatnonzero(part.messages.channel == channel)
            if chosen.size:
                by_topic.setdefault(name, []).append(_rows(part, chosen, templates[name]))
    return {name: Rows.joined(parts) for name, parts in by_topic.items()}


def _rows(part: Outputs, chosen: Indexes, template: Template) -> Rows:
    messages, count = part.messages[chosen], len(chosen)
    stamps, numbers, good = np.zeros(count, np.int64), np.zeros((count, template.count)), np.zeros(count, bool)
    read_numbers(
        messages.buffer, messages.start, messages.length, template.data, template.fixed, template.places, stamps,
        numbers, good,
    )  # fmt: skip
    for index in np.flatnonzero(~good).tolist():
        try:
            message = part.record(int(chosen[index])).message()
        except RecordingError:
            continue
        values = _numbers(message)
        if values.shape == numbers[index].shape and isinstance(message, JointState | Odometry):
            stamps[index], numbers[index], good[index] = message.stamp_ns, values, True
    sequence = part.sequence[chosen]
    return Rows(sequence, stamps, numbers) if good.all() else Rows(sequence[good], stamps[good], numbers[good])


def _numbers(message: Message) -> Array:
    if isinstance(message, JointState):
        return np.concatenate((message.position, message.velocity, message.effort))
    if isinstance(message, Odometry):
        twist = (*message.linear[:2], message.angular[2])
        return np.array((*message.position[:2], *message.orientation[2:], *twist))
    return np.zeros(0)
