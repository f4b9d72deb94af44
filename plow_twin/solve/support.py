"""A frame on springs: a second body on which springs, dampers and the reactions of the contact forces act.

    m_f u'' = -k_x u - c_x u' - sum F_x      (v likewise)      I_f phi'' = -k_phi phi - c_phi phi' - sum (p x F)

u, v, phi is the frame's displacement in world axes. F is the force of a pair on the head, and p is its point of action
relative to the frame's centre. The head's equations of motion use its position relative to the ground, but `State.y` is
relative to the frame, so that modes, events and outputs are computed as for a fixed frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, set_row
from plow_twin.solve.kinematics import to_body, to_body_axes, to_world
from plow_twin.solve.state import COS, OMEGA, SIN, THETA, VX, VY, X, Y

#: Columns of the frame's series `w.frame`: displacement and velocity in world axes, angular velocity, cosine and sine
#: of the head's angle relative to the frame, and the frame's angle.
FRAME_X, FRAME_Y, FRAME_VX, FRAME_VY, SPIN, RELATIVE_COS, RELATIVE_SIN, FRAME_THETA = range(8)


@kernel()
def to_ground(y, frame, out) -> None:
    """Convert the head's body coordinates y from relative to the frame to relative to the ground (`out`).

    `frame` is the state of the frame, shape (6,).
    """
    theta, spin = y[THETA] + frame[2], frame[5]
    c, s = math.cos(theta), math.sin(theta)
    bx, by = to_body_axes(c, s, frame[0], frame[1])
    wx, wy = to_body_axes(c, s, frame[3], frame[4])
    x, yy = y[X], y[Y]
    out[VX], out[VY] = y[VX] + wx - spin * yy, y[VY] + wy + spin * x
    out[X], out[Y], out[OMEGA] = x + bx, yy + by, y[OMEGA] + spin
    out[COS], out[SIN], out[THETA] = c, s, theta


@kernel()
def from_ground(y, frame, out) -> None:
    """Invert `to_ground`. `out` may be y."""
    theta, spin = y[THETA], frame[5]
    c, s = math.cos(theta), math.sin(theta)
    bx, by = to_body_axes(c, s, frame[0], frame[1])
    wx, wy = to_body_axes(c, s, frame[3], frame[4])
    x, yy = y[X] - bx, y[Y] - by
    out[VX], out[VY] = y[VX] - wx + spin * yy, y[VY] - wy - spin * x
    out[X], out[Y], out[OMEGA], out[THETA] = x, yy, y[OMEGA] - spin, theta - frame[2]
    out[COS], out[SIN] = math.cos(out[THETA]), math.sin(out[THETA])


@kernel()
def to_world_both(p, y, frame, z) -> None:
    """Write z = (x, y, theta, u, v, phi) and its rates in world axes, shape (12,), from the states of both bodies."""
    absolute, head = np.empty(8), np.empty(6)
    to_ground(y, frame, absolute)
    to_world(p, absolute, head)
    for j in range(3):
        z[j], z[6 + j] = head[j], head[3 + j]
        z[3 + j], z[9 + j] = frame[j], frame[3 + j]


@kernel()
def to_body_both(p, z, y, frame) -> None:
    """Invert `to_world_both`."""
    head = np.empty(6)
    for j in range(3):
        head[j], head[3 + j] = z[j], z[6 + j]
        frame[j], frame[3 + j] = z[3 + j], z[9 + j]
    to_body(p, y, head, y)
    from_ground(y, frame, y)


@kernel()
def start_frame(state, w) -> None:
    """Write the first rows of the series of head and frame to `w.moved` and `w.frame`."""
    frame, here = state.frame, w.frame[0]
    to_ground(state.y, frame, w.moved)
    for j in range(2):
        here[FRAME_X + j], here[FRAME_VX + j] = frame[j], frame[3 + j]
    here[SPIN], here[FRAME_THETA] = frame[5], frame[2]
    here[RELATIVE_COS], here[RELATIVE_SIN] = math.cos(state.y[THETA]), math.sin(state.y[THETA])


@kernel(fast=True)
def see_from_frame(w, order, sigma, y) -> None:
    """Make the head's coordinates y at `sigma` relative to the frame, and write the frame's state to `w.frame_now`."""
    value = row(w.frame, order)
    for k in range(order - 1, -1, -1):
        value = value * sigma + row(w.frame, k)
    set_row(w.frame_sum, 0, value)
    here, now = w.frame_sum, w.frame_now
    now[0], now[1], now[2] = here[FRAME_X], here[FRAME_Y], here[FRAME_THETA]
    now[3], now[4], now[5] = here[FRAME_VX], here[FRAME_VY], here[SPIN]
    from_ground(y, now, y)


def frame_at(series: NDArray[np.float64], order: int, sigma: float) -> NDArray[np.float64]:
    """Return displacement and rates of the frame at sigma, shape (6,), from its series."""
    lanes = np.asarray(np.polynomial.polynomial.polyval(sigma, series[: order + 1]))
    row: NDArray[np.float64] = lanes[[FRAME_X, FRAME_Y, FRAME_THETA, FRAME_VX, FRAME_VY, SPIN]]
    return row
