"""Buffers of rows for rerun. One call of rerun logs 20,000 rows as fast as a single row."""

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
#: Timeline of the time since the first stamp.
RUN_TIME: Final = "run_time"


class TimeAxis:
    """The timelines of all curves. The time of the run is counted from the stamp `first_ns`."""

    def __init__(self) -> None:
        self.first_ns: int | None = None

    def columns(self, stamps: Indexes, steps: Indexes) -> list[rr.TimeColumn]:
        """Return the columns of all timelines for rows, shape (n,)."""
        since = (stamps - (self.first_ns or 0)).astype("timedelta64[ns]")
        return [
            rr.TimeColumn(ROS_TIME, timestamp=stamps.astype("datetime64[ns]")),
            rr.TimeColumn(RUN_TIME, duration=since),
            rr.TimeColumn(STEP, sequence=steps),
        ]


class Curves:
    """Curves with common times. Each curve is a rerun entity of its own.

    With `span_ns`, only two values of each curve are sent for each span of stamps: the least and the largest. No peak
    is lost. `rows` counts the rows added, and `sent` counts the values sent for the first curve.
    """

    def __init__(self, stream: rr.RecordingStream, axis: TimeAxis, entities: Sequence[str], span_ns: int = 0) -> None:
        self._stream = stream
        self._axis = axis
        self.span_ns = span_ns
        self.entities = tuple(entities)
        self._parts: list[tuple[Indexes, Indexes, Array]] = []
        self._ends: list[NDArray[np.bool_]] = []  # True for each row of a part at which all lines end
        self._last: tuple[Indexes, Indexes] | None = None
        self._waiting = self.rows = self.sent = 0

    def add(self, stamps: Indexes, steps: Indexes, values: Array) -> None:
        """Add stamps [ns], shape (n,), steps, shape (n,), and values, shape (n, number of entities)."""
        if len(stamps):
            self._append(stamps, steps, values, ends=False)
            self._last = stamps[-1:] + 1, steps[-1:]
            self._waiting += len(stamps)
            self.rows += len(stamps)
        if self._waiting >= BLOCK_ROWS:
            self.flush()

    def end(self) -> None:
        """End the line of each curve. The next row begins a new line of each curve."""
        if self._last is not None:
            self._append(*self._last, np.zeros((1, len(self.entities))), ends=True)
        self._last = None

    def _append(self, stamps: Indexes, steps: Indexes, values: Array, *, ends: bool) -> None:
        self._parts.append((stamps, steps, values))
        self._ends.append(np.full(len(stamps), ends))

    def flush(self) -> None:
        """Send the buffered rows."""
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
        """Return the number of the span of each row. A row that ends a line has its own span."""
        spans = stamps // self.span_ns
        after = np.concatenate(([False], ends[:-1]))
        changes: Indexes = np.cumsum((np.diff(spans, prepend=spans[0]) != 0) | ends | after)
        return changes


@compiled
def extremes(spans, values):  # type: ignore[no-untyped-def]
    """Mark the first least and the first largest value of each column.

    `values` has shape (n, k). Successive rows with equal numbers in `spans`, shape (n,), form one group with extremes
    of its own.
    """
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
    """Buffer of an entity with several instances in each row, such as all force arrows at one stamp."""

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
        """Add a row. All fields must have the same number of instances."""
        lengths = {name: len(values[name]) for name in self._fields}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"{self._entity}: got {lengths} instances, expected equal numbers")
        self._stamps.append(stamp_ns)
        self._steps.append(step)
        self._lengths.append(lengths[self._fields[0]])
        for name in self._fields:
            self._values[name].extend(values[name])
        if len(self._stamps) >= BLOCK_ROWS // 10:
            self.flush()

    def flush(self) -> None:
        """Send the buffered rows."""
        if not self._lengths:
            return
        columns = self._archetype.columns(**self._values).partition(self._lengths)
        indexes = self._axis.columns(np.array(self._stamps, np.int64), np.array(self._steps, np.int64))
        rr.send_columns(self._entity, indexes, columns, recording=self._stream)
        self._stamps, self._steps, self._lengths = [], [], []
        self._values = {name: [] for name in self._fields}


def buffers(owner: object) -> Iterator[Curves | Batches]:
    """Yield all `Curves` and `Batches` among the attributes of an object."""
    return (value for value in vars(owner).values() if isinstance(value, Curves | Batches))
