"""Models of a sensor with a lever arm, and of a sensor with a low pass.

A sensor with a lever arm measures a point away from the centre of the head. A first-order low pass y of the pose u
obeys tau dy/dt = u - y. Its mean delay tau is part of the delay of the stamps. For a small tau, the remaining
difference is tau^2 / 2 times the acceleration.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.measurements import Poses, filled, interpolated

Array = NDArray[np.float64]

#: Number of rows of a parabola for the measured pose at the start of a swing, derived from the rows over which a slow
#: sensor smooths a kink of the motion.
_ROWS: Final = 7


def moved_by_lever(q: Array, v: Array, lever: Array) -> tuple[Array, Array]:
    """Return poses and rates, (n, 3) each, as a sensor with a lever arm measures them.

    `lever`, shape (2,), is the lever arm in m in the axes of the head. Its constant displacement at theta = 0 is
    subtracted.
    """
    c, s = np.cos(q[:, 2:]), np.sin(q[:, 2:])
    arm, across = lever, np.array([-lever[1], lever[0]])
    place, rate = q.copy(), v.copy()
    place[:, :2] += (c - 1.0) * arm + s * across
    rate[:, :2] += v[:, 2:] * (c * across - s * arm)
    return place, rate


class Memory:
    """Smoothed measured poses, which give the initial state of a low pass at the start of a swing."""

    def __init__(self, poses: Poses) -> None:
        q = filled(poses)
        rows = min(_ROWS, len(q))
        basis = np.vander(np.arange(rows) - rows // 2, 3, increasing=True)
        weight = np.linalg.pinv(basis)[0]
        inner = np.lib.stride_tricks.sliding_window_view(q, rows, axis=0) @ weight
        q[rows // 2 : rows // 2 + len(inner)] = inner
        self._t, self._q = poses.t, q

    def at(self, t: Array) -> Array:
        """Return the smoothed pose at k stamps in s, shape (k, 3)."""
        return interpolated(t, self._t, self._q)
