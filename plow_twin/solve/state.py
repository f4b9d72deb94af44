"""Records of the compiled kernels: constants of a scene, dynamic state, scratch space and totals.

Parts that a scene lacks are `None`: the compiled signature then holds `none`, and their code is not compiled.
"""

from __future__ import annotations

import math
from enum import IntEnum
from functools import cache
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.polynomial import MAX_HALVINGS
from plow_twin.model.geometry import STATE_SIZE
from plow_twin.model.pairs import PAIR_COUNT

Array = NDArray[np.float64]

#: Highest order of the series; the tolerance decides how many terms are used.
MAX_ORDER: Final = 30

# indices into Work.per_pair
ACTS, DAMPS, BASE, SIGN, RATIO, SUM, FIRST, SECOND, RAMPS = range(9)

# contact modes; the first three are public
OFF: Final = 0
ON: Final = 1
CLIPPED: Final = 2
#: Penetrating less than `Params.release`, where the force is negligible (exponents that are not integers).
RELEASED: Final = 3
#: Not a mode but the outcome of an event: a pair crosses the end of its damping's ramp.
CROSSING: Final = 4
#: Further outcomes of an event: the corner slips along the wall, forward or backward, or sticks.
SLIPS_FORWARD: Final = 5
SLIPS_BACKWARD: Final = 6
STICKS: Final = 7

# indices into State.y
X, Y, VX, VY, OMEGA, COS, SIN, THETA = range(STATE_SIZE)


class Status(IntEnum):
    """How an advance ended.

    Attributes
    ----------
    OK
        The time asked for was reached.
    OUT_OF_RANGE
        abs(theta) above 45 degrees, or half the cavity penetrated: the pairs no longer describe the contacts.
    NON_FINITE
        A number became infinite or NaN.
    BUDGET
        The steps that an advance may take were used up.
    LOG_FULL, PAUSED
        Internal; never the status of an advance.
    """

    OK = 0
    OUT_OF_RANGE = 1
    NON_FINITE = 2
    BUDGET = 3
    #: internal: the event log is full; the caller makes room and continues
    LOG_FULL = 4
    #: internal: a slice of the work is done; the caller checks its limits and continues
    PAUSED = 5

    @property
    def text(self) -> str:
        """Return the status as a sentence."""
        return _STATUS_TEXT[self]


_STATUS_TEXT: Final = {
    Status.OK: "done",
    Status.OUT_OF_RANGE: "the head left the model's range: |theta| above 45 degrees or half the cavity penetrated",
    Status.NON_FINITE: "the motion became non-finite; load, stiffness or damping is too large for double precision",
    Status.BUDGET: "the budget of steps was used up before the time asked for",
    Status.LOG_FULL: "the event log is full",
    Status.PAUSED: "a slice of the work is done",
}


# Records rather than tuples of arrays: a kernel gets one pointer, shapes are constants, and nothing is reference
# counted.

_ROWS: Final = MAX_ORDER + 1
_WIDE: Final = (_ROWS, PAIR_COUNT)
#: Size of a cache line in bytes.
_LINE: Final = 64


