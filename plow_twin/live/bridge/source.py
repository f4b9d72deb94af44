"""Interface of the sources of messages, and parsers for lines and JSON payloads."""

from __future__ import annotations

import csv
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, Protocol, runtime_checkable

from plow_twin.errors import PlowTwinError
from plow_twin.live.part import Part
from plow_twin.record.merging import StampOf
from plow_twin.record.sources import Arrived, Columns, TopicType, columns_of
from plow_twin.scene_file.csv_rows import delimiter_of

#: Largest number of messages that a source returns in one call.
BATCH: Final = 256
#: Largest length of a line or a payload [B].
LONGEST: Final = 65536


class BridgeError(PlowTwinError):
    """A source cannot be opened, or has failed and cannot continue."""


class Messages(Protocol):
    """Messages in the order of arrival, which may be parsed only when the iteration reaches them."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Arrived]: ...


class Bridge(ABC):
    """Source of messages."""

    def __init__(self, *, ends: bool = False, connected: bool = False) -> None:
        #: whether the source has an end; if it has one, the stamps of its messages replace the system time
        self.ends = ends
        #: whether the source has ended
        self.finished = False
        self.connected = connected
        #: number of messages that were dropped before they were read
        self.lost = 0
        #: reason why no messages can arrive at present, or an empty text if messages can arrive
        self.trouble = ""

    @abstractmethod
    def topics(self) -> Mapping[str, TopicType] | None:
        """Return the type of each topic, or None if the mapping may contain any topic."""

    @abstractmethod
    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Subscribe to topics. If the source has an end, messages of several files are merged by `stamp_ns`."""

    @abstractmethod
    def poll(self, timeout_s: float) -> Messages:
        """Return the next messages, or no messages after `timeout_s` [s].

        The content of a message that cannot be parsed is None.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the source."""


@runtime_checkable
class Reporting(Protocol):
    """Source that has a part in the diagnostics."""

    def part(self) -> Part:
        """Return the part `source` of the diagnostics."""


def read_json(data: bytes) -> dict[str, Any] | None:
    """Return the object that a JSON text represents, or None if the text is too long or not an object."""
    if len(data) > LONGEST:
        return None
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


class Lines:
    """Splitter of bytes into lines. A line that is too long becomes None."""

    def __init__(self) -> None:
        self._rest = b""
        self._skipping = False

    def add(self, data: bytes) -> list[bytes | None]:
        """Add bytes, and return the lines that are complete."""
        *whole, self._rest = (self._rest + data).split(b"\n")
        lines: list[bytes | None] = []
        for line in whole:
            lines.append(None if self._skipping or len(line) > LONGEST else line)
            self._skipping = False
        if len(self._rest) > LONGEST:
            self._rest, self._skipping = b"", True
        return lines

    @property
    def begun(self) -> bool:
        """Whether the last line is incomplete."""
        return self._skipping or bool(self._rest)

    def end(self) -> list[bytes | None]:
        """Return the last line, even if it has no newline character."""
        rest, self._rest = self._rest, b""
        return [None] if self._skipping else [rest] if rest else []


class Rows:
    """Parser of lines, which are JSON objects or rows of a CSV table, as the first line shows."""

    def __init__(self) -> None:
        #: names of the columns, or keys of the first JSON object; None before the first line
        self.columns: list[str] | None = None
        self._json = False
        self.delimiter = ","
        #: columns of the previous file
        self._before: list[str] | None = None

    @property
    def under_header(self) -> bool:
        """Whether the lines are CSV and the header has been read."""
        return self.columns is not None and not self._json

    def header(self, source: str) -> Columns:
        """Return the result of `columns_of` for the columns of lines that arrive one by one."""
        return replace(columns_of(source, self.columns or ()), are_received=True)

    def of_another_file(self) -> Rows:
        """Return a parser for the next file, which has the columns of this file if it has no header."""
        rows = Rows()
        rows._before = self.columns
        return rows

    def read(self, line: bytes | None) -> dict[str, Any] | bool | None:
        """Return the content of a line.

        Returns None if the line cannot be parsed, and False if it is empty, a comment, or a header.
        """
        if line is None:
            return None
        line = line.strip(b"\r \xef\xbb\xbf")  # tabs are not removed, because they may separate empty cells
        if not line.strip() or line.startswith(b"#"):
            return False
        if self.columns is None and (self._json or line.startswith(b"{")):
            self._json = True
            self.columns = list(read_json(line) or ()) or None  # a truncated or empty object has no keys
        if self._json:
            return read_json(line)
        cells = self._cells(line)
        if cells is None:
            return None
        if self.columns is None:
            if self._before is None or not any(map(_is_number, cells)):
                self.columns = [cell.strip() for cell in cells]
                return False
            self.columns = self._before
        if [cell.strip() for cell in cells] == self.columns:
            return False  # the line repeats the header
        if len(cells) != len(self.columns):
            return None
        if self.delimiter != ",":  # if the delimiter is not a comma, a comma is a decimal sign
            cells = [cell.replace(",", ".") for cell in cells]
        return dict(zip(self.columns, cells, strict=True))

    def _cells(self, line: bytes) -> list[str] | None:
        text = line.decode(errors="replace")
        if self.columns is None:
            self.delimiter = delimiter_of(text)
        try:
            return next(csv.reader([text], delimiter=self.delimiter, strict=True), None)
        except csv.Error:
            return None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
