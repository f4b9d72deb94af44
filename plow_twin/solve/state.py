"""Records of the compiled kernels: constants of a scene, dynamic state, scratch space and totals.

A part that a scene lacks is `None`. Since `None` has a type of its own in the compiled signature, the code of this part
is not compiled.
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

#: Highest order of the series; the tolerance determines the order that is used.
MAX_ORDER: Final = 30

# indices into Work.per_pair
ACTS, DAMPS, BASE, SIGN, RATIO, SUM, FIRST, SECOND, RAMPS = range(9)

# contact modes; the first three are public
OFF: Final = 0
ON: Final = 1
CLIPPED: Final = 2
#: Mode for exponents that are not integers: the pair penetrates by less than `Params.release`, so its force is
#: negligible.
RELEASED: Final = 3
#: Outcome of an event: a pair's penetration crosses the end of the damping's ramp; its mode does not change.
CROSSING: Final = 4
#: Further outcomes of an event that leave the mode unchanged: a corner begins to slip along the wall, forward or
#: backward, or it begins to stick.
SLIPS_FORWARD: Final = 5
SLIPS_BACKWARD: Final = 6
STICKS: Final = 7

# indices into State.y
X, Y, VX, VY, OMEGA, COS, SIN, THETA = range(STATE_SIZE)


class Status(IntEnum):
    """The outcome of an advance.

    Attributes
    ----------
    OK
        The advance reached its time.
    OUT_OF_RANGE
        abs(theta) exceeded 45 degrees, or a corner went beyond half the cavity, where the pairs no longer describe the
        contacts.
    NON_FINITE
        A number became infinite or NaN.
    BUDGET
        The number of steps that an advance may take was used up.
    LOG_FULL, PAUSED
        Internal; never the status of an advance.
    """

    OK = 0
    OUT_OF_RANGE = 1
    NON_FINITE = 2
    BUDGET = 3
    #: internal: the event log is full, so the caller must make room before it continues
    LOG_FULL = 4
    #: internal: a slice of the work is done, so the caller checks its limits before it continues
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


# The types below are records rather than tuples of arrays: a kernel then gets a single pointer, the shapes of arrays
# are constants, and nothing is reference counted.

_ROWS: Final = MAX_ORDER + 1
_WIDE: Final = (_ROWS, PAIR_COUNT)
#: Size of a cache line in bytes.
_LINE: Final = 64


def _in_lines(fields: list[tuple[Any, ...]]) -> np.dtype[np.void]:
    """Return a record type padded to whole cache lines, so that each record of an array begins at a cache line."""
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


#: Number of intervals of the table of damping numbers over restitutions from 0 to 1; the smallest restitution used is
#: one interval.
RESTITUTIONS: Final = 1000

#: Constants of one scene at one tolerance, divided by mass and inertia where that saves work.
_PARAM_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("penetration_rows", "f8", (5, PAIR_COUNT)),  # factors of c, s, X, Y and 1 in the penetrations
    ("arm_rows", "f8", (4, PAIR_COUNT)),  # factors of c, s, X and Y in the arms
    ("slip_rows", "f8", (4, PAIR_COUNT)),  # factors of c, s, X and Y in the corners' places along their walls
    # factors of c, s, X and Y in the arms, about G, of the forces along the walls
    ("slip_arm_rows", "f8", (4, PAIR_COUNT)),
    ("wear_per_impulse", "f8", (PAIR_COUNT,)),  # depth of each pad per impulse, k_s v / A
    ("speed_per_wear", "f8"),  # A / k_s = v / `wear_per_impulse`; 0 if sliding in the plane does not wear
    ("running_in", "f8"),  # share by which a new pad wears faster than a worn one
    ("running_in_rate", "f8"),  # 1 / h0 in 1/m, the rate at which `running_in` falls with the depth
    ("enabled", "i8", (PAIR_COUNT,)),  # 1 if the pair can touch
    ("inverse_mass", "f8"),
    ("inverse_inertia", "f8"),
    ("stiffness", "f8"),
    ("exponent", "f8"),
    ("viscous", "f8"),  # C in N s/m; 0 for a law without C
    ("damping_number", "f8"),  # D of lambda = D / v0; negative if lambda is constant
    ("speed_floor", "f8"),  # smallest v0 that lambda = D / v0 uses
    ("ramp", "f8"),  # penetration over which C grows to its full value; 0 without a ramp
    ("gravity", "f8"),
    ("constant", "f8", (3,)),  # Fx/m, Fy/m - g, M/I of the constant loads
    ("direction", "f8", (2, 2)),  # directions (x, y) of the harmonic forces S1, S2
    ("offset", "f8", (2,)),  # place of the centre of mass relative to the cavity's centre
    ("free", "f8", (3,)),  # 1 for a free degree of freedom, 0 for a locked one
    ("friction", "f8"),  # mu
    ("slip_speed", "f8"),  # regularisation speed of friction in m/s
    ("static_friction", "f8"),  # static coefficient of friction, up to which a corner sticks
    ("stick_stiffness", "f8"),
    ("stick_damping", "f8"),
    ("frame_mobility", "f8", (3,)),  # 1/m, 1/m, 1/I of a frame on springs, otherwise 0
    ("frame_stiffness", "f8", (3,)),  # stiffness of the frame's support, per mass and inertia
    ("frame_damping", "f8", (3,)),
    ("order", "i8"),
    ("lacuna", "i8"),  # number of consecutive orders that may vanish before the end of a series
    ("threshold", "f8", (_ROWS,)),  # admissible size of term k of a velocity over a step
    ("velocity_tolerance", "f8"),  # admissible error of a velocity
    ("position_tolerance", "f8"),  # admissible error of a position
    ("weight", "f8"),  # factor that makes a cosine or sine a velocity, for the size of terms
    ("radius", "f8"),  # factor that makes an angle a length
    ("release", "f8"),  # penetration below which the force is negligible
    ("fastest", "f8"),  # largest angular frequency of the harmonics
    ("leverage", "f8"),  # distance of a corner of the frame from its centre
    ("half_cavity", "f8"),  # largest penetration for which the model is valid
    ("max_events", "i8"),  # largest number of events at one instant
]
PARAMS: Final = _in_lines(_PARAM_FIELDS)

#: Further constants of a scene, for each option of `Options` that the scene has.
_OPTION_FIELDS: Final[dict[str, list[tuple[Any, ...]]]] = {
    "corners": [("tumbles", "f8")],  # the head carries corners; 1 if the block may tumble
    # movement of a rounded corner's touching point along the wall per angle of the head [m/rad]
    "rounded": [("roll", "f8")],
    "falling": [  # a restitution that falls with the impact
        ("damping_numbers", "f8", (RESTITUTIONS + 1,)),  # e D(e) on a grid from 0 to 1
        ("restitution", "f8"),  # restitution of impacts up to `fall_speed`
        ("fall", "f8"),  # power with which the restitution falls with the impact
        ("fall_speed", "f8"),  # impact speed in m/s up to which the restitution is constant
        ("fall_mass", "f8"),  # power of the effective mass in the impact
        ("fall_along", "f8"),  # loss of restitution per speed along the wall, in s/m
    ],
}


class Options(NamedTuple):
    """Options of a scene; each adds fields to the record of its constants."""

    corners: bool  #: the head carries corners
    rounded: bool  #: the corners are rounded
    falling: bool  #: the restitution falls with the impact


@cache
def params_type(options: Options) -> np.dtype[np.void]:
    """Return the record type of a scene's constants."""
    # the fields of the options come first, for the reason given in `state_type`
    more = [field for name in Options._fields if getattr(options, name) for field in _OPTION_FIELDS[name]]
    return _in_lines([*more, *_PARAM_FIELDS]) if more else PARAMS


