"""The record of eight scenes side by side: series and constants whose rows have one number for each scene (lane)."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.arrays import copy_part
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import sum_to_bernstein
from plow_twin.kernel.simd import choose, equal, exact_row, exact_splat, fused, lowest_bit, set_row, transpose
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.compiled_scene import CompiledScene, options
from plow_twin.solve.state import COS, MAX_ORDER, OFF, ON, Terms, new_records

#: Number of scenes in a vector.
WIDTH: Final = 8
#: Number of state components in a lane's series.
COMPONENTS: Final = 8
#: Indices in `moment` of the factors by which cosine, sine, X and Y are multiplied in the contacts' moment.
DC, DS, DX, DY = range(4)
#: Numbering of guards: from 0 the first guards of the eight pairs, from `SECOND` their second guards, from `AGAIN` the
#: guards of pairs that part within the step and may touch again.
SECOND: Final = PAIR_COUNT
AGAIN: Final = 2 * PAIR_COUNT
GUARDS: Final = 3 * PAIR_COUNT
#: Largest number of consecutive orders that may vanish (`Params.lacuna`).
MOST_LACUNA: Final = 6

_ROWS: Final = MAX_ORDER + 1
_PAIRS: Final = (PAIR_COUNT, WIDTH)
_LANES_OF: Final = (WIDTH,)
#: Blocks of `staged`: five rows of the penetrations, two of the arms, then state, lambda, modes, and whether a pair can
#: touch.
_ARM, _Y, _FACTOR, _MODE, _ENABLED, _BLOCKS = 5, 7, 8, 9, 10, 11
#: Indices in `counts`: steps, evaluations, events, searches of roots, recoveries, events at one instant.
STEPS, EVALUATIONS, EVENTS, GUARD_ROOTS, RECOVERIES, AT_ONCE = range(6)
COUNTS: Final = 6

#: The constants and the state of eight scenes, from which their next steps follow.
_BLOCK_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("rows", "f8", (PAIR_COUNT, 5, WIDTH)),  # factors of cosine, sine, X and Y in the penetration, and its constant
    ("arms", "f8", (PAIR_COUNT, 2, WIDTH)),  # factors of cosine and sine in the arm
    ("enabled", "i8", _PAIRS),  # 1 if the pair can touch
    ("constant", "f8", (3, WIDTH)),
    ("inverse_mass", "f8", _LANES_OF),
    ("inverse_inertia", "f8", _LANES_OF),
    ("radius", "f8", _LANES_OF),
    ("weight", "f8", _LANES_OF),
    ("stiffness", "f8", _LANES_OF),
    ("viscous", "f8", _LANES_OF),
    ("half_cavity", "f8", _LANES_OF),
    ("mass", "f8", (3, WIDTH)),  # sampled loads: mass, mass and inertia
    ("small", "f8", _LANES_OF),  # size below which a term over the longest wanted step counts as vanished
    ("threshold", "f8", (MOST_LACUNA, WIDTH)),  # admissible sizes of the last orders, as velocities
    ("stretch", "f8", _LANES_OF),  # log2 of velocity tolerance / (position tolerance (order + 1))
    # exponents other than 1
    ("exponent", "f8", _LANES_OF),
    ("release", "f8", _LANES_OF),  # penetration below which the force is negligible
    # state
    ("y", "f8", (COMPONENTS, WIDTH)),  # state at the step's start
    ("factor", "f8", _PAIRS),  # lambda
    ("mode", "i8", _PAIRS),
    ("time", "f8", _LANES_OF),
    ("before_it", "f8", _LANES_OF),  # size of the previous step in s
    ("touch_time", "f8", _LANES_OF),  # time of the last touch
    ("touched", "i8", _LANES_OF),  # a bit for each pair that touches at the step's start
    ("counts", "i8", (COUNTS, WIDTH)),  # by `STEPS` to `AT_ONCE`, as in the records of the states
    # derived from modes (`note_modes`, `_weigh_lanes`)
    ("ratio", "f8", _PAIRS),  # C / K of pairs that are ON
    ("filled", "i8", _LANES_OF),  # number of slots that a lane's pairs fill
    ("on", "i8", (PAIR_COUNT,)),  # a bit for each lane in which the pair is ON
    ("off", "i8", (PAIR_COUNT,)),  # a bit for each lane in which the pair is OFF and can touch
    ("taken", "i8", (PAIR_COUNT,)),  # a bit for each lane with a pair in the slot
    ("watched", "i8", _LANES_OF),  # a bit for each guard that is always searched
    ("inside", "i8", _LANES_OF),  # number of pairs that penetrate
    ("carrying", "i8", _LANES_OF),  # a bit for each pair that is ON
    ("along", "f8", (2, 6, WIDTH)),  # factors of c, s, X or Y and of their rates in the forces along X and Y
    # moment = c Gc + s Gs - X fy + Y fx: factors of c, s, X, Y and of their rates in Gc and Gs
    ("turn", "f8", (2, 8, WIDTH)),
    ("slot", "i8", _PAIRS),  # the pair in each slot
    ("gear", "f8", (PAIR_COUNT, 8, WIDTH)),  # for the pairs in each slot: `rows`, `arms` and `factor`
]
BLOCK: Final = np.dtype(_BLOCK_FIELDS)


def _begin_of(field: str) -> int:
    parts: Any = BLOCK.fields
    return int(parts[field][1])


#: Where state, notes on modes and slots begin in `BLOCK`, in bytes, and where the slots' gears begin; size of a gear.
_STATE, _NOTES, _SLOTS, _GEARS = _begin_of("y"), _begin_of("ratio"), _begin_of("slot"), _begin_of("gear")
_SIZE: Final = BLOCK.itemsize
_GEAR: Final = (_SIZE - _GEARS) // PAIR_COUNT

LANES: Final = np.dtype(
    [
        *_BLOCK_FIELDS,
        ("series", "f8", (COMPONENTS, _ROWS, WIDTH)),  # state
        ("moment", "f8", (4, _ROWS, WIDTH)),  # factors of c, s, X and Y in the moment of the contacts
        ("load", "f8", (3, _ROWS, WIDTH)),  # S1, S2, M
        # penetrations of the pairs in each slot; not written if F is linear in d and d'
        ("depth", "f8", (PAIR_COUNT, _ROWS, WIDTH)),
        ("push", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # F / K of the pairs in each slot
        ("guard", "f8", (GUARDS, _ROWS, WIDTH)),  # the eight guards of each round, which may belong to any lanes
        ("bernstein", "f8", (_ROWS, WIDTH)),
        ("bulge", "f8", (_ROWS, WIDTH)),  # forces whose maximum must still be found, because it may exceed the peak
        ("bulge_step", "f8", _LANES_OF),  # step sizes that belong to the forces in `bulge`
        # guards of a round: the penetration's rows, factors of d and d', a further constant
        ("chosen", "f8", (8, WIDTH)),
        ("direction", "f8", (4, WIDTH)),
        ("slope", "f8", (3, WIDTH)),  # sampled loads: slope from the previous sample to the next sample
        ("sample", "f8", (3, WIDTH)),  # sampled loads: value at the previous sample
        ("held", "f8", (3, WIDTH)),  # load at the step's start, including the constant loads
        ("next", "f8", (3, WIDTH)),  # sampled loads: value at the next sample
        ("knot", "f8", _LANES_OF),  # sampled loads: time of the previous sample
        ("change", "f8", (COMPONENTS, WIDTH)),  # change of the state over the step
        ("gained", "f8", (2, WIDTH)),  # scratch for one slot: impulse over the step, and peak
        ("sum", "f8", (4, WIDTH)),  # integrals over the step of the changes of cosine, sine, X, Y
        # one harmonic load: frequency, sine, cosine, amplitudes of S1, S2 and M, phase
        ("harmonic", "f8", (10, WIDTH)),
        ("size", "f8", (MOST_LACUNA, WIDTH)),  # sizes of the terms of the last orders, as velocities
        ("step", "f8", _LANES_OF),  # step size in s
        ("accurate", "f8", _LANES_OF),  # step size without events
        ("stop", "f8", _LANES_OF),  # time at which the present step must end at the latest
        ("whole", "f8", _LANES_OF),  # longest wanted step in s
        ("reach", "f8", _LANES_OF),  # guards of a round: end of the interval that is searched
        ("root", "f8", _LANES_OF),  # guards of a round: first root
        ("begin", "f8", _LANES_OF),  # guards of a round: time at which the pair has parted, else 0
        ("parted", "f8", _PAIRS),  # time at which a CLIPPED pair parts within the step, else infinity
        ("peak", "f8", _PAIRS),
        ("impulse", "f8", _PAIRS),
        ("time_in_contact", "f8", _PAIRS),
        ("out", "f8", (COMPONENTS, WIDTH)),  # values of one scene at eight instants, or of eight scenes
        ("told", "f8", (3, PAIR_COUNT, WIDTH)),  # penetration, rate, force
        # blocks whose rows are lanes and whose columns are pairs or components, and the transposed blocks
        ("staged", "f8", (_BLOCKS, WIDTH, PAIR_COUNT)),
        ("turned", "f8", (_BLOCKS, PAIR_COUNT, WIDTH)),
        # state, lambda, modes, `touch_time`, `before_it` and `touched` at the previous sample
        ("kept", "f8", (3 * PAIR_COUNT + 3, WIDTH)),
        ("kept_counts", "i8", (COUNTS, WIDTH)),
        ("member", "i8", _LANES_OF),  # the scene in a lane, -1 for an empty lane
        ("switch", "i8", _PAIRS),  # modes that pairs take at the step's end, -1 for no change
        ("event", "i8", _LANES_OF),  # the guard that ends the step, or -1
        ("ends_at_stop", "i8", _LANES_OF),
        ("todo", "i8", _LANES_OF),  # a bit for each guard that remains to be searched
        ("guarded", "i8", (GUARDS, WIDTH)),  # the guards of each round, by their numbers from 0 to `GUARDS` - 1, or -1
        ("owner", "i8", (GUARDS, WIDTH)),  # lanes of these guards
        ("row_place", "i8", _LANES_OF),  # index in `rows` of each guard of a round
        ("bulge_pair", "i8", _LANES_OF),
        ("bulge_lane", "i8", _LANES_OF),
        ("orders", "i8", _LANES_OF),  # order of each lane's series; the terms beyond have vanished
        # the following fields are used only for exponents other than 1
        ("power", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # d^n of each slot's pairs
        # base of the power: d, or d / sigma^2 for a pair that touches at the step's start; d^2 if n is an integer
        ("base", "f8", (PAIR_COUNT, _ROWS, WIDTH)),
        ("rate", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # d' of each slot's pairs
        ("per_base", "f8", _PAIRS),  # 1 / base at the step's start
        # the following fields are used only for exponents that are not integers
        ("rates", "f8", (4, _ROWS, WIDTH)),  # rates of cosine, sine, X and Y
        ("alpha", "f8", _LANES_OF),  # time since the step's start: alpha sigma + beta sigma^2 / 2
        ("beta", "f8", _LANES_OF),
        ("duration", "f8", _LANES_OF),  # step size in s, where `step` and `whole` are values of sigma
        ("may_stop", "i8", _LANES_OF),  # 1 if a step of the size `whole` ends at `stop`
        ("touching", "i8", (PAIR_COUNT,)),  # a bit for each lane whose pair in the slot touches at the step's start
        # single numbers come last, so that every row before them fills a cache line
        ("live", "i8", (1,)),  # a bit for each lane that has a scene
        ("noted", "i8", (1,)),  # `live` at the last `note_modes`; -1 if the notes are those of the lanes' block
        ("parting", "i8", (1,)),  # a bit for each lane in which a CLIPPED pair parts
        ("rounds", "i8", (1,)),
        ("bulges", "i8", (1,)),  # number of forces in `bulge`
        ("vanished", "i8", (1,)),  # a bit for each lane whose series ends early
        ("failed", "i8", (1,)),  # sampled loads: a bit for each lane whose series was not finite
        ("stale", "i8", (1,)),  # 1 if modes or scenes have changed since the last `_weigh_lanes`
    ]
)


#: Terms that a scene in lanes may have: those of its law without a ramp, harmonic loads, flight and rest. For a step of
#: flight or rest the scene leaves its lane.
_COVERED: Final = {"harmonics", "second", "viscous", "hysteretic", "integer", "fraction", "flight", "rest"}


def fits_lanes(compiled: CompiledScene, *, sampled: bool = False) -> bool:
    """Return whether a scene can run in lanes.

    Its terms must be those of its contact law and of harmonics (or samples); it may have no ramp and no `Options`.
    """
    parts = compiled.parts._replace(terms=compiled.parts.terms._replace(segments=None)) if sampled else compiled.parts
    there = (name for name, term in zip(Terms._fields, parts.terms, strict=True) if term is not None)
    return parts.implicit is None and _COVERED.issuperset(there) and not any(options(compiled.scene))


def powers(terms: Terms) -> tuple[int | None, int | None]:
    """Return two flags, 1 or None: for exponents other than 1, and for exponents that are not integers."""
    return 1 if terms.integer or terms.fraction else None, terms.fraction


def new_lanes() -> NDArray[np.void]:
    """Return empty lanes, shape (1,)."""
    lanes = new_records(LANES, 1)
    lanes["member"] = -1
    # an empty lane has the numbers of a scene at rest, so that its results stay finite
    lanes["y"][:, COS] = lanes["half_cavity"] = lanes["whole"] = 1.0
    return lanes


@kernel()
def load_lane(p, state, power, lanes, lane, member) -> None:
    """Put a scene into a lane; `join_lanes` must follow."""
    lanes.member[lane], lanes.time[lane] = member, state.step_start
    lanes.live[0] |= 1 << lane
    for i in range(5):
        constant = exact_row(p.penetration_rows, i)
        if i == 4:
            constant = constant - exact_row(state.wear_depth, 0)
        set_row(lanes.staged, WIDTH * i + lane, constant)
    for i in range(2):
        set_row(lanes.staged, WIDTH * (_ARM + i) + lane, exact_row(p.arm_rows, i))
    set_row(lanes.staged, WIDTH * _Y + lane, exact_row(state.y, 0))
    set_row(lanes.staged, WIDTH * _FACTOR + lane, exact_row(state.damping_factor, 0))
    set_row(lanes.staged, WIDTH * _MODE + lane, exact_row(state.mode, 0))
    set_row(lanes.staged, WIDTH * _ENABLED + lane, exact_row(p.enabled, 0))
    for j in range(3):
        lanes.constant[j, lane] = p.constant[j]
    for i in range(2):
        for j in range(2):
            lanes.direction[2 * i + j, lane] = p.direction[i, j]
    lanes.inverse_mass[lane], lanes.inverse_inertia[lane] = p.inverse_mass, p.inverse_inertia
    lanes.radius[lane], lanes.weight[lane] = p.radius, p.weight
    lanes.stiffness[lane], lanes.viscous[lane] = p.stiffness, p.viscous
    lanes.half_cavity[lane] = p.half_cavity
    if power is not None:
        lanes.exponent[lane], lanes.release[lane] = p.exponent, p.release
    for i in range(MOST_LACUNA):
        lanes.threshold[i, lane] = p.threshold[p.order - i] if i < p.lacuna else np.inf
    lanes.stretch[lane] = math.log2(p.velocity_tolerance / (p.position_tolerance * (p.order + 1)))
    lanes.before_it[lane], lanes.touch_time[lane] = state.last_step_size, state.touch_time
    lanes.touched[lane], counts = state.touching, lanes.counts
    counts[STEPS, lane], counts[EVALUATIONS, lane], counts[EVENTS, lane] = state.steps, state.evaluations, state.events
    counts[GUARD_ROOTS, lane], counts[RECOVERIES, lane] = state.guard_roots, state.recoveries
    counts[AT_ONCE, lane] = state.events_at_once
    state.in_flight = state.at_rest = 0


@kernel()
def join_lanes(lanes, bits) -> None:
    """Spread the staged numbers of newly loaded lanes over the rows of all lanes, and note the modes."""
    for block in range(_BLOCKS):
        transpose(lanes.turned[block], lanes.staged[block])
    turned = lanes.turned
    for pair in range(PAIR_COUNT):
        for i in range(5):
            at = 5 * pair + i
            set_row(lanes.rows, at, choose(bits, exact_row(turned, WIDTH * i + pair), exact_row(lanes.rows, at)))
        for i in range(2):
            at, new = 2 * pair + i, exact_row(turned, WIDTH * (_ARM + i) + pair)
            set_row(lanes.arms, at, choose(bits, new, exact_row(lanes.arms, at)))
        set_row(lanes.y, pair, choose(bits, exact_row(turned, WIDTH * _Y + pair), exact_row(lanes.y, pair)))
        factor, mode = exact_row(turned, WIDTH * _FACTOR + pair), exact_row(turned, WIDTH * _MODE + pair)
        set_row(lanes.factor, pair, choose(bits, factor, exact_row(lanes.factor, pair)))
        set_row(lanes.mode, pair, choose(bits, mode, exact_row(lanes.mode, pair)))
        enabled = exact_row(turned, WIDTH * _ENABLED + pair)
        set_row(lanes.enabled, pair, choose(bits, enabled, exact_row(lanes.enabled, pair)))
    note_modes(lanes)
    lanes.stale[0] = 1


@kernel()
def write_place(state, lanes, lane) -> None:
    """Write the time and body coordinates of a lane to a state's record."""
    for i in range(COMPONENTS):
        state.y[i] = lanes.y[i, lane]
    state.step_start = lanes.time[lane]


