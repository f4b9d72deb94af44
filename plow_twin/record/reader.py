"""Reading a recording from front to back: complete, cut off by a kill, or with damaged chunks.

Only one chunk is in memory at a time, and no index is needed: a file without its end is read as far as it goes.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import IO, Any, Final

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import decode
from plow_twin.record.header import HEADER_RECORD, LOSS_RECORD, STOPPED_EARLY_KEY, RunHeader
from plow_twin.record.journal_codec import Dropped, from_message
from plow_twin.record.messages import MESSAGE_TYPES, Message
from plow_twin.stream.journal import Entry

#: A longer record is damage: the recorder's chunks are some 64 KiB [B].
_RECORD_LIMIT: Final = 256 * 1024 * 1024
_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"


class FileStatus(Enum):
    """How a file ended."""

    UNREAD = "not read to its end"
    COMPLETE = "complete"
    STOPPED_EARLY = "stopped early: the recorder closed it before the run ended"
    TRUNCATED = "truncated: the recorder did not close it"
    DAMAGED = "damaged: chunks could not be read"


@dataclass(frozen=True, slots=True)
class EntryRecord:
    """A journal entry, or the recorder's note, at its place in the common order."""

    sequence: int
    log_time_ns: int
    entry: Entry | Dropped


@dataclass(frozen=True, slots=True)
class OutputRecord:
    """A message that was sent after journal entry number `sequence`; `data` are its CDR bytes."""

    sequence: int
    log_time_ns: int
    publish_time_ns: int
    topic: str
    message_type: str
    data: bytes

    def message(self) -> Message:
        """Decode the message."""
        return decode(self.data, self.message_type)


Record = EntryRecord | OutputRecord


@dataclass
class RunReader:
    """Iterate over the records of a recording, a folder or its `.mcap` file.

    `status`, `damaged_chunks`, `lost` (by topic, as the recorder counted), `stop_reason` (why it stopped early, if it
    did) and `counts` (records by topic) hold once the iteration has ended; `position` is the share of the file that has
    been read, 0..1.

    Raises
    ------
    RecordingError
        There is no such file, or it is not a recording of plow_twin.
    """

    path: Path
    header: RunHeader = field(init=False)
    status: FileStatus = field(default=FileStatus.UNREAD, init=False)
    damaged_chunks: int = field(default=0, init=False)
    lost: Mapping[str, int] = field(default_factory=dict, init=False)
    stop_reason: str | None = field(default=None, init=False)
    counts: Counter[str] = field(default_factory=Counter, init=False)
    position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.path = mcap_path(Path(self.path))
        with _open(self.path) as stream:
            for record in self._records(stream):
                if type(record).__name__ == "Metadata" and record.name == HEADER_RECORD:
                    self.header = RunHeader.from_record(record.metadata, str(self.path))
                    return
                if type(record).__name__ == "Chunk":
                    break
        raise RecordingError(f"{self.path}: metadata {HEADER_RECORD!r} is missing: not a recording of plow_twin")

    def __iter__(self) -> Iterator[Record]:
        self.status, self.damaged_chunks, self.lost, self.position = FileStatus.UNREAD, 0, {}, 0.0
        self.stop_reason = None
        size = self.path.stat().st_size
        self.counts.clear()
        channels: dict[int, Any] = {}
        schemas: dict[int, Any] = {}
        with _open(self.path) as stream:
            for record in self._records(stream):
                kind = type(record).__name__
                self.position = stream.tell() / size
                if kind == "Chunk":
                    for inner in self._open_chunk(record, schemas, channels):
                        yield from self._convert(inner, schemas, channels)
                elif kind == "Metadata" and record.name == LOSS_RECORD:
                    counted = dict(record.metadata)
                    self.stop_reason = counted.pop(STOPPED_EARLY_KEY, None)
                    self.lost = {topic: int(count) for topic, count in counted.items()}
                elif kind == "Footer":
                    self.status = FileStatus.COMPLETE
        if self.status is FileStatus.UNREAD:
            self.status = FileStatus.TRUNCATED
        elif self.damaged_chunks:
            self.status = FileStatus.DAMAGED
        elif self.stop_reason is not None:
            self.status = FileStatus.STOPPED_EARLY

    def _records(self, stream: IO[bytes]) -> Iterator[Any]:
        """Yield the records outside the chunks up to the footer or to where the file breaks off."""
        from mcap.exceptions import InvalidMagic, McapError
        from mcap.stream_reader import StreamReader

        try:
            yield from StreamReader(stream, emit_chunks=True, record_size_limit=_RECORD_LIMIT).records
        except InvalidMagic as error:
            if stream.tell() <= len(_MCAP_MAGIC):
                raise RecordingError(f"{self.path}: got {error}, expected an MCAP file") from error
        except (McapError, struct.error, UnicodeDecodeError, MemoryError):
            return  # cut off here; the missing footer tells

    def _open_chunk(self, chunk: Any, schemas: dict[int, Any], channels: dict[int, Any]) -> list[Any]:
        from mcap.stream_reader import breakup_chunk

        try:
            return breakup_chunk(chunk, validate_crc=True)
        except Exception:  # each decompressor has errors of its own; all mean that the chunk is damaged
            self.damaged_chunks += 1
            self._read_summary(schemas, channels)
            return []

    def _read_summary(self, schemas: dict[int, Any], channels: dict[int, Any]) -> None:
        """Take channels from the index at the end, for the messages behind a damaged chunk that declared them."""
        from mcap.reader import make_reader

        try:
            with self.path.open("rb") as stream:
                summary = make_reader(stream).get_summary()
        except Exception:  # no index, no help
            return
        if summary is not None:
            schemas.update(summary.schemas)
            channels.update(summary.channels)

    def _convert(self, record: Any, schemas: dict[int, Any], channels: dict[int, Any]) -> Iterator[Record]:
        kind = type(record).__name__
        if kind == "Schema":
            schemas[record.id] = record
        elif kind == "Channel":
            channels[record.id] = record
        elif kind == "Message" and record.channel_id in channels:
            channel = channels[record.channel_id]
            schema = schemas.get(channel.schema_id)
            self.counts[channel.topic] += 1
            if schema is not None and schema.name in MESSAGE_TYPES:
                yield self._record(record, channel.topic, schema.name)

    def _record(self, record: Any, topic: str, message_type: str) -> Record:
        if topic in (self.header.samples_topic, self.header.entries_topic):
            place = f"{self.path}: {topic} number {record.sequence}"
            entry = from_message(decode(record.data, message_type), place)
            return EntryRecord(record.sequence, record.log_time, entry)
        return OutputRecord(record.sequence, record.log_time, record.publish_time, topic, message_type, record.data)


def mcap_path(path: Path) -> Path:
    """Return the file of a recording given as its folder or as the file itself."""
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise RecordingError(f"{path}: got {len(files)} .mcap files, expected one")
        return files[0]
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording, expected an .mcap file or its folder")
    return path


def _open(path: Path) -> IO[bytes]:
    try:
        stream = path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    if stream.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
        stream.close()
        raise RecordingError(f"{path}: not an MCAP file (its first bytes are not {_MCAP_MAGIC!r})")
    stream.seek(0)
    return stream
