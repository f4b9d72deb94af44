"""Record of eight scenes that run together. Each row of its series and constants contains one number for each scene.

The position of a scene in a row is its lane. The acting pairs of each lane are assigned to slots 0, 1, ..., so that one
vector operation processes one acting pair of every lane. The pairs in a slot may differ.
"""

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
from plow_twin.solve.state import COS, MAX_ORDER, OFF, OMEGA, ON, SIN, THETA, VX, VY, Terms, X, Y, new_records

#: Number of scenes in a vector.
WIDTH: Final = 8
#: Number of state components in the series of a lane.
COMPONENTS: Final = 8
#: Indices in `moment` of the factors of cosine, sine, X and Y in the contacts' moment.
DC, DS, DX, DY = range(4)
#: Numbers of guard functions. Each pair has a first guard function (numbers from 0), a second guard function (from
#: `SECOND`), and a guard function for a new touch after a separation in the same step (from `AGAIN`).
SECOND: Final = PAIR_COUNT
AGAIN: Final = 2 * PAIR_COUNT
GUARDS: Final = 3 * PAIR_COUNT
#: Largest number of successive terms of a series that can be zero (`Params.lacuna`).
MOST_LACUNA: Final = 6

_ROWS: Final = MAX_ORDER + 1
_PAIRS: Final = (PAIR_COUNT, WIDTH)
_LANES_OF: Final = (WIDTH,)
_ALL: Final = 2**WIDTH - 1
#: Indices of the blocks of `staged`: five rows of the penetrations, two rows of the arms, then state, lambda, modes,
#: and whether a pair can touch.
_ARM, _Y, _FACTOR, _MODE, _ENABLED, _BLOCKS = 5, 7, 8, 9, 10, 11
#: Indices in `counts`: steps, evaluations, events, searches of roots, recoveries, events at one instant.
STEPS, EVALUATIONS, EVENTS, GUARD_ROOTS, RECOVERIES, AT_ONCE = range(6)
COUNTS: Final = 6

#: Constants and state of eight scenes, which determine their next steps.
_BLOCK_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("rows", "f8", (PAIR_COUNT, 5, WIDTH)),  # coefficients of cosine, sine, X, Y and 1 in the penetration
    ("arms", "f8", (PAIR_COUNT, 2, WIDTH)),  # coefficients of cosine and sine in the arm
    ("enabled", "i8", _PAIRS),  # 1 if the pair can touch
    ("constant", "f8", (3, WIDTH)),
    ("inverse_mass", "f8", _LANES_OF),
    ("inverse_inertia", "f8", _LANES_OF),
    ("radius", "f8", _LANES_OF),
    ("weight", "f8", _LANES_OF),
    ("stiffness", "f8", _LANES_OF),
    ("viscous", "f8", _LANES_OF),
    ("damped", "f8", _LANES_OF),  # C / K
    ("half_cavity", "f8", _LANES_OF),
    ("mass", "f8", (3, WIDTH)),  # sampled loads: mass, mass and inertia
    ("small", "f8", _LANES_OF),  # size of a term, over the longest admissible step, below which it is treated as zero
    ("threshold", "f8", (MOST_LACUNA, WIDTH)),  # admissible sizes of the last orders, as velocities
    ("stretch", "f8", _LANES_OF),  # log2 of velocity tolerance / (position tolerance (order + 1))
    # the following fields are used only for friction
    ("friction", "f8", _LANES_OF),  # mu
    ("per_slip_speed", "f8", _LANES_OF),  # 1 / v_s
    # the following fields are used only for exponents other than 1
    ("exponent", "f8", _LANES_OF),
    ("release", "f8", _LANES_OF),  # penetration below which the force is negligible
    # state
    ("y", "f8", (COMPONENTS, WIDTH)),  # state at the start of the step
    ("factor", "f8", _PAIRS),  # lambda
    ("mode", "i8", _PAIRS),
    ("time", "f8", _LANES_OF),
    ("before_it", "f8", _LANES_OF),  # size of the previous step in s
    ("touch_time", "f8", _LANES_OF),  # time of the last touch
    ("touched", "i8", _LANES_OF),  # bit mask of the pairs that touch at the start of the step
    ("counts", "i8", (COUNTS, WIDTH)),  # counts of the state records, indexed by `STEPS` to `AT_ONCE`
    # the following fields are derived from the modes (`note_modes`, `_weigh_lanes`)
    ("on", "i8", (PAIR_COUNT,)),  # bit mask of the lanes in which the pair is ON
    ("off", "i8", (PAIR_COUNT,)),  # bit mask of the lanes in which the pair is OFF and can touch
    ("taken", "i8", (PAIR_COUNT,)),  # bit mask of the lanes that use the slot
    ("watched", "i8", _LANES_OF),  # bit mask of the guard functions that are always searched
    ("inside", "i8", _LANES_OF),  # bit mask of the pairs that penetrate
    ("carrying", "i8", _LANES_OF),  # bit mask of the pairs that are ON, or -1 if it must be determined again
    ("along", "f8", (2, 6, WIDTH)),  # coefficients of c, s, X or Y and of their rates in the forces along X and Y
    # the moment is c Gc + s Gs - X fy + Y fx; coefficients of c, s, X, Y and of their rates in Gc and Gs
    ("turn", "f8", (2, 8, WIDTH)),
    ("slot", "i8", _PAIRS),  # index of the pair in each slot
    ("gear", "f8", (PAIR_COUNT, 8, WIDTH)),  # values of `rows`, `arms` and `factor` for the pair in each slot
]
BLOCK: Final = np.dtype(_BLOCK_FIELDS)


