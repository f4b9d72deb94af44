"""Conversion of a scene to the records that the kernels read."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from numbers import Real
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError
from plow_twin.model import geometry
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.loads import LoadSet, Pieces, compile_loads
from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Contact, Head, Scene, Table, Wear
from plow_twin.solve.method.implicit import OVERDAMPED_RATIO, new_implicit
from plow_twin.solve.modes import settle_modes
from plow_twin.solve.state import (
    COS,
    HARMONIC,
    MAX_ORDER,
    PARAMS,
    RESTITUTIONS,
    SEGMENT,
    SIN,
    Array,
    Harmonics,
    Implicit,
    Options,
    Params,
    Parts,
    Segments,
    State,
    Terms,
    X,
    Y,
    new_record,
    new_records,
    params_type,
    state_type,
)

#: Tightest and loosest admissible tolerance.
TOLERANCE_RANGE = (1e-13, 1e-1)
#: Admissible error of one step divided by the tolerance. The errors of hundreds of steps add up, and impacts amplify
#: them.
STEP_SHARE = 3e-4
#: Largest admissible error of a step at loose tolerances, relative to the length scale.
LARGEST_STEP_ERROR = 1e-6
#: `STEP_SHARE` for exponents that are not integers, whose series converge slowly near a branch point.
STEP_SHARE_FRACTION = 1e-6
#: Number of mode changes at one instant after which the solver takes a step without event detection.
MAX_EVENTS_AT_ONCE = 64
#: Largest harmonic load at which the head can rest, divided by the load that presses it against its walls
#: (`method.small_harmonics`).
_SMALL_HARMONICS = 1e-2
#: Penetration below which rounding dominates, divided by half the frame's diagonal (some 45 rounding errors).
_NOISE = 1e-14

_Found = TypeVar("_Found")

_NO_TERMS = Terms(*[None] * len(Terms._fields))


@dataclass(frozen=True)
class CompiledScene:
    """Records of a scene at one tolerance, for the kernels."""

    scene: Scene
    params: Params
    parts: Parts
    loads: LoadSet

    def initial_state(self, time: float = 0.0, wear_depth: Array | None = None) -> State:
        """Return the scene's initial state at `time`, with its own wear depth or `wear_depth` [m]."""
        state = new_record(state_type(self.parts.terms))
        self.start(state)
        if wear_depth is not None:
            state.wear_depth[:] = wear_depth
        state.step_start = state.time = time
        settle_modes(self.params, state, self.parts.terms.stick)
        return state

    def start(self, state: State | np.void) -> None:
        """Write coordinates, rates, damping and wear, but not modes, of the initial state to a zero record."""
        state["y"][:] = geometry.state_of(self.scene, self.scene.initial.q, self.scene.initial.v)
        if self.parts.terms.hysteretic is not None:
            state["damping_factor"][:] = self.scene.contact.damping or 0.0
        if self.scene.wear is not None:
            state["wear_depth"][:] = self.scene.wear.initial_depth_m


def compile_scene(scene: Scene, tol: float, *, sampled: bool = False) -> CompiledScene:
    """Return the records of a scene for the kernels.

    Parameters
    ----------
    scene : Scene
    tol : float
        Tolerance of the pose relative to `geometry.length_scale`, 1e-13 .. 1e-1.
    sampled : bool
        Whether the load is given as samples. If True, the loads of the scene are omitted.

    Raises
    ------
    ArgumentError
        The tolerance is out of range.
    """
    _check_tolerance(tol)
    # `_LATELY` would keep a table in memory after the end of its scene
    tables = any(isinstance(load, Table) for load in scene.loads)
    return _describe(scene, tol, sampled, _Shared() if tables else _LATELY).compiled()


def compile_scenes(scenes: Sequence[Scene], tol: float) -> tuple[NDArray[np.void], list[CompiledScene]]:
    """Return the records of many scenes at one tolerance. A part that scenes share is converted only once.

    Returns
    -------
    params : ndarray of `PARAMS`, shape (m,)
        Constants of all scenes in one array. The rows of scenes with `Options` are zero.
    compiled : list of CompiledScene
        The compiled scenes. Their constants are rows of `params`, or separate records for scenes with `Options`.

    Raises
    ------
    ArgumentError
        The tolerance is out of range.
    """
    _check_tolerance(tol)
    shared, params = _Shared(), new_records(PARAMS, len(scenes))
    descriptions = [_describe(scene, tol, False, shared) for scene in scenes]
    shares = [not any(options(scene)) for scene in scenes]
    for name in PARAMS.names or ():
        there = [index for index, one in enumerate(descriptions) if shares[index] and name in one.values]
        values = [descriptions[index].values[name] for index in there]
        if values:
            params[name][there] = values[0] if all(value is values[0] for value in values) else values
    rows = params.view(np.recarray)
    return params, [one.compiled(rows[i] if shares[i] else None) for i, one in enumerate(descriptions)]