def _in_lines(fields: list[tuple[Any, ...]]) -> np.dtype[np.void]:
    """Return a record type that fills whole cache lines, so that each of many begins at one."""
    packed = np.dtype(fields)
    names = packed.names or ()
    parts: Any = packed.fields
    return np.dtype(
        {
            "names": names,
            "formats": [parts[name][0] for name in names],
            "offsets": [parts[name][1] for name in names],
            "itemsize": -(-packed.itemsize // _LINE) * _LINE,
        }
    )


#: Steps of the grid of restitutions on which their damping numbers are known; a step is the least restitution.
RESTITUTIONS: Final = 1000

#: Constants of one scene and one tolerance, per mass and inertia where that saves work.
_PARAM_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("penetration_rows", "f8", (5, PAIR_COUNT)),  # penetration rows for c, s, X, Y, 1
    ("arm_rows", "f8", (4, PAIR_COUNT)),  # arm rows for c, s, X, Y
    ("slip_rows", "f8", (4, PAIR_COUNT)),  # place along the wall, rows for c, s, X, Y
    ("slip_arm_rows", "f8", (4, PAIR_COUNT)),  # arm about G of a force along the wall
    ("wear_per_impulse", "f8", (PAIR_COUNT,)),  # depth of each pad per impulse, k_s v / A
    ("speed_per_wear", "f8"),  # A / k_s: turns depth per impulse into v; 0 where sliding in the plane does not wear
    ("running_in", "f8"),  # share by which a new pad wears faster
    ("running_in_rate", "f8"),  # 1 / h0 in 1/m, the rate at which this share falls with the depth
    ("enabled", "i8", (PAIR_COUNT,)),  # 1 where the pair can touch
    ("inverse_mass", "f8"),
    ("inverse_inertia", "f8"),
    ("stiffness", "f8"),
    ("exponent", "f8"),
    ("viscous", "f8"),  # C in N s/m, 0 without
    ("damping_number", "f8"),  # D of lambda = D / v0, or a negative number when lambda is constant
    ("speed_floor", "f8"),  # smallest v0
    ("ramp", "f8"),  # penetration over which C grows, 0 without
    ("gravity", "f8"),
    ("constant", "f8", (3,)),  # Fx/m, Fy/m - g, M/I of the constant loads
    ("direction", "f8", (2, 2)),  # directions (x, y) of the harmonic forces S1, S2
    ("offset", "f8", (2,)),  # centre of mass from the cavity's centre
    ("free", "f8", (3,)),  # 1 free, 0 locked
    ("friction", "f8"),  # mu
    ("slip_speed", "f8"),  # regularisation speed in m/s
    ("static_friction", "f8"),  # mu up to which a corner sticks
    ("stick_stiffness", "f8"),
    ("stick_damping", "f8"),
    ("frame_mobility", "f8", (3,)),  # 1/m, 1/m, 1/I of a frame on springs, otherwise 0
    ("frame_stiffness", "f8", (3,)),  # stiffness of the frame's support, per mass and inertia
    ("frame_damping", "f8", (3,)),
    ("order", "i8"),
    ("lacuna", "i8"),  # orders in a row that may vanish while the series goes on
    ("threshold", "f8", (_ROWS,)),  # admissible size of term k of a velocity over a step
    ("velocity_tolerance", "f8"),  # admissible error of a velocity
    ("position_tolerance", "f8"),  # admissible error of a position
    ("weight", "f8"),  # turns cos and sin into velocities
    ("radius", "f8"),  # turns angles into lengths
    ("release", "f8"),  # penetration below which the force is negligible
    ("fastest", "f8"),  # largest angular frequency of the harmonics
    ("leverage", "f8"),  # distance of a corner of the frame from its centre
    ("half_cavity", "f8"),  # penetration that ends the model's range
    ("max_events", "i8"),  # events at one instant before recovery
]
PARAMS: Final = _in_lines(_PARAM_FIELDS)

#: Constants that only some scenes have, by their `Options`.
_OPTION_FIELDS: Final[dict[str, list[tuple[Any, ...]]]] = {
    "corners": [("tumbles", "f8")],  # the head carries corners; 1 where the block may tumble
    "rounded": [("roll", "f8")],  # distance of a rounded corner along its wall by the angle [m]
    "falling": [  # a restitution that falls with the impact
        ("damping_numbers", "f8", (RESTITUTIONS + 1,)),  # e D(e) on a grid from 0 to 1
        ("restitution", "f8"),  # its value for impacts no faster than `fall_speed`
        ("fall", "f8"),  # power by which it falls
        ("fall_speed", "f8"),  # in m/s
        ("fall_mass", "f8"),  # power of the effective mass
        ("fall_along", "f8"),  # rate at which it falls with the speed along the wall, in s/m
    ],
}


