"""Clearances around a block (a scene with `carries: corners`), estimated from the positions of its impacts.

The flights before and after an impact are extrapolated to the time at which they are nearest to each other. At this
time, the deepest corner touches a rigid wall or has penetrated a compliant wall. The position of an impact is a linear
function of the clearances, the bias and the lever arm of the sensor, and the compliance of the contact, which are
estimated together from all impacts. The errors of the positions have a Student-t distribution of unknown scale, so the
intervals follow from the scatter of the impacts.

Reference: Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989) 881 (Student-t errors by reweighting).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.priors import UNSTATED, deviation_of
from plow_twin.estimate.result import NORMAL_P95, Estimate, Interval, State
from plow_twin.estimate.similar import PAPER_LENGTH
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.unknowns import BIAS, GX, GY, QUANTITIES
from plow_twin.model import geometry
from plow_twin.model.scene import Gravity, Scene
from plow_twin.solve.compiled_scene import inertias

Array = NDArray[np.float64]

#: Definition of the walls: index of the axis that a wall bounds, and outward normal.
WALLS: Final = {
    "right": (GX, np.array([1.0, 0.0])),
    "left": (GX, np.array([-1.0, 0.0])),
    "top": (GY, np.array([0.0, 1.0])),
    "bottom": (GY, np.array([0.0, -1.0])),
}
#: Lower and upper bound on the number of rows for the fit of a flight, whose parabola has three coefficients.
_FLIGHT_ROWS: Final = (4, 9)
#: Degrees of freedom of the Student-t likelihood, derived from the recommendation of Lange et al.
_FREEDOM: Final = 4.0
#: Upper bounds on the number of scales of the likelihood, and on the reweighting iterations for each scale.
_SCALES, _ROUNDS = 40, 30
#: Definition of the unknowns: two clearances, three biases (x, y, theta), two coordinates of the lever arm, and the
#: change of the penetration relative to its value with the scene's stiffness.
_CLEARANCES, _BIAS, _LEVER, _DEPTH, _SIZE = slice(0, 2), slice(2, 5), slice(5, 7), 7, 8


@dataclass(frozen=True, eq=False)
class Impact:
    """One impact of a corner on a wall.

    Attributes
    ----------
    t : float
        Time in s.
    wall : str
        A name of `WALLS`.
    distance : float
        Distance of the wall from the middle of the guide in m, computed for a rigid wall.
    deeper : float
        Penetration in m that is part of `distance`, computed for a wall with the scene's stiffness.
    restitution : float
        Coefficient of restitution: normal speed of the corner after the impact divided by the speed before it.
    gained : float
        Kinetic energy after the impact, divided by the energy before the impact.
    turned : ndarray, shape (2,)
        The wall's normal in the block's axes.
    arm : float
        Lever arm of the normal force about the centre of mass in m.
    """

    t: float
    wall: str
    distance: float
    deeper: float
    restitution: float
    gained: float
    turned: Array
    arm: float


def estimate_block(scene: Scene, load: Load, poses: Poses, prior_estimate: Estimate) -> Estimate:
    """Return the estimate of the clearances around a block from the positions of its impacts.

    If only one of two opposite walls has impacts, the sensor's bias along their normal is assumed to be zero, and is
    None in the result. A clearance is not observable if its standard deviation exceeds half of its prior standard
    deviation, and rough if it exceeds 1 mm.

    Parameters
    ----------
    scene : Scene
        A scene with `carries: corners`.
    load : Load
        The measured load.
    poses : Poses
        The poses, measured in the axes of the guide.
    prior_estimate : Estimate
        The prior, in the form of an estimate.
    """
    whole = np.isfinite(poses.q).all(axis=1) & np.append(np.diff(poses.t) > 0.0, True)[: len(poses.t)]
    poses = Poses(poses.t[whole], poses.q[whole], poses.deviation)
    level = noise_level(poses.q)
    unseen = State.NOT_OBSERVABLE
    if len(poses.t) < 2 * _FLIGHT_ROWS[0] or not level.all():
        reason = (
            f"poses: got {len(poses.t)} complete poses with noise {level.tolist()}, expected at least "
            f"{2 * _FLIGHT_ROWS[0]} with some noise in each component"
        )
        return prior_estimate.having(prior_estimate.clearances, (unseen, unseen), reasons=(reason,))
    impacts_found, contacts = impacts(scene, load, poses, level)
    reason = _unfit(impacts_found, contacts)
    if reason:
        return prior_estimate.having(prior_estimate.clearances, (unseen, unseen), reasons=(reason,))
    met, reasons = _on_walls(
        scene, [impact for impact in impacts_found if impact.gained < tuning.GAINED], prior_estimate
    )
    value, deviation = _solve(scene, met, prior_estimate, level)
    clearances, states = [], []
    bias: list[Interval | None] = [Interval.normal(*pair) for pair in zip(value[_BIAS], deviation[_BIAS], strict=True)]
    for axis, (name, prior) in enumerate(zip(("horizontal", "vertical"), prior_estimate.clearances, strict=True)):
        count = {wall: sum(impact.wall == wall for impact in met) for wall in WALLS if WALLS[wall][0] == axis}
        share = float(deviation[axis]) / max(prior.deviation, 1e-300)
        observed = share < tuning.OBSERVED_SHARE
        clearances.append(Interval.normal(value[axis], deviation[axis]).above(0.0) if observed else prior)
        fine = float(deviation[axis]) <= tuning.OBSERVED
        states.append((State.ESTIMATED if fine else State.ROUGH) if observed else unseen)
        counts = ", ".join(f"{number} impacts on the {wall} wall" for wall, number in count.items())
        if not all(count.values()):
            bias[axis] = None
        if not observed:
            most = f"{tuning.OBSERVED_SHARE:.0%}"
            reasons.append(f"{name}: {counts} leave {share:.0%} of the prior's deviation, expected at most {most}")
        elif not all(count.values()):
            reasons.append(f"{name}: {counts}, so the poses are taken to be measured from the middle")
        if observed and not fine:
            got = f"a deviation of {1e3 * float(deviation[axis]):.3g} mm, expected at most {1e3 * tuning.OBSERVED:g} mm"
            reasons.append(f"{name}: rough, {counts} leave {got}")
    restitution = {"restitution": float(np.median([impact.restitution for impact in met]))} if met else {}
    return prior_estimate.having(
        clearances,
        states,
        **dict(zip(("bias_x", "bias_y", "bias_theta"), bias, strict=True)),
        noise=(float(level[0]), float(level[1]), float(level[2])),
        reasons=tuple(reasons),
        figures={"impacts": float(len(met)), **restitution},
    )


def _unfit(impacts: list[Impact], contacts: int) -> str:
    gained = sum(impact.gained >= tuning.GAINED for impact in impacts)
    if gained > tuning.IMPACT_SHARE * len(impacts):
        return f"{gained} of {len(impacts)} impacts add energy: the poses are too far apart in time"
    if len(impacts) < tuning.IMPACT_SHARE * contacts:
        return (
            f"{len(impacts)} of {contacts} contacts are impacts between two flights, expected at least "
            f"{tuning.IMPACT_SHARE:.0%}: the contact lasts longer than two poses, or the block hardly flies"
        )
    return ""


def _on_walls(scene: Scene, every: list[Impact], prior_estimate: Estimate) -> tuple[list[Impact], list[str]]:
    met: list[Impact] = []
    reasons = []
    for wall, (axis, _) in WALLS.items():
        clearance = prior_estimate.clearances[axis]
        expected = 0.5 * ((scene.frame.width_m, scene.frame.height_m)[axis] + clearance.mean)
        most = 0.5 * tuning.OUTLYING * clearance.deviation
        own = [impact for impact in every if impact.wall == wall]
        near = [impact for impact in own if abs(impact.distance - impact.deeper - expected) < most]
        if len(near) < len(own):
            far = max((one.distance for one in own), key=lambda distance: abs(distance - expected))
            reasons.append(
                f"{wall} wall: {len(own) - len(near)} impacts left out, got one at {far:.4g} m from the middle, "
                f"expected {expected:.4g} m within {most:.2g} m"
            )
        met += near
    return met, reasons


def _solve(scene: Scene, met: list[Impact], prior_estimate: Estimate, level: Array) -> tuple[Array, Array]:
    mean = np.zeros(_SIZE)
    mean[_CLEARANCES] = [clearance.mean for clearance in prior_estimate.clearances]
    prior = np.zeros(_SIZE)
    prior[_CLEARANCES] = [clearance.deviation for clearance in prior_estimate.clearances]
    prior[_BIAS] = np.array([quantity.deviation for quantity in QUANTITIES])[BIAS]
    # the prior was chosen for the size of the paper's machine
    prior[_LEVER] = UNSTATED["lever_x"] * geometry.half_diagonal(scene) / PAPER_LENGTH
    # normal distribution with the 95 % quantile of the penetration's log-normal prior
    spread = deviation_of(scene, "contact.stiffness") / (scene.contact.exponent + 1.0)
    prior[_DEPTH] = math.expm1(NORMAL_P95 * spread) / NORMAL_P95
    for axis in (GX, GY):
        if len({impact.wall for impact in met if WALLS[impact.wall][0] == axis}) < 2:
            prior[_BIAS][axis] = 0.0
    if not met:
        return mean, prior
    design, excess = np.zeros((len(met), _SIZE)), np.zeros(len(met))
    sides = np.array([scene.frame.width_m, scene.frame.height_m])
    for row, impact in enumerate(met):
        axis, normal = WALLS[impact.wall]
        excess[row] = impact.distance - impact.deeper - 0.5 * (sides[axis] + mean[axis])
        design[row, _DEPTH] = impact.deeper
        design[row, axis] = 0.5
        design[row, _BIAS] = *normal, impact.arm
        design[row, _LEVER] = impact.turned
    free = prior > 0.0
    # the error of an impact's position is at least the uncertainty of the frame's sides
    least = max(float(level[:2].max()), *(deviation_of(scene, f"frame.{side}") for side in ("width_m", "height_m")))
    scales = np.geomspace(least, max(float(prior[_CLEARANCES].max()), 2.0 * least), _SCALES)
    step, deviation = np.zeros(_SIZE), np.zeros(_SIZE)
    step[free], deviation[free] = _student(design[:, free], excess, prior[free], scales)
    return mean + step, deviation


def _student(design: Array, excess: Array, prior: Array, scales: Array) -> tuple[Array, Array]:
    """Return the means and the standard deviations of the unknowns x in the equation `excess` = `design` x + errors.

    The prior of x is normal with the standard deviations `prior`. The errors have a Student-t distribution with a
    log-uniform prior of their scale over `scales`. For each scale, reweighting gives the mode and the covariance of x,
    and Laplace's approximation gives the evidence, with which the results are averaged.
    """
    modes, variances, log = [], [], []
    precision = np.diag(prior**-2.0)
    for scale in scales:
        x = np.zeros(len(prior))
        for _ in range(_ROUNDS):
            weight = (_FREEDOM + 1.0) / (_FREEDOM * scale**2 + (excess - design @ x) ** 2)
            covariance = np.linalg.inv(design.T @ (weight[:, None] * design) + precision)
            x = covariance @ (design.T @ (weight * excess))
        residual = (excess - design @ x) / scale
        fits = -0.5 * (_FREEDOM + 1.0) * float(np.log1p(residual**2 / _FREEDOM).sum()) - len(excess) * math.log(scale)
        log.append(fits - 0.5 * ((x / prior) ** 2).sum() + 0.5 * float(np.linalg.slogdet(covariance)[1]))
        modes.append(x)
        variances.append(np.diag(covariance))
    share = np.exp(np.array(log) - max(log))
    share /= share.sum()
    mean = share @ np.array(modes)
    variance = share @ (np.array(variances) + (np.array(modes) - mean) ** 2)
    return mean, np.sqrt(variance)


def impacts(scene: Scene, load: Load, poses: Poses, level: Array) -> tuple[list[Impact], int]:
    """Return the impacts between two flights long enough for a fit, and the number of all contacts.

    Parameters
    ----------
    scene, load : Scene, Load
        The block, and the measured load.
    poses : Poses
        Poses in which all components are measured.
    level : ndarray, shape (3,)
        Standard deviation of the noise of a pose in m, m, rad.
    """
    t, q = poses.t, _of_mass(scene, poses.q)
    inertia = np.asarray(inertias(scene))
    free = _load_and_weight(scene, load, t) / inertia
    unknown = tuning.DRAG * Gravity().acceleration_m_s2 * np.array([1.0, 1.0, 1.0 / geometry.half_diagonal(scene)])
    ends = _kinks(t, q, free, level, unknown)
    hits = []
    for index, (first, last) in enumerate(ends):
        begin = ends[index - 1][1] if index else 0
        end = ends[index + 1][0] if index + 1 < len(ends) else len(t) - 1
        coming = np.arange(max(begin, first + 1 - _FLIGHT_ROWS[1]), first + 1)
        leaving = np.arange(last, min(end, last - 1 + _FLIGHT_ROWS[1]) + 1)
        if last - first > 1 or min(len(coming), len(leaving)) < _FLIGHT_ROWS[0]:
            continue
        middle = 0.5 * (t[first] + t[last])
        flights = [
            _flight(t[rows] - middle, q[rows], free[rows].mean(axis=0), level, unknown) for rows in (coming, leaving)
        ]
        room = 0.5 * (t[last] - t[first]) + tuning.BEYOND * float(np.median(np.diff(t)))
        met = _meeting(scene, inertia, flights, room)
        if met is not None:
            hits.append(replace(met, t=met.t + middle))
    return hits, len(ends)


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]


def _of_mass(scene: Scene, q: Array) -> Array:
    """Return the poses of the centre of mass, shape (n, 3)."""
    x, y = scene.head.com_offset_m
    c, s = np.cos(q[:, 2]), np.sin(q[:, 2])
    theta = np.unwrap(q[:, 2])
    return np.stack([q[:, 0] + c * x - s * y, q[:, 1] + s * x + c * y, theta], axis=1)


def _load_and_weight(scene: Scene, load: Load, t: Array) -> Array:
    """Return the sum of load and weight at the times `t`, shape (n, 3), in N, N, N m."""
    wrench = load.at(t)
    weight = scene.head.mass_kg * scene.gravity.acceleration_m_s2
    return wrench - weight * np.array([0.0, 1.0, scene.gravity.arm_m])


def _kinks(t: Array, q: Array, free: Array, level: Array, unknown: Array) -> list[tuple[int, int]]:
    """Return the first and the last row of each contact, where the acceleration is not that of a flight."""
    one, two = np.diff(t)[:-1, None], np.diff(t)[1:, None]
    way = np.diff(q, axis=0)
    acceleration = 2.0 * (way[1:] / two - way[:-1] / one) / (one + two)
    noise = 2.0 * level * np.sqrt(one**-2 + two**-2 + (1.0 / one + 1.0 / two) ** 2) / (one + two)
    bent: NDArray[np.bool_] = np.abs(acceleration - free[1:-1]) > tuning.OUTLYING * np.hypot(noise, unknown)
    return [(first + 1, last + 1) for first, last in _runs(np.asarray(bent.any(axis=1)))]


def _flight(t: Array, q: Array, free: Array, level: Array, unknown: Array) -> Array:
    """Return the coefficients of a flight's parabolas, shape (3, 3): rows for the pose, columns for powers of t."""
    basis = np.vander(t, 3, increasing=True)
    out = np.zeros((3, 3))
    for j in range(3):
        # the last row of the system is the prior of the acceleration
        rows = np.vstack([basis / level[j], [0.0, 0.0, 2.0 / unknown[j]]])
        out[j] = np.linalg.lstsq(rows, np.append(q[:, j] / level[j], free[j] / unknown[j]), rcond=None)[0]
    return out


