"""Read the messages of a recording in the format MCAP, sqlite3 (of rosbag2), CSV or Parquet.

Messages are read in the order in which they were written, and only a few chunks are in memory at a time. Messages that
cannot be decoded are counted and skipped. A truncated file is read as far as possible.
"""

from __future__ import annotations

import csv
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Protocol, TypeAlias
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.record.chunks import MAGIC, Channel, ChunkReader, is_mcap
from plow_twin.record.column_names import time_column
from plow_twin.record.merging import StampOf, merged
from plow_twin.record.metadata_yaml import missing_files
from plow_twin.record.reader import packed, part_number, run_parts
from plow_twin.record.times import NO_TIME, NUMBER, STAMP_UNITS, time_ns
from plow_twin.scene_file.csv_rows import csv_rows, open_csv, tables
from plow_twin.scene_file.parquet_lines import is_parquet

_SQLITE_MAGIC: Final = b"SQLite format 3\0"
_ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
#: Largest size of a decompressed message [B].
_LARGEST_MESSAGE: Final = 2**26
#: Query for views, virtual tables and computed columns. A file that contains one is refused, because reading a computed
#: table may never end.
_COMPUTED: Final = """
    SELECT 1 FROM sqlite_master
    WHERE name COLLATE NOCASE IN ('topics', 'messages', 'message_definitions') AND (type != 'table' OR rootpage = 0)
    UNION ALL SELECT 1 FROM pragma_table_xinfo('messages') WHERE hidden
    UNION ALL SELECT 1 FROM pragma_table_xinfo('message_definitions') WHERE hidden
    UNION ALL SELECT 1 FROM pragma_table_xinfo('topics') WHERE hidden LIMIT 1
"""
_SCHEMA: Final = "SELECT encoded_message_definition FROM message_definitions WHERE topic_type = ? LIMIT 1"
_MESSAGES: Final = "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
#: Errors that sqlite3 raises for a damaged file, for text that is not UTF-8, and for table cells of invalid length.
_SQLITE_ERRORS: Final = (sqlite3.Error, UnicodeDecodeError, MemoryError)


@dataclass(frozen=True, slots=True)
class Columns:
    """Type of a topic whose messages are lines of text.

    The names are the columns of a table, or the keys of the first JSON object.
    """

    names: tuple[str, ...]
    #: whether the lines arrive one by one, so that a line without a time can get the time of receipt
    are_received: bool = False

    def __str__(self) -> str:
        """Return the names for a message, with a hint if the header row or the separators seem to be missing."""
        if not any(self.names):
            return "columns (none: is it empty?)"
        names = ", ".join(ascii(name) if "," in name or not name.isprintable() else name for name in self.names)
        hint = ""
        if all(NUMBER.fullmatch(name.strip()) for name in self.names):
            hint = " (no header row?)"
        elif len(self.names) == 1:
            hint = " (expected commas, semicolons or tabs between them)"
        return f"columns {names}{hint}"


#: Type of a topic, which is the name of a ROS type, `json`, or the columns of a table.
TopicType: TypeAlias = str | Columns


@dataclass(frozen=True, slots=True)
class Arrived:
    """A received message. `content` contains the fields, which are accessed by paths such as `wrench.force.x`."""

    topic: str
    #: receive time [ns], or `NO_TIME` if it is unknown
    log_time_ns: int
    content: Any
    #: whether the message was sent before the subscription and retained by the MQTT broker
    retained: bool = False
    #: whether messages before this message are missing, because a part is missing or damaged
    after_hole: bool = False


@dataclass
class Losses:
    """Numbers of unused messages of a recording by reason, and the topics that have an unknown message type."""

    counts: Counter[str] = field(default_factory=Counter)
    unknown_types: dict[str, str] = field(default_factory=dict)


class Source(Protocol):
    """A recording."""

    losses: Losses

    def topics(self) -> Mapping[str, TopicType]:
        """Return the type of each topic."""

    def messages(self, wanted: Callable[[str], bool], stamp_ns: StampOf[Arrived] | None = None) -> Iterator[Arrived]:
        """Yield the messages on the topics for which `wanted` returns True.

        If the recording has a file for each topic, the messages of the files are merged by the stamps that `stamp_ns`
        returns.
        """


