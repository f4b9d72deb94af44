"""Many live twins in lanes under sampled loads: a twin advances from sample to sample and writes a row at each sample.

If a load is sampled frequently, a step ends at the next sample long before its series loses accuracy. So a series is
ended at the order whose terms vanish over this step (`series.expand`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.arrays import copy_into, copy_record, unowned
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.dense_output import pair_outputs
from plow_twin.solve.kinematics import pose_of
from plow_twin.solve.lanes.events import first_events, note_switches
from plow_twin.solve.lanes.loop import (
    OTHER_METHOD,
    bits_in_range,
    complete,
    go_past_an_instant,
    lane_in_range,
    move,
    turn,
)
from plow_twin.solve.lanes.maps import choose_maps, note_durations
from plow_twin.solve.lanes.record import (
    COMPONENTS,
    WIDTH,
    linear_at,
    load_lane,
    penetration_at,
    save_lane,
    weigh_lanes,
    write_place,
    write_state,
)
from plow_twin.solve.lanes.series import accurate_steps, accurate_steps_by_power, expand, raised
from plow_twin.solve.lanes.totals import add_step, sum_step
from plow_twin.solve.method.rest import slow_enough
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, Status, X, Y
from plow_twin.solve.step import LONGEST_STEP

#: If the way to a sample takes more than this number of steps, rest is checked under a constant load; the check costs
#: as much as these steps.
_MAY_REST: Final = 32
#: A term has vanished if it is below this share of the admissible size of the last order (`method.series`).
_VANISHED: Final = 0.4
_SHORTEST_SPAN: Final = 1e-100

_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_BUDGET: Final = int(Status.BUDGET)
_AT_SAMPLE: Final = 7


class Samples(NamedTuple):
    """The samples through which twins are advanced, and the progress of each twin."""

    params: NDArray[np.void]  #: parameters of all twins, shape (m,)
    states: NDArray[np.void]
    saved: NDArray[np.void]  #: states at the previous sample, by lane, shape (8,)
    totals: NDArray[np.void]  #: counts of touches since the previous sample, by lane, shape (8,)
    times: NDArray[np.float64]  #: times of the samples in s, shape (n,)
    #: load per mass and inertia at the previous sample and at the samples, shape (m, n + 1, 3)
    wrench: NDArray[np.float64]
    rows: NDArray[np.void]  #: rows to fill, shape (m, n)
    place: NDArray[np.int64]  #: number of samples that each twin has passed, shape (m,)
    queue: NDArray[np.int64]  #: indices of the twins that wait for a lane
    #: first the number of twins taken from the queue, then the number of twins that left for another method
    progress: NDArray[np.int64]
    other: NDArray[np.int64]  #: indices of the twins that left for another method, shape (m,)


@kernel(inline="source")
def _unowned_samples(s):
    """Return the arrays without reference counts."""
    return Samples(
        unowned(s.params), unowned(s.states), unowned(s.saved), unowned(s.totals), unowned(s.times), unowned(s.wrench),
        unowned(s.rows), unowned(s.place), unowned(s.queue), unowned(s.progress), unowned(s.other),
    )  # fmt: skip


@kernel()
def _begin_sample(s, lanes, lane) -> None:
    """Make the load of a lane linear up to the next sample, and save the lane's present state."""
    member = lanes.member[lane]
    i, state = s.place[member], s.states[member]
    lanes.stop[lane], lanes.knot[lane], lanes.before[lane] = s.times[i], lanes.time[lane], state.steps
    copy_record(s.saved[lane], state)
    span = lanes.stop[lane] - lanes.knot[lane]
    per_span = 1.0 / span if span > _SHORTEST_SPAN else 0.0
    for j in range(3):
        before = s.wrench[member, i, j]
        lanes.sample[j, lane] = before
        lanes.slope[j, lane] = (s.wrench[member, i + 1, j] - before) * per_span


