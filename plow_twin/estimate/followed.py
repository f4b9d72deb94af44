"""Forces and clearances over recorded data, where each row depends only on earlier measurements."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.estimate import Guess, estimate_window
from plow_twin.estimate.follow import MEMBERS, Follower, Span
from plow_twin.estimate.gaps import Gaps
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import Estimate
from plow_twin.estimate.window import Window, Windows
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.solve.state import ROW
from plow_twin.stream.journal import Estimated, Pose
from plow_twin.stream.session import Session

Array = NDArray[np.float64]

#: Length of a window of the estimate in s, and time in s between the ends of successive windows; by definition the
#: defaults of the node.
WINDOW_S, INTERVAL_S = 32.0, 10.0
#: Nanoseconds per second, by definition.
_NS: Final = 1e9
#: Upper bound in s on the load that is processed in one call, so that all rows fit into the processor's cache.
_PART_S: Final = 0.02


@dataclass(frozen=True, eq=False)
class Followed:
    """Forces and clearances as functions of time, computed from earlier measurements only.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times in s.
    force, low, high : ndarray, shape (n, 8)
        Forces of the median twin, and lower and upper ends of their 90 % intervals, in N.
    clearance : ndarray, shape (n, 2, 3)
        Value, 5 % and 95 % quantile of the horizontal and of the vertical clearance in m.
    """

    t: Array
    force: Array
    low: Array
    high: Array
    clearance: Array

    @classmethod
    def of(cls, t: Array, rows: NDArray[np.void]) -> Followed:
        """Return forces and clearances from the rows of a follower."""
        clearance = rows["known_clearance"].reshape(-1, 2, 3)
        return cls(t, rows["force"], rows["force_low"], rows["force_high"], clearance)


@dataclass(frozen=True)
class TakenOver:
    """An estimate and the time in s at which it was finished; `taken` states whether twins were drawn from it."""

    t: float
    estimate: Estimate
    taken: bool


@dataclass(frozen=True, eq=False)
class Stretch:
    """Result of `follow`: the rows, the estimates, and the peaks and impulses of each span."""

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
    """Return forces and clearances at each sample of the load, or every `dt` s, computed from earlier measurements.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    load, poses, gaps : Load, Poses, Gaps
        Measurements with stamps of the same clock. In the estimates, times are counted from the first sample of the
        load.
    members : int
        Number of twins.
    dt : float, optional
        Interval of the rows in s; by default there is a row at each sample of the load.
    span : float, optional
        Duration in s of each span for which peaks and impulses are computed; by default there are no spans.
    seed : int
        Seed of the random numbers.
    """
    steps = _Steps(scene, load, poses, gaps, members, seed, span)
    parts = list(steps.rows(dt))
    whole = Followed(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    return Stretch(whole, steps.taken_over, steps.spans)


class _Steps:
    """Loop that passes the load and all measurements to a session in order of their stamps."""

    def __init__(
        self, scene: Scene, load: Load, poses: Poses, gaps: Gaps | None, members: int, seed: int, span: float | None
    ) -> None:
        self._scene, self._load, self._poses, self._gaps = scene, load, poses, gaps
        self._stamps, self._pose_stamps = (_stamps(part.t, load.t[0]) for part in (load, poses))
        self._follower = Follower(scene, members, seed=seed)
        self._follower.every_row = True
        self._session = Session(self._follower)
        deviation = 0.0 if gaps is None else gaps.deviation
        self._windows = Windows(WINDOW_S, INTERVAL_S, 0.0, poses.deviation, load.deviation, deviation, early=True)
        self._guess: Guess = ()
        #: numbers of rows on the grid of `dt`, of added poses and of added gaps
        self._count = self._poses_added = self._gaps_added = 0
        self._span = span
        #: number of draws of the members so far
        self._drawn = self._follower.drawn
        self.taken_over: list[TakenOver] = []
        self.spans: list[Span] = []

    def rows(self, dt: float | None) -> Iterator[Followed]:
        step = max(1, int(np.searchsorted(self._load.t, self._load.t[0] + _PART_S)))
        # there is no motion before the first sample
        for first in (0, *range(1, len(self._stamps), step)):
            part = slice(first, min(first + step, len(self._stamps)) if first else 1)
            if first:
                self._add_poses(self._stamps[part][-1])
            yield from self._advance(part, dt)
            if self._follower.drawn != self._drawn:
                self._drawn = self._follower.drawn
                self.taken_over[-1] = replace(self.taken_over[-1], taken=True)
            if self._span is not None and self._follower.time >= (len(self.spans) + 1) * self._span:
                self.spans.append(self._follower.span())
            self._add_gaps(float(self._load.t[part][-1]))
            stamps, samples = self._stamps[part].tolist(), self._load.wrench[part].tolist()
            for stamp, sample in zip(stamps, samples, strict=True):
                window = self._windows.add_load(stamp, tuple(sample))
                if window is not None:
                    self._estimate(window)

    def _add_poses(self, until_ns: int) -> None:
        last = int(np.searchsorted(self._pose_stamps, until_ns, side="right"))
        for index in range(self._poses_added, last):
            stamp, q = int(self._pose_stamps[index]), tuple(self._poses.q[index].tolist())
            self._session.apply(Pose(stamp, q))
            self._windows.add_pose(stamp, q)
        self._poses_added = max(last, self._poses_added)

    def _advance(self, part: slice, dt: float | None) -> Iterator[Followed]:
        t, stamps, wrench = self._load.t[part], self._stamps[part], self._load.wrench[part]
        if dt is None:
            yield Followed.of(t, self._session.advance(stamps, wrench, np.zeros(len(t), ROW)).rows)
            return
        for index in range(len(t)):
            while (due := float(self._load.t[0]) + self._count * dt) < t[index]:
                self._count += 1
                yield Followed.of(np.array([due]), self._follower.held(due - float(self._load.t[0])))
            interval = slice(index, index + 1)
            now = self._session.advance(stamps[interval], wrench[interval], np.zeros(1, ROW)).rows
            if due == t[index]:
                self._count += 1
                yield Followed.of(t[interval], now)

    def _add_gaps(self, now: float) -> None:
        if self._gaps is None:
            return
        last = int(np.searchsorted(self._gaps.t, now, side="right"))
        stamps = _stamps(self._gaps.t, self._load.t[0]).tolist()
        for index in range(self._gaps_added, last):
            finite = np.flatnonzero(np.isfinite(self._gaps.gap[index]))
            values = tuple(self._gaps.gap[index, finite].tolist())
            self._windows.add_gaps(stamps[index], tuple(finite.tolist()), values)
        self._gaps_added = last

    def _estimate(self, window: Window) -> None:
        result, following = estimate_window(
            self._scene, window.load, window.pose, window.lost, self._guess, window.gaps
        )
        bounds = window.start_ns, window.end_ns, window.samples, window.poses
        self._session.apply(Estimated(*bounds, self._guess, (0.0,) * 6, json.dumps(result.as_dict())))
        # twins are drawn `PREPARATION_S` later
        self.taken_over.append(TakenOver(self._follower.time, result, taken=False))
        self._guess = following


def _stamps(t: Array, start: float) -> NDArray[np.int64]:
    return np.round((t - start) * _NS).astype(np.int64)


def table(followed: Followed) -> tuple[list[str], Array]:
    """Return the column names of the file `followed.csv`, and its rows."""
    names, columns = ["t"], [followed.t]
    for index, pair in enumerate(PAIR_NAMES):
        names += [pair, f"{pair}/p05", f"{pair}/p95"]
        columns += [followed.force[:, index], followed.low[:, index], followed.high[:, index]]
    for index, axis in enumerate(("horizontal", "vertical")):
        names += [axis, f"{axis}/p05", f"{axis}/p95"]
        columns += list(followed.clearance[:, index].T)
    return names, np.column_stack(columns)
