"""A sensor that is not at the head's centre, and one that follows the pose with a lag.

A sensor with a lever arm measures a point of the head that moves with its angle. A first-order low pass follows the
pose u by tau dy/dt = u - y. Its mean delay tau counts as part of the delay of the stamps, so that for a small tau the
rest is tau^2 / 2 times the acceleration.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.measurements import Poses, filled
from plow_twin.kernel.compiler import kernel

Array = NDArray[np.float64]

#: Derived: rows of the parabola that gives a measured pose at a swing's start: a kink of a slow sensor spans as many.
_ROWS: Final = 7
#: Guard: shortest span in s over which a cubic is formed from places and rates.
_SHORTEST: Final = 1e-6


def moved_by_lever(q: Array, v: Array, lever: Array) -> tuple[Array, Array]:
    """Return poses and rates, (n, 3) each, as measured with a lever arm (2,) in m, less the arm itself."""
    c, s = np.cos(q[:, 2:]), np.sin(q[:, 2:])
    arm, across = lever, np.array([-lever[1], lever[0]])
    place, rate = q.copy(), v.copy()
    place[:, :2] += (c - 1.0) * arm + s * across
    rate[:, :2] += v[:, 2:] * (c * across - s * arm)
    return place, rate


class Memory:
    """The measured pose as a smooth curve: where a low pass is at the start of a swing."""

    def __init__(self, poses: Poses) -> None:
        q = filled(poses)
        rows = min(_ROWS, len(q))
        basis = np.vander(np.arange(rows) - rows // 2, 3, increasing=True)
        weight = np.linalg.pinv(basis)[0]
        inner = np.lib.stride_tricks.sliding_window_view(q, rows, axis=0) @ weight
        q[rows // 2 : rows // 2 + len(inner)] = inner
        self._t, self._q = poses.t, q

    def at(self, t: Array) -> Array:
        """Return the pose at some stamps, shape (k, 3)."""
        return np.stack([np.interp(t, self._t, column) for column in self._q.T], axis=1)


@kernel(entry=True)
def lagged(tau, edges, starts, places, rates, memory, t, q, v):  # type: ignore[no-untyped-def]
    """Return poses and rates (n, 3) behind a low pass with the time constant `tau` in s.

    Swing m has the rows edges[m]:edges[m + 1] of `t`, `q`, `v`. It starts at starts[m] with the pose places[m] and the
    rates rates[m], while the low pass is at memory[m]. Between rows the pose is a cubic, for which this is exact.
    """
    out, rate = np.empty_like(q), np.empty_like(q)
    for swing in range(len(starts)):
        for j in range(3):
            before, u0, v0, y = starts[swing], places[swing, j], rates[swing, j], memory[swing, j]
            for row in range(edges[swing], edges[swing + 1]):
                u1, v1 = q[row, j], v[row, j]
                h = max(t[row] - before, _SHORTEST)
                mean = (u1 - u0) / h
                third = 6.0 * (v0 + v1 - 2.0 * mean) / (h * h)
                # the particular solution u - tau u' + tau^2 u'' - tau^3 u''' at both ends
                first = u0 - tau * (v0 - tau * ((6.0 * mean - 4.0 * v0 - 2.0 * v1) / h - tau * third))
                last = u1 - tau * (v1 - tau * ((2.0 * v0 + 4.0 * v1 - 6.0 * mean) / h - tau * third))
                y = last + (y - first) * np.exp(-h / tau)
                out[row, j] = y
                rate[row, j] = (u1 - y) / tau
                before, u0, v0 = t[row], u1, v1
    return out, rate