@kernel()
def _load_next(s, lanes, lane) -> None:
    """Move the next waiting twin into a lane."""
    member = s.queue[s.progress[0]]
    s.progress[0] += 1
    p = s.params[member]
    load_lane(p, s.states[member], s.totals[lane], lanes, lane, member)
    lanes.small[lane], lanes.stale[0] = _VANISHED * p.threshold[p.order], 1
    _begin_sample(s, lanes, lane)


@kernel()
def _clear_sums(s, lanes, lane) -> None:
    """Clear the sums of a row."""
    for pair in range(PAIR_COUNT):
        lanes.peak[pair, lane] = lanes.impulse[pair, lane] = lanes.time_in_contact[pair, lane] = 0.0
        s.totals[lane].makes[pair] = 0
    s.totals[lane].logged = 0


@kernel()
def _leave(s, lanes, lane) -> None:
    """Take a twin out of its lane, and set it back to its state at the previous sample."""
    member = lanes.member[lane]
    _clear_sums(s, lanes, lane)
    save_lane(s.states[member], s.totals[lane], lanes, lane)
    copy_record(s.states[member], s.saved[lane])


@kernel()
def _fail(s, lanes, lane, code) -> None:
    """Undo a failed advance: the twin keeps its state, with the time of the next sample, and waits for a lane again."""
    member = lanes.member[lane]
    i, steps = s.place[member], s.states[member].steps - lanes.before[lane]
    _leave(s, lanes, lane)
    p, state, out = s.params[member], s.states[member], s.rows[member, i]
    state.touch_time += s.times[i] - state.time
    state.step_start = state.time = s.times[i]
    out.t, out.status, out.steps = s.times[i], code, steps
    pose_of(p, state.y, None, out.q, out.v)
    copy_into(out.wear_depth, state.wear_depth)
    pair_outputs(p, state, out.wear_depth, state.y, out.penetration, out.rate, out.force)
    copy_into(out.peak, out.force)
    s.place[member] += 1
    if s.place[member] < s.times.size:
        s.progress[0] -= 1
        s.queue[s.progress[0]] = member


@kernel()
def _tell(lanes, reached, viscous, hysteretic, power, fraction) -> None:
    """Write poses and rates of all lanes to `lanes.out`; write penetrations, their rates and forces to `lanes.told`.

    In lanes that have `reached` a sample, the force at the sample raises the peak.
    """
    for i in range(COMPONENTS):
        set_row(lanes.out, i, exact_row(lanes.y, i))
    c, s, om = exact_row(lanes.y, COS), exact_row(lanes.y, SIN), exact_row(lanes.y, OMEGA)
    x, y = exact_row(lanes.y, X), exact_row(lanes.y, Y)
    dc, ds = om * s * -1.0, om * c
    dx, dy = fused(om, y, exact_row(lanes.y, VX)), exact_row(lanes.y, VY) - om * x
    zero = exact_splat(0.0)
    for pair in range(PAIR_COUNT):
        depth, closing = penetration_at(lanes.rows[pair], c, s, x, y), linear_at(lanes.rows[pair], dc, ds, dx, dy)
        push = depth
        if viscous is not None:
            push = fused(exact_row(lanes.ratio, pair), closing, depth)
        if hysteretic is not None:
            push = fused(exact_row(lanes.factor, pair) * closing, depth, depth)
        if power is not None:
            push = raised(lanes, depth, fraction)
            if hysteretic is not None:
                push = fused(exact_row(lanes.factor, pair) * closing, push, push)
        acts = lanes.on[pair] & below(zero, depth) & below(zero, push)
        force, peak = choose(acts, exact_row(lanes.stiffness, 0) * push, zero), exact_row(lanes.peak, pair)
        set_row(lanes.told[0], pair, depth)
        set_row(lanes.told[1], pair, closing)
        set_row(lanes.told[2], pair, force)
        set_row(lanes.peak, pair, choose(below(peak, force) & reached, force, peak))
    turn(lanes.out, X, Y)
    turn(lanes.out, VX, VY)


