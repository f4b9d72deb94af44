"""Live twins in lanes under sampled loads. A twin advances from sample to sample, and writes a row at each sample.

Under a load with frequent samples, a step ends long before its series becomes inaccurate. A series therefore ends at
the order from which its terms are negligible over the step (`series.expand`).
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
    COUNTS,
    STEPS,
    WIDTH,
    empty_lanes,
    join_lanes,
    linear_at,
    load_lane,
    note_modes,
    penetration_at,
    read_block,
    refresh,
    save_lanes,
    write_block,
    write_place,
)
from plow_twin.solve.lanes.series import accurate_steps, before_sticking, expand, raised
from plow_twin.solve.lanes.totals import add_step, sum_step
from plow_twin.solve.method.rest import slow_enough
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, Status, X, Y
from plow_twin.solve.step import LONGEST_STEP

#: Number of steps under constant load after which a lane is checked for rest. The check costs as much as these steps.
_MAY_REST: Final = 32
#: Size of a term that is treated as zero, divided by the admissible size of the term of the last order
#: (`method.series`).
_VANISHED: Final = 0.4
_SHORTEST_SPAN: Final = 1e-100

_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_BUDGET: Final = int(Status.BUDGET)
_AT_SAMPLE: Final = 7
#: Index in `kept` of the rows after state, lambda and modes.
_TIMES: Final = 3 * PAIR_COUNT


class Load(NamedTuple):
    """Samples of the load of all twins."""

    #: previous sample, Fx, Fy [N] and M [N m] about the cavity's centre, shape (m, 3), or (1, 3) for all twins
    before: NDArray[np.float64]
    samples: NDArray[np.float64]  #: shape (m, n, 3), or (1, n, 3) for all twins
    masses: NDArray[np.float64]  #: mass, mass and inertia of each twin, shape (m, 3)


class Samples(NamedTuple):
    """Samples through which twins are advanced, and the progress of each twin."""

    params: NDArray[np.void]  #: parameters of all twins, shape (m,)
    states: NDArray[np.void]
    blocks: NDArray[np.void]  #: twins of a thread, eight in each `BLOCK`; shape (b,)
    #: for each block, bit mask of the twins whose modes it contains; -1 for a block to load from records
    noted: NDArray[np.int64]
    totals: NDArray[np.void]  #: numbers of touches since the previous sample, by lane, shape (8,)
    times: NDArray[np.float64]  #: times of the samples in s, shape (n,)
    load: Load
    rows: NDArray[np.void]  #: rows of `ADVANCE` to fill, shape (m, n)
    place: NDArray[np.int64]  #: number of samples that each twin has passed, shape (m,)
    progress: NDArray[np.int64]  #: indexed by `BLOCK_NOW` to `END`
    other: NDArray[np.int64]  #: indices of the twins that a method without lanes continues, shape (m,)


#: Indices in `Samples.progress`: current block, number of twins that a method without lanes continues, state of the
#: current block, first twin of the thread, and the twin after its last twin. The state of a block is `_LOADED` in the
#: lanes, `_LEFT` if one of its twins has left the lanes, else 0.
BLOCK_NOW, OTHERS, LOADED, FIRST, END = range(5)
_LOADED, _LEFT = 1, 2


@kernel(inline="source")
def _unowned_samples(s):
    load = Load(unowned(s.load.before), unowned(s.load.samples), unowned(s.load.masses))
    return Samples(
        unowned(s.params), unowned(s.states), unowned(s.blocks), unowned(s.noted), unowned(s.totals),
        unowned(s.times), load, unowned(s.rows), unowned(s.place), unowned(s.progress), unowned(s.other),
    )  # fmt: skip


@kernel()
def _begin_samples(s, lanes, bits) -> None:
    """Set the loads of some lanes to straight lines up to their next samples, and store their states."""
    samples = s.load.samples
    for j in range(3):
        set_row(lanes.sample, j, choose(bits, exact_row(lanes.next, j), exact_row(lanes.sample, j)))
    for lane in range(WIDTH):
        if bits >> lane & 1:
            member = lanes.member[lane]
            i, own = s.place[member], member if samples.shape[0] > 1 else 0
            lanes.stop[lane] = s.times[i]
            for j in range(3):
                lanes.next[j, lane] = samples[own, i, j]
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
        _copy_lanes(lanes.kept, i, lanes.y, i, bits)
        _copy_lanes(lanes.kept, PAIR_COUNT + i, lanes.factor, i, bits)
        _copy_lanes(lanes.kept, 2 * PAIR_COUNT + i, lanes.mode, i, bits)
    _copy_lanes(lanes.kept, _TIMES, lanes.touch_time, 0, bits)
    _copy_lanes(lanes.kept, _TIMES + 1, lanes.before_it, 0, bits)
    _copy_lanes(lanes.kept, _TIMES + 2, lanes.touched, 0, bits)
    for i in range(COUNTS):
        _copy_lanes(lanes.kept_counts, i, lanes.counts, i, bits)


@kernel(inline="code")
def _copy_lanes(there, i, source, at, bits) -> None:
    set_row(there, i, choose(bits, exact_row(source, at), exact_row(there, i)))


@kernel()
def _undo(s, lanes, bits) -> None:
    """Restore the states of some lanes at the previous sample, and reset their sums.

    The caller has to call `note_modes` afterwards.
    """
    for i in range(PAIR_COUNT):
        _copy_lanes(lanes.y, i, lanes.kept, i, bits)
        _copy_lanes(lanes.factor, i, lanes.kept, PAIR_COUNT + i, bits)
        _copy_lanes(lanes.mode, i, lanes.kept, 2 * PAIR_COUNT + i, bits)
    _copy_lanes(lanes.touch_time, 0, lanes.kept, _TIMES, bits)
    _copy_lanes(lanes.before_it, 0, lanes.kept, _TIMES + 1, bits)
    _copy_lanes(lanes.touched, 0, lanes.kept, _TIMES + 2, bits)
    for i in range(COUNTS):
        _copy_lanes(lanes.counts, i, lanes.kept_counts, i, bits)
    _copy_lanes(lanes.time, 0, lanes.knot, 0, bits)
    for lane in range(WIDTH):
        if bits >> lane & 1:
            lanes.carrying[lane] = -1
    lanes.stale[0] = 1
    _clear_sums(s, lanes, bits)


@kernel()
def _steps_since(lanes, lane) -> int:
    steps: int = lanes.counts[STEPS, lane] - lanes.kept_counts[STEPS, lane]
    return steps


@kernel()
def _next_block(s, hysteretic, power, slip, lanes) -> bool:
    """Load the next block with a twin that has not passed all samples. Return whether there is such a block."""
    progress = s.progress
    if progress[LOADED] != 0:
        _store_block(s, hysteretic, power, slip, lanes)
    while progress[BLOCK_NOW] < s.blocks.size:
        first, live, count = progress[FIRST] + WIDTH * progress[BLOCK_NOW], 0, 0
        for lane in range(WIDTH):
            if first + lane < progress[END]:
                count += 1
                live |= 1 << lane if s.place[first + lane] < s.times.size else 0
        if live != 0:
            _load_block(s, power, slip, lanes, first, count, live)
            return True
        progress[BLOCK_NOW] += 1
    return False


@kernel()
def _load_block(s, power, slip, lanes, first, count, live) -> None:
    """Load `count` twins into the lanes, beginning with `first`, and start the advances of the twins in `live`."""
    block = s.progress[BLOCK_NOW]
    if s.noted[block] < 0:
        for lane in range(count):
            _load_record(s, power, slip, lanes, lane, first + lane)
        join_lanes(lanes, (1 << count) - 1)
    else:
        read_block(lanes, s.blocks[block])
    for lane in range(WIDTH):
        lanes.member[lane] = first + lane if live >> lane & 1 else -1
    lanes.live[0] = live
    if s.noted[block] != live:
        note_modes(lanes)
        lanes.stale[0] = 1
    s.progress[LOADED], before, samples = _LOADED, s.load.before, s.load.samples
    for lane in range(WIDTH):
        if live >> lane & 1:
            member = first + lane
            i, own = s.place[member], member if samples.shape[0] > 1 else 0
            first_own = member if before.shape[0] > 1 else 0
            for j in range(3):
                lanes.next[j, lane] = before[first_own, j] if i == 0 else samples[own, i - 1, j]
    for j in range(3):
        set_row(lanes.next, j, exact_row(lanes.next, j) / exact_row(lanes.mass, j))
    _begin_samples(s, lanes, live)


@kernel()
def _load_record(s, power, slip, lanes, lane, member) -> None:
    """Load a twin into a lane from its record. The caller has to call `join_lanes` afterwards."""
    p = s.params[member]
    load_lane(p, s.states[member], power, slip, lanes, lane, member)
    lanes.small[lane] = _VANISHED * p.threshold[p.order]
    for j in range(3):
        lanes.mass[j, lane] = s.load.masses[member, j]


@kernel()
def _store_block(s, hysteretic, power, slip, lanes) -> None:
    """Write the lanes to their block, which must be loaded from records if a twin has left the lanes."""
    block = s.progress[BLOCK_NOW]
    if s.progress[LOADED] == _LOADED:
        refresh(lanes, hysteretic, power, slip)
        write_block(s.blocks[block], lanes, s.noted[block] < 0)
        if lanes.noted[0] >= 0:
            s.noted[block] = lanes.noted[0]
    else:
        s.noted[block] = -1
    s.progress[BLOCK_NOW] += 1
    s.progress[LOADED] = 0


@kernel()
def _clear_sums(s, lanes, bits) -> None:
    """Reset the sums of some lanes, and of all lanes whose twins have passed all samples."""
    zero, bits = exact_splat(0.0), bits | ~lanes.live[0]
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
def _fail(s, lanes, lane, code) -> None:
    """Undo a failed advance: the twin has its previous state at the time of the next sample.

    The caller has to call `note_modes` afterwards.
    """
    member, steps = lanes.member[lane], _steps_since(lanes, lane)
    i = s.place[member]
    _undo(s, lanes, 1 << lane)
    lanes.touch_time[lane] += s.times[i] - lanes.time[lane]
    lanes.time[lane] = s.times[i]
    save_lanes(s.states, lanes, 1 << lane)
    p, state, out, zero = s.params[member], s.states[member], s.rows[member, i], exact_splat(0.0)
    out.t, out.status, out.steps, out.error_estimate = s.times[i], code, steps, 0.0
    pose_of(p, state.y, None, out.q, out.v)
    copy_into(out.wear_depth, state.wear_depth)
    pair_outputs(p, state, out.wear_depth, state.y, out.penetration, out.rate, out.force)
    copy_into(out.peak, out.force)
    set_row(out.impulse, 0, zero)
    set_row(out.time_in_contact, 0, zero)
    set_row(out.makes, 0, zero)


@kernel()
def _write_outputs(lanes, reached, viscous, hysteretic, power, fraction) -> None:
    """Write poses and rates of all lanes to `lanes.out`, and values of the pairs to `lanes.pair_values`.

    `reached` is a bit mask of the lanes that have reached a sample. Their peaks include the force at the sample.
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
            push = fused(exact_row(lanes.damped, 0), closing, depth)
        if hysteretic is not None:
            push = fused(exact_row(lanes.factor, pair) * closing, depth, depth)
        if power is not None:
            push = raised(lanes, depth, fraction)
            if hysteretic is not None:
                push = fused(exact_row(lanes.factor, pair) * closing, push, push)
        acts = lanes.on[pair] & below(zero, depth) & below(zero, push)
        force, peak = choose(acts, exact_row(lanes.stiffness, 0) * push, zero), exact_row(lanes.peak, pair)
        set_row(lanes.pair_values[0], pair, depth)
        set_row(lanes.pair_values[1], pair, closing)
        set_row(lanes.pair_values[2], pair, force)
        set_row(lanes.peak, pair, choose(below(peak, force) & reached, force, peak))
    turn(lanes.out, X, Y)
    turn(lanes.out, VX, VY)


