"""Write MCAP files.

Compiled functions write many messages at a time. These functions and the compressors release the interpreter lock. Each
record is written by a single call, so that the file of a killed process can be read up to its last chunk.
"""

from __future__ import annotations

import io
import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from plow_twin.errors import TakenError
from plow_twin.record.chunks import MAGIC, MESSAGE_HEAD, crc32
from plow_twin.record.durable import naming
from plow_twin.record.follow import claim
from plow_twin.record.template import Bytes, Indexes, Template, compiled, fill
from plow_twin.record.words import set_word

_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
_INDEX_ENTRY: Final = np.dtype([("time", "<u8"), ("offset", "<u8")])


class ChunkBuilder:
    """Buffer that collects the messages of a chunk."""

    def __init__(self, compression: str) -> None:
        self.compression = compression
        self._buffer: Bytes = np.empty(1 << 16, np.uint8)
        self.size = 0
        self._channels: list[Indexes] = []
        self._times: list[Indexes] = []
        self._offsets: list[Indexes] = []

    def add(self, channel: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Add one message."""
        head = _MESSAGE_HEAD.pack(5, 22 + len(data), channel, sequence, log_time_ns, publish_time_ns)
        place = self.reserve(len(head) + len(data))
        self._buffer[place : self.size] = np.frombuffer(head + data, np.uint8)
        self._note(*(np.array([number]) for number in (channel, log_time_ns, place)))

    def add_bytes(
        self,
        channel: Indexes,
        sequence: Indexes,
        log_time_ns: Indexes,
        publish_time_ns: Indexes,
        length: Indexes,
        data: bytes,
    ) -> None:
        """Add n messages. The arrays have shape (n,), and `data` is the concatenation of all messages."""
        sizes = MESSAGE_HEAD + length
        ends = np.cumsum(sizes)
        starts = self.reserve(int(ends[-1]) if len(ends) else 0) + ends - sizes
        heads(self._buffer, starts, channel, sequence, log_time_ns, publish_time_ns, length)
        spread(self._buffer, starts + MESSAGE_HEAD, length, np.frombuffer(data, np.uint8))
        self._note(channel, log_time_ns, starts)

    def add_many(
        self,
        channel: int,
        template: Template,
        starts: Indexes,
        sequence: Indexes,
        log_time_ns: Indexes,
        stamp_ns: Indexes,
        values: Any,
    ) -> None:
        """Write messages of one template to the offsets `starts`, which `reserve` must have returned."""
        channels, length = np.full(len(starts), channel), np.full(len(starts), len(template))
        heads(self._buffer, starts, channels, sequence, log_time_ns, np.maximum(stamp_ns, 0), length)
        fill(self._buffer, starts + MESSAGE_HEAD, template.data, template.places, stamp_ns, values)
        self._note(channels, log_time_ns, starts)

    def reserve(self, size: int) -> int:
        """Enlarge the content by `size` bytes and return the offset of the first new byte."""
        place = self.size
        self.size += size
        if self.size > len(self._buffer):
            larger = np.empty(max(self.size, 2 * len(self._buffer)), np.uint8)
            larger[:place] = self._buffer[:place]
            self._buffer = larger
        return place

    def clear(self) -> None:
        """Discard all messages."""
        self.size, self._channels, self._times, self._offsets = 0, [], [], []

    def _note(self, channel: Indexes, time_ns: Indexes, offset: Indexes) -> None:
        self._channels.append(channel)
        self._times.append(time_ns)
        self._offsets.append(offset)

    def pop(self) -> tuple[Bytes, dict[int, Any]]:
        """Return the records and the index of each channel, and empty the builder.

        An index consists of the times and offsets of the messages, sorted by time.
        """
        channels, times, offsets = map(np.concatenate, (self._channels, self._times, self._offsets))
        index = {}
        for channel in np.unique(channels).tolist():
            chosen = np.flatnonzero(channels == channel)
            chosen = chosen[np.argsort(times[chosen], kind="stable")]
            entries = np.empty(len(chosen), _INDEX_ENTRY)
            entries["time"], entries["offset"] = times[chosen], offsets[chosen]
            index[channel] = entries
        content = self._buffer[: self.size]
        self.clear()
        return content, index


@compiled
def heads(buffer, starts, channel, sequence, log_time, publish_time, length):  # type: ignore[no-untyped-def]
    """Write the head of each message, which consists of opcode, length, channel, sequence number and two times."""
    for n in range(starts.size):
        start, size = starts[n], length[n] + 22
        set_word(buffer, start, 5 | size << 8)
        set_word(buffer, start + 8, size >> 56 | channel[n] << 8 | sequence[n] << 24)
        set_word(buffer, start + 15, log_time[n])
        set_word(buffer, start + 23, publish_time[n])


@compiled
def spread(buffer, starts, length, data):  # type: ignore[no-untyped-def]
    """Copy the concatenated messages in `data` to the offsets `starts` in `buffer`."""
    place = 0
    for n in range(starts.size):
        start, end = starts[n], place + length[n]
        buffer[start : start + length[n]] = data[place:end]
        place = end


class McapFile:
    """Writer of an MCAP file to the stream `out`.

    Every method raises `OSError` if the disk is full. After a failed call of `chunk`, the messages of the chunk are
    lost, and the file is as before the call. After a failed call of any other method outside the context `undone`,
    `out` must be closed.
    """

    def __init__(self, out: ByteFile, library: str) -> None:
        from mcap.records import Header

        self.out = out
        self._schemas: dict[str, Any] = {}
        self._channels: dict[int, Any] = {}
        self._undeclared: list[Any] = []
        # a live run writes thousands of chunks an hour, and bytes take a tenth of the memory of objects
        self._chunk_index = bytearray()
        self._chunk_count = 0
        self._metadata: list[Any] = []
        #: number of messages of each channel
        self.counts: Counter[int] = Counter()
        self._times: list[int] = []
        #: size of the file so far [B]
        self.size = 0
        self._append(MAGIC)
        self._write(Header("ros2", library))

    def _append(self, data: bytes) -> None:
        self.out.write(data)
        self.size += len(data)

    @property
    def times(self) -> tuple[int, int]:
        """First and last log time [ns], or (0, 0) without messages."""
        return (min(self._times), max(self._times)) if self._times else (0, 0)

    def _write(self, record: Any) -> int:
        data = _records_bytes([record])
        self._append(data)
        return len(data)

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Write a metadata record."""
        from mcap.records import Metadata, MetadataIndex

        offset = self.size
        length = self._write(Metadata(name=name, metadata=dict(record)))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def channel(self, topic: str, message_type: str, schema: bytes, metadata: Mapping[str, str]) -> int:
        """Add a channel and return its number. The channel is declared in the file before the next chunk."""
        from mcap.records import Channel, Schema

        if message_type not in self._schemas:
            number = len(self._schemas) + 1
            self._schemas[message_type] = Schema(id=number, data=schema, encoding="ros2msg", name=message_type)
            self._undeclared.append(self._schemas[message_type])
        number = len(self._channels) + 1
        self._channels[number] = Channel(
            id=number,
            topic=topic,
            message_encoding="cdr",
            metadata=dict(metadata),
            schema_id=self._schemas[message_type].id,
        )
        self._undeclared.append(self._channels[number])
        return number

    def chunk(self, builder: ChunkBuilder) -> None:
        """Write the messages of a builder as a chunk with its index; an empty chunk is not written."""
        if not builder.size:
            return
        content, index = builder.pop()
        with self.undone():
            self._chunk(builder.compression, content, index)

    @contextmanager
    def undone(self) -> Iterator[None]:
        """Restore the file to its content at the start of this context if the context raises `OSError`."""
        size, metadata = self.size, len(self._metadata)
        try:
            yield
        except OSError:
            self.size = self.out.truncate(size)
            del self._metadata[metadata:]
            raise

    def _chunk(self, compression: str, content: Bytes, index: dict[int, Any]) -> None:
        from mcap.records import ChunkIndex

        for record in self._undeclared:
            self._write(record)
        first = min(int(entries["time"][0]) for entries in index.values())
        last = max(int(entries["time"][-1]) for entries in index.values())
        name = compression.encode()
        data = _compress(compression, content)
        start = self.size
        crc = crc32(content)
        head = struct.pack("<QQQII", first, last, len(content), crc, len(name)) + name + struct.pack("<Q", len(data))
        record = struct.pack("<BQ", 6, len(head) + len(data)) + head + data
        offsets, place, parts = {}, start + len(record), [record]
        for channel, entries in index.items():
            offsets[channel] = place
            raw = entries.tobytes()
            parts.append(struct.pack("<BQHI", 7, 6 + len(raw), channel, len(raw)) + raw)
            place += len(parts[-1])
        self._append(b"".join(parts))
        self._undeclared = []
        for channel, entries in index.items():
            self.counts[channel] += len(entries)
        self._times += [first, last]
        if len(self._times) > 64:
            self._times = [min(self._times), max(self._times)]
        self._chunk_count += 1
        entry = ChunkIndex(
            chunk_length=len(record),
            chunk_start_offset=start,
            compression=compression,
            compressed_size=len(data),
            message_end_time=last,
            message_index_length=place - start - len(record),
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=len(content),
        )
        self._chunk_index += _records_bytes([entry])

    def finish(self) -> None:
        """Write the index, the footer and the final magic bytes."""
        from mcap.opcode import Opcode
        from mcap.records import DataEnd, Footer, Statistics, SummaryOffset

        for record in self._undeclared:
            self._write(record)
        self._write(DataEnd(0))
        start = self.size
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self.counts),
            chunk_count=self._chunk_count,
            message_count=self.counts.total(),
            metadata_count=len(self._metadata),
            message_start_time=self.times[0],
            message_end_time=self.times[1],
            schema_count=len(self._schemas),
        )
        groups = (
            (Opcode.SCHEMA, _records_bytes(self._schemas.values())),
            (Opcode.CHANNEL, _records_bytes(self._channels.values())),
            (Opcode.STATISTICS, _records_bytes([statistics])),
            (Opcode.CHUNK_INDEX, self._chunk_index),
            (Opcode.METADATA_INDEX, _records_bytes(self._metadata)),
        )
        summary, offsets = bytearray(), []
        for opcode, data in groups:
            if data:
                place = start + len(summary)
                offsets.append(SummaryOffset(group_opcode=opcode, group_start=place, group_length=len(data)))
                summary += data
        offset_start = start + len(summary)
        summary += _records_bytes(offsets)
        crc = crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), crc32(summary))
        self._append(bytes(summary))
        self._write(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc))
        self._append(MAGIC)


