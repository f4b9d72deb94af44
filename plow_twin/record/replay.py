"""Replay a recording.

A replay advances the model by the entries of the journal, and compares the messages that it computes with the recorded
messages.

Terms of this module:

- The replay is *synced* while its state must equal the state of the live session. After a missing journal entry, the
  replay is not synced until the next snapshot, from which it restores the state. A synced replay compares its state
  with the state in a snapshot.
- A *cumulative* message contains a quantity of the time since the previous message, for example the peak.
- The *output window* is the motion since the previous publication. Cumulative messages can be compared only if the
  replay has computed the whole output window.
- A *run* of entries is a series of samples and digests without a missing entry. A run is applied in one call.
- The *sink* is a new recording, which a replay writes on request.
"""

from __future__ import annotations

import hashlib
import struct
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin.build import build_fingerprint
from plow_twin.errors import RecordingError
from plow_twin.model.scene import Scene
from plow_twin.record.alarms import ALARMS, AlarmCheck
from plow_twin.record.cdr import encode
from plow_twin.record.chunks import Messages, scan
from plow_twin.record.comparing import Sent, SentMessages
from plow_twin.record.entries import Batch, Entries, EntryRecord, OutputRecord, first_difference
from plow_twin.record.header import RunHeader
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import Message
from plow_twin.record.outputs import (
    FOLLOWED_TOPICS,
    PUBLICATION_TOPICS,
    publication_messages,
    publication_templates,
)
from plow_twin.record.reader import FileStatus, RunReader, sample_template
from plow_twin.record.replay_report import Divergence, ReplayReport
from plow_twin.record.template import Indexes, Templates, read_numbers
from plow_twin.record.unused import InputCounts
from plow_twin.run.twin import Twin
from plow_twin.solve.state import ROW
from plow_twin.stream import journal
from plow_twin.stream.driven import MOST_STEPS, Driven
from plow_twin.stream.outputs import NONE, NOTHING, Published
from plow_twin.stream.session import Applied, Session
from plow_twin.stream.topics import TOPICS

if TYPE_CHECKING:
    from plow_twin.record.writer import RunWriter

#: Base names of the topics with cumulative messages.
_CUMULATIVE: Final = frozenset(topic.name for topic in TOPICS if topic.cumulative)
_IS_CUMULATIVE: Final = np.array([name in _CUMULATIVE for name in PUBLICATION_TOPICS])
_SEQUENCE_MASK: Final = 0xFFFFFFFF


def replay(
    path: Path,
    on_progress: Callable[[float], object] = lambda share: None,
    *,
    digests_only: bool = False,
    write: Path | None = None,
) -> ReplayReport:
    """Replay a recording, and compare each digest and each message that can be computed from the journal.

    Values are equal only if all their bits are equal.

    Parameters
    ----------
    path
        Folder of the recording, or one of its `.mcap` files.
    on_progress
        Function that receives the share of the recording that has been replayed, from 0 to 1.
    digests_only
        Compare only the digests, which are hashes of the state, and skip chunks without journal entries.
    write
        Folder of a new recording, which contains the journal and all outputs after each advance. If a folder is given,
        only digests are compared.

    Raises
    ------
    RecordingError
        The file is not a recording of plow_twin, or its scene or journal is invalid.
    """
    reader = RunReader(Path(path))
    run = _Replay(reader.header, ReplayReport(reader.path), digests_only or write is not None)
    if write is not None:
        from plow_twin.record.writer import RunWriter

        full = replace(reader.header, record_outputs="all", part=0, build=build_fingerprint())
        run.sink = RunWriter(write, full, chunk_size=2**20, min_free_bytes=0)
    begin = time.perf_counter()
    try:
        for batch in reader.batches(outputs=not digests_only):
            run.batch(batch)
            on_progress(reader.position)
        on_progress(1.0)
        if run.sink is not None:
            run.sink.close(reader.lost, reader.stop_reason)
    except BaseException:
        if run.sink is not None:
            run.sink.abandon()
        raise
    return run.finish(reader, time.perf_counter() - begin)


