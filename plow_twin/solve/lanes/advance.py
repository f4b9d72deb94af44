"""Many live twins in lanes under sampled loads: a twin advances from sample to sample and writes a row at each sample.

If a load is sampled frequently, a step ends at the next sample long before its series loses accuracy. A series is
therefore cut off at the order from which its terms are negligible over this step (`series.expand`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.arrays import copy_into, unowned
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, set_row, transpose
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
    join_lanes,
    linear_at,
    load_lane,
    note_modes,
    penetration_at,
    save_lanes,
    weigh_lanes,
    write_place,
)
from plow_twin.solve.lanes.series import accurate_steps, accurate_steps_by_power, expand, raised
from plow_twin.solve.lanes.totals import add_step, sum_step
from plow_twin.solve.method.rest import slow_enough
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, Status, X, Y
from plow_twin.solve.step import LONGEST_STEP

#: Under a constant load, a lane that has taken this number of steps towards a sample is checked for rest; the check
#: costs as much as these steps.
_MAY_REST: Final = 32
#: A term of a series counts as vanished if it is below this share of the admissible size of the last order's term
#: (`method.series`).
_VANISHED: Final = 0.4
_SHORTEST_SPAN: Final = 1e-100

_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_BUDGET: Final = int(Status.BUDGET)
_AT_SAMPLE: Final = 7


class Load(NamedTuple):
    """The samples of the load of all twins."""

    before: NDArray[np.float64]  #: previous sample, Fx, Fy [N] and M [N m] about the cavity's centre, shape (m, 3)
    samples: NDArray[np.float64]  #: shape (m, n, 3), or (1, n, 3) for all twins
    masses: NDArray[np.float64]  #: mass, mass and inertia of each twin, shape (m, 3)


class Samples(NamedTuple):
    """The samples through which twins are advanced, and the progress of each twin."""

    params: NDArray[np.void]  #: parameters of all twins, shape (m,)
    states: NDArray[np.void]
    totals: NDArray[np.void]  #: counts of touches since the previous sample, by lane, shape (8,)
    times: NDArray[np.float64]  #: times of the samples in s, shape (n,)
    load: Load
    rows: NDArray[np.void]  #: rows of `ADVANCE` to fill, shape (m, n)
    place: NDArray[np.int64]  #: number of samples that each twin has passed, shape (m,)
    queue: NDArray[np.int64]  #: indices of the twins that wait for a lane
    #: first the number of twins taken from the queue, then the number of twins that left for another method
    progress: NDArray[np.int64]
    other: NDArray[np.int64]  #: indices of the twins that left for another method, shape (m,)


@kernel(inline="source")
def _unowned_samples(s):
    """Return the arrays without reference counts."""
    load = Load(unowned(s.load.before), unowned(s.load.samples), unowned(s.load.masses))
    return Samples(
        unowned(s.params), unowned(s.states), unowned(s.totals), unowned(s.times), load, unowned(s.rows),
        unowned(s.place), unowned(s.queue), unowned(s.progress), unowned(s.other),
    )  # fmt: skip


@kernel()
def _begin_samples(s, lanes, bits) -> None:
    """Make the loads of some lanes linear up to their next samples, and keep the lanes' present states."""
    samples = s.load.samples
    for j in range(3):
        set_row(lanes.sample, j, choose(bits, exact_row(lanes.next, j), exact_row(lanes.sample, j)))
    for lane in range(WIDTH):
        if bits >> lane & 1:
            member = lanes.member[lane]
            i, own, state = s.place[member], member if samples.shape[0] > 1 else 0, s.states[member]
            lanes.stop[lane], lanes.kept_touched[lane] = s.times[i], lanes.touched[lane]
            for j in range(3):
                lanes.next[j, lane] = samples[own, i, j]
            _keep_counts(state, lanes, lane)
    time, stop, zero = exact_row(lanes.time, 0), exact_row(lanes.stop, 0), exact_splat(0.0)
    span = stop - time
    per_span = choose(below(exact_splat(_SHORTEST_SPAN), span), exact_splat(1.0) / span, zero)
    for j in range(3):
        after = exact_row(lanes.next, j)
        after = choose(bits, after / exact_row(lanes.mass, j), after)
        set_row(lanes.next, j, after)
        slope = (after - exact_row(lanes.sample, j)) * per_span
        set_row(lanes.slope, j, choose(bits, slope, exact_row(lanes.slope, j)))
    set_row(lanes.knot, 0, choose(bits, time, exact_row(lanes.knot, 0)))
    for i in range(PAIR_COUNT):
        _keep(lanes, i, exact_row(lanes.y, i), bits)
        _keep(lanes, PAIR_COUNT + i, exact_row(lanes.factor, i), bits)
        _keep(lanes, 2 * PAIR_COUNT + i, exact_row(lanes.mode, i), bits)
    _keep(lanes, 3 * PAIR_COUNT, exact_row(lanes.touch_time, 0), bits)
    _keep(lanes, 3 * PAIR_COUNT + 1, exact_row(lanes.before_it, 0), bits)


