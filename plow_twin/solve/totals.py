"""Totals of a motion (peaks, impulses, times in contact) from the series of the forces, and the log of its events."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import maximum, shift_column
from plow_twin.kernel.simd import magnitude, row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT, STOPS_COUNTER_CLOCKWISE
from plow_twin.solve.dense_output import time_along
from plow_twin.solve.state import FIRST, ON, SECOND, SUM


@kernel()
def _seal(row_of, window) -> None:
    """Write the sums since the previous publication to a row, and reset all but the number of touches."""
    for pair in range(PAIR_COUNT):
        row_of.makes[pair], row_of.impulse[pair] = window.makes[pair], window.impulse[pair]
        row_of.peak[pair], row_of.measured_peak[pair] = window.peak[pair], window.measured_peak[pair]
        window.impulse[pair] = window.peak[pair] = window.measured_peak[pair] = 0.0
    row_of.samples, window.samples = window.samples, 0
    row_of.corrected = window.corrected
    mark = max(row_of.held, row_of.corrected)
    row_of.marked = max(mark, window.marked)
    window.corrected, window.marked = 0, mark
    theta = row_of.q[2]
    cos, sin = math.cos(theta), math.sin(theta)
    row_of.orientation[0], row_of.orientation[1] = math.sin(0.5 * theta), math.cos(0.5 * theta)
    vx, vy = row_of.v[0], row_of.v[1]
    row_of.twist[0], row_of.twist[1], row_of.twist[2] = cos * vx + sin * vy, cos * vy - sin * vx, row_of.v[2]


@kernel(entry=True)
def publish(rows, stamps, held, taken, windows, waits) -> int:
    """Sum up advances, and write the sums since the previous publication to each row that is published.

    If the advance of a published row failed, the row has the motion of the last successful row since the previous
    publication. If there is no successful row, its stamp is 0.

    Parameters
    ----------
    rows : ndarray of `ROW`, shape (n,)
        Advances in order of time. Failed advances do not contribute to the sums.
    stamps : ndarray of int64, shape (n,)
        Stamps of the advances [ns].
    held : int
        1 if the advances were computed without samples, under constant loads.
    taken : ndarray of int64, shape (m,)
        Increasing indices of the rows to publish.
    windows : ndarray of `ROW`, shape (1,)
        Sums since the previous publication, and motion of the last successful advance that has not been published.
    waits : int
        1 if a successful advance has not been published.

    Returns
    -------
    int
        New value of `waits`.
    """
    window, place, newest = windows[0], 0, -1
    for n in range(rows.size):
        row_of = rows[n]
        row_of.stamp_ns, row_of.held = stamps[n], held
        is_taken = place < taken.size and taken[place] == n
        place += 1 if is_taken else 0
        if row_of.status == 0:
            for pair in range(PAIR_COUNT):
                window.makes[pair] += row_of.makes[pair]
                window.impulse[pair] += row_of.impulse[pair]
                window.peak[pair] = max(window.peak[pair], row_of.peak[pair])
                if held == 0:
                    window.measured_peak[pair] = max(window.measured_peak[pair], row_of.peak[pair])
            window.samples += 1 - held
            newest, waits = n, 1
        elif is_taken and waits == 1:
            _copy_motion(rows[newest] if newest >= 0 else window, row_of)
        else:
            row_of.stamp_ns = 0
            for pair in range(PAIR_COUNT):
                row_of.makes[pair] = window.makes[pair]
        if is_taken and waits == 1:
            _seal(row_of, window)
            newest, waits = -1, 0
    if newest >= 0:
        _copy_motion(rows[newest], window)
    return waits


@kernel()
def _copy_motion(row_of, target) -> None:
    target.t, target.stamp_ns, target.held = row_of.t, row_of.stamp_ns, row_of.held
    for j in range(3):
        target.q[j], target.v[j] = row_of.q[j], row_of.v[j]
    for pair in range(PAIR_COUNT):
        target.penetration[pair], target.rate[pair] = row_of.penetration[pair], row_of.rate[pair]
        target.force[pair], target.wear_depth[pair] = row_of.force[pair], row_of.wear_depth[pair]
    target.followed = row_of.followed
    if row_of.followed == 0:
        return
    for pair in range(PAIR_COUNT):
        target.force_low[pair], target.force_high[pair] = row_of.force_low[pair], row_of.force_high[pair]
        target.peak_low[pair], target.peak_high[pair] = row_of.peak_low[pair], row_of.peak_high[pair]
        target.impulse_low[pair], target.impulse_high[pair] = row_of.impulse_low[pair], row_of.impulse_high[pair]
    for j in range(6):
        target.known_clearance[j] = row_of.known_clearance[j]


@kernel(entry=True)
def publish_window(windows, rows) -> None:
    """Write the sums of a window since the previous publication to a row, shape (1,) each, and begin a new window."""
    rows[0] = windows[0]
    _seal(rows[0], windows[0])


@kernel(entry=True)
def summary(rows, n) -> tuple[int, int, int, int, float, float, float, bool]:
    """Return the fields of row `n` that every publication needs, faster than by access to each field.

    Returns
    -------
    tuple
        Stamp [ns], `marked`, `held`, number of samples, x, y [m], largest force of a pair in advances to a sample [N],
        and whether pose, rates, contacts and sums are finite.
    """
    row_of = rows[n]
    largest, total = row_of.measured_peak[0], 0.0
    for j in range(3):
        total += row_of.q[j] + row_of.v[j]
    for pair in range(PAIR_COUNT):
        largest = max(largest, row_of.measured_peak[pair])
        total += row_of.penetration[pair] + row_of.rate[pair] + row_of.force[pair]
        total += row_of.impulse[pair] + row_of.peak[pair]
    finite = math.isfinite(total)
    return row_of.stamp_ns, row_of.marked, row_of.held, row_of.samples, row_of.q[0], row_of.q[1], largest, finite


@kernel(fast=True)
def _sums(w, order, h) -> None:
    """Write an upper bound of each force over [0, h], and the sums of f_k h^k / (k+1) and f_k h^k / (k+2).

    The bound is the larger end value plus h^2 / 8 times an upper bound of the downward curvature.
    """
    end = bend = first = second = splat(0.0)
    for k in range(order, -1, -1):
        force = row(w.force, k)
        end = end * h + force
        bend = bend * h + (magnitude(force) - force) * (0.0625 * k * (k - 1))
        first = first * h + force * w.inverse[k + 1]
        second = second * h + force * w.inverse[k + 2]
    start = row(w.force, 0)
    set_row(w.per_pair, SUM, (start + end + magnitude(start - end)) * 0.5 + bend)
    set_row(w.per_pair, FIRST, first)
    set_row(w.per_pair, SECOND, second)


@kernel()
def add_to_totals(state, w, low, high, totals) -> None:
    """Add peaks, impulses and contact times from sigma `low` to sigma `high` of the current step to the totals."""
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
    """Add `elapsed` to the time of the set of corners that carry force, for each sense of rotation.

    Bit i of `carrying` is set if pair i carries force.
    """
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
    """Write a change of contact mode to the event log, which must not be full."""
    event = log[totals.logged]
    event.time, event.pair, event.rate = time, pair, rate
    event.mode_from, event.mode_to = mode_from, mode_to
    totals.logged += 1


@kernel()
def _swap_rows(a, b, order) -> None:
    for k in range(order + 1):
        for lane in range(8):
            a[k, lane], b[k, lane] = b[k, lane], a[k, lane]