def _is_number(value: object) -> bool:
    return isinstance(value, Real)


def _check_tolerance(tol: float) -> None:
    low, high = TOLERANCE_RANGE
    if not (_is_number(tol) and low <= tol <= high):
        raise ArgumentError(f"tol: got {tol!r}, expected a number from {low:g} to {high:g}")


class _Shared:
    """Cache of the `most` newest results, by the identity of the objects on which they depend."""

    def __init__(self, most: float = math.inf) -> None:
        self._most = most
        self._known: OrderedDict[tuple[Any, ...], tuple[Any, Any]] = OrderedDict()

    def of(self, compute: Callable[..., _Found], *sources: object, given: tuple[Any, ...] | None = None) -> _Found:
        """Return compute(*sources), or compute(*given). The sources must determine `given`."""
        key = (compute, *map(id, sources))
        known = self._known.get(key)
        if known is None:
            # the id of a deleted source could belong to a new object, so the sources are stored
            known = self._known[key] = sources, compute(*(sources if given is None else given))
            if len(self._known) > self._most:
                self._known.popitem(last=False)
        found: _Found = known[1]
        return found


#: Results for parts of the newest scenes. A study usually varies only some parts of a scene.
_LATELY: Final = _Shared(64)


@dataclass(frozen=True)
class _Description:
    """Content of a `CompiledScene`, with the fields `values` of its `PARAMS` record."""

    scene: Scene
    values: dict[str, Any]
    parts: Parts
    loads: LoadSet

    def compiled(self, params: Params | None = None) -> CompiledScene:
        """Return the compiled scene with its constants in `params` or in a new record."""
        if params is None:
            params = new_record(params_type(options(self.scene)))
            for name, value in self.values.items():
                params[name] = value
        return CompiledScene(self.scene, params, self.parts, self.loads)


class _Unchanged(NamedTuple):
    """Results that do not depend on the clearance. `values` are fields of `PARAMS`."""

    loads: LoadSet
    acceleration: float  #: largest acceleration in m/s^2
    start_speed: float  #: upper bound of the head's speed at the start in m/s
    harmonics: Harmonics | None
    terms: Terms
    values: dict[str, Any]


def _unchanged(scene: Scene, sampled: bool, shared: _Shared) -> _Unchanged:
    loads = shared.of(compile_loads, () if sampled else scene.loads)
    mass, inertia = scene.head.mass_kg, scene.head.inertia_kg_m2
    gravity = scene.gravity.acceleration_m_s2
    constant = per_mass(scene, loads.constant)
    constant[1] -= gravity
    constant[2] -= mass * gravity * scene.gravity.arm_m / inertia
    direction, harmonics = shared.of(_harmonics, scene.head, loads)
    terms, number = shared.of(law_terms, scene.contact)
    rows = geometry.penetration_rows(scene)
    values: dict[str, Any] = dict(
        penetration_rows=rows,
        arm_rows=geometry.arm_rows(scene),
        enabled=[name in scene.pairs for name in PAIR_NAMES],
        inverse_mass=1.0 / mass,
        inverse_inertia=1.0 / inertia,
        stiffness=float(scene.contact.stiffness),
        exponent=float(scene.contact.exponent),
        viscous=float(scene.contact.damping or 0.0) if terms.viscous else 0.0,
        damping_number=number,
        speed_floor=float(scene.contact.impact_speed_floor_m_s),
        ramp=float(scene.contact.ramp_m or 0.0) if terms.ramp else 0.0,
        gravity=float(gravity),
        constant=constant,
        direction=direction,
        lacuna=_lacuna(scene.contact.exponent),
        radius=geometry.half_diagonal(scene),
        wear_per_impulse=_wear_rates(scene.wear),
        offset=scene.head.com_offset_m,
        free=scene.free,
        fastest=float(loads.omega.max(initial=0.0)),
        leverage=float(np.hypot(rows[0], rows[1]).max()),
        max_events=MAX_EVENTS_AT_ONCE,
    )
    terms = _scene_terms(scene, terms, loads, harmonics, sampled or loads.pieces is not None, shared)
    acceleration = _largest_acceleration(scene, shared.of(_largest_wrench, loads))
    return _Unchanged(loads, acceleration, _start_speed(scene), harmonics, terms, values)


