"""Many separate impacts of bodies that touch a wall at one point, with constant positions and arms.

The normal force is that of `model.contact`. Friction is regularised (`model.friction`) or modelled by the spring of
`solve.grip`.
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.model.contact import normal_force
from plow_twin.model.friction import friction_force

#: Constants of the contact, divided by the mass: stiffness K, exponent n, viscous damping C, ramp [m], friction
#: coefficient mu, regularisation speed [m/s], and stiffness and damping of the tangential spring, which is used if the
#: regularisation speed is 0.
POINT = np.dtype(
    [
        (name, "f8")
        for name in (
            "stiffness", "exponent", "viscous", "ramp", "friction", "slip_speed", "stick_stiffness", "stick_damping",
        )
    ]
)  # fmt: skip
#: `_STEPS`: number of steps per duration of the undamped impact. `_LONGEST`: longest impact divided by this duration.
_STEPS, _LONGEST = 800, 20


@kernel()
def _strike(point, damping, normal_arm, tangential_arm, inertia, speed, slip, out) -> None:
    normal = 1.0 + normal_arm * normal_arm / inertia
    along = 1.0 + tangential_arm * tangential_arm / inertia
    coupling = -normal_arm * tangential_arm / inertia
    # the largest depth of the undamped impact gives its duration up to a factor near 1
    power = point.exponent + 1.0
    deepest = (power * speed * speed / (2.0 * point.stiffness * normal)) ** (1.0 / power)
    h = math.pi * deepest / (speed * _STEPS)
    depth, place, anchor, rate, rate_along = 0.0, 0.0, 0.0, speed, slip
    pushed = dragged = 0.0
    for _ in range(_LONGEST * _STEPS):
        force = normal_force(depth, rate, point.stiffness, point.exponent, damping, point.viscous, point.ramp)
        if point.slip_speed > 0.0:
            drag = friction_force(force, rate_along, point.friction, point.slip_speed)
        else:
            drag = point.stick_stiffness * (place - anchor) + point.stick_damping * rate_along
            limit = point.friction * force
            if abs(drag) > limit:
                drag = limit if drag > 0.0 else -limit
                anchor = place - (drag - point.stick_damping * rate_along) / point.stick_stiffness
        pushed += h * force
        dragged -= h * drag
        rate = speed - normal * pushed - coupling * dragged
        rate_along = slip + along * dragged + coupling * pushed
        depth += h * rate
        place += h * rate_along
        if depth <= 0.0:
            break
    out[0], out[1] = dragged, pushed


@kernel(entry=True)
def strike_points(point, damping, normal_arm, tangential_arm, inertia, speed, slip, impulse) -> None:
    """Write the impulses of each impact, divided by the mass, to `impulse`: along the wall and away from the wall.

    Parameters
    ----------
    point : ndarray of POINT, shape (1,)
    damping : ndarray, shape (m,)
        Damping factor lambda of each impact in s/m.
    normal_arm : ndarray, shape (m,)
        Position of the touching point along the wall in m, relative to the centre of mass.
    tangential_arm : ndarray, shape (m,)
        Position of the touching point away from the wall in m, relative to the centre of mass.
    inertia : float
        Square of the radius of gyration in m^2.
    speed : ndarray, shape (m,)
        Speed of the point towards the wall in m/s, above 0.
    slip : ndarray, shape (m,)
        Speed of the point along the wall in m/s.
    impulse : ndarray, shape (m, 2)
        Array that receives the impulses in m/s.
    """
    for i in range(speed.size):
        _strike(point[0], damping[i], normal_arm[i], tangential_arm[i], inertia, speed[i], slip[i], impulse[i])
