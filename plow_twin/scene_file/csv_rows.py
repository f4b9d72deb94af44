"""Reader of CSV files as spreadsheets of many countries write them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import IO


def open_csv(path: Path) -> IO[str]:
    """Open a text file without the byte order mark that spreadsheets write."""
    return path.open(newline="", encoding="utf-8-sig", errors="replace")


def delimiter_of(header: str) -> str:
    """Return the delimiter of a header line: comma, semicolon or tab, the most frequent outside quotes."""
    return max(",;\t", key=re.sub(r'"[^"]*"', "", header).count)


def csv_rows(stream: IO[str], comment: str = "") -> Iterator[tuple[int, list[str]]]:
    """Yield line numbers and rows, the header first; empty rows are left out.

    The delimiter is that of the header. With semicolons or tabs decimal commas become points. Lines that begin with
    `comment` are left out.

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
