"""Kinematics of the head: penetrations and their rates, and conversions between axes.

The argument `rows` contains each pair's coefficients of cosine and sine of the head's angle and of its position x, y
(`model.geometry`).
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.by_field import by_field
from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, splat
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, X, Y

#: A quarter turn in rad, after which the corners of a tumbling block are renamed (`solve.tumbling`).
QUARTER_TURN = 0.5 * math.pi


#: 1 for a state in world axes, as for a head that carries corners, and None for a state in head axes.
fixed_axes = by_field("tumbles", lambda p: 1, lambda p: None)
#: Whether the head may turn beyond 45 degrees (`model.geometry.tumbles`).
may_tumble = by_field("tumbles", lambda p: p.tumbles != 0.0, lambda p: False)


#: 1 for rounded corners, whose rotation moves the touching point along its wall, and None for sharp corners.
_is_rounded = by_field("roll", lambda p: 1, lambda p: None)
_roll = by_field("roll", lambda p: p.roll, lambda p: 0.0)


@kernel(inline="code")
def along(p, c, s):
    """Return cosine and sine of the angle of the state's axes, from cosine c and sine s of the head's angle."""
    if fixed_axes(p) is not None:
        return 1.0, 0.0
    return c, s


@kernel(inline="code")
def spin_of_axes(p, omega):
    """Return the angular velocity of the state's axes in rad/s."""
    if fixed_axes(p) is not None:
        return 0.0
    return omega


@kernel(inline="code")
def named_angle(p, y, theta):
    """Return theta without the quarter turns after which the corners were renamed (`solve.tumbling`).

    The body coordinates y contain the cosine and sine of this angle, which is theta for a head that carries walls.
    """
    if fixed_axes(p) is not None:
        turns = np.rint((y[THETA] - math.atan2(y[SIN], y[COS])) / QUARTER_TURN)
        return theta - turns * QUARTER_TURN
    return theta


@kernel(inline="source")
def row_value(rows, pair, c, s, x, y):
    """Return the scalar product of one pair's coefficients with (c, s, x, y)."""
    return rows[0, pair] * c + rows[1, pair] * s + rows[2, pair] * x + rows[3, pair] * y


@kernel(fast=True)
def row_values(rows, c, s, x, y):
    """Return the scalar products of all pairs' coefficients with (c, s, x, y), as a vector of eight lanes."""
    return (row(rows, 0) * c + row(rows, 1) * s) + (row(rows, 2) * x + row(rows, 3) * y)


@kernel(inline="source")
def row_rate(p, rows, pair, c, s, omega, x, y, vx, vy):
    """Return the time derivative of one pair's `row_value`."""
    spin = spin_of_axes(p, omega)
    return row_value(rows, pair, -omega * s, omega * c, vx + spin * y, vy - spin * x)


@kernel(inline="code")
def slip_place(p, pair, c, s, x, y, theta):
    """Return the position of a corner's touching point along its wall in m."""
    place = row_value(p.slip_rows, pair, c, s, x, y)
    if _is_rounded(p) is not None:
        place += _roll(p) * theta
    return place


@kernel(inline="code")
def slip_rate(p, pair, c, s, omega, x, y, vx, vy):
    """Return the rate in m/s at which a corner's touching point slides along its wall."""
    rate = row_rate(p, p.slip_rows, pair, c, s, omega, x, y, vx, vy)
    if _is_rounded(p) is not None:
        rate += _roll(p) * omega
    return rate


@kernel(inline="code")
def slip_arm(p, pair, c, s, x, y):
    """Return the moment arm in m of a friction force that acts at a corner's touching point."""
    arm = row_value(p.slip_arm_rows, pair, c, s, x, y)
    if _is_rounded(p) is not None:
        arm -= _roll(p)
    return arm


@kernel(fast=True, inline="code")
def rolled(p, values, angle):
    """Return positions along the walls, or slip rates, plus the product of `roll` and `angle` or its rate."""
    if _is_rounded(p) is not None:
        values = values + splat(_roll(p) * angle)
    return values


@kernel(fast=True, inline="code")
def slip_arms(p, arms, k):
    """Return coefficient k of all friction arms, given those of sharp corners, `arms`."""
    if _is_rounded(p) is not None and k == 0:
        arms = arms - splat(_roll(p))
    return arms


@kernel(inline="code")
def penetration_at(p, state, pair, c, s, x, y):
    """Return the penetration of one pair in m, with the wear depth at the start of the step."""
    return row_value(p.penetration_rows, pair, c, s, x, y) + p.penetration_rows[4, pair] - state.wear_depth[pair]


@kernel(inline="code")
def penetration_of(p, state, pair, y):
    """Return the penetration of one pair in m at body coordinates y, shape (8,)."""
    return penetration_at(p, state, pair, y[COS], y[SIN], y[X], y[Y])


@kernel(inline="code")
def rate_at(p, pair, c, s, omega, x, y, vx, vy):
    """Return the rate of one pair's penetration in m/s."""
    return row_rate(p, p.penetration_rows, pair, c, s, omega, x, y, vx, vy)


@kernel(inline="code")
def rate_of(p, pair, y):
    """Return the rate of one pair's penetration in m/s at body coordinates y, shape (8,)."""
    return rate_at(p, pair, y[COS], y[SIN], y[OMEGA], y[X], y[Y], y[VX], y[VY])


@kernel(inline="source")
def to_body_axes(c, s, x, y):
    """Convert a vector from world axes to body axes."""
    return c * x + s * y, c * y - s * x


@kernel(inline="source")
def to_world_axes(c, s, x, y):
    """Convert a vector from body axes to world axes."""
    return c * x - s * y, s * x + c * y


@kernel()
def to_body(p, named, z, y) -> None:
    """Write body coordinates to y from z = (x, y, theta, vx, vy, omega) of the centre of mass.

    The corners have the same names as in the body coordinates `named` (`named_angle`).
    """
    angle = named_angle(p, named, z[2])
    c, s = math.cos(angle), math.sin(angle)
    ca, sa = along(p, c, s)
    y[X], y[Y] = to_body_axes(ca, sa, z[0], z[1])
    y[VX], y[VY] = to_body_axes(ca, sa, z[3], z[4])
    y[OMEGA] = z[5]
    y[COS], y[SIN], y[THETA] = c, s, z[2]


@kernel()
def to_world(p, y, z) -> None:
    """Write z = (x, y, theta, vx, vy, omega) of the centre of mass from body coordinates."""
    c, s = along(p, y[COS], y[SIN])
    z[0], z[1] = to_world_axes(c, s, y[X], y[Y])
    z[3], z[4] = to_world_axes(c, s, y[VX], y[VY])
    z[2], z[5] = y[THETA], y[OMEGA]


@kernel()
def pose_of(p, y, offset, q, v) -> None:
    """Write pose and rate of the cavity's centre in world axes from body coordinates (inverse of `body_state`)."""
    x, yy, vx, vy, om = y[X], y[Y], y[VX], y[VY], y[OMEGA]
    if offset is not None:
        x, yy = x - p.offset[0], yy - p.offset[1]
        vx, vy = vx + om * p.offset[1], vy - om * p.offset[0]
    c, s = along(p, y[COS], y[SIN])
    q[0], q[1] = to_world_axes(c, s, x, yy)
    v[0], v[1] = to_world_axes(c, s, vx, vy)
    q[2], v[2] = y[THETA], om
