"""The main loop of the solver, which takes steps and evaluates the motion at each output time."""

from __future__ import annotations

import numpy as np

from plow_twin.kernel.arrays import copy_into, copy_record, unowned
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.dense_output import evaluate, pair_outputs, sigma_at, sum_series, wear_depth_at
from plow_twin.solve.energy_balance import balance_step, start_balance
from plow_twin.solve.fixed_step import end_coarsely
from plow_twin.solve.kinematics import pose_of
from plow_twin.solve.method.flight import fly
from plow_twin.solve.method.rest import write_rest
from plow_twin.solve.modes import read_range, within_range
from plow_twin.solve.state import Parts, Status
from plow_twin.solve.step import complete_step, lay_out_step
from plow_twin.solve.totals import add_to_totals

_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_BUDGET, _LOG_FULL, _PAUSED = int(Status.BUDGET), int(Status.LOG_FULL), int(Status.PAUSED)


@kernel(inline="source")
def _unowned_loads(parts):
    return Parts(parts.terms, unowned(parts.harmonics), unowned(parts.segments), parts.implicit)


@kernel(inline="source")
def _end(p, parts, state, w, totals, log) -> None:
    terms = parts.terms
    complete_step(
        p, parts.harmonics, terms.flight, terms.support, state, w, totals, log, terms.wear, terms.fraction, terms.stick
    )


@kernel(inline="source")
def _next(p, parts, state, w, stop_time, budget) -> int:
    """Compute the next step, unless the current time is within a step. Return a `Status`."""
    if state.step_size >= 0.0:
        return _OK
    if state.steps >= budget:
        return _BUDGET
    if not within_range(p, state, state.y):
        return _RANGE
    return _OK if lay_out_step(p, parts, state, w, stop_time) else _NON_FINITE


@kernel()
def _present(p, harmonics, flight, support, state, w, y) -> None:
    """Write body coordinates and the frame's state at the current time, even within a step, to y and `w`."""
    if state.step_size >= 0.0:
        evaluate(p, harmonics, flight, support, state, w, sigma_at(state, state.elapsed), y)
    else:
        set_row(y, 0, row(state.y, 0))
        if support is not None:
            copy_into(w.frame_now, state.frame)


@kernel()
def _proceed(p, parts, state, w, totals, target, stop_time, budget) -> int:
    """Advance the motion to `target`, and return a `Status`. Steps may extend beyond `target`, up to `stop_time`.

    Without `totals`, which do not influence the motion, no impulses, peaks and times are computed.
    """
    while True:
        t0 = state.step_start
        if t0 >= target and state.step_size < 0.0:
            return _OK if within_range(p, state, state.y) else _RANGE
        code = _next(p, parts, state, w, stop_time, budget)
        if code != _OK:
            return code
        low = sigma_at(state, state.elapsed)
        # by rounding, the stop time can be slightly beyond the end of the step
        stopped = state.ends_at_stop == 1 and target >= state.stop_time
        if target < t0 + state.step_size and not stopped:
            if totals is not None:
                add_to_totals(state, w, low, sigma_at(state, target - t0), totals)
            state.elapsed, state.time = target - t0, target
            _present(p, parts.harmonics, parts.terms.flight, parts.terms.support, state, w, w.moved)
            return _OK if within_range(p, state, w.moved) else _RANGE
        if totals is not None:
            add_to_totals(state, w, low, sigma_at(state, state.step_size), totals)
        _end(p, parts, state, w, totals, None)


@kernel()
def _worn_at(state, w, wear, sigma, out) -> None:
    if wear is not None:
        wear_depth_at(state, w, sigma, out)
    else:
        set_row(out, 0, row(state.wear_depth, 0))


@kernel()
def _worn_now(state, w, wear, out) -> None:
    if state.step_size >= 0.0:
        _worn_at(state, w, wear, sigma_at(state, state.elapsed), out)
    else:
        set_row(out, 0, row(state.wear_depth, 0))


