"""The main loop for lanes. Each lane runs one scene after another, independently of other lanes."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.arrays import unowned
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import below, choose, exact_row, exact_splat, fused, lowest_bit, magnitude, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.kinematics import pose_of, rate_at
from plow_twin.solve.lanes.events import first_events, note_switches
from plow_twin.solve.lanes.maps import choose_maps, duration_of, note_durations, sigma_of
from plow_twin.solve.lanes.record import (
    AT_ONCE,
    COMPONENTS,
    EVALUATIONS,
    EVENTS,
    RECOVERIES,
    STEPS,
    WIDTH,
    empty_lanes,
    join_lanes,
    load_lane,
    note_modes,
    penetration_at,
    refresh,
    save_lanes,
    set_state,
    write_place,
)
from plow_twin.solve.lanes.series import accurate_steps, before_sticking, expand, expand_loads
from plow_twin.solve.lanes.totals import add_step, find_peaks, sum_step
from plow_twin.solve.lanes.waves import turn_lanes
from plow_twin.solve.method.flight import safe_time
from plow_twin.solve.method.rest import slow_enough
from plow_twin.solve.modes import LARGEST_ANGLE, slow_touch, within_range
from plow_twin.solve.state import COS, OFF, OMEGA, ON, RELEASED, SIN, THETA, VX, VY, Status, X, Y
from plow_twin.solve.step import LONGEST_STEP, ONE_INSTANT, PAST_AN_INSTANT


class Members(NamedTuple):
    """Arrays of all scenes of a run, with the scene as first axis."""

    params: NDArray[np.void]
    states: NDArray[np.void]
    totals: NDArray[np.void]
    harmonics: NDArray[np.void]  #: harmonic loads of all scenes, one scene after the other
    extent: NDArray[np.int64]  #: for each scene, index of its first harmonic load and number of its harmonic loads
    status: NDArray[np.int64]
    first: NDArray[np.int64]  #: number of rows written
    q: NDArray[np.float64]
    v: NDArray[np.float64]


_OK, _RANGE, _NON_FINITE = int(Status.OK), int(Status.OUT_OF_RANGE), int(Status.NON_FINITE)
_BUDGET, _PAUSED = int(Status.BUDGET), int(Status.PAUSED)
#: Result for a lane whose next step requires another method.
OTHER_METHOD: Final = 6
#: Result for a lane whose scene has reached its end.
_DONE: Final = 7


@kernel()
def lane_in_range(lanes, p, state, lane) -> bool:
    """Return whether the model is valid for the state of a lane."""
    write_place(state, lanes, lane)
    return within_range(p, state, state.y)


@kernel()
def bits_in_range(lanes):
    """Return a bit mask of lanes in which the model is certainly valid (`modes.within_range`)."""
    c, s, x, y = exact_row(lanes.y, COS), exact_row(lanes.y, SIN), exact_row(lanes.y, X), exact_row(lanes.y, Y)
    bits = below(magnitude(exact_row(lanes.y, THETA)), exact_splat(LARGEST_ANGLE))
    for pair in range(PAIR_COUNT):
        bits &= below(penetration_at(lanes.rows[pair], c, s, x, y), exact_row(lanes.half_cavity, 0))
    return bits


@kernel()
def _another_method(p, harmonics, extent, flight, rest, state, lanes, lane, w, span) -> bool:
    """Return whether the next step of a lane may be free flight or rest, which lanes do not support."""
    if lanes.inside[lane] == 0:
        if flight is not None:
            for j in range(3):
                w.wrench[0, j], w.wrench[1, j] = p.constant[j], 0.0
            write_place(state, lanes, lane)
            first = extent[0]
            return safe_time(p, harmonics[first : first + extent[1]], state, w, span) > 0.0
        return False
    if rest is not None:
        write_place(state, lanes, lane)
        return slow_enough(p, state.y)
    return False


@kernel()
def _look(members, flight, rest, lanes, lane, w, t_end, budget, in_range) -> int:
    """Return `OK` if the lane can take the next step, or the status with which the scene has to leave the lane."""
    member = lanes.member[lane]
    p, state = members.params[member], members.states[member]
    if not in_range and not lane_in_range(lanes, p, state, lane):
        return _RANGE
    if lanes.time[lane] >= t_end:
        return _DONE
    if lanes.counts[STEPS, lane] >= budget:
        return _BUDGET
    lanes.stop[lane], lanes.whole[lane] = t_end, min(t_end - lanes.time[lane], LONGEST_STEP)
    if _another_method(
        p, members.harmonics, members.extent[member], flight, rest, state, lanes, lane, w, lanes.whole[lane]
    ):
        return OTHER_METHOD
    return _OK


@kernel()
def _fill_rows(members, lanes, order, fraction, t) -> None:
    """Write the output rows within the steps of all lanes, one row of each lane at a time."""
    at, due = lanes.root, lanes.live[0]
    while True:
        remaining, due = due, 0
        while remaining != 0:
            lane = lowest_bit(remaining)
            remaining &= remaining - 1
            i = members.first[lanes.member[lane]]
            if i < t.size and t[i] < end_of(lanes, lane, fraction):
                at[lane] = sigma_of(lanes, lane, max(t[i] - lanes.time[lane], 0.0), fraction)
                due |= 1 << lane
        if due == 0:
            return
        _evaluate(lanes, order, exact_row(at, 0))
        remaining = due
        while remaining != 0:
            lane = lowest_bit(remaining)
            remaining &= remaining - 1
            member = lanes.member[lane]
            i = members.first[member]
            q, v, out = members.q[member, i], members.v[member, i], lanes.out
            q[0], q[1], q[2] = out[X, lane], out[Y, lane], out[THETA, lane]
            v[0], v[1], v[2] = out[VX, lane], out[VY, lane], out[OMEGA, lane]
            members.first[member] = i + 1


@kernel()
def _evaluate(lanes, order, at) -> None:
    """Write poses and rates at one value of each lane's series variable to `lanes.out`."""
    # the processor adds independent sums in parallel
    series, out = lanes.series, lanes.out
    x, y, theta = exact_row(series[X], order), exact_row(series[Y], order), exact_row(series[THETA], order)
    vx, vy, om = exact_row(series[VX], order), exact_row(series[VY], order), exact_row(series[OMEGA], order)
    c, s = exact_row(series[COS], order), exact_row(series[SIN], order)
    for k in range(order - 1, -1, -1):
        x, y = fused(x, at, exact_row(series[X], k)), fused(y, at, exact_row(series[Y], k))
        vx, vy = fused(vx, at, exact_row(series[VX], k)), fused(vy, at, exact_row(series[VY], k))
        c, s = fused(c, at, exact_row(series[COS], k)), fused(s, at, exact_row(series[SIN], k))
        theta, om = fused(theta, at, exact_row(series[THETA], k)), fused(om, at, exact_row(series[OMEGA], k))
    set_state(out, x, y, vx, vy, om, c, s, theta)
    turn(out, X, Y)
    turn(out, VX, VY)


