"""Read a recording as tables of numbers for numpy, pandas and Arrow, in batches or as a whole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.scene import Scene
from plow_twin.record.entries import Batch
from plow_twin.record.header import RunHeader
from plow_twin.record.outputs import REPLAYED, publication_templates
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.rows import Rows, poses_of, rows_by_topic
from plow_twin.stream.journal import PartOfPose, Pose, whole_pose
from plow_twin.stream.topics import JOINT_STATE, Topic

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Array = NDArray[np.float64]
Indexes = NDArray[np.int64]

_POSE: Final = ("x", "y", "theta")
#: Name in the tables of each quantity that has another name in the record.
_NAMES: Final = {"makes": "touches"}


def _columns_of(topic: Topic) -> tuple[str, ...]:
    """Return the column names of the table of a topic: `<name>/<quantity>` if it has several quantities."""
    if topic.type != JOINT_STATE:
        return *_POSE, "velocity_x", "velocity_y", "omega"
    if len(topic.columns) == 1:
        return topic.names
    quantities = (parts[0][0] for parts in topic.columns.values())
    return tuple(f"{name}/{_NAMES.get(quantity, quantity)}" for quantity in quantities for name in topic.names)


#: Columns of each table. The first two tables contain inputs of the twin. All tables after the second contain outputs.
COLUMNS: Final[Mapping[str, tuple[str, ...]]] = {
    "excitation": ("fx", "fy", "m"),
    "head_pose": _POSE,
    **{topic.name: _columns_of(topic) for topic in REPLAYED},
}


def read_recording(run: str | Path) -> Recording:
    """Open a recording of plow_twin and return it. The data are read when a table is accessed.

    Parameters
    ----------
    run
        Folder of the run, or one of its `.mcap` files.

    Raises
    ------
    RecordingError
        The path is not a recording of plow_twin.
    """
    return Recording(Path(run))


@dataclass(frozen=True)
class Batched:
    """Rows of a table.

    Attributes
    ----------
    stamp_ns : ndarray of int64, shape (n,)
        Stamps on the clock of the samples [ns].
    values : ndarray, shape (n, k)
        Values of the columns [SI units].
    """

    stamp_ns: Indexes
    values: Array


class Recording:
    """A recording whose data are read when they are accessed. `recording["contact_peaks"]` is a table.

    Attributes
    ----------
    path : Path
        The first file of the recording.
    header : RunHeader
        Settings of the run.
    """

    def __init__(self, path: Path) -> None:
        reader = RunReader(path)
        self.path = path
        self._named = reader.path
        self.header: RunHeader = reader.header
        self._losses: dict[str, int] | None = None

    @cached_property
    def scene(self) -> Scene:
        """The scene of the run. It is parsed at the first access, so that an invalid scene does not prevent reading.

        Raises
        ------
        RecordingError
            The scene is invalid in this version of plow_twin.
        """
        return self.header.scene(self.path)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tables."""
        return tuple(COLUMNS)

    def __getitem__(self, name: str) -> Table:
        if name not in COLUMNS:
            raise KeyError(f"{name}: no table of a recording, expected one of {', '.join(COLUMNS)}")
        return Table(self, name, COLUMNS[name])

    def losses(self) -> dict[str, int]:
        """Return the number of missing messages by topic.

        The method reads the whole journal, unless the recording has already been read to its end.
        """
        if self._losses is None:
            for _ in self._read(outputs=False):
                pass
        assert self._losses is not None
        return dict(self._losses)

    def _read(self, *, outputs: bool) -> Iterator[Batch]:
        reader = RunReader(self.path)
        yield from reader.batches(outputs=outputs)
        whole = reader.status is FileStatus.COMPLETE
        self._losses = {**reader.lost, **reader.lost_parts, **({} if whole else {reader.status.value: 1})}

    def batches(self, *names: str) -> Iterator[dict[str, Batched]]:
        """Return an iterator over the rows of several tables, which reads the recording once.

        Parameters
        ----------
        names
            Names of the tables; by default all tables.

        Raises
        ------
        RecordingError
            A file cannot be read.
        """
        chosen = names or self.names
        templates = publication_templates(self.header.frame_id, self.header.child_frame_id)
        sent = [name for name in chosen if name in templates]
        topics = {self.header.topic(name): name for name in sent}
        for batch in self._read(outputs=bool(sent)):
            batched: dict[str, Batched] = {}
            if "excitation" in chosen and batch.entries.sample.any():
                batched["excitation"] = Batched(*batch.entries.samples())
            if "head_pose" in chosen and (poses := _poses(batch)) is not None:
                batched["head_pose"] = poses
            if sent:
                rows = rows_by_topic(batch.outputs, topics, templates)
                batched |= {name: _plain(name, rows[name]) for name in sent if name in rows}
            if batched:
                yield batched


