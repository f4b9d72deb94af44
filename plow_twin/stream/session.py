"""The deterministic machine that the live node and a replay both drive: entries of the journal in, motion out."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from plow_twin.stream.journal import Digest, Entry, Hold, Loss, Parameter, Reset, Sample, Snapshot, Travel
from plow_twin.stream.outputs import Outputs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plow_twin.run.advance import Advance, AdvanceSeries
    from plow_twin.run.twin import MarkedAdvance, Twin

#: A digest follows each so many advances.
DIGEST_INTERVAL: Final = 100
_HEADER: Final = struct.Struct("<?qqq")


def _ignore(entry: Entry) -> None:
    """Drop an entry."""


class Session:
    """One run of a twin under a journal.

    The same entries in the same order give the same motion, the same publications (`outputs`) and the same digests, bit
    for bit, whatever the clock did meanwhile. Model time is (stamp - origin), the origin being the first stamp.

    Parameters
    ----------
    twin
        The twin to drive; nobody else may advance it.
    origin_ns
        Stamp of model time 0, or None: the first stamp.
    on_entry
        Receives each entry in order of time just before it is applied, and each digest after the advance that it
        covers. An entry that the twin then refuses (a number is not finite) has been emitted: a replay refuses it too.
    """

    def __init__(self, twin: Twin, origin_ns: int | None = None, on_entry: Callable[[Entry], object] = _ignore) -> None:
        self.twin = twin
        self.origin_ns = origin_ns
        #: the time that the model has reached [ns], None before the first stamp
        self.stamp_ns: int | None = None
        self.outputs = Outputs(twin.scene)
        self._on_entry = on_entry
        self._advances = 0

    def start(self) -> None:
        """Emit the snapshot that opens a journal."""
        self._on_entry(self.snapshot())

    def close(self) -> None:
        """Emit the digest that ends a journal."""
        if self.stamp_ns is not None:
            self._on_entry(Digest(self.stamp_ns, self.twin.digest()))

    def apply(self, entry: Entry) -> Advance | None:
        """Emit one entry, apply it, and return the advance when it made one.

        A digest or a loss says something about a journal and changes nothing: it is not emitted again.

        Raises
        ------
        ValueError
            The entry cannot be applied (its stamp lies before the time reached, a number is not finite); the
            motion is unchanged then.
        """
        match entry:
            case Sample(stamp_ns, wrench):
                return self._advance(entry, stamp_ns, wrench)
            case Hold(stamp_ns):
                return self._advance(entry, stamp_ns, None)
            case Travel(_, speed):
                self._on_entry(entry)
                self.twin.set_travel_speed(speed)
            case Reset():
                self._on_entry(entry)
                self._reset()
            case Parameter():
                # acts through the entries that follow it
                self._on_entry(entry)
            case Snapshot(_, data):
                self._on_entry(entry)
                self._restore(data)
            case Digest() | Loss():
                pass
        return None

    def apply_samples(self, samples: Sequence[Sample]) -> Iterator[AdvanceSeries]:
        """Apply samples of rising stamps in as few calls as digests allow; the same bits as `apply` for each.

        Yields the advances of one call after the other, each once it has been made.

        Raises
        ------
        ValueError
            As `apply`.
        """
        while samples:
            count = DIGEST_INTERVAL - self._advances % DIGEST_INTERVAL
            part, samples = samples[:count], samples[count:]
            yield self._advance_part(part)

    def snapshot(self) -> Snapshot:
        """Return the exact state of twin, outputs and session."""
        known = self.stamp_ns is not None
        header = _HEADER.pack(known, self.origin_ns or 0, self.stamp_ns or 0, self._advances)
        stamp_ns = self.stamp_ns if self.stamp_ns is not None else self.origin_ns or 0
        return Snapshot(stamp_ns, header + self.outputs.state() + self.twin.snapshot())

    def _advance(self, entry: Entry, stamp_ns: int, wrench: tuple[float, float, float] | None) -> Advance:
        if self.stamp_ns is not None and stamp_ns < self.stamp_ns:
            raise ValueError(f"stamp: got {stamp_ns} ns, expected at least the time reached, {self.stamp_ns} ns")
        self._on_entry(entry)
        if self.origin_ns is None:
            self.origin_ns = stamp_ns
        advance = self.twin.advance((stamp_ns - self.origin_ns) * 1e-9, wrench)
        self.stamp_ns = stamp_ns
        if not advance.status:
            self.outputs.add(stamp_ns, advance)
        self._advances += 1
        if self._advances % DIGEST_INTERVAL == 0:
            self._on_entry(Digest(stamp_ns, self.twin.digest()))
        return advance

    def _advance_part(self, samples: Sequence[Sample]) -> AdvanceSeries:
        stamps_ns = [sample.stamp_ns for sample in samples]
        before_ns = self.stamp_ns if self.stamp_ns is not None else stamps_ns[0]
        for stamp_ns, earlier_ns in zip(stamps_ns, (before_ns, *stamps_ns), strict=False):
            if stamp_ns < earlier_ns:
                raise ValueError(f"stamp: got {stamp_ns} ns, expected at least the time reached, {earlier_ns} ns")
        for sample in samples:
            self._on_entry(sample)
        if self.origin_ns is None:
            self.origin_ns = stamps_ns[0]
        origin_ns = self.origin_ns
        series = self.twin.advance_samples(
            [(stamp_ns - origin_ns) * 1e-9 for stamp_ns in stamps_ns], [sample.wrench for sample in samples]
        )
        self.stamp_ns = stamps_ns[-1]
        self.outputs.add_series(stamps_ns, series)
        self._advances += len(samples)
        if self._advances % DIGEST_INTERVAL == 0:
            self._on_entry(Digest(self.stamp_ns, self.twin.digest()))
        return series

    def advance_marked(
        self, stamps: NDArray[np.int64], wrench: NDArray[np.float64], marks: NDArray[np.int64], *, rows: bool = True
    ) -> MarkedAdvance:
        """Apply many samples at once for a replay: nothing is emitted, and `outputs` is left to the caller.

        Parameters
        ----------
        stamps : ndarray of int64, shape (n,)
            Never falling, the first not before the time reached [ns].
        wrench : ndarray, shape (n, 3)
        marks, rows
            As of `Twin.advance_marked`.

        Raises
        ------
        ValueError
            A sample cannot be applied; the motion is unchanged then.
        """
        reached = self.stamp_ns if self.stamp_ns is not None else int(stamps[0])
        if stamps[0] < reached or (stamps[1:] < stamps[:-1]).any():
            raise ValueError(f"stamp: expected stamps that do not fall, from {reached} ns on")
        origin = int(stamps[0]) if self.origin_ns is None else self.origin_ns
        done = self.twin.advance_marked(np.multiply(stamps - origin, 1e-9), wrench, marks, rows=rows)
        self.origin_ns, self.stamp_ns = origin, int(stamps[-1])
        self._advances += len(stamps)
        return done

    def restore(self, snapshot: Snapshot, pending: tuple[int, Advance] | None, origin_ns: int | None) -> None:
        """Go back to a snapshot, with what the next publication was to show (`Outputs.pending`); nothing is emitted."""
        self._restore(snapshot.data)
        self.origin_ns = origin_ns
        self.outputs.set_pending(pending)

    def _reset(self) -> None:
        self.twin.reset(0.0)
        self.outputs.restart()
        self.origin_ns = self.stamp_ns = None

    def _restore(self, data: bytes) -> None:
        known, origin_ns, stamp_ns, advances = _HEADER.unpack_from(data)
        split = _HEADER.size + self.outputs.state_size()
        self.twin.restore(data[split:])
        self.outputs.set_state(data[_HEADER.size : split])
        self.origin_ns = origin_ns if known else self.origin_ns
        self.stamp_ns = stamp_ns if known else None
        self._advances = advances