@kernel()
def _write_row(s, lanes, lane) -> None:
    """Write the row of the sample that a lane has reached."""
    member = lanes.member[lane]
    state, sums, i, told, now = s.states[member], s.totals[lane], s.place[member], lanes.told, lanes.out
    out = s.rows[member, i]
    out.t, out.status, out.steps = s.times[i], _OK, state.steps - lanes.before[lane]
    out.q[0], out.q[1], out.q[2] = now[X, lane], now[Y, lane], now[THETA, lane]
    out.v[0], out.v[1], out.v[2] = now[VX, lane], now[VY, lane], now[OMEGA, lane]
    set_row(out.wear_depth, 0, exact_row(state.wear_depth, 0))
    for pair in range(PAIR_COUNT):
        out.penetration[pair], out.rate[pair], out.force[pair] = (
            told[0, pair, lane],
            told[1, pair, lane],
            told[2, pair, lane],
        )
        out.peak[pair], out.impulse[pair] = lanes.peak[pair, lane], lanes.impulse[pair, lane]
        out.time_in_contact[pair], out.makes[pair] = lanes.time_in_contact[pair, lane], sums.makes[pair]


@kernel()
def _clear_reached(s, lanes, reached) -> None:
    """Clear the sums of the lanes that have reached a sample."""
    zero = exact_splat(0.0)
    for pair in range(PAIR_COUNT):
        set_row(lanes.peak, pair, choose(reached, zero, exact_row(lanes.peak, pair)))
        set_row(lanes.impulse, pair, choose(reached, zero, exact_row(lanes.impulse, pair)))
        set_row(lanes.time_in_contact, pair, choose(reached, zero, exact_row(lanes.time_in_contact, pair)))
    for lane in range(WIDTH):
        sums = s.totals[lane]
        if reached >> lane & 1 and sums.logged != 0:
            sums.logged = 0
            for pair in range(PAIR_COUNT):
                sums.makes[pair] = 0


@kernel()
def _go_on(s, lanes, lane) -> bool:
    """Begin the advance of a lane to its next sample; after the last sample its twin leaves.

    Returns whether the lane can take a step at once, without another check.
    """
    member = lanes.member[lane]
    state = s.states[member]
    s.place[member] += 1
    if s.place[member] == s.times.size:
        save_lane(state, s.totals[lane], lanes, lane)
        return False
    write_state(state, lanes, lane)
    _begin_sample(s, lanes, lane)
    left = lanes.stop[lane] - lanes.time[lane]
    lanes.whole[lane] = min(left, LONGEST_STEP)
    return left > 0.0


@kernel(inline="source")
def _is_steady(lanes, lane) -> bool:
    slope = lanes.slope
    return slope[0, lane] == 0.0 and slope[1, lane] == 0.0 and slope[2, lane] == 0.0


@kernel()
def _look(s, rest, lanes, lane, budget, in_range) -> int:
    """Return `OK` if a lane can take a step, `_AT_SAMPLE` if it has reached a sample, else the code of its failure."""
    member = lanes.member[lane]
    p, state = s.params[member], s.states[member]
    if not in_range and not lane_in_range(lanes, p, state, lane):
        return _RANGE
    left, taken = lanes.stop[lane] - lanes.time[lane], state.steps - lanes.before[lane]
    if left <= 0.0:
        return _AT_SAMPLE
    if taken >= budget:
        return _BUDGET
    if rest is not None:  # noqa: SIM102 - left out by types
        if taken >= _MAY_REST and _is_steady(lanes, lane):
            write_place(state, lanes, lane)
            if slow_enough(p, state.y):
                return OTHER_METHOD
    lanes.whole[lane] = min(left, LONGEST_STEP)
    return _OK