@kernel()
def _clear(totals) -> None:
    if totals is not None:
        set_row(totals.peak, 0, splat(0.0))
        set_row(totals.impulse, 0, splat(0.0))
        set_row(totals.time_in_contact, 0, splat(0.0))
        for pair in range(PAIR_COUNT):
            totals.makes[pair] = 0


@kernel()
def _undo(support, state, w, target) -> None:
    """Undo a failed advance: set the time to `target`, and the head to `w.saved_y` and `w.saved_wear`.

    If the advance began within a step, this step is shortened to the time before the advance.
    """
    set_row(state.y, 0, row(w.saved_y, 0))
    set_row(state.wear_depth, 0, row(w.saved_wear, 0))
    if support is not None:
        copy_into(state.frame, w.frame_saved)
    state.touch_time += target - state.time
    state.step_start, state.step_size, state.elapsed, state.time = target, -1.0, 0.0, target


@kernel()
def _advance(p, parts, states, index, saved, w, totals, target, stop_time, budget, bound, pace):
    """Start or continue an advance to `target`. Return a `Status` and the number of steps of the advance.

    If the advance fails, the time becomes `target`, and the head has its state and counts before the advance, from the
    record `saved`. With a `bound`, a few Runge-Kutta steps complete an advance that reaches the largest number of
    steps.
    """
    state = states[index]
    if pace.underway == 0:
        copy_record(saved[0], state)
        _present(p, parts.harmonics, parts.terms.flight, parts.terms.support, state, w, w.saved_y)
        if parts.terms.support is not None:
            copy_into(w.frame_saved, w.frame_now)
        _worn_now(state, w, parts.terms.wear, w.saved_wear)
    before, begin = saved[0].steps, state.steps
    code = _proceed(p, parts, state, w, totals, target, stop_time, min(before + budget, begin + pace.left))
    pace.left = max(pace.left - (state.steps - begin), 0)
    if code == _BUDGET and state.steps < before + budget:
        pace.underway = 1
        return _PAUSED, 0
    pace.underway = 0
    if bound is not None:
        bound.error = 0.0
        if code == _BUDGET:
            code = end_coarsely(p, parts, state, totals, target, bound)
    steps = state.steps - before
    if code == _RANGE:
        _present(p, parts.harmonics, parts.terms.flight, parts.terms.support, state, w, w.moved)
        read_range(p, state, w.moved, w.beyond)
    if code != _OK:
        copy_record(state, saved[0])
        _undo(parts.terms.support, state, w, target)
        _clear(totals)
    return code, steps


@kernel()
def _read_row(p, parts, state, w, totals, out) -> None:
    """Write the current state and the totals to a `ROW`, and reset the totals."""
    y = w.moved
    _present(p, parts.harmonics, parts.terms.flight, parts.terms.support, state, w, y)
    pose_of(p, y, parts.terms.offset, out.q, out.v)
    _worn_now(state, w, parts.terms.wear, out.wear_depth)
    pair_outputs(p, state, out.wear_depth, y, out.penetration, out.rate, out.force)
    for pair in range(PAIR_COUNT):
        out.peak[pair] = max(totals.peak[pair], out.force[pair])
        out.impulse[pair], out.makes[pair] = totals.impulse[pair], totals.makes[pair]
        out.time_in_contact[pair] = totals.time_in_contact[pair]
    _clear(totals)


@kernel(inline="source")
def _begin_slice(pace) -> None:
    pace.left = pace.slice


@kernel(inline="source")
def _is_over(pace) -> bool:
    return bool(pace.left <= 0 and pace.underway == 0)


@kernel(inline="source")
def _follow_line(piece, start, time, before, sample) -> None:
    """Set the load to a straight line from `before` at the time `start` to `sample` at the time `time`."""
    span = time - start
    piece.knot = start
    for j in range(3):
        piece.start[j] = before[j]
        piece.slope[j] = (sample[j] - before[j]) / span if span > 1e-100 else 0.0


