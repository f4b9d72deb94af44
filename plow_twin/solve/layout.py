"""What the compiled kernels pass around: constants of a scene, dynamic state, scratch space and what is counted.

Parts that a scene does not have are `None`: the compiled signature then holds `none` in their place and the code that
would serve them is not compiled at all.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.geometry import STATE_SIZE
from plow_twin.model.pairs import PAIR_COUNT

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Highest order of the series; the tolerance decides how many terms are used.
MAX_ORDER: Final = 30
#: Depth to which an interval is halved when a root or a maximum is isolated.
MAX_HALVINGS: Final = 48

# contact modes; the first three are public
OFF: Final = 0
ON: Final = 1
CLIPPED: Final = 2
#: Penetrating less than `Params.release`, where the force is negligible (exponents that are not integers).
RELEASED: Final = 3

# indices into State.y
X, Y, VX, VY, OMEGA, COS, SIN, THETA = range(STATE_SIZE)
# indices into State.clock
T0, USED, LENGTH, SIGMA, ALPHA, BETA, HARD_END = range(7)
# indices into State.step; TOUCHING has a bit for each pair that touches at the step's start and needs the root map
ORDER, EVENT_PAIR, EVENT_TO, TOUCHING, STALL, PIECE, AT_HARD_END = range(7)
# indices into State.count
STEPS, COEFFICIENTS, EVENTS, GUARD_ROOTS, RECOVERIES = range(5)


class Status(IntEnum):
    """How an advance ended."""

    OK = 0
    STALLED = 1
    OUT_OF_RANGE = 2
    NON_FINITE = 3
    BUDGET = 4
    #: internal: the event log is full, the caller makes room and goes on
    LOG_FULL = 5

    @property
    def text(self) -> str:
        """Say it in a sentence."""
        return _STATUS_TEXT[self]


_STATUS_TEXT: Final = {
    Status.OK: "done",
    Status.STALLED: "time did not advance: contact modes kept changing at one instant",
    Status.OUT_OF_RANGE: "the head left the model's range: |theta| > 45 degrees or a penetration beyond half the cavity",
    Status.NON_FINITE: "the motion became non-finite; load, stiffness or damping is too large for double precision",
    Status.BUDGET: "the budget of steps was used up before the time asked for",
    Status.LOG_FULL: "the event log is full",
}


class Params(NamedTuple):
    """Constants of one scene and one tolerance, per mass and inertia where that saves work."""

    gap: Array  #: (5, 8) penetration rows for c, s, X, Y, 1
    arm: Array  #: (4, 8) arm rows for c, s, X, Y
    enabled: IntArray  #: (8,) 1 where the pair can touch
    inverse_mass: float
    inverse_inertia: float
    stiffness: float
    exponent: float
    viscous: float  #: C in N s/m, 0 without
    damping_factor: float  #: D of lambda = D / v0, or a negative number when lambda is constant
    speed_floor: float  #: smallest v0
    gravity: float
    constant: Array  #: (3,) Fx/m, Fy/m - g, M/I of all that does not change
    direction: Array  #: (2, 2) directions (x, y) of the harmonic forces S1, S2
    order: int
    lacuna: int  #: orders in a row that may vanish while the series goes on
    threshold: Array  #: (order + 1,) admissible size of term k of a velocity over a step
    velocity_tolerance: float  #: admissible local error of a velocity
    position_tolerance: float  #: admissible local error of a position
    radius: float  #: turns angles into lengths
    release: float  #: penetration below which the force is negligible
    half_cavity: float  #: penetration that ends the model's range
    max_events: int  #: events at one instant before recovery


class Harmonics(NamedTuple):
    """Harmonic loads: S1 (and S2) are force per mass along `Params.direction`, M is moment per inertia."""

    omega: Array  #: (h,)
    first: Array  #: (h, 2) sine and cosine amplitudes of S1
    moment: Array  #: (h, 2) of M


class Law(NamedTuple):
    """Which terms of the contact law exist; the type of each is part of the compiled signature."""

    viscous: float | None  #: C of Kelvin-Voigt in N s/m
    factor: int | None  #: not None: lambda is read from State.factor
    integer: int | None  #: integer exponent of at least 2
    fraction: float | None  #: exponent that is not an integer


class Segments(NamedTuple):
    """Linear pieces of a sampled load, per mass and inertia."""

    knots: Array  #: (n,)
    start: Array  #: (n, 3)
    slope: Array  #: (n, 3)


class Parts(NamedTuple):
    """The parts that a scene may lack."""

    harmonics: Harmonics | None
    second: Array | None  #: (h, 2) amplitudes of S2; None when all forces share one direction
    segments: Segments | None
    law: Law
    wear: Array | None  #: (8,) depth per impulse, k_s v / A
    offset: Array | None  #: (2,) centre of mass from the cavity's centre
    free: Array | None  #: (3,) 1 free, 0 locked


class State(NamedTuple):
    """Everything that the future depends on, and the step under way."""

    y: Array  #: (8,) body coordinates at the step's start
    factor: Array  #: (8,) lambda of each pair
    depth: Array  #: (8,) wear depth of each pad
    mode: IntArray  #: (8,)
    clock: Array  #: (7,)
    step: IntArray  #: (7,)
    count: IntArray  #: (5,)


class Work(NamedTuple):
    """Scratch space: series of one step. Rows are orders, columns components or pairs."""

    series: Array  #: (n, 8) state
    left: Array  #: (n, 8)
    right: Array  #: (n, 8)
    gap: Array  #: (n, 8) penetration
    guard: Array  #: (n, 8)
    bernstein: Array  #: (n, 8)
    load: Array  #: (3, n) S1, S2, M
    force: Array  #: (8, n)
    rate: Array  #: (8, n)
    arm: Array  #: (8, n)
    power: Array  #: (8, 4, n)
    worn: Array  #: (8, n)
    scratch: Array  #: (2, n)
    world: Array  #: (2, n)
    halves: Array  #: (MAX_HALVINGS + 2, n)
    bounds: Array  #: (MAX_HALVINGS + 2, 2)
    inverse: Array  #: (n + 1,) 1/k
    binomial: Array  #: (n, n) 1 / C(order, k)


class Totals(NamedTuple):
    """What is summed over the motion since it was last cleared."""

    peak: Array  #: (8,)
    impulse: Array  #: (8,)
    time_in_contact: Array  #: (8,)
    makes: IntArray  #: (8,)
    set_time: Array  #: (2, 16) time in each set of corners, counter-clockwise and clockwise pairs


class Log(NamedTuple):
    """Contact events in order of time."""

    time: Array
    pair: IntArray
    mode_from: IntArray
    mode_to: IntArray
    rate: Array
    length: IntArray  #: (1,)


def new_state() -> State:
    """Return an empty state."""
    return State(
        np.zeros(STATE_SIZE), np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT, np.int64), np.zeros(7),
        np.zeros(7, np.int64), np.zeros(5, np.int64),
    )  # fmt: skip


def new_work() -> Work:
    """Return scratch space for series up to `MAX_ORDER`."""
    n = MAX_ORDER + 1
    binomial = np.ones((n, n))
    for order in range(n):
        value = 1.0
        for k in range(1, order + 1):
            value *= (order - k + 1) / k
            binomial[order, k] = 1.0 / value
    inverse = np.zeros(n + 1)
    inverse[1:] = 1.0 / np.arange(1, n + 1)
    wide, rows = (n, PAIR_COUNT), (PAIR_COUNT, n)
    return Work(
        *(np.zeros(wide) for _ in range(6)), np.zeros((3, n)), *(np.zeros(rows) for _ in range(3)),
        np.zeros((PAIR_COUNT, 4, n)), np.zeros(rows), np.zeros((2, n)), np.zeros((2, n)), np.zeros((MAX_HALVINGS + 2, n)),
        np.zeros((MAX_HALVINGS + 2, 2)), inverse, binomial,
    )  # fmt: skip


def new_totals() -> Totals:
    """Return cleared sums."""
    eight = PAIR_COUNT
    return Totals(np.zeros(eight), np.zeros(eight), np.zeros(eight), np.zeros(eight, np.int64), np.zeros((2, 16)))


def new_log(size: int) -> Log:
    """Return an event log with room for `size` events."""
    return Log(
        np.zeros(size), np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros(size),
        np.zeros(1, np.int64),
    )  # fmt: skip
