"""Rows collected into columns: rerun takes 20 thousand rows at once at the cost of one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

#: Rows kept in memory before they are sent.
BLOCK_ROWS: Final = 20_000
ROS_TIME: Final = "ros_time"
STEP: Final = "step"
#: Time since the first stamp.
RUN_TIME: Final = "run_time"


class TimeAxis:
    """The timelines of a block of rows."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._steps: list[int] = []
        self._first_ns: int | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, step: int) -> None:
        """Add one row."""
        self._stamps.append(stamp_ns)
        self._steps.append(step)

    def take(self) -> list[rr.TimeColumn]:
        """Return the timelines and begin anew."""
        return self.columns(*self.take_arrays())

    def take_arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return stamps and steps and begin anew."""
        stamps, steps = np.array(self._stamps, np.int64), np.array(self._steps, np.int64)
        self._stamps, self._steps = [], []
        return stamps, steps

    def columns(self, stamps: NDArray[np.int64], steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
        """Return the timelines of some rows."""
        if self._first_ns is None and len(stamps):
            self._first_ns = int(stamps[0])
        since = (stamps - (self._first_ns or 0)).astype("timedelta64[ns]")
        return [
            rr.TimeColumn(ROS_TIME, timestamp=stamps.astype("datetime64[ns]")),
            rr.TimeColumn(RUN_TIME, duration=since),
            rr.TimeColumn(STEP, sequence=steps),
        ]


class Curves:
    """Some curves with common times: row by row in, one entity per curve out.

    With `span_ns` a curve keeps the least and the largest value in each such span of stamps: no peak is lost.
    """

    def __init__(self, stream: rr.RecordingStream, entities: Sequence[str], span_ns: int = 0) -> None:
        self._stream = stream
        self._span_ns = span_ns
        self.entities = tuple(entities)
        self._axis = TimeAxis()
        self._rows: list[Any] = []
        self.sent = 0

    def add(self, stamp_ns: int, step: int, values: Any) -> None:
        """Add one row, shape (number of entities,)."""
        self._axis.add(stamp_ns, step)
        self._rows.append(values)
        if len(self._axis) >= BLOCK_ROWS:
            self.flush()

    def flush(self) -> None:
        """Send what has been collected."""
        if not self._rows:
            return
        values = np.asarray(self._rows, dtype=np.float64)
        self._rows = []
        self.sent += len(values)
        stamps, steps = self._axis.take_arrays()
        indexes = self._axis.columns(stamps, steps)
        for entity, column in zip(self.entities, values.T, strict=True):
            if self._span_ns:
                kept = extremes(stamps // self._span_ns, column)
                indexes, column = self._axis.columns(stamps[kept], steps[kept]), column[kept]
            rr.send_columns(entity, indexes, rr.Scalars.columns(scalars=column), recording=self._stream)


def extremes(spans: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the places of the least and the largest value in each run of equal `spans`, in order."""
    starts = np.flatnonzero(np.concatenate(([True], spans[1:] != spans[:-1])))
    counts = np.diff(np.append(starts, len(spans)))
    places = np.arange(len(values))
    kept = []
    for reduce in (np.minimum, np.maximum):
        bound = np.repeat(reduce.reduceat(values, starts), counts)
        kept.append(np.minimum.reduceat(np.where(values == bound, places, len(values)), starts))
    found = np.unique(np.concatenate(kept))
    return found[found < len(values)]


class Batches:
    """One entity whose rows hold several instances each, such as the arrows of one moment."""

    def __init__(self, stream: rr.RecordingStream, entity: str, archetype: Any, fields: Sequence[str]) -> None:
        self._stream = stream
        self._entity = entity
        self._archetype = archetype
        self._fields = tuple(fields)
        self._axis = TimeAxis()
        self._values: dict[str, list[Any]] = {name: [] for name in self._fields}
        self._lengths: list[int] = []

    def add(self, stamp_ns: int, step: int, **values: Sequence[Any] | NDArray[np.float64]) -> None:
        """Add one row; all fields have as many instances."""
        self._axis.add(stamp_ns, step)
        lengths = {name: len(values[name]) for name in self._fields}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"{self._entity}: got {lengths} instances, expected as many in each")
        self._lengths.append(lengths[self._fields[0]])
        for name in self._fields:
            self._values[name].extend(values[name])
        if len(self._axis) >= BLOCK_ROWS // 10:
            self.flush()

    def flush(self) -> None:
        """Send what has been collected."""
        if not self._lengths:
            return
        columns = self._archetype.columns(**self._values).partition(self._lengths)
        rr.send_columns(self._entity, self._axis.take(), columns, recording=self._stream)
        self._values = {name: [] for name in self._fields}
        self._lengths = []


def buffers(*owners: object) -> Iterator[Curves | Batches]:
    """Yield all curves and batches that the owners hold as attributes."""
    for owner in owners:
        for value in vars(owner).values():
            if isinstance(value, Curves | Batches):
                yield value
