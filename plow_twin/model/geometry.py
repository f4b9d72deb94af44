"""Geometry of the guide: positions of the frame's corners in head axes, penetrations, and arms of the contact forces.

The state of the head consists of *body coordinates* of its centre of mass G:

    X, Y     position of G, VX, VY its velocity, both resolved in head axes,
    omega    angular velocity,  c, s = cos(theta), sin(theta),  theta.

In these coordinates every penetration and every arm is linear. Relative to the centre of the cavity, a frame corner C =
(Cx, Cy) is at p = R(theta)^T (C - (x, y)) (paper, eq. 1, inverted), that is

    p_x =  c Cx + s Cy - X + rx        p_y = -s Cx + c Cy - Y + ry

where (rx, ry) is the offset of G from the centre of the cavity in head axes. The penetration past a wall with outward
normal n at distance H is n . p - H.

A head that carries corners (`carries: corners`) is a block in a fixed cavity. Its state is resolved in world axes. Its
corner c = (cx, cy) is at

    p_x = X + c cx - s cy              p_y = Y + s cx + c cy

so the equations of both kinds of head have the same form, with different coefficients.

For a rounded corner, C is the centre of its arc, and the radius is subtracted from the distance of each wall. Friction
acts at the touching point, one radius away from C (`roll`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.model.pairs import CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene

#: Number of components of the state: X, Y, VX, VY, omega, c, s, theta.
STATE_SIZE = 8
#: Axis of each pair's wall normal, 0 for x and 1 for y, shape (8,).
_AXIS = np.abs(NORMAL_Y).astype(int)


def corner_positions(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return Cx and Cy of each pair's corner in m, in world axes, shape (8,) each."""
    radius = corner_radius(scene)
    return (0.5 * scene.frame.width_m - radius) * CORNER_X, (0.5 * scene.frame.height_m - radius) * CORNER_Y


def corner_radius(scene: Scene) -> float:
    """Return the radius of the frame's corners in m, or 0 for sharp corners."""
    return scene.frame.corner_radius_m or 0.0


#: Number of straight lines that approximate the arc of a rounded corner.
_ARC_SIDES = 6


