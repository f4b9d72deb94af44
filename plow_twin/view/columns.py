"""Rows collected into columns: rerun logs 20,000 rows at once in the time of one row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from plow_twin.record.template import compiled

Array = NDArray[np.float64]
Indexes = NDArray[np.int64]

BLOCK_ROWS: Final = 20_000
ROS_TIME: Final = "ros_time"
STEP: Final = "step"
#: Timeline that counts from the first stamp.
RUN_TIME: Final = "run_time"


class TimeAxis:
    """The timelines of all curves; the run's time counts from `first_ns`."""

    def __init__(self) -> None:
        self.first_ns: int | None = None

    def columns(self, stamps: Indexes, steps: Indexes) -> list[rr.TimeColumn]:
        """Return the timelines of rows."""
        since = (stamps - (self.first_ns or 0)).astype("timedelta64[ns]")
        return [
            rr.TimeColumn(ROS_TIME, timestamp=stamps.astype("datetime64[ns]")),
            rr.TimeColumn(RUN_TIME, duration=since),
            rr.TimeColumn(STEP, sequence=steps),
        ]


class Curves:
    """Curves with common times, each an entity of its own.

    With `span_ns`, a curve keeps only the least and the largest value in each span of stamps, so that no peak is lost.
    `rows` counts the rows added, and `sent` the values of the first curve that were sent.
    """

    def __init__(self, stream: rr.RecordingStream, axis: TimeAxis, entities: Sequence[str], span_ns: int = 0) -> None:
        self._stream = stream
        self._axis = axis
        self.span_ns = span_ns
        self.entities = tuple(entities)
        self._parts: list[tuple[Indexes, Indexes, Array]] = []
        self._ends: list[NDArray[np.bool_]] = []  # whether the lines end at each row of a part
        self._last: tuple[Indexes, Indexes] | None = None
        self._waiting = self.rows = self.sent = 0

    @property
    def thinned(self) -> bool:
        """Whether the curves are thinned to the extremes of spans."""
        return self.span_ns > 0

    def add(self, stamps: Indexes, steps: Indexes, values: Array) -> None:
        """Add rows, shapes (n,), (n,) and (n, number of entities)."""
        if len(stamps):
            self._append(stamps, steps, values, ends=False)
            self._last = stamps[-1:] + 1, steps[-1:]
            self._waiting += len(stamps)
            self.rows += len(stamps)
        if self._waiting >= BLOCK_ROWS:
            self.flush()

    def end(self) -> None:
        """End the lines; the next row begins new ones."""
        if self._last is not None:
            self._append(*self._last, np.zeros((1, len(self.entities))), ends=True)
        self._last = None

    def _append(self, stamps: Indexes, steps: Indexes, values: Array, *, ends: bool) -> None:
        self._parts.append((stamps, steps, values))
        self._ends.append(np.full(len(stamps), ends))

    def flush(self) -> None:
        """Send the collected rows."""
        if not self._parts:
            return
        stamps, steps, values = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        ends = np.concatenate(self._ends)
        self._parts, self._ends, self._waiting = [], [], 0
        everywhere = np.arange(len(stamps))
        kept = extremes(self._spans(stamps, ends), values) if self.span_ns else None
        every = self._axis.columns(stamps, steps) if kept is None else None
        for entity, number in zip(self.entities, range(values.shape[1]), strict=True):
            chosen = everywhere if kept is None else np.flatnonzero(kept[:, number])
            valued = chosen[~ends[chosen]]
            self.sent += len(valued) if number == 0 else 0
            columns = rr.Scalars.columns(scalars=np.ascontiguousarray(values[valued, number]))
            if len(valued) < len(chosen):
                columns = columns.partition((~ends[chosen]).astype(np.int64))
            indexes = self._axis.columns(stamps[chosen], steps[chosen]) if every is None else every
            rr.send_columns(entity, indexes, columns, recording=self._stream)

    def _spans(self, stamps: Indexes, ends: NDArray[np.bool_]) -> Indexes:
        """Return the number of each row's span; a row that ends a line has a span of its own."""
        spans = stamps // self.span_ns
        after = np.concatenate(([False], ends[:-1]))
        changes: Indexes = np.cumsum((np.diff(spans, prepend=spans[0]) != 0) | ends | after)
        return changes


@compiled
def extremes(spans, values):  # type: ignore[no-untyped-def]
    """Mark the first least and the first largest value of each column, (n, k), in each run of equal `spans`, (n,)."""
    count, columns = values.shape
    kept = np.zeros((count, columns), np.bool_)
    for k in range(columns):
        least = largest = 0
        for n in range(1, count + 1):
            if n == count or spans[n] != spans[n - 1]:
                kept[least, k] = kept[largest, k] = True
                least = largest = n
            elif values[n, k] < values[least, k]:
                least = n
            elif values[n, k] > values[largest, k]:
                largest = n
    return kept


class Batches:
    """An entity with several instances in each row, such as the arrows at one instant."""

    def __init__(
        self, stream: rr.RecordingStream, axis: TimeAxis, entity: str, archetype: Any, fields: Sequence[str]
    ) -> None:
        self._stream = stream
        self._axis = axis
        self._entity = entity
        self._archetype = archetype
        self._fields = tuple(fields)
        self._stamps: list[int] = []
        self._steps: list[int] = []
        self._values: dict[str, list[Any]] = {name: [] for name in self._fields}
        self._lengths: list[int] = []

    def add(self, stamp_ns: int, step: int, **values: Sequence[Any] | Array) -> None:
        """Add a row, with as many instances in each field."""
        lengths = {name: len(values[name]) for name in self._fields}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"{self._entity}: got {lengths} instances, expected as many in each")
        self._stamps.append(stamp_ns)
        self._steps.append(step)
        self._lengths.append(lengths[self._fields[0]])
        for name in self._fields:
            self._values[name].extend(values[name])
        if len(self._stamps) >= BLOCK_ROWS // 10:
            self.flush()

    def flush(self) -> None:
        """Send the collected rows."""
        if not self._lengths:
            return
        columns = self._archetype.columns(**self._values).partition(self._lengths)
        indexes = self._axis.columns(np.array(self._stamps, np.int64), np.array(self._steps, np.int64))
        rr.send_columns(self._entity, indexes, columns, recording=self._stream)
        self._stamps, self._steps, self._lengths = [], [], []
        self._values = {name: [] for name in self._fields}


def buffers(*owners: object) -> Iterator[Curves | Batches]:
    """Yield the curves and batches among the owners' attributes."""
    for owner in owners:
        for value in vars(owner).values():
            if isinstance(value, Curves | Batches):
                yield value