@kernel(entry=True)
def advance_rows(
    params, parts, states, saved, work, totals, first, last, times, wrench, budget, rows, marks, snapshots, bound, pace
) -> bool:
    """Advance the members `first` to `last` - 1 to each time. The bits of a result do not depend on other members.

    Parameters
    ----------
    params : ndarray of records, shape (m,)
        Constants of all members.
    states : ndarray of records, shape (m,)
        States of all members.
    saved : ndarray of records, shape (1,)
        State before the current advance.
    work : ndarray of records, shape (1,)
        Scratch space.
    totals : ndarray of records, shape (1,), or None
        Sums over an advance. With None, no sums are computed and no rows are written.
    times : ndarray, shape (n,)
        Times in s, not decreasing.
    wrench : ndarray, shape (m, n + 1, 3), or None
        Samples of the load, divided by mass and inertia: one before the first time, and one at each time. The load is
        interpolated linearly, and a step ends at each time. None selects the loads of the scene.
    rows : ndarray of `ROW`, shape (m, n), or None
        Array that receives the motion and the totals at each time, or None without `totals`.
    marks : ndarray of int64, shape (k,)
        Increasing numbers of advances, counted from 1, after which the state is copied.
    snapshots : ndarray of records, shape (k,)
        Array that receives the copies of the state.
    bound : record of `BOUND`, or None
        Limit of the evaluations of each advance.
    pace : record of `PACE`
        Progress of the work, from which the call continues.

    Returns
    -------
    bool
        Whether all advances are done. If not, the caller repeats the call with the same `pace`.
    """
    parts, states = _unowned_loads(parts), unowned(states)
    w, count = work[0], times.size
    sums = None if totals is None else totals[0]
    _begin_slice(pace)
    while pace.row < (last - first) * count:
        m, i = first + pace.row // count, pace.row % count
        if _is_over(pace):
            return False
        p, state = params[m], states[m]
        stop_time = np.inf
        if wrench is not None:
            stop_time = times[i]
            if pace.underway == 0:
                state.piece = 0
                _follow_line(parts.segments[0], state.step_start, times[i], wrench[m, i], wrench[m, i + 1])
        status, steps = _advance(p, parts, states, m, saved, w, sums, times[i], stop_time, budget, bound, pace)
        if status == _PAUSED:
            return False
        pace.failed += 1 if status != _OK else 0
        if rows is not None:
            out = rows[m, i]
            out.t, out.status, out.steps = times[i], status, steps
            if bound is not None:
                out.error_estimate = bound.error
            _read_row(p, parts, state, w, sums, out)
        pace.row += 1
        while pace.mark < marks.size and marks[pace.mark] == pace.row:
            copy_record(snapshots[pace.mark], states[m])
            pace.mark += 1
    return True


@kernel(entry=True)
def interrupt_step(p, parts, state, w, totals) -> None:
    """End the current step at the current time, before the caller changes the state or the parameters."""
    if state.step_size < 0.0:
        return
    state.sigma_end = sigma_at(state, state.elapsed)
    state.step_size = state.elapsed
    state.event_pair = -1
    state.ends_at_stop = 0
    now = state.time
    _end(p, parts, state, w, totals, None)
    state.step_start = state.time = now


@kernel(entry=True)
def lay_out_again(p, parts, state, w) -> None:
    """Compute the series of the current step, which a restored snapshot does not contain.

    A snapshot can be within a step only under the scene's own loads, whose steps have no stop time.
    """
    if state.at_rest == 1:
        write_rest(p, state, w)
        return
    used, implicit = state.elapsed, parts.implicit
    if implicit is not None:
        # restore the fields that the first computation of the step changed
        state.implicit_size, state.decay_times = state.implicit_size_before, state.decay_times_before
        state.refused = state.refused_before
    steps, evaluations, guard_roots = state.steps, state.evaluations, state.guard_roots
    recoveries, implicit_steps = state.recoveries, state.implicit_steps
    lay_out_step(p, parts, state, w, np.inf)
    state.steps, state.evaluations, state.guard_roots = steps, evaluations, guard_roots
    state.recoveries, state.implicit_steps = recoveries, implicit_steps
    state.elapsed = used