@kernel(inline="code")
def _keep(lanes, i, value, bits) -> None:
    set_row(lanes.kept, i, choose(bits, value, exact_row(lanes.kept, i)))


@kernel(inline="code")
def _keep_counts(state, lanes, lane) -> None:
    counts = lanes.counts
    counts[0, lane], counts[1, lane], counts[2, lane] = state.steps, state.evaluations, state.events
    counts[3, lane], counts[4, lane] = state.guard_roots, state.recoveries
    counts[5, lane] = state.events_at_once


@kernel()
def _load_waiting(s, power, lanes) -> bool:
    """Move waiting twins into empty lanes, and begin their advances; return whether any was waiting."""
    bits = 0
    for lane in range(WIDTH):
        if lanes.member[lane] < 0 and s.progress[0] < s.queue.size:
            member = s.queue[s.progress[0]]
            s.progress[0] += 1
            p = s.params[member]
            load_lane(p, s.states[member], power, lanes, lane, member)
            lanes.small[lane] = _VANISHED * p.threshold[p.order]
            i, before = s.place[member], s.load.before
            own = member if s.load.samples.shape[0] > 1 else 0
            for j in range(3):
                lanes.mass[j, lane] = s.load.masses[member, j]
                lanes.next[j, lane] = before[member, j] if i == 0 else s.load.samples[own, i - 1, j]
            bits |= 1 << lane
    if bits == 0:
        return False
    for j in range(3):
        before_it = exact_row(lanes.next, j)
        set_row(lanes.next, j, choose(bits, before_it / exact_row(lanes.mass, j), before_it))
    join_lanes(lanes, bits)
    _begin_samples(s, lanes, bits)
    return True


@kernel()
def _clear_sums(s, lanes, bits) -> None:
    """Clear the sums of the rows of some lanes."""
    zero = exact_splat(0.0)
    for pair in range(PAIR_COUNT):
        set_row(lanes.peak, pair, choose(bits, zero, exact_row(lanes.peak, pair)))
        set_row(lanes.impulse, pair, choose(bits, zero, exact_row(lanes.impulse, pair)))
        set_row(lanes.time_in_contact, pair, choose(bits, zero, exact_row(lanes.time_in_contact, pair)))
    for lane in range(WIDTH):
        sums = s.totals[lane]
        if bits >> lane & 1 and sums.logged != 0:
            sums.logged = 0
            set_row(sums.makes, 0, zero)


@kernel()
def _leave(s, lanes, lane) -> None:
    """Set a twin back to its state at the previous sample, and take it out of its lane; `note_modes` must follow."""
    state, kept, counts = s.states[lanes.member[lane]], lanes.kept, lanes.counts
    for i in range(PAIR_COUNT):
        lanes.y[i, lane], lanes.factor[i, lane] = kept[i, lane], kept[PAIR_COUNT + i, lane]
    bit = 1 << lane
    for i in range(PAIR_COUNT):
        set_row(lanes.mode, i, choose(bit, exact_row(kept, 2 * PAIR_COUNT + i), exact_row(lanes.mode, i)))
    lanes.time[lane], lanes.touched[lane] = lanes.knot[lane], lanes.kept_touched[lane]
    lanes.touch_time[lane], state.last_step_size = kept[3 * PAIR_COUNT, lane], kept[3 * PAIR_COUNT + 1, lane]
    state.steps, state.evaluations, state.events = counts[0, lane], counts[1, lane], counts[2, lane]
    state.guard_roots, state.recoveries, state.events_at_once = counts[3, lane], counts[4, lane], counts[5, lane]
    _clear_sums(s, lanes, bit)
    save_lanes(s.states, lanes, bit)