@kernel()
def save_lanes(states, lanes, bits) -> None:
    """Write the states of some lanes to their records."""
    transpose(lanes.turned[0], lanes.y)
    transpose(lanes.turned[1], lanes.factor)
    transpose(lanes.turned[2], lanes.mode)
    counts = lanes.counts
    for lane in range(WIDTH):
        if bits >> lane & 1:
            state = states[lanes.member[lane]]
            set_row(state.y, 0, exact_row(lanes.turned, lane))
            set_row(state.damping_factor, 0, exact_row(lanes.turned, WIDTH + lane))
            set_row(state.mode, 0, exact_row(lanes.turned, 2 * WIDTH + lane))
            state.step_start = state.time = lanes.time[lane]
            state.touching, state.touch_time = lanes.touched[lane], lanes.touch_time[lane]
            state.last_step_size, state.steps = lanes.before_it[lane], counts[STEPS, lane]
            state.evaluations, state.events = counts[EVALUATIONS, lane], counts[EVENTS, lane]
            state.guard_roots, state.recoveries = counts[GUARD_ROOTS, lane], counts[RECOVERIES, lane]
            state.events_at_once = counts[AT_ONCE, lane]


@kernel()
def empty_lanes(lanes, bits) -> None:
    """Empty some lanes; `note_modes` must follow."""
    for lane in range(WIDTH):
        if bits >> lane & 1:
            lanes.member[lane] = -1
    lanes.live[0] &= ~bits


