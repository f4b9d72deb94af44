"""Windows for the sliding estimate, formed from samples and poses as they come.

Which windows there are follows from the stamps alone: each ends at a multiple of the interval and is formed once the
newest sample of the load is later by the time that late ones are waited for. So the order of arrival within that time
changes nothing, and the journal gives the same windows as the live node.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.gaps import Gaps
from plow_twin.estimate.measurements import (
    FEWEST_POSES,
    LONGEST_GAP_S,
    UNSTATED,
    Deviation,
    Load,
    Poses,
    believed,
    own_deviations,
)
from plow_twin.model.pairs import PAIR_COUNT

Array = NDArray[np.float64]
#: A stamp in ns and what was measured.
Row = tuple[int, tuple[float, ...]]

#: Most poses, and gaps, that are kept: more come where the load has stopped, or another clock is ahead by hours.
MOST_KEPT = 600_000
#: Share of the window's full length from which on it is worth an estimate.
LEAST_SHARE = 0.5
#: The same of early windows: a load period of a window of ten; and how much longer the next one is.
EARLY_SHARE, EARLY_GROWTH = 0.1, 1.5


@dataclass(frozen=True, eq=False)
class Window:
    """What was measured in [start_ns, end_ns); times in s count from `start_ns`.

    samples, poses : numbers of rows as they came, before any is left out, `poses` those of gaps too
    lost : rows left out
    gaps : None where none were measured
    """

    start_ns: int
    end_ns: int
    load: Load
    pose: Poses
    samples: int
    poses: int
    lost: int
    gaps: Gaps | None = None


class Windows:
    """Collect samples and poses, and form a window whenever one is due.

    Parameters
    ----------
    length_s, interval_s, wait_s : float
        Full length of a window, distance of their ends, and how long late data are waited for, in s.
    poses, load : tuple of 3 float
        Stated deviations of what is measured; that of the load until another one is stated, that of the poses where
        they bring no larger one.
    gaps : float
        Stated deviation of a gap sensor in m.
    early : bool
        Form shorter windows too, from `EARLY_SHARE` of the length on, until there are longer ones.
    """

    def __init__(
        self,
        length_s: float,
        interval_s: float,
        wait_s: float,
        poses: Deviation = UNSTATED,
        load: Deviation = UNSTATED,
        gaps: float = 0.0,
        early: bool = False,
    ) -> None:
        self._early = early
        self._pose_deviation, self._load_deviation, self._gaps_deviation = poses, load, gaps
        self._length_ns, self._interval_ns = round(length_s * 1e9), round(interval_s * 1e9)
        self._wait_ns = round(wait_s * 1e9)
        self.restart()

    def restart(self) -> None:
        """Forget everything: stamps or machine are other ones from now on."""
        self._loads: list[Row] = []
        self._poses: deque[tuple[int, tuple[float, ...], tuple[float, ...]]] = deque(maxlen=MOST_KEPT)
        self._gaps: deque[tuple[int, tuple[int, ...], tuple[float, ...]]] = deque(maxlen=MOST_KEPT)
        self._newest_ns: int | None = None
        self._end_ns: int | None = None
        self._first_ns: int | None = None

    def take_spread(self, deviation: Deviation) -> None:
        """Take in how well the load is known from here on: Fx, Fy [N], M [N m]."""
        self._load_deviation = deviation

    def take_pose(self, stamp_ns: int, q: tuple[float, ...], deviation: tuple[float, ...] = ()) -> None:
        """Take in a measured pose x, y [m], theta [rad], NaN where not measured, with its deviations if known."""
        self._poses.append((stamp_ns, q, deviation))

    def take_gaps(self, stamp_ns: int, pairs: tuple[int, ...], gaps: tuple[float, ...]) -> None:
        """Take in measured gaps in m of the pairs with these numbers."""
        self._gaps.append((stamp_ns, pairs, gaps))

    def take_load(self, stamp_ns: int, wrench: tuple[float, ...]) -> Window | None:
        """Take in a sample of the load Fx, Fy [N], M [N m]; return the window that is due now, if one is."""
        self._loads.append((stamp_ns, wrench))
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            return None
        self._newest_ns = stamp_ns
        end_ns = (stamp_ns - self._wait_ns) // self._interval_ns * self._interval_ns
        if self._early:
            end_ns = max(end_ns, self._early_end(stamp_ns))
        if self._end_ns is None:
            self._end_ns = end_ns
        if end_ns <= self._end_ns:
            return None
        self._end_ns = end_ns
        return self._form(end_ns)

    def _early_end(self, stamp_ns: int) -> int:
        """Return the end of the longest early window that is due; they count from the first sample."""
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        span, end_ns = EARLY_SHARE * self._length_ns, self._first_ns
        while span < LEAST_SHARE * self._length_ns and self._first_ns + round(span) <= stamp_ns - self._wait_ns:
            end_ns = self._first_ns + round(span)
            span *= EARLY_GROWTH
        return end_ns

    def _form(self, end_ns: int) -> Window | None:
        start_ns = end_ns - self._length_ns
        # what is older than this window is in none of those to come
        self._loads = [row for row in self._loads if row[0] >= start_ns]
        self._poses = deque((row for row in self._poses if row[0] >= start_ns), MOST_KEPT)
        self._gaps = deque((row for row in self._gaps if row[0] >= start_ns), MOST_KEPT)
        stamps = np.sort(np.array([row[0] for row in self._loads if row[0] < end_ns], dtype=np.int64))
        gaps = np.flatnonzero(np.diff(stamps) > LONGEST_GAP_S * 1e9)
        if len(gaps):
            start_ns = int(stamps[gaps[-1] + 1])
        elif len(stamps):
            start_ns = max(start_ns, int(stamps[0]))
        poses = [row for row in self._poses if start_ns <= row[0] < end_ns]
        measured = [row for row in self._gaps if start_ns <= row[0] < end_ns]
        most = max(len(poses), len(measured))
        least = EARLY_SHARE if self._early else LEAST_SHARE
        if end_ns - start_ns < least * self._length_ns or most < FEWEST_POSES or len(stamps) < 2:
            return None
        rows = [row for row in self._loads if start_ns <= row[0] < end_ns]
        load, lost_load = Load.of(*_table(rows, start_ns), self._load_deviation)
        times, q = _table([(stamp, values) for stamp, values, _ in poses], start_ns)
        own = own_deviations(brought for _, _, brought in poses)
        q, deviation = believed(self._pose_deviation, q, own)
        pose, lost_poses = Poses.of(times, q, deviation)
        tabled, lost_gaps = self._table_of_gaps(measured, start_ns)
        lost = lost_load + lost_poses + lost_gaps
        return Window(start_ns, end_ns, load, pose, len(rows), len(poses) + len(measured), lost, tabled)

    def _table_of_gaps(
        self, rows: list[tuple[int, tuple[int, ...], tuple[float, ...]]], start_ns: int
    ) -> tuple[Gaps | None, int]:
        if not rows:
            return None, 0
        table = np.full((len(rows), PAIR_COUNT), np.nan)
        for index, (_, pairs, values) in enumerate(rows):
            table[index, list(pairs)] = values
        stamps = np.array([row[0] for row in rows], dtype=np.int64)
        return Gaps.of(np.multiply(stamps - start_ns, 1e-9, dtype=np.float64), table, self._gaps_deviation)


def _table(rows: list[Row], start_ns: int) -> tuple[Array, Array]:
    """Return times in s, shape (n,), and values, shape (n, 3)."""
    stamps = np.array([row[0] for row in rows], dtype=np.int64)
    values = np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3)
    return np.multiply(stamps - start_ns, 1e-9, dtype=np.float64), values
