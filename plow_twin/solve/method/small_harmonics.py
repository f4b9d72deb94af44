"""Proof that the motion of a head in contact stays below the tolerance under small harmonic loads.

Near its equilibrium, the head satisfies e'' + C e' + K e = r. K and C are the matrices of stiffness and damping,
divided by mass and inertia. e is the distance of the head from the linear response to the harmonic loads, with the
angle times the radius of gyration as third coordinate. r is the remainder of the linearisation.

Let s and c be the smallest eigenvalues of K and C, and S the largest eigenvalue of C. Choose eps at most c / 2,
s / (10 S) and sqrt(s) / 10. For such an eps, the Lyapunov function V and the squared size W of the motion satisfy

    V = (e'e' + e K e) / 2 + eps (e e' + e C e / 2),  V' <= -eps W + r (1 + eps / sqrt(s)) sqrt(W),  W = e'e' + e K e

and V is between 0.45 W and 0.55 W. Therefore sqrt(W) always stays below the larger of 1.2 times its current value and
1.4 r / eps, and e stays below sqrt(W / s). Without damping (c = 0), e is not bounded.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.dynamics import accelerate
from plow_twin.solve.kinematics import penetration_of
from plow_twin.solve.loads import add_harmonics
from plow_twin.solve.method.equilibrium import stiffer_than
from plow_twin.solve.method.flight import amplitudes
from plow_twin.solve.state import ON, X, Y

#: Number of halvings after which an eigenvalue is treated as zero.
_HALVINGS = 40
#: Number of evaluations of the equations of motion in this proof.
EVALUATIONS = 4


@kernel()
def without_harmonics(p, harmonics, t, rate, spare) -> None:
    """Subtract the harmonic loads at time t from the accelerations rate[3:], with scratch space `spare`, shape (3,)."""
    if harmonics is not None:
        spare[0] = spare[1] = spare[2] = 0.0
        add_harmonics(p, harmonics, t, spare)
        for j in range(3):
            rate[3 + j] -= p.free[j] * spare[j]


@kernel()
def _damping_at(p, acts, state, w, gyration) -> None:
    """Write minus the derivatives of the accelerations with respect to the rates, at `w.rest[0]`, to `w.damping`."""
    z, rate, moved = w.rest[0], w.rest[1], w.rest[2]
    accelerate(p, acts, True, state, state.step_start, z, w.rest[3, :3], rate)
    for j in range(3):
        # exact, because the laws are linear in the rate
        unit = gyration if j == 2 else 1.0
        z[3 + j] = 1.0 / unit
        accelerate(p, acts, True, state, state.step_start, z, w.rest[3, :3], moved)
        z[3 + j] = 0.0
        for i in range(3):
            w.damping[i, j] = (rate[3 + i] - moved[3 + i]) * (gyration if i == 2 else 1.0)
            if p.free[i] == 0.0 or p.free[j] == 0.0:
                w.damping[i, j] = np.inf if i == j else 0.0
    state.evaluations += 4


@kernel()
def _least_eigenvalue(h) -> float:
    """Return a lower bound of the smallest eigenvalue, at least about half of it, or 0 if it is not positive."""
    least = 0.99 * min(h[0, 0], h[1, 1], h[2, 2])
    for _ in range(_HALVINGS):
        if stiffer_than(h, least):
            return least
        least *= 0.5
    return 0.0


@kernel()
def _trace(p, h) -> float:
    """Return an upper bound of the largest eigenvalue."""
    trace = 0.0
    for j in range(3):
        trace += h[j, j] if p.free[j] != 0.0 else 0.0
    return trace


@kernel(inline="code")
def _dynamic_stiffness(p, w, omega, i, j):
    """Return element (i, j) of K - omega^2 + i omega C, or of the unit matrix for locked coordinates."""
    if p.free[i] == 0.0 or p.free[j] == 0.0:
        return complex(1.0 if i == j else 0.0, 0.0)
    return complex(w.hessian[i, j] - (omega * omega if i == j else 0.0), omega * w.damping[i, j])


@kernel()
def _answer(p, harmonic, w, gyration):
    """Return the amplitudes of |x| in m and of sqrt(x K x), where x is the linear response to a harmonic load."""
    om = harmonic.omega
    a, b, c = _dynamic_stiffness(p, w, om, 0, 0), _dynamic_stiffness(p, w, om, 0, 1), _dynamic_stiffness(p, w, om, 0, 2)
    d, e, f = _dynamic_stiffness(p, w, om, 1, 0), _dynamic_stiffness(p, w, om, 1, 1), _dynamic_stiffness(p, w, om, 1, 2)
    g, h, k = _dynamic_stiffness(p, w, om, 2, 0), _dynamic_stiffness(p, w, om, 2, 1), _dynamic_stiffness(p, w, om, 2, 2)
    sx, cx = amplitudes(p, harmonic, 0)
    sy, cy = amplitudes(p, harmonic, 1)
    st, ct = amplitudes(p, harmonic, 2)
    x, y, t = p.free[0] * complex(cx, -sx), p.free[1] * complex(cy, -sy), p.free[2] * gyration * complex(ct, -st)
    # the inverse matrix, from the adjugate matrix
    first, second, third = e * k - f * h, f * g - d * k, d * h - e * g
    along_x = first * x + (c * h - b * k) * y + (b * f - c * e) * t
    along_y = second * x + (a * k - c * g) * y + (c * d - a * f) * t
    along_t = third * x + (b * g - a * h) * y + (a * e - b * d) * t
    size = math.sqrt(abs(along_x) ** 2 + abs(along_y) ** 2 + abs(along_t) ** 2)
    size /= abs(a * first + b * second + c * third)
    # x K x is at most |x| times the amplitudes of the harmonic load and of the inertia force
    load = math.sqrt(abs(x) ** 2 + abs(y) ** 2 + abs(t) ** 2)
    return size, math.sqrt(load * size) + om * size


@kernel()
def _left_out(p, state, w, reach, rate, gyration) -> float:
    """Return an upper bound of r in the module's docstring, for distances up to `reach` and rates up to `rate`.

    It is due to the nonlinearity of the pairs' forces and to their rotation with the head.
    """
    y, left_out = state.y, 0.0
    arm = (p.leverage + math.hypot(y[X], y[Y])) / gyration
    way = math.sqrt(1.0 + arm * arm)
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1 and state.mode[pair] == ON:
            d = penetration_of(p, state, pair, y)
            force = law_force(p, state, pair, d, 0.0)
            damper = law_force(p, state, pair, d, 1.0) - force
            bent = p.exponent * abs(p.exponent - 1.0) * force / d * reach
            if p.ramp > 0.0 or p.viscous == 0.0:
                bent += (p.exponent + 2.0) * damper * rate
            left_out += p.inverse_mass * way**3 * bent * reach / d
    return left_out + 4.0 * (_trace(p, w.hessian) * reach + _trace(p, w.damping) * rate) * reach / gyration


@kernel()
def stays_at_rest(p, acts, harmonics, state, w, distance, way, fast, gyration) -> bool:
    """Return whether the head always stays within `way` [m] of its equilibrium and slower than `fast` [m/s].

    `distance` is the current sqrt(W) of the module's docstring without the response to the harmonic loads. `w.hessian`
    contains the stiffness.
    """
    least = _least_eigenvalue(w.hessian)
    _damping_at(p, acts, state, w, gyration)
    eps = min(
        0.5 * _least_eigenvalue(w.damping), 0.1 * least / max(_trace(p, w.damping), 1e-300), 0.1 * math.sqrt(least)
    )
    swing = swing_rate = 0.0
    for i in range(harmonics.size):
        size, energy = _answer(p, harmonics[i], w, gyration)
        swing += size
        swing_rate += harmonics[i].omega * size
        distance += harmonics[i].omega * size + energy
    reach = min(way, 2.0 * (swing + 1.2 * distance / math.sqrt(least)))
    rate = min(fast, 2.0 * (swing_rate + 1.2 * distance))
    distance = max(1.2 * distance, 1.4 * _left_out(p, state, w, reach, rate, gyration) / eps)
    return swing + distance / math.sqrt(least) <= reach and swing_rate + distance <= rate
