"""What is kept of a motion: peaks, impulses, times and sets of corners from the force polynomials, and its events."""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import maximum, shift_column
from plow_twin.kernel.simd import magnitude, row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT, STOPS_COUNTER_CLOCKWISE
from plow_twin.solve.dense_output import time_along
from plow_twin.solve.state import FIRST, ON, SECOND, SUM


@kernel(entry=True)
def add_up(rows, makes, impulse, peak) -> int:
    """Let the `ROW` of an advance, (1, 1), tell of all since the last one told, of which the three sums know.

    Makes go on counting, impulse and peak begin anew. Returns the advance's status; after a failed one nothing changes.
    """
    row_of = rows[0, 0]
    if row_of.status != 0:
        return row_of.status
    for pair in range(PAIR_COUNT):
        makes[pair] += row_of.makes[pair]
        row_of.makes[pair] = makes[pair]
        row_of.impulse[pair] = impulse[pair] + row_of.impulse[pair]
        if row_of.peak[pair] < peak[pair]:
            row_of.peak[pair] = peak[pair]
        impulse[pair] = peak[pair] = 0.0
    return 0


@kernel(entry=True)
def sum_windows(rows, taken, makes, impulse, peak, all_makes, impulses, peaks) -> None:
    """Sum the rows of advances up to each of those `taken` (rising), after which a window begins.

    Parameters
    ----------
    rows : tuple of ndarray, shape (n, 8)
        Makes, impulse and peak of each advance.
    makes, impulse, peak : ndarray, shape (8,)
        Makes so far, impulse and peak of the window under way; they are brought up to the last row.
    all_makes, impulses, peaks : ndarray, shape (m, 8)
        Receive what they are at each row taken.
    """
    made, pushed, reached = rows
    window = 0
    for n in range(len(made)):
        for pair in range(PAIR_COUNT):
            makes[pair] += made[n, pair]
            impulse[pair] += pushed[n, pair]
            peak[pair] = max(peak[pair], reached[n, pair])
        if window < taken.size and taken[window] == n:
            for pair in range(PAIR_COUNT):
                all_makes[window, pair], impulses[window, pair] = makes[pair], impulse[pair]
                peaks[window, pair] = peak[pair]
                impulse[pair] = peak[pair] = 0.0
            window += 1


@kernel(entry=True)
def sum_makes(made, makes, all_makes) -> None:
    """Sum the makes of advances, (n, 8), from those so far, (8,), on; write what they are after each, (n, 8)."""
    for n in range(len(made)):
        for pair in range(PAIR_COUNT):
            makes[pair] += made[n, pair]
            all_makes[n, pair] = makes[pair]


@kernel(fast=True)
def _sums(w, order, h) -> None:
    """Write a bound of each force over [0, h] and its integrals: sum f_k h^k / (k+1), sum f_k h^k / (k+2).

    Between its ends a function exceeds them by h^2 / 8 times its largest curvature at most.
    """
    end = bend = first = second = splat(0.0)
    for k in range(order, -1, -1):
        force = row(w.force, k)
        end = end * h + force
        bend = bend * h + magnitude(force) * (0.125 * k * (k - 1))
        first = first * h + force * w.inverse[k + 1]
        second = second * h + force * w.inverse[k + 2]
    start = row(w.force, 0)
    set_row(w.per_pair, SUM, (start + end + magnitude(start - end)) * 0.5 + bend)
    set_row(w.per_pair, FIRST, first)
    set_row(w.per_pair, SECOND, second)


@kernel()
def add_to_totals(state, w, low, high, totals) -> None:
    """Add what happened between two sigmas of the step to the totals: peaks, impulses, times, sets of corners."""
    mode = state.mode
    acting = 0
    for pair in range(PAIR_COUNT):
        acting += 1 if mode[pair] == ON else 0
    if acting == 0:
        return
    order = state.order - 1
    alpha, beta = state.alpha + state.beta * low, state.beta
    h = high - low
    elapsed = time_along(alpha, beta, h)
    if low > 0.0:
        for pair in range(PAIR_COUNT):
            shift_column(w.force, pair, order, low, w.bernstein)
        _swap_rows(w.force, w.bernstein, order)
    _sums(w, order, h)
    carrying = 0
    for pair in range(PAIR_COUNT):
        if mode[pair] != ON:
            continue
        carrying |= 1 << pair
        totals.impulse[pair] += max(0.0, (alpha * w.per_pair[FIRST, pair] + beta * h * w.per_pair[SECOND, pair]) * h)
        if w.per_pair[SUM, pair] > totals.peak[pair]:
            for k in range(order + 1):
                w.column[0, k] = w.force[k, pair]
            totals.peak[pair] = maximum(w.column[0], order, h, totals.peak[pair], w)
        totals.time_in_contact[pair] += elapsed
    if low > 0.0:
        _swap_rows(w.force, w.bernstein, order)
    add_set_times(totals, carrying, elapsed)


@kernel()
def add_set_times(totals, carrying, elapsed) -> None:
    """Add a time to the sets of corners that carry force together, one for each sense; `carrying` has a bit a pair."""
    ccw = cw = 0
    for pair in range(PAIR_COUNT):
        if carrying >> pair & 1 == 1:
            if STOPS_COUNTER_CLOCKWISE[pair]:
                ccw |= 1 << pair // 2
            else:
                cw |= 1 << pair // 2
    totals.set_time[0, ccw] += elapsed if ccw != 0 else 0.0
    totals.set_time[1, cw] += elapsed if cw != 0 else 0.0


@kernel()
def log_event(log, totals, time, pair, mode_from, mode_to, rate) -> None:
    """Write one change of contact to the event log, which has room for it."""
    event = log[totals.logged]
    event.time, event.pair, event.rate = time, pair, rate
    event.mode_from, event.mode_to = mode_from, mode_to
    totals.logged += 1


@kernel()
def _swap_rows(a, b, order) -> None:
    for k in range(order + 1):
        for lane in range(8):
            a[k, lane], b[k, lane] = b[k, lane], a[k, lane]