#: The whole state of the motion, and the current step. Times in s.
_STATE_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("y", "f8", (STATE_SIZE,)),  # body coordinates at the step's start
    ("damping_factor", "f8", (PAIR_COUNT,)),  # lambda of each pair in s/m
    ("wear_depth", "f8", (PAIR_COUNT,)),  # wear depth of each pad in m
    ("mode", "i8", (PAIR_COUNT,)),
    ("beyond_ramp", "i8", (PAIR_COUNT,)),  # 1 if the penetration is beyond the ramp
    ("step_start", "f8"),
    ("elapsed", "f8"),  # time since the start of the current step
    ("step_size", "f8"),  # size of the current step; negative if there is no current step
    ("sigma_end", "f8"),  # the series' variable at the step's end
    ("alpha", "f8"),  # time since the step's start: alpha sigma + beta sigma^2 / 2
    ("beta", "f8"),
    # time at which a step must end, because of a sample, a knot of the load, or the end of the run
    ("stop_time", "f8"),
    ("last_step_size", "f8"),
    ("touch_time", "f8"),  # time of the last touch
    ("time", "f8"),  # the present time, bit for bit as the caller gave it
    ("implicit_size", "f8"),  # size of the next implicit step
    ("decay_times", "f8"),  # time in overdamped contact since a contact changed, as a number of decay times
    # values of `implicit_size` and `decay_times` before the current step was laid out
    ("implicit_size_before", "f8"),
    ("decay_times_before", "f8"),
    ("order", "i8"),  # order of the series of the current step
    ("event_pair", "i8"),  # the pair whose event ends the step, or -1
    ("event_mode", "i8"),  # the mode of this pair after the event
    # bit mask of the pairs that touch at the step's start; the series of these pairs need the square root of time
    ("touching", "i8"),
    ("events_at_once", "i8"),  # number of events at the present instant so far
    ("piece", "i8"),  # index of the sampled load's present piece
    ("ends_at_stop", "i8"),  # 1 if the step ends at `stop_time`
    ("refused", "i8"),  # number of failed attempts at implicit steps since a contact changed
    ("refused_before", "i8"),  # `refused` before the current step was laid out
    ("in_flight", "i8"),  # 1 if the current step is a step of free flight
    ("at_rest", "i8"),  # 1 if the current step is a step of rest
    # the following numbers count from the start of the motion
    ("steps", "i8"),
    ("evaluations", "i8"),  # number of evaluations of the equations of motion, one for each order of a series
    ("events", "i8"),
    ("guard_roots", "i8"),  # number of searches for a guard's root
    ("recoveries", "i8"),  # number of steps beyond an instant at which modes changed back and forth
    ("bounded", "i8"),  # number of advances with a coarse end
    ("implicit_steps", "i8"),
]
STATE: Final = _in_lines(_STATE_FIELDS)
#: State of the corners' grip, for friction with stick.
_GRIP_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("anchor", "f8", (PAIR_COUNT,)),  # place along the wall in m where a sticking corner's spring is slack
    ("grip", "i8", (PAIR_COUNT,)),  # 0 sticks, 1 slips forward, -1 backward
]
#: State of a frame on springs: its displacements x, y, theta from equilibrium, then their rates. With this field,
#: `State.y` is relative to the frame.
_FRAME_FIELDS: Final[list[tuple[Any, ...]]] = [("frame", "f8", (6,))]

