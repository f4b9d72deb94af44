"""Eight scenes side by side: their series and constants, one number a lane in each row."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import choose, exact_row, exact_splat, fused, set_row
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.compiled_scene import CompiledScene, options
from plow_twin.solve.state import CLIPPED, COS, MAX_ORDER, OFF, ON, Terms, new_records

#: Scenes in a vector.
WIDTH: Final = 8
#: Components of the state in a lane's series.
COMPONENTS: Final = 8
#: Indices of the rates of cosine, sine, X and Y, and of the factors of cosine, sine, X and Y in the moment.
DC, DS, DX, DY = range(4)
#: First guards of the eight pairs, second guards of clipped pairs, pairs that part within the step and touch again.
SECOND: Final = PAIR_COUNT
AGAIN: Final = 2 * PAIR_COUNT

_ROWS: Final = MAX_ORDER + 1
_PAIRS: Final = (PAIR_COUNT, WIDTH)
_LANES_OF: Final = (WIDTH,)

LANES: Final = np.dtype(
    [
        ("series", "f8", (COMPONENTS, _ROWS, WIDTH)),  # state
        ("turning", "f8", (4, _ROWS, WIDTH)),  # rates of cosine, sine, X, Y
        ("moment", "f8", (4, _ROWS, WIDTH)),  # factors of cosine, sine, X and Y in the contacts' moment
        ("load", "f8", (3, _ROWS, WIDTH)),  # S1, S2, M
        ("depth", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # with lambda d': penetration of pairs that are on in some lane
        ("push", "f8", (PAIR_COUNT, _ROWS, WIDTH)),  # and their F / K
        ("guard", "f8", (2 * PAIR_COUNT, _ROWS, WIDTH)),
        ("column", "f8", (_ROWS, WIDTH)),  # one guard of each lane
        ("bernstein", "f8", (_ROWS, WIDTH)),
        ("rows", "f8", (PAIR_COUNT, 4, WIDTH)),  # penetration: factors of cosine, sine, X or Y, constant
        ("arms", "f8", (PAIR_COUNT, 2, WIDTH)),  # arm: factors of cosine and sine
        ("sign", "f8", _PAIRS),  # of the penetration in a pair's first guard, 0 for pairs that cannot touch
        ("ratio", "f8", _PAIRS),  # C / K of pairs that are on
        ("factor", "f8", _PAIRS),  # lambda
        ("start", "f8", (4, WIDTH)),  # contact forces along X and Y, factors of c and s in the moment, at the start
        ("along", "f8", (2, 6, WIDTH)),  # higher orders of the forces: of c, s, X or Y, their rates
        ("turn", "f8", (2, 8, WIDTH)),  # and of the factors in the moment: of c, s, X, Y, their rates
        ("constant", "f8", (3, WIDTH)),
        ("slope", "f8", (3, WIDTH)),  # sampled loads: rise from the last sample to the next one
        ("sample", "f8", (3, WIDTH)),  # the last one
        ("held", "f8", (3, WIDTH)),  # load at the step's start, the constant one with it
        ("knot", "f8", _LANES_OF),  # time of the last sample
        ("small", "f8", _LANES_OF),  # size of a term over the longest step wanted that has vanished
        ("direction", "f8", (4, WIDTH)),
        ("inverse_mass", "f8", _LANES_OF),
        ("inverse_inertia", "f8", _LANES_OF),
        ("radius", "f8", _LANES_OF),
        ("weight", "f8", _LANES_OF),
        ("stiffness", "f8", _LANES_OF),
        ("viscous", "f8", _LANES_OF),
        ("half_cavity", "f8", _LANES_OF),
        ("y", "f8", (COMPONENTS, WIDTH)),  # state at the step's start
        ("change", "f8", (COMPONENTS, WIDTH)),  # of the state over the step
        ("sum", "f8", (4, WIDTH)),  # integrals of cosine, sine, X, Y over the step, less their values at its start
        ("harmonic", "f8", (10, WIDTH)),  # one load: frequency, sine, cosine, amplitudes of S1, S2, M; phase
        ("size", "f8", (2, WIDTH)),  # of the last two orders as velocities
        ("step", "f8", _LANES_OF),  # step size in s
        ("accurate", "f8", _LANES_OF),  # step size before an event ends the step
        ("stop", "f8", _LANES_OF),  # time at which a step must end
        ("whole", "f8", _LANES_OF),  # the longest step wanted
        ("reach", "f8", _LANES_OF),  # how far a column is searched
        ("root", "f8", _LANES_OF),  # its first root
        ("parted", "f8", _PAIRS),  # when a clipped pair parts within the step, infinity where it does not
        ("parting", "i8", (1,)),  # a bit for each lane in which a clipped pair parts
        ("peak", "f8", _PAIRS),
        ("impulse", "f8", _PAIRS),
        ("time_in_contact", "f8", _PAIRS),
        ("out", "f8", (COMPONENTS, WIDTH)),  # one scene at eight instants, or eight scenes
        ("told", "f8", (3, PAIR_COUNT, WIDTH)),  # penetration, rate, force
        ("time", "f8", _LANES_OF),
        ("member", "i8", _LANES_OF),  # the scene in a lane, -1 for an empty lane
        ("mode", "i8", _PAIRS),
        ("switch", "i8", _PAIRS),  # modes that pairs take at the step's end, -1 for no change
        ("on", "i8", (PAIR_COUNT,)),  # a bit for each lane in which the pair is on
        ("clipped", "i8", (PAIR_COUNT,)),
        ("leaves", "i8", (PAIR_COUNT,)),  # clipped, and cannot touch again within the step
        ("inside", "i8", _LANES_OF),  # pairs that penetrate
        ("event", "i8", _LANES_OF),  # the guard that ends the step, or -1
        ("ends_at_stop", "i8", _LANES_OF),
        ("todo", "i8", _LANES_OF),  # a bit for each guard that is still to be searched
        ("guarded", "i8", _LANES_OF),  # the guard in the column
        ("orders", "i8", _LANES_OF),  # of the series of each lane: the terms beyond have vanished
        ("vanished", "i8", (1,)),  # a bit for each lane whose series ends early
        ("before", "i8", _LANES_OF),  # steps before the sample
        ("carrying", "i8", _LANES_OF),  # a bit for each pair that is on
        ("stale", "i8", (1,)),  # 1 where modes or scenes have changed since the maps were summed
    ]
)


#: Terms that the lanes cover: the force is linear in penetration and rate, nothing but harmonics drives the head.
_COVERED: Final = {"harmonics", "second", "viscous", "hysteretic", "flight", "rest"}


def fits_lanes(compiled: CompiledScene, *, sampled: bool = False) -> bool:
    """Return whether the lanes take the steps of a scene.

    Its exponent is 1, it has no other term than damping and harmonics or samples, and no `Options`.
    """
    parts = compiled.parts._replace(terms=compiled.parts.terms._replace(segments=None)) if sampled else compiled.parts
    there = (name for name, term in zip(Terms._fields, parts.terms, strict=True) if term is not None)
    return parts.implicit is None and _COVERED.issuperset(there) and not any(options(compiled.scene))


def new_lanes() -> NDArray[np.void]:
    """Return empty lanes, shape (1,)."""
    lanes = new_records(LANES, 1)
    lanes["member"] = -1
    # an empty lane computes with a scene at rest
    lanes["y"][:, COS] = lanes["half_cavity"] = lanes["whole"] = 1.0
    return lanes


@kernel()
def load_lane(p, state, totals, lanes, lane, member) -> None:
    """Put a scene into a lane."""
    lanes.member[lane] = member
    for i in range(COMPONENTS):
        lanes.y[i, lane] = state.y[i]
    lanes.time[lane] = state.step_start
    for pair in range(PAIR_COUNT):
        along = 3 - pair % 2  # horizontal walls first: Y, then X
        lanes.rows[pair, 0, lane], lanes.rows[pair, 1, lane] = p.penetration_rows[0, pair], p.penetration_rows[1, pair]
        lanes.rows[pair, 2, lane] = p.penetration_rows[along, pair]
        lanes.rows[pair, 3, lane] = p.penetration_rows[4, pair] - state.wear_depth[pair]
        lanes.arms[pair, 0, lane], lanes.arms[pair, 1, lane] = p.arm_rows[0, pair], p.arm_rows[1, pair]
        lanes.mode[pair, lane], lanes.factor[pair, lane] = state.mode[pair], state.damping_factor[pair]
        lanes.peak[pair, lane], lanes.impulse[pair, lane] = totals.peak[pair], totals.impulse[pair]
        lanes.time_in_contact[pair, lane] = totals.time_in_contact[pair]
    for j in range(3):
        lanes.constant[j, lane] = p.constant[j]
    for i in range(2):
        for j in range(2):
            lanes.direction[2 * i + j, lane] = p.direction[i, j]
    lanes.inverse_mass[lane], lanes.inverse_inertia[lane] = p.inverse_mass, p.inverse_inertia
    lanes.radius[lane], lanes.weight[lane] = p.radius, p.weight
    lanes.stiffness[lane], lanes.viscous[lane] = p.stiffness, p.viscous
    lanes.half_cavity[lane] = p.half_cavity
    state.in_flight = state.at_rest = 0
    note_modes(p, lanes, lane)


@kernel()
def write_place(state, lanes, lane) -> None:
    """Write the place of a lane to a state's record."""
    for i in range(COMPONENTS):
        state.y[i] = lanes.y[i, lane]
    state.step_start = lanes.time[lane]


