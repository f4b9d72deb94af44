"""Read tables (CSV, JSON lines or Parquet) from files or from standard input, once or while they grow."""

from __future__ import annotations

import csv
import os
import re
import select
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

from plow_twin.errors import ExcessError
from plow_twin.live.bridge.source import BATCH, Bridge, BridgeError, Lines, Messages, Rows
from plow_twin.live.bridge.table import Table
from plow_twin.record.merging import StampOf, merged
from plow_twin.record.sources import Arrived, TopicType, columns_of
from plow_twin.record.times import NO_TIME
from plow_twin.scene_file.csv_rows import MOST_COLUMNS, check_text
from plow_twin.scene_file.parquet_lines import ParquetLines, is_parquet

#: Largest number of bytes that are read in one call.
_BLOCK: Final = 1 << 18
#: Number of bytes before the read position that are compared to recognise a rewritten file.
_REMEMBERED: Final = 256
_LOOK_S: Final = 0.02
_LOOK_FOR_FILES_S: Final = 0.2
STDIN_TOPIC: Final = "stdin"
_STDIN: Final = 0


@dataclass
class _Tail:
    """A file that is read while it grows, and from its beginning after it was truncated or replaced."""

    path: Path
    #: topic of the rows; by default the file name without extension
    topic: str = ""
    lines: Lines = field(default_factory=Lines)
    rows: Rows = field(default_factory=Rows)
    _file: Any = None
    #: bytes before the read position
    _newest: bytes = b""
    #: number of lines that are incomplete because the file was truncated or replaced
    left: int = 0

    def __post_init__(self) -> None:
        self.topic = self.topic or self.path.stem

    def columns(self, *, grows: bool) -> list[str] | None:
        """Return the columns in the first line, or None without a first line.

        If `grows` is True, a last line without a newline character is not used.
        """
        rows = Rows()
        try:
            with _readable(self.path), _open(self.path) as stream:
                while rows.columns is None and (line := stream.readline(_BLOCK)):
                    check_text(line)
                    if grows and not line.endswith(b"\n") and len(line) < _BLOCK:
                        break
                    if len(line) == _BLOCK:
                        content = f"a first line of more than {_BLOCK} bytes"
                        raise ExcessError(f"{self.path}: got {content}, expected a header")
                    rows.read(line)
                    if len(rows.columns or ()) > MOST_COLUMNS:
                        content = f"{len(rows.columns or ())} columns"
                        raise ExcessError(f"{self.path}: got {content}, expected at most {MOST_COLUMNS} columns")
        except FileNotFoundError:
            return None
        return rows.columns

    def files(self) -> list[Path]:
        return [self.path] if self.path.is_file() else []

    def read(self) -> list[Arrived]:
        data = self._block()
        lines = [None] * self.left + (self.lines.add(data) if data else [])
        self.left = 0
        return list(Table(self.topic, lines, self.rows))

    def _block(self) -> bytes:
        if self._file is None or self._is_another():
            rest = b"" if self._file is None or self._is_anew() else self._read()
            if rest:  # the end of a file that was renamed
                return rest
            try:
                with _readable(self.path):
                    file = _open(self.path)
            except FileNotFoundError:
                return b""
            self.close()
            self._file, self._newest = file, b""
            self.rows = self.rows.of_another_file()
            # the incomplete last line of the old file is not used, because the last number in it may be truncated
            self.left += self.lines.begun
            self.lines = Lines()
        return self._read()

    def _read(self) -> bytes:
        with _readable(self.path):
            data = bytes(self._file.read(_BLOCK))
        self._newest = (self._newest + data)[-_REMEMBERED:]
        return data

    def _is_anew(self) -> bool:
        """Return whether the bytes before the read position have changed."""
        begin = self._file.tell() - len(self._newest)
        return os.pread(self._file.fileno(), len(self._newest), begin) != self._newest

    def _is_another(self) -> bool:
        if isinstance(self._file, ParquetLines):  # a Parquet file is never followed
            return False
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return False  # the file was renamed and may still grow until a new file has its path
        ours = os.fstat(self._file.fileno())
        return (status.st_dev, status.st_ino) != (ours.st_dev, ours.st_ino) or self._is_anew()

    @property
    def place(self) -> int:
        return 0 if self._file is None else int(self._file.tell())

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None