@kernel()
def turn(out, first, second) -> None:
    """Convert a vector to world axes."""
    c, s, x, y = exact_row(out, COS), exact_row(out, SIN), exact_row(out, first), exact_row(out, second)
    set_row(out, first, fused(c, x, s * y * -1.0))
    set_row(out, second, fused(s, x, c * y))


@kernel()
def _part(sums, lanes, lane) -> bool:
    """Set the pairs that separate from their walls within a lane's step to OFF, and return whether there are any."""
    any_found = False
    for pair in range(PAIR_COUNT):
        if lanes.parted[pair, lane] < lanes.step[lane]:
            lanes.mode[pair, lane] = OFF
            lanes.counts[EVENTS, lane] += 1
            sums.logged += 1
            any_found = True
    return any_found


@kernel()
def _rate(p, lanes, pair, lane) -> float:
    y = lanes.y
    return rate_at(
        p, pair, y[COS, lane], y[SIN, lane], y[OMEGA, lane], y[X, lane], y[Y, lane], y[VX, lane], y[VY, lane]
    )


@kernel()
def _touch(p, lanes, pair, lane) -> None:
    """Start a contact, with the damping factor lambda = D / v0 of its impact speed v0 (`modes.touch`)."""
    if p.damping_number >= 0.0:
        lanes.factor[pair, lane] = p.damping_number / max(_rate(p, lanes, pair, lane), p.speed_floor)


@kernel()
def _touch_or_release(p, lanes, pair, lane) -> None:
    """Start the contact of a pair with the force law d^n, or release it after a slow touch (`step`)."""
    lanes.touched[lane] &= ~(1 << pair)
    if lanes.mode[pair, lane] == ON:
        if _rate(p, lanes, pair, lane) > slow_touch(p):
            lanes.touched[lane] |= 1 << pair
            lanes.touch_time[lane] = lanes.time[lane]
        else:
            lanes.mode[pair, lane] = RELEASED