def outline(sides: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Return a rectangle about the origin with rounded corners as a closed polygon, shape (n, 2).

    `sides`, shape (2,), contains width and height in the unit of `radius`.
    """
    angles = np.linspace(math.pi, 0.5 * math.pi, _ARC_SIDES + 1 if radius > 0.0 else 1)
    points = []
    for turn, corner in enumerate(((-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))):
        arc = angles - 0.5 * math.pi * turn
        centre = (0.5 * sides - radius) * corner
        points.append(centre + radius * np.stack([np.cos(arc), np.sin(arc)], axis=1))
    closed: NDArray[np.float64] = np.concatenate([*points, points[0][:1]])
    return closed


def roll(scene: Scene) -> float:
    """Return the slip of a rounded corner along its wall per rotation of the head about the arc's centre [m/rad]."""
    return corner_radius(scene) * (1.0 if scene.head.carries == "corners" else -1.0)


def wall_distances(scenes: Sequence[Scene]) -> NDArray[np.float64]:
    """Return the distance of each pair's unworn wall from the centre of the cavity in m, shape (m, 8)."""
    sides = [
        (scene.frame.width_m + scene.clearance.horizontal_m, scene.frame.height_m + scene.clearance.vertical_m)
        for scene in scenes
    ]
    return 0.5 * np.array(sides).take(_AXIS, axis=1)


def _along_normal(scene: Scene) -> NDArray[np.float64]:
    """Return the coefficients of n . p, shape (4, 8), for a head that carries walls: rows for c, s, X, Y."""
    corner_x, corner_y = corner_positions(scene)
    return np.array(
        [NORMAL_X * corner_x + NORMAL_Y * corner_y, NORMAL_X * corner_y - NORMAL_Y * corner_x, -NORMAL_X, -NORMAL_Y]
    )


def _along_tangent(scene: Scene) -> NDArray[np.float64]:
    """Return the coefficients of t . p, shape (4, 8), for a head that carries walls: rows for c, s, X, Y."""
    corner_x, corner_y = corner_positions(scene)
    return np.array(
        [NORMAL_X * corner_y - NORMAL_Y * corner_x, -NORMAL_Y * corner_y - NORMAL_X * corner_x, NORMAL_Y, -NORMAL_X]
    )


def penetration_rows(scene: Scene) -> NDArray[np.float64]:
    """Return the coefficients of each penetration n . p - H before wear, shape (5, 8): rows for c, s, X, Y and 1."""
    return np.vstack([position_rows(scene), penetrations_at_centre(scene, wall_distances([scene]))])


def position_rows(scene: Scene) -> NDArray[np.float64]:
    """Return the first four rows of `penetration_rows`, which depend only on the frame and on `Head.carries`."""
    return _of_places(scene, _along_normal(scene))


def penetrations_at_centre(scene: Scene, distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the last row of `penetration_rows`, the only row that depends on the clearance, shape (m, 8).

    `distances` are the `wall_distances` of scenes that have the head and the frame of `scene`.
    """
    offset_x, offset_y = scene.head.com_offset_m
    return NORMAL_X * offset_x + NORMAL_Y * offset_y - (distances - corner_radius(scene))


def _of_places(scene: Scene, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert coefficients of positions for a head that carries walls to those for the head of the scene.

    If the head carries corners, R replaces R^T and the position of the head has the opposite sign.
    """
    if scene.head.carries == "corners":
        rows[1:4] *= -1.0
    return rows


def _of_arms(scene: Scene, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert coefficients of arms for a head that carries walls to those for the head of the scene.

    If the head carries corners, the arms do not depend on the position of the head.
    """
    if scene.head.carries == "corners":
        rows[0] *= -1.0
        rows[2:] = 0.0
    return rows


def arm_rows(scene: Scene) -> NDArray[np.float64]:
    """Return the coefficients of the arm (p - r) x n of each normal force about G, shape (4, 8): rows c, s, X, Y."""
    return _of_arms(scene, -_along_tangent(scene))


def slip_rows(scene: Scene) -> NDArray[np.float64]:
    """Return the coefficients of each corner's position t . p along its wall, shape (4, 8): rows for c, s, X, Y.

    The tangent t is the wall's outward normal n, rotated by +90 degrees.
    """
    return _of_places(scene, _along_tangent(scene))


def slip_arm_rows(scene: Scene) -> NDArray[np.float64]:
    """Return the coefficients of the arm (p - r) x t of each friction force about G, shape (4, 8): rows c, s, X, Y."""
    return _of_arms(scene, _along_normal(scene))


def body_state(
    q: tuple[float, float, float] | NDArray[np.float64],
    v: tuple[float, float, float] | NDArray[np.float64],
    com_offset: tuple[float, float],
) -> NDArray[np.float64]:
    """Convert pose and rate of the cavity's centre, shape (3,) each, to body coordinates of G, shape (8,)."""
    x, y, theta = (float(value) for value in q)
    vx, vy, omega = (float(value) for value in v)
    c, s = math.cos(theta), math.sin(theta)
    rx, ry = com_offset
    return np.array(
        [
            c * x + s * y + rx,
            -s * x + c * y + ry,
            c * vx + s * vy - omega * ry,
            -s * vx + c * vy + omega * rx,
            omega,
            c,
            s,
            theta,
        ]
    )


def body_states(states: NDArray[np.float64], offset: tuple[float, float]) -> NDArray[np.float64]:
    """Convert poses and rates of the cavity's centre, shape (s, 6), to body coordinates of G, shape (s, 8)."""
    _, _, theta, vx, vy, omega = states.T
    c, s, x, y = _body_places(states[:, :3], offset)
    rx, ry = offset
    return np.stack(
        [x, y, c * vx + s * vy - omega * ry, -s * vx + c * vy + omega * rx, omega, c, s, theta],
        axis=1,
    )


def _body_places(q: NDArray[np.float64], offset: tuple[float, float]) -> tuple[NDArray[np.float64], ...]:
    """Return c, s, X and Y, shape (m,) each, at poses of the cavity's centre, shape (m, 3)."""
    x, y, theta = q.T
    c, s = np.cos(theta), np.sin(theta)
    rx, ry = offset
    return c, s, c * x + s * y + rx, -s * x + c * y + ry


def tumbles(scene: Scene) -> bool:
    """Return whether the head may turn beyond 45 degrees, which only a square block without wear may do."""
    alike = scene.frame.width_m == scene.frame.height_m and scene.wear is None
    return scene.head.carries == "corners" and alike


def state_of(
    scene: Scene,
    q: tuple[float, float, float] | NDArray[np.float64],
    v: tuple[float, float, float] | NDArray[np.float64],
) -> NDArray[np.float64]:
    """Convert pose and rate of the centre of the cavity or block, shape (3,) each, to the solver's state, shape (8,).

    A head that carries walls has body coordinates, and a head that carries corners has world axes. If a block tumbles,
    c and s belong to the angle modulo quarter turns.
    """
    if scene.head.carries == "walls":
        return body_state(q, v, scene.head.com_offset_m)
    x, y, theta = (float(value) for value in q)
    vx, vy, omega = (float(value) for value in v)
    quarter = 0.5 * math.pi
    angle = theta - quarter * round(theta / quarter) if tumbles(scene) else theta
    return np.array([x, y, vx, vy, omega, math.cos(angle), math.sin(angle), theta])


def states_of(scene: Scene, states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert poses and rates, shape (s, 6), to the solver's states, shape (s, 8), as `state_of` does."""
    if scene.head.carries == "walls":
        return body_states(states, scene.head.com_offset_m)
    return np.array([state_of(scene, row[:3], row[3:]) for row in states]).reshape(-1, STATE_SIZE)


def factors_of(scene: Scene, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors c, s, X, Y and 1 of `penetration_rows` at the poses `q`, shape (m, 3); shape (m, 5)."""
    factors = np.ones((len(q), 5))
    if scene.head.carries == "walls":
        factors[:, 0], factors[:, 1], factors[:, 2], factors[:, 3] = _body_places(q, scene.head.com_offset_m)
    else:
        state = states_of(scene, np.concatenate([q, np.zeros_like(q)], axis=1))
        factors[:, :2], factors[:, 2:4] = state[:, 5:7], state[:, :2]
    return factors


def angle_of(z: ArrayLike, w: ArrayLike) -> NDArray[np.float64]:
    """Return the angle in [-pi, pi] rad of a rotation about the z axis, from the elements z and w of its quaternion.

    A quaternion and its negative describe the same rotation.
    """
    turned = np.signbit(w)
    return np.asarray(2.0 * np.arctan2(np.where(turned, np.negative(z), z), np.abs(w)))


def largest_angle(scene: Scene) -> float:
    """Return the largest angle in rad, up to 45 degrees, to which the frame can turn in an unworn cavity."""
    radius = corner_radius(scene)
    sides = np.array([[scene.frame.width_m], [scene.frame.height_m]])
    angles = np.linspace(0.0, 0.25 * math.pi, 4096)
    core = sides - 2.0 * radius
    extents = core * np.cos(angles) + core[::-1] * np.sin(angles) + 2.0 * radius
    cavity = sides + np.array([[scene.clearance.horizontal_m], [scene.clearance.vertical_m]])
    inside = np.append((extents <= cavity).all(axis=0), False)
    return float(angles[max(0, int(np.argmin(inside)) - 1)])


def length_scale(scene: Scene) -> float:
    """Return the reference length in m for tolerances: the smallest clearance above 1e-4 of the frame's diagonal.

    Without such a clearance, the reference length is 1e-4 of the diagonal.
    """
    floor = 1e-4 * math.hypot(scene.frame.width_m, scene.frame.height_m)
    return min((c for c in (scene.clearance.horizontal_m, scene.clearance.vertical_m) if c > floor), default=floor)


def half_diagonal(scene: Scene) -> float:
    """Return half the diagonal of the frame in m, which converts angles to lengths."""
    return 0.5 * math.hypot(scene.frame.width_m, scene.frame.height_m)
