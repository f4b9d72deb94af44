"""What a source of messages is, and how a line or a payload becomes one."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from typing import Any, Final, Protocol

from plow_twin.errors import PlowTwinError
from plow_twin.record.merging import StampOf
from plow_twin.record.sources import Arrived, Columns, TopicType, columns_of
from plow_twin.scene_file.csv_rows import delimiter_of

#: Most messages that a source hands over at once.
BATCH: Final = 256
#: A longer line or payload is none of a sensor's [B].
LONGEST: Final = 65536


class BridgeError(PlowTwinError):
    """A source cannot be opened or has ended for good; the message says which and why."""


class Bridge(Protocol):
    """Where messages come from.

    Attributes
    ----------
    ends : bool
        Whether the source has an end and its own time: a file that is read once.
    finished : bool
        Whether nothing more will come.
    connected : bool
    lost : int
        Messages that could not be kept until they were read.
    trouble : str
        Why nothing comes just now; empty: it may.
    """

    ends: bool
    finished: bool
    connected: bool
    lost: int
    trouble: str

    def topics(self) -> Mapping[str, TopicType] | None:
        """Return types by topic; None: any topic that the mapping names."""

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Begin to receive these topics; files that are read once are put in order by `stamp_ns`."""

    def poll(self, timeout_s: float) -> list[Arrived]:
        """Return what has arrived; wait at most so long for the first message. Unreadable content is None."""

    def close(self) -> None:
        """Let go of the source."""


def read_json(data: bytes) -> dict[str, Any] | None:
    """Return the object that JSON text stands for, or None."""
    if len(data) > LONGEST:
        return None
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


class Lines:
    """Bytes as they come, cut into whole lines; one that is too long is given up and comes as None."""

    def __init__(self) -> None:
        self._rest = b""
        self._skipping = False

    def add(self, data: bytes) -> list[bytes | None]:
        """Return the lines that are whole now."""
        *whole, self._rest = (self._rest + data).split(b"\n")
        found: list[bytes | None] = []
        for line in whole:
            found.append(None if self._skipping or len(line) > LONGEST else line)
            self._skipping = False
        if len(self._rest) > LONGEST:
            self._rest, self._skipping = b"", True
        return found

    @property
    def begun(self) -> bool:
        """Whether a line has begun and not ended."""
        return self._skipping or bool(self._rest)

    def end(self) -> list[bytes | None]:
        """Return what is left at the end, where the last line may lack its newline."""
        rest, self._rest = self._rest, b""
        return [None] if self._skipping else [rest] if rest else []


class Rows:
    """Lines of CSV under a header, or JSON objects one a line; which one, the first line tells."""

    def __init__(self) -> None:
        #: names of the columns, or keys of the first object; None before the first line
        self.columns: list[str] | None = None
        self._json = False
        self._delimiter = ","
        #: columns of the file in whose place this one stands
        self._before: list[str] | None = None

    def header(self, source: str) -> Columns:
        """Return the columns of `source`; raises as `columns_of`."""
        return columns_of(source, self.columns or ())

    def of_another_file(self) -> Rows:
        """Return what reads a file that takes this one's place: under its own header, without one under this one's."""
        rows = Rows()
        rows._before = self.columns
        return rows

    def read(self, line: bytes | None) -> dict[str, Any] | bool | None:
        """Return the content of a line: None where it is unreadable, False where it says nothing (header, empty)."""
        if line is None:
            return None
        line = line.strip(b"\r \xef\xbb\xbf")  # not tabs: empty cells may stand between them
        if not line.strip() or line.startswith(b"#"):
            return False
        if self.columns is None and (self._json or line.startswith(b"{")):
            self._json = True
            self.columns = list(read_json(line) or ()) or None  # an object that is cut or empty has no keys to tell
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
            return False  # a file that goes on under its header again
        if len(cells) != len(self.columns):
            return None
        if self._delimiter != ",":  # decimal commas
            cells = [cell.replace(",", ".") for cell in cells]
        return dict(zip(self.columns, cells, strict=True))

    def _cells(self, line: bytes) -> list[str] | None:
        text = line.decode(errors="replace")
        if self.columns is None:
            self._delimiter = delimiter_of(text)
        try:
            return next(csv.reader([text], delimiter=self._delimiter, strict=True), None)
        except csv.Error:
            return None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