def _begin_of(field: str) -> int:
    parts: Any = BLOCK.fields
    return int(parts[field][1])


#: Offsets in `BLOCK` [B] of the state, of the data derived from modes, of `slot` and of `gear`. `_SIZE` and `_GEAR` are
#: the sizes [B] of a block and of one slot's data in `gear`.
_STATE, _NOTES, _SLOTS, _GEARS = _begin_of("y"), _begin_of("on"), _begin_of("slot"), _begin_of("gear")
_SIZE: Final = BLOCK.itemsize
_GEAR: Final = (_SIZE - _GEARS) // PAIR_COUNT

LANES: Final = np.dtype(
    [
        *_BLOCK_FIELDS,
        ("series", "f8", (COMPONENTS, _ROWS, WIDTH)),  # state
        ("moment", "f8", (4, _ROWS, WIDTH)),  # factors of c, s, X and Y in the moment of the contacts
        ("load", "f8", (3, _ROWS, WIDTH)),  # S1, S2, M
        # penetration of the pair in each slot; not used if F is linear in d and d'
        ("depth", "f8", (PAIR_COUNT, _ROWS, WIDTH)),
        ("push", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # F / K of the pair in each slot
        ("guard", "f8", (_ROWS, WIDTH)),  # eight guard functions of an iteration, which may be of any lanes
        ("ending", "f8", (GUARDS, WIDTH)),  # first roots of the guard functions of each iteration, or infinity
        ("bernstein", "f8", (_ROWS, WIDTH)),
        ("bulge", "f8", (_ROWS, WIDTH)),  # forces whose maximum is not yet computed and may exceed the peak
        ("bulge_step", "f8", _LANES_OF),  # step sizes for the forces in `bulge`
        # guard functions of an iteration: coefficients of the penetration, factors of d and d', constant
        ("chosen", "f8", (8, WIDTH)),
        ("direction", "f8", (4, WIDTH)),
        ("slope", "f8", (3, WIDTH)),  # sampled loads: slope from the previous sample to the next sample
        ("sample", "f8", (3, WIDTH)),  # sampled loads: value at the previous sample
        ("held", "f8", (3, WIDTH)),  # load at the start of the step, including the constant loads
        ("next", "f8", (3, WIDTH)),  # sampled loads: value at the next sample
        ("knot", "f8", _LANES_OF),  # sampled loads: time of the previous sample
        ("change", "f8", (COMPONENTS, WIDTH)),  # change of the state over the step
        ("gained", "f8", (2, WIDTH)),  # scratch space for one slot: impulse over the step, and peak
        ("sum", "f8", (4, WIDTH)),  # time integrals over the step of the changes of cosine, sine, X, Y
        # one harmonic load: frequency, sine, cosine, amplitudes of S1, S2 and M, phase
        ("harmonic", "f8", (10, WIDTH)),
        ("size", "f8", (MOST_LACUNA, WIDTH)),  # sizes of the terms of the last orders, as velocities
        ("step", "f8", _LANES_OF),  # step size in s
        ("accurate", "f8", _LANES_OF),  # step size without events
        ("stop", "f8", _LANES_OF),  # latest time at which the current step may end
        ("whole", "f8", _LANES_OF),  # longest admissible step in s
        ("reach", "f8", _LANES_OF),  # guard functions of an iteration: end of the interval that is searched
        ("root", "f8", _LANES_OF),  # guard functions of an iteration: first root
        ("begin", "f8", _LANES_OF),  # guard functions of an iteration: time of the pair's separation, or 0
        ("parted", "f8", _PAIRS),  # time at which a CLIPPED pair separates, or infinity
        ("peak", "f8", _PAIRS),
        ("impulse", "f8", _PAIRS),
        ("time_in_contact", "f8", _PAIRS),
        ("out", "f8", (COMPONENTS, WIDTH)),  # state at one time of each lane
        ("pair_values", "f8", (3, PAIR_COUNT, WIDTH)),  # penetration, rate, force
        # blocks whose rows are lanes and whose columns are pairs or components, and the transposes of these blocks
        ("staged", "f8", (_BLOCKS, WIDTH, PAIR_COUNT)),
        ("turned", "f8", (_BLOCKS, PAIR_COUNT, WIDTH)),
        # state, lambda, modes, `touch_time`, `before_it` and `touched` at the previous sample
        ("kept", "f8", (3 * PAIR_COUNT + 3, WIDTH)),
        ("kept_counts", "i8", (COUNTS, WIDTH)),
        ("member", "i8", _LANES_OF),  # index of the scene in a lane, -1 for an empty lane
        ("switching", "i8", _LANES_OF),  # bit mask of the pairs whose mode changes at the end of the step
        ("switch", "i8", _PAIRS),  # modes of these pairs after the step
        ("event", "i8", _LANES_OF),  # number of the guard function that ends the step, or -1
        ("ends_at_stop", "i8", _LANES_OF),
        ("todo", "i8", _LANES_OF),  # bit mask of the guard functions that have not been searched yet
        ("guarded", "i8", (GUARDS, WIDTH)),  # numbers of the guard functions of each iteration, or -1
        ("owner", "i8", (GUARDS, WIDTH)),  # lanes of these guard functions
        ("row_place", "i8", _LANES_OF),  # offset in `rows` for each guard function of an iteration
        ("bulge_pair", "i8", _LANES_OF),
        ("bulge_lane", "i8", _LANES_OF),
        ("orders", "i8", _LANES_OF),  # order of each lane's series; higher terms are negligible
        # the following fields are used only for exponents other than 1
        ("power", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # d^n of the pair in each slot
        # base of the power: d, or d / sigma^2 for a pair that touches at the start of the step; d^2 if n is an integer
        ("base", "f8", (PAIR_COUNT, _ROWS, WIDTH)),
        ("rate", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # d' of the pair in each slot
        ("swept", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # d^n d' of the pair in each slot
        ("per_base", "f8", _PAIRS),  # 1 / base at the start of the step
        # the following fields are used only for friction, for the pair in each slot; r = s' / v_s
        ("slip", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # k r_k, and r_0 in row 0
        ("tanh", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # tanh r
        ("rest", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # 1 - tanh^2 r
        # the following fields are used only for exponents that are not integers
        ("rates", "f8", (4, _ROWS, WIDTH)),  # rates of cosine, sine, X and Y
        ("alpha", "f8", _LANES_OF),  # the time since the start of the step is alpha sigma + beta sigma^2 / 2
        ("beta", "f8", _LANES_OF),
        ("duration", "f8", _LANES_OF),  # step size in s; `step` and `whole` are values of sigma
        ("may_stop", "i8", _LANES_OF),  # 1 if a step of the size `whole` ends at `stop`
        ("touching", "i8", (PAIR_COUNT,)),  # bit mask of the lanes whose pair in the slot touches at the step's start
        # single numbers come last, so that each of the rows before them fills a cache line
        ("live", "i8", (1,)),  # bit mask of the lanes that have a scene
        ("noted", "i8", (1,)),  # `live` at the last call of `note_modes`; -1 if its results were read from the block
        ("parting", "i8", (1,)),  # bit mask of the lanes in which a CLIPPED pair separates
        ("rounds", "i8", (1,)),
        ("bulges", "i8", (1,)),  # number of forces in `bulge`
        ("vanished", "i8", (1,)),  # bit mask of the lanes whose series ends early
        ("failed", "i8", (1,)),  # sampled loads: bit mask of the lanes whose series was not finite
        ("stale", "i8", (1,)),  # 1 if modes or scenes have changed since the last call of `_weigh_lanes`
    ]
)


#: Terms that lanes support: a contact law without a ramp, regularised friction, and harmonic loads. A scene leaves its
#: lane for flight and rest.
_COVERED: Final = {"harmonics", "second", "viscous", "hysteretic", "integer", "fraction", "slip", "flight", "rest"}


def fits_lanes(compiled: CompiledScene, *, sampled: bool = False) -> bool:
    """Return whether a scene can run in lanes: it has only the terms `_COVERED` or samples, and no `Options`."""
    parts = compiled.parts._replace(terms=compiled.parts.terms._replace(segments=None)) if sampled else compiled.parts
    present = (name for name, term in zip(Terms._fields, parts.terms, strict=True) if term is not None)
    return parts.implicit is None and _COVERED.issuperset(present) and not any(options(compiled.scene))


def forces(terms: Terms) -> tuple[int | None, int | None, int | None]:
    """Return flags, 1 or None: for exponents other than 1, for exponents that are not integers, and for friction."""
    return 1 if terms.integer or terms.fraction else None, terms.fraction, terms.slip


def new_lanes() -> NDArray[np.void]:
    """Return empty lanes, shape (1,)."""
    lanes = new_records(LANES, 1)
    lanes["member"] = -1
    # an empty lane needs finite results
    lanes["y"][:, COS] = lanes["half_cavity"] = lanes["whole"] = 1.0
    return lanes


@kernel()
def load_lane(p, state, power, slip, lanes, lane, member) -> None:
    """Load a scene into a lane. The caller has to call `join_lanes` afterwards."""
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
    lanes.damped[lane], lanes.half_cavity[lane] = p.viscous / p.stiffness, p.half_cavity
    if power is not None:
        lanes.exponent[lane], lanes.release[lane] = p.exponent, p.release
    if slip is not None:
        lanes.friction[lane], lanes.per_slip_speed[lane] = p.friction, 1.0 / p.slip_speed
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
    """Copy scenes from `staged` to the lanes in `bits`, and update what depends on the modes of their pairs."""
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
    for lane in range(WIDTH):
        if bits >> lane & 1:
            lanes.carrying[lane] = -1
    note_modes(lanes)
    lanes.stale[0] = 1


@kernel()
def write_place(state, lanes, lane) -> None:
    """Write the time and the body coordinates of a lane to a state record."""
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
    """Empty some lanes. The caller has to call `note_modes` afterwards."""
    for lane in range(WIDTH):
        if bits >> lane & 1:
            lanes.member[lane] = -1
    lanes.live[0] &= ~bits


@kernel(inline="code")
def _exchanged(bits):
    """Return the transpose of the 8 x 8 bits of an integer."""
    swapped = (bits ^ bits >> 7) & 0x00AA00AA00AA00AA
    bits ^= swapped ^ swapped << 7
    swapped = (bits ^ bits >> 14) & 0x0000CCCC0000CCCC
    bits ^= swapped ^ swapped << 14
    swapped = (bits ^ bits >> 28) & 0x00000000F0F0F0F0
    return bits ^ swapped ^ swapped << 28


@kernel()
def note_modes(lanes) -> None:
    """Derive the guard functions of all lanes from the modes, and assign the pairs that are ON to slots."""
    live, acting, inside, taken = lanes.live[0], 0, 0, 0
    lanes.noted[0] = live
    for pair in range(PAIR_COUNT):
        on, off = equal(lanes.mode, pair, ON) & live, equal(lanes.mode, pair, OFF) & live
        lanes.on[pair], lanes.off[pair] = on, off & ~equal(lanes.enabled, pair, 0)
        acting |= on << WIDTH * pair
        inside |= (live & ~off) << WIDTH * pair
    acting, inside = _exchanged(acting), _exchanged(inside)
    for lane in range(WIDTH):
        pairs = acting >> PAIR_COUNT * lane & _ALL
        lanes.inside[lane] = inside >> PAIR_COUNT * lane & _ALL
        lanes.watched[lane] = (lanes.inside[lane] ^ pairs) * (1 | 1 << SECOND)
        same, slot = pairs == lanes.carrying[lane], 0
        lanes.carrying[lane] = pairs
        while pairs != 0:
            pair = lowest_bit(pairs)
            pairs &= pairs - 1
            if not same:
                _take_slot(lanes, lane, pair, slot)
            taken |= 1 << WIDTH * slot + lane
            slot += 1
    for slot in range(PAIR_COUNT):
        lanes.taken[slot] = taken >> WIDTH * slot & _ALL


@kernel()
def _take_slot(lanes, lane, pair, slot) -> None:
    gear = lanes.gear[slot]
    for i in range(5):
        gear[i, lane] = lanes.rows[pair, i, lane]
    gear[5, lane], gear[6, lane] = lanes.arms[pair, 0, lane], lanes.arms[pair, 1, lane]
    gear[7, lane], lanes.slot[slot, lane] = lanes.factor[pair, lane], pair


@kernel()
def refresh(lanes, hysteretic, power, slip) -> None:
    """Update the linear maps of `_weigh_lanes` if modes or scenes have changed."""
    if lanes.stale[0] == 1:
        if hysteretic is None and power is None and slip is None:
            _weigh_lanes(lanes)
        lanes.stale[0] = 0


@kernel()
def _weigh_lanes(lanes) -> None:
    """Write the linear maps from an order of the state to the same order of the forces, summed over acting pairs.

    Along a wall's normal, f = -n F with F = K (a c + b s + n Z) + C (a c' + b s' + n Z'), where Z is X or Y. The moment
    is c Gc + s Gs - X fy + Y fx with sums Gc and Gs of F times the coefficients of the arms.
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
    """Add `factor` times the force of a slot to a linear map."""
    spring, damper = factor * stiffness, factor * viscous
    for i in range(rates):
        at = third if i == 2 else fourth if i == 3 else i
        set_row(there, i, fused(spring, exact_row(gear, at), exact_row(there, i)))
        set_row(there, rates + i, fused(damper, exact_row(gear, at), exact_row(there, rates + i)))


@kernel()
def read_block(lanes, block) -> None:
    """Copy constants, state and the data derived from modes from a block to the lanes."""
    copy_part(lanes, block, 0, _SLOTS)
    used = 0
    while used < PAIR_COUNT and lanes.taken[used] != 0:
        used += 1
    if used > 0:
        copy_part(lanes, block, _SLOTS, _GEARS + used * _GEAR)
    lanes.noted[0] = -1


@kernel()
def write_block(block, lanes, new) -> None:
    """Copy the state of the lanes to their block; also changed data derived from modes, and constants if `new`."""
    copy_part(block, lanes, 0 if new else _STATE, _NOTES if lanes.noted[0] < 0 else _SIZE)


@kernel(inline="code")
def set_state(there, x, y, vx, vy, om, c, s, angle) -> None:
    """Write the components of a state, or those of its change, of all lanes."""
    set_row(there, X, x)
    set_row(there, Y, y)
    set_row(there, VX, vx)
    set_row(there, VY, vy)
    set_row(there, OMEGA, om)
    set_row(there, COS, c)
    set_row(there, SIN, s)
    set_row(there, THETA, angle)


@kernel(inline="code")
def places_of(numbers):
    """Return an array of eight integers as a tuple for `gathered`."""
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
    """Write the Bernstein coefficients on [0, h] of one polynomial of each lane to `lanes.bernstein`."""
    b, power = lanes.bernstein, exact_splat(1.0)
    for k in range(order + 1):
        set_row(b, k, exact_row(column, k) * (power * w.binomial[order, k]))
        power = power * h
    sum_to_bernstein(b, order)