class Options(NamedTuple):
    """Fields of the constants that only some scenes have."""

    corners: bool  #: the head carries corners
    rounded: bool  #: the corners are rounded
    falling: bool  #: the restitution falls with the impact


@cache
def params_type(options: Options) -> np.dtype[np.void]:
    """Return the record type of a scene's constants."""
    # further fields come first, as in `state_type`
    more = [field for name in Options._fields if getattr(options, name) for field in _OPTION_FIELDS[name]]
    return _in_lines([*more, *_PARAM_FIELDS]) if more else PARAMS


#: The whole state of the motion, and the step under way. Times in s.
_STATE_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("y", "f8", (STATE_SIZE,)),  # body coordinates at the step's start
    ("damping_factor", "f8", (PAIR_COUNT,)),  # lambda of each pair in s/m
    ("wear_depth", "f8", (PAIR_COUNT,)),  # wear depth of each pad in m
    ("mode", "i8", (PAIR_COUNT,)),
    ("beyond_ramp", "i8", (PAIR_COUNT,)),  # 1 where the penetration is beyond the ramp
    ("step_start", "f8"),
    ("elapsed", "f8"),  # time into the step under way
    ("step_size", "f8"),  # size of the step under way, negative without a step
    ("sigma_end", "f8"),  # the series' variable at the step's end
    ("alpha", "f8"),  # time runs as t = alpha sigma + beta sigma^2 / 2
    ("beta", "f8"),
    ("stop_time", "f8"),  # where a step must end: a sample, a knot of the load, the end of the run
    ("last_step_size", "f8"),
    ("touch_time", "f8"),  # time of the last touch
    ("time", "f8"),  # the present time, bit for bit as the caller gave it
    ("implicit_size", "f8"),  # size of the next implicit step
    ("decay_times", "f8"),  # that have passed in overdamped contact since a contact changed
    ("implicit_size_before", "f8"),  # both before the step under way was laid out
    ("decay_times_before", "f8"),
    ("order", "i8"),  # order of the series of the step under way
    ("event_pair", "i8"),  # the pair whose event ends the step, or -1
    ("event_mode", "i8"),  # the mode that follows
    ("touching", "i8"),  # a bit for each pair that touches at the step's start and needs the root of time
    ("events_at_once", "i8"),  # events so far at one instant
    ("piece", "i8"),  # piece of the sampled load
    ("ends_at_stop", "i8"),  # 1 where the step ends at `stop_time`
    ("refused", "i8"),  # failed attempts at implicit steps since a contact changed
    ("refused_before", "i8"),  # the same before the step under way was laid out
    ("in_flight", "i8"),  # 1 during a step of free flight
    ("at_rest", "i8"),  # 1 during a step of rest
    # counted since the start
    ("steps", "i8"),
    ("evaluations", "i8"),  # evaluations of the equations of motion; an order of a series counts as one
    ("events", "i8"),
    ("guard_roots", "i8"),  # guards whose roots were searched for
    ("recoveries", "i8"),  # times that modes flipped at one instant
    ("bounded", "i8"),  # advances whose end was coarse
    ("implicit_steps", "i8"),
]
STATE: Final = _in_lines(_STATE_FIELDS)
#: State of the corners' grip, for friction with stick.
_GRIP_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("anchor", "f8", (PAIR_COUNT,)),  # place along the wall in m where a sticking corner's spring is slack
    ("grip", "i8", (PAIR_COUNT,)),  # 0 sticks, 1 slips forward, -1 backward
]
#: A frame on springs: x, y, theta from where its springs are slack, and their rates; y is then relative to it.
_FRAME_FIELDS: Final[list[tuple[Any, ...]]] = [("frame", "f8", (6,))]