#: Scratch space, mainly for the series of one step. Each row is one order of a series; the eight columns (SIMD lanes)
#: are state components or pairs. Arrays of eight columns come first, so that each of their rows fills a cache line.
WORK: Final = np.dtype(
    [
        ("series", "f8", _WIDE),  # state
        ("left", "f8", _WIDE),  # first factors of the Cauchy products
        ("right", "f8", _WIDE),
        ("penetration", "f8", _WIDE),  # penetration
        ("rate", "f8", _WIDE),  # time derivative of the penetration
        ("arm", "f8", _WIDE),
        ("damped", "f8", _WIDE),  # ramped damping only: the ramp times the rate
        ("force", "f8", _WIDE),
        ("wear", "f8", _WIDE),  # growth of the wear depth
        ("guard", "f8", _WIDE),
        ("bernstein", "f8", _WIDE),
        ("power", "f8", (4, *_WIDE)),  # powers of the penetration d
        ("ramp", "f8", (3, *_WIDE)),  # ramped damping only: square and cube of the penetration, acting share of C
        ("slip", "f8", (6, *_WIDE)),  # friction: slip rate r / v_s, k r_k, tanh r, 1 - tanh^2 r, force, arm
        ("frame", "f8", _WIDE),  # a frame on springs (`solve.support`)
        ("frame_left", "f8", (3, *_WIDE)),  # first factors of the Cauchy products of a frame on springs
        ("frame_right", "f8", (3, *_WIDE)),
        ("seen", "f8", _WIDE),  # implicit steps: the head relative to the frame
        ("frame_sum", "f8", (PAIR_COUNT,)),
        ("grip", "f8", (3, PAIR_COUNT)),  # friction with stick: factors of normal force, place and slip rate
        ("per_pair", "f8", (9, PAIR_COUNT)),  # masks and sums of the eight pairs
        ("moved", "f8", (STATE_SIZE,)),
        # fields of one row have the type of the state's fields, so that kernels are compiled once for both
        ("saved_y", "f8", (STATE_SIZE,)),  # body coordinates and wear depth at the start of an advance
        ("saved_wear", "f8", (PAIR_COUNT,)),
        ("read_y", "f8", (STATE_SIZE,)),  # body coordinates, rate and wear depth at a time of output
        ("read_rate", "f8", (PAIR_COUNT,)),
        ("read_wear", "f8", (PAIR_COUNT,)),
        ("frame_now", "f8", (6,)),  # state of the frame when the motion was last read
        ("frame_saved", "f8", (6,)),  # state of the frame at the start of an advance
        ("load", "f8", (3, _ROWS)),  # S1, S2, M
        ("world", "f8", (4, _ROWS)),  # forces per mass in head and world axes
        # scratch: coefficients of a polynomial in time, for example of a guard or a force
        ("column", "f8", (2, _ROWS)),
        ("halves", "f8", (MAX_HALVINGS + 2, _ROWS)),
        ("bounds", "f8", (MAX_HALVINGS + 2, 2)),
        ("wrench", "f8", (2, 3)),  # linear load: its value at the step's start and its slope
        ("flight", "f8", (6, 6)),  # start of a flight, its bounds, scratch (`solve.method.flight`)
        ("rest", "f8", (4, 6)),  # place, rates and load at rest (`solve.method.rest`)
        ("hessian", "f8", (3, 3)),
        ("term_size", "f8", (_ROWS,)),  # size of each order as a velocity
        ("decay", "f8", (1,)),  # decay rate of the damping in 1/s, 0 if it does not limit steps
        ("switch", "i8", (PAIR_COUNT,)),  # modes that pairs take at the step's end, -1 for no change
        ("inverse", "f8", (_ROWS + 2,)),  # 1/k
        # rest under harmonics: derivatives of the accelerations with respect to the rates, with the opposite sign
        ("damping", "f8", (3, 3)),
        ("rub", "f8", (6, *_WIDE)),  # wear: s' / v, sliding distance per travel, force times this distance; running-in
        ("binomial", "f8", (_ROWS, _ROWS)),  # 1 / C(order, k)
        # newest advance out of range: angle [rad], largest penetration [m], and the pair with this penetration
        ("beyond", "f8", (3,)),
    ]
)

