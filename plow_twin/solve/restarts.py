"""Many runs of one scene, with their own initial states and time intervals, in one compiled call."""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.compiler import for_kernels, kernel
from plow_twin.solve import loop
from plow_twin.solve.modes import settle_modes
from plow_twin.solve.state import Status

_OK, _LOG_FULL = int(Status.OK), int(Status.LOG_FULL)
_integrate = for_kernels(loop.integrate)


@kernel(entry=True)
def run_restarts(p, parts, states, w, totals, log, edges, budgets, t, q, v) -> int:
    """Run state m through the times t[edges[m]:edges[m + 1]], and write poses and rates to these rows of q and v.

    The caller sets the coordinates, rates and time of each state, but not its modes. The first failed run ends the call
    with its `Status`.
    """
    first = np.zeros(1, np.int64)
    for m in range(states.size):
        low, high = edges[m], edges[m + 1]
        if low == high:
            continue
        settle_modes(p, states[m], parts.terms.stick)
        first[0] = 0
        code = _LOG_FULL
        while code == _LOG_FULL:
            totals[m].logged = 0
            code = _integrate(
                p, parts, states[m], w, totals[m], log, t[high - 1], budgets[m], first, t[low:high], q[low:high],
                v[low:high], None, None, None, None,
            )  # fmt: skip
        if code != _OK:
            return code
    return _OK
