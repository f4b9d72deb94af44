"""Equations of motion (paper, eq. 5) as functions of the state, in world axes about the centre of mass."""

from __future__ import annotations

import math
from typing import NamedTuple

from plow_twin.kernel.compiler import kernel
from plow_twin.model.friction import friction_force
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.contact_force import law_force
from plow_twin.solve.grip import tangential_force
from plow_twin.solve.kinematics import (
    along,
    named_angle,
    penetration_at,
    rate_at,
    row_value,
    slip_arm,
    slip_place,
    slip_rate,
    to_body_axes,
    to_world_axes,
)
from plow_twin.solve.loads import load_at
from plow_twin.solve.state import ON, Harmonics, Segments


class Acting(NamedTuple):
    """Loads and terms of the equations of motion, without the terms of the contact law.

    Scenes with the same types in this tuple share compiled code.
    """

    harmonics: Harmonics | None
    segments: Segments | None
    offset: int | None
    free: int | None
    slip: int | None
    stick: int | None
    support: int | None


@kernel(inline="source")
def acting(parts):
    """Return the `Acting` of a scene."""
    terms = parts.terms
    return Acting(parts.harmonics, parts.segments, terms.offset, terms.free, terms.slip, terms.stick, terms.support)


@kernel()
def push(p, slip, stick, state, frozen, pair, force, c, s, theta, omega, x, y, vx, vy):
    """Return force and moment of one pair in head axes, and the power of its friction, for the normal force `force`.

    Rows 2 and 3 of `p.penetration_rows` contain the wall's normal with the opposite sign.
    """
    fx, fy = -p.penetration_rows[2, pair] * force, -p.penetration_rows[3, pair] * force
    torque, power = row_value(p.arm_rows, pair, c, s, x, y) * force, 0.0
    if slip is not None or stick is not None:
        rate = slip_rate(p, pair, c, s, omega, x, y, vx, vy)
        if stick is not None:
            place = slip_place(p, pair, c, s, x, y, theta)
            drag = tangential_force(p, state, frozen, pair, force, place, rate)
        else:
            drag = friction_force(force, rate, p.friction, p.slip_speed)
        fx += p.penetration_rows[3, pair] * drag
        fy -= p.penetration_rows[2, pair] * drag
        torque += slip_arm(p, pair, c, s, x, y) * drag
        power = drag * rate
    return fx, fy, torque, power


@kernel(inline="source")
def about_mass(p, c, s, load):
    """Return the head's angular acceleration due to a load at the cavity's centre.

    Gravity, which is part of the load, acts at the centre of mass and has no moment.
    """
    across = (c * p.offset[0] - s * p.offset[1]) * (load[1] + p.gravity)
    return -(across - (s * p.offset[0] + c * p.offset[1]) * load[0]) * p.inverse_inertia / p.inverse_mass


@kernel()
def accelerate(p, acts, frozen, state, t, z, load, out) -> None:
    """Write the rate of z = (x, y, theta, vx, vy, omega) to `out`. With a support, `to_world_both` defines z.

    If `frozen` is true, the pairs with mode ON exert the force of their law, even where it would pull. Otherwise all
    penetrating pairs exert force, and no pair pulls.
    """
    load_at(p, acts.harmonics, acts.segments, t, load)
    _accelerate(p, acts.offset, acts.free, acts.slip, acts.stick, acts.support, frozen, state, z, load, out)


@kernel()
def _contacts(p, slip, stick, frozen, state, c, s, theta, om, x, y, vx, vy):
    """Return the sum of the pairs' forces in head axes, and the sum of their moments about the centre of mass."""
    fx = fy = torque = 0.0
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 0:
            continue
        d = penetration_at(p, state, pair, c, s, x, y)
        if (frozen and state.mode[pair] == ON) or (not frozen and d > 0.0):
            r = rate_at(p, pair, c, s, om, x, y, vx, vy)
            f = law_force(p, state, pair, d, r)
            if not frozen:
                f = max(f, 0.0)
            push_x, push_y, moment, _ = push(p, slip, stick, state, frozen, pair, f, c, s, theta, om, x, y, vx, vy)
            fx += push_x
            fy += push_y
            torque += moment
    return fx, fy, torque


@kernel()
def _accelerate(p, offset, free, slip, stick, support, frozen, state, z, load, out) -> None:
    if support is not None:
        _accelerate_both(p, offset, free, slip, stick, frozen, state, z, load, out)
        return
    angle, om = named_angle(p, state.y, z[2]), z[5]
    c, s = math.cos(angle), math.sin(angle)
    ca, sa = along(p, c, s)
    x, y = to_body_axes(ca, sa, z[0], z[1])
    vx, vy = to_body_axes(ca, sa, z[3], z[4])
    fx, fy, torque = _contacts(p, slip, stick, frozen, state, c, s, z[2], om, x, y, vx, vy)
    out[0], out[1], out[2] = z[3], z[4], z[5]
    along_x, along_y = to_world_axes(ca, sa, fx, fy)
    _accelerate_head(p, offset, free, c, s, load, along_x, along_y, torque, 3, out)


@kernel()
def _accelerate_head(p, offset, free, c, s, load, along_x, along_y, torque, first, out) -> None:
    """Write the head's accelerations to `out[first:first + 3]`, for the contact force (along_x, along_y)."""
    out[first] = load[0] + along_x * p.inverse_mass
    out[first + 1] = load[1] + along_y * p.inverse_mass
    out[first + 2] = load[2] + torque * p.inverse_inertia
    if offset is not None:
        out[first + 2] += about_mass(p, c, s, load)
    if free is not None:
        for j in range(3):
            out[first + j] *= p.free[j]


@kernel()
def _accelerate_both(p, offset, free, slip, stick, frozen, state, z, load, out) -> None:
    """Write the rate of the state of head and frame. `support.to_world_both` defines this state."""
    c, s, om, spin = math.cos(z[2]), math.sin(z[2]), z[8], z[11]
    # pose and rates of the head relative to the frame
    angle = z[2] - z[5]
    x, y = to_body_axes(c, s, z[0] - z[3], z[1] - z[4])
    vx, vy = to_body_axes(c, s, z[6] - z[9], z[7] - z[10])
    fx, fy, torque = _contacts(
        p, slip, stick, frozen, state, math.cos(angle), math.sin(angle), angle, om - spin, x, y, vx + spin * y,
        vy - spin * x,
    )  # fmt: skip
    along_x, along_y = to_world_axes(c, s, fx, fy)
    for j in range(6):
        out[j] = z[6 + j]
    _accelerate_head(p, offset, free, c, s, load, along_x, along_y, torque, 6, out)
    out[9], out[10], out[11] = along_x, along_y, torque + x * fy - y * fx
    for j in range(3):
        out[9 + j] = -p.frame_mobility[j] * out[9 + j] - p.frame_stiffness[j] * z[3 + j] - p.frame_damping[j] * z[9 + j]