@kernel()
def _write_rows(s, lanes, reached) -> None:
    turned = lanes.turned
    transpose(turned[0], lanes.out)
    for i in range(3):
        transpose(turned[1 + i], lanes.pair_values[i])
    transpose(turned[4], lanes.peak)
    transpose(turned[5], lanes.impulse)
    transpose(turned[6], lanes.time_in_contact)
    for lane in range(WIDTH):
        if reached >> lane & 1:
            member = lanes.member[lane]
            state, now = s.states[member], turned[0, lane]
            i = s.place[member]
            out = s.rows[member, i]
            out.t, out.status, out.steps = s.times[i], _OK, _steps_since(lanes, lane)
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
def _go_on(s, lanes, passed) -> int:
    """Start advances to the next samples, and remove twins that have passed the last sample.

    Returns a bit mask of the lanes that can take a step without a further check.
    """
    over = 0
    for lane in range(WIDTH):
        if passed >> lane & 1:
            member = lanes.member[lane]
            s.place[member] += 1
            over |= 1 << lane if s.place[member] == s.times.size else 0
    if over != 0:
        save_lanes(s.states, lanes, over)
        empty_lanes(lanes, over)
    if passed == over:
        return 0
    _begin_samples(s, lanes, passed & ~over)
    return _limit_steps(lanes) & passed & ~over


