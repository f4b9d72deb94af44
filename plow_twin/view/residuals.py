"""Residuals of a run, which are the measured poses in the journal minus the poses of the model at the same stamps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plow_twin.record.rows import Rows, poses_of
from plow_twin.stream.journal import Pose
from plow_twin.view.columns import Array, Indexes

#: Factor from m and rad to mm and mrad.
_SCALE = 1e3


class Residuals:
    """Comparison of measured poses with linearly interpolated poses of the model."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, int, tuple[float, ...]]] = []
        self._last: tuple[int, Array] | None = None

    def compare(self, poses: Sequence[tuple[int, Pose]], steps: Indexes, head: Rows) -> tuple[Indexes, Indexes, Array]:
        """Return stamps [ns], steps and residuals x, y [mm], theta [mrad], shape (n, 3).

        Each item of `poses` is the index of a journal entry and its pose; `steps` contains the step of each journal
        entry. `head` has rows of `head_state`. A pose beyond the last row of `head` is compared at a later call.
        """
        self._waiting += [(pose.stamp_ns, max(int(steps[place]), 0), pose.pose) for place, pose in poses]
        stamps, predicted = head.stamp_ns, poses_of(head.numbers)
        if self._last is not None and len(stamps) and self._last[0] < stamps[0]:
            stamps = np.concatenate(([self._last[0]], stamps))
            predicted = np.concatenate((self._last[1][None], predicted))
        if not len(stamps):
            return stamps, stamps, np.zeros((0, 3))
        self._last = int(stamps[-1]), predicted[-1]
        ready = [pose for pose in self._waiting if stamps[0] <= pose[0] <= stamps[-1]]
        self._waiting = [pose for pose in self._waiting if pose[0] > stamps[-1]]
        at = np.array([pose[0] for pose in ready], np.int64)
        rising = np.maximum.accumulate(stamps) - stamps[0]
        model = np.stack([np.interp(at - stamps[0], rising, column) for column in predicted.T], axis=1)
        measured = np.array([pose[2] for pose in ready]).reshape(-1, 3)
        return at, np.array([pose[1] for pose in ready], np.int64), _SCALE * (measured - model)
