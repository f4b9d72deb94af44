"""Implicit steps for overdamped contact: collocation at Radau points with the contact modes frozen.

Where damping stops a pair long before its spring moves it, an explicit series is bound by stability: steps of a few
decay times, however smooth the motion. Radau IIA collocation (Hairer and Wanner, Solving ODEs II, sec. IV.5) is stable
there. Its solution is a polynomial in time too: written as a series, events, output and statistics are those of any
other step.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_jacobi

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row, splat
from plow_twin.model.contact import free_force
from plow_twin.solve.dynamics import accelerate
from plow_twin.solve.kinematics import penetration_of, rate_of, row_value, row_values, to_body, to_world
from plow_twin.solve.state import COS, DAMPS, OMEGA, ON, SIN, THETA, VX, VY, Implicit, X, Y

#: Stages: the polynomials' degree. The order is 2 s - 1.
STAGES = 9
#: Explicit steps in a row that were bound by stability before an implicit one is tried; how many of them it must be
#: worth, for it costs as much.
PATIENCE, _GAIN = 20, 100.0
#: A step that covers so many decay times is bound by stability, not by what decays.
_DECAY_TIMES = 4.0


def _coefficients(nodes: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
    """Return c with sum_i c[k, i] f(nodes[i]) the coefficient k of the polynomial through the nodes, shape (n, n).

    In extended precision: the inverse of a Vandermonde matrix would lose half of the digits.
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
    """Return nodes, weights, and the coefficients from values at the start and the nodes, and at the nodes alone."""
    inner = 0.5 * (roots_jacobi(STAGES - 1, 1.0, 0.0)[0] + 1.0)
    nodes = np.append(np.sort(inner), 1.0).astype(np.longdouble)
    degree = np.arange(1, STAGES + 1)
    from_stages = _coefficients(nodes)
    weights = (nodes[:, None] ** degree / degree) @ from_stages
    from_values = _coefficients(np.append(np.longdouble(0.0), nodes))
    return tuple(table.astype(np.float64) for table in (nodes, weights, from_values, from_stages))


def new_implicit() -> Implicit:
    """Return nodes, weights and scratch space."""
    nodes, weights, from_values, from_stages = _rule()
    size = 3 * STAGES
    return Implicit(
        nodes, weights, from_values, from_stages,
        np.zeros((STAGES + 1, 6)), np.zeros((2, 6)), np.zeros((STAGES, 3)), np.zeros((STAGES, 2, 3, 3)),
        np.zeros((size, size)), np.zeros(size), np.zeros((STAGES + 1, 8)), np.zeros((STAGES, 8)), np.zeros(3),
    )  # fmt: skip


@kernel()
def stiffest(p, state, w):
    """Return the largest rate of decay in 1/s that a pair's damping gives alone."""
    y, largest = state.y, 0.0
    for pair in range(8):
        if state.mode[pair] == ON:
            damping = w.per_pair[DAMPS, pair]
            if p.viscous == 0.0:
                damping *= max(w.penetration[0, pair], 0.0) ** p.exponent
            arm = row_value(p.arm_rows, pair, y[COS], y[SIN], y[X], y[Y])
            largest = max(largest, damping * (p.inverse_mass + arm * arm * p.inverse_inertia))
    return largest


@kernel()
def note_explicit(p, state, w, length, free) -> None:
    """Count explicit steps in a row that were bound by the stability of an overdamped contact.

    `free`: nothing from outside has ended the step.
    """
    bound = free and length * stiffest(p, state, w) > _DECAY_TIMES
    state.overdamped = state.overdamped + 1 if bound else min(state.overdamped, 0)
    if bound and state.implicit_size < _GAIN * length:
        state.implicit_size = 4.0 * _GAIN * length
    state.explicit_size = length