#: Scratch space: series of one step. Rows are orders, the eight columns state components or pairs: SIMD lanes. Arrays
#: of eight columns come first, so that each of their rows fills a cache line.
WORK: Final = np.dtype(
    [
        ("series", "f8", _WIDE),  # state
        ("left", "f8", _WIDE),  # factors of the Cauchy products
        ("right", "f8", _WIDE),
        ("penetration", "f8", _WIDE),  # penetration
        ("rate", "f8", _WIDE),  # its rate in time
        ("arm", "f8", _WIDE),
        ("damped", "f8", _WIDE),  # ramped damping: the ramp times the rate; other laws: not written
        ("force", "f8", _WIDE),
        ("wear", "f8", _WIDE),  # growth of the wear depth
        ("guard", "f8", _WIDE),
        ("bernstein", "f8", _WIDE),
        ("power", "f8", (4, *_WIDE)),  # powers of the penetration
        ("ramp", "f8", (3, *_WIDE)),  # square and cube of the penetration, share of C
        ("slip", "f8", (6, *_WIDE)),  # friction: slip rate r / v_s, k r_k, tanh r, 1 - tanh^2 r, force, arm
        ("frame", "f8", _WIDE),  # a frame on springs (`solve.support`)
        ("frame_left", "f8", (3, *_WIDE)),  # factors of its Cauchy products
        ("frame_right", "f8", (3, *_WIDE)),
        ("seen", "f8", _WIDE),  # implicit steps: the head as seen from the frame
        ("frame_sum", "f8", (PAIR_COUNT,)),
        ("grip", "f8", (3, PAIR_COUNT)),  # friction with stick: force per normal force, place and slip rate
        ("per_pair", "f8", (9, PAIR_COUNT)),  # masks and sums of the eight pairs
        ("moved", "f8", (STATE_SIZE,)),
        ("saved", "f8", (2, PAIR_COUNT)),  # y and wear depth at the time before an advance
        ("frame_now", "f8", (6,)),  # state of the frame where the motion was last read
        ("frame_saved", "f8", (6,)),  # and at the time before an advance
        ("load", "f8", (3, _ROWS)),  # S1, S2, M
        ("world", "f8", (4, _ROWS)),  # forces per mass in head and world axes
        ("column", "f8", (2, _ROWS)),  # one polynomial
        ("halves", "f8", (MAX_HALVINGS + 2, _ROWS)),
        ("bounds", "f8", (MAX_HALVINGS + 2, 2)),
        ("wrench", "f8", (2, 3)),  # value and slope at the step's start of the load that is linear in time
        ("flight", "f8", (6, 6)),  # start of a flight, what bounds it, scratch (`solve.method.flight`)
        ("rest", "f8", (4, 6)),  # place, rates and load at rest (`solve.method.rest`)
        ("hessian", "f8", (3, 3)),
        ("term_size", "f8", (_ROWS,)),  # size of each order as a velocity
        ("decay", "f8", (1,)),  # decay rate in 1/s of the damping, 0 where it does not bound steps
        ("switch", "i8", (PAIR_COUNT,)),  # modes that pairs take at the step's end, -1 for no change
        ("inverse", "f8", (_ROWS + 2,)),  # 1/k
        ("damping", "f8", (3, 3)),  # by rate, at rest under harmonics
        ("rub", "f8", (6, *_WIDE)),  # wear: s' / v, way per travel, force times it; running-in and its factors
        ("binomial", "f8", (_ROWS, _ROWS)),  # 1 / C(order, k)
        ("beyond", "f8", (3,)),  # newest advance out of range: angle [rad], largest penetration [m], its pair
    ]
)

#: Sums over the motion since they were last cleared.
TOTALS: Final = np.dtype(
    [
        ("peak", "f8", (PAIR_COUNT,)),
        ("impulse", "f8", (PAIR_COUNT,)),
        ("time_in_contact", "f8", (PAIR_COUNT,)),
        ("makes", "i8", (PAIR_COUNT,)),
        ("set_time", "f8", (2, 16)),  # time in each set of corners, counter-clockwise and clockwise pairs
        ("logged", "i8"),  # events in the log
    ]
)

