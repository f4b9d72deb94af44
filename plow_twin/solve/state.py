"""Record types of the compiled kernels: constants of a scene, dynamic state, scratch space and totals.

A part that a scene lacks is None, so numba does not compile its code.
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

#: Highest order of the Taylor series.
MAX_ORDER: Final = 30

# indices into Work.per_pair
ACTS, DAMPS, BASE, SIGN, RATIO, SUM, FIRST, SECOND, RAMPS = range(9)

# contact modes; the first three modes are part of the public interface
OFF: Final = 0
ON: Final = 1
CLIPPED: Final = 2
#: Mode of a pair with a penetration below `Params.release`, whose force is negligible. Only exponents that are not
#: integers need it.
RELEASED: Final = 3
#: Code of the event at which a penetration crosses the end of the damping ramp, without a change of mode.
CROSSING: Final = 4
#: Codes of the events at which a corner starts to slip forward, slip backward or stick, without a change of mode.
SLIPS_FORWARD: Final = 5
SLIPS_BACKWARD: Final = 6
STICKS: Final = 7

# indices into State.y
X, Y, VX, VY, OMEGA, COS, SIN, THETA = range(STATE_SIZE)


class Status(IntEnum):
    """Status with which an advance ends.

    Attributes
    ----------
    OK
        The advance reached its target time.
    OUT_OF_RANGE
        abs(theta) exceeded 45 degrees, or a penetration exceeded half the size of the cavity. The model is not valid
        beyond these limits.
    NON_FINITE
        A number became infinite or NaN. The load, stiffness or damping is too large for double precision.
    BUDGET
        The advance reached its largest number of steps.
    LOG_FULL, PAUSED
        Internal values. An advance never ends with them.
    """

    OK = 0
    OUT_OF_RANGE = 1
    NON_FINITE = 2
    BUDGET = 3
    #: internal: the caller has to extend the full event log before it continues
    LOG_FULL = 4
    #: internal: a slice of the work is done, and the caller has to check its limits before it continues
    PAUSED = 5

    @property
    def text(self) -> str:
        """Return a description of the status."""
        return _STATUS_TEXT[self]


_STATUS_TEXT: Final = {
    Status.OK: "done",
    Status.OUT_OF_RANGE: "the head left the model's range: |theta| above 45 degrees or half the cavity penetrated",
    Status.NON_FINITE: "the motion became non-finite; load, stiffness or damping is too large for double precision",
    Status.BUDGET: "the largest number of steps was reached before the target time",
    Status.LOG_FULL: "the event log is full",
    Status.PAUSED: "a slice of the work is done",
}


# A kernel receives a record as a single pointer to arrays of constant shape, without reference counting.

_ROWS: Final = MAX_ORDER + 1
_WIDE: Final = (_ROWS, PAIR_COUNT)
#: Size of a cache line in bytes.
_LINE: Final = 64


def _in_lines(fields: list[tuple[Any, ...]]) -> np.dtype[np.void]:
    """Return a record type padded to whole cache lines."""
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


#: Number of intervals of the restitution from 0 to 1 in the table of damping numbers, whose smallest restitution in use
#: is one interval.
RESTITUTIONS: Final = 1000

#: Constants of one scene at one tolerance, divided by mass and inertia where the kernels need the quotients.
_PARAM_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("penetration_rows", "f8", (5, PAIR_COUNT)),  # coefficients of c, s, X, Y and 1 in the penetrations
    ("arm_rows", "f8", (4, PAIR_COUNT)),  # coefficients of c, s, X and Y in the arms
    ("slip_rows", "f8", (4, PAIR_COUNT)),  # coefficients of c, s, X and Y in the positions of corners along their walls
    # coefficients of c, s, X and Y in the arms, about G, of the friction forces
    ("slip_arm_rows", "f8", (4, PAIR_COUNT)),
    ("wear_per_impulse", "f8", (PAIR_COUNT,)),  # wear depth of each pad per impulse of its force, k_s v / A
    ("speed_per_wear", "f8"),  # A / k_s = v / `wear_per_impulse`; 0 if in-plane sliding does not cause wear
    ("running_in", "f8"),  # wear coefficient of a new pad over the coefficient of a worn pad, minus 1
    ("running_in_rate", "f8"),  # 1 / h0 in 1/m, the rate at which the effect of running-in decreases with the depth
    ("enabled", "i8", (PAIR_COUNT,)),  # 1 if the pair can touch
    ("inverse_mass", "f8"),
    ("inverse_inertia", "f8"),
    ("stiffness", "f8"),
    ("exponent", "f8"),
    ("viscous", "f8"),  # C in N s/m; 0 for a law without C
    ("damping_number", "f8"),  # D in lambda = D / v0; negative if lambda is constant
    ("speed_floor", "f8"),  # lower bound of v0 in lambda = D / v0
    ("ramp", "f8"),  # penetration over which C increases to its full value; 0 without a ramp
    ("gravity", "f8"),
    ("constant", "f8", (3,)),  # Fx/m, Fy/m - g, M/I of the constant loads
    ("direction", "f8", (2, 2)),  # directions (x, y) of the harmonic forces S1 and S2
    ("offset", "f8", (2,)),  # position of the centre of mass relative to the cavity's centre
    ("free", "f8", (3,)),  # 1 for a free degree of freedom, 0 for a locked one
    ("friction", "f8"),  # mu
    ("slip_speed", "f8"),  # regularisation speed of friction in m/s
    ("static_friction", "f8"),  # friction coefficient up to which a corner sticks
    ("stick_stiffness", "f8"),
    ("stick_damping", "f8"),
    ("frame_mobility", "f8", (3,)),  # 1/m, 1/m, 1/I of a frame on springs; 0 for a fixed frame
    ("frame_stiffness", "f8", (3,)),  # stiffness of the frame's support, divided by mass and inertia
    ("frame_damping", "f8", (3,)),
    ("order", "i8"),
    ("lacuna", "i8"),  # largest number of successive terms of a series that can be zero
    ("threshold", "f8", (_ROWS,)),  # admissible size of term k in the series of a velocity over a step
    ("velocity_tolerance", "f8"),  # admissible error of a velocity
    ("position_tolerance", "f8"),  # admissible error of a position
    ("weight", "f8"),  # factor that converts a cosine or sine to a velocity, for the size of terms
    ("radius", "f8"),  # factor that converts an angle to a length
    ("release", "f8"),  # penetration below which the force is negligible
    ("fastest", "f8"),  # largest angular frequency of the harmonics
    ("leverage", "f8"),  # distance of the frame's corners from its centre
    ("half_cavity", "f8"),  # largest penetration for which the model is valid
    ("max_events", "i8"),  # largest number of events at one instant
]
PARAMS: Final = _in_lines(_PARAM_FIELDS)

#: Additional constants of a scene by the names of the fields of `Options`.
_OPTION_FIELDS: Final[dict[str, list[tuple[Any, ...]]]] = {
    "corners": [("tumbles", "f8")],  # the head carries corners: 1 if the block may tumble
    # slip of a rounded corner along its wall per angle of the head [m/rad]
    "rounded": [("roll", "f8")],
    "falling": [  # the restitution decreases with the impact speed
        ("damping_numbers", "f8", (RESTITUTIONS + 1,)),  # e D(e) on a grid from 0 to 1
        ("restitution", "f8"),  # restitution of impacts up to `fall_speed`
        ("fall", "f8"),  # exponent of the decrease with the impact speed
        ("fall_speed", "f8"),  # impact speed in m/s up to which the restitution is constant
        ("fall_mass", "f8"),  # exponent of the effective mass in the impact speed
        ("fall_along", "f8"),  # decrease of the restitution per speed along the wall, in s/m
    ],
}


class Options(NamedTuple):
    """Options of a scene, each of which adds fields to its constants."""

    corners: bool  #: the head carries corners
    rounded: bool  #: the corners are rounded
    falling: bool  #: the restitution decreases with the impact speed


#: A scene without options.
NO_OPTIONS: Final = Options(False, False, False)


@cache
def params_type(options: Options) -> np.dtype[np.void]:
    """Return the record type of a scene's constants."""
    # the additional fields come first, for the reason given in `_state_type`
    more = [field for name in Options._fields if getattr(options, name) for field in _OPTION_FIELDS[name]]
    return _in_lines([*more, *_PARAM_FIELDS]) if more else PARAMS