def _describe(scene: Scene, tol: float, sampled: bool, shared: _Shared) -> _Description:
    loads, acceleration, start_speed, harmonics, terms, unchanged = shared.of(
        _unchanged, scene.head, scene.frame, scene.contact, scene.gravity, scene.loads, scene.initial, scene.locked,
        scene.pairs, scene.wear, scene.friction, scene.support, sampled,
        # only a head that starts off centre may touch a wall at the start
        scene.clearance if any(scene.initial.q) else None,
        given=(scene, sampled, shared),
    )  # fmt: skip
    length, radius = geometry.length_scale(scene), unchanged["radius"]
    # speed after half the length scale under the largest load
    speed = max(math.sqrt(length * acceleration), start_speed, 1e-3 * length)
    admissible = min(tol * (STEP_SHARE if terms.fraction is None else STEP_SHARE_FRACTION), LARGEST_STEP_ERROR)
    order = order_for(admissible)
    rows = unchanged["penetration_rows"].copy()
    rows[4] = geometry.penetrations_at_centre(scene)
    values: dict[str, Any] = unchanged | dict(
        penetration_rows=rows,
        order=order,
        threshold=speed * _thresholds(admissible, order),
        velocity_tolerance=tol * speed,
        position_tolerance=tol * length,
        weight=radius * speed / length,
        release=0.0 if terms.fraction is None else _release(scene, tol, length, speed),
        half_cavity=0.5 * float(geometry.wall_distances(scene).min()),
    )
    values |= _of_options(scene)
    values |= _rubbing(scene) | _slip(scene) | _frame(scene)
    segments = _segments(scene, loads.pieces) if loads.pieces is not None else None
    if sampled:
        segments = np.zeros(1, SEGMENT)
    return _Description(scene, values, Parts(terms, harmonics, segments, _implicit(scene, terms, values)), loads)


def options(scene: Scene) -> Options:
    """Return the options of a scene, each of which adds fields to its `PARAMS` record."""
    falls = scene.contact.restitution_fall is not None or scene.contact.restitution_fall_along_s_m is not None
    return Options(scene.head.carries == "corners", scene.frame.corner_radius_m is not None, falls)


def _of_options(scene: Scene) -> dict[str, Any]:
    there, contact, found = options(scene), scene.contact, dict[str, Any]()
    if there.corners:
        found["tumbles"] = float(geometry.tumbles(scene))
    if there.rounded:
        found["roll"] = geometry.roll(scene)
    if there.falling:
        found |= dict(
            damping_numbers=damping_numbers(contact.law),
            restitution=contact.restitution,
            fall=contact.restitution_fall or 0.0,
            fall_speed=contact.restitution_speed_m_s or 1.0,
            fall_mass=contact.restitution_mass_power or 0.0,
            fall_along=contact.restitution_fall_along_s_m or 0.0,
        )
    return found


@cache
def damping_numbers(law: str) -> Array:
    """Return e D(e) for restitutions e on a uniform grid from 0 to 1, shape (RESTITUTIONS + 1,)."""
    grid = np.arange(RESTITUTIONS + 1) / RESTITUTIONS
    return grid * [LAWS[law].damping_number(float(e)) for e in grid]


