"""Insertion of late samples into the motion of many twins that are advanced together.

The twins cannot repeat the motion since a late sample before the next sample arrives. They go on without the late
sample, while a second set of twins repeats the motion with it, a part with each new sample. After a number of new
samples that follows from counts of samples in the journal alone, the second set replaces the first one. A replay
therefore replaces the twins at the same sample.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np

from plow_twin.solve.state import ROW
from plow_twin.stream.driven import Following
from plow_twin.stream.history import NO_SAMPLES, History, Samples
from plow_twin.stream.journal import Estimated, PartOfPose, Pose, Sample, Travel
from plow_twin.stream.outputs import Array, Integers, Outputs, Rows

#: Product of twins and samples in one part of the repeated motion, and number of new samples for each part. With 128
#: twins and poses at 100 Hz, a part has ten samples and takes 2 ms, a snapshot of the second set after every two parts
#: 0.6 ms, and a new sample 0.4 ms. Five new samples with a part thus take less than the 5 ms that they have at 1 kHz.
MEMBER_SAMPLES: Final = 1280
STRIDE: Final = 5
#: Number of new samples until the second set of twins begins to repeat the motion: it is drawn in five parts before.
#: Samples that are late meanwhile are inserted together.
GATHERED: Final = 6


def samples_at_once(members: int) -> int:
    """Return how many samples a set of twins repeats at once; more than the new samples, so that the set catches up."""
    return max(STRIDE + 1, MEMBER_SAMPLES // members)


class Repeating(Protocol):
    """Session that repeats the motion."""

    history: History
    outputs: Outputs

    def advance(self, stamps: Integers, wrench: Array, rows: Rows | None, /) -> Any:
        """Advance to samples, as `Session.advance` does."""

    def catch_up(self) -> None:
        """Advance all twins to the time of the first one, as `Session.catch_up` does."""

    def follow(self, stamp_ns: int, entry: Pose | PartOfPose | Estimated, known: float, /) -> None:
        """Use a pose or an estimate, as `Session.follow` does."""

    def schedule(self, travel: Travel, /) -> None:
        """Let a travel speed wait for its stamp, as `Session.schedule` does."""


Second = TypeVar("Second", bound=Repeating)


class Insertion(Generic[Second]):
    """Late samples that wait, and a second session that repeats the motion with them.

    Parameters
    ----------
    twin : Following
        Result of `Following.second`.
    go_back : callable
        Function that returns a second session of a twin, which has gone back to a state before a given stamp [ns], the
        stamp [ns] at which the repeated motion changes, and the samples to repeat.

    Attributes
    ----------
    passed : int
        Number of new samples since the first late sample.
    later : list of (Sample, int)
        Late samples that cannot be inserted together with the first ones, because the repeated motion has perhaps
        passed their stamps; each with the number of samples to repeat, minus `passed`, when it arrived.
    """

    def __init__(self, twin: Following, go_back: Callable[[Following, int], tuple[Second, int, Samples]]) -> None:
        self._twin, self._go_back = twin, go_back
        self._at_once = samples_at_once(twin.members)
        self._late: list[Sample] = []
        self.later: list[tuple[Sample, int]] = []
        self.passed = 0
        #: numbers of new samples whose work is done, and up to the end of the insertion
        self._worked = self._end = 0
        #: number of samples to repeat, minus the number of new samples when they were counted
        self._behind = 0
        self._second: Second | None = None
        self._changed_ns: int | None = None
        #: samples that the second session has not applied
        self._stamps, self._wrench = NO_SAMPLES

    @property
    def waiting(self) -> int:
        """Number of late samples that have not been inserted."""
        return len(self._late) + len(self.later)

    @property
    def left(self) -> int:
        """Number of new samples until the second session replaces the motion of the first one."""
        return self._end - self.passed

    def add_late(self, sample: Sample, repeated: int) -> None:
        """Add a late sample, for which `repeated` samples must be applied again."""
        if self.passed >= GATHERED:
            self.later.append((sample, repeated - self.passed))
            return
        self._late.append(sample)
        self._behind = max(self._behind, repeated - self.passed)
        count = self._behind + GATHERED + len(self._late)
        # new samples are repeated too
        self._end = GATHERED + STRIDE * -(-count // (self._at_once - STRIDE))

    def add(self, stamps: Integers, wrench: Array) -> None:
        """Add new samples, which the first session has applied."""
        self.passed += len(stamps)
        if self._second is not None:
            self._queue(stamps, wrench)

    def add_measured(self, entry: Pose | PartOfPose | Estimated, stamp_ns: int, known: float) -> None:
        """Add a pose or an estimate with the arguments of `Session.follow`."""
        if self._second is not None:
            self._second.follow(stamp_ns, entry, known)

    def add_travel(self, travel: Travel) -> None:
        """Add a travel speed with a stamp that the second session has not passed."""
        if self._second is not None:
            self._second.schedule(travel)

    def work(self) -> None:
        """Do the work that belongs to the newest samples. A second call without new samples repeats no motion."""
        before, self._worked = self._worked, self.passed
        if self.passed < GATHERED:
            for _ in range(before, self.passed):
                self._twin.draw_piece()
        elif self._second is None:
            self._begun()
        elif (self.passed - GATHERED) // STRIDE > (before - GATHERED) // STRIDE:
            # the rest is divided equally among the remaining parts
            count = -(-(len(self._stamps) + self.left) // (self.left // STRIDE + 1))
            self._repeat(self._second, min(count, len(self._stamps)))
        else:
            self._second.catch_up()

    def finish(self) -> Second:
        """Do all the rest of the work, and return the second session."""
        second = self._begun()
        self._repeat(second, len(self._stamps))
        return second

    def _begun(self) -> Second:
        if self._second is None:
            late = sorted(self._late, key=lambda sample: sample.stamp_ns)
            self._second, self._changed_ns, samples = self._go_back(self._twin, late[0].stamp_ns)
            self._queue(*samples)
            self._queue(np.array([sample.stamp_ns for sample in late]), np.array([sample.wrench for sample in late]))
        return self._second

    def _queue(self, stamps: Integers, wrench: Array) -> None:
        stamps, wrench = np.append(self._stamps, stamps), np.append(self._wrench, wrench, axis=0)
        order = stamps.argsort(kind="stable")
        self._stamps, self._wrench = stamps[order], wrench[order]

    def _repeat(self, second: Second, count: int) -> None:
        """Repeat `count` samples.

        The part may be shorter or longer by half, so that it ends where a snapshot is due. The snapshot is taken after
        the next new sample, which has more time.
        """
        done = 0
        while done < count:
            end = second.history.until_snapshot(self._stamps)
            if done + end > 1.5 * count:
                if done >= 0.5 * count:
                    return
                end = count - done
            if self._changed_ns is not None:
                unchanged = int(self._stamps.searchsorted(self._changed_ns))
                if not unchanged:
                    second.outputs.begin_correction()
                    self._changed_ns = None
                end = min(end, unchanged or end)
            stamps, wrench = self._stamps[:end].copy(), self._wrench[:end].copy()
            second.advance(stamps, wrench, np.zeros(end, ROW))
            self._stamps, self._wrench = self._stamps[end:], self._wrench[end:]
            done += end
