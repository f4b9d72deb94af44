"""The one reader of CSV files: as spreadsheets of many countries write them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import IO


def open_csv(path: Path) -> IO[str]:
    """Open a text; a mark of the byte order at its beginning, as spreadsheets write it, is no part of it."""
    return path.open(newline="", encoding="utf-8-sig", errors="replace")


def delimiter_of(header: str) -> str:
    """Return what parts the columns of a header line: comma, semicolon or tab, the most frequent outside quotes."""
    return max(",;\t", key=re.sub(r'"[^"]*"', "", header).count)


def csv_rows(stream: IO[str], comment: str = "") -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not empty with the numbers of their lines, the header first.

    Columns are parted by commas, or by semicolons or tabs where the header has more of these; numbers may have decimal
    commas then, which become points. Lines that begin with `comment` are none.

    Raises
    ------
    csv.Error
        A line is no row.
    """
    number = 0

    def lines() -> Iterator[str]:
        nonlocal number
        for number, line in enumerate(stream, 1):  # noqa: B007 - of the row that is yielded
            if not comment or not line.startswith(comment):
                yield line

    kept = lines()
    first = next((line for line in kept if line.strip()), "")
    delimiter, is_header = delimiter_of(first), True
    for cells in csv.reader(chain([first], kept), delimiter=delimiter):
        if not any(cells):
            continue
        yield number, cells if is_header or delimiter == "," else [cell.replace(",", ".") for cell in cells]
        is_header = False
