"""CSV or JSON lines from files, read once or followed while they grow, and from standard input."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

from plow_twin.live.bridge.source import BATCH, BridgeError, Lines, Rows
from plow_twin.record.merging import StampOf, merged
from plow_twin.record.sources import Arrived, TopicType
from plow_twin.record.times import NO_TIME

#: Most bytes read from a source at once.
_BLOCK: Final = 1 << 18
#: Bytes by which a file is recognised.
_REMEMBERED: Final = 256
#: Interval at which a followed file is read [s].
_LOOK_S: Final = 0.02
STDIN_TOPIC: Final = "stdin"


@dataclass
class _Tail:
    """One file, read as far as it goes; a file that was cut or replaced is read from its beginning again."""

    path: Path
    lines: Lines = field(default_factory=Lines)
    rows: Rows = field(default_factory=Rows)
    _file: Any = None
    #: the newest bytes read, which differ in a file that was written anew
    _newest: bytes = b""
    #: lines whose end never came: the file was cut or replaced
    left: int = 0

    @property
    def topic(self) -> str:
        return self.path.stem

    def read(self) -> list[Arrived]:
        """Return the messages of the next block."""
        data = self._block()
        lines = [None] * self.left + (self.lines.add(data) if data else [])
        self.left = 0
        return messages(self.topic, lines, self.rows)

    def _block(self) -> bytes:
        if self._file is None or self._is_another():
            rest = b"" if self._file is None or self._is_anew() else self._read()
            if rest:  # the rest of the file that was moved away
                return rest
            try:
                file = self.path.open("rb")
            except FileNotFoundError:
                return b""
            self.close()
            self._file, self._newest = file, b""
            self.rows = self.rows.of_another_file()
            # an incomplete line: a number in it may have been cut
            self.left += self.lines.begun
            self.lines = Lines()
        return self._read()

    def _read(self) -> bytes:
        data = bytes(self._file.read(_BLOCK))
        self._newest = (self._newest + data)[-_REMEMBERED:]
        return data

    def _is_anew(self) -> bool:
        """Return whether the file was cut, even if it has grown beyond its old size since."""
        begin = self._file.tell() - len(self._newest)
        return os.pread(self._file.fileno(), len(self._newest), begin) != self._newest

    def _is_another(self) -> bool:
        """Return whether the file was written anew, or another file is at its path."""
        try:
            found = self.path.stat()
        except FileNotFoundError:
            return False  # until another file is there, the one that was moved away may grow
        ours = os.fstat(self._file.fileno())
        return (found.st_dev, found.st_ino) != (ours.st_dev, ours.st_ino) or self._is_anew()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None


def messages(topic: str, lines: list[bytes | None], rows: Rows) -> list[Arrived]:
    """Return the messages of whole lines, received now."""
    now_ns = time.time_ns()
    found = []
    for line in lines:
        content = rows.read(line)
        if content is not False:
            found.append(Arrived(topic, now_ns, content))
    return found


class Files:
    """Files, each a topic under its name without ending.

    Parameters
    ----------
    paths
        The files; when they are read once, their messages are put in order by the times in them.
    follow
        Continue at the end with lines that are appended later.

    Raises
    ------
    BridgeError
        A file cannot be read.
    """

    def __init__(self, paths: list[Path], *, follow: bool) -> None:
        self.ends = not follow
        self.finished = False
        self.connected = True
        self.lost = 0
        self.trouble = ""
        self._tails = [_Tail(path) for path in paths]
        for tail in self._tails:
            if not tail.path.is_file():
                raise BridgeError(f"{tail.path}: no such file")
        self._merged: Iterator[Arrived] | None = None

    def topics(self) -> dict[str, TopicType]:
        """Return columns by topic, by the first line of each file."""
        found: dict[str, TopicType] = {}
        for tail in self._tails:
            rows = Rows()
            with tail.path.open("rb") as stream:
                while rows.columns is None and (line := stream.readline(_BLOCK)):
                    rows.read(line)
            found[tail.topic] = rows.header(str(tail.path))
        return found

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Begin to read the files of these topics."""
        self._tails = [tail for tail in self._tails if tail.topic in topics]
        if self.ends:
            streams = [_all(tail) for tail in self._tails]
            self._merged = streams[0] if len(streams) == 1 else merged(streams, lambda row: _sent_ns(row, stamp_ns))

    def poll(self, timeout_s: float) -> list[Arrived]:
        """Return the next messages."""
        if self._merged is not None:
            found = list(islice(self._merged, BATCH))
            self.finished = not found
            return found
        give_up = time.monotonic() + timeout_s
        while True:
            found = [arrived for tail in self._tails for arrived in tail.read()]
            left_s = give_up - time.monotonic()
            if found or left_s <= 0.0:
                return found
            time.sleep(min(_LOOK_S, left_s))

    def close(self) -> None:
        """Close the files."""
        for tail in self._tails:
            tail.close()


def _all(tail: _Tail) -> Iterator[Arrived]:
    """Yield all messages of a file that is read once."""
    while True:
        data = tail._block()
        yield from messages(tail.topic, tail.lines.add(data) if data else tail.lines.end(), tail.rows)
        if not data:
            return


def _sent_ns(row: Arrived, stamp_ns: StampOf[Arrived] | None) -> int | None:
    """Return the stamp in a row; the time of reading is not its time."""
    return None if stamp_ns is None else stamp_ns(Arrived(row.topic, NO_TIME, row.content))


class StandardInput:
    """Lines on standard input or another descriptor, until its end.

    Raises
    ------
    BridgeError
        It is closed.
    """

    def __init__(self, descriptor: int = 0) -> None:
        if descriptor == 0 and sys.stdin is None:
            raise BridgeError("-: got a closed standard input, expected lines")
        self.ends = False
        self.finished = False
        self.connected = True
        self.lost = 0
        self.trouble = ""
        self._descriptor = descriptor
        self._lines, self._rows = Lines(), Rows()
        self._first: list[Arrived] = []

    def topics(self) -> dict[str, TopicType]:
        """Wait for the first line, and return its columns."""
        while self._rows.columns is None and not self.finished:
            self._first += self._read(1.0)
        return {STDIN_TOPIC: self._rows.header("-")}

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Do nothing: there is one topic."""

    def poll(self, timeout_s: float) -> list[Arrived]:
        """Return the messages that have come."""
        if self._first:
            first, self._first = self._first, []
            return first
        return self._read(timeout_s)

    def _read(self, timeout_s: float) -> list[Arrived]:
        try:
            ready, _, _ = select.select([self._descriptor], [], [], timeout_s)
            if not ready:
                return []
            data = os.read(self._descriptor, _BLOCK)
        except OSError as error:
            raise BridgeError(f"-: standard input cannot be read: {error.strerror}") from error
        self.finished = not data
        lines = self._lines.add(data) if data else self._lines.end()
        return messages(STDIN_TOPIC, lines, self._rows)

    def close(self) -> None:
        """Do nothing: the descriptor belongs to its owner."""
