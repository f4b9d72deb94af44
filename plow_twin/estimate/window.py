"""Windows of the sliding estimate, formed from arriving samples and poses.

Each window ends at a multiple of the interval between windows. It is formed as soon as a load sample arrives with a
stamp later than its end plus the waiting time for late data. The order of arrival within the waiting time has no
effect, so a replay of the journal gives the same windows as the live node. If no load arrives for half of a window's
length, windows are formed from poses alone.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.gaps import Gaps
from plow_twin.estimate.measurements import (
    FEWEST_POSES,
    UNSTATED,
    Deviation,
    Load,
    Poses,
    own_deviations,
    without_uncertain,
)
from plow_twin.model.pairs import PAIR_COUNT

Array = NDArray[np.float64]
#: A stamp in ns and the measured values.
Row = tuple[int, tuple[float, ...]]
#: A stamp in ns, the measured pose, and the standard deviations of the pose, or an empty tuple.
_Pose = tuple[int, tuple[float, ...], tuple[float, ...]]

#: Upper bound on the number of stored poses and of stored rows of gaps, for a stopped load or a wrong clock.
MOST_KEPT = 600_000


@dataclass(frozen=True, eq=False)
class Window:
    """Measurements in the window [start_ns, end_ns), with times in s after `start_ns`.

    samples : number of received load samples
    poses : number of received poses and rows of gaps
    lost : number of rows that are left out
    gaps : measured gaps; None without gaps
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
    """Collect samples and poses, and form windows.

    Parameters
    ----------
    length_s, interval_s, wait_s : float
        Full length of a window, interval between the ends of successive windows, and waiting time for late data in s.
    poses : tuple of 3 float
        Lower limit of the standard deviation of the poses.
    load : tuple of 3 float
        Standard deviation of the load until `set_load_deviation` is called.
    gaps : float
        Standard deviation of the constant error of a gap sensor in m, 0 if unknown.
    early : bool
        Whether shorter windows are formed at the beginning, the first with the share `tuning.WINDOW_SHARES[1]` of the
        full length, each with at least the share `tuning.NEW_MOTION` of new motion.
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
        """Drop all data, for example after a jump of the stamps."""
        self._loads: list[Row] = []
        self._poses: deque[_Pose] = deque(maxlen=MOST_KEPT)
        self._gaps: deque[tuple[int, tuple[int, ...], tuple[float, ...]]] = deque(maxlen=MOST_KEPT)
        #: length [s] of the newest checked window, and the larger number of its poses and rows of gaps
        self._last_extent = (0.0, 0)
        self._newest_ns: int | None = None
        self._end_ns: int | None = None
        self._first_ns: int | None = None
        #: stamp [ns] of the first pose that arrived after the newest sample of the load
        self._silent_ns: int | None = None
        #: end [ns] of the newest formed window
        self._formed_ns: int | None = None

    def set_load_deviation(self, deviation: Deviation) -> None:
        """Set the standard deviation of the load (Fx, Fy [N], M [N m]) from now on."""
        self._load_deviation = deviation

    def add_pose(self, stamp_ns: int, q: tuple[float, ...], deviation: tuple[float, ...] = ()) -> Window | None:
        """Add a measured pose (x, y [m], theta [rad]) and its standard deviations; a missing component is NaN.

        Return a window of poses if one is due because no load arrives.
        """
        self._poses.append((stamp_ns, q, deviation))
        self._silent_ns = stamp_ns if self._silent_ns is None else self._silent_ns
        end_ns = (stamp_ns - self._wait_ns) // self._interval_ns * self._interval_ns
        if end_ns - self._silent_ns < tuning.WINDOW_SHARES[0] * self._length_ns:
            return None
        if self._end_ns is not None and end_ns <= self._end_ns:
            return None
        window = self._without_load(max(self._silent_ns, end_ns - self._length_ns), end_ns)
        self._end_ns = self._end_ns if window is None else end_ns
        return window

    def add_gaps(self, stamp_ns: int, pairs: tuple[int, ...], gaps: tuple[float, ...]) -> None:
        """Add measured gaps in m of the pairs with the indices `pairs`."""
        self._gaps.append((stamp_ns, pairs, gaps))

    def add_load(self, stamp_ns: int, wrench: tuple[float, ...]) -> Window | None:
        """Add a sample of the load (Fx, Fy [N], M [N m]); return a window if one has become due."""
        self._loads.append((stamp_ns, wrench))
        self._silent_ns = None
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            return None
        self._newest_ns = stamp_ns
        end_ns = (stamp_ns - self._wait_ns) // self._interval_ns * self._interval_ns
        if self._early:
            end_ns = max(end_ns, self._early_end(stamp_ns))
        if self._end_ns is None:
            self._end_ns = end_ns
        if end_ns <= self._end_ns or self._is_hardly_new(end_ns):
            return None
        self._end_ns = end_ns
        window = self._form(end_ns)
        self._formed_ns = self._formed_ns if window is None else end_ns
        return window

    def last(self) -> Window | str:
        """Return the last window, which ends at the newest sample, or a message why no window can be formed."""
        if self._newest_ns is None:
            return "got no load"
        window = self._form(self._newest_ns + 1)
        if window is not None:
            return window
        span_s, rows = self._last_extent
        least_s = tuning.WINDOW_SHARES[self._early] * self._length_ns * 1e-9
        return (
            f"got {span_s:.3g} s of load without a gap and {rows} poses or gaps in them, expected at least "
            f"{least_s:.3g} s and {FEWEST_POSES}"
        )

    def _early_end(self, stamp_ns: int) -> int:
        """Return the end [ns] of the longest early window that is due; early windows begin at the first sample."""
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        least, early, growth = tuning.WINDOW_SHARES
        span, end_ns = early * self._length_ns, self._first_ns
        while span < least * self._length_ns and self._first_ns + round(span) <= stamp_ns - self._wait_ns:
            end_ns = self._first_ns + round(span)
            span *= growth
        return end_ns

    def _is_hardly_new(self, end_ns: int) -> bool:
        if not self._early or self._formed_ns is None or self._first_ns is None:
            return False
        span = end_ns - self._first_ns
        is_short = span < tuning.WINDOW_SHARES[0] * self._length_ns
        return is_short and end_ns - self._formed_ns < tuning.NEW_MOTION * span

    def _form(self, end_ns: int) -> Window | None:
        start_ns = end_ns - self._length_ns
        # later windows need no older rows
        self._loads = [row for row in self._loads if row[0] >= start_ns]
        self._poses = deque((row for row in self._poses if row[0] >= start_ns), MOST_KEPT)
        self._gaps = deque((row for row in self._gaps if row[0] >= start_ns), MOST_KEPT)
        stamps = np.sort(np.array([row[0] for row in self._loads if row[0] < end_ns], dtype=np.int64))
        gaps = np.flatnonzero(np.diff(stamps) > tuning.LONGEST_GAP[0] * 1e9)
        if len(gaps):
            start_ns = int(stamps[gaps[-1] + 1])
        elif len(stamps):
            start_ns = max(start_ns, int(stamps[0]))
        poses = [row for row in self._poses if start_ns <= row[0] < end_ns]
        measured = [row for row in self._gaps if start_ns <= row[0] < end_ns]
        most = max(len(poses), len(measured))
        self._last_extent = (end_ns - start_ns) * 1e-9, most
        least = tuning.WINDOW_SHARES[self._early]
        if end_ns - start_ns < least * self._length_ns or most < FEWEST_POSES or len(stamps) < 2:
            return None
        rows = [row for row in self._loads if start_ns <= row[0] < end_ns]
        load, lost_load = Load.of(*_table(rows, start_ns), self._load_deviation)
        pose, lost_poses = self._table_of_poses(poses, start_ns)
        tabled, lost_gaps = self._table_of_gaps(measured, start_ns)
        lost = lost_load + lost_poses + lost_gaps
        return Window(start_ns, end_ns, load, pose, len(rows), len(poses) + len(measured), lost, tabled)

    def _without_load(self, start_ns: int, end_ns: int) -> Window | None:
        poses = [row for row in self._poses if start_ns <= row[0] < end_ns]
        if len(poses) < FEWEST_POSES:
            return None
        pose, lost = self._table_of_poses(poses, start_ns)
        return Window(start_ns, end_ns, Load.unmeasured((end_ns - start_ns) * 1e-9), pose, 0, len(poses), lost)

    def _table_of_poses(self, rows: list[_Pose], start_ns: int) -> tuple[Poses, int]:
        times, q = _table([(stamp, values) for stamp, values, _ in rows], start_ns)
        q, deviation = without_uncertain(
            self._pose_deviation, q, own_deviations(deviations for _, _, deviations in rows)
        )
        return Poses.of(times, q, deviation)

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
    stamps = np.array([row[0] for row in rows], dtype=np.int64)
    values = np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3)
    return np.multiply(stamps - start_ns, 1e-9, dtype=np.float64), values