@kernel()
def _fail(s, lanes, lane, code) -> None:
    """Undo a failed advance: the twin has its old state at the next sample's time, and is queued again."""
    member = lanes.member[lane]
    i, steps = s.place[member], s.states[member].steps - lanes.counts[0, lane]
    _leave(s, lanes, lane)
    p, state, out, zero = s.params[member], s.states[member], s.rows[member, i], exact_splat(0.0)
    state.touch_time += s.times[i] - state.time
    state.step_start = state.time = s.times[i]
    out.t, out.status, out.steps, out.error_estimate = s.times[i], code, steps, 0.0
    pose_of(p, state.y, None, out.q, out.v)
    copy_into(out.wear_depth, state.wear_depth)
    pair_outputs(p, state, out.wear_depth, state.y, out.penetration, out.rate, out.force)
    copy_into(out.peak, out.force)
    set_row(out.impulse, 0, zero)
    set_row(out.time_in_contact, 0, zero)
    set_row(out.makes, 0, zero)
    s.place[member] += 1
    if s.place[member] < s.times.size:
        s.progress[0] -= 1
        s.queue[s.progress[0]] = member


@kernel()
def _tell(lanes, reached, viscous, hysteretic, power, fraction) -> None:
    """Write poses and rates of all lanes to `lanes.out`; write penetrations, their rates and forces to `lanes.told`.

    `reached` has a bit for each lane that is at a sample; there the force at the sample is included in the peak.
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
def _write_rows(s, lanes, reached) -> None:
    """Write the rows of the samples that lanes have reached."""
    turned = lanes.turned
    transpose(turned[0], lanes.out)
    for i in range(3):
        transpose(turned[1 + i], lanes.told[i])
    transpose(turned[4], lanes.peak)
    transpose(turned[5], lanes.impulse)
    transpose(turned[6], lanes.time_in_contact)
    for lane in range(WIDTH):
        if reached >> lane & 1:
            member = lanes.member[lane]
            state, now = s.states[member], turned[0, lane]
            i = s.place[member]
            out = s.rows[member, i]
            out.t, out.status, out.steps = s.times[i], _OK, state.steps - lanes.counts[0, lane]
            out.error_estimate = 0.0
            out.q[0], out.q[1], out.q[2] = now[X], now[Y], now[THETA]
            out.v[0], out.v[1], out.v[2] = now[VX], now[VY], now[OMEGA]
            set_row(out.wear_depth, 0, exact_row(state.wear_depth, 0))
            set_row(out.penetration, 0, exact_row(turned, WIDTH + lane))
            set_row(out.rate, 0, exact_row(turned, 2 * WIDTH + lane))
            set_row(out.force, 0, exact_row(turned, 3 * WIDTH + lane))
            set_row(out.peak, 0, exact_row(turned, 4 * WIDTH + lane))
            set_row(out.impulse, 0, exact_row(turned, 5 * WIDTH + lane))
            set_row(out.time_in_contact, 0, exact_row(turned, 6 * WIDTH + lane))
            set_row(out.makes, 0, exact_row(s.totals[lane].makes, 0))


@kernel()
def _go_on(s, lanes, reached) -> int:
    """Begin the advances of lanes to their next samples; after the last sample a twin leaves.

    Returns a bit for each lane that can take a step at once, without another check.
    """
    over = 0
    for lane in range(WIDTH):
        if reached >> lane & 1:
            member = lanes.member[lane]
            s.place[member] += 1
            over |= 1 << lane if s.place[member] == s.times.size else 0
    if over != 0:
        save_lanes(s.states, lanes, over)
    if reached == over:
        return 0
    _begin_samples(s, lanes, reached & ~over)
    return _limit_steps(lanes) & reached & ~over


@kernel()
def _limit_steps(lanes) -> int:
    """Write the longest wanted step of each lane; return a bit for each lane whose sample is still ahead."""
    left, longest = exact_row(lanes.stop, 0) - exact_row(lanes.time, 0), exact_splat(LONGEST_STEP)
    ahead = below(exact_splat(0.0), left)
    whole = choose(below(left, longest), left, longest)
    # an empty lane keeps its longest step, so that its results stay finite
    set_row(lanes.whole, 0, choose(ahead, whole, exact_row(lanes.whole, 0)))
    return ahead


@kernel(inline="source")
def _is_steady(lanes, lane) -> bool:
    slope = lanes.slope
    return slope[0, lane] == 0.0 and slope[1, lane] == 0.0 and slope[2, lane] == 0.0


@kernel()
def _look(s, rest, lanes, lane, budget, in_range, ahead) -> int:
    """Return `OK` if a lane can take a step, `_AT_SAMPLE` if it has reached a sample, else the code of its failure."""
    member = lanes.member[lane]
    state = s.states[member]
    if not in_range and not lane_in_range(lanes, s.params[member], state, lane):
        return _RANGE
    taken = state.steps - lanes.counts[0, lane]
    if not ahead:
        return _AT_SAMPLE
    if taken >= budget:
        return _BUDGET
    if rest is not None:  # noqa: SIM102 - left out by types
        if taken >= _MAY_REST and _is_steady(lanes, lane):
            write_place(state, lanes, lane)
            if slow_enough(s.params[member], state.y):
                return OTHER_METHOD
    return _OK


@kernel()
def _get_ready(s, viscous, hysteretic, power, fraction, rest, lanes, budget) -> bool:
    """Write the rows of reached samples and fill empty lanes; return whether any lane has a step to take."""
    left = False
    while True:
        if _load_waiting(s, power, lanes):
            left = False
        in_range, ahead, reached, live, changed = bits_in_range(lanes), _limit_steps(lanes), 0, 0, False
        for lane in range(WIDTH):
            if lanes.member[lane] < 0:
                continue
            code = _look(s, rest, lanes, lane, budget, in_range >> lane & 1 == 1, ahead >> lane & 1 == 1)
            if code == _OK:
                live |= 1 << lane
            elif code == _AT_SAMPLE:
                reached |= 1 << lane
            elif code == OTHER_METHOD:
                s.other[s.progress[1]] = lanes.member[lane]
                s.progress[1] += 1
                _leave(s, lanes, lane)
                changed = left = True
            else:
                _fail(s, lanes, lane, code)
                changed = left = True
        if reached != 0:
            _tell(lanes, reached, viscous, hysteretic, power, fraction)
            _write_rows(s, lanes, reached)
            _clear_sums(s, lanes, reached)
            ready = _go_on(s, lanes, reached)
            live |= ready
            changed |= ready != reached
            left |= ready != reached
        if not changed:
            if left and live != 0:
                note_modes(lanes)
            return live != 0


@kernel()
def _step(s, viscous, hysteretic, power, fraction, order, lanes, w) -> None:
    """Take one step in each lane."""
    time = exact_row(lanes.time, 0) - exact_row(lanes.knot, 0)
    for j in range(3):
        sampled = fused(exact_row(lanes.slope, j), time, exact_row(lanes.sample, j))
        set_row(lanes.held, j, exact_row(lanes.constant, j) + sampled)
    if lanes.stale[0] == 1:
        if hysteretic is None and power is None:
            weigh_lanes(lanes)
        lanes.stale[0] = 0
    if fraction is not None:
        choose_maps(None, None, None, None, hysteretic, fraction, 1, lanes, w)
    used = expand(lanes, w, order, None, None, viscous, hysteretic, power, fraction, 1)
    if power is None:
        infinite = accurate_steps(s.params, lanes, order)
    else:
        infinite = accurate_steps_by_power(lanes, w, order, fraction)
    if infinite != 0:
        for lane in range(WIDTH):
            if infinite >> lane & 1:
                _fail(s, lanes, lane, _NON_FINITE)
        note_modes(lanes)
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
    if lanes.stale[0] == 1:
        note_modes(lanes)


@kernel(entry=True)
def advance_lanes(
    s, viscous, hysteretic, power, fraction, rest, order, eight, work, budget, iterations
) -> bool:  # fmt: skip
    """Advance the twins in the queue through all samples, eight at a time; return False if `iterations` are used up.

    `eight` and `work`, shape (1,), are lanes and scratch space. `budget` is the largest number of steps of an advance
    to a sample. If an advance fails, the twin keeps its state, and its time becomes that of the sample. A twin at rest
    leaves its lane in its state at the previous sample, and another method continues it (`Samples.other`).
    """
    s, lanes, w = _unowned_samples(s), eight[0], work[0]
    for _ in range(iterations):
        if not _get_ready(s, viscous, hysteretic, power, fraction, rest, lanes, budget):
            return True
        _step(s, viscous, hysteretic, power, fraction, order, lanes, w)
    return False
