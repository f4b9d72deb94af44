"""Many runs of one scene in one compiled call, each from its own state over its own interval of time."""

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
    """Run state m through the times t[edges[m]:edges[m + 1]], and fill the same rows of q and v.

    The caller sets each state's place, rates and time; the modes of its pairs are chosen here. Returns the first
    `Status` that is not OK, after which no further state is run.
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
