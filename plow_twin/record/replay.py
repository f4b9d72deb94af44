"""Run a recording again: the model advances on the journal alone, and what was recorded is compared with what it does.

Nothing is copied from the recorded messages. The state is taken from a recorded snapshot only where the journal begins
or where something was lost; any other snapshot is compared.
"""

from __future__ import annotations

import hashlib
import struct
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from plow_twin.build import build_fingerprint
from plow_twin.errors import RecordingError
from plow_twin.record.cdr import decode, encode
from plow_twin.record.header import RunHeader
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import Message
from plow_twin.record.outputs import FRAME_TOPICS, publication_messages
from plow_twin.record.reader import EntryRecord, FileStatus, OutputRecord, RunReader
from plow_twin.run.twin import Twin
from plow_twin.stream.journal import Digest, Hold, Loss, Sample, Snapshot
from plow_twin.stream.session import Session

#: Topics that depend on the frame before: after a lost message they can be compared again from the next snapshot on.
_CUMULATIVE: Final = frozenset({"contact_peaks", "clearance", "wear_rate"})
_SEQUENCE_MASK: Final = 0xFFFFFFFF
_PROGRESS_EVERY: Final = 500

#: Receives the share of the file that has been replayed, 0..1.
ProgressCallback = Callable[[float], object]


@dataclass(frozen=True)
class Divergence:
    """A difference: at advance number `step` (from 0), on `topic`, in `field`, recorded against computed."""

    step: int
    stamp_ns: int
    topic: str
    field: str
    recorded: str
    computed: str

    def __str__(self) -> str:
        return (
            f"step {self.step}, stamp {self.stamp_ns} ns, {self.topic}: {self.field}: "
            f"recorded {self.recorded}, computed {self.computed}"
        )


@dataclass
class ReplayReport:
    """What a replay found. `compared` and `not_compared` count messages by base name of their topic."""

    path: Path
    entries: int = 0
    samples: int = 0
    steps: int = 0
    refused: int = 0
    digests_compared: int = 0
    snapshots_compared: int = 0
    compared: Counter[str] = field(default_factory=Counter)
    not_compared: Counter[str] = field(default_factory=Counter)
    divergences: int = 0
    first_divergence: Divergence | None = None
    status: FileStatus = FileStatus.UNREAD
    stop_reason: str | None = None
    damaged_chunks: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    build_differences: dict[str, tuple[str, str]] = field(default_factory=dict)
    span_s: float = 0.0
    wall_s: float = 0.0

    @property
    def messages_compared(self) -> int:
        """Number of messages compared on all topics."""
        return self.compared.total()

    @property
    def loss(self) -> bool:
        """Something of the run is missing in the file, or nothing in it could be compared."""
        nothing = self.steps > 0 and self.messages_compared + self.digests_compared == 0
        return bool(self.lost) or self.status is not FileStatus.COMPLETE or nothing

    @property
    def exit_code(self) -> int:
        """0: the same, bit for bit; 1: diverged; 3: the same as far as the file goes, with loss."""
        return 1 if self.first_divergence is not None else 3 if self.loss else 0


def replay(path: Path, on_progress: ProgressCallback | None = None) -> ReplayReport:
    """Run a recording again and compare each digest and each message that follows from the journal, bit for bit.

    Parameters
    ----------
    path
        The `.mcap` file or its folder.
    on_progress
        Receives the share of the entries' bytes done, 0..1.

    Raises
    ------
    RecordingError
        The file is no recording, or its journal cannot be understood.
    SceneError
        The scene in the file is not usable.
    """
    reader = RunReader(Path(path))
    run = _Replay(reader.header, ReplayReport(reader.path))
    begin = time.perf_counter()
    for index, record in enumerate(reader):
        if isinstance(record, EntryRecord):
            run.entry(record)
        else:
            run.output(record)
        if on_progress is not None and index % _PROGRESS_EVERY == 0:
            on_progress(reader.position)
    if on_progress is not None:
        on_progress(1.0)
    return run.finish(reader, time.perf_counter() - begin)


