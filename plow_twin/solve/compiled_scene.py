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
from plow_twin.model.scene import Contact, Friction, Head, Scene, Table, Wear
from plow_twin.solve.method.implicit import OVERDAMPED_RATIO, new_implicit
from plow_twin.solve.modes import settle_modes
from plow_twin.solve.state import (
    COS,
    HARMONIC,
    MAX_ORDER,
    NO_OPTIONS,
    RESTITUTIONS,
    SEGMENT,
    SIN,
    Array,
    Harmonics,
    Options,
    Params,
    Parts,
    Segments,
    State,
    Terms,
    X,
    Y,
    first_of,
    new_records,
    params_type,
    state_type,
    with_attributes,
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
        states = new_records(state_type(self.parts.terms), 1)
        start_many([self], states, [0])
        state = first_of(states)
        if wear_depth is not None:
            state.wear_depth[:] = wear_depth
        state.step_start = state.time = time
        settle_modes(self.params, state, self.parts.terms.stick)
        return state


def start_many(compiled: Sequence[CompiledScene], states: NDArray[np.void], members: Sequence[int]) -> None:
    """Write coordinates, rates, damping and wear, but not modes, of the initial states of `members` to zero records."""
    chosen, shared = [compiled[index] for index in members], _Shared()
    scenes = [compiled.scene for compiled in chosen]
    # the frame and the wear determine whether a block tumbles
    states["y"][members] = [
        shared.of(_initial_place, one.initial, one.head, one.frame, one.wear, given=(one,)) for one in scenes
    ]
    states["damping_factor"][members] = [
        [0.0 if compiled.parts.terms.hysteretic is None else compiled.scene.contact.damping or 0.0]
        for compiled in chosen
    ]
    for index, scene in zip(members, scenes, strict=True):
        if scene.wear is not None:
            states["wear_depth"][index] = scene.wear.initial_depth_m


def _initial_place(scene: Scene) -> Array:
    return geometry.state_of(scene, scene.initial.q, scene.initial.v)


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
    _check_scenes([scene])
    # `_LATELY` would keep a table in memory after the end of its scene
    tables = any(isinstance(load, Table) for load in scene.loads)
    return _compile_alike([scene], tol, sampled, _Shared() if tables else _LATELY)[0]


def compile_scenes(
    scenes: Sequence[Scene], tol: float, *, sampled: bool = False, kind: Options = NO_OPTIONS
) -> tuple[NDArray[np.void], list[CompiledScene]]:
    """Return the records of many scenes at one tolerance, as `compile_scene` does.

    Scenes that differ only in the numbers of clearance, contact and friction are converted together.

    Parameters
    ----------
    scenes : sequence of Scene
    tol : float
        Tolerance of the pose relative to `geometry.length_scale`, 1e-13 .. 1e-1.
    sampled : bool
        Whether the load is given as samples. If True, the loads of the scenes are omitted.
    kind : Options
        Options of the scenes whose constants are rows of one array.

    Returns
    -------
    params : ndarray of records, shape (m,)
        Constants of all scenes in one array. The rows of scenes with other options are zero.
    compiled : list of CompiledScene
        The compiled scenes. Their constants are rows of `params`, or separate records for scenes with other options.

    Raises
    ------
    ArgumentError
        The tolerance is out of range.
    """
    _check_tolerance(tol)
    _check_scenes(scenes)
    shared, params = _LATELY if sampled else _Shared(), new_records(params_type(kind), len(scenes))
    alike: dict[tuple[object, ...], list[int]] = {}
    for index, scene in enumerate(scenes):
        alike.setdefault(_kind(scene, sampled), []).append(index)
    compiled: dict[int, CompiledScene] = {}
    for which in alike.values():
        own = [scenes[index] for index in which]
        rows = (params, which) if options(own[0]) == kind else None
        compiled.update(zip(which, _compile_alike(own, tol, sampled, shared, rows), strict=True))
    return params, [compiled[index] for index in range(len(scenes))]


def _is_number(value: object) -> bool:
    return isinstance(value, Real)


def _check_scenes(scenes: Sequence[Scene]) -> None:
    for scene in scenes:
        if not isinstance(scene, Scene):
            raise ArgumentError(f"scene: got {scene!r}, expected a Scene, for example from load_scene")


def _check_tolerance(tol: float) -> None:
    low, high = TOLERANCE_RANGE
    if not (_is_number(tol) and low <= tol <= high):
        raise ArgumentError(f"tol: got {tol!r}, expected a number from {low:g} to {high:g}")


class _Shared:
    """Cache of the `most` newest results, by the identity of the objects on which they depend."""

    def __init__(self, most: float = math.inf) -> None:
        self._most = most
        self._entries: OrderedDict[tuple[Any, ...], tuple[Any, Any]] = OrderedDict()

    def of(self, compute: Callable[..., _Found], *sources: object, given: tuple[Any, ...] | None = None) -> _Found:
        """Return compute(*sources), or compute(*given). The sources must determine `given`."""
        key = (compute, *map(id, sources))
        stored = self._entries.get(key)
        if stored is None:
            # the id of a deleted source could belong to a new object, so the sources are stored
            stored = self._entries[key] = sources, compute(*(sources if given is None else given))
            if len(self._entries) > self._most:
                self._entries.popitem(last=False)
        found: _Found = stored[1]
        return found


#: Results for parts of the newest scenes. A study usually varies only some parts of a scene.
_LATELY: Final = _Shared(64)


class _Unchanged(NamedTuple):
    """Results that scenes of the same `_kind` share. The fields of `record` that `_varied` returns are not final."""

    loads: LoadSet
    acceleration: float  #: largest acceleration in m/s^2
    start_speed: float  #: upper bound of the head's speed at the start in m/s
    mobility: float  #: largest acceleration of a corner per force in 1/kg
    frame_overdamped: bool  #: the dampers of the support alone make the motion overdamped
    harmonics: Harmonics | None
    terms: Terms
    rows: Array  #: `Params.penetration_rows`
    record: NDArray[np.void]  #: bytes of one record of `PARAMS`, which numpy copies faster than fields


def _unchanged(params: np.dtype[np.void], scene: Scene, sampled: bool, shared: _Shared) -> _Unchanged:
    loads = shared.of(compile_loads, () if sampled else scene.loads)
    mass, inertia = scene.head.mass_kg, scene.head.inertia_kg_m2
    gravity = scene.gravity.acceleration_m_s2
    constant = per_mass(scene, loads.constant)
    constant[1] -= gravity
    constant[2] -= mass * gravity * scene.gravity.arm_m / inertia
    direction, harmonics = shared.of(_harmonics, scene.head, loads)
    terms, _ = law_terms(scene.contact)
    frame, carries = scene.frame, scene.head.carries
    rows = np.zeros((5, PAIR_COUNT))
    rows[:4] = shared.of(geometry.position_rows, frame, carries, given=(scene,))
    values: dict[str, Any] = dict(
        penetration_rows=rows,
        arm_rows=shared.of(geometry.arm_rows, frame, carries, given=(scene,)),
        enabled=[name in scene.pairs for name in PAIR_NAMES],
        inverse_mass=1.0 / mass,
        inverse_inertia=1.0 / inertia,
        gravity=float(gravity),
        constant=constant,
        direction=direction,
        radius=geometry.half_diagonal(scene),
        wear_per_impulse=_wear_rates(scene.wear),
        offset=scene.head.com_offset_m,
        free=scene.free,
        fastest=float(loads.omega.max(initial=0.0)),
        leverage=shared.of(_leverage, frame, carries, given=(rows,)),
        max_events=MAX_EVENTS_AT_ONCE,
        slip_speed=1.0,
    )
    values |= _of_frame(scene) | _rubbing(scene) | _support(scene)
    if scene.friction is not None:
        values |= {"slip_rows": geometry.slip_rows(scene), "slip_arm_rows": geometry.slip_arm_rows(scene)}
    record = new_records(params, 1)
    for name, value in values.items():
        record[name] = value
    terms = _scene_terms(scene, terms, loads, harmonics, sampled or loads.pieces is not None, shared)
    acceleration = _largest_acceleration(scene, shared.of(_largest_wrench, loads))
    radius, overdamped = values["radius"], False
    mobility = 1.0 / mass + radius**2 / inertia
    if scene.support is not None:
        mobility += float(values["frame_mobility"][0] + radius**2 * values["frame_mobility"][2])
        overdamped = bool((values["frame_damping"] > OVERDAMPED_RATIO * np.sqrt(values["frame_stiffness"])).any())
    return _Unchanged(loads, acceleration, _start_speed(scene), mobility, overdamped, harmonics, terms, rows,
                      record.view(f"V{params.itemsize}"))  # fmt: skip


def _leverage(rows: Array) -> float:
    return float(np.hypot(rows[0], rows[1]).max())


def _sources(scene: Scene, sampled: bool) -> tuple[object, ...]:
    """Return the objects that determine `_unchanged`."""
    law, _ = law_terms(scene.contact)
    # only under harmonic loads, a head that starts off centre may rest at a wall that it touches at the start
    wall = (scene.contact, scene.clearance) if not sampled and any(scene.initial.q) else ()
    return (
        scene.head, scene.frame, scene.gravity, () if sampled else scene.loads, scene.initial, scene.locked,
        scene.pairs, scene.wear, scene.support, law, _friction_kind(scene.friction), sampled, *wall,
    )  # fmt: skip


def _kind(scene: Scene, sampled: bool) -> tuple[object, ...]:
    """Return a key of the scenes that differ at most in the numbers of `_varied`."""
    contact = scene.contact
    return contact.law, contact.exponent, options(scene).falling, *map(id, _sources(scene, sampled))


def _compile_alike(
    scenes: Sequence[Scene],
    tol: float,
    sampled: bool,
    shared: _Shared,
    rows: tuple[NDArray[np.void], list[int]] | None = None,
) -> list[CompiledScene]:
    """Return the records of scenes of the same `_kind`.

    `rows` are an array of records and the indices of the scenes in it. Without `rows`, the array is new.
    """
    first, kind = scenes[0], params_type(options(scenes[0]))
    params, which = rows or (new_records(kind, len(scenes)), list(range(len(scenes))))
    common = shared.of(_unchanged, kind, *_sources(first, sampled), given=(kind, first, sampled, shared))
    values, overdamped = _varied(scenes, tol, common)
    # numpy writes to a slice faster than to a list of indices
    members = slice(which[0], which[-1] + 1) if which[-1] - which[0] < len(which) else which
    params.view(common.record.dtype)[members] = common.record
    for name, value in values.items():
        params[name][members] = value
    segments = None
    if sampled:
        segments = np.zeros(1, SEGMENT)
    elif common.loads.pieces is not None:
        segments = _segments(first, common.loads.pieces)
    parts = Parts(common.terms, common.harmonics, segments, None)
    record, support = with_attributes(params), first.support is not None
    return [
        CompiledScene(scene, record[row], parts._replace(implicit=new_implicit(support)) if damped else parts,
                      common.loads)
        for scene, row, damped in zip(scenes, which, overdamped, strict=True)
    ]  # fmt: skip


def _varied(scenes: Sequence[Scene], tol: float, common: _Unchanged) -> tuple[dict[str, Any], list[bool]]:
    """Return fields of `PARAMS`, shape (m, ...) or that of one record, and whether each scene is overdamped."""
    first, terms = scenes[0], common.terms
    length, walls = np.array([geometry.length_scale(scene) for scene in scenes]), geometry.wall_distances(scenes)
    # speed after half the length scale under the largest load
    speed = np.maximum(np.maximum(np.sqrt(length * common.acceleration), common.start_speed), 1e-3 * length)
    numbers = [
        (one.stiffness, one.damping or 0.0, law_terms(one)[1], one.impact_speed_floor_m_s, one.ramp_m or 0.0)
        for one in (scene.contact for scene in scenes)
    ]
    stiffness, damping, number, floor, ramp = np.array(numbers, dtype=float).T
    admissible = min(tol * (STEP_SHARE if terms.fraction is None else STEP_SHARE_FRACTION), LARGEST_STEP_ERROR)
    order = order_for(admissible)
    rows = common.rows[None].repeat(len(scenes), axis=0)
    rows[:, 4] = geometry.penetrations_at_centre(first, walls)
    release = 0.0 if terms.fraction is None else list(map(_release, scenes, [tol] * len(scenes), length, speed))
    values: dict[str, Any] = dict(
        penetration_rows=rows,
        stiffness=stiffness,
        exponent=float(first.contact.exponent),
        viscous=damping if terms.viscous else 0.0,
        damping_number=number,
        speed_floor=floor,
        ramp=ramp if terms.ramp else 0.0,
        lacuna=_lacuna(first.contact.exponent),
        order=order,
        threshold=speed[:, None] * _thresholds(admissible, order),
        velocity_tolerance=tol * speed,
        position_tolerance=tol * length,
        weight=geometry.half_diagonal(first) * speed / length,
        release=release,
        half_cavity=0.5 * walls.min(axis=1),
    )
    if first.friction is not None:
        values |= _slip([scene.friction for scene in scenes if scene.friction is not None])
    if options(first).falling:
        values |= _falling([scene.contact for scene in scenes])
    return values, _overdamped(first, common, values, damping, length).tolist()


def options(scene: Scene) -> Options:
    """Return the options of a scene, each of which adds fields to its `PARAMS` record."""
    falls = scene.contact.restitution_fall is not None or scene.contact.restitution_fall_along_s_m is not None
    return Options(scene.head.carries == "corners", scene.frame.corner_radius_m is not None, falls)


def _of_frame(scene: Scene) -> dict[str, Any]:
    scene_options, constants = options(scene), dict[str, Any]()
    if scene_options.corners:
        constants["tumbles"] = float(geometry.tumbles(scene))
    if scene_options.rounded:
        constants["roll"] = geometry.roll(scene)
    return constants


def _falling(contacts: Sequence[Contact]) -> dict[str, Any]:
    return dict(
        damping_numbers=damping_numbers(contacts[0].law),
        restitution=[contact.restitution for contact in contacts],
        fall=[contact.restitution_fall or 0.0 for contact in contacts],
        fall_speed=[contact.restitution_speed_m_s or 1.0 for contact in contacts],
        fall_mass=[contact.restitution_mass_power or 0.0 for contact in contacts],
        fall_along=[contact.restitution_fall_along_s_m or 0.0 for contact in contacts],
    )


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
    friction = _friction_kind(scene.friction)
    if friction in ("slip", "stick"):
        present[friction] = True
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


def _friction_kind(friction: Friction | None) -> str:
    if friction is None:
        return ""
    if friction.coefficient == 0.0:
        return "zero"
    return "slip" if friction.stick_stiffness_n_m is None else "stick"


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
    if any(scene.initial.q):
        depth = float(_initial_depth(scene, geometry.penetration_rows(scene)))
        pressing += contact.stiffness * depth**contact.exponent
    return bool(swing @ arms <= _SMALL_HARMONICS * pressing)


def _initial_depth(scene: Scene, rows: Array) -> Array | float:
    """Return the largest penetration of any pair in the initial state in m, shape (...), or 0 without contact.

    `rows` are the coefficients of the penetrations, shape (..., 5, 8).
    """
    if not any(scene.initial.q):
        return 0.0  # a centred head does not touch a wall
    y = geometry.state_of(scene, scene.initial.q, scene.initial.v)
    depth: Array = np.maximum((np.array([y[COS], y[SIN], y[X], y[Y], 1.0]) @ rows).max(axis=-1), 0.0)
    return depth


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
    law = LAWS[contact.law]
    viscous = law.additive and bool(contact.damping)
    number = -1.0 if contact.restitution is None else law.damping_number(contact.restitution)
    damped = not law.additive and (number > 0.0 or bool(contact.damping))
    terms = _law_terms(viscous, damped, float(contact.exponent), viscous and contact.ramp_m is not None)
    return terms, number if damped else -1.0


@lru_cache(64)
def _law_terms(viscous: bool, damped: bool, exponent: float, ramp: bool) -> Terms:
    present = dict(
        viscous=viscous,
        hysteretic=damped,
        integer=exponent != 1.0 and exponent.is_integer(),
        fraction=not exponent.is_integer(),
        ramp=ramp,
    )
    return _NO_TERMS._replace(**_flags(present))


def _flags(present: dict[str, bool]) -> dict[str, int]:
    return {name: 1 for name, is_present in present.items() if is_present}


def _harmonics(head: Head, loads: LoadSet) -> tuple[Array, Harmonics | None]:
    """Return the directions of the harmonic forces S1 and S2, and the harmonic loads.

    If all forces are parallel, S1 has their direction and S2 is zero. Otherwise S1 is along x and S2 along y.
    """
    if loads.omega.size == 0:
        return np.eye(2), None
    # sine and cosine amplitudes of the accelerations Fx/m, Fy/m, M/I, shape (h, 2, 3)
    inertias = np.array([head.mass_kg, head.mass_kg, head.inertia_kg_m2])
    amplitudes = np.array([loads.sine, loads.cosine]).swapaxes(0, 1) / inertias
    acting = amplitudes.any(axis=(1, 2))
    if not acting.any():
        return np.eye(2), None
    amplitudes = amplitudes[acting]
    forces = amplitudes[:, :, :2].reshape(-1, 2)
    sizes = np.hypot(forces[:, 0], forces[:, 1])
    largest = sizes.argmax()
    size = float(sizes[largest])
    unit = forces[largest] / size if size > 0.0 else np.array([1.0, 0.0])
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


def _overdamped(
    first: Scene, common: _Unchanged, values: dict[str, Any], factor: Array, length: Array
) -> NDArray[np.bool_]:
    """Return whether the motion of each scene is overdamped, so that it needs implicit steps."""
    terms, exponent, stiffness = common.terms, values["exponent"], values["stiffness"]
    largest_force = first.head.mass_kg * values["threshold"][:, 0] ** 2 / length
    depth = np.maximum(
        (largest_force / stiffness) ** (1.0 / exponent), _initial_depth(first, values["penetration_rows"])
    )
    largest_force = stiffness * depth**exponent
    spring = exponent * largest_force / depth
    damping: Any = np.array(values.get("stick_damping", 0.0))
    if terms.viscous is not None:
        damping = damping + values["viscous"]
    elif terms.hysteretic is not None:
        slow = values["damping_number"] / values["speed_floor"]
        damping = damping + largest_force * np.where(factor > 0.0, factor, slow)
    if terms.slip is not None:
        damping = damping + np.array(values["friction"]) * largest_force / np.array(values["slip_speed"])
    overdamped: NDArray[np.bool_] = damping * common.mobility > OVERDAMPED_RATIO * np.sqrt(spring * common.mobility)
    return overdamped | common.frame_overdamped


def _rubbing(scene: Scene) -> dict[str, Any]:
    wear, wear_terms, options_of_scene = scene.wear, _wear_terms(scene.wear), dict[str, Any]()
    if wear is not None and wear_terms.get("sliding"):
        options_of_scene["slip_rows"] = geometry.slip_rows(scene)
        options_of_scene["speed_per_wear"] = wear.pad_area_m2 / wear.coefficient_m2_n
    if wear is not None and wear_terms.get("running_in") and wear.running_in_depth_m is not None:
        options_of_scene |= {
            "running_in": wear.running_in_ratio - 1.0,
            "running_in_rate": 1.0 / wear.running_in_depth_m,
        }
    return options_of_scene


def _slip(frictions: Sequence[Friction]) -> dict[str, Any]:
    static = [law.coefficient if law.static_coefficient is None else law.static_coefficient for law in frictions]
    return dict(
        friction=[law.coefficient for law in frictions],
        slip_speed=[law.regularisation_speed_m_s for law in frictions],
        static_friction=static,
        stick_stiffness=[law.stick_stiffness_n_m or 0.0 for law in frictions],
        stick_damping=[law.stick_damping_n_s_m or 0.0 for law in frictions],
    )


def _support(scene: Scene) -> dict[str, Any]:
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
