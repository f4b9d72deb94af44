"""Recordings for the tests, made by a twin, a session and a recorder in this process, and modified copies of files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap import records
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from plow_twin.model.scene import Wear
from plow_twin.record.entries import EntryRecord, OutputRecord
from plow_twin.record.header import RunHeader
from plow_twin.record.messages import Message
from plow_twin.record.outputs import publication_messages
from plow_twin.record.reader import RunReader
from plow_twin.record.recorder import LossReport, Recorder
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Entry, Hold, Parameter, Reset, Sample, Travel
from plow_twin.stream.outputs import NOTHING
from plow_twin.stream.session import Session

BASE_NS = 1_800_000_000_000_000_000
STEP_NS = 1_000_000
#: Amplitudes of the paper's loads [N, N, N m].
PAPER_AMPLITUDE = (32_000.0, -11_000.0, -45_495.0)


def paper_sample(index: int, first_ns: int = BASE_NS) -> Sample:
    phase = float(np.sin(2e-3 * index))
    fx, fy, moment = (phase * amplitude for amplitude in PAPER_AMPLITUDE)
    return Sample(first_ns + index * STEP_NS, (fx, fy, moment))


def paper_entries(count: int) -> list[Entry]:
    """Return samples, with one entry of every other kind in between and a reset in the middle."""
    half = count // 2
    entries: list[Entry] = [Parameter("hold", "hold"), *map(paper_sample, range(half))]
    entries.insert(half // 2, Travel(BASE_NS, 2.5))
    last_ns = BASE_NS + (half - 1) * STEP_NS
    entries += [Hold(last_ns + 500_000_000), Reset(last_ns, "asked for"), Parameter("excitation_timeout", 0.25)]
    return entries + [paper_sample(index, BASE_NS + 10**9 + 7) for index in range(count - half)]


def records_of(run: Path | RunReader) -> Iterator[EntryRecord | OutputRecord]:
    """Yield the entries of a run, each followed by the messages that the twin sent after it."""
    for batch in (run if isinstance(run, RunReader) else RunReader(run)).batches():
        reached = np.maximum.accumulate(batch.entries.sequence).tolist()  # entries may be out of order
        entries = [(number, 0, batch.entries.record(index)) for index, number in enumerate(reached)]
        sent = [
            (number, 1, part.record(i)) for part in batch.outputs for i, number in enumerate(part.sequence.tolist())
        ]
        yield from (record for _, _, record in sorted([*entries, *sent], key=lambda item: item[:2]))


@dataclass
class Run:
    folder: Path
    file: Path
    loss: LossReport
    entries: list[Entry] = field(default_factory=list)
    outputs: list[tuple[str, Message]] = field(default_factory=list)


def record_run(
    folder: Path,
    entries: Iterable[Entry],
    *,
    frame_every: int = 1,
    pause_every: int = 100,
    wear: Wear | None = None,
    rollback_span_s: float = 0.0,
    parameters: Mapping[str, Any] | None = None,
    **options: Any,
) -> Run:
    """Pass entries to a twin of the paper's head, and record the twin as the node does."""
    scene = replace(load_scene(scene_path("paper")), wear=wear)
    header = RunHeader(dump_scene(scene), parameters={"hold": "hold", **(parameters or {})})
    recorder = Recorder(folder, header, **options)
    run = Run(folder, recorder.path, LossReport({}, False, None))

    def journal(entry: Entry) -> None:
        run.entries.append(entry)
        recorder.journal(entry)

    session = Session(Twin(scene, excitation="sampled"), on_entry=journal, rollback_span_s=rollback_span_s)
    session.start()
    for index, entry in enumerate(entries):
        session.apply(entry)
        published = session.outputs.pop() if index % frame_every == 0 else NOTHING
        messages = publication_messages(published, header.frame_id, header.child_frame_id)
        run.outputs += [(header.topic(name), message) for name, message in messages.items()]
        if len(published.rows):
            recorder.publication(published)
        if recorder.snapshot_wanted:
            journal(session.snapshot())
        if pause_every and index % pause_every == 0:
            time.sleep(0.02)  # in the pause, the recorder's thread can empty its queue
    session.close()
    run.loss = recorder.close()
    return run


def rewrite(
    source: Path,
    target: Path,
    change: Callable[[str, Any], bytes | None] = lambda topic, message: None,
    metadata: Callable[[dict[str, str]], dict[str, str]] = dict,
    *,
    metadata_last: bool = False,
) -> Path:
    """Copy an MCAP file with third-party tools; `change` may replace the bytes of a message; no bytes omit it."""
    with source.open("rb") as stream, target.open("wb") as out:
        writer = Writer(out, chunk_size=64 * 1024)
        writer.start(profile="ros2", library="test")
        reader = make_reader(stream)
        kept = [(record.name, metadata(dict(record.metadata))) for record in reader.iter_metadata()]
        for name, content in [] if metadata_last else kept:
            writer.add_metadata(name, content)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                number = writer.register_channel(channel.topic, "cdr", schemas[schema.id], channel.metadata)
                channels[channel.id] = number
            data = change(channel.topic, message)
            if data == b"":
                continue
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data if data is None else data,
                message.publish_time,
                message.sequence,
            )
        for name, content in kept if metadata_last else []:
            writer.add_metadata(name, content)
        writer.finish()
    return target


def chunk_spans(file: Path, *, journal: bool | None = None) -> list[tuple[int, int]]:
    """Return offset and length of the data of each chunk of a file: of the journal, of all other chunks, or of both."""
    spans, topics = [], {}
    with file.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            inside = breakup_chunk(record) if isinstance(record, records.Chunk) else [record]
            topics.update({item.id: item.topic for item in inside if isinstance(item, records.Channel)})
            if isinstance(record, records.Chunk):
                topics_found = [topics[item.channel_id] for item in inside if isinstance(item, records.Message)]
                if journal in (None, any("/journal/" in topic for topic in topics_found)):
                    spans.append((stream.tell() - len(record.data), len(record.data)))
    return spans
