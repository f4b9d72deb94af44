"""Implicit steps for overdamped contact, by collocation at Radau points with fixed contact modes.

In overdamped contact, the damper stops a pair much faster than the spring moves it, so stability limits the steps of an
explicit series to a few decay times. Radau IIA collocation (Hairer and Wanner, Solving ODEs II, sec. IV.5) is stable
for longer steps. Its solution, a polynomial in time, is written as a series, so that events, outputs and totals are
computed as for an explicit step.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row, splat
from plow_twin.model.geometry import STATE_SIZE
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.dynamics import accelerate, acting
from plow_twin.solve.grip import grip_guard, grip_terms
from plow_twin.solve.kinematics import (
    penetration_of,
    rate_of,
    rolled,
    row_value,
    row_values,
    slip_arm,
    slip_rate,
    to_body,
    to_world,
)
from plow_twin.solve.rubbing import rubbing
from plow_twin.solve.state import CLIPPED, COS, OMEGA, ON, SIN, THETA, VX, VY, Implicit, X, Y, new_record
from plow_twin.solve.support import (
    FRAME_THETA,
    FRAME_VX,
    FRAME_VY,
    FRAME_X,
    FRAME_Y,
    RELATIVE_COS,
    RELATIVE_SIN,
    SPIN,
    to_body_both,
    to_ground,
    to_world_both,
)

#: Number s of stages, the degree of the polynomials. The order of the method is 2 s - 1.
STAGES = 9
#: Ratio of the decay rate of a contact's dampers to the angular frequency of its springs, above which the contact is
#: overdamped and the scene may need implicit steps.
OVERDAMPED_RATIO = 20.0
#: Cost of an implicit step in explicit steps, so an implicit step must be longer than this number of explicit steps.
_WORTH = 30.0
#: Admissible error of an implicit step, which replaces many explicit steps, divided by that of an explicit step.
_GAIN = 100.0
#: Rounding error of a velocity, divided by the largest velocity. Smaller errors are always admissible.
_NOISE = 1e-12
#: Rounding error of a guard function of stick and slip, divided by its largest term.
_GUARD_NOISE = 1e-6
#: Number of failed attempts up to which each doubles the time until the next attempt at an implicit step.
_MOST_REFUSED = 12


def _coefficients(nodes: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
    """Return the matrix that converts the values of a polynomial at the nodes to its coefficients, shape (n, n).

    The inversion of the Vandermonde matrix loses half of the digits.
    """
    n = len(nodes)
    columns = np.zeros((n, n), np.longdouble)
    for i in range(n):
        polynomial = np.ones(1, np.longdouble)
        for j in range(n):
            if j != i:
                product = np.zeros(len(polynomial) + 1, np.longdouble)
                product[1:] += polynomial
                product[:-1] -= nodes[j] * polynomial
                polynomial = product / (nodes[i] - nodes[j])
        columns[:, i] = polynomial
    return columns


@cache
def _rule() -> tuple[NDArray[np.float64], ...]:
    """Return the nodes, the weights, and the matrices `from_values` and `from_stages` of `_implicit_type`."""
    # the import is slow, and only stiff scenes need it
    from scipy.special import roots_jacobi

    inner = 0.5 * (roots_jacobi(STAGES - 1, 1.0, 0.0)[0] + 1.0)
    nodes = np.append(np.sort(inner), 1.0).astype(np.longdouble)
    degree = np.arange(1, STAGES + 1)
    from_stages = _coefficients(nodes)
    weights = (nodes[:, None] ** degree / degree) @ from_stages
    from_values = _coefficients(np.append(np.longdouble(0.0), nodes))
    return tuple(table.astype(np.float64) for table in (nodes, weights, from_values, from_stages))


@cache
def _implicit_type(size: int) -> np.dtype[np.void]:
    """Return the record type of an implicit step (nodes, weights, scratch space) for `size` degrees of freedom."""
    shape = (STAGES + 1, STATE_SIZE)
    return np.dtype(
        [
            ("nodes", "f8", (STAGES,)),
            ("weights", "f8", (STAGES, STAGES)),
            ("from_values", "f8", (STAGES + 1, STAGES + 1)),  # values at the start and at the nodes to coefficients
            ("from_stages", "f8", (STAGES, STAGES)),  # values at the nodes to coefficients
            ("z", "f8", (STAGES + 1, 2 * size)),  # state at the start and at the nodes
            ("rate", "f8", (2, 2 * size)),  # rates at a state and at a displaced state, for finite differences
            ("accelerations", "f8", (STAGES, size)),
            # derivatives of the accelerations with respect to position and with respect to velocity
            ("jacobians", "f8", (STAGES, 2, size, size)),
            ("matrix", "f8", (size * STAGES, size * STAGES)),
            ("residual", "f8", (size * STAGES,)),
            ("body", "f8", shape),  # body coordinates
            ("seen", "f8", shape),  # body coordinates relative to a frame on springs
            ("frame", "f8", shape),  # state of this frame, in the order of `w.frame`
            # values at the nodes: acting force, force by the law (also for CLIPPED pairs), rate of penetration
            ("pairs", "f8", (3, STAGES, PAIR_COUNT)),
            ("wearing", "f8", (STAGES, PAIR_COUNT)),  # rate of wear at the nodes
            ("wear_depth", "f8", shape),  # wear depth at the start and at the nodes
            ("load", "f8", (3,)),
        ]
    )


def new_implicit(support: bool) -> Implicit:
    """Return nodes, weights and scratch space of implicit steps, for a fixed frame or for a frame on springs."""
    implicit = new_record(_implicit_type(6 if support else 3))
    for name, table in zip(("nodes", "weights", "from_values", "from_stages"), _rule(), strict=True):
        implicit[name] = table
    return implicit


@kernel()
def decay_rate(p, state, slip, stick, support) -> float:
    """Return the sum of the decay rates in 1/s due to all dampers, or 0 if the motion is not overdamped.

    The dampers include regularised friction and the damper of a sticking corner.
    """
    y, decay, spring = state.y, 0.0, 0.0
    c, s, om, x, yy, vx, vy = y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY]
    for pair in range(PAIR_COUNT):
        if state.mode[pair] != ON:
            continue
        penetration, rate = max(penetration_of(p, state, pair, y), 0.0), rate_of(p, pair, y)
        force = law_force(p, state, pair, penetration, rate)
        faster = law_force(p, state, pair, penetration, rate + 1.0)
        slope = p.stiffness if p.exponent == 1.0 else p.exponent * p.stiffness * penetration ** (p.exponent - 1.0)
        arm = row_value(p.arm_rows, pair, c, s, x, yy)
        mobility = p.inverse_mass + arm * arm * p.inverse_inertia
        if support is not None:
            arm = row_value(p.arm_rows, pair, c, s, 0.0, 0.0)
            mobility += p.frame_mobility[0] + arm * arm * p.frame_mobility[2]
        decay += (faster - force) * mobility
        spring += slope * mobility
        if slip is not None:
            sticking = 1.0 - math.tanh(slip_rate(p, pair, c, s, om, x, yy, vx, vy) / p.slip_speed) ** 2
            arm = slip_arm(p, pair, c, s, x, yy)
            mobility = p.inverse_mass + arm * arm * p.inverse_inertia
            decay += p.friction * max(force, 0.0) / p.slip_speed * sticking * mobility
        if stick is not None and state.grip[pair] == 0:
            arm = slip_arm(p, pair, c, s, x, yy)
            mobility = p.inverse_mass + arm * arm * p.inverse_inertia
            decay += p.stick_damping * mobility
            spring += p.stick_stiffness * mobility
    if support is not None:
        for j in range(3):
            decay += p.frame_damping[j]
            spring += p.frame_stiffness[j]
    return decay if decay > OVERDAMPED_RATIO * math.sqrt(spring) else 0.0


@kernel(inline="source")
def _admissible(p):
    """Return the admissible error of the velocity in an implicit step in m/s."""
    return max(_GAIN * p.threshold[p.order], _NOISE * p.threshold[0])


@kernel(inline="source")
def stable_decay(order):
    """Return the number of decay times over which a series of this order is stable, with a safety margin."""
    return 0.3 * order


@kernel(inline="source")
def has_decayed(p, state) -> bool:
    """Return whether fast motion has decayed since the last change of contact. Failed attempts lengthen the wait."""
    wait = 5.0 - math.log(p.velocity_tolerance / p.threshold[0])
    return bool(state.decay_times >= wait * 2.0**state.refused)


@kernel(inline="source")
def note_decay(state, decay, step_size) -> None:
    """Add a step to the number of decay times, or reset the number without overdamping."""
    if decay > 0.0:
        state.decay_times += decay * step_size
    else:
        state.decay_times, state.refused = 0.0, 0


@kernel()
def _jacobian(p, acts, state, t, z, implicit, base, out) -> None:
    """Write the accelerations at z to `base`, (n,), and their derivatives by place and velocity to `out`, (2, n, n)."""
    rate, moved, n = implicit.rate[0], implicit.rate[1], base.size
    accelerate(p, acts, True, state, t, z, implicit.load, rate)
    for j in range(2 * n):
        # a difference over which the law is nearly linear, and rounding negligible
        delta = 1e-8 / (p.radius if j % 3 == 2 else 1.0)
        saved = z[j]
        z[j] = saved + delta
        accelerate(p, acts, True, state, t, z, implicit.load, moved)
        z[j] = saved
        for i in range(n):
            out[j // n, i, j % n] = (moved[n + i] - rate[n + i]) / delta
    for i in range(n):
        base[i] = rate[n + i]


@kernel()
def _newton_matrix(implicit, h) -> None:
    """Write the derivatives of the residual by the node velocities v. Positions are x_i = x_0 + h sum a_ij v_j."""
    a, jacobians, matrix, s = implicit.weights, implicit.jacobians, implicit.matrix, implicit.nodes.size
    n = implicit.accelerations.shape[1]
    for i in range(s):
        for j in range(s):
            for r in range(n):
                for c in range(n):
                    value = 1.0 if i == j and r == c else 0.0
                    value -= h * a[i, j] * jacobians[j, 1, r, c]
                    for k in range(s):
                        value -= h * h * a[i, k] * a[k, j] * jacobians[k, 0, r, c]
                    matrix[n * i + r, n * j + c] = value


@kernel()
def _eliminate(matrix, right) -> bool:
    """Solve matrix x = right in place by Gaussian elimination. Return False if the matrix is singular."""
    n = right.size
    for j in range(n):
        pivot = j
        for i in range(j + 1, n):
            if abs(matrix[i, j]) > abs(matrix[pivot, j]):
                pivot = i
        if not 0.0 < abs(matrix[pivot, j]) < np.inf:
            return False
        if pivot != j:
            for k in range(j, n):
                matrix[j, k], matrix[pivot, k] = matrix[pivot, k], matrix[j, k]
            right[j], right[pivot] = right[pivot], right[j]
        for i in range(j + 1, n):
            share = matrix[i, j] / matrix[j, j]
            if share != 0.0:
                for k in range(j + 1, n):
                    matrix[i, k] -= share * matrix[j, k]
                right[i] -= share * right[j]
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            right[j] -= matrix[j, k] * right[k]
        right[j] /= matrix[j, j]
    return True


@kernel()
def _places(implicit, h) -> None:
    """Compute the positions at the nodes from the velocities at the nodes."""
    z, a, s, n = implicit.z, implicit.weights, implicit.nodes.size, implicit.accelerations.shape[1]
    for i in range(s):
        for c in range(n):
            value = z[0, c]
            for j in range(s):
                value += h * a[i, j] * z[j + 1, n + c]
            z[i + 1, c] = value


@kernel()
def _bodies(p, support, state, implicit, i) -> None:
    """Write the body coordinates at the start (i = 0) or at a node, and those relative to a frame on springs."""
    z, y = implicit.z[i], implicit.body[i]
    if support is not None:
        relative, frame = implicit.seen[i], implicit.frame[i]
        to_body_both(p, z, relative, implicit.rate[0, :6])
        to_ground(relative, implicit.rate[0, :6], y)
        frame[FRAME_X], frame[FRAME_Y], frame[FRAME_THETA] = z[3], z[4], z[5]
        frame[FRAME_VX], frame[FRAME_VY], frame[SPIN] = z[9], z[10], z[11]
        frame[RELATIVE_COS], frame[RELATIVE_SIN] = relative[COS], relative[SIN]
    else:
        to_body(p, state.y, z, y)


@kernel()
def _relative_nodes(support, implicit):
    """Return the body coordinates relative to the frame at the start and at the nodes, for penetrations."""
    if support is not None:
        return implicit.seen
    return implicit.body


@kernel()
def _measure(p, support, state, implicit) -> None:
    """Write the acting force, the force by the law, and the penetration rate of each pair at the nodes."""
    pairs, relative = implicit.pairs, _relative_nodes(support, implicit)
    for i in range(implicit.nodes.size):
        _bodies(p, support, state, implicit, i + 1)
        y = relative[i + 1]
        for pair in range(PAIR_COUNT):
            r = rate_of(p, pair, y)
            pairs[0, i, pair], pairs[1, i, pair], pairs[2, i, pair] = 0.0, 0.0, r
            if state.mode[pair] == ON or state.mode[pair] == CLIPPED:
                d = penetration_of(p, state, pair, y) + (state.wear_depth[pair] - implicit.wear_depth[i + 1, pair])
                force = law_force(p, state, pair, d, r)
                pairs[1, i, pair] = force
                pairs[0, i, pair] = force if state.mode[pair] == ON else 0.0


@kernel()
def _wear_at_nodes(p, support, state, h, implicit, sliding, running_in) -> float:
    """Compute the wear rate and wear depth of each pad at the nodes. Return the largest change of a depth in m."""
    worn, rates, a, s, change = implicit.wear_depth, implicit.wearing, implicit.weights, implicit.nodes.size, 0.0
    relative = _relative_nodes(support, implicit)
    _measure(p, support, state, implicit)
    for i in range(s):
        for pair in range(PAIR_COUNT):
            faster = rubbing(p, pair, relative[i + 1], worn[i + 1, pair], sliding, running_in)
            rates[i, pair] = p.wear_per_impulse[pair] * faster * max(implicit.pairs[0, i, pair], 0.0)
    for i in range(s):
        for pair in range(PAIR_COUNT):
            value = worn[0, pair]
            for j in range(s):
                value += h * a[i, j] * rates[j, pair]
            change = max(change, abs(value - worn[i + 1, pair]))
            worn[i + 1, pair] = value
    return change


@kernel()
def _solve(p, acts, support, state, t, h, implicit, wear, sliding, running_in) -> bool:
    """Compute the velocities at the nodes by Newton's method. Return whether it has converged.

    The derivatives are computed at every node, because the damped direction rotates with the head. Only rounding errors
    may remain, because a strong damper converts a small error of a velocity to a large error of its force. Wear is
    slow, so the wear depths of the previous iterate are used.
    """
    z, s, a, residual = implicit.z, implicit.nodes.size, implicit.weights, implicit.residual
    n = implicit.accelerations.shape[1]
    for i in range(s):
        for c in range(n):
            z[i + 1, n + c] = z[0, n + c]
    before = np.inf
    for _ in range(15):
        _places(implicit, h)
        for i in range(s):
            at = t + h * implicit.nodes[i]
            if wear is not None:
                set_row(state.wear_depth, 0, row(implicit.wear_depth, i + 1))
            _jacobian(p, acts, state, at, z[i + 1], implicit, implicit.accelerations[i], implicit.jacobians[i])
            if wear is not None:
                set_row(state.wear_depth, 0, row(implicit.wear_depth, 0))
        _newton_matrix(implicit, h)
        for i in range(s):
            for c in range(n):
                value = z[0, n + c] - z[i + 1, n + c]
                for j in range(s):
                    value += h * a[i, j] * implicit.accelerations[j, c]
                residual[n * i + c] = value
        if not _eliminate(implicit.matrix, residual):
            return False
        change = 0.0
        for i in range(n * s):
            z[i // n + 1, n + i % n] += residual[i]
            change += abs(residual[i]) * (p.radius if i % 3 == 2 else 1.0)
        if not math.isfinite(change):
            return False
        state.evaluations += (2 * n + 1) * s
        if wear is not None:
            _places(implicit, h)
            change += (
                _wear_at_nodes(p, support, state, h, implicit, sliding, running_in)
                * p.velocity_tolerance
                / p.position_tolerance
            )
        # convergence is quadratic until only rounding errors remain
        if change < 1e-14 * p.threshold[0] or (change < 0.1 * p.velocity_tolerance and change > 0.1 * before):
            _places(implicit, h)
            return True
        before = change
    return False


@kernel()
def _interpolate(values, coefficients, h, out) -> None:
    """Write the series of eight polynomials, given by their values at the nodes of a step of size h.

    The differences from the last value are interpolated, because the coefficients of a large constant part would leave
    rounding errors.
    """
    scale, n = 1.0, len(coefficients)
    last = row(values, n - 1)
    for k in range(n):
        value = splat(0.0)
        for i in range(n - 1):
            value = value + (row(values, i) - last) * coefficients[k, i]
        value = value * scale
        set_row(out, k, value + last if k == 0 else value)
        scale /= h


@kernel()
def _relative_series(support, h, w, implicit):
    """Return the series of the body coordinates relative to the frame, and write the series of a frame on springs."""
    if support is not None:
        frame, s, relative = implicit.frame, implicit.nodes.size, w.seen
        _interpolate(implicit.seen, implicit.from_values, h, relative)
        _interpolate(frame, implicit.from_values, h, w.frame)
        _interpolate(frame[1:], implicit.from_stages, h, w.left)
        for i in (FRAME_VX, FRAME_VY, SPIN):
            for k in range(s):
                w.frame[k, i] = w.left[k, i]
            w.frame[s, i] = 0.0
        return relative
    return w.series


@kernel()
def _frame_terms(p, support, w, implicit, scale):
    """Return the initial velocity of the frame that its series omits, and the size of the last term of the series."""
    off = size = 0.0
    if support is not None:
        s = implicit.nodes.size
        start, here, last, place = implicit.frame[0], w.frame[0], w.frame[s - 1], w.frame[s]
        off += abs(here[FRAME_VX] - start[FRAME_VX]) + abs(here[FRAME_VY] - start[FRAME_VY])
        off += p.radius * abs(here[SPIN] - start[SPIN])
        size += 4.0 * (abs(last[FRAME_VX]) + abs(last[FRAME_VY]) + p.radius * abs(last[SPIN]))
        size += scale * (abs(place[FRAME_X]) + abs(place[FRAME_Y]) + p.radius * abs(place[FRAME_THETA]))
    return off, size


@kernel()
def _write_series(p, support, state, h, w, implicit, ramp, wear, stick) -> float:
    """Write the series of state, penetration, rate and force from the collocation polynomials. Return the error.

    The error is the size of the last terms. The polynomials of velocities and forces omit an initial velocity that a
    damper stops at once. If this velocity is too large, the error is infinite.
    """
    s, body, pairs, scratch = implicit.nodes.size, implicit.body, implicit.pairs, w.left
    _bodies(p, support, state, implicit, 0)
    _measure(p, support, state, implicit)
    _interpolate(body, implicit.from_values, h, w.series)
    _interpolate(body[1:], implicit.from_stages, h, scratch)
    for i in (VX, VY, OMEGA):
        for k in range(s):
            w.series[k, i] = scratch[k, i]
        w.series[s, i] = 0.0
    relative = _relative_series(support, h, w, implicit)
    _interpolate(pairs[0], implicit.from_stages, h, w.force)
    if wear is not None:
        _interpolate(implicit.wearing, implicit.from_stages, h, scratch)
    _interpolate(pairs[2], implicit.from_stages, h, w.rate)
    for k in range(s + 1):
        y = relative[k]
        penetration = row_values(p.penetration_rows, y[COS], y[SIN], y[X], y[Y])
        if k == 0:
            penetration = penetration + row(p.penetration_rows, 4) - row(state.wear_depth, 0)
        elif wear is not None:
            worn = row(scratch, k - 1) * (1.0 / k)
            set_row(w.wear, k, worn)
            penetration = penetration - worn
        set_row(w.penetration, k, penetration)
    size = grip = 0.0
    if stick is not None:
        _write_grip(p, state, h, w, implicit, _relative_nodes(support, implicit), relative)
        grip = _last_of_guards(p, state, w, h)
    if ramp is not None:
        size = _write_ramp(p, h, w, implicit)
    off = abs(w.series[0, VX] - body[0, VX]) + abs(w.series[0, VY] - body[0, VY])
    off += p.radius * abs(w.series[0, OMEGA] - body[0, OMEGA])
    scale = p.velocity_tolerance / p.position_tolerance * h
    more_off, more = _frame_terms(p, support, w, implicit, scale)
    off += more_off
    if not off <= _admissible(p):
        return np.inf
    last, place = w.series[s - 1], w.series[s]
    size += 4.0 * (abs(last[VX]) + abs(last[VY]) + p.radius * abs(last[OMEGA]))
    size += scale * (abs(place[X]) + abs(place[Y]) + p.radius * abs(place[THETA])) + more
    # part of the last term on [0, h] that polynomials of lower degree cannot represent
    return (size * h ** (s - 1) + grip * _GAIN * p.threshold[0]) * 2.0 ** (1 - 2 * s)


@kernel()
def _write_grip(p, state, h, w, implicit, relative, series) -> None:
    """Write the series of the slip rates and of the tangential forces (`solve.grip`)."""
    s, rates = implicit.nodes.size, w.right
    for i in range(s):
        y = relative[i + 1]
        for pair in range(PAIR_COUNT):
            rates[i, pair] = slip_rate(p, pair, y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY])
    _interpolate(rates, implicit.from_stages, h, w.slip[0])
    for k in range(s):
        y = series[k]
        place = rolled(p, row_values(p.slip_rows, y[COS], y[SIN], y[X], y[Y]), y[THETA])
        set_row(w.slip[4], k, grip_terms(p, state, w, k, place, row(w.slip[0], k)))


@kernel()
def _last_of_guards(p, state, w, h) -> float:
    """Return the largest ratio of the last term to the largest term in any guard function of stick and slip.

    Even a small force can determine whether a corner slips.
    """
    guard, share = w.column[0], 0.0
    for pair in range(PAIR_COUNT):
        for side in range(2):
            if grip_guard(p, state, w, STAGES, pair, side) != 0:
                largest, last, power = 0.0, 0.0, 1.0
                for k in range(STAGES):
                    if guard[k] != 0.0:
                        last = abs(guard[k]) * power
                    largest = max(largest, last)
                    power *= h
                if last > _GUARD_NOISE * largest:
                    share = max(share, last / largest)
    return share


@kernel()
def _write_ramp(p, h, w, implicit) -> float:
    """Write the force of a ramped law as K times an elastic part plus C times a remainder. Return the last term's size.

    The elastic part is d for the exponent 1, and 0 otherwise. The size is a velocity per h^(STAGES - 1). The force of a
    CLIPPED pair determines the time at which the pair starts to push.
    """
    s, largest = implicit.nodes.size, 0.0
    _interpolate(implicit.pairs[1], implicit.from_stages, h, w.damped)
    linear = p.exponent == 1.0
    for pair in range(PAIR_COUNT):
        largest = max(largest, abs(w.damped[s - 1, pair]))
    for k in range(s):
        rest = row(w.damped, k)
        if linear:
            rest = rest - row(w.penetration, k) * p.stiffness
        set_row(w.damped, k, rest * (1.0 / p.viscous))
        for i in range(4):
            set_row(w.power[i], k, splat(0.0))
    return largest * p.inverse_mass * h


@kernel(inline="source")
def own(parts):
    """Return nodes and scratch space of implicit steps, and the terms for which the method is compiled."""
    terms = parts.terms
    rubbing = terms.wear, terms.sliding, terms.running_in
    return parts.implicit, terms.ramp, rubbing, terms.slip, terms.stick, terms.support


@kernel(inline="source")
def lay_out(p, parts, own, state, w, span, penetrating) -> bool:
    """Compute an implicit step if damping limits explicit steps. The decay rate is written to `w.decay[0]`."""
    return _lay_out(p, parts, *own, state, w, span, penetrating)


@kernel()
def _lay_out(p, parts, implicit, ramp, rubbing, slip, stick, support, state, w, span, penetrating) -> bool:
    if implicit is None:
        return False
    state.implicit_size_before, state.decay_times_before = state.implicit_size, state.decay_times
    state.refused_before = state.refused
    # dampers of a support act without contact
    damped = penetrating or support is not None
    w.decay[0] = decay_rate(p, state, slip, stick, support) if damped else 0.0
    if w.decay[0] <= 0.0 or state.touching != 0 or not has_decayed(p, state):
        return False
    size = _collocate(p, parts, support, state, w, span, w.decay[0], implicit, ramp, *rubbing, stick)
    state.sigma_end, state.order = size, STAGES
    state.ends_at_stop = 1 if size == span else 0
    return size > 0.0


@kernel(inline="source")
def at_most_stable(p, implicit, state, w, sigma):
    """Return `sigma`, or the smaller value up to which an explicit step is stable."""
    if implicit is not None and w.decay[0] > 0.0 and state.beta == 0.0:
        sigma = min(sigma, stable_decay(p.order) / w.decay[0])
    return sigma


@kernel()
def note_step(implicit, state, w, step_size, has_event) -> None:
    """Store data for the next implicit step: the decay times of the current step, and a limit of the size."""
    if implicit is not None:
        note_decay(state, w.decay[0], step_size)
        if has_event:
            # the polynomial of a long step can show a false event if a pair only approaches its wall
            state.implicit_size = min(state.implicit_size, 4.0 * step_size)


@kernel()
def _start(p, support, state, implicit) -> None:
    if support is not None:
        to_world_both(p, state.y, state.frame, implicit.z[0])
    else:
        to_world(p, state.y, implicit.z[0])


@kernel()
def _collocate(p, parts, support, state, w, span, decay, implicit, ramp, wear, sliding, running_in, stick) -> float:
    """Compute an implicit step as series of order `STAGES`. Return its size in s, or 0 if explicit steps are better."""
    least = _WORTH * stable_decay(p.order) / decay
    if span < least:
        return 0.0
    h = min(max(state.implicit_size, 10.0 * least), span)
    _start(p, support, state, implicit)
    admissible = _admissible(p)
    while h >= least:
        for i in range(implicit.nodes.size + 1):
            set_row(implicit.wear_depth, i, row(state.wear_depth, 0))
        if _solve(p, acting(parts), support, state, state.step_start, h, implicit, wear, sliding, running_in):
            size = _write_series(p, support, state, h, w, implicit, ramp, wear, stick)
            better = 0.9 * (admissible / max(size, 1e-6 * admissible)) ** (1.0 / (STAGES - 1))
            if size <= admissible:
                # a step that a sample has shortened does not reduce the next step
                longer = h * min(better, 4.0)
                state.implicit_size = max(longer, state.implicit_size) if h == span else longer
                state.implicit_steps += 1
                state.refused = 0
                return h
            h *= min(max(better, 0.1), 0.7)
        else:
            h *= 0.25
    state.implicit_size = 0.0
    state.decay_times = 0.0
    state.refused = min(state.refused + 1, _MOST_REFUSED)
    return 0.0
