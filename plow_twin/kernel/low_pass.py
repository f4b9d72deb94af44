"""First-order low-pass filter of a pose. The output y follows the input u by tau dy/dt = u - y."""

from __future__ import annotations

from typing import Final

import numpy as np

from plow_twin.kernel.compiler import kernel

#: Lower bound in s of the interval between two rows, because it is a divisor.
_SHORTEST: Final = 1e-6


@kernel(entry=True)
def lagged(tau, edges, starts, places, rates, memory, t, q, v):
    """Return the filter's output and its rates, shape (n, 3) each. The time constant `tau` is in s.

    A swing is a part of the motion with its own initial state. Swing m consists of the rows edges[m]:edges[m + 1] of
    the times `t`, poses `q` and rates `v`. It begins at the time starts[m] with the pose places[m], the rates rates[m]
    and the filter output memory[m]. The filter is integrated exactly for a cubic pose between rows.
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
                # particular solution u - tau u' + tau^2 u'' - tau^3 u''' at both ends of the interval
                first = u0 - tau * (v0 - tau * ((6.0 * mean - 4.0 * v0 - 2.0 * v1) / h - tau * third))
                last = u1 - tau * (v1 - tau * ((2.0 * v0 + 4.0 * v1 - 6.0 * mean) / h - tau * third))
                y = last + (y - first) * np.exp(-h / tau)
                out[row, j] = y
                rate[row, j] = (u1 - y) / tau
                before, u0, v0 = t[row], u1, v1
    return out, rate