#: State of the motion, and description of the current step. All times are in s.
_STATE_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("y", "f8", (STATE_SIZE,)),  # body coordinates at the start of the step
    ("damping_factor", "f8", (PAIR_COUNT,)),  # lambda of each pair in s/m
    ("wear_depth", "f8", (PAIR_COUNT,)),
    ("mode", "i8", (PAIR_COUNT,)),
    ("beyond_ramp", "i8", (PAIR_COUNT,)),  # 1 if the penetration exceeds the ramp
    ("step_start", "f8"),
    ("elapsed", "f8"),  # time since the start of the current step
    ("step_size", "f8"),  # size of the current step; negative if there is no current step
    ("sigma_end", "f8"),  # value of sigma, the variable of the series, at the end of the step
    ("alpha", "f8"),  # the time since the start of the step is alpha sigma + beta sigma^2 / 2
    ("beta", "f8"),
    # time at which a step has to end because of a sample, a knot of the load, or the end of the run
    ("stop_time", "f8"),
    ("last_step_size", "f8"),
    ("touch_time", "f8"),
    ("time", "f8"),  # current time, bit-identical to the value that the caller gave
    ("implicit_size", "f8"),  # size of the next implicit step
    ("decay_times", "f8"),  # duration of overdamped contact since the last change of contact, divided by the decay time
    # fields with the suffix `_before` contain the values before the current step was computed
    ("implicit_size_before", "f8"),
    ("decay_times_before", "f8"),
    ("order", "i8"),  # order of the series of the current step
    ("event_pair", "i8"),  # pair whose event ends the step, or -1
    ("event_mode", "i8"),  # mode of this pair after the event
    # bit mask of the pairs that touch at the start of the step; their series contain the square root of time
    ("touching", "i8"),
    ("events_at_once", "i8"),  # number of events at the current time so far
    ("piece", "i8"),  # index of the current piece of the sampled load
    ("ends_at_stop", "i8"),  # 1 if the step ends at `stop_time`
    ("refused", "i8"),  # number of failed attempts at implicit steps since the last change of contact
    ("refused_before", "i8"),
    ("in_flight", "i8"),  # 1 if the current step is a step of free flight
    ("at_rest", "i8"),  # 1 if the current step is a step at rest
    # the following fields are counts since the start of the motion
    ("steps", "i8"),
    ("evaluations", "i8"),  # evaluations of the equations of motion; one order of a series is one evaluation
    ("events", "i8"),
    ("guard_roots", "i8"),  # searches for the root of a guard function
    ("recoveries", "i8"),  # steps that ended an endless alternation of modes at one instant
    ("bounded", "i8"),  # advances that ended with Runge-Kutta steps because of their limit of evaluations
    ("implicit_steps", "i8"),
]
STATE: Final = _in_lines(_STATE_FIELDS)
#: Additional state for friction with stick.
_GRIP_FIELDS: Final[list[tuple[Any, ...]]] = [
    ("anchor", "f8", (PAIR_COUNT,)),  # position along the wall in m at which the spring of a sticking corner is relaxed
    ("grip", "i8", (PAIR_COUNT,)),  # 0 for stick, 1 for slip forward, -1 for slip backward
]
#: Additional state of a frame on springs: displacements x, y, theta from equilibrium, and their rates. With this field,
#: `State.y` is relative to the frame.
_FRAME_FIELDS: Final[list[tuple[Any, ...]]] = [("frame", "f8", (6,))]