def open_source(path: Path) -> Source:
    """Open a recording. Raise `RecordingError` if the path is not a recording that can be read."""
    if path.is_dir():
        missing = [Path(name) for name in missing_files(path)]
        source: Source
        if any(path.glob("*.mcap")):
            source = McapSource(run_parts(path), missing)
        elif databases := list(path.glob("*.db3")):
            source = SqliteSource(databases, missing)
        elif files := tables(path):
            return CsvSource(files)
        else:
            content = f"a folder without .mcap, .db3, .csv or .parquet{packed(path)}"
            raise RecordingError(f"{path}: got {content}, expected a recording")
        if missing:
            source.losses.counts["missing_parts"] = len(missing)
        return source
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording")
    with path.open("rb") as stream:
        head = stream.read(len(_SQLITE_MAGIC))
    if head.startswith(MAGIC):
        return McapSource([path])
    if head == _SQLITE_MAGIC:
        return SqliteSource([path])
    if path.suffix.lower() == ".csv" or is_parquet(path):
        return CsvSource([path])
    raise RecordingError(
        f"{path}: got neither MCAP nor sqlite3 nor .csv nor .parquet, expected a recording{packed(path)}"
    )


def _decompressed(data: bytes) -> bytes:
    import zstandard

    try:
        if 0 <= zstandard.frame_content_size(data) <= _LARGEST_MESSAGE:
            return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError:
        pass
    return b""


class Decoder:
    """Decoder of CDR messages. It reads the types of ROS 2 Jazzy, and types that have a schema in the recording."""

    def __init__(self, losses: Losses) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._losses = losses
        self._store = get_typestore(Stores.ROS2_JAZZY)

    def knows(self, topic: str, message_type: str, schema: str = "") -> bool:
        """Return whether a type can be decoded; if it cannot, add the topic to the unknown types."""
        from plow_twin.record.foreign_types import parsed_types

        if message_type not in self._store.types and schema:
            with suppress(Exception):  # the schema may be damaged, too large, or in another schema language
                types = parsed_types(schema, message_type)
                self._store.register({name: type_ for name, type_ in types.items() if name not in self._store.types})
        if message_type in self._store.types:
            return True
        self._losses.unknown_types[topic] = message_type
        return False

    def reads(self, channel: Channel) -> bool:
        """Return whether an MCAP channel can be decoded; if it cannot, add its topic to the unknown types."""
        if channel.encoding != "cdr":
            self._losses.unknown_types[channel.topic] = f"{channel.message_type} encoded as {channel.encoding}"
            return False
        return self.knows(channel.topic, channel.message_type, channel.schema.decode(errors="replace"))

    def decode(self, data: bytes, message_type: str) -> Any | None:
        """Return the decoded message. If the bytes cannot be decoded, count the message and return None."""
        if data.startswith(_ZSTD_MAGIC):
            data = _decompressed(data)
        for end in (len(data), len(data) - 8):  # after a final empty float64[], rclpy appends 8 meaningless bytes
            try:
                return self._store.deserialize_cdr(data[:end], message_type)
            except Exception:  # for damaged bytes, rosbags may raise index, struct, unicode and assertion errors
                continue
        self._losses.counts["undecodable"] += 1
        return None


def _behind_holes(parts: Sequence[Path], missing: Sequence[Path]) -> set[Path]:
    order = sorted((*parts, *missing), key=part_number)
    return {part for before, part in pairwise(order) if before in missing}


class McapSource:
    """A recording in MCAP files. `missing` contains the files in `metadata.yaml` that do not exist."""

    def __init__(self, parts: list[Path], missing: Sequence[Path] = ()) -> None:
        self.parts = parts
        self.losses = Losses()
        self._behind_holes = _behind_holes(parts, missing)

    def topics(self) -> dict[str, str]:
        """Return the type of each topic in the first chunks of each part."""
        types: dict[str, str] = {}
        for part in self.parts:
            if len(self.parts) > 1 and not is_mcap(part):
                continue
            reader = ChunkReader(part)
            for number, _ in enumerate(reader):
                if number >= 8:
                    break
            types |= {channel.topic: channel.message_type for channel in reader.channels.values()}
        return types

    def messages(self, wanted: Callable[[str], bool], stamp_ns: StampOf[Arrived] | None = None) -> Iterator[Arrived]:
        """Yield the messages on the topics for which `wanted` returns True, in the order of the files."""
        decoder = Decoder(self.losses)
        hole = False
        for part in self.parts:
            hole = hole or part in self._behind_holes
            if len(self.parts) > 1 and not (begins := is_mcap(part)):
                self.losses.counts["truncated_files" if begins is None else "damaged_files"] += 1
                hole = True
                continue
            reader = ChunkReader(part)
            is_chosen: dict[int, bool] = {}
            damaged = 0
            for messages in reader:
                hole, damaged = hole or reader.damaged > damaged, reader.damaged
                for index, number in enumerate(messages.channel.tolist()):
                    channel = reader.channels.get(number)
                    if channel is None:
                        self.losses.counts["undeclared"] += 1
                        continue
                    if number not in is_chosen:
                        is_chosen[number] = wanted(channel.topic) and decoder.reads(channel)
                    if not is_chosen[number]:
                        continue
                    content = decoder.decode(messages.data(index), channel.message_type)
                    if content is not None:
                        log_time = int(messages.log_time_ns[index])
                        yield Arrived(channel.topic, log_time, content, after_hole=hole)
                        hole = False
            hole = hole or not reader.finished or reader.damaged > damaged
            if not reader.finished:
                self.losses.counts["truncated_files"] += 1
            if reader.damaged:
                self.losses.counts["damaged_chunks"] += reader.damaged


