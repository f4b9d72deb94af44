"""Single impacts of an ellipse on a flat surface, computed by the contact model of this package."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.scene import Initial, Scene
from plow_twin.run.simulate import simulate
from plow_twin.scene_file import load_scene
from plow_twin.solve.point_impact import POINT, strike_points

Array = NDArray[np.float64]

#: Semi-axes of the ellipse [m], and its radius of gyration [m].
SEMI_AXES: Final = (0.035, 0.025)
GYRATION: Final = 0.0192
#: Contact stiffness per mass [1/s^2]. It determines the duration of an impact, but not its result.
_STIFFNESS: Final = 1e9
#: Speed of approach [m/s] at which the restitution has its nominal value: the middle of the measured speeds.
USUAL_SPEED: Final = 2.5
_LEAST, _LARGEST = 0.05, 0.98
#: Upper bound of velocities [m/s] and angular velocities [rad/s]. No measured body is as fast.
_FASTEST: Final = 1e4
#: Gap [m] at which a simulated impact starts, and time [s] after which it is certainly over (13 half periods of the
#: contact).
_GAP, _WHOLE = 1e-9, 40.0 / _STIFFNESS**0.5


@dataclass(frozen=True)
class EllipseContact:
    """The parameters of an impact of the ellipse."""

    #: Key of `model.contact_laws.LAWS`.
    law: str = "exact_restitution"
    exponent: float = 1.0
    #: Restitution of an impact at 2.5 m/s without motion along the surface. For a law without a restitution, the
    #: damping number lambda v0, or the damping C relative to the critical damping.
    restitution: float = 0.703
    #: Exponent q of the factor (v / 2.5 m/s)^-q, by which the restitution depends on the speed of approach v.
    fall: float = 0.2523
    #: Decrease of the restitution with the speed of the centre of mass along the surface [s/m].
    fall_along: float = 0.2786
    friction: float = 0.1907
    #: Regularisation speed of the friction [m/s]; 0 selects a tangential spring and damper instead.
    slip_speed: float = 0.0
    #: Ratio of tangential to normal stiffness.
    stick_stiffness: float = 1.584
    #: Tangential damping relative to the critical damping.
    stick_damping: float = 0.1597
    #: Angle [rad] of the surface relative to the axes of the data.
    tilt: float = -0.0131


#: Parameters fitted to the odd-numbered impacts.
ELLIPSE: Final = EllipseContact()


def contact_arms(theta: Array) -> tuple[Array, Array]:
    """Return the coordinates [m] of the lowest point relative to the centre, shape (n,) each.

    The first coordinate is along the surface, the second away from it. `theta` is the counter-clockwise angle [rad],
    shape (n,).
    """
    a, b = SEMI_AXES
    c, s = np.cos(theta), np.sin(theta)
    height = np.hypot(a * s, b * c)
    return -(a * a - b * b) * s * c / height, -height


def impact(before: ArrayLike, contact: EllipseContact = ELLIPSE) -> Array:
    """Return the states of the ellipse after impacts, given the states before.

    Parameters
    ----------
    before : array_like, shape (n, 6)
        x, y [m], theta [rad], vx, vy [m/s], omega [rad/s] in the axes of the data: y points away from the surface, and
        a positive theta turns y towards x.
    contact : EllipseContact
        Parameters of the contact. The default is the fitted contact `ELLIPSE`.

    Returns
    -------
    ndarray, shape (n, 6)
        x, y and theta as before the impact, and the velocities after the impact. A state whose lowest point does not
        approach the surface is returned unchanged.

    Raises
    ------
    ArgumentError
        The shape is wrong, a number is not finite, or the law is unknown.
    """
    states = _states(before)
    if contact.law not in LAWS:
        raise ArgumentError(f"contact.law: got {contact.law!r}, expected one of {', '.join(LAWS)}")
    for name in ("exponent", "restitution", "fall", "fall_along", "friction", "slip_speed", "stick_stiffness"):
        if not 0.0 <= getattr(contact, name) < np.inf:
            raise ArgumentError(f"contact.{name}: got {getattr(contact, name)!r}, expected a finite number >= 0")
    along, up = _to_surface(states[:, 3], states[:, 4], contact.tilt)
    normal_arm, tangential_arm = contact_arms(states[:, 2] - contact.tilt)
    slip, speed = along - states[:, 5] * tangential_arm, -(up + states[:, 5] * normal_arm)
    hits = speed > 0.0
    damping, point = _numbers(contact, speed[hits], along[hits], normal_arm[hits])
    impulse = np.zeros((len(states), 2))
    struck = np.zeros((int(hits.sum()), 2))
    strike_points(point, damping, normal_arm[hits], tangential_arm[hits], GYRATION**2, speed[hits], slip[hits], struck)
    impulse[hits] = struck
    vx, vy = _to_surface(impulse[:, 0], impulse[:, 1], contact.tilt)
    states[:, 3] += vx
    states[:, 4] += vy
    states[:, 5] += (normal_arm * impulse[:, 1] - tangential_arm * impulse[:, 0]) / GYRATION**2
    return states


def _states(before: ArrayLike) -> Array:
    try:
        states = np.array(before, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"before: {error}, expected finite numbers of shape (n, 6)") from None
    if states.ndim != 2 or states.shape[1] != 6:
        raise ArgumentError(f"before: got shape {states.shape}, expected finite numbers of shape (n, 6)")
    fit = np.isfinite(states).all(axis=1) & (np.abs(states[:, 3:]) < _FASTEST).all(axis=1)
    if not fit.all():
        row = int(np.flatnonzero(~fit)[0])
        raise ArgumentError(
            f"before[{row}]: got {states[row].tolist()}, expected finite numbers, rates below {_FASTEST:g}"
        )
    return states


def _to_surface(x: Array, y: Array, tilt: float) -> tuple[Array, Array]:
    """Resolve vectors in the axes of the data into components along and away from the surface.

    The map is its own inverse. It reverses the x axis of the data, so that a positive theta is counter-clockwise.
    """
    c, s = np.cos(tilt), np.sin(tilt)
    return s * y - c * x, s * x + c * y


@cache
def _preset() -> Scene:
    return load_scene("measured_ellipse")


def impact_scene(before: ArrayLike) -> Scene:
    """Return the preset `measured_ellipse` with the ellipse one nanometre above the surface, just before an impact.

    `before`, shape (6,), is one row of the argument of `impact`.
    """
    state = _states(np.asarray(before)[None])[0]
    along, up = (float(rate[0]) for rate in _to_surface(state[3:4], state[4:5], ELLIPSE.tilt))
    beside, below = (float(arm[0]) for arm in contact_arms(state[2:3] - ELLIPSE.tilt))
    scene = _preset()
    x, y = -0.5 * scene.frame.width_m - beside, 0.5 * (scene.frame.height_m + scene.clearance.vertical_m) - below
    omega = float(state[5])
    start = Initial((0.0, _GAP - 0.5 * scene.clearance.vertical_m, 0.0), (along + omega * y, up - omega * x, omega))
    return replace(scene, head=replace(scene.head, com_offset_m=(x, y)), initial=start)


def simulated_impact(before: ArrayLike) -> Array:
    """Return the states after impacts, as `impact` does, but from simulations of the preset `measured_ellipse`."""
    states = _states(before)
    for state in states:
        scene = impact_scene(state)
        motion = simulate(scene, t_end=_WHOLE, output_dt=_WHOLE)
        (vx, vy, omega), theta = motion.v[-1], motion.q[-1, 2]
        # the rotation during the impact moves the centre of mass, which is half a metre from the origin
        x, y = scene.head.com_offset_m
        c, s = np.cos(theta), np.sin(theta)
        state[3:5] = _to_surface(vx - omega * (s * x + c * y), vy + omega * (c * x - s * y), ELLIPSE.tilt)
        state[5] = omega
    return states


def _numbers(contact: EllipseContact, speed: Array, along: Array, normal_arm: Array) -> tuple[Array, NDArray[np.void]]:
    """Return the damping factors lambda [s/m], shape (n,), and all other parameters, which the impacts share."""
    law, restitution = LAWS[contact.law], contact.restitution
    e = np.clip(
        restitution * (speed / USUAL_SPEED) ** -contact.fall - contact.fall_along * np.abs(along), _LEAST, _LARGEST
    )
    viscous, damping = 0.0, np.zeros_like(speed)
    if law.additive:
        mobility = 1.0 + float(np.mean(normal_arm**2)) / GYRATION**2
        viscous = 2.0 * restitution * (_STIFFNESS / mobility) ** 0.5
    elif law.number_of is not None:
        grid = np.linspace(_LEAST, _LARGEST, 500)
        damping = np.interp(e, grid, [law.damping_number(restitution_value) for restitution_value in grid]) / speed
    else:
        damping[:] = restitution / USUAL_SPEED
    spring = contact.stick_stiffness * _STIFFNESS
    ramp = 0.1 * USUAL_SPEED / _STIFFNESS**0.5 if law.ramped else 0.0
    numbers = (
        _STIFFNESS, contact.exponent, viscous, ramp, contact.friction, contact.slip_speed, spring,
        2.0 * contact.stick_damping * spring**0.5,
    )  # fmt: skip
    return damping, np.array([numbers], POINT)