@kernel()
def _limit_steps(lanes) -> int:
    """Write the longest admissible step of each lane. Return a bit mask of lanes that have not reached a sample."""
    remaining, longest = exact_row(lanes.stop, 0) - exact_row(lanes.time, 0), exact_splat(LONGEST_STEP)
    ahead = below(exact_splat(0.0), remaining)
    whole = choose(below(remaining, longest), remaining, longest)
    # an empty lane needs finite results
    set_row(lanes.whole, 0, choose(ahead, whole, exact_row(lanes.whole, 0)))
    return ahead


@kernel(inline="source")
def _is_steady(lanes, lane) -> bool:
    slope = lanes.slope
    return slope[0, lane] == 0.0 and slope[1, lane] == 0.0 and slope[2, lane] == 0.0


@kernel()
def _look(s, rest, lanes, lane, budget, in_range, ahead) -> int:
    """Return `OK` if a lane can take a step, `_AT_SAMPLE` if it has reached a sample, or the code of its failure."""
    member = lanes.member[lane]
    state = s.states[member]
    if not in_range and not lane_in_range(lanes, s.params[member], state, lane):
        return _RANGE
    steps = _steps_since(lanes, lane)
    if not ahead:
        return _AT_SAMPLE
    if steps >= budget:
        return _BUDGET
    if rest is not None:  # noqa: SIM102 - left out by types
        if steps >= _MAY_REST and _is_steady(lanes, lane):
            write_place(state, lanes, lane)
            if slow_enough(s.params[member], state.y):
                return OTHER_METHOD
    return _OK


