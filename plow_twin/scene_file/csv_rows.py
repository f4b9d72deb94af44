"""Reader of rows from CSV files, with the delimiters and decimal marks of many countries, and from Parquet files."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import IO, Final

from plow_twin.errors import ExcessError
from plow_twin.scene_file.parquet_lines import SUFFIX, ParquetLines, is_parquet

#: Length of the longest accepted row, in characters.
LONGEST_ROW: Final = 2**20
#: Largest number of columns. Exports of a plant historian have a few hundred columns.
MOST_COLUMNS: Final = 10_000


def open_csv(path: Path) -> IO[str]:
    """Open a CSV file as text without its byte order mark, or a Parquet file as lines of CSV.

    Raises `OSError`, and the errors of `check_text` and `ParquetLines`.
    """
    if is_parquet(path):
        return io.TextIOWrapper(io.BufferedReader(ParquetLines(path)), encoding="utf-8", errors="replace", newline="")
    file = path.open("rb")
    try:
        check_text(file.peek(4))
    except csv.Error:
        file.close()
        raise
    return io.TextIOWrapper(file, encoding="utf-8-sig", errors="replace", newline="")


def tables(folder: Path) -> list[Path]:
    """Return the CSV files of a folder, and the Parquet files without a CSV file of the same name, sorted by name."""
    files = {path.stem: path for ending in (SUFFIX, ".csv") for path in folder.glob(f"*{ending}")}
    return [files[name] for name in sorted(files)]


_EXPORT: Final = "UTF-8 (export a spreadsheet as CSV UTF-8)"
_RECORDING: Final = "a table; plow-twin analyse and plow-twin info read recordings"
#: First bytes of files that may be mistaken for text: the kind of the file, and what is expected instead.
_OTHERS: Final = {
    b"\xff\xfe": ("UTF-16 text", _EXPORT),
    b"\xfe\xff": ("UTF-16 text", _EXPORT),
    b"PK\x03\x04": ("a workbook or another ZIP file", _EXPORT),
    b"\x1f\x8b": ("a file compressed by gzip", _EXPORT),
    b"\x89MC": ("an MCAP recording", _RECORDING),
    b"SQLite format 3": ("a recording of rosbag2", _RECORDING),
}


def kind_of(begin: bytes) -> str:
    """Return the kind of a file with these first bytes if it is not a text file, otherwise an empty text."""
    return next((kind for first, (kind, _) in _OTHERS.items() if begin.startswith(first)), "")


def check_text(begin: bytes) -> None:
    """Raise a `csv.Error` if the first bytes are those of UTF-16 text, a workbook, an archive or a recording."""
    for first, (kind, expected) in _OTHERS.items():
        if begin.startswith(first):
            raise csv.Error(f"got {kind}, expected {expected}")


def delimiter_of(header: str) -> str:
    """Return the delimiter of a header line, which is the most frequent of comma, semicolon and tab outside quotes."""
    return max(",;\t", key=re.sub(r'"[^"]*"', "", header).count)


def csv_rows(stream: IO[str], comment: str = "") -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each row that is not empty, beginning with the header.

    The delimiter is found in the header. With semicolons or tabs, decimal commas are converted to points. Lines that
    begin with `comment` are skipped. Raise `ExcessError` if a row is longer than `LONGEST_ROW`, or there are more than
    `MOST_COLUMNS` columns.
    """
    number = length = 0

    def lines() -> Iterator[str]:
        nonlocal number, length
        while line := stream.readline(LONGEST_ROW + 1):
            number += 1
            is_comment = bool(comment) and line.startswith(comment)
            length += 0 if is_comment or line.isspace() else len(line)
            if max(length, len(line)) > LONGEST_ROW:
                raise _excess(stream, number, "a longer row", f"at most {LONGEST_ROW >> 20} MiB")
            if not is_comment:
                yield line

    kept = lines()
    first = next((line for line in kept if line.strip()), "")
    delimiter, is_header = delimiter_of(first), True
    for cells in csv.reader(chain([first], kept), delimiter=delimiter):
        length = 0
        if len(cells) > MOST_COLUMNS:
            raise _excess(stream, number, f"{len(cells)} columns", f"at most {MOST_COLUMNS}")
        if not any(cells):
            continue
        yield number, cells if is_header or delimiter == "," else [cell.replace(",", ".") for cell in cells]
        is_header = False


def _excess(stream: IO[str], line: int, got: str, expected: str) -> ExcessError:
    return ExcessError(f"{getattr(stream, 'name', 'csv')}: line {line}: got {got}, expected {expected}")
