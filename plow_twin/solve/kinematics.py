"""Kinematics of the head: penetrations and their rates, and the ways between body and world axes.

Everything that `model.geometry` gives as rows is linear in cosine, sine and place.
"""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, X, Y


@kernel(inline="source")
def row_value(rows, pair, c, s, x, y):
    """Return rows . (c, s, x, y) of one pair."""
    return rows[0, pair] * c + rows[1, pair] * s + rows[2, pair] * x + rows[3, pair] * y


@kernel(fast=True)
def row_values(rows, c, s, x, y):
    """Return rows . (c, s, x, y) of all pairs side by side."""
    return (row(rows, 0) * c + row(rows, 1) * s) + (row(rows, 2) * x + row(rows, 3) * y)


@kernel(inline="source")
def row_rate(rows, pair, c, s, omega, x, y, vx, vy):
    """Return the rate of rows . (c, s, x, y) of one pair: body axes turn with omega."""
    return row_value(rows, pair, -omega * s, omega * c, vx + omega * y, vy - omega * x)


@kernel(inline="code")
def penetration_at(p, state, pair, c, s, x, y):
    """Return the penetration of one pair in m, with the pad as worn as it is at the step's start."""
    return row_value(p.penetration_rows, pair, c, s, x, y) + p.penetration_rows[4, pair] - state.wear_depth[pair]


@kernel(inline="code")
def penetration_of(p, state, pair, y):
    """Return the penetration of one pair in body coordinates y, shape (8,)."""
    return penetration_at(p, state, pair, y[COS], y[SIN], y[X], y[Y])


@kernel(inline="code")
def rate_at(p, pair, c, s, omega, x, y, vx, vy):
    """Return the rate of one pair's penetration in m/s."""
    return row_rate(p.penetration_rows, pair, c, s, omega, x, y, vx, vy)


@kernel(inline="code")
def rate_of(p, pair, y):
    """Return the rate of one pair's penetration in body coordinates y, shape (8,)."""
    return rate_at(p, pair, y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY])


@kernel(inline="source")
def to_body_axes(c, s, x, y):
    """Resolve a vector in world axes along body axes."""
    return c * x + s * y, c * y - s * x


@kernel(inline="source")
def to_world_axes(c, s, x, y):
    """Resolve a vector in body axes along world axes."""
    return c * x - s * y, s * x + c * y


@kernel()
def to_body(z, y) -> None:
    """Write body coordinates from z = (x, y, theta, vx, vy, omega) of the centre of mass."""
    c, s = math.cos(z[2]), math.sin(z[2])
    y[X], y[Y] = to_body_axes(c, s, z[0], z[1])
    y[VX], y[VY] = to_body_axes(c, s, z[3], z[4])
    y[OMEGA] = z[5]
    y[COS], y[SIN], y[THETA] = c, s, z[2]


@kernel()
def to_world(y, z) -> None:
    """Write z = (x, y, theta, vx, vy, omega) of the centre of mass from body coordinates."""
    z[0], z[1] = to_world_axes(y[COS], y[SIN], y[X], y[Y])
    z[3], z[4] = to_world_axes(y[COS], y[SIN], y[VX], y[VY])
    z[2], z[5] = y[THETA], y[OMEGA]


@kernel()
def pose_of(p, y, offset, q, v) -> None:
    """Write pose and rate of the cavity's centre in world axes from body coordinates; inverse of `body_state`."""
    x, yy, vx, vy, om = y[X], y[Y], y[VX], y[VY], y[OMEGA]
    if offset is not None:
        x, yy = x - p.offset[0], yy - p.offset[1]
        vx, vy = vx + om * p.offset[1], vy - om * p.offset[0]
    q[0], q[1] = to_world_axes(y[COS], y[SIN], x, yy)
    v[0], v[1] = to_world_axes(y[COS], y[SIN], vx, vy)
    q[2], v[2] = y[THETA], om
