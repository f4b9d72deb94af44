"""Examine a recording, and repair truncated and damaged files.

A repair copies every readable message into a new file with an index, and renames the old file. Other messages are
counted as lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.record.bag import beside_folders
from plow_twin.record.cdr import type_hash
from plow_twin.record.chunks import DAMAGE_RECORD, MAGIC, Channel, ChunkReader, Messages, is_mcap
from plow_twin.record.follow import is_claimed
from plow_twin.record.header import LAYOUT_VERSION, LOSS_RECORD
from plow_twin.record.mcap_file import ChunkBuilder, McapFile, UnbufferedFile
from plow_twin.record.messages import MESSAGE_TYPES
from plow_twin.record.metadata_yaml import (
    PartFacts,
    TopicCount,
    bag_metadata,
    listed_parts,
    profiles,
    qos_text,
    recorded_losses,
    write_metadata,
)
from plow_twin.record.reader import FileStatus, RunReader, run_parts
from plow_twin.record.run_time import RunTime
from plow_twin.record.unused import InputCounts
from plow_twin.stream.journal import Digest, Failed, Sample, Snapshot

#: Key under which `metadata.yaml` contains the names of repaired parts. In the file, the prefix `plow_twin_` precedes
#: the key.
REPAIRED_KEY: Final = "repaired"
_HASH: Final = "topic_type_hash"
_QOS: Final = "offered_qos_profiles"


@dataclass
class PartReport:
    """The state of one file of a recording."""

    path: Path
    bytes: int
    finished: bool
    damaged_chunks: int
    messages: dict[str, int]
    #: number of bytes after the end of the MCAP content; many readers of MCAP refuse a file with trailing bytes
    trailing_bytes: int = 0
    #: number of damaged chunks that an earlier repair removed
    left_out: int = 0
    #: whether the file begins with the magic bytes of MCAP
    mcap: bool = True

    @property
    def healthy(self) -> bool:
        """Whether the file is complete and undamaged, without trailing bytes."""
        return self.mcap and self.finished and not self.damaged_chunks and not self.trailing_bytes


@dataclass
class RunReport:
    """The state of a recording: parts, journal entries, losses and problems."""

    path: Path
    status: str = ""
    problems: list[str] = field(default_factory=list)
    layout_version: str = str(LAYOUT_VERSION)
    metadata_yaml: bool = False
    #: time from the first advance to the last [s]
    span_s: float = 0.0
    entries: Counter[str] = field(default_factory=Counter)
    missing_entries: int = 0
    repeated_entries: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    inputs: dict[str, dict[str, int]] = field(default_factory=dict)
    #: number of samples to which the twin could not advance, so that they have no computed forces
    failed_advances: int = 0
    parts: list[PartReport] = field(default_factory=list)

    def facts(self) -> dict[str, Any]:
        """Return the report as a dictionary for JSON."""
        shown = ("bytes", "finished", "damaged_chunks", "messages")
        parts = [{"file": part.path.name} | {key: getattr(part, key) for key in shown} for part in self.parts]
        facts = {"run": str(self.path), "healthy": not self.problems, **vars(self), "parts": parts}
        del facts["path"]
        return facts


def examine(path: Path) -> RunReport:
    """Read a recording from front to back, and return a report of its content and losses.

    Raise `RecordingError` if the path is not a recording of plow_twin, or its journal cannot be decoded.
    """
    reader = RunReader(path)
    report = RunReport(path)
    report.metadata_yaml = (reader.path.parent / "metadata.yaml").is_file()
    report.parts = [_part(part) for part in reader.parts]
    expected: int | None = None if reader.header.part else 0
    run_time = RunTime(reader.header.parameters)
    in_a_row = 0  # number of consecutive entries directly before the expected entry
    inputs = InputCounts(reader.header.excitation_source)
    for batch in reader.batches(outputs=False):
        entries = batch.entries
        inputs.add(entries)
        run_time.add(entries)
        report.failed_advances += sum(entry.advances for entry in entries.rest.values() if isinstance(entry, Failed))
        for index, sequence in enumerate(entries.sequence.tolist()):
            if expected is not None and 0 < expected - sequence <= in_a_row:
                report.repeated_entries += 1
                continue
            if expected is not None and sequence > expected:
                report.missing_entries += sequence - expected
            in_a_row = in_a_row + 1 if sequence == expected else 1
            expected = sequence + 1
            entry = None if entries.sample[index] else entries.others[index]
            report.entries[Sample.__name__ if entry is None else type(entry).__name__] += 1
    report.lost = dict(reader.lost)
    report.inputs = inputs.facts()
    report.span_s = run_time.span_s
    report.status = reader.status.value
    _name_problems(report, reader)
    for folder in beside_folders(reader.path.parent) if path.is_dir() else ():
        for part in run_parts(folder):
            report.problems += [f"{folder.name}/{text}" for text in _part_problems(_part(part))]
        for topic, count in recorded_losses(folder).items():
            report.problems.append(f"{folder.name}: {count} lost on {topic}, as counted by the recorder")
    return report


def _part(path: Path) -> PartReport:
    begins = is_mcap(path)
    if not begins:
        size = path.stat().st_size
        return PartReport(path, size, finished=False, damaged_chunks=0, messages={}, mcap=begins is None)
    reader, by_channel, _ = _read(path)
    counts: Counter[str] = Counter()
    for number, count in by_channel.items():
        channel = reader.channels.get(number)
        counts[channel.topic if channel else "undeclared"] += count
    size = path.stat().st_size
    trailing = size - reader.position - len(MAGIC) if reader.finished else 0
    damaged = reader.damaged - reader.left_out
    return PartReport(path, size, reader.finished, damaged, dict(sorted(counts.items())), trailing, reader.left_out)


def _read(path: Path) -> tuple[ChunkReader, Counter[int], tuple[int, int]]:
    """Read a file; return its reader, the number of messages of each channel, and the first and last log time [ns]."""
    reader, counts, times = ChunkReader(path), Counter[int](), list[int]()
    for messages in reader:
        counts.update(messages.channel.tolist())
        if len(messages):
            times += [int(messages.log_time_ns.min()), int(messages.log_time_ns.max())]
    return reader, counts, (min(times, default=0), max(times, default=0))


def _name_problems(report: RunReport, reader: RunReader) -> None:
    for part in report.parts:
        report.problems += _part_problems(part)
    for file, read in reader.repeated.items():
        report.problems.append(f"{file.name}: repeats {read.name} (part {reader.number(file)}): it is not read")
    for file, keys in reader.foreign.items():
        report.problems.append(f"{file.name}: belongs to another run (its {', '.join(keys)} differ) and is not read")
    problems = _metadata_problems(reader)
    report.problems += problems
    unnamed = reader.missing_parts - sum("is missing: metadata" in problem for problem in problems)
    if unnamed > 0:
        report.problems.append(f"{unnamed} part(s) are missing, as the part numbers show")
    if repeated := report.repeated_entries:
        report.problems.append(f"{repeated} journal entries occur more than once: the first of each is used")
    if report.missing_entries:
        report.problems.append(f"{report.missing_entries} journal entries are missing")
    for topic, count in report.lost.items():
        report.problems.append(f"{count} lost on {topic}, as counted by the recorder")
    if reader.status is FileStatus.STOPPED_EARLY:
        report.problems.append(f"stopped early: {reader.stop_reason}")
    if not report.entries[Snapshot.__name__] and report.entries[Digest.__name__]:
        report.problems.append("no snapshot: nothing can be compared")


def _part_problems(part: PartReport) -> list[str]:
    problems = []
    if not part.mcap:
        problems.append("not an MCAP file: it cannot be read")
    elif not part.finished:
        problems.append("truncated: its end is missing")
    if part.damaged_chunks:
        problems.append(f"{part.damaged_chunks} damaged chunk(s)")
    if part.left_out:
        problems.append(f"{part.left_out} chunk(s) left out by a repair")
    if part.trailing_bytes:
        problems.append(f"{part.trailing_bytes} B after the end of the MCAP content")
    return [f"{part.path.name}: {problem}" for problem in problems]


def _metadata_problems(reader: RunReader) -> list[str]:
    """Return the problems of `metadata.yaml`, from which the tools of rosbag2 read the names of the parts."""
    folder = reader.path.parent
    if not (folder / "metadata.yaml").is_file():
        return ["metadata.yaml is missing"]
    try:
        listed = listed_parts(folder)
    except RecordingError as error:
        return [f"metadata.yaml: {str(error).rpartition(': ')[2]}"]
    part_names = [part.name for part in reader.parts]
    missing = [f"{name} is missing: metadata.yaml names it" for name in listed if not (folder / name).is_file()]
    return missing + [f"{name}: metadata.yaml does not name it" for name in part_names if name not in listed]


def repair(path: Path) -> list[Path]:
    """Rewrite each truncated or damaged part of a recording, and write a new `metadata.yaml` if necessary.

    Old files are renamed:

    - A truncated, damaged or empty part becomes `<name>.damaged` (`<name>.damaged_2`, ...).
    - A part that repeats another part becomes `<name>.repeated`.
    - A part of another run becomes `<name>.foreign`.

    Returns
    -------
    list of Path
        Files that were rewritten or renamed. Recordings in subfolders of the run are included.

    Raises
    ------
    RecordingError, OSError
        The path is not a recording of plow_twin, the recording is still being written, or the disk is full.
    """
    reader = RunReader(path)
    folder = reader.path.parent
    whole = RunReader(folder) if path.is_file() else reader
    besides = beside_folders(folder) if path.is_dir() else ()
    for parts in (reader.parts, whole.parts, *map(run_parts, besides)):
        with parts[-1].open("rb") as stream:
            if is_claimed(stream.fileno()):
                raise RecordingError(f"{parts[-1]}: still being written, expected a recording that has ended")
    rewritten = []
    for files, ending in ((reader.repeated, "repeated"), (reader.foreign, "foreign")):
        for file in files:
            _put_aside(file, ending)
            rewritten.append(file)
    rewritten += _mend(reader.parts, _end(whole.parts))
    if path.is_dir() or reader.parts[0] in whole.parts:
        wrong = _metadata_problems(whole)
        if rewritten or wrong:
            texts = [text for text in wrong if "is missing:" in text]
            _list_parts(folder, whole.parts, [*(part.name for part in rewritten), *texts])
    for beside in besides:
        parts = run_parts(beside)
        mended = _mend(parts, _end(parts))
        if mended:
            _list_parts(beside, parts, [part.name for part in mended])
        rewritten += mended
    return rewritten


def _end(parts: Sequence[Path]) -> Sequence[Path]:
    """Return the last part with messages, and the parts after it.

    If the recorder is killed while it starts a part, the new part has no messages, and the part before has no end.
    """
    empty = 0
    while empty < len(parts) - 1 and not (is_mcap(parts[-1 - empty]) and any(map(len, ChunkReader(parts[-1 - empty])))):
        empty += 1
    return parts[-1 - empty :]


def _mend(parts: Sequence[Path], end: Sequence[Path]) -> list[Path]:
    mended = []
    for part in parts:
        if not is_mcap(part):
            _put_aside(part, "damaged")
        elif not _part(part).healthy:
            _rewrite(part, last=part in end)
        else:
            continue
        mended.append(part)
    return mended


def _put_aside(file: Path, ending: str) -> None:
    target, number = file.with_name(f"{file.name}.{ending}"), 2
    while target.exists():
        target, number = file.with_name(f"{file.name}.{ending}_{number}"), number + 1
    file.replace(target)


def _list_parts(folder: Path, parts: Sequence[Path], repaired: Sequence[str]) -> None:
    facts = [_facts(part) for part in parts if part.exists() and is_mcap(part)]
    custom = {f"plow_twin_{REPAIRED_KEY}": ", ".join(repaired)} if repaired else {}
    if facts:
        write_metadata(folder, bag_metadata(facts, recorded_losses(folder), custom))


def _rewrite(part: Path, *, last: bool) -> None:
    """Replace a file by a new file with the readable messages and a note of damage at each gap.

    A truncated part has a gap at its end, unless only parts without messages follow.
    """
    target = part.with_name(f"{part.name}.partial")
    target.unlink(missing_ok=True)
    loss: dict[str, str] = {}
    file = McapFile(UnbufferedFile(target), "plow_twin doctor")

    def on_metadata(name: str, record: dict[str, str]) -> None:
        if name == LOSS_RECORD:
            loss.update(record)
        elif name != DAMAGE_RECORD:  # `note_damage` writes the earlier notes again
            file.metadata(name, record)

    reader = ChunkReader(part, on_metadata)
    numbers: dict[int, int] = {}
    noted = 0

    def note_damage(count: int) -> None:
        nonlocal noted
        for _ in range(noted, count):
            file.metadata(DAMAGE_RECORD, {"file": part.name})
        noted = count

    try:
        for messages in reader:
            note_damage(reader.damaged)
            _copy(messages, reader, file, numbers)
        note_damage(reader.damaged + (not reader.finished and not last))
        file.metadata(LOSS_RECORD, loss)
        file.finish()
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    finally:
        file.out.close()
    _put_aside(part, "damaged")
    target.replace(part)


def _copy(messages: Messages, reader: ChunkReader, file: McapFile, numbers: dict[int, int]) -> None:
    for number in dict.fromkeys(messages.channel.tolist()):
        channel = reader.channels.get(number)
        if channel is not None and number not in numbers:
            numbers[number] = file.channel(channel.topic, channel.message_type, channel.schema, _description(channel))
    known = messages[np.isin(messages.channel, list(numbers))]
    channels = np.array([numbers[number] for number in known.channel.tolist()], np.int64)
    data = b"".join(map(known.data, range(len(known))))
    builder = ChunkBuilder("zstd")
    builder.add_bytes(channels, known.sequence, known.log_time_ns, known.publish_time_ns, known.length, data)
    file.chunk(builder)


def _description(channel: Channel) -> Mapping[str, str]:
    """Return the metadata of a channel. A missing or damaged QoS, which other readers refuse, is replaced."""
    kind, metadata = channel.message_type, channel.metadata
    if kind not in MESSAGE_TYPES or profiles(metadata.get(_QOS, "")):
        return metadata
    return {**metadata, _QOS: qos_text(channel.topic.rpartition("/")[2]), _HASH: type_hash(kind)}


def _facts(part: Path) -> PartFacts:
    reader, counts, times = _read(part)
    topics = []
    for number, count in sorted(counts.items()):
        channel = reader.channels.get(number)
        if channel is not None and (channel.message_type in MESSAGE_TYPES or _HASH in channel.metadata):
            qos, digest = channel.metadata.get(_QOS, ""), channel.metadata.get(_HASH, "")
            topics.append(TopicCount(channel.topic, channel.message_type, count, qos, digest))
    return PartFacts(part.name, *times, topics)
