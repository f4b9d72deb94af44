"""Read MCAP files from front to back, chunk by chunk, without the index at the end of the file.

A truncated file is read up to its last whole record. Damaged chunks are skipped and counted. For speed, the messages of
a chunk are stored as arrays of offsets into its bytes.

A *head* is the opcode and the length at the start of a record. The index records behind a chunk name its channels, so
that a chunk without wanted channels can be skipped.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from plow_twin.errors import ExcessError, ForeignRecordingError, RecordingError
from plow_twin.record.compression import RECORD_LIMIT, decompress
from plow_twin.record.template import Bytes, Indexes, compiled
from plow_twin.record.words import word

try:  # the function `crc32` of isal is twenty times as fast as the function of the standard library
    from isal.isal_zlib import crc32 as crc32
except ImportError:
    from zlib import crc32 as crc32

#: Name of the metadata record that replaces a damaged chunk in a repaired file.
DAMAGE_RECORD: Final = "plow_twin_damage"
MAGIC: Final = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _METADATA = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x0C
_ATTACHMENT: Final = 0x09
_TABLES: Final = (".csv", ".parquet")
_HEAD: Final = struct.Struct("<BQ")
_HEAD_SIZE: Final = _HEAD.size
#: Start of an index record: a head and a channel number.
_INDEX_HEAD: Final = struct.Struct("<BQH")
#: Largest decompressed size of all chunks, as a multiple of the size of the file; `RECORD_LIMIT` is added.
UNPACKED_RATIO: Final = 200
#: Largest number of schemas and channels that a file may declare.
_MOST_DECLARED: Final = 10_000
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
#: Number of bytes before the data of a message: opcode, length, channel, sequence, log time and publish time.
MESSAGE_HEAD: Final = 31
_MESSAGE_FIELDS: Final = MESSAGE_HEAD - _HEAD_SIZE
_COLUMNS: Final = 6
#: Size [B] up to which several chunks are scanned in one call.
_SMALL: Final = 2**18
#: Size [B] up to which several chunks are scanned in one call if the argument `wanted` is given.
_SMALL_ALONE: Final = 2**20


@dataclass(frozen=True)
class Channel:
    """A channel of an MCAP file: its topic, with the message type, the encoding and the text of the schema."""

    topic: str
    message_type: str
    encoding: str
    schema: bytes
    metadata: Mapping[str, str]


@dataclass(frozen=True)
class Messages:
    """Messages of one chunk in the order of the file, as arrays of shape (n,).

    The data of message `i` is `buffer[start[i] : start[i] + length[i]]`.
    """

    buffer: Bytes
    channel: Indexes
    sequence: Indexes
    log_time_ns: Indexes
    publish_time_ns: Indexes
    start: Indexes
    length: Indexes

    def __len__(self) -> int:
        return len(self.channel)

    def __getitem__(self, chosen: Any) -> Messages:
        """Return the messages that a mask, a slice or an array of indexes selects."""
        columns = (self.channel, self.sequence, self.log_time_ns, self.publish_time_ns, self.start, self.length)
        return Messages(self.buffer, *(column[chosen] for column in columns))

    @classmethod
    def none(cls) -> Messages:
        """Return an empty batch."""
        return cls(np.zeros(0, np.uint8), *(np.zeros(0, np.int64) for _ in range(6)))

    def data(self, index: int) -> bytes:
        """Return the data of the message with this index."""
        start = int(self.start[index])
        return self.buffer[start : start + int(self.length[index])].tobytes()


@dataclass
class ChunkReader:
    """Iterate over the chunks of one MCAP file.

    The reader adds each declared channel to `channels`, and sets `finished` to True if the file is complete. `damaged`
    is the number of records and chunks that could not be read, plus `left_out`. `left_out` is the number of damaged
    chunks that an earlier repair removed.
    """

    #: the file
    path: Path
    #: function that receives each metadata record
    on_metadata: Callable[[str, dict[str, str]], object] = lambda name, record: None
    #: function that receives the set of channel numbers of a chunk; if it returns False, the chunk is skipped; a chunk
    #: without a usable index is always read
    wanted: Callable[[set[int]], bool] | None = None
    #: function that waits until the file grows; the reader calls it at the end of the file, with the stream and the
    #: size of the file [B]; if `more` returns True, the reader continues; before each call, the reader yields an empty
    #: batch
    more: Callable[[IO[bytes], int], bool] | None = None
    channels: dict[int, Channel] = field(default_factory=dict)
    finished: bool = False
    damaged: int = 0
    left_out: int = 0
    position: int = 0
    #: result of `wanted` for each set of channels
    _answers: dict[frozenset[int], bool] = field(default_factory=dict, init=False)
    #: number of messages for which the next table has space
    _room: int = field(default=256, init=False)
    #: decompressed size of all chunks read so far [B]
    _unpacked: int = field(default=0, init=False)
    #: declared schemas and channels by opcode and number, in order to skip repeated declarations
    _declared: dict[tuple[int, bytes], bytes] = field(default_factory=dict, init=False)
    #: name and text of each schema
    _schemas: dict[int, tuple[str, bytes]] = field(default_factory=dict, init=False)
    #: chunks and single messages to scan in one call, because each call of `scan` has a fixed cost
    _waiting: list[Bytes] = field(default_factory=list, init=False)
    _waiting_bytes: int = field(default=0, init=False)
    _others: Indexes = field(default_factory=lambda: np.empty(256, np.int64), init=False)

    def __iter__(self) -> Iterator[Messages]:
        self.finished, self.damaged, self.left_out, self.position = False, 0, 0, 0
        self._unpacked, self._declared, self._schemas = 0, {}, {}
        self._waiting, self._waiting_bytes = [], 0
        small = _SMALL if self.wanted is None else _SMALL_ALONE
        with open_mcap(self.path) as stream:
            descriptor = stream.fileno()
            size, place = os.fstat(descriptor).st_size, len(MAGIC)
            while True:
                opcode, length = _head(descriptor, place)
                begin = place + _HEAD_SIZE
                if length > RECORD_LIMIT and opcode != _ATTACHMENT:
                    break
                # a footer is complete only if the magic bytes follow it
                behind = len(MAGIC) if opcode == _FOOTER else 0
                if begin + length + behind > size:
                    if self.more is None:
                        break
                    yield from self._scan_waiting()
                    yield Messages.none()
                    if not self.more(stream, size):
                        break
                    size = os.fstat(descriptor).st_size
                    continue
                place = self.position = begin + length
                if opcode == _MESSAGE:
                    record = os.pread(descriptor, _HEAD_SIZE + length, begin - _HEAD_SIZE)
                    self._wait(np.frombuffer(record, np.uint8))
                if self._waiting_bytes > small:
                    yield from self._scan_waiting()
                if opcode == _CHUNK:
                    channels, place = _indexed(descriptor, place, size)
                    if not self._is_wanted(channels):
                        continue
                    content = self._open(os.pread(descriptor, length, begin))
                    if content is None or len(content) > small:
                        yield from self._scan_waiting()
                    if content is not None:
                        self._count_unpacked(len(content), size)
                        self._wait(content)
                    else:
                        self._note_damage()
                elif opcode in (_SCHEMA, _CHANNEL):
                    self._declare(opcode, os.pread(descriptor, length, begin))
                elif opcode == _METADATA:
                    # the messages before the damage are yielded first, then the damage is counted
                    yield from self._scan_waiting()
                    self._metadata(os.pread(descriptor, length, begin))
                elif opcode == _FOOTER:
                    self.finished = os.pread(descriptor, len(MAGIC), place) == MAGIC
                    break
            yield from self._scan_waiting()

    def _is_wanted(self, channels: frozenset[int]) -> bool:
        if self.wanted is None or not channels or not channels <= self.channels.keys():
            return True
        if channels not in self._answers:
            self._answers[channels] = self.wanted({*channels})
        return self._answers[channels]

    def _open(self, record: bytes) -> Bytes | None:
        """Return the decompressed content of a chunk, or None if the chunk is damaged."""
        try:
            _, _, size, crc, letters = _CHUNK_HEAD.unpack_from(record)
            place = _CHUNK_HEAD.size + letters
            compression = record[_CHUNK_HEAD.size : place].decode()
            (length,) = struct.unpack_from("<Q", record, place)
            data = memoryview(record)[place + 8 : place + 8 + length]
            if len(data) != length or size > RECORD_LIMIT:
                return None
            content = decompress(compression, data, size)
        except Exception:  # the type of the error depends on the decompressor
            return None
        if len(content) != size or (crc and crc32(content) != crc):
            return None
        return np.frombuffer(content, np.uint8)

    def _count_unpacked(self, count: int, size: int) -> None:
        """Add `count` [B] to the decompressed size, and check the sum against the size of the file, `size` [B]."""
        self._unpacked += count
        most = RECORD_LIMIT + UNPACKED_RATIO * size
        if self._unpacked > most:
            raise ExcessError(
                f"{self.path}: unpacks to more than {most >> 20} MiB, expected at most {UNPACKED_RATIO} times its size"
            )

    def _wait(self, content: Bytes) -> None:
        self._waiting.append(content)
        self._waiting_bytes += len(content)

    def _scan_waiting(self) -> Iterator[Messages]:
        contents, self._waiting, self._waiting_bytes = self._waiting, [], 0
        if contents:
            yield from self._scan(contents)

    def _scan(self, contents: list[Bytes]) -> Iterator[Messages]:
        """Yield the messages of several chunks as one batch; if a chunk is damaged, yield one batch for each chunk."""
        content = contents[0] if len(contents) == 1 else np.concatenate(contents)
        others, table = self._others, np.empty((_COLUMNS, self._room), np.int64)
        count, other_count, whole = scan(content, table, others)
        if count > self._room:
            self._room = len(content) // MESSAGE_HEAD + 1
            table = np.empty((_COLUMNS, self._room), np.int64)
            count, other_count, whole = scan(content, table, others)
            self._room = count + count // 8
        if not whole and len(contents) > 1:
            for part in contents:
                yield from self._scan([part])
            return
        for place in others[: min(other_count, len(others))]:
            opcode, length = _HEAD.unpack_from(content.data, int(place))
            start = int(place) + _HEAD.size
            self._declare(opcode, content[start : start + length].tobytes())
        self.damaged += 0 if whole else 1
        yield Messages(content, *table[:, :count])

    def _declare(self, opcode: int, record: bytes) -> None:
        from mcap import records
        from mcap.data_stream import ReadDataStream

        number = opcode, record[:2]
        if self._declared.get(number) == record:
            return
        self._declared[number] = record
        if len(self._declared) > _MOST_DECLARED:
            raise ExcessError(f"{self.path}: got more schemas and channels, expected at most {_MOST_DECLARED}")
        stream = ReadDataStream(BytesIO(record))
        try:
            if opcode == _SCHEMA:
                schema = records.Schema.read(stream)
                self._schemas[schema.id] = (schema.name, schema.data)
            else:
                channel = records.Channel.read(stream)
                self.channels[channel.id] = self._channel(channel)
        except Exception:  # the messages of a damaged channel are skipped
            self.damaged += 1

    def _channel(self, record: Any) -> Channel:
        name, text = self._schemas.get(record.schema_id, ("", b""))
        return Channel(record.topic, name, record.message_encoding, text, record.metadata)

    def _metadata(self, record: bytes) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Metadata

        try:
            metadata = Metadata.read(ReadDataStream(BytesIO(record)))
        except Exception:
            self.damaged += 1
            return
        if metadata.name == DAMAGE_RECORD:
            self.damaged, self.left_out = self.damaged + 1, self.left_out + 1
        self.on_metadata(metadata.name, dict(metadata.metadata))

    def _note_damage(self) -> None:
        """Count a damaged chunk, and read the channels that the chunk may have declared from the end of the file."""
        self.damaged += 1
        summary = read_summary(self.path)
        if summary is not None:
            for schema in summary.schemas.values():
                self._schemas.setdefault(schema.id, (schema.name, schema.data))
            for channel in summary.channels.values():
                self.channels.setdefault(channel.id, self._channel(channel))


def read_summary(path: Path) -> Any | None:
    """Return the summary at the end of an MCAP file, or None if it is missing or damaged."""
    from mcap.reader import make_reader

    try:
        with path.open("rb") as stream:
            return make_reader(stream).get_summary()
    except Exception:  # the type of the error depends on the damage
        return None


def is_mcap(path: Path) -> bool | None:
    """Return True if a file begins with the magic bytes of MCAP.

    The result is None if the file ends within the magic bytes, because its writer was killed early.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(len(MAGIC))
    except OSError:
        return True
    return head == MAGIC or (None if MAGIC.startswith(head) else False)


