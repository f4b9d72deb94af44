"""A first-order low pass of a pose, tau dy/dt = u - y, with the input u and the output y."""

from __future__ import annotations

from typing import Final

import numpy as np

from plow_twin.kernel.compiler import kernel

#: Shortest interval in s between two rows; a shorter interval counts as this long, because slopes are divided by it.
_SHORTEST: Final = 1e-6


@kernel(entry=True)
def lagged(tau, edges, starts, places, rates, memory, t, q, v):
    """Return the low pass's output and its rates, shape (n, 3); the time constant `tau` is in s.

    A swing is a part of the motion with its own starting state. Swing m has the rows edges[m]:edges[m + 1] of `t`, `q`,
    `v`. It starts at time starts[m] with the pose places[m], the rates rates[m] and the low pass's output memory[m].
    The pose is assumed to be a cubic between rows; for this cubic the low pass is integrated exactly.
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
                # the particular solution for the cubic u(t), u - tau u' + tau^2 u'' - tau^3 u''', at both ends of the
                # interval
                first = u0 - tau * (v0 - tau * ((6.0 * mean - 4.0 * v0 - 2.0 * v1) / h - tau * third))
                last = u1 - tau * (v1 - tau * ((2.0 * v0 + 4.0 * v1 - 6.0 * mean) / h - tau * third))
                y = last + (y - first) * np.exp(-h / tau)
                out[row, j] = y
                rate[row, j] = (u1 - y) / tau
                before, u0, v0 = t[row], u1, v1
    return out, rate
