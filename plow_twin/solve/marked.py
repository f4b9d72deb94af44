"""Many samples in one call, with the state kept at marked places: what replay compares."""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.solve.loop import _advance, _clear, _read_row
from plow_twin.solve.state import STATE


@kernel()
def advance_marked(params, parts, states, work, totals, times, wrench, budget, marks, saved, status, rows) -> None:
    """Advance one twin to each time, as `advance_batch` does, and save its state where `marks` say.

    `marks` are numbers of advances, rising; `saved` has room for as many states. `rows` are the columns of the outputs
    or None: then nothing is read out.
    """
    w, sums, piece = work[0], totals[0], parts.segments[0]
    p, state, before = params[0], states[0], np.empty(1, STATE)
    state.piece = 0
    mark = 0
    for i in range(times.size):
        span = times[i] - state.step_start
        piece.knot = state.step_start
        for j in range(3):
            piece.start[j] = wrench[i, j]
            piece.slope[j] = (wrench[i + 1, j] - wrench[i, j]) / span if span > 1e-100 else 0.0
        status[i] = _advance(p, parts, states, 0, before, w, sums, times[i], times[i], budget, None)[0]
        if rows is not None:
            q, v, penetration, rate, force, peak, impulse, makes, depth = rows
            _read_row(p, parts, state, w, sums, i, q, v, penetration, rate, force, peak, impulse, makes, depth)
        else:
            _clear(sums)
        while mark < marks.size and marks[mark] == i + 1:
            saved[mark] = states[0]
            mark += 1
