"""Read a run from front to back, even if it is truncated or has damaged chunks.

A recording consists of one or more files, which are called *parts*. Journal entries and outputs are in separate chunks,
and the reader merges them by their sequence numbers.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ForeignRecordingError, RecordingError
from plow_twin.record.cdr import decode
from plow_twin.record.chunks import ChunkReader, Messages, is_mcap, metadata_records, read_summary
from plow_twin.record.entries import NO_ENTRIES, Batch, Entries, Outputs, parted_at, unwrap
from plow_twin.record.follow import Tail
from plow_twin.record.header import HEADER_RECORD, JOURNAL, LOSS_RECORD, STOPPED_EARLY_KEY, RunHeader
from plow_twin.record.journal_codec import Dropped, from_message, read_digests
from plow_twin.record.messages import MESSAGE_TYPES, Message, WrenchStamped
from plow_twin.record.metadata_yaml import missing_files
from plow_twin.record.template import Indexes, Template, read_numbers
from plow_twin.stream.journal import Entry, Loss, Sample

#: Largest number of journal entries in memory. If more entries are read, they are yielded, although outputs that belong
#: between them may follow in the file.
_PENDING: Final = 65_536
#: Smallest number of entries in a batch. A batch may be smaller if the outputs of `_LEAST // 16` chunks are in memory.
_LEAST: Final = 8192
#: Smallest number of entries in a batch without outputs, which needs less memory.
_LEAST_ALONE: Final = 32_768
#: Typical growth of a recording at 1 kHz [B/s]. It is used to estimate the duration of a file without an index.
_BYTES_PER_S: Final = 400_000
#: Indexes of Fx, Fy and M in the six numbers of a wrench.
_WRENCH: Final = np.array([0, 1, 5])


class FileStatus(Enum):
    """State of the end of a recording."""

    UNREAD = "not read to its end"
    COMPLETE = "complete"
    STOPPED_EARLY = "stopped early: the recorder closed it before the run ended"
    TRUNCATED = "truncated: the recorder did not close it"
    DAMAGED = "damaged: chunks could not be read"


@dataclass
class RunReader:
    """Reader of the records of a run, in batches.

    `path` is the folder of the run, or one of its `.mcap` files. With `tail`, the reader waits for a run that is still
    being written, reads new parts, and yields an empty batch at each end of the data.

    `parts` are the files that are read, in order; parts that are removed during the iteration are skipped. `repeated`
    maps a file that repeats a part to the file that is read instead. `foreign` maps a file of another run to the keys
    in which its header differs.

    The iteration determines `status`, `damaged_chunks` (a part that is not an MCAP file counts as one), `stop_reason`,
    `counts` (records by topic) and `position` (share of the data that has been read, from 0 to 1). Raise
    `RecordingError` if the file does not exist, or it is not a recording of plow_twin.
    """

    path: Path
    tail: Tail | None = None
    header: RunHeader = field(init=False)
    parts: list[Path] = field(init=False)
    repeated: dict[Path, Path] = field(default_factory=dict, init=False)
    foreign: dict[Path, tuple[str, ...]] = field(default_factory=dict, init=False)
    status: FileStatus = field(default=FileStatus.UNREAD, init=False)
    damaged_chunks: int = field(default=0, init=False)
    stop_reason: str | None = field(default=None, init=False)
    counts: Counter[str] = field(default_factory=Counter, init=False)
    position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._place = Path(self.path)
        self._headers: dict[Path, RunHeader] = {}
        self._counted: Counter[str] = Counter()
        self._noted: dict[int, Loss | Dropped] = {}  # by sequence number, so that a repeated entry is counted once
        self._look_for_parts()
        self.path = self.parts[0]
        for part in self.parts:
            if part in self._headers:
                self.header = self._headers[part]
                return
        if all(map(_has_no_message, self.parts)):
            raise RecordingError(f"{self.path}: truncated before its first message, expected a complete recording")
        raise ForeignRecordingError(f"{self.path}: metadata {HEADER_RECORD!r} is missing: not a recording of plow_twin")

    def _look_for_parts(self) -> None:
        files = run_parts(self._place)
        for file in files:
            if file not in self._headers and (len(files) == 1 or is_mcap(file)):
                try:
                    header = read_header(file)
                except RecordingError:
                    if len(files) > 1 and not file.exists():
                        continue
                    raise
                if header is not None:
                    self._headers[file] = header
        self.parts, self.repeated, self.foreign = [], {}, self._of_other_runs()
        read: dict[int, Path] = {}
        for file in sorted(set(files) - set(self.foreign), key=self._place_of):
            if file not in self._headers or read.setdefault(self._headers[file].part, file) is file:
                self.parts.append(file)
            else:
                self.repeated[file] = read[self._headers[file].part]

    def _of_other_runs(self) -> dict[Path, tuple[str, ...]]:
        """Return the files with a header that differs from the header of most files, and the keys that differ."""
        records = {file: header.to_record() for file, header in self._headers.items()}
        for record in records.values():
            del record["part"]
        whose = Counter(tuple(sorted(record.items())) for record in records.values())
        if len(whose) < 2:
            return {}
        own = dict(whose.most_common(1)[0][0])
        return {
            file: tuple(sorted(key for key in own if own[key] != record.get(key)))
            for file, record in records.items()
            if record != own
        }

    @property
    def missing_parts(self) -> int:
        """Number of missing parts, according to `metadata.yaml` and to the part numbers of the existing files."""
        if not self._place.is_dir():
            return 0
        part_numbers = {self.number(file) for file in self.parts}
        numbers = sorted(self._headers[file].part for file in self.parts if file in self._headers)
        inside = {number for number in part_numbers if numbers[0] <= number <= numbers[-1]}
        between = numbers[-1] - numbers[0] + 1 - len(inside)
        missing = missing_files(self._place, {file.name for file in self.foreign})
        named = {part_number(Path(name))[0] for name in missing} - part_numbers
        return between + sum(number >= 0 and not numbers[0] < number < numbers[-1] for number in named)

    @property
    def lost(self) -> dict[str, int]:
        """Number of lost messages by topic.

        The recorder writes the numbers when it closes the recording. If the recorder was killed, the notes about losses
        in the journal are added up.
        """
        noted: Counter[str] = Counter()
        for entry in self._noted.values():
            noted[entry.topic if isinstance(entry, Dropped) else JOURNAL] += entry.count
        return dict(self._counted | noted)

    @property
    def lost_parts(self) -> dict[str, int]:
        """Numbers of missing parts and of parts of other runs; a number of zero is omitted."""
        # while a run is being written, the recorder may remove its oldest parts
        missing = self.missing_parts if self.tail is None else 0
        found = {"missing_parts": missing, "foreign_parts": len(self.foreign)}
        return {name: count for name, count in found.items() if count}

    def number(self, file: Path) -> int:
        """Return the number of a part from the header of the file or, without a header, from the file name."""
        return self._headers[file].part if file in self._headers else part_number(file)[0]

    def _place_of(self, file: Path) -> tuple[int, bool, str]:
        named = part_number(file)[0]
        number = self.number(file)
        return number, named != number, file.name

    def batches(self, *, outputs: bool = True) -> Iterator[Batch]:
        """Yield the records in order, many at a time. Without `outputs`, only the journal is read."""
        self.status, self.damaged_chunks, self.position, self.stop_reason = FileStatus.UNREAD, 0, 0.0, None
        self.counts.clear()
        self._counted.clear()
        self._noted.clear()
        for batch in self._batches(outputs):
            for index, entry in batch.entries.rest.items():
                if isinstance(entry, Loss | Dropped):
                    self._noted[int(batch.entries.sequence[index])] = entry
            yield batch

    def _batches(self, outputs: bool) -> Iterator[Batch]:
        merger = _Merger(self, outputs)
        size, before = self.size(), 0
        finished, cut = True, 0
        for part in self._parts_to_read():
            begins = is_mcap(part) if len(self.parts) > 1 else True
            if self.tail is None and begins is None:
                finished, cut = False, cut + 1
                continue
            if begins is False:
                self.damaged_chunks += 1
                continue
            reader = ChunkReader(
                part,
                self._metadata,
                None if outputs else merger.is_journal,
                None if self.tail is None else self.tail.more,
            )
            merger.begin(part, reader)
            for messages in reader:
                self.position = min(1.0, (before + reader.position) / max(1, size))
                if len(messages):  # messages may be missing between a truncated part and the next part
                    self.damaged_chunks, cut = self.damaged_chunks + cut, 0
                yield from merger.add(messages)
                if self.tail is not None and not len(messages):
                    yield from merger.finish()
                    yield Batch(NO_ENTRIES, [])
            before += reader.position
            finished, cut = finished and reader.finished, cut + (not reader.finished)
            self.damaged_chunks += reader.damaged
            merger.end()
        yield from merger.finish()
        if self.tail is not None and self.tail.stopped:
            return
        if not finished:
            self.status = FileStatus.TRUNCATED
        elif self.damaged_chunks:
            self.status = FileStatus.DAMAGED
        else:
            self.status = FileStatus.COMPLETE if self.stop_reason is None else FileStatus.STOPPED_EARLY

    def _parts_to_read(self) -> Iterator[Path]:
        """Yield the parts in order. With a tail, parts that the recorder starts during the iteration are included."""
        done: list[Path] = []
        while unread := [part for part in self.parts if part not in done]:
            done.append(unread[0])
            if unread[0].exists():
                yield unread[0]
            elif len(self.parts) > 1:  # the recorder has removed this part
                self.parts.remove(unread[0])
            if self.tail is not None and not self.tail.stopped:
                self._look_for_parts()

    def size(self) -> int:
        """Return the total size of the parts [B]."""
        count = 0
        for part in self.parts:
            with suppress(FileNotFoundError):
                count += part.stat().st_size
        return count

    def duration_s(self) -> float:
        """Return the time from the first to the last record [s].

        If a part has no index, the time is estimated from the size of the files.
        """
        first_ns, last_ns, has_messages = self._received_ns()
        return float(last_ns - first_ns) * 1e-9 if has_messages else self.size() / _BYTES_PER_S

    def began_ns(self) -> int | None:
        """Return the first receive time [ns], or None if a part has no index."""
        first_ns, _, has_messages = self._received_ns()
        return first_ns if has_messages else None

    def _received_ns(self) -> tuple[int, int, bool]:
        first, last = [], []
        for part in self.parts:
            summary = read_summary(part)
            if summary is not None and summary.statistics is not None and summary.statistics.message_count:
                first.append(summary.statistics.message_start_time)
                last.append(summary.statistics.message_end_time)
        return min(first, default=0), max(last, default=0), bool(first) and len(first) == len(self.parts)

    def _metadata(self, name: str, record: dict[str, str]) -> None:
        if name != LOSS_RECORD:
            return
        self.stop_reason = record.pop(STOPPED_EARLY_KEY, self.stop_reason)
        try:
            counted = Counter({topic: int(count) for topic, count in record.items()})
        except ValueError as error:
            raise RecordingError(f"{self.path}: metadata {LOSS_RECORD!r}: {error}, expected counts") from error
        self._counted = counted  # each part contains the counts from the beginning of the run


class _Merger:
    """Merge journal entries and outputs by their sequence numbers."""

    def __init__(self, reader: RunReader, outputs: bool) -> None:
        self._run = reader
        self._with_outputs = outputs
        self._least = _LEAST if outputs else _LEAST_ALONE
        header = reader.header
        self._journal = (header.samples_topic, header.digests_topic, header.entries_topic)
        self._template = sample_template(header.frame_id)
        self._places = self._template.places[_WRENCH]
        self._entries = [NO_ENTRIES]
        self._count = 0
        self._outputs: list[Outputs] = []
        self._base = 0
        self._part = reader.path
        self._chunks: ChunkReader | None = None
        self._topics: dict[int, tuple[str, str]] = {}
        self._damaged = 0

    def begin(self, part: Path, chunks: ChunkReader) -> None:
        self._part, self._chunks = part, chunks
        self._topics = {}

    def end(self) -> None:
        self._chunks = None

    def is_journal(self, numbers: set[int]) -> bool:
        """Return whether one of the channels `numbers` belongs to the journal."""
        assert self._chunks is not None
        return any(self._chunks.channels[number].topic in self._journal for number in numbers)

    def add(self, messages: Messages) -> Iterator[Batch]:
        """Add the messages of a chunk, and yield the batches that are complete."""
        assert self._chunks is not None
        counts = np.bincount(messages.channel)
        present = counts.nonzero()[0]
        journal, sent, samples, digests = [], [], -1, -1
        for number, count in zip(present.tolist(), counts[present].tolist(), strict=True):
            channel = self._chunks.channels.get(number)
            if channel is None:
                continue
            self._run.counts[channel.topic] += count
            if channel.topic in self._journal:
                journal.append(number)
                samples = number if channel.topic == self._journal[0] else samples
                digests = number if channel.topic == self._journal[1] else digests
            elif channel.message_type in MESSAGE_TYPES:
                sent.append(number)
                named = channel.topic, channel.message_type
                if self._topics.get(number) != named:  # a new dictionary, because earlier outputs refer to the old one
                    self._topics = {**self._topics, number: named}
        if journal:
            chosen = messages if len(journal) == len(present) else _of(messages, journal)
            self._entries.append(self._read(chosen, samples, digests))
            self._count += len(chosen)
        if sent and self._with_outputs:
            chosen = messages if len(sent) == len(present) else _of(messages, sent)
            self._outputs.append(Outputs(chosen, self._unwrap(chosen.sequence), self._topics))
        if self._count < self._least and len(self._outputs) < _LEAST // 16:
            return
        newest = max((part.newest for part in self._outputs), default=-1)
        if not self._with_outputs or self._count > _PENDING:
            newest = self._newest(newest) + 1
        yield from self._read_to(newest)

    def finish(self) -> Iterator[Batch]:
        newest = max((part.newest for part in self._outputs), default=-1)
        yield from self._read_to(self._newest(newest) + 1)

    def _newest(self, least: int) -> int:
        return max(int(part.sequence.max(initial=least)) for part in self._entries)

    def _unwrap(self, sequence: Indexes) -> Indexes:
        unwrapped = np.empty(len(sequence), np.int64)
        unwrap(sequence, self._base, unwrapped)
        return unwrapped

    def _read_to(self, end: int) -> Iterator[Batch]:
        """Yield the records in memory that have sequence numbers below `end`."""
        waiting = Entries.joined(self._entries)
        later = np.flatnonzero(waiting.sequence >= end)
        count = int(later[0]) if later.size else len(waiting)
        entries, self._entries = waiting[:count], [waiting[count:]]
        self._count = len(waiting) - count
        outputs, self._outputs = parted_at(self._outputs, end)
        if len(entries) or outputs:
            damaged = self._run.damaged_chunks + (self._chunks.damaged if self._chunks is not None else 0)
            yield Batch(entries, outputs, damaged > self._damaged)
            self._damaged = damaged

    def _read(self, messages: Messages, samples: int, digests: int) -> Entries:
        sequence = self._unwrap(messages.sequence)
        if len(sequence):
            self._base = int(sequence[-1])
        count, template = len(messages), self._template
        stamps, wrench, good = np.zeros(count, np.int64), np.zeros((count, 3)), np.zeros(count, bool)
        places = messages.buffer, messages.start, messages.length
        read_numbers(*places, template.data, template.fixed, self._places, stamps, wrench, good)
        good &= messages.channel == samples
        if not np.isfinite(wrench).all():
            good &= np.isfinite(wrench).all(axis=1)
        digest_at = np.flatnonzero(messages.channel == digests)
        found, digest_stamps, digest = read_digests(
            messages.buffer, messages.start[digest_at], messages.length[digest_at]
        )
        digest_at = digest_at[found]
        stamps[digest_at] = digest_stamps
        read = good.copy()
        read[digest_at] = True
        rest: dict[int, Entry | Dropped] = {}
        for index in np.flatnonzero(~read).tolist():
            assert self._chunks is not None
            channel = self._chunks.channels[int(messages.channel[index])]
            place = f"{self._part}: {channel.topic} number {int(messages.sequence[index])}"
            entry = from_message(decode(messages.data(index), channel.message_type), place)
            if isinstance(entry, Sample):
                stamps[index], wrench[index], good[index] = entry.stamp_ns, entry.wrench, True
            else:
                rest[index] = entry
        return Entries(sequence, messages.log_time_ns, good, stamps, wrench, digest_at, digest, rest)


def _of(messages: Messages, channels: list[int]) -> Messages:
    selected = np.zeros(int(messages.channel.max(initial=0)) + 1, bool)
    selected[channels] = True
    chosen = selected[messages.channel]
    return messages if chosen.all() else messages[np.flatnonzero(chosen)]


def sample_template(frame_id: str) -> Template:
    """Return the template of load samples in the journal. Its six numbers are the force and the torque."""

    def build(values: NDArray[np.float64]) -> Message:
        fx, fy, fz, mx, my, mz = values.tolist()
        return WrenchStamped(0, frame_id, (fx, fy, fz), (mx, my, mz))

    return Template.of(build, 6)


def read_header(path: Path) -> RunHeader | None:
    """Return the header of a recording of plow_twin, or None for a recording of another program.

    Raise `RecordingError` if the file is not an MCAP file, or its header is invalid.
    """
    headers: list[RunHeader] = []

    def on_metadata(name: str, record: dict[str, str]) -> None:
        if name == HEADER_RECORD:
            headers.append(RunHeader.from_record(record, str(path)))

    for _ in ChunkReader(path, on_metadata):
        break
    if not headers:  # programs that rewrite MCAP files move metadata records to the end
        for name, record in metadata_records(path):
            on_metadata(name, record)
    return headers[0] if headers else None


def _has_no_message(path: Path) -> bool:
    """Return whether a file ends before its first message and has no end mark."""
    begins = is_mcap(path)
    if not begins:
        return begins is None
    reader = ChunkReader(path)
    return not any(map(len, reader)) and not reader.finished


def run_parts(path: Path) -> list[Path]:
    """Return the MCAP files of a recording in order; `path` is the folder, or a single file.

    Raise `RecordingError` if no file exists.
    """
    if path.is_dir():
        files = sorted(path.glob("*.mcap"), key=part_number)
        if not files:
            raise RecordingError(f"{path}: got no .mcap file, expected a recording{packed(path)}")
        return files
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording, expected an .mcap file or its folder")
    return [path]


def packed(path: Path) -> str:
    """Return a hint if a file cannot be read because rosbag2 has compressed it as a whole, or an empty string."""
    files = sorted(path.glob("*.zstd")) if path.is_dir() else [path] if path.suffix == ".zstd" else []
    return f" ({files[0].name} is compressed as a whole: unpack it with zstd -d)" if files else ""


def mcap_path(path: Path) -> Path:
    """Return the first MCAP file of a recording; `path` is the folder, or a single file."""
    return run_parts(path)[0]


def part_number(path: Path) -> tuple[int, str]:
    """Return the sort key of a file: the number at the end of its name, or -1 without a number, and the name."""
    digits = re.search(r"(\d+)$", path.stem)
    return (int(digits[1]) if digits else -1, path.name)


def own_run(path: Path, tail: Tail | None = None) -> RunReader | None:
    """Return a reader of a run, or None for a recording of another program."""
    if path.is_dir() and not any(path.glob("*.mcap")):
        return None
    try:
        return RunReader(path, tail)
    except ForeignRecordingError:
        return None