def metadata_records(path: Path) -> list[tuple[str, dict[str, str]]]:
    """Return the name and the content of each metadata record in a file."""
    from mcap.reader import make_reader

    with open_mcap(path) as stream:
        try:
            return [(record.name, dict(record.metadata)) for record in make_reader(stream).iter_metadata()]
        except Exception:  # the index at the end of the file is missing or damaged
            pass
    records: list[tuple[str, dict[str, str]]] = []
    for _ in ChunkReader(path, lambda name, record: records.append((name, record)), lambda numbers: False):
        pass
    return records


def _head(descriptor: int, place: int) -> tuple[int, int]:
    """Return the opcode and the length of the record at offset `place`, or zeros at the end of the file."""
    head = os.pread(descriptor, _HEAD_SIZE, place)
    opcode, length = _HEAD.unpack(head) if len(head) == _HEAD_SIZE else (0, 0)
    return opcode, length


def _indexed(descriptor: int, place: int, size: int) -> tuple[frozenset[int], int]:
    """Return the channels in the index records from offset `place` on, and the end of these records [B]."""
    numbers = set[int]()
    while len(head := os.pread(descriptor, _INDEX_HEAD.size, place)) == _INDEX_HEAD.size:
        opcode, length, number = _INDEX_HEAD.unpack(head)
        if opcode != _MESSAGE_INDEX or place + _HEAD_SIZE + length > size:
            break
        numbers.add(number)
        place += _HEAD_SIZE + length
    return frozenset(numbers), place


