"""The equations of motion (paper, eq. 5) as they stand: values in world axes about the centre of mass."""

from __future__ import annotations

import math

from plow_twin.model.contact import free_force
from plow_twin.model.friction import friction_force
from plow_twin.model.kernel import kernel
from plow_twin.solve.layout import COS, OMEGA, ON, SIN, THETA, VX, VY
from plow_twin.solve.loads import combined, load_at


@kernel()
def accelerate(p, parts, offset, free, slip, frozen, state, t, z, load, out) -> None:
    """Write the rate of z = (x, y, theta, vx, vy, omega).

    `frozen`: the pairs that are on act by their law, also where it would pull; else those that penetrate push.
    """
    load_at(p, parts.harmonics, parts.second, parts.segments, t, load)
    A, B = p.gap, p.arm
    c, s, om = math.cos(z[2]), math.sin(z[2]), z[5]
    x, y, vx, vy = c * z[0] + s * z[1], c * z[1] - s * z[0], c * z[3] + s * z[4], c * z[4] - s * z[3]
    fx = fy = torque = 0.0
    for pair in range(8):
        if p.enabled[pair] == 0:
            continue
        d = A[0, pair] * c + A[1, pair] * s + A[2, pair] * x + A[3, pair] * y + A[4, pair] - state.depth[pair]
        if (frozen and state.mode[pair] == ON) or (not frozen and d > 0.0):
            r = om * (A[1, pair] * c - A[0, pair] * s) + A[2, pair] * (vx + om * y) + A[3, pair] * (vy - om * x)
            f = free_force(d, r, p.stiffness, p.exponent, state.factor[pair], p.viscous, p.ramp)
            if not frozen:
                f = max(f, 0.0)
            fx -= A[2, pair] * f
            fy -= A[3, pair] * f
            torque += (B[0, pair] * c + B[1, pair] * s + B[2, pair] * x + B[3, pair] * y) * f
            if slip is not None:
                along = combined(slip.rows, pair, -om * s, om * c, vx + om * y, vy - om * x)
                drag = friction_force(f, along, slip.coefficient, slip.speed)
                # t is the normal turned by +90 degrees
                fx += A[3, pair] * drag
                fy -= A[2, pair] * drag
                torque += combined(slip.arm, pair, c, s, x, y) * drag
    moment = load[2] + torque * p.inverse_inertia
    if offset is not None:
        force_x, force_y = load[0], load[1] + p.gravity
        across = (c * offset[0] - s * offset[1]) * force_y - (s * offset[0] + c * offset[1]) * force_x
        moment -= across * p.inverse_inertia / p.inverse_mass
    out[0], out[1], out[2] = z[3], z[4], z[5]
    out[3] = load[0] + (c * fx - s * fy) * p.inverse_mass
    out[4] = load[1] + (s * fx + c * fy) * p.inverse_mass
    out[5] = moment
    if free is not None:
        for j in range(3):
            out[3 + j] *= free[j]


@kernel()
def to_body(z, y) -> None:
    """Write body coordinates from z."""
    c, s = math.cos(z[2]), math.sin(z[2])
    y[0], y[1] = c * z[0] + s * z[1], c * z[1] - s * z[0]
    y[VX], y[VY], y[OMEGA] = c * z[3] + s * z[4], c * z[4] - s * z[3], z[5]
    y[COS], y[SIN], y[THETA] = c, s, z[2]


@kernel()
def to_world(y, z) -> None:
    """Write z from body coordinates."""
    c, s = y[COS], y[SIN]
    z[0], z[1], z[2] = c * y[0] - s * y[1], s * y[0] + c * y[1], y[THETA]
    z[3], z[4], z[5] = c * y[VX] - s * y[VY], s * y[VX] + c * y[VY], y[OMEGA]