#: Totals of the motion since the totals were last cleared.
TOTALS: Final = np.dtype(
    [
        ("peak", "f8", (PAIR_COUNT,)),
        ("impulse", "f8", (PAIR_COUNT,)),
        ("time_in_contact", "f8", (PAIR_COUNT,)),
        ("makes", "i8", (PAIR_COUNT,)),
        ("set_time", "f8", (2, 16)),  # time in which each set of corners carries force, for ccw and for cw pairs
        ("logged", "i8"),  # number of events in the log
    ]
)

#: Values of the field `followed` of `ROW`.
FOLLOWED: Final = 1
WITH_INTERVALS: Final = 2

#: The motion at the end of an advance, and the sums over it; the rows of twins in lanes. Eight single numbers come
#: first, so that the numbers of the eight pairs begin at a cache line.
_ADVANCE_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("t", "f8"),
    ("q", "f8", (3,)),
    ("v", "f8", (3,)),
    ("error_estimate", "f8"),
    *((name, "f8", (PAIR_COUNT,)) for name in ("penetration", "rate", "force", "peak", "impulse")),
    ("time_in_contact", "f8", (PAIR_COUNT,)),
    ("makes", "i8", (PAIR_COUNT,)),
    ("wear_depth", "f8", (PAIR_COUNT,)),
    ("steps", "i8"),
    ("status", "i8"),
]
ADVANCE: Final = _in_lines(_ADVANCE_FIELDS)