def _open(path: Path) -> Any:
    return ParquetLines(path) if is_parquet(path) else path.open("rb")


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except csv.Error as error:
        raise BridgeError(f"{path}: {error}") from error


class _Dated:
    """Files whose names match a pattern, as one topic.

    When followed, reading begins with the newest file. The newest two files are read, because the older one may still
    grow.
    """

    def __init__(self, pattern: Path) -> None:
        self._pattern, self.topic = pattern, pattern.stem
        self._seen_files: set[Path] = set()
        self._tails: list[_Tail] = []
        self._look_s = 0.0

    @property
    def path(self) -> Path:
        return self._tails[-1].path if self._tails else self._pattern

    def columns(self, *, grows: bool) -> list[str] | None:
        files = self.files()
        return _Tail(max(files, key=_changed_ns)).columns(grows=grows) if files else None

    def files(self) -> list[Path]:
        return sorted(self._pattern.parent.glob(self._pattern.name), key=_numbered)

    def read(self) -> list[Arrived]:
        arrived_rows = [arrived for tail in self._tails for arrived in tail.read()]
        if arrived_rows or time.monotonic() < self._look_s:
            return arrived_rows
        self._look_s = time.monotonic() + _LOOK_FOR_FILES_S
        files = self.files()
        new = [file for file in files if file not in self._seen_files]
        if new and not self._seen_files:
            new = [max(new, key=_changed_ns)]
        self._seen_files.update(files)
        for file in new:
            rows = self._tails[-1].rows if self._tails else Rows()
            unread = 0
            for tail in self._tails[:-1]:
                unread += tail.lines.begun
                tail.close()
            self._tails = [*self._tails[-1:], _Tail(file, self.topic, rows=rows, left=unread)]
        return self.read() if new else arrived_rows

    def close(self) -> None:
        for tail in self._tails:
            tail.close()


def _changed_ns(path: Path) -> tuple[int, Any]:
    try:
        return path.stat().st_mtime_ns, _numbered(path)
    except FileNotFoundError:  # the file has been removed in the meantime
        return 0, _numbered(path)