@kernel()
def _jacobian(p, parts, state, t, z, implicit, base, out) -> None:
    """Write the accelerations at z to `base` (3,), their derivatives by place and by velocity to `out` (2, 3, 3)."""
    rate, moved = implicit.rate[0], implicit.rate[1]
    accelerate(p, parts, True, state, t, z, implicit.load, rate)
    for j in range(6):
        # where the law is linear any difference will do that rounding does not spoil
        delta = 1e-8 / (p.radius if j % 3 == 2 else 1.0)
        saved = z[j]
        z[j] = saved + delta
        accelerate(p, parts, True, state, t, z, implicit.load, moved)
        z[j] = saved
        for i in range(3):
            out[j // 3, i, j % 3] = (moved[3 + i] - rate[3 + i]) / delta
    for i in range(3):
        base[i] = rate[3 + i]


@kernel()
def _newton_matrix(implicit, h) -> None:
    """Write d residual / d velocities: places follow from velocities, x_i = x_0 + h sum a_ij v_j."""
    a, jacobians, matrix, s = implicit.weights, implicit.jacobians, implicit.matrix, implicit.nodes.size
    for i in range(s):
        for j in range(s):
            for r in range(3):
                for c in range(3):
                    value = 1.0 if i == j and r == c else 0.0
                    value -= h * a[i, j] * jacobians[j, 1, r, c]
                    for k in range(s):
                        value -= h * h * a[i, k] * a[k, j] * jacobians[k, 0, r, c]
                    matrix[3 * i + r, 3 * j + c] = value


@kernel()
def _eliminate(matrix, right) -> bool:
    """Solve matrix x = right in place by Gaussian elimination; False instead of an exception when it is singular."""
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
    """Write the places at the nodes from the velocities there."""
    z, a, s = implicit.z, implicit.weights, implicit.nodes.size
    for i in range(s):
        for c in range(3):
            value = z[0, c]
            for j in range(s):
                value += h * a[i, j] * z[j + 1, 3 + c]
            z[i + 1, c] = value


@kernel()
def _solve(p, parts, state, t, h, implicit) -> bool:
    """Find the velocities at the nodes by Newton's method; return whether it converged.

    The derivatives are taken at every node: as the head turns, so does the direction that is damped.
    """
    z, s, a, residual = implicit.z, implicit.nodes.size, implicit.weights, implicit.residual
    for i in range(s):
        for c in range(3):
            z[i + 1, 3 + c] = z[0, 3 + c]
    before = np.inf
    for _ in range(10):
        _places(implicit, h)
        for i in range(s):
            at = t + h * implicit.nodes[i]
            _jacobian(p, parts, state, at, z[i + 1], implicit, implicit.accelerations[i], implicit.jacobians[i])
        _newton_matrix(implicit, h)
        for i in range(s):
            for c in range(3):
                value = z[0, 3 + c] - z[i + 1, 3 + c]
                for j in range(s):
                    value += h * a[i, j] * implicit.accelerations[j, c]
                residual[3 * i + c] = value
        if not _eliminate(implicit.matrix, residual):
            return False
        change = 0.0
        for i in range(3 * s):
            z[i // 3 + 1, 3 + i % 3] += residual[i]
            change += abs(residual[i]) * (p.radius if i % 3 == 2 else 1.0)
        if not math.isfinite(change):
            return False
        state.evaluations += 7 * s
        # quadratic: a small change, or one that rounding keeps from falling further, is the last
        if change < 1e-3 * p.threshold[p.order] or (change < p.velocity_tolerance and change > 0.1 * before):
            _places(implicit, h)
            return True
        before = change
    return False


@kernel()
def _interpolate(values, coefficients, h, out) -> None:
    """Write the series of the polynomials of a step of length h that take eight values at each node."""
    scale = 1.0
    for k in range(len(coefficients)):
        value = splat(0.0)
        for i in range(len(coefficients)):
            value = value + row(values, i) * coefficients[k, i]
        set_row(out, k, value * scale)
        scale /= h


@kernel()
def _write_series(p, state, h, w, implicit) -> float:
    """Write the collocation polynomial of state, penetration, rate and force as series; return its last term's size."""
    s, body, forces = implicit.nodes.size, implicit.body, implicit.forces
    for i in range(s + 1):
        to_body(implicit.z[i], body[i])
    _interpolate(body, implicit.from_values, h, w.series)
    for k in range(s + 1):
        y = w.series[k]
        penetration = row_values(p.penetration_rows, y[COS], y[SIN], y[X], y[Y])
        if k == 0:
            penetration = penetration + row(p.penetration_rows, 4) - row(state.wear_depth, 0)
        else:
            set_row(w.rate, k - 1, penetration * k)
        set_row(w.penetration, k, penetration)
    for i in range(s):
        y = body[i + 1]
        for pair in range(8):
            forces[i, pair] = 0.0
            if state.mode[pair] == ON:
                d = penetration_of(p, state, pair, y)
                r = rate_of(p, pair, y)
                forces[i, pair] = free_force(
                    d, r, p.stiffness, p.exponent, state.damping_factor[pair], p.viscous, p.ramp
                )
    _interpolate(forces, implicit.from_stages, h, w.force)
    last = w.series[s]
    size = abs(last[VX]) + abs(last[VY]) + p.radius * abs(last[OMEGA])
    size += p.velocity_tolerance / p.position_tolerance * (abs(last[X]) + abs(last[Y]) + p.radius * abs(last[THETA]))
    # its share on [0, h] that polynomials of lower degree cannot take over
    return size * h**s * 2.0 ** (1 - 2 * s)


@kernel()
def collocate(p, parts, state, w, span, implicit) -> float:
    """Lay out an implicit step as series of order `STAGES`; return its length, or 0 when an explicit one is better."""
    least = _GAIN * state.explicit_size
    h = min(max(state.implicit_size, 2.0 * least), span)
    to_world(state.y, implicit.z[0])
    # one that stands for so many explicit steps may spend their shares; much of it is a layer at the start that decays
    admissible = _GAIN * p.threshold[p.order]
    while h >= least:
        if _solve(p, parts, state, state.step_start, h, implicit):
            size = _write_series(p, state, h, w, implicit)
            better = 0.9 * (admissible / max(size, 1e-6 * admissible)) ** (1.0 / STAGES)
            if size <= admissible:
                # a step cut short by a sample says nothing against a longer one
                longer = h * min(better, 4.0)
                state.implicit_size = max(longer, state.implicit_size) if h == span else longer
                state.implicit_steps += 1
                return h
            h *= min(max(better, 0.1), 0.7)
        else:
            h *= 0.25
    state.implicit_size = 0.0
    # not soon again: an attempt costs as much as a hundred explicit steps
    state.overdamped = -500
    return 0.0
