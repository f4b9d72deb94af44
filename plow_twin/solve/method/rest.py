"""Detection of rest. Once the decaying vibration of a head that is held by its contacts is small, it is omitted.

Under constant loads, the sum of kinetic and potential energy cannot increase, so it bounds the head's distance from its
equilibrium for all time if the stiffness is positive definite. When the bound is far below the tolerance, the head is
set to its equilibrium, and the steps become as long as possible. Harmonic loads are admissible if they do not move the
head beyond the bound (`small_harmonics`).
"""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row, splat
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.dynamics import accelerate, acting
from plow_twin.solve.kinematics import penetration_of, to_body, to_world
from plow_twin.solve.method.equilibrium import held, stiffer_than, stiffness_at, to_equilibrium
from plow_twin.solve.method.small_harmonics import EVALUATIONS, stays_at_rest, without_harmonics
from plow_twin.solve.state import OMEGA, ON, VX, VY

#: Largest motion that is omitted at rest, divided by the tolerance.
_SHARE = 1e-3
#: Smallest penetration or gap of every pair, divided by the largest omitted motion.
_MARGIN = 10.0
#: Smallest penetration or gap of every pair in m, so that finite differences can be used for the stiffness.
_DEEP = 1e-7
#: Largest number of evaluations of the equations of motion in a check for rest.
AT_REST = 5 + EVALUATIONS


@kernel(inline="source")
def _gyration(p) -> float:
    return math.sqrt(p.inverse_mass / p.inverse_inertia)


@kernel(inline="source")
def _speed(p, y) -> float:
    return math.hypot(math.hypot(y[VX], y[VY]), _gyration(p) * y[OMEGA])


@kernel(inline="source")
def slow_enough(p, y) -> bool:
    """Return whether the head is slow enough for rest."""
    return bool(_speed(p, y) <= 0.5 * _SHARE * p.velocity_tolerance)


@kernel()
def _still(p, acts, harmonics, state, w) -> bool:
    """Return whether the motion that is omitted at rest stays within its share of the tolerances for all time.

    If so, `w.rest[0]` contains the equilibrium of the head.
    """
    y, z, rate = state.y, w.rest[0], w.rest[1]
    gyration, speed = _gyration(p), _speed(p, y)
    way, fast = _SHARE * p.position_tolerance, _SHARE * p.velocity_tolerance
    if not slow_enough(p, y) or not held(p, state, y, max(_MARGIN * way, _DEEP)):
        return False
    to_world(p, y, z)
    z[3] = z[4] = z[5] = 0.0
    stiffness_at(p, acts, state, w, gyration)
    without_harmonics(p, harmonics, state.step_start, rate, w.rest[3, 3:])
    if not stiffer_than(w.hessian, 0.0):
        return False
    # the energy bounds the speed and, with the smallest stiffness, the distance from the equilibrium
    energy = speed * speed + to_equilibrium(w.hessian, rate, z, gyration)
    if not (2.0 * energy < fast * fast and stiffer_than(w.hessian, 2.0 * energy / (way * way))):
        return False
    if harmonics is not None:
        return stays_at_rest(p, acts, harmonics, state, w, math.sqrt(energy), way, fast, gyration)
    return True


@kernel()
def _still_as_before(p, acts, harmonics, state, w) -> bool:
    """Return whether position and load have not changed since the head was found at rest."""
    z, rate = w.rest[0], w.rest[1]
    to_world(p, state.y, z)
    accelerate(p, acts, True, state, state.step_start, z, w.rest[3, :3], rate)
    without_harmonics(p, harmonics, state.step_start, rate, w.rest[3, 3:])
    state.evaluations += 1
    push = math.hypot(math.hypot(rate[3], rate[4]), p.radius * rate[5])
    return push <= 1e-12 * p.threshold[0] * p.weight / p.radius


@kernel(inline="source")
def own(parts):
    """Return 1 for a scene in which rest can be detected, else None."""
    return parts.terms.rest


@kernel(inline="source")
def lay_out(p, parts, own, state, w, span, penetrating) -> bool:
    """Compute a step of rest if the head is at rest and its load is constant."""
    return _lay_out(p, acting(parts), parts.harmonics, own, state, w, span, penetrating)


@kernel()
def _lay_out(p, acts, harmonics, rest, state, w, span, penetrating) -> bool:
    if rest is None:
        return False
    steady = penetrating and w.wrench[1, 0] == 0.0 and w.wrench[1, 1] == 0.0 and w.wrench[1, 2] == 0.0
    state.at_rest = 1 if steady and _settle(p, acts, harmonics, state, w) else 0
    if state.at_rest == 0:
        return False
    write_rest(p, state, w)
    state.sigma_end, state.order, state.ends_at_stop = span, 1, 1
    return True


@kernel()
def _settle(p, acts, harmonics, state, w) -> bool:
    """Set a head at rest to its equilibrium, and return whether it is at rest."""
    if not (state.at_rest == 1 and _still_as_before(p, acts, harmonics, state, w)):
        if not _still(p, acts, harmonics, state, w):
            return False
        to_body(p, state.y, w.rest[0], state.y)
    return True


@kernel()
def write_rest(p, state, w) -> None:
    """Write the constant series of a head at rest."""
    y = state.y
    set_row(w.series, 0, row(y, 0))
    for pair in range(PAIR_COUNT):
        penetration = penetration_of(p, state, pair, y)
        w.penetration[0, pair], w.force[0, pair] = penetration, 0.0
        if state.mode[pair] == ON:
            w.force[0, pair] = law_force(p, state, pair, penetration, 0.0)
    set_row(w.series, 1, splat(0.0))
    set_row(w.penetration, 1, splat(0.0))
    set_row(w.force, 1, splat(0.0))
