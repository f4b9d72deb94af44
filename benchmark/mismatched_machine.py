"""A machine with properties that a scene does not have, integrated by fixed Runge-Kutta steps.

The equations are independent of the solver. Walls may differ in stiffness and damping and have a recess, corners may be
rounded and have friction, pads may be displaced, and the frame may be on a spring. The centre of mass may be displaced,
gravity inclined and the motion damped. The rotation of the head is that of `rotation: paper`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y
from plow_twin.model.scene import Scene

Array = NDArray[np.float64]

#: Number of steps in the shortest period of a contact oscillation, and longest step [s].
_STEPS_A_PERIOD, _LONGEST_STEP = 60.0, 1e-4
#: Mass [kg] and damping ratio of a frame on a spring.
_FRAME_MASS, _FRAME_DAMPING = 500.0, 0.1
#: Speed [m/s] below which friction is viscous.
_CREEP = 0.005
#: Half width [m] of a recess, at which its depth falls to 1/e.
_HALF_RECESS = 0.01


@dataclass(frozen=True)
class Machine:
    """Properties of the machine that a scene does not have."""

    #: Stiffness of each pair, relative to the stiffness of the contact, shape (8,).
    stiffness_share: Array
    #: Outward displacement of the wall of each pair [m], shape (8,).
    depth: Array
    radius: float = 0.0
    friction: float = 0.0
    #: Stiffness of the spring under the frame along x and y [N/m]; 0 for a fixed frame.
    spring: float = 0.0
    #: Damping of each pair, relative to the damping of the contact, shape (8,).
    damping_share: Array = field(default_factory=lambda: np.ones(8))
    #: Depth [m] of a recess in the wall of each pair, in front of the pad at rest, shape (8,).
    recess: Array = field(default_factory=lambda: np.zeros(8))
    #: Centre of mass relative to the cavity's centre, in the axes of the head [m].
    off_centre: tuple[float, float] = (0.0, 0.0)
    #: Angle [rad] between gravity and -y.
    inclination: float = 0.0
    #: Viscous drag on the head [N s/m].
    drag: float = 0.0


def poses_of(scene: Scene, machine: Machine, t: Array, wrench: Array, pose_times: Array) -> Array:
    """Return the poses at `pose_times` [s], shape (k, 3), under a load (n, 3) at evenly spaced times `t` [s]."""
    contact = scene.contact
    stiff = contact.stiffness * max(1.0, 0.01 ** (contact.exponent - 1.0) * contact.exponent)
    lever = 1.0 / scene.head.mass_kg + 0.05 / scene.head.inertia_kg_m2
    fastest = max(math.sqrt(3.0 * stiff * lever), math.sqrt(machine.spring / _FRAME_MASS))
    step = min(_LONGEST_STEP, 2.0 * math.pi / fastest / _STEPS_A_PERIOD)
    half = 0.5 * scene.frame.width_m - machine.radius, 0.5 * scene.frame.height_m - machine.radius
    walls = (
        np.abs(NORMAL_X) * 0.5 * (scene.frame.width_m + scene.clearance.horizontal_m)
        + np.abs(NORMAL_Y) * 0.5 * (scene.frame.height_m + scene.clearance.vertical_m)
        + machine.depth
        - machine.radius
    )
    gravity = scene.gravity.acceleration_m_s2
    numbers = np.array([
        scene.head.mass_kg, scene.head.inertia_kg_m2, contact.exponent, machine.friction,
        gravity * math.sin(machine.inclination), gravity * math.cos(machine.inclination), scene.gravity.arm_m,
        machine.spring, _FRAME_MASS, 2.0 * _FRAME_DAMPING * math.sqrt(machine.spring * _FRAME_MASS),
        *machine.off_centre, machine.drag,
    ])  # fmt: skip
    corners = np.stack([half[0] * CORNER_X, half[1] * CORNER_Y])
    normals = np.stack([NORMAL_X, NORMAL_Y]).astype(np.float64)
    stiffness = contact.stiffness * machine.stiffness_share
    pads = np.stack([walls, stiffness, (contact.damping or 0.0) * machine.damping_share, machine.recess])
    out: Array = _run(numbers, corners, normals, pads, t, wrench, pose_times, step)
    return out


@numba.njit(cache=True)
def _run(numbers, corners, normals, pads, t, wrench, pose_times, step):  # type: ignore[no-untyped-def]
    out = np.zeros((len(pose_times), 3))
    state, now = np.zeros(10), t[0]
    state[0], state[1] = numbers[10], numbers[11]
    for row in range(len(pose_times)):
        steps = int(np.ceil((pose_times[row] - now) / step)) if pose_times[row] > now else 0
        h = (pose_times[row] - now) / steps if steps else 0.0
        for _ in range(steps):
            a = _rates(numbers, corners, normals, pads, t, wrench, now, state)
            b = _rates(numbers, corners, normals, pads, t, wrench, now + 0.5 * h, state + 0.5 * h * a)
            c = _rates(numbers, corners, normals, pads, t, wrench, now + 0.5 * h, state + 0.5 * h * b)
            d = _rates(numbers, corners, normals, pads, t, wrench, now + h, state + h * c)
            state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            now += h
        c, s = np.cos(state[2]), np.sin(state[2])
        out[row] = state[:3]
        out[row, 0] -= c * numbers[10] - s * numbers[11]
        out[row, 1] -= s * numbers[10] + c * numbers[11]
    return out


@numba.njit(cache=True)
def _rates(numbers, corners, normals, pads, t, wrench, now, state):  # type: ignore[no-untyped-def]
    mass, inertia, exponent, friction, along, gravity, arm, spring, frame_mass, frame_damping, ox, oy, drag = numbers
    walls, stiffness, damping, recess = pads
    place = min(max((now - t[0]) / (t[1] - t[0]), 0.0), len(t) - 1.000001)
    left = int(place)
    load = wrench[left] + (place - left) * (wrench[left + 1] - wrench[left])
    c, s = np.cos(state[2]), np.sin(state[2])
    fx, fy = load[0] - mass * along - drag * state[3], load[1] - mass * gravity - drag * state[4]
    moment = load[2] - mass * gravity * arm - (c * ox - s * oy) * load[1] + (s * ox + c * oy) * load[0]
    frame_x, frame_y = 0.0, 0.0
    for k in range(8):
        dx, dy = corners[0, k] + state[6] - state[0], corners[1, k] + state[7] - state[1]
        px, py = c * dx + s * dy, -s * dx + c * dy
        nx, ny = normals[0, k], normals[1, k]
        depth = nx * (px + ox) + ny * (py + oy) - walls[k]
        if recess[k] > 0.0:
            aside = nx * (py + oy - corners[1, k]) - ny * (px + ox - corners[0, k])
            depth -= recess[k] * np.exp(-((aside / _HALF_RECESS) ** 2))
        if depth <= 0.0:
            continue
        ux, uy = state[8] - state[3], state[9] - state[4]
        wx, wy = c * ux + s * uy + state[5] * py, -s * ux + c * uy - state[5] * px
        force = stiffness[k] * depth**exponent * (1.0 + damping[k] * (nx * wx + ny * wy))
        if force <= 0.0:
            continue
        rub = friction * force * np.tanh((nx * wy - ny * wx) / _CREEP)
        bx, by = force * nx - rub * ny, force * ny + rub * nx
        ax, ay = c * bx - s * by, s * bx + c * by
        fx, fy, moment = fx + ax, fy + ay, moment + px * by - py * bx
        frame_x, frame_y = frame_x - ax, frame_y - ay
    rates = np.zeros(10)
    rates[:3] = state[3:6]
    rates[3], rates[4], rates[5] = fx / mass, fy / mass, moment / inertia
    if spring > 0.0:
        rates[6:8] = state[8:10]
        rates[8] = (frame_x - spring * state[6] - frame_damping * state[8]) / frame_mass
        rates[9] = (frame_y - spring * state[7] - frame_damping * state[9]) / frame_mass
    return rates