def _numbered(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that compares the numbers in names as numbers, so that load_9 precedes load_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


class Files(Bridge):
    """Files as topics. The name of a topic is the file name, or the pattern such as `load_*.csv`, without extension.

    With `follow`, files are read while they grow, and missing files are awaited. Without `follow`, the messages of
    several files are merged by their stamps.
    """

    def __init__(self, paths: list[Path], *, follow: bool) -> None:
        super().__init__(ends=not follow, connected=True)
        self._tails = [_Dated(path) if _is_pattern(path) else _Tail(path) for path in paths]
        for tail in self._tails:
            if self.ends and not tail.files():
                raise BridgeError(f"{tail.path}: no such file")
            if follow and is_parquet(tail.path):
                raise BridgeError(f"{tail.path}: got Parquet, which does not grow by lines; expected CSV for --follow")
            if not tail.path.parent.is_dir():
                raise BridgeError(f"{tail.path.parent}: no such folder")
        self._messages: Iterator[Messages] = iter(())
        #: total size of the files, and number of bytes that have been read; with `follow`, the total size is 0
        self._size = self._done = 0

    def topics(self) -> dict[str, TopicType]:
        """Return the columns of each topic. With `follow`, the method waits for the first line of each file."""
        types: dict[str, TopicType] = {}
        for tail in self._tails:
            columns = tail.columns(grows=not self.ends)
            while columns is None and not self.ends:
                time.sleep(_LOOK_FOR_FILES_S)
                columns = tail.columns(grows=True)
            types[tail.topic] = columns_of(str(tail.path), columns or ())
        return types

    def awaited(self) -> list[Path]:
        """Return the files and patterns for which no complete line exists."""
        return [tail.path for tail in self._tails if tail.columns(grows=not self.ends) is None]

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Begin to read the files of the topics."""
        self._tails = [tail for tail in self._tails if tail.topic in topics]
        if self.ends:
            self._size = sum(file.stat().st_size for tail in self._tails for file in tail.files())
            streams = [self._all(tail) for tail in self._tails]
            rows = merged([chain.from_iterable(stream) for stream in streams], lambda row: _sent_ns(row, stamp_ns))
            self._messages = streams[0] if len(streams) == 1 else iter(lambda: list(islice(rows, BATCH)), [])

    def poll(self, timeout_s: float) -> Messages:
        """Return the next messages."""
        if self.ends:
            messages = next(self._messages, [])
            self.finished = not len(messages)
            return messages
        give_up = time.monotonic() + timeout_s
        while True:
            arrived_rows = [arrived for tail in self._tails for arrived in tail.read()]
            left_s = give_up - time.monotonic()
            if arrived_rows or left_s <= 0.0:
                return arrived_rows
            time.sleep(min(_LOOK_S, left_s))

    @property
    def share(self) -> float:
        """Share of the files that has been read, from 0 to 1. With `follow`, the share is 0."""
        return self._done / self._size if self._size else 0.0

    def _all(self, tail: _Tail | _Dated) -> Iterator[Messages]:
        if isinstance(tail, _Dated):
            for file in tail.files():
                with closing(_Tail(file, tail.topic)) as part:
                    yield from self._all(part)
            return
        place = 0
        while True:
            data = tail._block()
            self._done, place = self._done + tail.place - place, tail.place
            lines = tail.lines.add(data) if data else tail.lines.end()
            begin = 0
            while begin < len(lines):
                end = begin + (BATCH if tail.rows.columns is not None else 1)
                batch, rows = lines[begin:end], tail.rows
                table: Messages = Table(tail.topic, batch, rows)
                if not rows.under_header:
                    table = list(table)
                if len(table):
                    yield table
                begin = end
            if not data:
                return

    def close(self) -> None:
        """Close the files."""
        for tail in self._tails:
            tail.close()


def _is_pattern(path: Path) -> bool:
    return any(sign in path.name for sign in "*?[") and not path.exists()


def _sent_ns(row: Arrived, stamp_ns: StampOf[Arrived] | None) -> int | None:
    """Return the stamp in a row, or None without a stamp."""
    return None if stamp_ns is None else stamp_ns(Arrived(row.topic, NO_TIME, row.content))


class StandardInput(Bridge):
    """Lines from standard input."""

    def __init__(self) -> None:
        if sys.stdin is None:
            raise BridgeError("-: got a closed standard input, expected lines")
        super().__init__(connected=True)
        self._lines, self._rows = Lines(), Rows()
        self._first: list[Arrived] = []

    def topics(self) -> dict[str, TopicType]:
        """Wait for the first line, and return the columns in it."""
        while self._rows.columns is None and not self.finished:
            self._first += self._read(1.0)
        return {STDIN_TOPIC: self._rows.header("-")}

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Do nothing, because there is only one topic."""

    def poll(self, timeout_s: float) -> list[Arrived]:
        """Return the messages that have arrived."""
        if self._first:
            first, self._first = self._first, []
            return first
        return self._read(timeout_s)

    def _read(self, timeout_s: float) -> list[Arrived]:
        try:
            ready, _, _ = select.select([_STDIN], [], [], timeout_s)
            if not ready:
                return []
            data = os.read(_STDIN, _BLOCK)
        except OSError as error:
            raise BridgeError(f"-: standard input cannot be read: {error.strerror}") from error
        self.finished = not data
        lines = self._lines.add(data) if data else self._lines.end()
        return list(Table(STDIN_TOPIC, lines, self._rows))

    def close(self) -> None:
        """Do nothing, because standard input stays open."""