def _scene_terms(
    scene: Scene, law: Terms, loads: LoadSet, harmonics: Harmonics | None, segments: bool, shared: _Shared
) -> Terms:
    present = dict(
        harmonics=harmonics is not None,
        second=harmonics is not None and shared.of(_has_second, harmonics),
        segments=segments,
        **_wear_terms(scene.wear),
        offset=any(scene.head.com_offset_m),
        free=bool(scene.locked),
    )
    if scene.friction is not None and scene.friction.coefficient != 0.0:
        present["slip" if scene.friction.stick_stiffness_n_m is None else "stick"] = True
    present["support"] = scene.support is not None
    # with an offset centre of mass, the moment of the loads depends on the angle
    present["flight"] = present["harmonics"] and not present["offset"] and not present["support"]
    # the closed form of flight is not valid for a block that tumbles by more than a quarter turn
    present["flight"] &= scene.head.carries == "walls"
    creeps = present["wear"] or bool({"slip", "stick"} & present.keys())
    present["rest"] = not (creeps or present["support"])
    if present["harmonics"]:
        # without damping, even a small harmonic load can build up a motion
        damped = law.viscous is not None or law.hysteretic is not None
        present["rest"] &= damped and present["flight"] and _harmonics_are_small(scene, loads, shared.of(_swing, loads))
    return law._replace(**_flags(present))


def _wear_rates(wear: Wear | None) -> list[float]:
    return [0.0 if wear is None else wear_rate(wear, wear.travel_speed_m_s)] * PAIR_COUNT


def _wear_terms(wear: Wear | None) -> dict[str, bool]:
    if wear is None or wear.coefficient_m2_n == 0.0:
        return {"wear": False}
    return {"wear": True, "sliding": wear.sliding == "total", "running_in": wear.running_in_ratio > 1.0}


def _harmonics_are_small(scene: Scene, loads: LoadSet, swing: Array) -> bool:
    """Return whether the harmonic loads are small compared with the steady loads and the preload at the walls."""
    mass, contact = scene.head.mass_kg, scene.contact
    arms = np.array([1.0, 1.0, 1.0 / geometry.half_diagonal(scene)])
    pressing = np.abs(loads.constant) @ arms + mass * abs(scene.gravity.acceleration_m_s2)
    if loads.pieces is not None:
        pressing += float(np.abs(loads.pieces.start).max(axis=0) @ arms)
    pressing += contact.stiffness * _initial_depth(scene) ** contact.exponent
    return bool(swing @ arms <= _SMALL_HARMONICS * pressing)


def _initial_depth(scene: Scene) -> float:
    """Return the largest penetration of a pair in the initial state in m, or 0 without contact."""
    if not any(scene.initial.q):
        return 0.0  # a centred head does not touch a wall
    y = geometry.state_of(scene, scene.initial.q, scene.initial.v)
    rows = geometry.penetration_rows(scene)
    return max(float((np.array([y[COS], y[SIN], y[X], y[Y], 1.0]) @ rows).max()), 0.0)


@lru_cache(64)
def _thresholds(admissible: float, order: int) -> Array:
    """Return the admissible size of each term of a series, divided by the admissible size of the first term."""
    sizes: Array = admissible ** (np.arange(MAX_ORDER + 1) / order)
    return sizes


def order_for(admissible: float) -> int:
    """Return the order of the series for an admissible error of a step, fitted to the fastest orders in benchmarks."""
    return int(min(MAX_ORDER, max(8, round(6.0 - math.log10(admissible)))))


def _lacuna(exponent: float) -> int:
    """Return how many successive terms of a series can be zero. A force d^n has a term in every (n + 1)th order."""
    if not float(exponent).is_integer():
        return 6
    return 2 if exponent == 1.0 else int(exponent) + 1


def per_mass(scene: Scene, wrench: Array) -> Array:
    """Return wrenches, shape (..., 3), divided by mass and inertia."""
    share: Array = np.asarray(wrench) / inertias(scene)
    return share


def inertias(scene: Scene) -> Array:
    """Return mass, mass and inertia of the head in kg, kg and kg m^2, shape (3,)."""
    return np.array([scene.head.mass_kg, scene.head.mass_kg, scene.head.inertia_kg_m2])


def _segments(scene: Scene, pieces: Pieces) -> Segments:
    segments = np.zeros(len(pieces.knots), SEGMENT)
    segments["knot"] = pieces.knots
    segments["start"], segments["slope"] = per_mass(scene, pieces.start), per_mass(scene, pieces.slope)
    return segments


def law_terms(contact: Contact) -> tuple[Terms, float]:
    """Return the terms of the contact law, and D for a damping factor D / v0 or -1 for a constant factor."""
    law, exponent = LAWS[contact.law], float(contact.exponent)
    viscous = law.additive and bool(contact.damping)
    number = -1.0 if contact.restitution is None else law.damping_number(contact.restitution)
    damped = not law.additive and (number > 0.0 or bool(contact.damping))
    present = dict(
        viscous=viscous,
        hysteretic=damped,
        integer=exponent != 1.0 and exponent.is_integer(),
        fraction=not exponent.is_integer(),
        ramp=viscous and contact.ramp_m is not None,
    )
    return _NO_TERMS._replace(**_flags(present)), number if damped else -1.0