@kernel()
def note_modes(lanes) -> None:
    """Derive the guards of all lanes from the modes of their pairs, and put the pairs that are ON into slots."""
    live, damped = lanes.live[0], exact_row(lanes.viscous, 0) / exact_row(lanes.stiffness, 0)
    lanes.noted[0] = live
    for lane in range(WIDTH):
        lanes.inside[lane] = lanes.carrying[lane] = lanes.watched[lane] = lanes.filled[lane] = 0
    for pair in range(PAIR_COUNT):
        on, off = equal(lanes.mode, pair, ON) & live, equal(lanes.mode, pair, OFF) & live
        set_row(lanes.ratio, pair, choose(on, damped, exact_splat(0.0)))
        lanes.on[pair], lanes.off[pair] = on, off & ~equal(lanes.enabled, pair, 0)
        lanes.taken[pair], left = 0, live & ~off
        while left != 0:
            lane = lowest_bit(left)
            left &= left - 1
            lanes.inside[lane] += 1
            if on >> lane & 1:
                lanes.carrying[lane] |= 1 << pair
                _take_slot(lanes, lane, pair, lanes.filled[lane])
                lanes.filled[lane] += 1
            else:
                lanes.watched[lane] |= 1 << pair | 1 << SECOND + pair
    for lane in range(WIDTH):
        for slot in range(lanes.filled[lane]):
            lanes.taken[slot] |= 1 << lane