@kernel()
def _get_ready(s, viscous, hysteretic, power, fraction, slip, rest, lanes, budget) -> bool:
    """Write the rows of samples that were reached, and load blocks. Return whether any lane has a step to take."""
    while True:
        if lanes.live[0] == 0 and not _next_block(s, hysteretic, power, slip, lanes):
            return False
        in_range, ahead, failed, remaining = bits_in_range(lanes), _limit_steps(lanes), 0, 0
        reached = lanes.live[0] & in_range & ~ahead & ~lanes.failed[0]
        for lane in range(WIDTH):
            if lanes.member[lane] < 0 or reached >> lane & 1:
                continue
            code = _look(s, rest, lanes, lane, budget, in_range >> lane & 1 == 1, ahead >> lane & 1 == 1)
            if lanes.failed[0] >> lane & 1:
                code = _NON_FINITE
            if code == _AT_SAMPLE:
                reached |= 1 << lane
            elif code == OTHER_METHOD:
                _leave(s, lanes, lane)
                remaining |= 1 << lane
            elif code != _OK:
                _fail(s, lanes, lane, code)
                failed |= 1 << lane
        lanes.failed[0] = 0
        if reached != 0:
            _write_outputs(lanes, reached, viscous, hysteretic, power, fraction)
            _write_rows(s, lanes, reached)
            _clear_sums(s, lanes, reached)
        if remaining | failed != 0:
            note_modes(lanes)
        ready = _go_on(s, lanes, reached | failed)
        if remaining | failed == 0 and ready == reached:
            return True


