"""Write a recording to a folder: `run/run_0.mcap`, `run/run_1.mcap`, ... and `run/metadata.yaml`.

All functions must be called from one thread.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeVar
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError, TakenError
from plow_twin.record.cdr import encode, schema_text, type_hash, warm_up
from plow_twin.record.chunks import MESSAGE_HEAD
from plow_twin.record.durable import sync_path
from plow_twin.record.header import HEADER_RECORD, JOURNAL, LOSS_RECORD, STOPPED_EARLY_KEY, RunHeader
from plow_twin.record.journal_codec import Dropped, to_message
from plow_twin.record.mcap_file import ByteFile, ChunkBuilder, McapFile, UnbufferedFile
from plow_twin.record.messages import Message, WrenchStamped
from plow_twin.record.metadata_yaml import PartFacts, TopicCount, bag_metadata, qos_text, write_metadata
from plow_twin.record.outputs import REPLAYED, publication_templates
from plow_twin.record.reader import sample_template
from plow_twin.record.template import Indexes
from plow_twin.solve.state import WITH_INTERVALS
from plow_twin.stream.journal import Digest, Entry, Loss, Sample
from plow_twin.stream.outputs import Published
from plow_twin.stream.topics import TOPICS, Cadence, topics_of

#: Subfolder of a run for recordings of topics of other nodes. If it exists, `beside_2`, `beside_3`, ... are used.
BESIDE: Final = "beside"
_SEQUENCE_MASK: Final = 0xFFFFFFFF
Made = TypeVar("Made")


@dataclass
class _Part:
    path: Path
    file: McapFile
    #: for each topic, the number, message type and QoS text of its channel
    channels: dict[str, tuple[int, str, str]] = field(default_factory=dict)
    #: for each base name of a topic, the number of its channel
    sent: dict[str, int] = field(default_factory=dict)

    def facts(self) -> PartFacts:
        counts = [
            TopicCount(topic, message_type, self.file.counts[number], qos)
            for topic, (number, message_type, qos) in self.channels.items()
        ]
        return PartFacts(self.path.name, *self.file.times, counts)


class RunWriter:
    """Write journal entries and outputs to the parts of a recording. The arguments are described in `Recorder`.

    Journal entries and outputs are written to separate chunks. A chunk of entries precedes the chunk of the outputs
    that were sent after these entries.

    Every method raises `OSError` if the disk is full. After a failed write, `flush` or `split`, the file contains all
    data up to the previous flush, and more data can be written. After a failed `close`, only `abandon` may be called.
    """

    def __init__(
        self, folder: Path, header: RunHeader, chunk_size: int, min_free_bytes: int, *, sync: bool = False
    ) -> None:
        self.folder = folder
        self.header = header = replace(header, run_id=uuid4().hex)
        self.path = folder / f"{folder.name}_0.mcap"
        self._chunk_size = chunk_size
        self._min_free_bytes = min_free_bytes
        self._sync = sync
        self._journal, self._outputs = ChunkBuilder("zstd"), ChunkBuilder("lz4")
        self._sample = sample_template(header.frame_id)
        self._templates = publication_templates(header.frame_id, header.child_frame_id)
        self._base_names = {header.topic(topic.name): topic.name for topic in TOPICS}
        self._done: list[PartFacts] = []
        self._bytes_before = 0
        self._counts_before: Counter[str] = Counter()
        self._notes: list[Loss | Dropped] = []
        #: losses that are noted in the files, by topic, or `JOURNAL` for journal entries
        self.noted: Counter[str] = Counter()
        warm_up()
        self._prepare(folder)
        self._number = 0
        self._part = self._open(self._number)

    def _prepare(self, folder: Path) -> None:
        make_folder(folder)

    def _make(self, path: Path) -> ByteFile:
        return UnbufferedFile(path)

    def _open(self, number: int) -> _Part:
        path = self.folder / f"{self.folder.name}_{number}.mcap"
        out = self._make(path)
        try:
            file = McapFile(out, f"plow_twin {self.header.package_version}")
            file.metadata(HEADER_RECORD, {**self.header.to_record(), "part": str(number)})
            if self._sync:
                out.sync()
                sync_path(self.folder, self.folder.parent)
        except OSError:
            out.remove()
            raise
        return _Part(path, file)

    @property
    def bytes_written(self) -> int:
        """Size of all parts that have been written [B]."""
        return self._bytes_before + self._part.file.size

    @property
    def counts(self) -> Counter[str]:
        """Number of messages in the files by topic, with the key `JOURNAL` for all three topics of the journal."""
        header, counts = self.header, Counter(self._counts_before)
        journal = (header.samples_topic, header.digests_topic, header.entries_topic)
        for topic, (number, _, _) in self._part.channels.items():
            counts[JOURNAL if topic in journal else topic] += self._part.file.counts[number]
        return counts

    @property
    def part_bytes(self) -> int:
        """Size of the part that is being written [B]."""
        return self._part.file.size

    def write_entry(self, sequence: int, log_time_ns: int, entry: Entry | Dropped) -> None:
        """Write a journal entry with the sequence number `sequence`."""
        topic = self.header.entries_topic
        if isinstance(entry, Sample | Digest):
            topic = self.header.samples_topic if isinstance(entry, Sample) else self.header.digests_topic
        elif isinstance(entry, Loss | Dropped):
            self._notes.append(entry)
        stamp_ns = getattr(entry, "stamp_ns", log_time_ns)
        self._write(self._journal, topic, sequence, log_time_ns, stamp_ns, to_message(entry, self.header.frame_id))

    def write_samples(
        self, sequence: Indexes, log_time_ns: Indexes, stamp_ns: Indexes, wrench: NDArray[np.float64]
    ) -> None:
        """Write load samples as journal entries."""
        numbers = np.zeros((len(stamp_ns), 6))
        numbers[:, [0, 1, 5]] = wrench
        length = MESSAGE_HEAD + len(self._sample)
        starts = self._journal.reserve(length * len(stamp_ns)) + length * np.arange(len(stamp_ns))
        channel = self._channel(self.header.samples_topic, WrenchStamped.TYPE)
        self._journal.add_many(
            channel, self._sample, starts, sequence & _SEQUENCE_MASK, np.maximum(log_time_ns, 0), stamp_ns, numbers
        )
        self._close_full_chunks()

    def write_series(
        self,
        sequence: int,
        log_time_ns: Indexes,
        stamp_ns: Indexes,
        wrench: NDArray[np.float64],
        digests: Mapping[int, str],
    ) -> Indexes:
        """Write samples and digests as journal entries, and return the sequence number of each sample.

        The first entry has the number `sequence`. The key of a digest is the number of samples before the digest.
        """
        index = np.arange(len(stamp_ns))
        numbers = sequence + index + np.searchsorted(sorted(digests), index, "right")
        begin = 0
        for end in sorted({*digests, len(stamp_ns)}):
            part, begin = slice(begin, end), end
            self.write_samples(numbers[part], log_time_ns[part], stamp_ns[part], wrench[part])
            if end in digests:
                entry = Digest(int(stamp_ns[end - 1]), digests[end])
                self.write_entry(int(numbers[end - 1]) + 1, int(log_time_ns[end - 1]), entry)
        return numbers

    def write_publications(self, sequence: Indexes, log_time_ns: Indexes, published: Published) -> None:
        """Encode and write the messages of publications.

        `sequence`, shape (n,), is the number of the journal entry before each publication.
        """
        log_time_ns = np.maximum(log_time_ns, 0)
        everywhere = np.arange(len(published.rows))
        rows = dict.fromkeys(REPLAYED, everywhere)
        for topic in REPLAYED:
            if topic.cadence is Cadence.SLOW:
                rows[topic] = published.slow["row"]
            elif topic.cadence is Cadence.FOLLOWED:
                rows[topic] = np.flatnonzero(published.rows["followed"] == WITH_INTERVALS)
        sizes = np.zeros(len(everywhere), np.int64)
        places = {}
        for topic, row in rows.items():
            places[topic] = sizes[row].copy()
            sizes[row] += MESSAGE_HEAD + len(self._templates[topic.name])
        ends = np.cumsum(sizes)
        begin = self._outputs.reserve(int(ends[-1])) if len(everywhere) else 0
        for topic, row in rows.items():
            if not len(row):
                continue
            records = topic.record_of(published)
            if topic.cadence is Cadence.FOLLOWED:
                records = records[row]
            template = self._templates[topic.name]
            channel = self._channel(self.header.topic(topic.name), template.message_type)
            starts = begin + (ends - sizes)[row] + places[topic]
            self._outputs.add_many(
                channel, template, starts, sequence[row] & _SEQUENCE_MASK, log_time_ns[row],
                np.ascontiguousarray(records["stamp_ns"]), np.concatenate(topic.numbers(records), axis=1),
            )  # fmt: skip
        self._close_full_chunks()

    def write_sent(
        self, sequence: Indexes, log_time_ns: Indexes, stamp_ns: Indexes, sent: Sequence[Mapping[str, bytes]]
    ) -> None:
        """Write publications that the node has sent.

        `sent` contains the bytes of the messages of each publication, by base name of the topic.
        """
        channels = self._part.sent
        if not channels:
            followed = (Cadence.FOLLOWED,) if self.header.follow == "full" else ()
            for topic in topics_of(Cadence.EACH, Cadence.SLOW, Cadence.MARKED, *followed):
                channels[topic.name] = self._channel(self.header.topic(topic.name), topic.type)
        each = np.fromiter(map(len, sent), np.int64, len(sent))
        data = [message for messages in sent for message in messages.values()]
        self._outputs.add_bytes(
            np.array([channels[name] for messages in sent for name in messages], np.int64),
            np.repeat(sequence & _SEQUENCE_MASK, each),
            np.repeat(np.maximum(log_time_ns, 0), each),
            np.repeat(np.maximum(stamp_ns, 0), each),
            np.fromiter(map(len, data), np.int64, len(data)),
            b"".join(data),
        )
        self._close_full_chunks()

    def write_output(self, topic: str, sequence: int, log_time_ns: int, stamp_ns: int, message: Message) -> None:
        """Write a message that the node sent after the journal entry with the number `sequence`."""
        self._write(self._outputs, topic, sequence, log_time_ns, stamp_ns, message)

    def _write(
        self, chunk: ChunkBuilder, topic: str, sequence: int, log_time_ns: int, stamp_ns: int, message: Message
    ) -> None:
        # times in MCAP are unsigned, so a negative stamp is replaced by 0; the message contains the exact stamp
        log_time_ns, stamp_ns = max(0, log_time_ns), max(0, stamp_ns)
        channel = self._channel(topic, message.TYPE)
        chunk.add(channel, sequence & _SEQUENCE_MASK, log_time_ns, stamp_ns, encode(message))
        self._close_full_chunks()

    def _channel(self, topic: str, message_type: str) -> int:
        channel = self._part.channels.get(topic)
        if channel is None:
            qos = qos_text(self._base_names.get(topic, ""))
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": type_hash(message_type)}
            number = self._part.file.channel(topic, message_type, schema_text(message_type).encode(), metadata)
            channel = self._part.channels[topic] = (number, message_type, qos)
        if channel[1] != message_type:
            raise RecordingError(f"{topic}: got a {message_type}, expected a {channel[1]} as before")
        return channel[0]

    def _close_full_chunks(self) -> None:
        if self._journal.size + self._outputs.size >= self._chunk_size:
            self._close_chunks()

    def _close_chunks(self) -> None:
        notes, self._notes = self._notes, []
        try:
            self._part.file.chunk(self._journal)
            for note in notes:
                self.noted[note.topic if isinstance(note, Dropped) else JOURNAL] += note.count
            self._part.file.chunk(self._outputs)
        except OSError:
            self._outputs.clear()  # a replay cannot compare outputs if the preceding journal entries are missing
            raise

    def flush(self) -> None:
        """Write all data to the file, so that they are not lost if the process is killed."""
        self._close_chunks()
        if self._sync:
            self._part.file.out.sync()

    def reason_to_stop(self) -> str | None:
        """Return the reason why recording must stop, or None."""
        return None if self._part.file.out.is_linked() else "the file was removed or replaced"

    def shortage(self) -> str | None:
        """Return a text if the disk has too little space to complete the file, otherwise None."""
        return shortage(self.folder, self._min_free_bytes)

    def split(self, loss: Mapping[str, int], keep_bytes: int = 0) -> None:
        """Start a new part and complete the old part. The caller must write a snapshot next.

        The new part is opened first, so that the folder always contains a part that is being written. With
        `keep_bytes`, the oldest completed parts are removed until their total size [B] is at most `keep_bytes`.
        """
        self._close_chunks()
        new = self._open(self._number + 1)
        try:
            self._finish(self._part, {topic: str(count) for topic, count in loss.items()})
        except OSError:
            new.file.out.remove()
            raise
        self._counts_before = self.counts
        self._part, self._number = new, self._number + 1
        if keep_bytes:
            self._remove_oldest(keep_bytes)

    def _remove_oldest(self, keep_bytes: int) -> None:
        while self._done:
            sizes = {facts.name: _size(self.folder / facts.name) for facts in self._done}
            if sum(sizes.values()) <= keep_bytes:
                return
            (self.folder / self._done.pop(0).name).unlink(missing_ok=True)

    def _finish(self, part: _Part, record: Mapping[str, str]) -> None:
        with part.file.undone():
            part.file.metadata(LOSS_RECORD, record)
            part.file.finish()
            if self._sync:
                part.file.out.sync()
        part.file.out.close()
        self._bytes_before += part.file.size
        self._done.append(part.facts())

    def close(self, loss: Mapping[str, int], stop_reason: str | None = None) -> None:
        """Complete the file and write `metadata.yaml`, with the loss counters and the reason of an early end."""
        record = {topic: str(count) for topic, count in loss.items()}
        custom: dict[str, str] = {}
        if stop_reason is not None:
            record[STOPPED_EARLY_KEY] = custom[f"plow_twin_{STOPPED_EARLY_KEY}"] = stop_reason
        self._close_chunks()
        self._finish(self._part, record)
        self._bytes_before -= self._part.file.size
        write_metadata(self.folder, bag_metadata(self._done, loss, custom), sync=self._sync)

    def abandon(self) -> None:
        """Close the file after an error, without an index."""
        self._part.file.out.close()


def shortage(folder: Path, min_free_bytes: int) -> str | None:
    """Return a text if the disk of a folder has too little free space, otherwise None."""
    free = shutil.disk_usage(folder).free
    return f"{free} B free on the disk, expected at least {min_free_bytes} B" if free < min_free_bytes else None


def _is_free(folder: Path) -> bool:
    """Return whether a folder can receive a recording. Subfolders with names that begin with `BESIDE` are allowed."""
    if not folder.exists():
        return True
    return folder.is_dir() and all(item.name.startswith(BESIDE) and item.is_dir() for item in folder.iterdir())


def free_folder(folder: Path) -> Path:
    """Return the first of `folder`, `<folder>_2`, `<folder>_3`, ... that can receive a recording."""
    path, number = folder, 1
    while not _is_free(path):
        number += 1
        path = folder.with_name(f"{folder.name}_{number}")
    return path


def in_free_folder(folder: Path, make: Callable[[Path], Made]) -> Made:
    """Call `make` with a free folder. If another process uses the folder first, call `make` with the next folder."""
    while True:
        try:
            return make(free_folder(folder))
        except TakenError:
            continue


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def make_folder(folder: Path) -> None:
    """Create a folder for a recording.

    Raise `TakenError` if the folder is not empty, and `RecordingError` if the folder cannot be created.
    """
    if not _is_free(folder):
        raise TakenError(f"{folder}: exists already, expected a new or empty folder for the recording")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be created: {error.strerror}") from error


def warm_up_writer(header: RunHeader) -> None:
    """Compile the functions that write messages to chunks, so that the first sample is not delayed."""
    templates: dict[str, Any] = {"sample": sample_template(header.frame_id)}
    templates |= publication_templates(header.frame_id, header.child_frame_id)
    zero = np.zeros(1, np.int64)
    for template in templates.values():
        builder = ChunkBuilder("zstd")
        builder.reserve(MESSAGE_HEAD + len(template))
        builder.add_many(1, template, zero, zero, zero, zero, np.zeros((1, template.count)))
        builder.add_bytes(zero, zero, zero, zero, zero, b"0")
