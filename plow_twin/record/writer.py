"""One recording on disk: `run/run_0.mcap` with `run/metadata.yaml` beside it, written from a single thread."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from mcap.writer import Writer

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import encode, schema_text, type_hash, warm_up
from plow_twin.record.header import HEADER_RECORD, LOSS_RECORD, STOPPED_EARLY_KEY, RunHeader
from plow_twin.record.journal_codec import Dropped, to_message
from plow_twin.record.messages import Message
from plow_twin.record.metadata_yaml import TopicCount, bag_metadata, qos_text, write_metadata
from plow_twin.stream.journal import Entry, Sample

_SEQUENCE_MASK: Final = 0xFFFFFFFF


class RunWriter:
    """Write entries and outputs in the order given.

    Every method may raise `OSError` (disk full); after that only `abandon` may be called.

    Parameters
    ----------
    folder
        Made by the writer; must not exist or be empty.
    chunk_size
        Bytes [B] in one compressed chunk.
    min_free_bytes
        `reason_to_stop` speaks up when the disk has less free space [B] than that.
    """

    def __init__(self, folder: Path, header: RunHeader, chunk_size: int, min_free_bytes: int) -> None:
        self.folder = folder
        self.header = header
        self.path = folder / f"{folder.name}_0.mcap"
        self._min_free_bytes = min_free_bytes
        self._topics: dict[str, tuple[int, TopicCount]] = {}
        self._schemas: dict[str, int] = {}
        self._start_ns, self._end_ns = -1, -1
        warm_up()
        _make_folder(folder)
        self._file = _UnbufferedFile(self.path)
        # the library's stream is an IO[bytes] by annotation, but only write, tell and flush are used
        self._mcap = Writer(self._file, chunk_size=chunk_size)  # type: ignore[arg-type]
        self._mcap.start(profile="ros2", library=f"plow_twin {header.package_version}")
        self._mcap.add_metadata(HEADER_RECORD, header.to_record())

    @property
    def bytes_written(self) -> int:
        """Size of the file so far [B]."""
        return self._file.tell()

    def write_entry(self, sequence: int, log_time_ns: int, entry: Entry | Dropped) -> None:
        """Write one journal entry under its place in the common order."""
        topic = self.header.samples_topic if isinstance(entry, Sample) else self.header.entries_topic
        stamp_ns = getattr(entry, "stamp_ns", log_time_ns)
        self._write(topic, sequence, log_time_ns, stamp_ns, to_message(entry, self.header.frame_id))

    def write_output(self, topic: str, sequence: int, log_time_ns: int, stamp_ns: int, message: Message) -> None:
        """Write one message that the node sent after journal entry number `sequence`."""
        self._write(topic, sequence, log_time_ns, stamp_ns, message)

    def _write(self, topic: str, sequence: int, log_time_ns: int, stamp_ns: int, message: Message) -> None:
        # MCAP times are unsigned; the exact stamp is in the message
        log_time_ns, stamp_ns = max(0, log_time_ns), max(0, stamp_ns)
        data = encode(message)
        channel, counter = self._topics.get(topic) or self._add_topic(topic, message.TYPE)
        if counter.message_type != message.TYPE:
            raise RecordingError(f"{topic}: got a {message.TYPE}, expected a {counter.message_type} as before")
        self._mcap.add_message(channel, log_time_ns, data, stamp_ns, sequence & _SEQUENCE_MASK)
        counter.count += 1
        self._start_ns = log_time_ns if self._start_ns < 0 else min(self._start_ns, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)

    def _add_topic(self, topic: str, message_type: str) -> tuple[int, TopicCount]:
        schema = self._schemas.get(message_type)
        if schema is None:
            schema = self._mcap.register_schema(message_type, "ros2msg", schema_text(message_type).encode())
            self._schemas[message_type] = schema
        qos = {"offered_qos_profiles": qos_text(message_type), "topic_type_hash": type_hash(message_type)}
        channel = self._mcap.register_channel(topic, "cdr", schema, qos)
        self._topics[topic] = (channel, TopicCount(topic, message_type))
        return self._topics[topic]

    def flush(self) -> None:
        """Hand all that was written to the operating system; a killed process loses nothing of it."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def reason_to_stop(self) -> str | None:
        """Return why recording should end now, while the file can still be closed: little disk space, or file gone."""
        if not self._file.is_linked():
            return "the file was removed or replaced"
        free = shutil.disk_usage(self.folder).free
        if free < self._min_free_bytes:
            return f"{free} B free on the disk, expected at least {self._min_free_bytes} B"
        return None

    def close(self, loss: Mapping[str, int], stop_reason: str | None = None) -> None:
        """Write the loss counters, why recording ended before the run (if it did), the index and `metadata.yaml`."""
        record = {topic: str(count) for topic, count in loss.items()}
        custom = {f"plow_twin_lost {topic}": count for topic, count in record.items()}
        if stop_reason is not None:
            record[STOPPED_EARLY_KEY] = custom[f"plow_twin_{STOPPED_EARLY_KEY}"] = stop_reason
        self._mcap.flush()  # type: ignore[no-untyped-call]
        self._mcap.add_metadata(LOSS_RECORD, record)
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        topics = [counter for _, counter in self._topics.values()]
        start, end = max(0, self._start_ns), max(0, self._end_ns)
        write_metadata(self.folder, bag_metadata(self.path.name, topics, start, end, custom))

    def abandon(self) -> None:
        """Leave the file as it is, without an index: after an error."""
        self._file.close()


def _make_folder(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RecordingError(f"{folder}: exists already, expected a new or empty folder for the recording")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be made: {error.strerror}") from error


class _UnbufferedFile:
    """A file that holds nothing back, so that nothing is left to fail a second time when the disk is full.

    The MCAP writer hands over whole chunks, which need no buffer.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be made: {error.strerror}") from error
        self._offset = 0
        self._open = True

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            count = os.write(self._descriptor, view)
            self._offset += count
            view = view[count:]
        return len(data)

    def tell(self) -> int:
        return self._offset

    def flush(self) -> None:
        """Do nothing: every write has reached the operating system."""

    def is_linked(self) -> bool:
        """Tell whether the path still leads to this file."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), os.stat(self._path))
        except FileNotFoundError:
            return False

    def close(self) -> None:
        if self._open:
            self._open = False
            os.close(self._descriptor)