#: A row of `ADVANCE` with the further values of a published message; the solver passes these rows on to the messages.
ROW: Final = np.dtype(
    [
        *_ADVANCE_FIELDS,
        # in a published row (`solve.totals.publish`) `makes` counts touches since the beginning; impulse and peak cover
        # the time since the previous publication
        ("stamp_ns", "i8"),
        ("samples", "i8"),  # number of advances that ended at a sample since the previous publication
        ("measured_peak", "f8", (PAIR_COUNT,)),  # largest force in these advances
        ("held", "i8"),  # 1 if the motion at the stamp was computed with held loads, without a sample
        ("corrected", "i8"),  # 1 if late samples have changed the motion since the previous publication
        ("marked", "i8"),  # 1 if `held` or `corrected` is 1, in this or in the previous publication
        ("orientation", "f8", (2,)),  # z and w of the head's quaternion
        ("twist", "f8", (3,)),  # rates along the head's own axes [m/s], and about z [rad/s]
        # the following fields are written if the motion follows measurements: the 5 % and 95 % quantiles over the
        # randomly drawn twins, and the clearances [m] with their quantiles. Quantiles of peak and impulse cover the
        # time since the previous publication
        ("followed", "i8"),  # `FOLLOWED` if only the clearances are filled, `WITH_INTERVALS` if all fields are filled
        *((f"{name}_{end}", "f8", (PAIR_COUNT,)) for name in ("force", "peak", "impulse") for end in ("low", "high")),
        ("known_clearance", "f8", (6,)),  # horizontal, then vertical clearance, each followed by its quantiles
    ]
)

Params: TypeAlias = np.record
State: TypeAlias = np.record
Work: TypeAlias = np.record
Totals: TypeAlias = np.record
Implicit: TypeAlias = np.record


#: A harmonic load, divided by mass and inertia: sine and cosine amplitudes of the forces S1 and S2 along
#: `Params.direction`, and of the moment M.
HARMONIC: Final = np.dtype([("omega", "f8"), ("first", "f8", (2,)), ("second", "f8", (2,)), ("moment", "f8", (2,))])

#: A linear piece of a load, divided by mass and inertia: the load at the knot where the piece begins, and its slope
#: after this knot.
SEGMENT: Final = np.dtype([("knot", "f8"), ("start", "f8", (3,)), ("slope", "f8", (3,))])

Harmonics: TypeAlias = NDArray[np.void]
Segments: TypeAlias = NDArray[np.void]