@kernel()
def write_state(state, lanes, lane) -> None:
    """Write all that a lane has of a state to its record."""
    write_place(state, lanes, lane)
    state.time = lanes.time[lane]
    for pair in range(PAIR_COUNT):
        state.mode[pair], state.damping_factor[pair] = lanes.mode[pair, lane], lanes.factor[pair, lane]


@kernel()
def save_lane(state, totals, lanes, lane) -> None:
    """Take a scene out of its lane."""
    write_state(state, lanes, lane)
    for pair in range(PAIR_COUNT):
        totals.peak[pair], totals.impulse[pair] = lanes.peak[pair, lane], lanes.impulse[pair, lane]
        totals.time_in_contact[pair] = lanes.time_in_contact[pair, lane]
    clear_lane(lanes, lane)


@kernel()
def clear_lane(lanes, lane) -> None:
    """Empty a lane."""
    lanes.member[lane] = -1
    rest = ~(1 << lane)
    for pair in range(PAIR_COUNT):
        lanes.on[pair] &= rest
        lanes.clipped[pair] &= rest


@kernel()
def note_modes(p, lanes, lane) -> None:
    """Write the modes of a lane's pairs to their guards and maps."""
    bit, inside, carrying = 1 << lane, 0, 0
    for pair in range(PAIR_COUNT):
        mode = lanes.mode[pair, lane]
        lanes.sign[pair, lane] = 0.0 if p.enabled[pair] == 0 else -1.0 if mode == OFF else 1.0
        lanes.ratio[pair, lane] = p.viscous / p.stiffness if mode == ON else 0.0
        lanes.on[pair] = lanes.on[pair] | bit if mode == ON else lanes.on[pair] & ~bit
        lanes.clipped[pair] = lanes.clipped[pair] | bit if mode == CLIPPED else lanes.clipped[pair] & ~bit
        inside += 0 if mode == OFF else 1
        carrying |= 1 << pair if mode == ON else 0
    lanes.inside[lane], lanes.carrying[lane] = inside, carrying