class SqliteSource:
    """A recording in files of the sqlite3 storage of rosbag2; damaged files are skipped.

    `missing` contains the files in `metadata.yaml` that do not exist.
    """

    def __init__(self, parts: list[Path], missing: Sequence[Path] = ()) -> None:
        self.parts = sorted(parts, key=part_number)
        self.losses = Losses()
        self._unread: set[Path] = set()
        self._damaged: dict[Path, str] = {}
        self._behind_holes = _behind_holes(parts, missing)

    def _open(self, path: Path) -> sqlite3.Connection:
        log = path.with_name(path.name + "-wal")  # if the recorder was killed, the log contains its last messages
        kept = log.is_file() and log.stat().st_size > 0
        place = quote(path.resolve().as_posix())
        connection = sqlite3.connect(f"file:{place}?mode=ro" + ("" if kept else "&immutable=1"), uri=True)
        if kept:
            try:
                connection.execute("SELECT 1 FROM sqlite_master")
            except sqlite3.OperationalError:
                # sqlite3 cannot open the log in a read-only folder, so the file is read without the log
                connection.close()
                connection = sqlite3.connect(f"file:{place}?mode=ro&immutable=1", uri=True)
                self._unread.add(path)
                self.losses.counts["unread_logs"] = len(self._unread)
        connection.text_factory = lambda data: data.decode(errors="replace")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_MESSAGE)
        if connection.execute(_COMPUTED).fetchone() is not None:
            connection.close()
            raise sqlite3.DatabaseError("got computed tables, expected stored tables")
        return connection

    def topics(self) -> dict[str, str]:
        """Return the type of each topic. Raise `RecordingError` if no file can be read."""
        types: dict[str, str] = {}
        for part in self.parts:
            with self._reading(part) as (_, topics):
                types |= {name: kind for _, name, kind in topics}
        if len(self._damaged) == len(self.parts):
            part, reason = next(iter(self._damaged.items()))
            raise RecordingError(f"{part}: not a recording of rosbag2: {reason}")
        return types

    @contextmanager
    def _reading(self, part: Path) -> Iterator[tuple[sqlite3.Connection | None, list[tuple[int, str, str]]]]:
        """Open a file and read its topics, each with number, name and type.

        For a damaged file, the connection is None and the list of topics is empty.
        """
        topics: list[tuple[int, str, str]] = []
        with ExitStack() as opened:
            try:
                connection = opened.enter_context(closing(self._open(part)))
                rows = connection.execute("SELECT id, name, type FROM topics").fetchall()
                topics = [row for row in rows if isinstance(row[1], str) and isinstance(row[2], str)]
            except _SQLITE_ERRORS as error:
                self._damaged[part] = str(error)
                self.losses.counts["damaged_files"] = len(self._damaged)
                yield None, topics
                return
            yield connection, topics

    def messages(self, wanted: Callable[[str], bool], stamp_ns: StampOf[Arrived] | None = None) -> Iterator[Arrived]:
        """Yield the messages on the topics for which `wanted` returns True, in the order of the files."""
        decoder = Decoder(self.losses)
        hole = False
        for part in self.parts:
            hole = hole or part in self._behind_holes
            with self._reading(part) as (connection, topics):
                if connection is None:
                    hole = True
                    continue
                named = {
                    number: (name, kind)
                    for number, name, kind in topics
                    if wanted(name) and decoder.knows(name, kind, _schema(connection, kind))
                }
                try:
                    for number, stamp_ns, data in connection.execute(_MESSAGES):
                        if number not in named:
                            continue
                        name, kind = named[number]
                        if not isinstance(data, bytes) or not isinstance(stamp_ns, int):
                            self.losses.counts["undecodable"] += 1
                            continue
                        content = decoder.decode(data, kind)
                        if content is not None:
                            yield Arrived(name, stamp_ns, content, after_hole=hole)
                            hole = False
                except (*_SQLITE_ERRORS, OverflowError):
                    self.losses.counts["truncated_files"] += 1
                    hole = True


