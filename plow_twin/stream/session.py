"""The session, which computes the motion from journal entries, in a replay exactly as in the live node.

Terms of this module:

- An *advance* moves the model to a stamp, usually the stamp of a sample. Its result is a *row*.
- The load is *held* while the motion advances without samples.
- A sample is *late* if the model has already advanced beyond its stamp. For a late sample, the session goes back to a
  snapshot in its *history*, inserts the sample, and computes the motion again. If a twin that follows measurements
  cannot repeat so many samples at once, the late sample *waits* (module `insertion`).
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from typing import Final, NamedTuple

import numpy as np

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import check_travel_speed
from plow_twin.solve.samples import model_times
from plow_twin.stream import journal, outputs
from plow_twin.stream.driven import MOST_MEASURED, PREPARATION_S, Driven, Following
from plow_twin.stream.history import NO_SAMPLES, History, Samples
from plow_twin.stream.insertion import Insertion, samples_at_once
from plow_twin.stream.model_changes import changed_scene, changed_twin, read_changes
from plow_twin.stream.outputs import NONE, NOTHING, ONLY_ROW, Array, Integers, Outputs, Published, Rows, Stock
from plow_twin.stream.snapshot import SessionState, split_changes, with_changes

#: Number of advances from one digest to the next.
DIGEST_INTERVAL: Final = 100
#: Largest time [ns] by which a pose may be ahead of the model, as when a bag is played fast. A pose beyond the limit
#: must come from a different clock.
_AHEAD_NS: Final = 3_600_000_000_000
_NO_LOAD: Final = np.zeros((1, 3))
_NO_SHIFT: Final = (0.0,) * 6
_NO_ROWS: Final = NOTHING.rows
#: Entries that end the motion; all late samples that wait are inserted before.
_ENDING: Final = journal.Reset | journal.SetWear | journal.Restore


class _Measured(NamedTuple):
    """A pose or an estimate, with the stamp [ns] that the model had reached when it was passed to the twin.

    `number` counts the poses and estimates of the twin. The entry has no effect before model time `known` [s], even if
    the session goes back to an earlier time.
    """

    number: int
    reached_ns: int
    known: float
    stamp_ns: int
    entry: journal.Pose | journal.PartOfPose | journal.Estimated


class Applied(NamedTuple):
    """Result of applying samples, such as a row for each sample, publications and digests."""

    rows: Rows
    published: Published
    digests: list[str]
    failed: int
    late: int = 0


class Series(NamedTuple):
    """Samples that were applied together and have not been journalled yet."""

    #: stamps [ns], shape (n,)
    stamps: Integers
    #: loads Fx, Fy [N] and M [N m], shape (n, 3)
    wrench: Array
    #: a row for each sample, or no rows
    published: Published
    #: the m digests
    digests: Sequence[str]
    #: number of samples before each digest, shape (m,)
    digest_after: Integers

    def part(self, begin: int, end: int) -> Series:
        """Return the samples with indices from `begin` to `end` - 1, with their publications and digests."""
        marked = (self.digest_after > begin) & (self.digest_after <= end)
        published = self.published
        if len(published.rows):
            published = published.of(np.arange(begin, end))
        return Series(
            self.stamps[begin:end],
            self.wrench[begin:end],
            published,
            [self.digests[place] for place in np.flatnonzero(marked).tolist()],
            self.digest_after[marked] - begin,
        )


class _UndoneError(Exception):
    """An advance failed, and the twin has been restored to its state before the samples."""


class Session:
    """One run of a twin. The inputs of the twin are entries of a journal.

    Model time is the stamp minus the origin, which is the first stamp by default. A `Reset` restores the initial motion
    but not the wear, which only `SetWear` changes. While the load is held or removed, the true load is unknown, so the
    pads do not wear. If the scene itself defines the loads, a `Hold` only advances the time.

    After a late sample, the motion is computed again up to the newest sample. Motion after it is dropped.

    Samples have three methods, because their journal is written at different times: `apply_samples` writes it before
    the advance, like every other entry; the caller of `apply_series` writes it after the advance, which is undone if it
    fails; the samples of `advance` come from a journal, which also determines the places of the digests.

    Parameters
    ----------
    twin
        The twin, which only the session may advance. A twin that follows measurements receives measured poses and
        estimates from the session.
    origin_ns
        Stamp of model time 0 [ns]; None for the first stamp.
    on_entry
        Function that receives each entry before the session applies it, and each digest after its advance. It also
        receives an entry that the twin then refuses, because a number is not finite.
    rollback_span_s
        Largest age of a late sample relative to the newest sample [s]; with 0, late samples are refused.
    wear_depth
        Initial wear depth of each pad [m], shape (8,); None for the wear depth of the scene.
    """

    def __init__(
        self,
        twin: Driven,
        origin_ns: int | None = None,
        on_entry: Callable[[journal.Entry], object] = lambda entry: None,
        *,
        rollback_span_s: float = 0.0,
        wear_depth: Sequence[float] | None = None,
    ) -> None:
        self._use(twin)
        #: poses and estimates since the oldest snapshot
        self._measured: deque[_Measured] = deque()
        #: late samples that wait; None without such samples
        self._insertion: Insertion[Session] | None = None
        #: number of poses that were dropped, because they were too far ahead of the model or more than `MOST_MEASURED`
        self.poses_dropped = 0
        self._scene = twin.scene
        #: changed numbers of the scene: new value by key
        self.changes: dict[str, float] = {}
        self.origin_ns = origin_ns
        #: stamp that the model has reached [ns], None before the first stamp
        self.stamp_ns: int | None = None
        self.outputs = Outputs(twin.scene)
        self._stock = Stock()
        #: rows of the latest advances, from which `wear_depth` is read when needed
        self._row: Rows | None = None
        scene, self._sampled = twin.scene, twin.excitation == "sampled"
        self.history = History(round(rollback_span_s * 1e9) if self._sampled else 0)
        self.wear_depth = np.zeros(PAIR_COUNT)
        if scene.wear is not None:
            self.wear_depth[:] = scene.wear.initial_depth_m
        if wear_depth is not None:
            self.wear_depth[:] = wear_depth
            twin.reset(twin.time, wear_depth=self.wear_depth)
        self._largest_error_m = 0.0
        self.held = False
        self._wears = scene.wear is not None and scene.wear.coefficient_m2_n != 0.0
        self.travel_speed_m_s = scene.wear.travel_speed_m_s if scene.wear is not None else 0.0
        self._travels: list[journal.Travel] = []
        #: function that emits an entry; called by others only for an entry that does not change the motion
        self.emit = on_entry
        self._advances = 0

    def _use(self, twin: Driven) -> None:
        self.twin: Driven = twin
        self.following = twin if isinstance(twin, Following) else None

    def catch_up(self) -> None:
        """Finish the deferred computation of a following twin, and add a snapshot to the history if it is due."""
        if self.following is not None:
            self.following.catch_up()
            if self._insertion is not None:
                self._insertion.work()
            elif self.history.is_due and self.stamp_ns is not None and not self.held:
                self._store_snapshot(kept=False)

    @property
    def waiting(self) -> int:
        """Number of late samples that wait for their insertion."""
        return 0 if self._insertion is None else self._insertion.waiting

    def start(self) -> None:
        """Emit the snapshot that opens a journal."""
        self.emit(self.snapshot())

    def close(self) -> None:
        """Insert all late samples that wait, and emit the digest that ends a journal."""
        if self.stamp_ns is not None:
            if self._insertion is not None:
                # the hold, by a time of zero, tells a replay when the samples were inserted
                self.apply(journal.Hold(self.stamp_ns))
            self.emit(journal.Digest(self.stamp_ns, self.twin.digest()))

    def apply(self, entry: journal.Entry) -> Rows | None:
        """Emit an entry and apply it; return the row of its advance, shape (1,), or None if the entry makes no advance.

        A `Digest` or a `Loss` describes the journal from which it was read. It is neither applied nor emitted. Raise
        `ValueError` if the stamp is older than all stored states, or a number is not finite. The motion is unchanged.
        """
        match entry:
            case journal.Sample():
                rows = self.apply_samples([entry]).rows[-1:]
                return rows if len(rows) else None
            case journal.Hold() | journal.Unload():
                return self._apply_hold(entry)
            case journal.Digest() | journal.Loss():
                return None
            case journal.Travel(_, speed):
                check_travel_speed(self.twin.scene, speed)
            case journal.SetModel():
                self._apply_model(entry)
                return None
        self.emit(entry)
        if isinstance(entry, _ENDING):
            self.insert_waiting()
        match entry:
            case journal.Travel():
                self._apply_travel(entry)
            case journal.Reset():
                self._restart(self.wear_depth)
            case journal.SetWear(_, depth):
                self._restart(np.array(depth))
                # the estimate refers to the wear before this change
                self.outputs.set_shift(_NO_SHIFT)
            case journal.Estimated(shift=shift):
                self.outputs.set_shift(shift)
                if self.stamp_ns is not None:
                    self.follow(self.stamp_ns, entry)
            case journal.Restore(_, data):
                self._restore_motion(data)
            case journal.Pose(stamp_ns) | journal.PartOfPose(stamp_ns):
                if self.following is not None and self.stamp_ns is not None and stamp_ns > self.stamp_ns + _AHEAD_NS:
                    self.poses_dropped += 1
                else:
                    self.follow(stamp_ns, entry)
            case journal.Parameter("follow", "parameters") if self.following is not None:
                self.insert_waiting()
                self.following.follow_parameters()
                self._renew_history()
            case journal.Snapshot(_, data):
                self._insertion = None
                self._restore(data)
                self._renew_history()
        return None  # entries of other types do not change the motion

    def parts(self, samples: Sequence[journal.Sample], *, each: bool = False) -> Iterator[Sequence[journal.Sample]]:
        """Yield parts of samples, whose stamps must not fall, for `apply_samples`.

        Each part must be applied before the next part is requested. A late sample and all samples after it form one
        part. A part without a late sample ends at the next digest or, if `each` is set, after one sample.
        """
        while samples:
            count = 1 if each else DIGEST_INTERVAL - self._advances % DIGEST_INTERVAL
            if self._is_late(samples[0].stamp_ns):
                count = len(samples)
            yield samples[:count]
            samples = samples[count:]

    def apply_samples(self, samples: Sequence[journal.Sample], *, each: bool = False) -> Applied:
        """Write a part of the samples, as divided by `parts`, to the journal and apply it.

        The motion does not depend on the division into parts. If `each` is set, each sample is published, except that
        samples inserted late are published together. If `each` is not set, `outputs` collects the samples for the next
        publication. Raise `ValueError` as `apply` does.
        """
        late, first_ns = 0, samples[0].stamp_ns
        if self._is_late(first_ns):
            late = sum(self._is_late(sample.stamp_ns) for sample in samples)
            self._check_late(first_ns)
        for sample in samples:
            self.emit(sample)
        stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
        wrench = np.array([sample.wrench for sample in samples])
        if late and self._must_wait(first_ns):
            for sample in samples[:late]:
                self._wait(sample, self.history.repeated(sample.stamp_ns))
            applied = Applied(_NO_ROWS, NOTHING, [], 0)
            if late < len(samples):
                applied = self._advance(stamps[late:], wrench[late:], self._stock.new(len(samples) - late))
            applied = applied._replace(published=self.outputs.pop() if each else NOTHING, late=late)
        elif late:
            applied = self._recompute(first_ns, (stamps, wrench))
            applied = applied._replace(published=self.outputs.pop() if each else NOTHING, late=late)
        else:
            applied = self._advance(stamps, wrench, self._stock.new(len(stamps)), ONLY_ROW if each else NONE)
            if each and applied.failed and not applied.published.rows["stamp_ns"][0]:
                applied = applied._replace(published=NOTHING)
        self._count(len(samples))
        return applied

    def apply_series(self, stamps: Integers, wrench: Array, *, each: bool) -> Series | None:
        """Apply samples together without emitting entries; the caller must journal the returned series.

        The result is None, without any change, if the samples must be applied one by one, for example because an
        advance fails. The `stamps` [ns], shape (n,), must rise, and the first must not be late. The loads `wrench`,
        shape (n, 3), must be finite. `each` is as for `apply_samples`.
        """
        if self.stamp_ns is None or self.held or self._travels or self._insertion is not None:
            return None
        if each and not self.outputs.is_clear:
            return None
        count = len(stamps)
        first = DIGEST_INTERVAL - self._advances % DIGEST_INTERVAL
        digest_after = np.arange(first, count + 1, DIGEST_INTERVAL)
        taken = np.arange(count) if each else NONE
        try:
            rows = self._advance_part(
                stamps, wrench, self._stock.new(count), taken, digest_after, undo=self.twin.snapshot()
            )
        except _UndoneError:
            return None
        self._advances += count
        return Series(stamps, wrench, rows.published, rows.digests, digest_after)

    @property
    def wear_depth(self) -> Array:
        """Wear depth of each pad [m], shape (8,)."""
        if self._row is not None:
            self.wear_depth = self._row["wear_depth"][-1].copy()
        return self._wear_depth

    @wear_depth.setter
    def wear_depth(self, wear_depth: Array) -> None:
        self._wear_depth, self._row = wear_depth, None

    def advance(
        self, stamps: Integers, wrench: Array, rows: Rows | None, taken: Integers = NONE, digest_after: Integers = NONE
    ) -> Applied:
        """Advance to samples that are already in a journal, without emitting entries.

        The `stamps` [ns], shape (n,), must not fall, and the first must not be late. `wrench`, shape (n, 3), is Fx, Fy
        [N] and M [N m]. The array `rows`, shape (n,), receives the rows; with None, rows are neither computed nor
        published. `taken` is as for `Outputs.add`. A digest is computed after each of the rising counts of samples in
        `digest_after`, shape (m,), from 1 to n. Raise `ValueError` if a number is not finite, or the stamps fall. The
        motion is unchanged.
        """
        if self._is_late(int(stamps[0])) or (stamps[1:] < stamps[:-1]).any():
            raise ValueError(
                f"stamp: got {stamps[0]} ns first, expected stamps after {self.stamp_ns} ns that do not decrease"
            )
        applied = self._advance(stamps, wrench, rows, taken, digest_after)
        self._advances += len(stamps)
        return applied

    def _advance(
        self, stamps: Integers, wrench: Array, rows: Rows | None, taken: Integers = NONE, digest_after: Integers = NONE
    ) -> Applied:
        """Advance in parts.

        A part ends at a waiting travel speed, after a sample that follows a held load, and where late samples are
        inserted.
        """
        if not (self.held or self._travels or self._insertion is not None):
            return self._advance_part(stamps, wrench, rows, taken, digest_after)
        if not np.isfinite(wrench).all():
            raise ValueError(f"wrench: got {wrench!r}, expected finite numbers")
        resumed, begin, count = self._resume_wear(), 0, len(stamps)
        parts: list[Applied] = []
        while begin < count:
            if self._insertion is not None:
                self._insertion.work()
                if not self._insertion.left:
                    self._insert()
            travel, end = self._travels[0] if self._travels else None, count
            if travel is not None and travel.stamp_ns < stamps[begin]:
                self._apply_waiting_travel(travel, int(stamps[begin]), wrench[begin])
                continue
            if travel is not None:
                end = int(np.searchsorted(stamps, travel.stamp_ns, side="right"))
            # a snapshot is taken after the first sample that follows a held load, because corrections of later motion
            # begin there
            if resumed:
                end = begin + 1
            if self._insertion is not None:
                end = min(end, begin + self._insertion.left)
            part = slice(begin, end)
            chosen = taken[(taken >= begin) & (taken < end)] - begin
            part_digest_after = digest_after[(digest_after > begin) & (digest_after <= end)] - begin
            out = None if rows is None else rows[part]
            applied = self._advance_part(stamps[part], wrench[part], out, chosen, part_digest_after, resumed=resumed)
            parts.append(applied)
            if self._insertion is not None:
                self._insertion.add(stamps[part], wrench[part])
            if resumed:
                self._store_snapshot(resumed=True)
            begin, resumed = end, False
        published = Published.joined([part.published for part in parts])
        digests = [digest for part in parts for digest in part.digests]
        return Applied(parts[-1].rows if rows is None else rows, published, digests, sum(part.failed for part in parts))

    def check_model(self, changes: Mapping[str, float]) -> None:
        """Raise an `ArgumentError` if changes of the scene are impossible while the model runs."""
        self._changed_twin(changes)

    def pop_error_estimate(self) -> float:
        """Return the largest error estimate [m] of advances that `max_evaluations` has limited since the last call."""
        largest, self._largest_error_m = self._largest_error_m, 0.0
        return largest

    def renew(self) -> journal.Snapshot:
        """Insert all late samples that wait, drop all stored earlier states, and return a snapshot of the state.

        A journal can continue from the snapshot.
        """
        self.insert_waiting()
        snapshot = self.snapshot()
        self._renew_history()
        return snapshot

    def snapshot(self) -> journal.Snapshot:
        """Return the exact state of the twin, the outputs and the session."""
        state = SessionState(
            self.origin_ns, self.stamp_ns, self._advances, self.held, self.travel_speed_m_s, self._travels,
            self.wear_depth, self.outputs.state(), with_changes(self.twin.snapshot(), self.changes),
        )  # fmt: skip
        stamp_ns = self.stamp_ns if self.stamp_ns is not None else self.origin_ns or 0
        return journal.Snapshot(stamp_ns, state.pack())

    def _advance_part(
        self,
        stamps: Integers,
        wrench: Array,
        rows: Rows | None,
        taken: Integers,
        digest_after: Integers,
        *,
        stored: bool = True,
        resumed: bool = False,
        undo: bytes | None = None,
    ) -> Applied:
        """Advance without other entries between the stamps.

        `stored` marks samples, which the history stores, and `resumed` the first sample after a held load. If an
        advance fails and the snapshot `undo` is given, restore the twin from it and raise `_UndoneError`.
        """
        origin_ns = self._begin(int(stamps[0])) if self.origin_ns is None else self.origin_ns
        # no state is saved at the stamp of a speed, because a late sample may change the load there
        due = self.history.is_due and self._insertion is None
        if due and stored and not resumed and self.stamp_ns in (None, self.history.newest_sample_ns):
            before_ns = int(stamps[0]) - 1 if self.stamp_ns is None else self.stamp_ns
            self.history.add_snapshot(before_ns, self.snapshot().data, kept=False)
        if self.following is not None:
            self.following.end_spans(taken, begins=not self.outputs.waits)
        times = np.empty(len(stamps))
        model_times(stamps, origin_ns, times)
        failed, digests = self.twin.advance_rows(times, wrench, rows, digest_after)
        if undo is not None and rows is not None and (failed or not _all_finite(rows)):
            self.twin.restore(undo)
            raise _UndoneError
        self.origin_ns, self.stamp_ns = origin_ns, stamps.item(-1)
        if stored:
            self.history.add(stamps, wrench)
        if rows is None:
            self.wear_depth = self.twin.wear_depth
            return Applied(_NO_ROWS, NOTHING, digests, failed)
        self._row = rows
        if self.twin.max_evaluations is not None:
            self._largest_error_m = max(self._largest_error_m, float(rows["error_estimate"].max()))
        return Applied(rows, self.outputs.add(rows, stamps, taken, held=self.held), digests, failed)

    def follow(
        self, stamp_ns: int, entry: journal.Pose | journal.PartOfPose | journal.Estimated, known: float = -math.inf
    ) -> None:
        """Pass a pose or an estimate to the twin, without effect before model time `known` [s]."""
        if self.following is None or self.origin_ns is None:
            return
        time = (stamp_ns - self.origin_ns) * 1e-9
        if isinstance(entry, journal.Estimated):
            start = (entry.start_ns - self.origin_ns) * 1e-9
            self.following.add_estimate(entry.result, time + PREPARATION_S, start)
        else:
            self.following.add_pose(time, journal.whole_pose(entry), known)
        measured, earliest_ns, reached_ns = self._measured, self.history.earliest_ns, self.stamp_ns or 0
        known = max(known, self.following.time)
        if self._insertion is not None:
            self._insertion.add_measured(entry, stamp_ns, known)
        measured.append(_Measured(self.following.added, reached_ns, known, stamp_ns, entry))
        while measured and (earliest_ns is None or measured[0].reached_ns < earliest_ns):
            measured.popleft()
        if len(measured) > MOST_MEASURED:
            del measured[
                next(
                    place
                    for place, measurement in enumerate(measured)
                    if not isinstance(measurement.entry, journal.Estimated)
                )
            ]
            self.poses_dropped += 1

    def _apply_waiting_travel(self, travel: journal.Travel, stamp_ns: int, wrench: Array) -> None:
        self._travels.pop(0)
        if self.stamp_ns is not None and travel.stamp_ns > self.stamp_ns:
            share = (travel.stamp_ns - self.stamp_ns) / (stamp_ns - self.stamp_ns)
            load = self.twin.wrench
            on_the_way = (load + share * (wrench - load))[None]
            self._move(travel.stamp_ns, on_the_way)
        self._set_speed(travel)

    def _is_late(self, stamp_ns: int) -> bool:
        """Return whether a sample with this stamp is late.

        A sample exactly at the stamp reached is late if the load was held up to this stamp.
        """
        if self.stamp_ns is None or stamp_ns > self.stamp_ns:
            return False
        return stamp_ns < self.stamp_ns or (self.held and self.history.oldest_ns is not None)

    def _check_late(self, stamp_ns: int) -> None:
        oldest_ns = self.history.oldest_ns
        if oldest_ns is None or stamp_ns <= oldest_ns:
            reached, stored = f"the time reached, {self.stamp_ns} ns", f"the oldest stored state, {oldest_ns} ns"
            expected = f"at least {reached}" if oldest_ns is None else f"a stamp after {stored}"
            raise ValueError(f"stamp: got {stamp_ns} ns, expected {expected}")

    def _must_wait(self, stamp_ns: int) -> bool:
        """Return whether a late sample must wait, because too many samples would be repeated at once."""
        if self._insertion is not None or self.following is None or self.held:
            return self._insertion is not None
        return self.history.repeated(stamp_ns) > samples_at_once(self.following.members)

    def _wait(self, sample: journal.Sample, repeated: int) -> None:
        """Let a late sample wait, for which `repeated` samples must be applied again."""
        assert self.following is not None
        if self._insertion is None:
            state = SessionState.unpack(self.history.before(sample.stamp_ns))
            self._insertion = Insertion(self.following.second(self._split_changes(state.twin)[0]), self._second)
        self._insertion.add_late(sample, repeated)
        self.history.wait(sample.stamp_ns)

    def _second(self, twin: Following, stamp_ns: int) -> tuple[Session, int, Samples]:
        """Return a session of `twin` in a state before `stamp_ns`, and the samples after the state.

        The second result is the stamp at which the motion changes.
        """
        second = copy(self)
        second._use(twin)
        second.emit, second._insertion = lambda entry: None, None
        second.history, second.outputs, second._stock = self.history.copy(), self.outputs.copy(), Stock()
        second._measured, second._travels = self._measured.copy(), self._travels.copy()
        corrected_ns = second.outputs.correct(stamp_ns, second.history.correction_limit_ns(stamp_ns))
        return second, corrected_ns, second._rewind(corrected_ns)

    def _insert(self) -> None:
        """Replace the motion by the motion with the late samples that have waited longest."""
        assert self._insertion is not None and self.following is not None
        insertion, self._insertion = self._insertion, None
        self.following.catch_up()
        second = insertion.finish()
        self._use(second.twin)
        self.history.replace_motion(second.history, [sample.stamp_ns for sample, _ in insertion.later])
        self.outputs.replace_motion(second.outputs)
        self._measured, self._travels, self.wear_depth = second._measured, second._travels, second.wear_depth
        if self._wears:
            self.travel_speed_m_s = second.travel_speed_m_s
        for sample, behind in insertion.later:
            self._wait(sample, behind + insertion.passed)

    def insert_waiting(self) -> None:
        """Insert all late samples that wait."""
        while self._insertion is not None:
            self._insert()

    def _recompute(self, stamp_ns: int, late: Samples, *travels: journal.Travel) -> Applied:
        """Go back to a state before a late stamp, and compute the motion again with late samples and travel speeds.

        The next publication covers the motion from the earliest late stamp that was inserted since the previous
        publication.
        """
        corrected_ns = self.outputs.correct(stamp_ns, self.history.correction_limit_ns(stamp_ns))
        stamps, wrench = self._rewind(corrected_ns, *travels)
        earlier = int(stamps.searchsorted(corrected_ns))
        if earlier:
            self._advance(stamps[:earlier], wrench[:earlier], self._stock.new(earlier))
            self._store_snapshot(kept=False)
        self.outputs.begin_correction()
        stamps, wrench = np.append(stamps[earlier:], late[0]), np.append(wrench[earlier:], late[1], axis=0)
        order = stamps.argsort(kind="stable")
        return self._advance(stamps[order], wrench[order], self._stock.new(len(order)))

    def _rewind(self, stamp_ns: int, *more: journal.Travel) -> Samples:
        """Go back to the newest snapshot before `stamp_ns`; return the samples after the snapshot.

        The travel speeds after the snapshot and the speeds `more` are scheduled for their stamps again.
        """
        data, samples, travels = self.history.rewind(stamp_ns)
        advances, pending, slow = self._advances, self._travels, self.outputs.slow_before
        self._restore(data)
        self._advances, self.outputs.slow_before = advances, slow
        if self.following is not None:
            # if a pose or an estimate had an effect before it became known, the motion would depend on how far the
            # session goes back
            measured, self._measured = self._measured, deque()
            for measurement in measured:
                if measurement.number > self.following.added:
                    self.follow(measurement.stamp_ns, measurement.entry, measurement.known)
                else:
                    self._measured.append(measurement)
        # a speed with the stamp of the snapshot may occur twice
        by_stamp = {travel.stamp_ns: travel for travel in (*self._travels, *travels, *pending, *more)}
        self._travels = sorted(by_stamp.values(), key=lambda travel: travel.stamp_ns)
        return samples

    def _apply_hold(self, entry: journal.Hold | journal.Unload) -> Rows:
        stamp_ns = entry.stamp_ns
        if self.stamp_ns is not None and stamp_ns < self.stamp_ns:
            raise ValueError(f"stamp: got {stamp_ns} ns, expected at least the time reached, {self.stamp_ns} ns")
        self.emit(entry)
        self.insert_waiting()
        if self._sampled:
            self._suspend_wear()
        while self._travels and self._travels[0].stamp_ns <= stamp_ns:
            travel = self._travels.pop(0)
            if not self._sampled and self.stamp_ns is not None and travel.stamp_ns > self.stamp_ns:
                self._move(travel.stamp_ns, _NO_LOAD)
            self._set_speed(travel)
        load = _NO_LOAD if isinstance(entry, journal.Unload) else self.twin.wrench[None]
        rows = self._move(stamp_ns, load)
        self._count(1)
        return rows

    def _move(self, stamp_ns: int, wrench: Array) -> Rows:
        return self._advance_part(np.array([stamp_ns]), wrench, self._stock.new(1), NONE, NONE, stored=False).rows

    def _suspend_wear(self) -> None:
        if not self.held:
            self._store_snapshot()
            self.held = True
            if self._wears:
                self.twin.set_travel_speed(0.0)

    def _resume_wear(self) -> bool:
        """Resume the wear of the pads after a held load; return whether the load was held."""
        held, self.held = self.held, False
        if held and self._wears:
            self.twin.set_travel_speed(self.travel_speed_m_s)
        return held

    def schedule(self, travel: journal.Travel) -> None:
        """Let a travel speed wait for its stamp."""
        insort(self._travels, travel, key=lambda item: item.stamp_ns)

    def _apply_travel(self, travel: journal.Travel) -> None:
        newest_ns, oldest_ns = self.history.newest_sample_ns, self.history.oldest_ns
        if not self._wears:
            self.travel_speed_m_s = travel.speed_m_s
        elif self.stamp_ns is None:
            # no advance has been made yet, so the speed takes effect at once
            self._use_speed(travel.speed_m_s)
        elif travel.stamp_ns > self.stamp_ns:
            self.schedule(travel)
            self._pass_on(travel)
        elif oldest_ns is not None and travel.stamp_ns <= oldest_ns:
            # a speed older than all stored states takes effect at the newest sample or, without samples, at the oldest
            # stored state
            applied = journal.Travel(oldest_ns if newest_ns is None else newest_ns, travel.speed_m_s)
            self._set_speed(applied)
            self._pass_on(applied)
        elif newest_ns is None or oldest_ns is None or travel.stamp_ns >= newest_ns:
            self._set_speed(travel)
            self._pass_on(travel)
        else:
            self.insert_waiting()
            self._recompute(travel.stamp_ns, NO_SAMPLES, travel)

    def _pass_on(self, travel: journal.Travel) -> None:
        if self._insertion is not None:
            self._insertion.add_travel(travel)

    def _set_speed(self, travel: journal.Travel) -> None:
        self.history.add_travel(travel)
        self._use_speed(travel.speed_m_s)

    def _use_speed(self, speed_m_s: float) -> None:
        self.travel_speed_m_s = speed_m_s
        if not self.held:
            self.twin.set_travel_speed(self.travel_speed_m_s)

    def _count(self, advances: int) -> None:
        before, self._advances = self._advances, self._advances + advances
        if before // DIGEST_INTERVAL != self._advances // DIGEST_INTERVAL and self.stamp_ns is not None:
            self.emit(journal.Digest(self.stamp_ns, self.twin.digest()))

    def _store_snapshot(self, *, kept: bool = True, resumed: bool = False) -> None:
        if self.stamp_ns is not None:
            self.history.add_snapshot(self.stamp_ns, self.snapshot().data, kept=kept, resumed=resumed)

    def _renew_history(self) -> None:
        self._clear_history()
        if not self.held:
            self._store_snapshot()

    def _clear_history(self) -> None:
        self.history.clear()
        self._measured.clear()

    def _restart(self, wear_depth: Array) -> None:
        self._end_motion()
        self.wear_depth = wear_depth.copy()
        self.twin.reset(0.0, wear_depth=wear_depth)

    def _end_motion(self) -> None:
        """End the present motion: apply all waiting travel speeds, and drop the history and all unpublished data."""
        self._resume_wear()
        for travel in self._travels:
            self._set_speed(travel)
        self.outputs.restart()
        self._clear_history()
        self._travels = []
        self.origin_ns = self.stamp_ns = None

    def _begin(self, stamp_ns: int) -> int:
        origin_ns = stamp_ns - round(self.twin.time * 1e9)
        if self.following is not None:
            self.following.begin_at(origin_ns)
        return origin_ns

    def _apply_model(self, entry: journal.SetModel) -> None:
        changes = read_changes(entry.changes)
        twin = self._changed_twin(changes)
        self.emit(entry)
        self.insert_waiting()
        before, speed = self.twin, 0.0 if self.held else self.travel_speed_m_s
        self._use(twin)
        self._carry(before)
        self.changes = changes
        if self._wears:
            self.twin.set_travel_speed(speed)
        self.outputs.scene = self.twin.scene
        self.outputs.set_shift(_NO_SHIFT)
        self._renew_history()

    def _changed_twin(self, changes: Mapping[str, float]) -> Driven:
        """Return a twin of the scene with changed numbers.

        Raise `ArgumentError` if the changes, or a present or waiting travel speed in the changed scene, are impossible.
        """
        twin = changed_twin(self.twin, self._scene, changes)
        for speed in (self.travel_speed_m_s, *(travel.speed_m_s for travel in self._travels)):
            check_travel_speed(twin.scene, speed)
        return twin

    def _carry(self, before: Driven) -> None:
        now = before.advance(before.time)
        self.twin.reset(before.time, wear_depth=self.wear_depth, pose=(now.q, now.v))
        if self._sampled:
            self.twin.advance(before.time, before.wrench)

    def _restore_motion(self, data: bytes) -> None:
        """Restore the motion from a snapshot, but neither the wear nor changed numbers of the scene."""
        state = SessionState.unpack(data)
        twin_data, changes = self._split_changes(state.twin)
        learned = None if self.following is None else self.following.learned(self.origin_ns)
        self._end_motion()
        if changes == self.changes and (state.wear_depth == self.wear_depth).all():
            self.twin.restore(twin_data)
        else:
            saved = self.twin.like(changed_scene(self._scene, changes))
            saved.restore(twin_data)
            self._carry(saved)
        if self.following is not None and learned is not None:
            self.following.learn(learned)
        if self._wears:
            self.twin.set_travel_speed(self.travel_speed_m_s)

    def _split_changes(self, data: bytes) -> tuple[bytes, dict[str, float]]:
        size = len(self.twin.snapshot()) if self.following is None else self.following.snapshot_size(data)
        return split_changes(data, size)

    def _restore(self, data: bytes) -> None:
        state = SessionState.unpack(data)
        twin_data, changes = self._split_changes(state.twin)
        if changes != self.changes:
            self._use(changed_twin(self.twin, self._scene, changes))
            self.changes = changes
            self.outputs.scene = self.twin.scene
        self.twin.restore(twin_data)
        self.outputs.set_state(state.outputs)
        self.wear_depth, self._travels = state.wear_depth, state.travels
        if state.origin_ns is not None:
            self.origin_ns = state.origin_ns
        self.stamp_ns, self._advances = state.stamp_ns, state.advances
        self.held, self.travel_speed_m_s = state.held, state.travel_speed_m_s


def _all_finite(rows: Rows) -> bool:
    return Published(rows, NOTHING.slow).finite and bool(np.isfinite(rows["wear_depth"]).all())


def warm_up() -> None:
    """Compile the functions that process samples and make publications, or load them from the cache on disk."""
    outputs.warm_up()
    model_times(np.zeros(1, np.int64), 0, np.zeros(1))