@kernel()
def _get_ready(s, viscous, hysteretic, power, fraction, rest, lanes, budget) -> bool:
    """Write the rows of reached samples and fill empty lanes; return whether any lane has a step to take."""
    while True:
        in_range, reached, live, changed = bits_in_range(lanes), 0, False, False
        for lane in range(WIDTH):
            if lanes.member[lane] < 0:
                if s.progress[0] < s.queue.size:
                    _load_next(s, lanes, lane)
                    changed = True
                continue
            code = _look(s, rest, lanes, lane, budget, in_range >> lane & 1 == 1)
            if code == _OK:
                live = True
            elif code == _AT_SAMPLE:
                reached |= 1 << lane
            elif code == OTHER_METHOD:
                s.other[s.progress[1]] = lanes.member[lane]
                s.progress[1] += 1
                _leave(s, lanes, lane)
                changed = True
            else:
                _fail(s, lanes, lane, code)
                changed = True
        if reached != 0:
            _tell(lanes, reached, viscous, hysteretic, power, fraction)
            for lane in range(WIDTH):
                if reached >> lane & 1:
                    _write_row(s, lanes, lane)
            _clear_reached(s, lanes, reached)
            for lane in range(WIDTH):
                if reached >> lane & 1:
                    ready = _go_on(s, lanes, lane)
                    live, changed = live or ready, changed or not ready
        if not changed:
            return live


@kernel()
def _step(s, viscous, hysteretic, power, fraction, order, lanes, w) -> None:
    """Take one step in each lane."""
    time = exact_row(lanes.time, 0) - exact_row(lanes.knot, 0)
    for j in range(3):
        sampled = fused(exact_row(lanes.slope, j), time, exact_row(lanes.sample, j))
        set_row(lanes.held, j, exact_row(lanes.constant, j) + sampled)
    if hysteretic is None and power is None and lanes.stale[0] == 1:
        weigh_lanes(lanes)
        lanes.stale[0] = 0
    if fraction is not None:
        choose_maps(s.params, None, None, None, None, hysteretic, fraction, 1, lanes, w)
    used = expand(lanes, w, order, None, None, viscous, hysteretic, power, fraction, 1)
    if power is None:
        infinite = accurate_steps(s.params, lanes, order)
    else:
        infinite = accurate_steps_by_power(lanes, w, order, fraction)
    if infinite != 0:
        for lane in range(WIDTH):
            if infinite >> lane & 1:
                _fail(s, lanes, lane, _NON_FINITE)
    first_events(s.states, lanes, w, used, order, hysteretic, power, fraction)
    go_past_an_instant(s.params, s.states, lanes)
    note_switches(lanes, used, viscous, fraction)
    if fraction is not None:
        note_durations(lanes)
    sum_step(lanes, w, used, power)
    add_step(None, lanes, w, used, order, viscous, hysteretic, power, fraction)
    move(lanes)
    for lane in range(WIDTH):
        member = lanes.member[lane]
        if member >= 0:
            complete(s.params[member], s.states[member], s.totals[lane], lanes, lane, hysteretic, fraction)


@kernel(entry=True)
def advance_lanes(
    s, viscous, hysteretic, power, fraction, rest, order, eight, work, budget, iterations
) -> bool:  # fmt: skip
    """Advance the twins in the queue through all samples, eight at a time; return False if `iterations` are used up.

    `eight` and `work`, shape (1,), are lanes and scratch space. `budget` is the largest number of steps of an advance
    to a sample. If an advance fails, the twin keeps its state and its time goes on. A twin at rest leaves its lane
    before the advance, for another method (`Samples.other`).
    """
    s, lanes, w = _unowned_samples(s), eight[0], work[0]
    for _ in range(iterations):
        if not _get_ready(s, viscous, hysteretic, power, fraction, rest, lanes, budget):
            return True
        _step(s, viscous, hysteretic, power, fraction, order, lanes, w)
    return False