def following_twin(header: RunHeader, scene: Scene) -> Driven:
    """Return a twin that follows measurements with the settings in the header of a run."""
    from plow_twin.estimate.follow import MEMBERS, follower

    return follower(scene, header.follow, int(header.parameters.get("follow_members", MEMBERS)), header.tol)


class _Replay:
    def __init__(self, header: RunHeader, report: ReplayReport, digests_only: bool) -> None:
        self.digests_only = digests_only
        self.all_outputs = not digests_only and header.record_outputs == "all"
        self.header = header
        self.report = report
        present = build_fingerprint()
        report.build_differences = {
            key: (recorded, present.get(key, ""))
            for key, recorded in header.build.items()
            if recorded != present.get(key, "")
        }
        scene = header.scene(report.path)
        excitation: Any = "scene" if header.excitation_source == "scene" else "sampled"
        self.follows = header.follow != "off"
        bound = int(header.parameters.get("max_evaluations") or 0) or None
        twin: Driven = (
            following_twin(header, scene)
            if self.follows
            else Twin(scene, tol=header.tol, excitation=excitation, max_evaluations=bound, max_steps=MOST_STEPS)
        )
        twin.warm_up()
        templates = publication_templates(header.frame_id, header.child_frame_id)
        self.templates = Templates.of(templates[name] for name in PUBLICATION_TOPICS)
        if excitation == "sampled":
            _warm_up(scene, header.tol, self.templates, rows=not digests_only)
        self.sink: RunWriter | None = None
        self.rows = np.zeros(0, ROW)
        # publications of the last run of entries; the recording may continue with messages of the last publication
        self.published: Published | None = None
        self.session = Session(
            twin, header.origin_ns, rollback_span_s=float(header.parameters.get("rollback_span", 0.0))
        )
        absent = FOLLOWED_TOPICS if header.follow != "full" else ()
        self.topics = {header.topic(name): name for name in PUBLICATION_TOPICS if name not in absent}
        self.next_sequence = 0
        self.newest_output = 0
        self.in_a_row = 0
        self.synced = False
        self.outputs_synced = False  # whether the replay has computed the whole output window
        self.outputs_whole = True  # whether the current batch contains a note about each missing message
        self.resumed = False  # whether the session has restored a snapshot and has not advanced since
        self.messages: Mapping[str, Message] | None = None
        self.first_ns: int | None = None
        self.gaps = 0
        self.lost_entries = 0  # number of lost entries according to the notes in the journal
        self.inputs = InputCounts(header.excitation_source)
        self.alarms = AlarmCheck(header, self.all_outputs)

    def batch(self, batch: Batch) -> None:
        """Apply and compare a batch. Each run is applied in one call."""
        self.outputs_whole = not batch.damaged
        self.outputs_synced = self.outputs_synced and self.outputs_whole
        if batch.damaged:
            self.alarms.give_up()
        entries = batch.entries
        self.newest_output = max([self.newest_output, *(part.newest for part in batch.outputs)])
        sent = SentMessages.of(batch.outputs, self.topics)
        ends, count = self._run_ends(entries), len(entries)
        place = begin = 0
        while place < count:
            end = int(ends[np.searchsorted(ends, place, side="right")])
            stop = sent.before(int(entries.sequence[place]))
            self._messages(sent, begin, stop)
            begin, stop = stop, sent.before(int(entries.sequence[end - 1]) + 1)
            if self._is_run(entries, place) and self._run(entries[place:end], sent, begin, stop):
                place, begin = end, stop
                continue
            for place in range(place, end):  # noqa: B020
                stop = sent.before(int(entries.sequence[place]))
                self._messages(sent, begin, stop)
                self.entry(entries.record(place))
                begin = stop
            place = end
        self._messages(sent, begin, len(sent))
        if not self.digests_only:
            self._compare_alarms(batch)

    def _run_ends(self, entries: Entries) -> Indexes:
        """Return the indexes at which runs end, in ascending order, up to the number of entries.

        A run ends at a missing entry, and before and after each entry that must be applied in a call of its own: a late
        sample, an entry that changes the motion, or a digest without a preceding sample in the run.
        """
        count = len(entries)
        breaks = np.ones(count, bool)
        breaks[1:] = np.diff(entries.sequence) != 1
        digests = entries.digest_at
        behind = digests > 0
        behind[behind] = ~entries.sample[digests[behind] - 1]
        kinds = (
            journal.Gaps | journal.Unused
            if self.follows
            else journal.Pose | journal.PartOfPose | journal.Gaps | journal.Unused
        )
        for index in sorted({*entries.rest, *digests[behind | breaks[digests]].tolist()}):
            goes_on = not breaks[index] and (index == 0 or entries.sample[index - 1] or not breaks[index - 1])
            still = index not in entries.rest or isinstance(entries.rest[index], kinds)
            if not (goes_on and still):
                breaks[index : index + 2] = True
        samples = np.flatnonzero(entries.sample)
        late = samples[1:][np.diff(entries.stamp_ns[samples]) < 0]
        breaks[late] = True
        breaks[late[late + 1 < count] + 1] = True
        return np.append(np.flatnonzero(breaks), count)

    def _is_run(self, entries: Entries, place: int) -> bool:
        expected = (int(entries.sequence[place]) - self.next_sequence) & _SEQUENCE_MASK == 0
        sampled = self.session.twin.excitation == "sampled"
        return self.synced and expected and bool(entries.sample[place]) and sampled

    def _compare_alarms(self, batch: Batch) -> None:
        topic = self.header.topic(ALARMS)
        recorded = []
        for part in batch.outputs:
            channels = [channel for channel, (name, _) in part.topics.items() if name == topic]
            places = np.flatnonzero(np.isin(part.messages.channel, channels)).tolist() if channels else []
            recorded += [(int(part.sequence[place]), part.record(place)) for place in places]
        for _, record in sorted(recorded, key=lambda found: found[0]):
            self.alarms.recorded(record)
        for difference in self.alarms.differences():
            self._note(Divergence(*difference))

    def _messages(self, sent: SentMessages, begin: int, end: int) -> None:
        # a sink gets copies of the messages that a replay cannot compute; without a sink, the others are compared
        chosen = (sent.kind[begin:end] >= 0) == (self.sink is None)
        for index in (begin + np.flatnonzero(chosen)).tolist():
            self.output(sent.record(index))

    def _run(self, entries: Entries, sent: SentMessages, begin: int, end: int) -> bool:
        """Apply a run and compare its messages.

        If the session refuses a sample, no entry is applied and the method returns False.
        """
        done: Indexes = np.cumsum(entries.sample, dtype=np.int64)
        digests = entries.digest_at
        stamps, wrench = entries.samples()
        self.messages, self.published = None, None
        sent_here, rows, taken = None, None, NONE
        if self.sink is not None:
            taken = np.arange(len(stamps))
        elif not self.digests_only:
            sent_here = Sent(
                sent.sequence[begin:end], sent.kind[begin:end], done, int(entries.sequence[0]), len(stamps)
            )
            taken = sent_here.taken
        if self.sink is not None or sent_here is not None:
            if len(self.rows) < len(stamps):
                self.rows = np.zeros(len(stamps), ROW)
            rows = self.rows[: len(stamps)]
        try:
            applied = self.session.advance(stamps, wrench, rows, taken, done[digests])
        except ValueError:  # the caller applies the entries singly
            return False
        self.inputs.add(entries)
        self.report.entries += len(entries)
        self.report.samples += len(stamps)
        self.report.steps += len(stamps)
        self.resumed = False
        self.first_ns = int(stamps[0]) if self.first_ns is None else self.first_ns
        first_step = self.report.steps - len(stamps)
        computed = np.frombuffer(bytes.fromhex("".join(applied.digests)), ">u8")
        differences = [
            (
                first_step + int(done[index]) - 1, int(entries.stamp_ns[index]), "digest", "digest",
                f"{entries.digest[number]:016x}", applied.digests[number],
            )
            for number in np.flatnonzero(computed != entries.digest).tolist()
            for index in (digests[number],)
        ]  # fmt: skip
        self.report.digests_compared += len(digests)
        self.next_sequence = (int(entries.sequence[-1]) + 1) & _SEQUENCE_MASK
        self.in_a_row += len(entries)
        if self.sink is not None:
            self._write_run(entries, applied)
            self._messages(sent, begin, end)
        elif sent_here is not None:
            self.published = applied.published if len(taken) and taken[-1] == len(stamps) - 1 else None
            differences += self._compare_sent(
                entries, sent, (begin, end), sent_here, applied.published, done, first_step
            )
        for difference in sorted(differences, key=lambda found: found[0]):
            self._note(Divergence(*difference))
        return True

    def _write_run(self, entries: Entries, applied: Applied) -> None:
        assert self.sink is not None
        begin = 0
        for end in (*sorted(entries.others), len(entries)):
            part = slice(begin, end)
            if end > begin:
                self.sink.write_samples(
                    entries.sequence[part], entries.log_time_ns[part], entries.stamp_ns[part], entries.wrench[part]
                )
            if end < len(entries):
                record = entries.record(end)
                self.sink.write_entry(record.sequence, record.log_time_ns, record.entry)
            begin = end + 1
        samples, published = np.flatnonzero(entries.sample), applied.published
        if applied.failed:
            good = np.flatnonzero(applied.rows["stamp_ns"])
            samples, published = samples[good], published.of(good)
        self.sink.write_publications(entries.sequence[samples], entries.log_time_ns[samples], published)

    def _write_entry(self, record: EntryRecord) -> None:
        """Write an entry that has been applied, and the publication that follows it, to the sink."""
        assert self.sink is not None
        entry = record.entry
        if isinstance(entry, journal.Snapshot) and self.synced:
            # the sink contains more publications than the recording, so the recorded snapshot does not fit
            entry = self.session.snapshot()
        self.sink.write_entry(record.sequence, record.log_time_ns, entry)
        published = (
            self.session.outputs.pop()
            if self.synced and isinstance(entry, journal.Sample | journal.Hold | journal.Unload)
            else NOTHING
        )
        if len(published.rows) and published.finite:
            self.sink.write_publications(np.array([record.sequence]), np.array([record.log_time_ns]), published)

    def _compare_sent(
        self,
        entries: Entries,
        sent: SentMessages,
        span: tuple[int, int],
        computed: Sent,
        published: Published,
        done: Indexes,
        first_step: int,
    ) -> list[tuple[int, int, str, str, str, str]]:
        poses = [
            (int(entries.sequence[index]) & _SEQUENCE_MASK, first_step + int(done[index]) - 1, entry)
            for index, entry in sorted(entries.rest.items())
            if isinstance(entry, journal.Pose)
        ]
        self.alarms.published(computed.first_sequence & _SEQUENCE_MASK, first_step + computed.taken, published, poses)
        compared = self.outputs_synced | ~_IS_CUMULATIVE
        for name, count, comparable in zip(
            PUBLICATION_TOPICS, computed.counts.tolist(), compared.tolist(), strict=True
        ):
            if count or name not in FOLLOWED_TOPICS:
                (self.report.compared if comparable else self.report.not_compared)[name] += count
        computed.expect(published, self.templates, compared)
        differences, begin = [], span[0]
        for messages, from_, to in sent.pieces(*span):
            chosen = slice(from_ - begin, to - begin)
            for index in computed.differing(messages, chosen):
                record, advance = sent.record(from_ + index), int(computed.after[from_ - begin + index])
                where = self._difference(record, published.at(int(computed.publication[advance])))
                if where is not None:
                    topic = self.topics[record.topic]
                    differences.append((first_step + advance, record.publish_time_ns, topic, *where))
        return differences

    def _difference(self, record: OutputRecord, published: Published) -> tuple[str, str, str] | None:
        name = self.topics[record.topic]
        computed = publication_messages(published, self.header.frame_id, self.header.child_frame_id).get(name)
        if computed is None:
            return "message", "a message", "none"
        return None if encode(computed) == record.data else first_difference(record, computed)

    def entry(self, record: EntryRecord) -> None:
        if not self.report.entries and self.header.part:
            self.next_sequence = record.sequence  # the recording has no earlier part
            self.alarms.give_up()
        missing = (record.sequence - self.next_sequence) & _SEQUENCE_MASK
        if 0 < (-missing & _SEQUENCE_MASK) <= self.in_a_row:
            self.report.repeated += 1
            return
        self.inputs.add_entry(record.entry)
        if missing:
            self.in_a_row = 0
            self.gaps += missing
            self.alarms.give_up()
            self.synced = self.outputs_synced = False
        elif record.sequence == 0 and not isinstance(record.entry, journal.Snapshot):
            # the recording is complete from its first entry, so the state is the initial state of the scene
            self.synced, self.outputs_synced = True, self.all_outputs and self.outputs_whole
        self.next_sequence = (record.sequence + 1) & _SEQUENCE_MASK
        self.in_a_row += 1
        if not isinstance(record.entry, Dropped):  # a note of a loss may lie between the messages of a publication
            self.messages = self.published = None
        self.report.entries += 1
        match record.entry:
            case journal.Loss(count):
                self.lost_entries += count
                self.alarms.give_up()
                self.synced = self.outputs_synced = False
            case Dropped():
                self.alarms.give_up()
                self.outputs_synced = False
            case journal.Snapshot() as snapshot:
                self._snapshot(snapshot)
            case journal.Digest(stamp_ns, digest):
                if self.synced:
                    self.report.digests_compared += 1
                    self._compare("digest", stamp_ns, "digest", digest, self.session.twin.digest())
            case entry:
                if self.synced:
                    self._apply(entry, record.sequence)
        if self.sink is not None:
            self._write_entry(record)

    def _apply(self, entry: Any, sequence: int) -> None:
        if isinstance(entry, journal.Pose):
            self.alarms.pose(sequence, self.report.steps - 1, entry)
        elif isinstance(entry, journal.Parameter):
            self.alarms.parameter(sequence, self.report.steps - 1, entry)
        self.report.samples += isinstance(entry, journal.Sample)
        if isinstance(entry, journal.Sample | journal.Hold | journal.Unload):
            self.report.steps += 1
            self.resumed = False
            self.first_ns = entry.stamp_ns if self.first_ns is None else self.first_ns
        try:
            self.session.apply(entry)
        except ValueError:
            # if the live session accepted this entry, the next comparison shows a difference
            self.report.refused += 1

    def _snapshot(self, snapshot: journal.Snapshot) -> None:
        if self.synced and (self.outputs_synced or self.sink is not None):
            # `renew` discards the earlier states, as the live session did, so that late samples have the same effect
            computed = self.session.renew().data
            if self.sink is None:
                self.report.snapshots_compared += 1
                self._compare("snapshot", snapshot.stamp_ns, "state", _hash(snapshot.data), _hash(computed))
            return
        # the live session inserted the late samples that waited before it made the snapshot
        self.session.insert_waiting()
        before = self.session.twin.digest() if self.synced else None
        try:
            self.session.apply(snapshot)
        except (ValueError, struct.error) as error:
            raise RecordingError(f"{self.report.path}: snapshot at {snapshot.stamp_ns} ns: {error}") from error
        # messages were lost, but no entry was lost, so that only the motion can be compared
        if before is not None:
            self._compare("snapshot", snapshot.stamp_ns, "state", self.session.twin.digest(), before)
        self.synced = self.resumed = True
        self.outputs_synced = self.all_outputs and self.outputs_whole

    def output(self, record: OutputRecord) -> None:
        """Compare a recorded message with the message that the replay computes after the same journal entry.

        If there is a sink, copy the message to the sink, and compare nothing.
        """
        if self.sink is not None:
            place = (record.topic, record.sequence, record.log_time_ns, record.publish_time_ns)
            self.sink.write_output(*place, record.message())
            return
        name = self.topics[record.topic]
        expected_sequence = (self.next_sequence - 1) & _SEQUENCE_MASK
        if not self.synced or record.sequence != expected_sequence or (name in _CUMULATIVE and not self.outputs_synced):
            self.report.not_compared[name] += 1
            return
        if self.messages is None:
            if self.published is not None:
                published = self.published.at(len(self.published.rows) - 1)
            else:
                published = self.session.outputs.pop()
                if len(published.rows):
                    self.alarms.published(np.array([expected_sequence]), np.array([self.report.steps - 1]), published)
            self.published = None
            self.messages = publication_messages(published, self.header.frame_id, self.header.child_frame_id)
        computed = self.messages.get(name)
        if computed is None and self.resumed:
            self.report.not_compared[name] += 1
            return
        self.report.compared[name] += 1
        if computed is None:
            self._diverged(name, record.publish_time_ns, "message", "a message", "none")
        elif encode(computed) != record.data:
            self._diverged(name, record.publish_time_ns, *first_difference(record, computed))

    def _compare(self, topic: str, stamp_ns: int, name: str, recorded: str, computed: str) -> None:
        if recorded != computed:
            self._diverged(topic, stamp_ns, name, recorded, computed)

    def _diverged(self, topic: str, stamp_ns: int, name: str, recorded: str, computed: str) -> None:
        self._note(Divergence(self.report.steps - 1, stamp_ns, topic, name, recorded, computed))

    def _note(self, divergence: Divergence) -> None:
        self.report.divergences += 1
        if self.report.first_divergence is None:
            self.report.first_divergence = divergence

    def finish(self, reader: RunReader, wall_s: float) -> ReplayReport:
        report = self.report
        report.status, report.damaged_chunks, report.wall_s = reader.status, reader.damaged_chunks, wall_s
        if report.status is FileStatus.COMPLETE:
            for difference in self.alarms.left_over(report.steps - 1, self.newest_output):
                self._note(Divergence(*difference))
        report.compared += Counter({ALARMS: self.alarms.compared})
        report.not_compared += Counter({ALARMS: self.alarms.not_compared})
        report.repeated_parts = {file.name: read.name for file, read in reader.repeated.items()}
        report.foreign_parts = {file.name: list(keys) for file, keys in reader.foreign.items()}
        report.stop_reason, report.inputs = reader.stop_reason, self.inputs.facts()
        report.lost = {**reader.lost, **reader.lost_parts}
        if self.gaps > self.lost_entries:
            report.lost["journal, unaccounted"] = self.gaps - self.lost_entries
        if self.first_ns is not None and self.session.stamp_ns is not None:
            report.span_s = (self.session.stamp_ns - self.first_ns) * 1e-9
        return report


def _warm_up(scene: Scene, tol: float, templates: Templates, *, rows: bool) -> None:
    """Compile the kernels of a replay, so that the measured time of the replay does not contain the compilation."""
    session = Session(Twin(scene, tol=tol, excitation="sampled"))
    stamps = np.arange(1, 3, dtype=np.int64) * 1000
    memory = np.zeros(2, ROW) if rows else None
    done = session.advance(stamps, np.zeros((2, 3)), memory, np.arange(2) if rows else NONE, np.array([1]))
    scan(np.zeros(8, np.uint8), np.empty((6, 2), np.int64), np.empty(2, np.int64))
    no_indexes, buffer, flags = np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, bool)
    sample = sample_template("")
    read_numbers(
        buffer, no_indexes, no_indexes, sample.data, sample.fixed, sample.places, no_indexes, np.zeros((0, 6)), flags
    )
    if rows:
        sent = Sent(no_indexes, no_indexes, np.arange(2), 0, 2)
        sent.expect(done.published, templates, ~_IS_CUMULATIVE)
        sent.differing(Messages.none(), slice(0))


def _hash(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=8).hexdigest()