@kernel()
def _take_slot(lanes, lane, pair, slot) -> None:
    """Put a pair that is ON into a slot of its lane."""
    gear = lanes.gear[slot]
    for i in range(5):
        gear[i, lane] = lanes.rows[pair, i, lane]
    gear[5, lane], gear[6, lane] = lanes.arms[pair, 0, lane], lanes.arms[pair, 1, lane]
    gear[7, lane], lanes.slot[slot, lane] = lanes.factor[pair, lane], pair


@kernel()
def refresh(lanes, hysteretic, power) -> None:
    """Renew the maps of `_weigh_lanes` if modes or scenes have changed."""
    if lanes.stale[0] == 1:
        if hysteretic is None and power is None:
            _weigh_lanes(lanes)
        lanes.stale[0] = 0


@kernel()
def _weigh_lanes(lanes) -> None:
    """Sum, over each lane's acting pairs, the linear maps from an order of the state to that of the forces.

    Along a wall's normal  f = -n F  with  F = K (a c + b s + n Z) + C (a c' + b s' + n Z'),  where Z is X or Y. The
    moment is  c Gc + s Gs - X fy + Y fx,  where Gc and Gs are the sums of the arms' factors times F.
    """
    along, turn, zero = lanes.along, lanes.turn, exact_splat(0.0)
    for i in range(6):
        set_row(along[0], i, zero)
        set_row(along[1], i, zero)
    for i in range(8):
        set_row(turn[0], i, zero)
        set_row(turn[1], i, zero)
    for slot in range(PAIR_COUNT):
        taken, gear = lanes.taken[slot], lanes.gear[slot]
        if taken == 0:
            break
        stiffness = choose(taken, exact_row(lanes.stiffness, 0), zero)
        viscous = choose(taken, exact_row(lanes.viscous, 0), zero)
        for axis in range(2):
            _add(along[axis], 3, exact_row(gear, 2 + axis) * -1.0, gear, 2 + axis, 0, stiffness, viscous)
            _add(turn[axis], 4, exact_row(gear, 5 + axis), gear, 2, 3, stiffness, viscous)