#: Values of `ROW`'s `followed`.
FOLLOWED: Final = 1
WITH_INTERVALS: Final = 2

#: The record that goes from the solver to the messages: the motion at a time, and the sums since the row before.
ROW: Final = np.dtype(
    [
        ("t", "f8"),
        ("q", "f8", (3,)),
        ("v", "f8", (3,)),
        *((name, "f8", (PAIR_COUNT,)) for name in ("penetration", "rate", "force", "peak", "impulse")),
        ("time_in_contact", "f8", (PAIR_COUNT,)),
        ("makes", "i8", (PAIR_COUNT,)),
        ("wear_depth", "f8", (PAIR_COUNT,)),
        ("steps", "i8"),
        ("status", "i8"),
        ("error_estimate", "f8"),
        # in a published row (`solve.totals.publish`) touches count from the beginning, impulse and peak from the
        # publication before
        ("stamp_ns", "i8"),
        ("samples", "i8"),  # advances since then that ended at a sample
        ("measured_peak", "f8", (PAIR_COUNT,)),  # largest force in these
        ("held", "i8"),  # 1 where the motion at the stamp was computed without a sample
        ("corrected", "i8"),  # 1 where late samples have been worked in since then
        ("marked", "i8"),  # 1 where `held` or `corrected` is 1, here or in the publication before
        ("orientation", "f8", (2,)),  # z and w of the head's quaternion
        ("twist", "f8", (3,)),  # rates along the head's own axes [m/s], about z [rad/s]
        # written where the motion follows measurements: 5 % and 95 % points over the drawn twins; peak and impulse
        # since the publication before; clearances [m] with their points
        ("followed", "i8"),  # `FOLLOWED`: clearances are filled; `WITH_INTERVALS`: all fields are filled
        *((f"{name}_{end}", "f8", (PAIR_COUNT,)) for name in ("force", "peak", "impulse") for end in ("low", "high")),
        ("known_clearance", "f8", (6,)),  # horizontal, its points, vertical, its points
    ]
)

Params: TypeAlias = np.record
State: TypeAlias = np.record
Work: TypeAlias = np.record
Totals: TypeAlias = np.record
Implicit: TypeAlias = np.record


#: Harmonic loads, per mass and inertia, sine and cosine amplitudes: forces S1 and S2 along `direction`, moment M.
HARMONIC: Final = np.dtype([("omega", "f8"), ("first", "f8", (2,)), ("second", "f8", (2,)), ("moment", "f8", (2,))])

#: Linear pieces of a sampled load, per mass and inertia: value at the knot and slope from there.
SEGMENT: Final = np.dtype([("knot", "f8"), ("start", "f8", (3,)), ("slope", "f8", (3,))])

Harmonics: TypeAlias = NDArray[np.void]
Segments: TypeAlias = NDArray[np.void]


class Terms(NamedTuple):
    """Terms of the equations of motion: 1, or `None` for an absent term. Their numbers are in `Params`.

    The types are part of the compiled signature. A kernel takes them as separate arguments, since only a separate
    argument that is `None` leaves a branch out of the compiled code.
    """

    harmonics: int | None
    second: int | None  #: harmonic forces in two directions
    segments: int | None  #: linear pieces
    viscous: int | None  #: C d'
    hysteretic: int | None  #: lambda d', lambda from State.damping_factor
    integer: int | None  #: an integer exponent of at least 2
    fraction: int | None  #: an exponent that is not an integer
    ramp: int | None  #: the viscous part is ramped over the penetration
    wear: int | None
    sliding: int | None  #: sliding in the plane wears too
    running_in: int | None  #: new pads wear faster
    offset: int | None  #: the centre of mass is not the cavity's
    free: int | None  #: some degree of freedom is locked
    slip: int | None  #: regularised friction
    stick: int | None  #: friction with stick
    support: int | None  #: the frame is on springs
    flight: int | None  #: free flight in closed form (`solve.method.flight`)
    rest: int | None  #: rest can be recognised (`solve.method.rest`)