def _meeting(scene: Scene, inertia: Array, flights: list[Array], room: float) -> Impact | None:
    """Return the impact between two flights; None if it hit no wall, or if the flights do not meet within `room` s."""
    apart = flights[1] - flights[0]
    change = apart[:, 1]
    t = -float((inertia * apart[:, 0] * change).sum() / (inertia * change * change).sum())
    if abs(t) > room:
        return None
    power, rate = np.array([1.0, t, t * t]), np.array([0.0, 1.0, 2.0 * t])
    q = 0.5 * (flights[0] + flights[1]) @ power
    v = np.stack([flight @ rate for flight in flights])
    impulse = (inertia * (v[1] - v[0]))[:2]
    wall, (_, normal) = max(WALLS.items(), key=lambda item: -float(item[1][1] @ impulse))
    c, s = math.cos(q[2]), math.sin(q[2])
    corners = np.array([[c, -s], [s, c]]) @ _corners(scene)
    deepest = int(np.argmax(normal @ corners))
    corner = corners[:, deepest]
    arm = float(corner[0] * normal[1] - corner[1] * normal[0])
    rates = v[:, :2] @ normal + arm * v[:, 2]
    approach, separation = float(rates[0]), -float(rates[1])
    if approach <= 0.0 or separation < 0.0:
        return None
    mass = 1.0 / (1.0 / inertia[0] + arm**2 / inertia[2])
    energy = (inertia * v**2).sum(axis=1)
    # `corner` is the centre of a rounded corner's arc
    distance = float(normal @ (q[:2] + corner)) + geometry.corner_radius(scene)
    turned = np.array([c * normal[0] + s * normal[1], -s * normal[0] + c * normal[1]])
    deeper = _deeper(scene, mass, approach, separation)
    return Impact(t, wall, distance, deeper, separation / approach, float(energy[1] / energy[0]), turned, arm)


def _corners(scene: Scene) -> Array:
    """Return the positions of the corners relative to the centre of mass, in the block's axes, in m, shape (2, 4)."""
    corners = np.stack(geometry.corner_positions(scene))[:, ::2]
    from_centre: Array = corners - np.array(scene.head.com_offset_m)[:, None]
    return from_centre


def _deeper(scene: Scene, mass: float, approach: float, separation: float) -> float:
    """Return the distance in m behind a compliant wall at which the flights before and after the contact meet.

    The corner approaches with the normal speed v and leaves with the speed e v after the time T. Straight flights meet
    at the distance v e T / (1 + e) behind the wall. T = pi u / v with the largest penetration u, which is exact for a
    linear spring.
    """
    exponent = scene.contact.exponent
    largest = ((exponent + 1.0) * mass * approach**2 / (2.0 * scene.contact.stiffness)) ** (1.0 / (exponent + 1.0))
    return float(math.pi * largest * separation / (approach + separation))