@kernel()
def weigh_lanes(lanes) -> None:
    """Sum over the acting pairs of each lane: the orders of all forces together are a linear map of the state's orders.

    Along a wall's normal  f = -n F,  F = K (a c + b s + n Z) + C (a c' + b s' + n Z'), Z = X or Y; the moment is
    c Gc + s Gs - X fy + Y fx  with  Gc, Gs = sum of the arms' factors times F.
    """
    along, turn, zero = lanes.along, lanes.turn, exact_splat(0.0)
    for i in range(6):
        set_row(along[0], i, zero)
        set_row(along[1], i, zero)
    for i in range(8):
        set_row(turn[0], i, zero)
        set_row(turn[1], i, zero)
    for pair in range(PAIR_COUNT):
        if lanes.on[pair] == 0:
            continue
        stiffness = choose(lanes.on[pair], exact_row(lanes.stiffness, 0), zero)
        viscous = choose(lanes.on[pair], exact_row(lanes.viscous, 0), zero)
        rows, axis = lanes.rows[pair], 1 - pair % 2
        _add(along[axis], 2, 3, exact_row(rows, 2) * -1.0, rows, stiffness, viscous)
        for i in range(2):
            _add(turn[i], 2 + axis, 4, exact_row(lanes.arms[pair], i), rows, stiffness, viscous)


@kernel()
def _add(there, third, rates, factor, rows, stiffness, viscous) -> None:
    """Add a factor times the force of one pair to an affine map."""
    spring, damper = factor * stiffness, factor * viscous
    for i in range(3):
        at = third if i == 2 else i
        set_row(there, at, fused(spring, exact_row(rows, i), exact_row(there, at)))
        set_row(there, rates + at, fused(damper, exact_row(rows, i), exact_row(there, rates + at)))


@kernel()
def penetration_at(lanes, pair, c, s, along):
    """Return the penetrations of a pair in all lanes."""
    rows = lanes.rows[pair]
    constant = exact_row(rows, 3)
    return fused(exact_row(rows, 0), c, fused(exact_row(rows, 1), s, fused(exact_row(rows, 2), along, constant)))


@kernel(inline="code")
def damped_at(lanes, pair, ratio, depth, dc, ds, rate):
    """Return penetration and `ratio` times its rate of a pair in all lanes."""
    rows = lanes.rows[pair]
    a, b, n = exact_row(rows, 0) * ratio, exact_row(rows, 1) * ratio, exact_row(rows, 2) * ratio
    return fused(a, dc, fused(b, ds, fused(n, rate, depth)))