class Parts(NamedTuple):
    """Parts that a scene may lack: terms of the equations, loads of any number, nodes and space of implicit steps."""

    terms: Terms
    harmonics: Harmonics | None
    segments: Segments | None
    implicit: Implicit | None


#: Bounds of the work of an advance, and scratch space for its coarse end.
BOUND: Final = np.dtype(
    [
        ("steps", "i8"),  # Runge-Kutta steps that are kept for the end
        ("error", "f8"),  # estimate in m of the advance, 0 while the bound is not reached
        ("z", "f8", (6, 12)),  # state, trial state, four stages; also of a frame on springs
        ("load", "f8", (3,)),
        ("pairs", "f8", (4, PAIR_COUNT)),  # penetration, rate, force, force before
    ]
)

#: One change of contact: time in s, pair, modes before and after, rate of penetration in m/s.
EVENT: Final = np.dtype([("time", "f8"), ("pair", "i8"), ("mode_from", "i8"), ("mode_to", "i8"), ("rate", "f8")])

#: How far a call for many advances has come; it comes back after each slice of work.
PACE: Final = np.dtype(
    [
        ("slice", "i8"),  # steps of a slice
        ("left", "i8"),  # steps left of the slice
        ("row", "i8"),  # the next advance, members one after the other
        ("underway", "i8"),  # 1 where the advance has begun
        ("mark", "i8"),  # the next mark
        ("failed", "i8"),  # advances that failed
    ]
)

Bound: TypeAlias = np.record
Log: TypeAlias = NDArray[np.void]


def state_type(terms: Terms) -> np.dtype[np.void]:
    """Return the record type of a scene's state."""
    return _state_type(terms.stick is not None, terms.support is not None)


@cache
def _state_type(stick: bool, support: bool) -> np.dtype[np.void]:
    # further fields come first: numba takes a record with further fields at its end for the shorter type
    more = (_FRAME_FIELDS if support else []) + (_GRIP_FIELDS if stick else [])
    return _in_lines([*more, *_STATE_FIELDS]) if more else STATE


def new_record(dtype: np.dtype[np.void]) -> np.record:
    """Return a record of zeros."""
    return first_of(new_records(dtype, 1))


def first_of(records: NDArray[np.void]) -> np.record:
    """Return the first of some records, in place."""
    record: np.record = records.view(_with_attributes(records.dtype))[0]
    return record


@cache
def _with_attributes(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the record type whose fields are attributes."""
    return np.dtype((np.record, dtype))


def new_records(dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Return records of zeros that start at a cache line: rows of eight numbers then lie in one line each."""
    memory = np.zeros(count * dtype.itemsize + _LINE, np.uint8)
    start = -memory.ctypes.data % _LINE
    return np.ndarray(count, dtype, memory.data, start)


@cache
def _inverses() -> Array:
    """Return 0 and 1 / k, shape (orders + 2,)."""
    return np.append(0.0, 1.0 / np.arange(1, _ROWS + 2))


@cache
def _inverse_binomials() -> Array:
    """Return 1 / C(order, k), shape (orders, orders)."""
    table = np.zeros((_ROWS, _ROWS))
    for order in range(_ROWS):
        table[order, : order + 1] = [1.0 / math.comb(order, k) for k in range(order + 1)]
    return table


def new_work() -> Work:
    """Return scratch space for series up to `MAX_ORDER`."""
    work = new_record(WORK)
    work.inverse[:] = _inverses()
    work.binomial[:] = _inverse_binomials()
    return work
