"""Conversion of Parquet files to lines of CSV, so that every reader of CSV files can read Parquet files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from plow_twin.errors import ExcessError

if TYPE_CHECKING:
    import pyarrow as pa

SUFFIX: Final = ".parquet"
_ROWS: Final = 4096
#: Largest number of rows per byte of a file, because a few compressed bytes can contain any number of rows.
_MOST_PER_BYTE: Final = 100
#: Number of rows that is always accepted.
_ALWAYS: Final = 1_000_000
#: Largest size [B] of an unpacked column in a row group, which must fit into memory.
_LARGEST_COLUMN: Final = 2**29
#: Largest number of columns.
_MOST_COLUMNS: Final = 10_000
#: Longest text [B] in the metadata.
_LONGEST_TEXT: Final = 2**24


def is_parquet(path: Path) -> bool:
    """Return whether the name of a file has the suffix of Parquet files."""
    return path.suffix.lower() == SUFFIX


class ParquetLines(io.RawIOBase):
    """A Parquet file that is read as UTF-8 text: a line with the names of the columns, then a line for each row.

    Numbers are written without loss of digits, and times with a zone in UTC. A missing value gives an empty cell.
    Columns of lists, structures or bytes are omitted. Raise `OSError` if the file cannot be opened, and `ExcessError`
    if the unpacked file would exceed a limit of this module.
    """

    def __init__(self, path: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet

        self.name = str(path)
        self._size = path.stat().st_size
        self._arrow_errors = (pa.ArrowException, OSError)
        try:
            self._file = pyarrow.parquet.ParquetFile(
                path, thrift_string_size_limit=_LONGEST_TEXT, thrift_container_size_limit=_LONGEST_TEXT
            )
        except FileNotFoundError:
            raise
        except self._arrow_errors as error:
            raise csv.Error(f"cannot be read as Parquet: {_first_line(error)}") from error
        self._rows = int(self._file.metadata.num_rows)
        self._done = 0
        self._check()
        self._columns = [column.name for column in self._file.schema_arrow if _is_plain(column.type)]
        self._blocks = self._lines()
        self._rest = memoryview(b"")

    def _check(self) -> None:
        facts = self._file.metadata
        if facts.num_columns > _MOST_COLUMNS:
            raise ExcessError(f"{self.name}: got {facts.num_columns} columns, expected at most {_MOST_COLUMNS}")
        most = max(_ALWAYS, _MOST_PER_BYTE * self._size)
        if self._rows > most:
            raise ExcessError(f"{self.name}: got {self._rows} rows, expected at most {most} in {self._size} bytes")
        sizes = (
            facts.row_group(group).column(column).total_uncompressed_size
            for group in range(facts.num_row_groups)
            for column in range(facts.num_columns)
        )
        largest = max(sizes, default=0)
        if largest > _LARGEST_COLUMN:
            raise ExcessError(
                f"{self.name}: got a column of {largest >> 20} MiB in one group of rows, expected at most "
                f"{_LARGEST_COLUMN >> 20} MiB"
            )

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Copy the next bytes into a buffer. Return their number, which is 0 at the end."""
        while not self._rest:
            block = next(self._blocks, None)
            if block is None:
                return 0
            self._rest = memoryview(block)
        count = min(len(buffer), len(self._rest))
        buffer[:count], self._rest = self._rest[:count], self._rest[count:]
        return count

    def tell(self) -> int:
        """Return an estimate of the number of bytes read so far, from the share of rows read."""
        return round(self._size * self._done / self._rows) if self._rows else self._size

    def close(self) -> None:
        """Close the file."""
        if not self.closed:
            self._file.close()
        super().close()

    def _lines(self) -> Iterator[bytes]:
        import pyarrow.csv

        options = pyarrow.csv.WriteOptions(include_header=False, quoting_style="needed")
        head = io.StringIO()
        csv.writer(head, lineterminator="\n").writerow(self._columns)
        yield head.getvalue().encode()
        try:
            for batch in self._file.iter_batches(_ROWS, columns=self._columns, use_threads=False):
                text = io.BytesIO()
                pyarrow.csv.write_csv(_as_text(batch), text, options)
                self._done += batch.num_rows
                yield text.getvalue()
        except self._arrow_errors as error:
            raise csv.Error(f"the rows from {self._done + 1} on cannot be read: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0][:200]


def _is_plain(kind: pa.DataType) -> bool:
    """Return whether a CSV cell can represent the values of a type."""
    import pyarrow as pa

    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    tests = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean, pa.types.is_null)
    texts = (pa.types.is_string, pa.types.is_large_string, pa.types.is_temporal)
    return any(test(kind) for test in (*tests, *texts)) and not pa.types.is_interval(kind)


def _as_text(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Convert instants to UTC and durations to seconds, for CSV."""
    import pyarrow as pa

    columns = []
    for column in batch.columns:
        kind = column.type
        if pa.types.is_dictionary(kind):
            column = column.dictionary_decode()
        elif pa.types.is_timestamp(kind) and kind.tz is not None:
            column = column.cast(pa.timestamp(kind.unit, "UTC"))
        elif pa.types.is_duration(kind):
            nanoseconds = column.cast(pa.duration("ns")).cast(pa.int64()).to_numpy(zero_copy_only=False)
            column = pa.array(nanoseconds * 1e-9, from_pandas=True)
        elif pa.types.is_float16(kind) or pa.types.is_float32(kind):
            column = column.cast(pa.float64())
        columns.append(column)
    return pa.RecordBatch.from_arrays(columns, names=batch.schema.names)