@compiled
def scan(content: Bytes, table: Indexes, others: Indexes) -> tuple[int, int, bool]:
    """Find the messages, schemas and channels in the decompressed content of a chunk.

    Each message fills a column of `table`. The array `others` receives the offsets of schemas and channels. Return the
    number of messages (the number of columns plus one if the table is too small), the number of schemas and channels,
    and whether the last record ends at the end of the chunk.
    """
    place, count, other = 0, 0, 0
    size, room = content.size, table.shape[1]
    while place + _HEAD_SIZE <= size:
        length, start = word(content, place + 1), place + _HEAD_SIZE
        if length < 0 or length > size - start:
            return count, other, False
        opcode = content[place]
        if opcode == _MESSAGE and length >= _MESSAGE_FIELDS:
            if count == room:
                return room + 1, other, False
            head = word(content, start)
            table[0, count], table[1, count] = head & 0xFFFF, head >> 16 & 0xFFFFFFFF
            table[2, count], table[3, count] = word(content, start + 6), word(content, start + 14)
            table[4, count], table[5, count] = start + _MESSAGE_FIELDS, length - _MESSAGE_FIELDS
            count += 1
        elif opcode in (_SCHEMA, _CHANNEL):
            if other < others.size:
                others[other] = place
            other += 1
        place = start + length
    return count, other, bool(place == size)


def open_mcap(path: Path) -> IO[bytes]:
    """Open an MCAP file. Raise `RecordingError` if the file cannot be read or is not an MCAP file."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    begin = stream.read(len(MAGIC))
    if begin != MAGIC:
        stream.close()
        if MAGIC.startswith(begin):
            # an empty table is not a recording that a killed recorder has left
            kind = RecordingError if path.suffix == ".mcap" else ForeignRecordingError
            state = "truncated before its first message" if begin else "empty"
            raise kind(f"{path}: {state}: its recorder was killed before it wrote anything")
        table = path.suffix.lower() in _TABLES
        more = "; plow-twin live makes a recording of a table, and commands with --map read a table" if table else ""
        raise ForeignRecordingError(f"{path}: not an MCAP file (its first bytes are not {MAGIC!r}){more}")
    stream.seek(0)
    return stream