@kernel()
def _leave(s, lanes, lane) -> None:
    """Remove a twin from its lane, so that a method without lanes continues it from the previous sample.

    The caller has to call `note_modes` afterwards.
    """
    bit = 1 << lane
    s.other[s.progress[OTHERS]] = lanes.member[lane]
    s.progress[OTHERS] += 1
    s.progress[LOADED] = _LEFT
    _undo(s, lanes, bit)
    save_lanes(s.states, lanes, bit)
    empty_lanes(lanes, bit)


@kernel()
def _step(s, viscous, hysteretic, power, fraction, slip, order, lanes, w) -> None:
    time = exact_row(lanes.time, 0) - exact_row(lanes.knot, 0)
    for j in range(3):
        sampled = fused(exact_row(lanes.slope, j), time, exact_row(lanes.sample, j))
        set_row(lanes.held, j, exact_row(lanes.constant, j) + sampled)
    refresh(lanes, hysteretic, power, slip)
    if fraction is not None:
        choose_maps(None, None, None, None, hysteretic, fraction, slip, 1, lanes, w)
    used = expand(lanes, w, order, None, None, viscous, hysteretic, power, fraction, slip, 1)
    infinite = accurate_steps(lanes, w, order, power, fraction)
    lanes.failed[0] = infinite
    if infinite != 0:
        lanes.live[0] &= ~infinite
        note_modes(lanes)
    if slip is not None:
        before_sticking(lanes, w, used, fraction)
    first_events(lanes, w, used, order, hysteretic, power, fraction)
    go_past_an_instant(s.params, lanes)
    note_switches(lanes, viscous, fraction)
    if fraction is not None:
        note_durations(lanes)
    sum_step(lanes, w, used, power)
    add_step(None, lanes, w, used, order, viscous, hysteretic, power, fraction)
    move(lanes)
    for lane in range(WIDTH):
        if lanes.live[0] >> lane & 1:
            complete(s.params[lanes.member[lane]], s.totals[lane], lanes, lane, hysteretic, fraction)
    if lanes.stale[0] == 1:
        note_modes(lanes)
    lanes.live[0] |= infinite


@kernel(entry=True)
def advance_lanes(
    s, viscous, hysteretic, power, fraction, slip, rest, order, eight, work, budget, iterations
) -> bool:  # fmt: skip
    """Advance the twins of all blocks through all samples. Return False if `iterations` iterations were not sufficient.

    `eight` and `work`, shape (1,), are lanes and scratch space. `budget` is the largest number of steps to a sample. A
    failed advance changes only the time of the twin. A twin at rest leaves its lane at the previous sample, and a
    method without lanes continues it (`Samples.other`).
    """
    s, lanes, w = _unowned_samples(s), eight[0], work[0]
    for _ in range(iterations):
        if not _get_ready(s, viscous, hysteretic, power, fraction, slip, rest, lanes, budget):
            return True
        _step(s, viscous, hysteretic, power, fraction, slip, order, lanes, w)
    return False
