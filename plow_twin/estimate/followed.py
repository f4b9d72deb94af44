"""A measured stretch followed from its first row to its last, each row from what was measured up to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.estimate import Guess, estimate_window
from plow_twin.estimate.follow import MEMBERS, Followed, Follower, Span, in_turn
from plow_twin.estimate.gaps import Gaps
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import Estimate
from plow_twin.estimate.window import Window, Windows
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene

Array = NDArray[np.float64]

#: Length of the windows of the estimates and distance of their ends in s, as a node has them by default.
WINDOW_S, INTERVAL_S = 32.0, 10.0
_NS: Final = 1e9
#: Seconds of load that are advanced through at once: the rows of all members stay in the processor's cache.
_PART_S: Final = 0.02


@dataclass(frozen=True)
class TakenOver:
    """An estimate and the time in s from which on the twins are drawn from it, or as before where it says no more."""

    t: float
    estimate: Estimate
    taken: bool


@dataclass(frozen=True, eq=False)
class Stretch:
    """What was known at each time, the estimates on the way, and peaks and impulses span by span."""

    rows: Followed
    taken_over: list[TakenOver]
    spans: list[Span]


def follow(
    scene: Scene,
    load: Load,
    poses: Poses,
    members: int = MEMBERS,
    dt: float | None = None,
    *,
    gaps: Gaps | None = None,
    span: float | None = None,
    seed: int = 0,
) -> Stretch:
    """Return what is known at each sample of the load, or each `dt` s, from what was measured up to then.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    load, poses, gaps : Load, Poses, Gaps
        What was measured, on one clock. Times count from the load's first sample in the windows of the estimates.
    members : int
        Twins.
    dt : float, optional
        Distance of the rows in s; one at each sample of the load by default.
    span : float, optional
        Seconds over which peaks and impulses are told; none are by default.
    seed : int
        Of all that is drawn.
    """
    steps = _Steps(scene, load, poses, gaps, members, seed, span)
    parts = list(steps.rows(dt))
    whole = Followed(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    return Stretch(whole, steps.taken_over, steps.spans)


class _Steps:
    """The loop over the load: advance, take in what was measured meanwhile, estimate where a window is due."""

    def __init__(
        self, scene: Scene, load: Load, poses: Poses, gaps: Gaps | None, members: int, seed: int, span: float | None
    ) -> None:
        self._scene, self._load, self._poses, self._gaps = scene, load, poses, gaps
        self._start = float(load.t[0])
        self._follower = Follower(scene, members, start=self._start, seed=seed)
        deviation = 0.0 if gaps is None else gaps.deviation
        self._windows = Windows(WINDOW_S, INTERVAL_S, 0.0, poses.deviation, load.deviation, deviation, early=True)
        self._guess: Guess = ()
        #: rows on a grid so far, and gaps that were taken in
        self._count = self._gaps_taken = 0
        self._span = span
        self.taken_over: list[TakenOver] = []
        self.spans: list[Span] = []

    def rows(self, dt: float | None) -> Iterator[Followed]:
        """Yield what is known, part by part."""
        load, poses = self._load, self._poses
        for rows, used in in_turn(load.t, poses.t):
            for part in self._until_due(rows):
                yield from self._advance(load.t[part], load.wrench[part], dt)
                if self._span is not None and load.t[part][-1] >= self._start + (len(self.spans) + 1) * self._span:
                    self.spans.append(self._follower.span())
                self._take_gaps(float(load.t[part][-1]))
                for index in range(used.start, used.stop) if part.stop == rows.stop else ():
                    self._windows.take_pose(self._stamp(poses.t[index]), tuple(poses.q[index].tolist()))
                    self._follower.take_pose(float(poses.t[index]), poses.q[index])
                for time, sample in zip(load.t[part].tolist(), load.wrench[part].tolist(), strict=True):
                    window = self._windows.take_load(self._stamp(time), tuple(sample))
                    if window is not None:
                        self._estimate(window)

    def _until_due(self, rows: slice) -> Iterator[slice]:
        """Yield rows one by one where poses are rare: windows and rows of a grid are then between them."""
        step = max(1, int(np.searchsorted(self._load.t[rows], self._load.t[rows.start] + _PART_S)))
        for first in range(rows.start, rows.stop, step):
            yield slice(first, min(first + step, rows.stop))

    def _advance(self, t: Array, wrench: Array, dt: float | None) -> Iterator[Followed]:
        if dt is None:
            yield self._follower.advance(t, wrench)
            return
        for index in range(len(t)):
            while (due := self._start + self._count * dt) < t[index]:
                self._count += 1
                yield self._follower.held(due)
            now = self._follower.advance(t[index : index + 1], wrench[index : index + 1])
            if due == t[index]:
                self._count += 1
                yield now

    def _take_gaps(self, now: float) -> None:
        if self._gaps is None:
            return
        last = int(np.searchsorted(self._gaps.t, now, side="right"))
        for index in range(self._gaps_taken, last):
            there = np.flatnonzero(np.isfinite(self._gaps.gap[index]))
            values = tuple(self._gaps.gap[index, there].tolist())
            self._windows.take_gaps(self._stamp(self._gaps.t[index]), tuple(there.tolist()), values)
        self._gaps_taken = last

    def _stamp(self, t: float) -> int:
        return round((float(t) - self._start) * _NS)

    def _estimate(self, window: Window) -> None:
        found, following = estimate_window(self._scene, window.load, window.pose, window.lost, self._guess, window.gaps)
        taken = self._follower.take_estimate(found)
        self.taken_over.append(TakenOver(self._follower.time, found, taken))
        self._guess = following


def table(followed: Followed) -> tuple[list[str], Array]:
    """Return the names of the columns and the rows of `followed.csv`."""
    names, columns = ["t"], [followed.t]
    for index, pair in enumerate(PAIR_NAMES):
        names += [pair, f"{pair}/p05", f"{pair}/p95"]
        columns += [followed.force[:, index], followed.low[:, index], followed.high[:, index]]
    for index, axis in enumerate(("horizontal", "vertical")):
        names += [axis, f"{axis}/p05", f"{axis}/p95"]
        columns += list(followed.clearance[:, index].T)
    return names, np.column_stack(columns)