@kernel()
def _switch(p, sums, lanes, lane, hysteretic, fraction) -> None:
    remaining = lanes.switching[lane]
    while remaining != 0:
        pair = lowest_bit(remaining)
        remaining &= remaining - 1
        new, old = lanes.switch[pair, lane], lanes.mode[pair, lane]
        lanes.mode[pair, lane] = new
        lanes.counts[EVENTS, lane] += 1
        if old == OFF:
            sums.makes[pair] += 1
            if hysteretic is not None:
                _touch(p, lanes, pair, lane)
        if fraction is None:
            sums.logged += 1
        else:
            if old == OFF:
                _touch_or_release(p, lanes, pair, lane)
            else:
                lanes.touched[lane] &= ~(1 << pair)
            # changes between RELEASED and ON are not counted
            sums.logged += 0 if old in (ON, RELEASED) and new in (ON, RELEASED) else 1


@kernel(inline="code")
def end_of(lanes, lane, fraction):
    """Return the time at which a lane's step ends."""
    stops = lanes.ends_at_stop[lane] == 1
    if fraction is None:
        stops = stops and lanes.whole[lane] < LONGEST_STEP
    return lanes.stop[lane] if stops else lanes.time[lane] + duration_of(lanes, lane, fraction)


@kernel()
def complete(p, sums, lanes, lane, hysteretic, fraction) -> None:
    """Set the time, counts and modes of a lane, whose state is already there, to the end of its step.

    If modes change, `lanes.stale` is set, and the caller has to call `note_modes` afterwards.
    """
    begin, parted, counts = lanes.time[lane], False, lanes.counts
    counts[STEPS, lane] += 1
    counts[EVALUATIONS, lane] += lanes.orders[lane]
    if lanes.parting[0] >> lane & 1:
        parted = _part(sums, lanes, lane)
    end = end_of(lanes, lane, fraction)
    lanes.time[lane] = end
    at_once = end - begin <= ONE_INSTANT * (1.0 + abs(begin))
    if not at_once:
        lanes.before_it[lane] = end - begin
    if not at_once or lanes.event[lane] < 0:
        lanes.touched[lane] = 0
    if lanes.event[lane] < 0:
        counts[AT_ONCE, lane] = 0
        if not parted:
            return
    else:
        counts[AT_ONCE, lane] = counts[AT_ONCE, lane] + 1 if at_once else 0
        _switch(p, sums, lanes, lane, hysteretic, fraction)
    lanes.stale[0] = 1


@kernel()
def move(lanes) -> None:
    """Add the changes over the steps to the states, and compute cosine and sine from the angle."""
    y, moved, live = lanes.y, lanes.out, lanes.live[0]
    for i in range(COMPONENTS):
        set_row(moved, i, exact_row(y, i) + exact_row(lanes.change, i))
    turn_lanes(moved[THETA], moved[COS], moved[SIN])
    for i in range(COMPONENTS):
        set_row(y, i, choose(live, exact_row(moved, i), exact_row(y, i)))


@kernel()
def go_past_an_instant(params, lanes) -> None:
    """Take a short step with the current modes in each lane whose modes would alternate endlessly at one instant."""
    for lane in range(WIDTH):
        member = lanes.member[lane]
        if member >= 0 and lanes.event[lane] >= 0:
            lanes.ends_at_stop[lane] = 0
            if lanes.counts[AT_ONCE, lane] > params[member].max_events:
                lanes.counts[RECOVERIES, lane] += 1
                lanes.step[lane] = max(lanes.step[lane], min(lanes.accurate[lane], PAST_AN_INSTANT))
                lanes.event[lane] = -1


@kernel()
def _leave(members, lanes, w, order, lane, code, t) -> None:
    """Remove the scene from a lane, store its status, and write its last rows at its end."""
    member = lanes.member[lane]
    p, state, totals = members.params[member], members.states[member], members.totals[member]
    find_peaks(lanes, w, order - 1)
    for pair in range(PAIR_COUNT):
        totals.peak[pair], totals.impulse[pair] = lanes.peak[pair, lane], lanes.impulse[pair, lane]
        totals.time_in_contact[pair] = lanes.time_in_contact[pair, lane]
    save_lanes(members.states, lanes, 1 << lane)
    empty_lanes(lanes, 1 << lane)
    lanes.touched[lane] = 0
    note_modes(lanes)
    members.status[member] = _OK if code == _DONE else code
    if code != _DONE:
        return
    i = members.first[member]
    while i < t.size:
        pose_of(p, state.y, None, members.q[member, i], members.v[member, i])
        i += 1
    members.first[member] = i