def _flags(present: dict[str, bool]) -> dict[str, int]:
    return {name: 1 for name, there in present.items() if there}


def _harmonics(head: Head, loads: LoadSet) -> tuple[Array, Harmonics | None]:
    """Return the directions of the harmonic forces S1 and S2, and the harmonic loads.

    If all forces are parallel, S1 has their direction and S2 is zero. Otherwise S1 is along x and S2 along y.
    """
    if loads.omega.size == 0:
        return np.eye(2), None
    # sine and cosine amplitudes of the accelerations Fx/m, Fy/m, M/I, shape (h, 2, 3)
    inertias = np.array([head.mass_kg, head.mass_kg, head.inertia_kg_m2])
    amplitudes = np.stack([loads.sine / inertias, loads.cosine / inertias], axis=1)
    acting = amplitudes.any(axis=(1, 2))
    if not acting.any():
        return np.eye(2), None
    amplitudes = amplitudes[acting]
    forces = amplitudes[:, :, :2].reshape(-1, 2)
    largest = forces[np.argmax(np.hypot(forces[:, 0], forces[:, 1]))]
    size = float(np.hypot(*largest))
    unit = largest / size if size > 0.0 else np.array([1.0, 0.0])
    across = np.abs(forces @ np.array([-unit[1], unit[0]]))
    directions = np.array([unit, [0.0, 0.0]]) if across.max() <= 1e-15 * size else np.eye(2)
    harmonics = np.zeros(len(amplitudes), HARMONIC)
    harmonics["omega"], harmonics["moment"] = loads.omega[acting], amplitudes[:, :, 2]
    for i, name in enumerate(("first", "second")):
        harmonics[name] = amplitudes[:, :, :2] @ directions[i]
    return directions, harmonics


def _largest_wrench(loads: LoadSet) -> Array:
    """Return an upper bound of |Fx|, |Fy| [N] and |M| [N m], shape (3,)."""
    wrench: Array = np.abs(loads.constant) + np.abs(loads.sine).sum(axis=0) + np.abs(loads.cosine).sum(axis=0)
    if loads.pieces is not None:
        wrench = wrench + np.abs(loads.pieces.start).max(axis=0)
    return wrench


def _swing(loads: LoadSet) -> Array:
    """Return the sum of the amplitudes of the harmonic loads, shape (3,)."""
    swing: Array = np.hypot(loads.sine, loads.cosine).sum(axis=0)
    return swing


def _has_second(harmonics: Harmonics) -> bool:
    return bool(harmonics["second"].any())


def _start_speed(scene: Scene) -> float:
    """Return an upper bound of the head's initial speed in m/s."""
    return float(np.hypot(*scene.initial.v[:2])) + geometry.half_diagonal(scene) * abs(scene.initial.v[2])


def _largest_acceleration(scene: Scene, wrench: Array) -> float:
    """Return an upper bound of the acceleration in m/s^2 under gravity and under loads of at most `wrench`."""
    acceleration = per_mass(scene, wrench)
    across = abs(scene.gravity.acceleration_m_s2) + float(np.hypot(acceleration[0], acceleration[1]))
    return across + geometry.half_diagonal(scene) * float(acceleration[2])


def _release(scene: Scene, tol: float, length: float, speed: float) -> float:
    """Return the penetration in m below which the impulse until separation is negligible.

    From the penetration d, a pair that separates at the speed v receives the impulse K d^(n+1) / ((n+1) v). It must be
    small compared with the velocity tolerance even after many separations that are a hundred times slower.
    """
    exponent = scene.contact.exponent
    share = 1e-5 if exponent == 1.5 or float(exponent).is_integer() else 1e-8
    impulse = share * tol * speed * scene.head.mass_kg
    release = float((impulse * (exponent + 1.0) * speed / scene.contact.stiffness) ** (1.0 / (exponent + 1.0)))
    if not float(exponent).is_integer():
        # the series of d^n would have non-finite terms at a smaller depth
        release = max(release, _NOISE * geometry.half_diagonal(scene))
    friction = scene.friction
    if friction is not None and friction.stick_stiffness_n_m is not None and friction.coefficient > 0.0:
        # the spring force of a sticking corner jumps to zero when its pair becomes RELEASED
        stretch = max(1e-3 * tol * length, 1e-15 * geometry.half_diagonal(scene))
        held = stretch * friction.stick_stiffness_n_m / friction.coefficient
        # the series would have non-finite terms if a corner crossed the depth in less than 1e-11 s
        depth = max(float((held / scene.contact.stiffness) ** (1.0 / exponent)), 1e-11 * speed)
        release = min(release, depth)
    return release