@kernel()
def _add(there, rates, factor, gear, third, fourth, stiffness, viscous) -> None:
    """Add a factor times a slot's force to a linear map: to the rows of cosine, sine and of further components."""
    spring, damper = factor * stiffness, factor * viscous
    for i in range(rates):
        at = third if i == 2 else fourth if i == 3 else i
        set_row(there, i, fused(spring, exact_row(gear, at), exact_row(there, i)))
        set_row(there, rates + i, fused(damper, exact_row(gear, at), exact_row(there, rates + i)))


@kernel()
def read_block(lanes, block) -> None:
    """Copy constants, state and notes from a block to the lanes."""
    copy_part(lanes, block, 0, _SLOTS)
    used = 0
    while used < PAIR_COUNT and lanes.taken[used] != 0:
        used += 1
    if used > 0:
        copy_part(lanes, block, _SLOTS, _GEARS + used * _GEAR)
    lanes.noted[0] = -1


@kernel()
def write_block(block, lanes, new) -> None:
    """Copy the state of the lanes to their block, also the notes if they have changed, and all if the block is new."""
    copy_part(block, lanes, 0 if new else _STATE, _NOTES if lanes.noted[0] < 0 else _SIZE)


@kernel(inline="code")
def places_of(numbers):
    """Return eight integers as the tuple of places that `gathered` takes."""
    return (
        numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6], numbers[7],
    )  # fmt: skip


@kernel(inline="code")
def penetration_at(rows, c, s, x, y):
    """Return the penetrations of one pair or slot in all lanes."""
    normal = fused(exact_row(rows, 2), x, fused(exact_row(rows, 3), y, exact_row(rows, 4)))
    return fused(exact_row(rows, 0), c, fused(exact_row(rows, 1), s, normal))


@kernel(inline="code")
def linear_at(rows, c, s, x, y):
    """Return the penetrations without their constant term, for higher orders and for rates."""
    return fused(
        exact_row(rows, 0), c, fused(exact_row(rows, 1), s, fused(exact_row(rows, 2), x, exact_row(rows, 3) * y))
    )


@kernel()
def to_bernstein(lanes, column, w, order, h) -> None:
    """Write the Bernstein coefficients of one polynomial of each lane on [0, h] to `lanes.bernstein`."""
    b, power = lanes.bernstein, exact_splat(1.0)
    for k in range(order + 1):
        set_row(b, k, exact_row(column, k) * (power * w.binomial[order, k]))
        power = power * h
    sum_to_bernstein(b, order)