@kernel(inline="source")
def _unowned_members(members):
    return Members(
        unowned(members.params),
        unowned(members.states),
        unowned(members.totals),
        unowned(members.harmonics),
        unowned(members.extent),
        unowned(members.status),
        unowned(members.first),
        unowned(members.q),
        unowned(members.v),
    )


@kernel()
def _load(members, power, slip, lanes, lane, member) -> None:
    totals = members.totals[member]
    load_lane(members.params[member], members.states[member], power, slip, lanes, lane, member)
    join_lanes(lanes, 1 << lane)
    for pair in range(PAIR_COUNT):
        lanes.peak[pair, lane], lanes.impulse[pair, lane] = totals.peak[pair], totals.impulse[pair]
        lanes.time_in_contact[pair, lane] = totals.time_in_contact[pair]


@kernel(entry=True)
def run_lanes(
    members, waves, second, viscous, hysteretic, power, fraction, slip, flight, rest, order, eight, work, queue,
    t_end, budget, iterations, t,
) -> bool:  # fmt: skip
    """Advance the members with the indices `queue` to `t_end`, eight at a time.

    `power`, `fraction` and `slip` are those of `record.forces`, `order` is the order of the series, `budget` the
    largest number of steps of a scene, and `t` contains the times of the output rows. `eight` and `work` are lanes and
    scratch space, shape (1,), because numba takes 30 us a call to find the types of such records. A scene leaves its
    lane with a `Status` or with `OTHER_METHOD`. If `iterations` iterations are not sufficient, all scenes leave with
    `PAUSED`, and the result is False.
    """
    members, queue, t, lanes, w = _unowned_members(members), unowned(queue), unowned(t), eight[0], work[0]
    waiting = 0
    for _ in range(iterations):
        in_range, live = bits_in_range(lanes), 0
        for lane in range(WIDTH):
            sure = in_range >> lane & 1 == 1
            while True:
                if lanes.member[lane] < 0:
                    if waiting == queue.size:
                        break
                    member = queue[waiting]
                    waiting += 1
                    _load(members, power, slip, lanes, lane, member)
                    sure = False
                code = _look(members, flight, rest, lanes, lane, w, t_end, budget, sure)
                if code == _OK:
                    live += 1
                    break
                _leave(members, lanes, w, order, lane, code, t)
        if live == 0:
            return True
        refresh(lanes, hysteretic, power, slip)
        _step(members, waves, second, viscous, hysteretic, power, fraction, slip, order, lanes, w, t)
    for lane in range(WIDTH):
        if lanes.member[lane] >= 0:
            _leave(members, lanes, w, order, lane, _PAUSED, t)
    return False


@kernel()
def _step(members, waves, second, viscous, hysteretic, power, fraction, slip, order, lanes, w, t) -> None:
    if fraction is not None:
        choose_maps(members.harmonics, members.extent, waves, second, hysteretic, fraction, slip, None, lanes, w)
    if waves is not None:
        expand_loads(members.harmonics, members.extent, second, fraction, lanes, w, order)
    expand(lanes, w, order, waves, second, viscous, hysteretic, power, fraction, slip, None)
    infinite = accurate_steps(lanes, w, order, power, fraction)
    if infinite != 0:
        for lane in range(WIDTH):
            if infinite >> lane & 1:
                _leave(members, lanes, w, order, lane, _NON_FINITE, t)
    if slip is not None:
        before_sticking(lanes, w, order, fraction)
    first_events(lanes, w, order, order, hysteretic, power, fraction)
    go_past_an_instant(members.params, lanes)
    note_switches(lanes, viscous, fraction)
    if fraction is not None:
        note_durations(lanes)
    sum_step(lanes, w, order, power)
    add_step(members.totals, lanes, w, order, order, viscous, hysteretic, power, fraction)
    _fill_rows(members, lanes, order, fraction, t)
    move(lanes)
    for lane in range(WIDTH):
        member = lanes.member[lane]
        if member >= 0:
            complete(members.params[member], members.totals[member], lanes, lane, hysteretic, fraction)
    if lanes.stale[0] == 1:
        note_modes(lanes)