@dataclass(frozen=True)
class Table:
    """A table of a recording: stamps, and the values of `columns` in SI units."""

    recording: Recording
    name: str
    columns: tuple[str, ...]

    def batches(self) -> Iterator[Batched]:
        """Return an iterator over batches of rows, which fit in memory even if the run is long."""
        for batched in self.recording.batches(self.name):
            yield batched[self.name]

    def numpy(self) -> tuple[Indexes, Array]:
        """Return the stamps [ns], shape (n,), and the values, shape (n, number of columns)."""
        parts = list(self.batches())
        if not parts:
            return np.zeros(0, np.int64), np.zeros((0, len(self.columns)))
        return np.concatenate([part.stamp_ns for part in parts]), np.concatenate([part.values for part in parts])

    def arrow(self) -> pa.Table:
        """Return an Arrow table. The package pyarrow must be installed."""
        import pyarrow as pa

        return pa.Table.from_batches(map(self.arrow_batch, self.batches()), self.arrow_schema())

    def pandas(self) -> pd.DataFrame:
        """Return a data frame whose index contains the stamps in UTC. The package pandas must be installed."""
        import pandas as pd

        stamps, values = self.numpy()
        index = pd.DatetimeIndex(stamps.view("datetime64[ns]"), tz="UTC", name="stamp")
        return pd.DataFrame(values, index, list(self.columns))

    def arrow_schema(self) -> pa.Schema:
        """Return the Arrow schema of the table."""
        import pyarrow as pa

        return pa.schema([("stamp", pa.timestamp("ns", "UTC")), *((name, pa.float64()) for name in self.columns)])

    def arrow_batch(self, part: Batched) -> pa.RecordBatch:
        """Return a batch of rows as an Arrow record batch."""
        import pyarrow as pa

        columns: list[Any] = [pa.array(part.stamp_ns.view("datetime64[ns]"), pa.timestamp("ns", "UTC"))]
        columns += [pa.array(np.ascontiguousarray(column)) for column in part.values.T]
        return pa.RecordBatch.from_arrays(columns, schema=self.arrow_schema())


def export(recording: Recording, kind: str, out: Path) -> dict[str, int]:
    """Write all tables that have rows, and return the number of rows of each table.

    If `kind` is `csv` or `parquet`, a file for each table is written to the folder `out`. If it is `npz`, the file
    `out` contains the arrays `<table>/stamp_ns`, `<table>/values` and `<table>/columns` of all tables. Raise
    `RecordingError` if a file cannot be written.
    """
    try:
        return _exported_npz(recording, out) if kind == "npz" else _exported_tables(recording, kind, out)
    except OSError as error:
        raise RecordingError(f"{error.filename or out}: cannot be written: {error.strerror or error}") from error


def _exported_npz(recording: Recording, out: Path) -> dict[str, int]:
    from plow_twin.record.durable import whole_file

    parts: dict[str, list[Batched]] = {}
    for batch in recording.batches():
        for name, part in batch.items():
            parts.setdefault(name, []).append(part)
    arrays: dict[str, Any] = {}
    for name, rows in parts.items():
        arrays[f"{name}/stamp_ns"] = np.concatenate([part.stamp_ns for part in rows])
        arrays[f"{name}/values"] = np.concatenate([part.values for part in rows])
        arrays[f"{name}/columns"] = np.array(COLUMNS[name])
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as stream:
        np.savez_compressed(stream, **arrays)
    return {name: sum(len(part.stamp_ns) for part in rows) for name, rows in parts.items()}


def _exported_tables(recording: Recording, kind: str, out: Path) -> dict[str, int]:
    from contextlib import ExitStack

    import pyarrow.csv
    import pyarrow.parquet

    from plow_twin.record.durable import whole_file

    out.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    writers: dict[str, Any] = {}
    with ExitStack() as opened:
        for batch in recording.batches():
            for name, part in batch.items():
                table = recording[name]
                if name not in writers:
                    make = pyarrow.csv.CSVWriter if kind == "csv" else pyarrow.parquet.ParquetWriter
                    stream = opened.enter_context(whole_file(out / f"{name}.{kind}"))
                    writers[name] = opened.enter_context(make(stream, table.arrow_schema()))
                writers[name].write_batch(table.arrow_batch(part))
                counts[name] = counts.get(name, 0) + len(part.stamp_ns)
    return counts


def _poses(batch: Batch) -> Batched | None:
    poses = [
        (entry.stamp_ns, whole_pose(entry))
        for _, entry in sorted(batch.entries.others.items())
        if isinstance(entry, Pose | PartOfPose)
    ]
    if not poses:
        return None
    return Batched(np.array([stamp for stamp, _ in poses], np.int64), np.array([pose for _, pose in poses], float))


def _plain(name: str, rows: Rows) -> Batched:
    values = rows.numbers
    if name == "head_state":
        values = np.column_stack((poses_of(values), values[:, 4:7]))
    return Batched(rows.stamp_ns, values)