def _implicit(scene: Scene, terms: Terms, values: dict[str, Any]) -> Implicit | None:
    """Return nodes and scratch space of implicit steps, or None without overdamped motion."""
    contact = scene.contact
    mobility = 1.0 / scene.head.mass_kg + values["radius"] ** 2 / scene.head.inertia_kg_m2
    if scene.support is not None:
        mobility += float(values["frame_mobility"][0] + values["radius"] ** 2 * values["frame_mobility"][2])
    largest_force = scene.head.mass_kg * values["threshold"][0] ** 2 / geometry.length_scale(scene)
    depth = max((largest_force / contact.stiffness) ** (1.0 / contact.exponent), _initial_depth(scene))
    largest_force = contact.stiffness * depth**contact.exponent
    spring = contact.exponent * largest_force / depth
    damping = values.get("stick_damping", 0.0)
    if terms.viscous is not None:
        damping += values["viscous"]
    elif terms.hysteretic is not None:
        damping += largest_force * (contact.damping or values["damping_number"] / values["speed_floor"])
    if terms.slip is not None:
        damping += values["friction"] * largest_force / values["slip_speed"]
    overdamped = damping * mobility > OVERDAMPED_RATIO * math.sqrt(spring * mobility)
    # the dampers of a support can make the motion overdamped
    if scene.support is not None:
        overdamped |= bool((values["frame_damping"] > OVERDAMPED_RATIO * np.sqrt(values["frame_stiffness"])).any())
    return new_implicit(scene.support is not None) if overdamped else None


def _rubbing(scene: Scene) -> dict[str, Any]:
    wear, there, found = scene.wear, _wear_terms(scene.wear), dict[str, Any]()
    if wear is not None and there.get("sliding"):
        found["slip_rows"] = geometry.slip_rows(scene)
        found["speed_per_wear"] = wear.pad_area_m2 / wear.coefficient_m2_n
    if wear is not None and there.get("running_in") and wear.running_in_depth_m is not None:
        found |= {"running_in": wear.running_in_ratio - 1.0, "running_in_rate": 1.0 / wear.running_in_depth_m}
    return found


def _slip(scene: Scene) -> dict[str, Any]:
    """Return the constants of friction; without friction, only a slip speed as a divisor."""
    friction = scene.friction
    if friction is None:
        return {"slip_speed": 1.0}
    return dict(
        slip_rows=geometry.slip_rows(scene),
        slip_arm_rows=geometry.slip_arm_rows(scene),
        friction=friction.coefficient,
        slip_speed=friction.regularisation_speed_m_s,
        static_friction=friction.coefficient if friction.static_coefficient is None else friction.static_coefficient,
        stick_stiffness=friction.stick_stiffness_n_m or 0.0,
        stick_damping=friction.stick_damping_n_s_m or 0.0,
    )


def _frame(scene: Scene) -> dict[str, Any]:
    support = scene.support
    if support is None:
        return {}
    inverse = 1.0 / np.array([support.mass_kg, support.mass_kg, support.inertia_kg_m2])
    springs = support.horizontal_stiffness_n_m, support.vertical_stiffness_n_m, support.rotational_stiffness_n_m_rad
    dampers = support.horizontal_damping_n_s_m, support.vertical_damping_n_s_m, support.rotational_damping_n_m_s_rad
    return {"frame_mobility": inverse, "frame_stiffness": springs * inverse, "frame_damping": dampers * inverse}


def wear_rate(wear: Wear, speed: float) -> float:
    """Return the wear depth of a pad per impulse, k_s v / A in m/(N s), at a speed along the face (Archard's law)."""
    return wear.coefficient_m2_n * speed / wear.pad_area_m2