#: Scratch space, mainly for the series of one step: a row for each order, and a column for each component of the state
#: or for each pair. Arrays of eight columns come first, so that each of their rows fills a cache line.
WORK: Final = np.dtype(
    [
        ("series", "f8", _WIDE),  # state
        ("left", "f8", _WIDE),  # left factors of the Cauchy products
        ("right", "f8", _WIDE),
        ("penetration", "f8", _WIDE),
        ("rate", "f8", _WIDE),  # time derivative of the penetration
        ("arm", "f8", _WIDE),
        ("damped", "f8", _WIDE),  # ramped damping only: product of the ramp and the rate
        ("force", "f8", _WIDE),
        ("wear", "f8", _WIDE),  # increase of the wear depth
        ("guard", "f8", _WIDE),
        ("bernstein", "f8", _WIDE),
        ("power", "f8", (4, *_WIDE)),  # powers of the penetration d
        ("ramp", "f8", (3, *_WIDE)),  # ramped damping only: square and cube of the penetration, active share of C
        ("slip", "f8", (6, *_WIDE)),  # friction: slip rate r / v_s, k r_k, tanh r, 1 - tanh^2 r, force, arm
        ("frame", "f8", _WIDE),  # state of a frame on springs (`solve.support`)
        ("frame_left", "f8", (3, *_WIDE)),  # left factors of the Cauchy products of a frame on springs
        ("frame_right", "f8", (3, *_WIDE)),
        ("seen", "f8", _WIDE),  # implicit steps: the head relative to the frame
        ("frame_sum", "f8", (PAIR_COUNT,)),
        ("grip", "f8", (3, PAIR_COUNT)),  # friction with stick: factors of normal force, position and slip rate
        ("per_pair", "f8", (9, PAIR_COUNT)),  # masks and sums of the eight pairs
        ("moved", "f8", (STATE_SIZE,)),
        # the following fields have the types of the state's fields, so that the same compiled kernels can be used
        ("saved_y", "f8", (STATE_SIZE,)),  # body coordinates and wear depth at the start of an advance
        ("saved_wear", "f8", (PAIR_COUNT,)),
        ("read_y", "f8", (STATE_SIZE,)),  # body coordinates, rates and wear depths at an output time
        ("read_rate", "f8", (PAIR_COUNT,)),
        ("read_wear", "f8", (PAIR_COUNT,)),
        ("frame_now", "f8", (6,)),  # state of the frame when the motion was last evaluated
        ("frame_saved", "f8", (6,)),  # state of the frame at the start of an advance
        ("load", "f8", (3, _ROWS)),  # S1, S2, M
        ("world", "f8", (4, _ROWS)),  # forces divided by mass, in head axes and world axes
        # coefficients of a polynomial in time, for example of a guard function or a force
        ("column", "f8", (2, _ROWS)),
        ("halves", "f8", (MAX_HALVINGS + 2, _ROWS)),
        ("bounds", "f8", (MAX_HALVINGS + 2, 3)),
        ("wrench", "f8", (2, 3)),  # linear load: value at the start of the step, and slope
        ("flight", "f8", (6, 6)),  # initial state of a flight, its bounds, and scratch space (`solve.method.flight`)
        ("rest", "f8", (4, 6)),  # position, rates and load at rest (`solve.method.rest`)
        ("hessian", "f8", (3, 3)),
        ("term_size", "f8", (_ROWS,)),  # size of each term, converted to a velocity
        ("decay", "f8", (1,)),  # decay rate of damped motion in 1/s; 0 if it does not limit the step size
        ("switch", "i8", (PAIR_COUNT,)),  # modes of the pairs after the step; -1 for no change
        ("inverse", "f8", (_ROWS + 2,)),  # 1/k
        # rest under harmonic loads: minus the derivatives of the accelerations with respect to the rates
        ("damping", "f8", (3, 3)),
        ("rub", "f8", (6, *_WIDE)),  # wear: s' / v, sliding distance per travel, force times this distance; running-in
        ("binomial", "f8", (_ROWS, _ROWS)),  # 1 / C(order, k)
        # most recent advance out of range: angle [rad], largest penetration [m], and index of its pair
        ("beyond", "f8", (3,)),
    ]
)