@kernel()
def _rows_in_flight(p, harmonics, flight, state, w, t, i, q, v, penetration, force):
    """Fill the output rows within a step of free flight, from row i on, and return the first row after it."""
    if flight is not None:
        t0, y, rate = state.step_start, w.read_y, w.read_rate
        while i < t.size and t[i] < t0 + state.step_size:
            fly(p, harmonics, flight, state, w, max(t[i] - t0, 0.0), y)
            pose_of(p, y, None, q[i], v[i])
            if force is not None:
                pair_outputs(p, state, state.wear_depth, y, penetration[i], rate, force[i])
            i += 1
    return i


@kernel()
def _rows_in_step(p, support, offset, wear, state, w, t, i, q, v, penetration, force, frame):
    """Fill the output rows within a step of a series from row i on, and return the first row after it."""
    t0, y = state.step_start, w.read_y
    end = t0 + state.step_size
    while i < t.size and t[i] < end:
        sigma = sigma_at(state, max(t[i] - t0, 0.0))
        sum_series(support, state, w, sigma, y)
        if frame is not None:
            copy_into(frame[i], w.frame_now)
        pose_of(p, y, offset, q[i], v[i])
        if force is not None:
            _worn_at(state, w, wear, sigma, w.read_wear)
            pair_outputs(p, state, w.read_wear, y, penetration[i], w.read_rate, force[i])
        i += 1
    return i


@kernel(entry=True)
def integrate(
    p, parts, state, w, totals, log, t_end, budget, first, t, q, v, penetration, force, frame, balance
) -> int:
    """Advance to `t_end`, fill the output rows from row `first[0]` on, and return a `Status`.

    The rows are the arrays t, q, v, `penetration`, `force` and `frame`, shape (n, 6). The last three arrays and
    `balance` can be None. The steps do not depend on the output times.
    """
    parts, log, t = _unowned_loads(parts), unowned(log), unowned(t)
    q, v, pair_penetration, pair_force = unowned(q), unowned(v), unowned(penetration), unowned(force)
    rate, wear = w.read_rate, parts.terms.wear
    i = first[0]
    if balance is not None and state.steps == 0:
        start_balance(p, parts, state, state.y, state.step_start, balance)
    while True:
        if state.step_start >= t_end:
            break
        if totals.logged + PAIR_COUNT > log.size:
            return _LOG_FULL
        code = _next(p, parts, state, w, t_end, budget)
        if code != _OK:
            return code
        if state.in_flight == 1:
            i = _rows_in_flight(
                p, parts.harmonics, parts.terms.flight, state, w, t, i, q, v, pair_penetration, pair_force
            )
        i = _rows_in_step(
            p, parts.terms.support, parts.terms.offset, wear, state, w, t, i, q, v, pair_penetration, pair_force, frame
        )
        first[0] = i
        add_to_totals(state, w, 0.0, sigma_at(state, state.step_size), totals)
        if balance is not None:
            balance_step(p, parts, wear, parts.terms.flight, state, w, balance)
        _end(p, parts, state, w, totals, log)
    if not within_range(p, state, state.y):
        return _RANGE
    while i < t.size:
        if frame is not None:
            copy_into(frame[i], state.frame)
        pose_of(p, state.y, parts.terms.offset, q[i], v[i])
        if force is not None:
            pair_outputs(p, state, state.wear_depth, state.y, pair_penetration[i], rate, pair_force[i])
        i += 1
    first[0] = i
    return _OK