def _records_bytes(records: Iterable[Any]) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def _compress(compression: str, content: Bytes) -> bytes:
    if compression == "lz4":
        import lz4.frame

        # independent blocks are decompressed faster than linked blocks, and take only 1 % more space
        return bytes(lz4.frame.compress(content, block_linked=False))
    import zstandard

    return bytes(zstandard.ZstdCompressor(level=3).compress(content.tobytes()))


class UnbufferedFile(io.FileIO):
    """A new file without a buffer.

    After a failed write to a full disk, a buffered file would try to write the rest of its buffer again.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            super().__init__(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o644))
        except FileExistsError as error:
            raise TakenError(f"{path}: exists already, expected a new file for the recording") from error
        claim(self.fileno())

    def write(self, data: Any) -> int:
        """Append all bytes of `data`, and return their number."""
        view = memoryview(data)
        while view:
            with naming(self._path):
                view = view[super().write(view) :]
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Truncate the file to `size` bytes, and continue at its end."""
        return self.seek(super().truncate(size))

    def sync(self) -> None:
        """Wait until all data are on the disk."""
        os.fdatasync(self.fileno())

    def is_linked(self) -> bool:
        """Return whether the file still exists at its path."""
        try:
            return os.path.samestat(os.fstat(self.fileno()), os.stat(self._path))
        except (FileNotFoundError, NotADirectoryError):
            return False

    def remove(self) -> None:
        """Close and remove the file."""
        self._path.unlink(missing_ok=True)
        self.close()


class MemoryFile(io.BytesIO):
    """A file in memory, whose content can be read after `close`."""

    def truncate(self, size: int | None = None) -> int:
        """Truncate the file to `size` bytes, and continue at its end."""
        return self.seek(super().truncate(size))

    def sync(self) -> None:
        """Do nothing."""

    def is_linked(self) -> bool:
        """Return True, because a file in memory cannot be removed from a folder."""
        return True

    def close(self) -> None:
        """Do nothing."""

    def remove(self) -> None:
        """Do nothing."""


ByteFile: TypeAlias = UnbufferedFile | MemoryFile