def _schema(connection: sqlite3.Connection, message_type: str) -> str:
    """Return the text of a message type, or an empty text if the file has none, as before ROS 2 Iron."""
    with suppress(*_SQLITE_ERRORS):
        return str((connection.execute(_SCHEMA, (message_type,)).fetchone() or ("",))[0])
    return ""


class CsvSource:
    """A recording in CSV files with a header row, or in Parquet files.

    Each file is a topic. The name of the topic is the file name without extension.
    """

    def __init__(self, parts: list[Path]) -> None:
        self.parts = parts
        self.losses = Losses()

    def topics(self) -> dict[str, TopicType]:
        """Return the columns of each topic."""
        types: dict[str, TopicType] = {}
        for part in self.parts:
            try:
                with open_csv(part) as stream:
                    names = [name.strip() for name in next(csv_rows(stream), (0, []))[1]]
            except csv.Error as error:
                raise RecordingError(f"{part}: {error}") from None
            types[part.stem] = columns_of(part, names)
        return types

    def messages(self, wanted: Callable[[str], bool], stamp_ns: StampOf[Arrived] | None = None) -> Iterator[Arrived]:
        """Return an iterator over the rows of the wanted files in the order of their stamps.

        Without `stamp_ns`, the stamp is read from the column that `time_column` returns.
        """
        streams = [self._rows(part) for part in self.parts if wanted(part.stem)]
        if len(streams) == 1:
            return streams[0]
        return merged(streams, stamp_ns or _log_time_ns)

    def _rows(self, part: Path) -> Iterator[Arrived]:
        try:
            with open_csv(part) as stream:
                rows = csv_rows(stream)
                names = tuple(name.strip() for name in next(rows, (0, []))[1])
                column = time_column(names)
                place = len(names) if column is None else names.index(column)
                for _, cells in rows:
                    time = _row_time_ns(cells[place]) if place < len(cells) else NO_TIME
                    yield Arrived(part.stem, time, dict(zip(names, cells, strict=False)))
        except csv.Error:
            self.losses.counts["truncated_files"] += 1


def read_table(path: Path) -> tuple[Columns, Iterator[list[str]]]:
    """Return the columns of a CSV or Parquet file, and an iterator over its rows.

    Lines that begin with `#` are skipped. Raise `RecordingError` if the file cannot be read, or two columns have the
    same name. The function or the iterator raises the error.
    """
    rows = _table_rows(path)
    names = tuple(name.strip() for name in next(rows, ()))
    return columns_of(path, names), rows


def read_columns(path: Path, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the numbers in the columns `names` of a CSV or Parquet file, shape (n, k).

    Raise `RecordingError` if the file cannot be read, a column occurs twice, or a column or a number is missing.
    """
    columns, rows = read_table(path)
    if not set(names) <= set(columns.names):
        raise RecordingError(f"{path}: got the {columns}, expected {', '.join(names)}")
    places = [columns.names.index(name) for name in names]
    numbers: list[list[float]] = []
    for row in rows:
        try:
            numbers.append([float(row[place]) for place in places])
        except (IndexError, ValueError):
            raise RecordingError(
                f"{path}: data row {len(numbers) + 1}: got {', '.join(map(repr, row))}, expected numbers in all of the "
                f"columns {', '.join(names)}"
            ) from None
    return np.array(numbers, float).reshape(-1, len(names))


def _table_rows(path: Path) -> Iterator[list[str]]:
    try:
        with open_csv(path) as stream:
            yield from (cells for _, cells in csv_rows(stream, "#"))
    except (OSError, csv.Error) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise RecordingError(f"{path}: {reason}") from None


def columns_of(source: Path | str, names: Sequence[str]) -> Columns:
    """Return the columns with these names; `source` is named in an error.

    Raise `RecordingError` if two columns have the same name.
    """
    columns = Columns(tuple(names))
    twice = [name for name, count in Counter(names).items() if name and count > 1]
    if twice:
        raise RecordingError(f"{source}: column {twice[0]!r} occurs more than once in the {columns}, expected once")
    return columns


def _log_time_ns(arrived: Arrived) -> int | None:
    return None if arrived.log_time_ns == NO_TIME else arrived.log_time_ns


def _row_time_ns(cell: str) -> int:
    """Return the time in a table cell [ns]. A number that is too large for seconds is read in a smaller unit."""
    return next((stamp_ns for unit in STAMP_UNITS if (stamp_ns := time_ns(cell, unit)) is not None), NO_TIME)