class _Replay:
    """The state of one replay: a session, and whether it is where the live one was."""

    def __init__(self, header: RunHeader, report: ReplayReport) -> None:
        from plow_twin.scene_file import loads_scene

        self.header = header
        self.report = report
        here = build_fingerprint()
        report.build_differences = {
            key: (there, here.get(key, "")) for key, there in header.build.items() if there != here.get(key, "")
        }
        scene = loads_scene(header.scene_yaml, source=f"scene in {report.path}")
        excitation: Any = "scene" if header.excitation_source == "scene" else "sampled"
        twin = Twin(scene, tol=header.tol, excitation=excitation)
        twin.warm_up()
        self.session = Session(twin, header.origin_ns)
        self.topics = {header.topic(name): name for name in FRAME_TOPICS}
        self.next_sequence = 0
        self.synced = False  # the session is where the live one was
        self.outputs_synced = False  # and so are its windows between two messages
        self.resumed = False  # no advance yet since the state was taken from a snapshot
        self.messages: Mapping[str, Message] | None = None
        self.first_ns: int | None = None
        self.gaps = 0
        self.noted: Counter[str] = Counter()  # losses, as noted at their place in the journal

    def entry(self, record: EntryRecord) -> None:
        """Apply or compare one entry of the journal."""
        missing = (record.sequence - self.next_sequence) & _SEQUENCE_MASK
        if missing:
            self.gaps += missing
            self.synced = self.outputs_synced = False
        elif record.sequence == 0 and not isinstance(record.entry, Snapshot):
            self.synced = self.outputs_synced = True  # a journal that starts at the scene's own initial state
        self.next_sequence = (record.sequence + 1) & _SEQUENCE_MASK
        if not isinstance(record.entry, Dropped):  # such a note may stand between the messages of one frame
            self.messages = None
        self.report.entries += 1
        match record.entry:
            case Loss(count):
                self.noted["journal"] += count
                self.synced = self.outputs_synced = False
            case Dropped(topic, count):
                self.noted[topic] += count
                self.outputs_synced = False
            case Snapshot() as snapshot:
                self._snapshot(snapshot)
            case Digest(stamp_ns, digest):
                if self.synced:
                    self.report.digests_compared += 1
                    self._compare("digest", stamp_ns, "digest", digest, self.session.twin.digest())
            case entry:
                if self.synced:
                    self._apply(entry)

    def _apply(self, entry: Any) -> None:
        self.report.samples += isinstance(entry, Sample)
        if isinstance(entry, Sample | Hold):
            self.report.steps += 1
            self.resumed = False
            self.first_ns = entry.stamp_ns if self.first_ns is None else self.first_ns
        try:
            self.session.apply(entry)
        except ValueError:  # refused by the live session as well; if not, the next comparison tells
            self.report.refused += 1

    def _snapshot(self, snapshot: Snapshot) -> None:
        if self.synced and self.outputs_synced:
            self.report.snapshots_compared += 1
            computed = self.session.snapshot().data
            self._compare("snapshot", snapshot.stamp_ns, "state", _hash(snapshot.data), _hash(computed))
            return
        before = self.session.twin.digest() if self.synced else None
        try:
            self.session.apply(snapshot)
        except (ValueError, struct.error) as error:
            raise RecordingError(f"{self.report.path}: snapshot at {snapshot.stamp_ns} ns: {error}") from error
        if before is not None:  # only messages were lost: the motion must be the same
            self._compare("snapshot", snapshot.stamp_ns, "state", self.session.twin.digest(), before)
        self.synced = self.outputs_synced = self.resumed = True

    def output(self, record: OutputRecord) -> None:
        """Compare one recorded message with the one that the model gives at that place."""
        name = self.topics.get(record.topic)
        if name is None:
            return
        here = (self.next_sequence - 1) & _SEQUENCE_MASK
        if not self.synced or record.sequence != here or (name in _CUMULATIVE and not self.outputs_synced):
            self.report.not_compared[name] += 1
            return
        if self.messages is None:  # the first message of a frame
            frame = self.session.outputs.take()
            frames = (self.header.frame_id, self.header.child_frame_id)
            self.messages = {} if frame is None else publication_messages(frame, *frames)
        computed = self.messages.get(name)
        if computed is None and self.resumed:
            self.report.not_compared[name] += 1
            return
        self.report.compared[name] += 1
        if computed is None:
            self._diverged(name, record.publish_time_ns, "message", "a message", "none")
        elif encode(computed) != record.data:
            self._diverged(name, record.publish_time_ns, *_first_difference(record, computed))

    def _compare(self, topic: str, stamp_ns: int, name: str, recorded: str, computed: str) -> None:
        if recorded != computed:
            self._diverged(topic, stamp_ns, name, recorded, computed)

    def _diverged(self, topic: str, stamp_ns: int, name: str, recorded: str, computed: str) -> None:
        self.report.divergences += 1
        if self.report.first_divergence is None:
            step = self.report.steps - 1
            self.report.first_divergence = Divergence(step, stamp_ns, topic, name, recorded, computed)

    def finish(self, reader: RunReader, wall_s: float) -> ReplayReport:
        """Complete the report once the file has been read."""
        report = self.report
        report.status, report.damaged_chunks, report.wall_s = reader.status, reader.damaged_chunks, wall_s
        report.stop_reason = reader.stop_reason
        report.lost = {topic: count for topic, count in (Counter(reader.lost) | self.noted).items() if count}
        if self.gaps > self.noted["journal"]:
            report.lost["journal, unaccounted"] = self.gaps - self.noted["journal"]
        if self.first_ns is not None and self.session.stamp_ns is not None:
            report.span_s = (self.session.stamp_ns - self.first_ns) * 1e-9
        return report


def _hash(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=8).hexdigest()


def _first_difference(record: OutputRecord, computed: Message) -> tuple[str, str, str]:
    """Return field, recorded and computed value of the first difference between two messages."""
    recorded = decode(record.data, record.message_type)
    if type(recorded) is not type(computed):
        return "type", record.message_type, computed.TYPE
    for name in type(computed).__dataclass_fields__:
        old, new = getattr(recorded, name), getattr(computed, name)
        if isinstance(new, np.ndarray) and np.shape(old) == np.shape(new):
            places = np.flatnonzero(np.asarray(old).view(np.int64) != new.view(np.int64))
            if places.size:
                place = int(places[0])
                return f"{name}[{place}]", repr(float(old[place])), repr(float(new[place]))
        elif repr(old) != repr(new):
            return name, repr(old), repr(new)
    return "encoding", "these bytes", "other bytes for the same values"