class Terms(NamedTuple):
    """Terms of the equations of motion: 1 for a term that is present, `None` otherwise. `Params` has their constants.

    The types are part of the compiled signature. Kernels take the terms as separate arguments, since numba leaves a
    branch out of the compiled code only if a separate argument is `None`.
    """

    harmonics: int | None
    second: int | None  #: harmonic forces in two directions
    segments: int | None  #: linear pieces
    viscous: int | None  #: damping C d'
    hysteretic: int | None  #: damping by lambda d', with lambda in `State.damping_factor`
    integer: int | None  #: an integer exponent of at least 2
    fraction: int | None  #: an exponent that is not an integer
    ramp: int | None  #: the viscous part is ramped over the penetration
    wear: int | None
    sliding: int | None  #: sliding in the plane wears too
    running_in: int | None  #: new pads wear faster
    offset: int | None  #: the centre of mass is not the cavity's centre
    free: int | None  #: some degree of freedom is locked
    slip: int | None  #: regularised friction
    stick: int | None  #: friction with stick
    support: int | None  #: the frame is on springs
    flight: int | None  #: free flight in closed form (`solve.method.flight`)
    rest: int | None  #: rest can be recognised (`solve.method.rest`)


class Parts(NamedTuple):
    """Parts that a scene may lack: terms of the equations, loads, nodes and scratch space of implicit steps."""

    terms: Terms
    harmonics: Harmonics | None
    segments: Segments | None
    implicit: Implicit | None


#: Limit of the work of an advance, and scratch space for the coarse Runge-Kutta steps that end an advance at this
#: limit.
BOUND: Final = np.dtype(
    [
        ("steps", "i8"),  # number of Runge-Kutta steps reserved for the end
        ("error", "f8"),  # estimated error of the advance in m, 0 if the limit was not reached
        ("z", "f8", (6, 12)),  # state, trial state and four stages, of the head and of a frame on springs
        ("load", "f8", (3,)),
        ("pairs", "f8", (4, PAIR_COUNT)),  # penetration, rate, force, and force at the previous step
    ]
)

#: One change of contact: time in s, pair, modes before and after, rate of penetration in m/s.
EVENT: Final = np.dtype([("time", "f8"), ("pair", "i8"), ("mode_from", "i8"), ("mode_to", "i8"), ("rate", "f8")])

#: Progress of a call that makes many advances; the call returns after each slice of work.
PACE: Final = np.dtype(
    [
        ("slice", "i8"),  # number of steps in a slice
        ("left", "i8"),  # number of steps left in the slice
        ("row", "i8"),  # index of the next advance; all advances of one member come before those of the next member
        ("underway", "i8"),  # 1 if this advance has begun
        ("mark", "i8"),  # index of the next mark
        ("failed", "i8"),  # number of failed advances
    ]
)

Bound: TypeAlias = np.record
Log: TypeAlias = NDArray[np.void]


def state_type(terms: Terms) -> np.dtype[np.void]:
    """Return the record type of a scene's state."""
    return _state_type(terms.stick is not None, terms.support is not None)


@cache
def _state_type(stick: bool, support: bool) -> np.dtype[np.void]:
    # further fields come first: if they came last, numba would take the record for the record without these fields
    more = (_FRAME_FIELDS if support else []) + (_GRIP_FIELDS if stick else [])
    return _in_lines([*more, *_STATE_FIELDS]) if more else STATE


def new_record(dtype: np.dtype[np.void]) -> np.record:
    """Return a record of zeros."""
    return first_of(new_records(dtype, 1))


def first_of(records: NDArray[np.void]) -> np.record:
    """Return a view of the first record."""
    record: np.record = records.view(_with_attributes(records.dtype))[0]
    return record


@cache
def _with_attributes(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the same record type with its fields as attributes."""
    return np.dtype((np.record, dtype))


def new_records(dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Return records of zeros that start at a cache line, so that each row of eight numbers lies in one line."""
    memory = np.zeros(count * dtype.itemsize + _LINE, np.uint8)
    start = -memory.ctypes.data % _LINE
    return np.ndarray(count, dtype, memory.data, start)


@cache
def _inverses() -> Array:
    """Return the table of 1 / k by k (0 for k = 0), shape (orders + 2,)."""
    return np.append(0.0, 1.0 / np.arange(1, _ROWS + 2))


@cache
def _inverse_binomials() -> Array:
    """Return the table of inverse binomial coefficients 1 / C(order, k), shape (orders, orders)."""
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