#: Totals of the motion since they were last cleared.
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

#: Motion at the end of an advance, and sums over the advance. Eight single numbers come first, so that the numbers of
#: the eight pairs begin at a cache line.
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

#: Row of `ADVANCE` with additional values of a published message.
ROW: Final = np.dtype(
    [
        *_ADVANCE_FIELDS,
        # in a published row (`solve.totals.publish`), `makes` counts the touches since the start of the motion; impulse
        # and peak refer to the time since the previous publication
        ("stamp_ns", "i8"),
        ("samples", "i8"),  # number of advances to a sample since the previous publication
        ("measured_peak", "f8", (PAIR_COUNT,)),  # largest force in these advances
        ("held", "i8"),  # 1 if there was no sample for the stamp, so that the load was held constant
        ("corrected", "i8"),  # 1 if late samples have changed the motion since the previous publication
        ("marked", "i8"),  # 1 if `held` or `corrected` is 1, in the current or the previous publication
        ("orientation", "f8", (2,)),  # z and w of the head's quaternion
        ("twist", "f8", (3,)),  # rates along the head's own axes [m/s], and about z [rad/s]
        # for a motion that follows measurements: 5 % and 95 % quantiles over randomly drawn twins, and clearances [m]
        # with their quantiles
        ("followed", "i8"),  # `FOLLOWED` if only the clearances are filled, `WITH_INTERVALS` if all fields are filled
        *((f"{name}_{end}", "f8", (PAIR_COUNT,)) for name in ("force", "peak", "impulse") for end in ("low", "high")),
        ("known_clearance", "f8", (6,)),  # horizontal clearance, its quantiles; vertical clearance, its quantiles
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

#: A linear piece of a load, divided by mass and inertia: the load at its first knot, and its slope.
SEGMENT: Final = np.dtype([("knot", "f8"), ("start", "f8", (3,)), ("slope", "f8", (3,))])

Harmonics: TypeAlias = NDArray[np.void]
Segments: TypeAlias = NDArray[np.void]


class Terms(NamedTuple):
    """Terms of the equations of motion, each 1 if it is present and None if it is absent.

    Kernels take the terms as separate arguments, because numba omits a branch from the compiled code only if a separate
    argument is None. `Params` contains the constants of the terms.
    """

    harmonics: int | None
    second: int | None  #: harmonic forces in two directions
    segments: int | None  #: linear pieces
    viscous: int | None  #: damping C d'
    hysteretic: int | None  #: damping K d^n lambda d', with lambda in `State.damping_factor`
    integer: int | None  #: an integer exponent of at least 2
    fraction: int | None  #: an exponent that is not an integer
    ramp: int | None  #: C increases with the penetration over a ramp
    wear: int | None
    sliding: int | None  #: in-plane sliding adds to the wear
    running_in: int | None  #: new pads wear faster
    offset: int | None  #: the centre of mass is not at the cavity's centre
    free: int | None  #: at least one degree of freedom is locked
    slip: int | None  #: regularised friction
    stick: int | None  #: friction with stick
    support: int | None  #: the frame is on springs
    flight: int | None  #: free flight is computed in closed form (`solve.method.flight`)
    rest: int | None  #: rest is detected (`solve.method.rest`)


class Parts(NamedTuple):
    """Optional parts of a scene: terms of the equations, loads, and data of implicit steps."""

    terms: Terms
    harmonics: Harmonics | None
    segments: Segments | None
    implicit: Implicit | None


#: Limit of the evaluations of an advance, and scratch space for the Runge-Kutta steps that complete it at this limit.
BOUND: Final = np.dtype(
    [
        ("steps", "i8"),  # number of Runge-Kutta steps that are reserved for completing an advance
        ("error", "f8"),  # estimated error of the advance in m; 0 if the limit was not reached
        ("z", "f8", (6, 12)),  # state, trial state and four stages, for the head and a frame on springs
        ("load", "f8", (3,)),
        ("pairs", "f8", (4, PAIR_COUNT)),  # penetration, rate, force, and force in the previous step
    ]
)

#: A change of contact mode: time in s, pair, mode before and after the change, and penetration rate in m/s.
EVENT: Final = np.dtype([("time", "f8"), ("pair", "i8"), ("mode_from", "i8"), ("mode_to", "i8"), ("rate", "f8")])

#: Progress of a call that makes many advances and returns after each slice of work.
PACE: Final = np.dtype(
    [
        ("slice", "i8"),  # number of steps in a slice
        ("left", "i8"),  # number of steps left in the slice
        ("row", "i8"),  # index of the next advance; all advances of one member precede those of the next member
        ("underway", "i8"),  # 1 if the advance `row` has started
        ("mark", "i8"),  # index of the next element of `marks` (see `advance_rows`)
        ("failed", "i8"),
    ]
)

Bound: TypeAlias = np.record
Log: TypeAlias = NDArray[np.void]


def state_type(terms: Terms) -> np.dtype[np.void]:
    """Return the record type of the state of a scene with these terms."""
    return _state_type(terms.stick is not None, terms.support is not None)


@cache
def _state_type(stick: bool, support: bool) -> np.dtype[np.void]:
    # additional fields come first; if they came last, numba would confuse the record with the record without them
    more = (_FRAME_FIELDS if support else []) + (_GRIP_FIELDS if stick else [])
    return _in_lines([*more, *_STATE_FIELDS]) if more else STATE


def new_record(dtype: np.dtype[np.void]) -> np.record:
    """Return a record filled with zeros."""
    return first_of(new_records(dtype, 1))


def first_of(records: NDArray[np.void]) -> np.record:
    """Return a view of the first record."""
    record: np.record = with_attributes(records)[0]
    return record


def with_attributes(records: NDArray[np.void]) -> NDArray[np.void]:
    """Return a view of contiguous records with access to their fields as attributes."""
    return np.ndarray(records.shape, _with_attributes(records.dtype), records)  # `view` takes ten times as long


@cache
def _with_attributes(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the same record type with access to its fields as attributes."""
    return np.dtype((np.record, dtype))


def new_records(dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Return records filled with zeros, aligned with cache lines."""
    memory = np.zeros(count * dtype.itemsize + _LINE, np.uint8)
    start = -memory.ctypes.data % _LINE
    return np.ndarray(count, dtype, memory.data, start)


@cache
def _inverses() -> Array:
    """Return a table of 1 / k for each k, shape (orders + 2,). The value for k = 0 is 0."""
    return np.append(0.0, 1.0 / np.arange(1, _ROWS + 2))


@cache
def _inverse_binomials() -> Array:
    """Return a table of inverse binomial coefficients 1 / C(order, k), shape (orders, orders)."""
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
