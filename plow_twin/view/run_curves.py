"""The curves of a whole recording for a picture or a page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.geometry import angle_of
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.entries import Batch, Holes
from plow_twin.record.outputs import publication_templates
from plow_twin.record.reader import RunReader
from plow_twin.record.rows import Rows, rows_by_topic
from plow_twin.record.run_time import RunTime
from plow_twin.stream.journal import Estimated, Failed, Hold, Reset, SetModel, SetWear, Unload
from plow_twin.stream.outputs import CLEARANCE_NAMES
from plow_twin.view.envelope import Envelope

Array = NDArray[np.float64]

#: Columns of each clearance and of its 5 % and 95 % points.
_CLEARANCE_COLUMNS: Final = np.array(
    [CLEARANCE_NAMES.index(f"{axis}{point}") for axis in ("horizontal", "vertical") for point in ("", "/p05", "/p95")]
)
_NS: Final = 1e-9
#: States of a clearance with a measured value.
_KNOWN_STATES: Final = ("estimated", "rough")
#: Largest number of marks of each kind; more marks would cover the picture.
_MOST_MARKS: Final = 40


class Instant(NamedTuple):
    """State at a stamp [ns]: pose x, y [m], theta [rad], and the forces [N] and penetrations [m] of all pairs."""

    stamp_ns: int
    pose: tuple[float, float, float]
    force: Array
    penetration: Array


@dataclass
class RunCurves:
    """Largest forces [kN], load [kN, kN m] and clearances [mm] over time, and the state at the largest force.

    Times [s] are counted from the first stamp `first_ns`. `held_s` contains the intervals without samples. In these
    intervals, the load is held or interpolated linearly. `failed_s` contains the intervals of failed advances, and
    `failed` their number. `changes` contains each change of the clearance that is not due to wear, with its reason.
    """

    first_ns: int | None = None
    force: Envelope = field(default_factory=lambda: Envelope(PAIR_COUNT))
    load: Envelope = field(default_factory=lambda: Envelope(3))
    clearance: Envelope = field(default_factory=lambda: Envelope(len(_CLEARANCE_COLUMNS)))
    instant: Instant | None = None
    #: Largest force of all pairs [kN], or 0 without forces.
    peak: float = 0.0
    held_s: list[tuple[float, float]] = field(default_factory=list)
    failed_s: list[tuple[float, float]] = field(default_factory=list)
    #: Description of the intervals without samples.
    silences: str = ""
    failed: int = 0
    changes: list[tuple[float, str]] = field(default_factory=list)
    #: States of the newest clearances, from the status of the twin.
    states: dict[str, str] = field(default_factory=lambda: {"horizontal": "prior", "vertical": "prior"})
    _estimated: bool = False
    _held_since_ns: int | None = None
    _newest_ns: int | None = None
    #: Sequence number and result of the newest estimate.
    _estimate: tuple[int, str] | None = None
    _clearance: Array | None = None

    @classmethod
    def of(cls, reader: RunReader) -> RunCurves:
        """Read a whole recording. Lines are interrupted at missing entries, resets and silences."""
        curves = cls()
        run_time = RunTime(reader.header.parameters)
        templates = publication_templates(reader.header.frame_id, reader.header.child_frame_id)
        topics = {reader.header.topic(name): name for name in templates}
        holes = Holes()
        for batch in reader.batches():
            missing = holes.find(batch.entries)
            resets = {index for index, entry in batch.entries.others.items() if isinstance(entry, Reset)}
            silent = {index: (begin, end) for index, begin, end in run_time.add(batch.entries)[:_MOST_MARKS]}
            places = sorted(resets | set(missing) | set(silent))
            for place, part in zip((None, *places), batch.parted(places), strict=True):
                if place in resets or place in missing:
                    curves._break_lines()
                elif place is not None:
                    curves._bridged(*silent[place])
                curves._entries(part)
                curves._messages(rows_by_topic(part.outputs, topics, templates))
        curves._end_of_held(curves._newest_ns)
        curves._last_estimate()
        curves.silences = run_time.silences.text()
        return curves

    @property
    def instant_s(self) -> float | None:
        """Time [s] of the largest force, or None."""
        return None if self.instant is None else (self.instant.stamp_ns - (self.first_ns or 0)) * _NS

    def __bool__(self) -> bool:
        return bool(self.force or self.load or self.clearance)

    def _break_lines(self) -> None:
        self._end_of_held(self._newest_ns)
        for envelope in (self.force, self.load, self.clearance):
            envelope.break_line()

    def _seconds(self, stamps_ns: NDArray[np.int64]) -> Array:
        if self.first_ns is None and len(stamps_ns):
            self.first_ns = int(stamps_ns[0])
        times: Array = np.asarray((stamps_ns - (self.first_ns or 0)) * _NS, np.float64)
        return times

    def _entries(self, batch: Batch) -> None:
        stamps, wrench = batch.entries.samples()
        self.load.add(self._seconds(stamps), wrench / 1e3)
        samples, done = np.flatnonzero(batch.entries.sample), 0
        for index, entry in sorted(batch.entries.others.items()):
            match entry:
                case Hold(stamp_ns) | Unload(stamp_ns):
                    self._samples(batch.entries.stamp_ns[samples[(samples >= done) & (samples < index)]])
                    done = index
                    if self._held_since_ns is None:
                        self._held_since_ns = stamp_ns if self._newest_ns is None else self._newest_ns
                    self._newest_ns = stamp_ns
                case Estimated(end_ns=end_ns, result=result):
                    if not self._estimated:
                        # first add the samples that arrived before the estimate
                        self._samples(batch.entries.stamp_ns[samples[(samples >= done) & (samples < index)]])
                        done = index
                        self._change(end_ns if self._newest_ns is None else self._newest_ns, "first estimate")
                    self._estimated, self._estimate = True, (int(batch.entries.sequence[index]), result)
                    found = json.loads(result)
                    self.states = {axis: found.get(axis, {}).get("state", "prior") for axis in self.states}
                case Failed(stamp_ns, since_ns, advances):
                    self._failed(stamp_ns, since_ns, advances)
                case SetModel(stamp_ns):
                    self._change(stamp_ns, "parameters set")
                    self.states = dict.fromkeys(self.states, "prior")
                case SetWear(stamp_ns):
                    self._change(stamp_ns, "wear set")
                    self.states = dict.fromkeys(self.states, "prior")
        self._samples(batch.entries.stamp_ns[samples[samples >= done]])

    def _samples(self, stamps: NDArray[np.int64]) -> None:
        """Add the stamps of samples. The first sample after the start of a hold ends the hold."""
        if not len(stamps):
            return
        behind = stamps[stamps > (self._held_since_ns or 0)]
        self._end_of_held(int(behind[0]) if len(behind) else None)
        self._newest_ns = int(stamps[-1])

    def _end_of_held(self, stamp_ns: int | None) -> None:
        if self._held_since_ns is None or stamp_ns is None:
            return
        first = self.first_ns or 0
        if len(self.held_s) < _MOST_MARKS:
            self.held_s.append(((self._held_since_ns - first) * _NS, (stamp_ns - first) * _NS))
        self._held_since_ns = None

    def _bridged(self, begin_ns: int, end_ns: int) -> None:
        """End the lines at a silence without a journal entry. Mark the silence unless there are too many marks."""
        if self._held_since_ns is None and len(self.held_s) < _MOST_MARKS:
            self._held_since_ns = begin_ns
            self._end_of_held(end_ns)
            self._break_lines()

    def _failed(self, stamp_ns: int, since_ns: int, advances: int) -> None:
        """Add failed advances. The first entry of a series is for its first advance, the second for all others."""
        first = self.first_ns or 0
        self.failed += advances
        if stamp_ns == since_ns:
            if len(self.failed_s) < _MOST_MARKS:
                self.failed_s.append(((since_ns - first) * _NS,) * 2)
        elif self.failed_s and self.failed_s[-1][0] == (since_ns - first) * _NS:
            self.failed_s[-1] = (self.failed_s[-1][0], (stamp_ns - first) * _NS)

    def _change(self, stamp_ns: int, reason: str) -> None:
        if self.first_ns is not None and len(self.changes) < _MOST_MARKS:
            self.changes.append(((stamp_ns - self.first_ns) * _NS, reason))

    def _last_estimate(self) -> None:
        """Add the clearances of an estimate that arrived after the last publication."""
        if self._estimate is None or self._clearance is None or self._newest_ns is None:
            return
        result, values = json.loads(self._estimate[1]), self._clearance.copy()
        for place, axis in enumerate(("horizontal", "vertical")):
            facts = result.get(axis, {})
            if facts.get("state") in _KNOWN_STATES:
                values[3 * place : 3 * place + 3] = [1e3 * facts[f"{point}_m"] for point in ("mean", "p05", "p95")]
        self.clearance.add(self._seconds(np.array([self._newest_ns])), values[None])

    def _messages(self, rows_of_topic: dict[str, Rows]) -> None:
        if "contact_peaks" in rows_of_topic:
            rows = rows_of_topic["contact_peaks"]
            peaks = rows.numbers[:, 2 * PAIR_COUNT :] / 1e3
            self.force.add(self._seconds(rows.stamp_ns), peaks)
            self.peak = max(self.peak, float(peaks.max()))
        if "clearance" in rows_of_topic:
            rows = rows_of_topic["clearance"]
            values = 1e3 * rows.numbers[:, _CLEARANCE_COLUMNS]
            self.clearance.add(self._seconds(rows.stamp_ns), values)
            self._clearance = values[-1]
            if self._estimate is not None and rows.sequence[-1] > self._estimate[0]:
                # publications after an estimate already contain its clearances
                self._estimate = None
        if "contact_forces" in rows_of_topic and "head_state" in rows_of_topic:
            for instant in _largest(rows_of_topic["contact_forces"], rows_of_topic["head_state"]):
                if self.instant is None or instant.force.max() > self.instant.force.max():
                    self.instant = instant


def _largest(contact: Rows, head: Rows) -> Iterator[Instant]:
    """Yield the state at the largest force, among the stamps for which a pose and forces were published."""
    at = np.minimum(np.searchsorted(contact.sequence, head.sequence), len(contact) - 1)
    both = np.flatnonzero(contact.stamp_ns[at] == head.stamp_ns)
    if not both.size:
        return
    force = contact.numbers[at[both], 2 * PAIR_COUNT :]
    row = int(force.max(axis=1).argmax())
    x, y, *turn = head.numbers[both[row], :4].tolist()
    penetration = contact.numbers[at[both[row]], :PAIR_COUNT]
    yield Instant(int(head.stamp_ns[both[row]]), (x, y, float(angle_of(*turn))), force[row], penetration)
