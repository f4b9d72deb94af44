"""The constants of one head in one guide, as frozen dataclasses in SI units.

The field names are the keys of the scene file. The metadata of a field contains its unit, meaning and range, from which
the checks, the schema of the scene file and its documentation are derived.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from enum import Enum
from types import MappingProxyType
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError, Problem, SceneError
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.pairs import CORNER_NAMES, PAIR_NAMES

SCENE_VERSION: Final = 1
DOF_NAMES: Final = ("x", "y", "theta")

LEAST_EXPONENT: Final = 1.0
_LARGEST_EXPONENT: Final = 4.0

_Part = TypeVar("_Part")


class Mark(Enum):
    """Origin of a number.

    Attributes
    ----------
    GIVEN
        Published, or stated by the manufacturer of the machine.
    RECONSTRUCTED
        Fitted to published or measured data.
    ASSUMED
        Chosen without data.
    MEASURED
        Measured at the machine.
    """

    GIVEN = "given"
    RECONSTRUCTED = "reconstructed"
    ASSUMED = "assumed"
    MEASURED = "measured"


@dataclass(frozen=True)
class Provenance:
    """The origin of one number of a scene.

    Attributes
    ----------
    mark : Mark
    source : str
        Description of the source.
    deviation : float, optional
        Standard deviation, in the unit of the number.
    """

    mark: Mark
    source: str = ""
    deviation: float | None = None


def _quantity(unit: str, doc: str, default: Any = ..., **bounds: float) -> Any:
    """Return a dataclass field for numbers with its unit, meaning and range (`gt`, `ge`, `lt`, `le`)."""
    metadata = {"unit": unit, "doc": doc, **bounds}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


def _choice(doc: str, choices: Collection[str], default: Any = ...) -> Any:
    metadata = {"doc": doc, "choices": choices}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Head:
    """The moving body: a plough head with a cavity around the frame, or a block inside a fixed cavity."""

    mass_kg: float = _quantity("kg", "mass", gt=0.0)
    inertia_kg_m2: float = _quantity("kg m^2", "moment of inertia about the centre of mass", gt=0.0)
    rotation: str = _choice(
        "paper: the centre of mass is the cavity's centre and gravity adds a constant moment; consistent: rigid body "
        "with an offset centre of mass",
        ("paper", "consistent"),
        "paper",
    )
    com_offset_m: tuple[float, float] = _quantity(
        "m", "centre of mass from the cavity's centre, head axes (rotation: consistent)", (0.0, 0.0)
    )
    carries: str = _choice(
        "walls: the head is the cavity, its walls meet the corners of a fixed frame; corners: the head is a block of "
        "the frame's size, its corners meet the walls of a fixed cavity",
        ("walls", "corners"),
        "walls",
    )


@dataclass(frozen=True)
class Frame:
    """The slide, a rectangle inside the cavity of the head. The slide is fixed unless the scene has a `Support`.

    Attributes
    ----------
    labels : mapping of str to str
        Letters that name corners, e.g. a: bottom_right.
    """

    width_m: float = _quantity("m", "horizontal side", gt=0.0)
    height_m: float = _quantity("m", "vertical side", gt=0.0)
    labels: Mapping[str, str] = field(
        default_factory=dict, metadata={"doc": "letters for corners, e.g. a: bottom_right", "choices": CORNER_NAMES}
    )
    corner_radius_m: float | None = _quantity("m", "radius of rounded corners, sharp unless given", None, gt=0.0)

    @property
    def letters(self) -> dict[str, str]:
        """Letter of each corner that has one."""
        return {corner: letter for letter, corner in self.labels.items()}

    @property
    def corner_labels(self) -> dict[str, str]:
        """Letter of each corner, or its name if it has no letter."""
        letters = self.letters
        return {corner: letters.get(corner, corner) for corner in CORNER_NAMES}


@dataclass(frozen=True)
class Clearance:
    """The cavity's size minus the frame's size. A negative clearance presses the frame against two opposite walls."""

    horizontal_m: float = _quantity("m", "cavity width minus frame width")
    vertical_m: float = _quantity("m", "cavity height minus frame height")


@dataclass(frozen=True)
class Contact:
    """Normal contact. All pairs have the same law with the same parameters.

    A scene gives either `damping` or `restitution`, or neither under a law without damping. Under the default law, an
    impact has exactly the given restitution.

    The restitution can decrease with the impact speed w = v (m' / m)^p:

    - v is the speed of approach, m the mass of the head, m' the effective mass of the head at the corner, and p the
      `restitution_mass_power`.
    - If w exceeds v1 = `restitution_speed_m_s`, the restitution is multiplied by (w / v1)^-q with q =
      `restitution_fall`.
    - The product of `restitution_fall_along_s_m` and the speed of the centre of mass along the wall is subtracted from
      this restitution.

    References
    ----------
    Johnson, Contact Mechanics, 1985, sec. 11.5, derives the decrease with the speed (v^-1/4 in plastic contact). The
    dependence on the effective mass and on the speed along the wall was found in measured impacts (docs/measured.md).
    """

    law: str = _choice("contact law", LAWS, "exact_restitution")
    # the dataclass needs a default; NaN is not admissible, so every scene has to give the stiffness
    stiffness: float = _quantity("N/m^exponent", "K in F = K d^n (...)", math.nan, gt=0.0)
    exponent: float = _quantity("1", "n in F = K d^n (...)", 1.0, ge=LEAST_EXPONENT, le=_LARGEST_EXPONENT)
    damping: float | None = _quantity(
        "N s/m or s/m",
        "kelvin_voigt, ramped_damping: C in N s/m; others: constant factor lambda of (1 + lambda d') in s/m",
        None,
        ge=0.0,
    )
    restitution: float | None = _quantity("1", "nominal restitution of the law", None, ge=0.0, le=1.0)
    impact_speed_floor_m_s: float = _quantity(
        "m/s", "least impact speed v0 in lambda = D(e)/v0, which bounds the damping of a slow touch", 1e-3, gt=0.0
    )
    ramp_m: float | None = _quantity("m", "ramped_damping: penetration at which C has its full value", None, gt=0.0)
    restitution_fall: float | None = _quantity(
        "1", "exponent q of the decrease of the restitution above restitution_speed_m_s", None, ge=0.0, le=1.0
    )
    restitution_speed_m_s: float | None = _quantity(
        "m/s", "impact speed v1 up to which the restitution is constant", None, gt=0.0
    )
    restitution_mass_power: float | None = _quantity(
        "1", "exponent p of the ratio of masses in the impact speed w, 0 unless given", None, ge=0.0, le=4.0
    )
    restitution_fall_along_s_m: float | None = _quantity(
        "s/m",
        "decrease of the restitution per speed of the centre of mass along the wall, 0 unless given",
        None,
        ge=0.0,
    )


def largest_exponent(contact: Contact) -> float:
    """Return the largest exponent that the contact law admits."""
    return LAWS[contact.law].exponent or _LARGEST_EXPONENT


#: Fields of `Contact` that make the restitution depend on the impact.
FALL_NAMES: Final = (
    "restitution_fall",
    "restitution_speed_m_s",
    "restitution_mass_power",
    "restitution_fall_along_s_m",
)


@dataclass(frozen=True)
class Friction:
    """Tangential friction of all pairs, by one of two laws.

    Without `stick_stiffness_n_m`, friction is regularised Coulomb friction: T = mu N tanh(slip rate / regularisation
    speed), so a corner creeps instead of sticking. With `stick_stiffness_n_m`, a spring and a damper connect a corner
    to the wall until their force exceeds `static_coefficient` times N. Then the corner slips with T = mu N.

    References
    ----------
    Regularised friction: Andersson, Soederberg and Bjoerklund, Tribol. Int. 40 (2007) 580, eq. 5. Friction with stick:
    Cundall and Strack, Geotechnique 29 (1979) 47, and Luding, Granul. Matter 10 (2008) 235, sec. 3.2.
    """

    coefficient: float = _quantity("1", "mu", ge=0.0)
    regularisation_speed_m_s: float = _quantity(
        "m/s", "slip speed below which friction is viscous; not with stick", 0.01, gt=0.0
    )
    stick_stiffness_n_m: float | None = _quantity("N/m", "tangential stiffness of a corner that sticks", None, gt=0.0)
    stick_damping_n_s_m: float | None = _quantity(
        "N s/m", "tangential damping of a corner that sticks, 0 unless given", None, ge=0.0
    )
    static_coefficient: float | None = _quantity(
        "1", "friction coefficient up to which a corner sticks, mu unless given", None, ge=0.0
    )


@dataclass(frozen=True)
class Support:
    """Springs and dampers between the frame and the ground. With a support, the frame is a movable body with mass.

    The frame starts at rest in its equilibrium without contact. Its displacement is measured from this equilibrium. The
    pose q of the head is relative to the frame.
    """

    mass_kg: float = _quantity("kg", "mass of the frame and of the parts that move with it", gt=0.0)
    inertia_kg_m2: float = _quantity(
        "kg m^2", "moment of inertia of the frame and these parts about the frame's centre", gt=0.0
    )
    horizontal_stiffness_n_m: float = _quantity("N/m", "horizontal spring, 0 for no spring", ge=0.0)
    vertical_stiffness_n_m: float = _quantity("N/m", "vertical spring, 0 for no spring", ge=0.0)
    rotational_stiffness_n_m_rad: float = _quantity("N m/rad", "spring against rotation, 0 for no spring", ge=0.0)
    horizontal_damping_n_s_m: float = _quantity("N s/m", "horizontal damper", 0.0, ge=0.0)
    vertical_damping_n_s_m: float = _quantity("N s/m", "vertical damper", 0.0, ge=0.0)
    rotational_damping_n_m_s_rad: float = _quantity("N m s/rad", "damper of the rotation", 0.0, ge=0.0)


@dataclass(frozen=True)
class Gravity:
    """Gravity. With `rotation: paper` it adds the constant moment -m g arm about the centre of the cavity."""

    acceleration_m_s2: float = _quantity("m/s^2", "acceleration along -y", 9.81)
    arm_m: float = _quantity("m", "arm of the constant moment, positive to the right", 0.0)


@dataclass(frozen=True)
class Harmonic:
    """A load `amplitude * sin(omega t + phase)` at a constant point (x, y), with the moment M = x Fy - y Fx + moment.

    Attributes
    ----------
    name : str
        Name of the load, unique in a scene.
    """

    name: str
    force_n: tuple[float, float] = _quantity("N", "amplitude (Fx, Fy)", (0.0, 0.0))
    omega_rad_s: float = _quantity("rad/s", "angular frequency", 1.0, gt=0.0)
    phase_rad: float = _quantity("rad", "phase", 0.0)
    moment_n_m: float = _quantity("N m", "amplitude of a free moment", 0.0)
    at_m: tuple[float, float] = _quantity("m", "point of action from the cavity's centre, world axes", (0.0, 0.0))


@dataclass(frozen=True)
class Constant:
    """A constant load.

    Attributes
    ----------
    name : str
        Name of the load, unique in a scene.
    """

    name: str
    force_n: tuple[float, float] = _quantity("N", "(Fx, Fy)", (0.0, 0.0))
    moment_n_m: float = _quantity("N m", "free moment", 0.0)
    at_m: tuple[float, float] = _quantity("m", "point of action from the cavity's centre, world axes", (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Table:
    """A load given by samples. Before the first sample and after the last sample, the load is constant.

    With `hold: linear`, straight lines connect the samples. With `hold: zero`, each value lasts until the next sample.

    Attributes
    ----------
    name : str
        Name of the load, unique in a scene.
    t : ndarray, shape (n,)
        Times in s, strictly increasing.
    wrench : ndarray, shape (n, 3)
        Fx, Fy in N and M in N m at each time.
    """

    name: str
    t: NDArray[np.float64]
    wrench: NDArray[np.float64]
    hold: str = _choice("load between the samples", ("linear", "zero"), "linear")
    at_m: tuple[float, float] = _quantity("m", "point of action from the cavity's centre, world axes", (0.0, 0.0))


Load = Harmonic | Constant | Table


@dataclass(frozen=True)
class Initial:
    """State at t = 0: the pose of the cavity's centre relative to the frame's centre, and its rate."""

    q: tuple[float, float, float] = _quantity("m, m, rad", "x, y, theta", (0.0, 0.0, 0.0))
    v: tuple[float, float, float] = _quantity("m/s, m/s, rad/s", "rates of q", (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Wear:
    """Archard wear of the eight pads by the travel along the face: dh/dt = k_s F v / A.

    With `sliding: total`, sqrt(v^2 + s'^2) replaces v, where s' is the in-plane speed of the corner over its pad. Below
    v = 0.01 m/s, this wear is proportional to v.
    Running-in multiplies k_s by 1 + (r - 1) exp(-h / h0) with the wear depth h, r = `running_in_ratio` and h0 =
    `running_in_depth_m`.

    References
    ----------
    Wear: Archard, J. Appl. Phys. 24 (1953) 981. Running-in: Queener, Smith and Mitchell, Wear 8 (1965) 391.
    """

    coefficient_m2_n: float = _quantity("m^2/N", "k_s = k/H", ge=0.0)
    pad_area_m2: float = _quantity("m^2", "area A of one pad", gt=0.0)
    travel_speed_m_s: float = _quantity("m/s", "speed v along the face", ge=0.0)
    initial_depth_m: tuple[float, ...] = _quantity("m", "wear depth of the eight pads at t = 0", (0.0,) * 8, ge=0.0)
    prior_m2_n: tuple[float, float] = _quantity(
        "m^2/N", "5 % and 95 % points of the prior of k_s", (1e-15, 1e-13), gt=0.0
    )
    pad_length_m: float | None = _quantity(
        "m", "length of a pad along the face, from which the wear of the slide is computed", None, gt=0.0
    )
    sliding: str = _choice(
        "motion that causes wear: travel alone, or total, which includes sliding in the plane",
        ("travel", "total"),
        "travel",
    )
    running_in_ratio: float = _quantity("1", "wear coefficient of a new pad, divided by k_s", 1.0, ge=1.0)
    running_in_depth_m: float | None = _quantity(
        "m", "wear depth over which the excess of this ratio over 1 falls by a factor e", None, gt=0.0
    )


@dataclass(frozen=True)
class Scene:
    """The parameters, loads and initial state of one machine.

    Attributes
    ----------
    head : Head
    frame : Frame
    clearance : Clearance
    contact : Contact
    gravity : Gravity
    loads : tuple of Harmonic, Constant or Table
        Loads on the head other than gravity and contact forces.
    initial : Initial
    locked : tuple of str
        Degrees of freedom that are fixed: any of x, y, theta.
    pairs : tuple of str
        The pairs that can touch.
    wear : Wear or None
    friction : Friction or None
    support : Support or None
    marks : mapping of str to Provenance
        Origin of each number, by the path of the number. The comparison by == ignores the marks.

    Raises
    ------
    SceneError
        The scene is not valid. The error lists every problem.
    """

    head: Head
    frame: Frame
    clearance: Clearance
    contact: Contact
    gravity: Gravity = Gravity()
    loads: tuple[Load, ...] = ()
    initial: Initial = Initial()
    locked: tuple[str, ...] = field(default=(), metadata={"doc": "locked degrees of freedom", "choices": DOF_NAMES})
    pairs: tuple[str, ...] = field(
        default=PAIR_NAMES, metadata={"doc": "the pairs that can touch", "choices": PAIR_NAMES}
    )
    wear: Wear | None = None
    friction: Friction | None = None
    support: Support | None = None
    marks: Mapping[str, Provenance] = field(default_factory=lambda: MappingProxyType({}), compare=False)

    def __post_init__(self) -> None:
        problems = list(check(self))
        if problems:
            raise SceneError(problems)

    @property
    def free(self) -> tuple[bool, ...]:
        """Whether x, y and theta are free, shape (3,)."""
        return tuple(name not in self.locked for name in DOF_NAMES)


def variants(scenes: Sequence[Scene], numbers: Mapping[str, Mapping[str, Any]], **parts: Any) -> list[Scene]:
    """Return copies of scenes with other numbers in clearance, contact or friction.

    Parameters
    ----------
    scenes : sequence of Scene
        Scenes that differ from each other only in these parts.
    numbers : mapping
        For each part, the new numbers by the names of the fields, shape (m,) each.
    **parts
        Further parts, which become those of all scenes.

    Raises
    ------
    SceneError
        A copy is not valid. Only the copies with all smallest and all largest numbers are checked, because a scene
        bounds each of these numbers.
    """
    for bound in (np.min, np.max):
        end = {part: {name: float(bound(values)) for name, values in own.items()} for part, own in numbers.items()}
        replace(scenes[0], **parts, **{part: replace(getattr(scenes[0], part), **own) for part, own in end.items()})
    lists = {part: {name: values.tolist() for name, values in own.items()} for part, own in numbers.items()}
    found = []
    for index, scene in enumerate(scenes):
        for part, own in lists.items():
            parts[part] = _copied(getattr(scene, part), {name: values[index] for name, values in own.items()})
        found.append(_copied(scene, parts))
    return found


def _copied(part: _Part, values: Mapping[str, Any]) -> _Part:
    """Return a copy of a frozen dataclass without a check of its new values."""
    copy = object.__new__(type(part))
    copy.__dict__.update(part.__dict__, **values)
    return copy


#: Parts that every scene has.
SECTIONS: Final[Mapping[str, type]] = {
    "head": Head,
    "frame": Frame,
    "clearance": Clearance,
    "contact": Contact,
    "gravity": Gravity,
    "initial": Initial,
}
#: Parts that a scene may lack.
OPTIONAL_PARTS: Final[Mapping[str, type]] = {"wear": Wear, "friction": Friction, "support": Support}
#: All parts of a scene that are dataclasses.
PARTS: Final[Mapping[str, type]] = {**SECTIONS, **OPTIONAL_PARTS}


def check(scene: Scene) -> Iterator[Problem]:
    """Yield every problem of a scene. Conflicts between fields are checked only if each field is valid."""
    problems = list(_check_fields(scene, ""))
    yield from problems
    if not problems:
        yield from _check_contact(scene.contact)
        yield from _check_rotation(scene)
        yield from _check_corners(scene)
        yield from _check_loads(scene.loads)
        if scene.friction is not None:
            yield from _check_friction(scene.friction)
        corners = list(scene.frame.labels.values())
        if len(set(corners)) != len(corners):
            yield Problem("frame.labels", dict(scene.frame.labels), "each corner once")
        for name, rate in zip(DOF_NAMES, scene.initial.v, strict=True):
            if name in scene.locked and rate != 0.0:
                yield Problem("initial.v", scene.initial.v, f"0 for the locked {name}")
        if scene.wear is not None:
            yield from _check_wear(scene.wear, scene.contact)
        for key in ("locked", "pairs"):
            names = getattr(scene, key)
            if len(set(names)) != len(names):
                yield Problem(key, names, "each name once")


def _check_fields(part: Any, path: str) -> Iterator[Problem]:
    for spec in fields(part):
        value = getattr(part, spec.name)
        key = f"{path}{spec.name}"
        kind = PARTS.get(spec.name) if isinstance(part, Scene) else None
        if kind is not None:
            if isinstance(value, kind):
                yield from _check_fields(value, f"{key}.")
            elif value is not None or spec.name not in OPTIONAL_PARTS:
                yield Problem(key, value, f"a {kind.__name__}")
        elif spec.name in ("loads", "locked", "pairs") and not isinstance(value, (tuple, list)):
            yield Problem(key, value, "a tuple")
        elif spec.name == "loads":
            for index, load in enumerate(value):
                if not isinstance(load, Load):
                    yield Problem(f"loads[{index}]", load, "a Harmonic, Constant or Table")
                else:
                    yield from _check_fields(load, f"loads[{index}].")
        elif "unit" in spec.metadata:
            yield from _check_number(key, value, spec)
        elif "choices" in spec.metadata:
            yield from _check_choice(key, value, spec)


def _check_number(key: str, value: Any, spec: Field[Any]) -> Iterator[Problem]:
    if value is None and spec.default is None:
        return
    if isinstance(spec.default, tuple) or isinstance(value, (tuple, list, np.ndarray)):
        length = len(spec.default) if isinstance(spec.default, tuple) else None
        if not isinstance(value, (tuple, list, np.ndarray)) or length is None or len(value) != length:
            yield Problem(key, value, f"{length or 1} number(s): {describe(spec)}")
            return
        for index, item in enumerate(value):
            if not _admissible(item, spec.metadata):
                yield Problem(f"{key}[{index}]", item, describe(spec))
    elif not _admissible(value, spec.metadata):
        yield Problem(key, value, describe(spec))


def _admissible(value: Any, metadata: Mapping[str, Any]) -> bool:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float, np.integer, np.floating))
        or not math.isfinite(value)
    ):
        return False
    return bool(
        value > metadata.get("gt", -math.inf)
        and value >= metadata.get("ge", -math.inf)
        and value < metadata.get("lt", math.inf)
        and value <= metadata.get("le", math.inf)
    )


def _check_choice(key: str, value: Any, spec: Field[Any]) -> Iterator[Problem]:
    choices = spec.metadata["choices"]
    values = value.values() if isinstance(value, Mapping) else (value,) if isinstance(value, str) else value
    for item in values:
        if item not in choices:
            yield Problem(key, item, f"one of {', '.join(choices)}")


def must_be_given(spec: Field[Any]) -> bool:
    """Return whether a scene must give the field, because the field has no default or the default NaN."""
    if spec.default is MISSING:
        return spec.default_factory is MISSING
    return isinstance(spec.default, float) and math.isnan(spec.default)


def describe(spec: Field[Any]) -> str:
    """Return the admissible numbers as text, e.g. `a finite number > 0 [kg]`."""
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    bounds = [f"{sign} {spec.metadata[name]:g}" for name, sign in signs.items() if name in spec.metadata]
    return f"a finite number {' and '.join(bounds)}".rstrip() + f" [{spec.metadata['unit']}]"


#: Largest admissible damping factor lambda [s/m]. A larger factor would stop a head within a depth sqrt(2 m / (K
#: lambda)) that double precision resolves with few digits.
MOST_DAMPING_FACTOR: Final = 1e9


def _check_wear(wear: Wear, contact: Contact) -> Iterator[Problem]:
    if wear.prior_m2_n[0] > wear.prior_m2_n[1]:
        yield Problem("wear.prior_m2_n", wear.prior_m2_n, "the 5 % point first, then the 95 % point")
    if wear.running_in_ratio > 1.0 and wear.running_in_depth_m is None:
        yield Problem("wear.running_in_depth_m", None, "a depth, with this wear.running_in_ratio")
    if wear.travel_speed_m_s > fastest_travel(wear, contact):
        rate = wear.running_in_ratio * wear.coefficient_m2_n * wear.travel_speed_m_s / wear.pad_area_m2
        yield Problem(
            "contact.damping", contact.damping, f"at most {1.0 / rate:.3g} N s/m, A / (k_s v), with this wear"
        )


def fastest_travel(wear: Wear | None, contact: Contact) -> float:
    """Return the largest speed along the face in m/s, A / (k_s C) with the damping C, or inf without C or wear.

    Above this speed, a force wears the pad faster than it moves the head, so no contact can last.
    """
    if wear is None or not LAWS[contact.law].additive:
        return math.inf
    worn = (contact.damping or 0.0) * wear.coefficient_m2_n * wear.running_in_ratio
    return wear.pad_area_m2 / worn if worn > 0.0 else math.inf


def check_travel_speed(scene: Scene, speed_m_s: float) -> None:
    """Raise an `ArgumentError` if the scene does not admit a speed along the face in m/s. The speed may be negative."""
    fastest = fastest_travel(scene.wear, scene.contact)
    if not math.isfinite(speed_m_s):
        raise ArgumentError(f"speed_m_s: got {speed_m_s!r}, expected a finite speed in m/s")
    if abs(speed_m_s) > fastest:
        raise ArgumentError(
            f"speed_m_s: got {speed_m_s!r}, expected at most {fastest:.3g} m/s, A / (k_s C), with this wear and "
            f"contact.damping {scene.contact.damping!r} N s/m"
        )


def _check_contact(contact: Contact) -> Iterator[Problem]:
    law = LAWS[contact.law]
    values = {"damping": contact.damping, "restitution": contact.restitution}
    names = [name for name, value in values.items() if value is not None]
    allowed = [
        name for name, possible in (("damping", law.takes_damping), ("restitution", law.takes_restitution)) if possible
    ]
    if len(names) > 1:
        yield Problem("contact", values, "either damping or restitution, not both")
    for name in names:
        if name not in allowed:
            yield Problem(
                f"contact.{name}", values[name], f"{' or '.join(allowed) or 'no damping at all'} for {contact.law}"
            )
    if allowed and not names:
        yield Problem("contact", values, f"{' or '.join(allowed)} for {contact.law}")
    yield from _check_fall(contact)
    if law.exponent is not None and contact.exponent != law.exponent:
        yield Problem("contact.exponent", contact.exponent, f"{law.exponent:g} for {contact.law}")
    if not law.additive and contact.damping is not None and contact.damping > MOST_DAMPING_FACTOR:
        expected = f"at most {MOST_DAMPING_FACTOR:g} s/m for {contact.law}; a restitution gives at most 1e6"
        yield Problem("contact.damping", contact.damping, expected)
    if law.ramped != (contact.ramp_m is not None):
        expected = "a penetration > 0 [m]" if law.ramped else "no value"
        yield Problem("contact.ramp_m", contact.ramp_m, f"{expected} for {contact.law}")


def _check_fall(contact: Contact) -> Iterator[Problem]:
    if contact.restitution is None:
        for name in FALL_NAMES:
            if getattr(contact, name) is not None:
                yield Problem(f"contact.{name}", getattr(contact, name), "no value without contact.restitution")
        return
    if (contact.restitution_fall is None) != (contact.restitution_speed_m_s is None):
        values = {name: getattr(contact, name) for name in ("restitution_fall", "restitution_speed_m_s")}
        yield Problem("contact", values, "both or neither")
    if contact.restitution_fall is None and contact.restitution_mass_power is not None:
        expected = "no value without contact.restitution_fall"
        yield Problem("contact.restitution_mass_power", contact.restitution_mass_power, expected)


def _check_corners(scene: Scene) -> Iterator[Problem]:
    radius, frame = scene.frame.corner_radius_m, scene.frame
    if radius is None:
        return
    if not radius < 0.5 * min(frame.width_m, frame.height_m):
        yield Problem("frame.corner_radius_m", radius, "less than half the frame's shorter side [m]")
    if scene.support is not None:
        yield Problem("support", scene.support, "none with frame.corner_radius_m")


def _check_friction(friction: Friction) -> Iterator[Problem]:
    static = friction.static_coefficient
    if friction.stick_stiffness_n_m is None:
        for name in ("stick_damping_n_s_m", "static_coefficient"):
            if getattr(friction, name) is not None:
                yield Problem(f"friction.{name}", getattr(friction, name), "no value without stick_stiffness_n_m")
    elif static and friction.coefficient == 0.0:
        expected = "no value, or 0, with a coefficient of 0, which means no friction"
        yield Problem("friction.static_coefficient", static, expected)
    elif static is not None and static < friction.coefficient:
        yield Problem("friction.static_coefficient", static, f"at least the coefficient {friction.coefficient:g} [1]")


def _check_rotation(scene: Scene) -> Iterator[Problem]:
    offset = any(value != 0.0 for value in scene.head.com_offset_m)
    if scene.head.carries == "corners":
        if offset:
            yield Problem("head.com_offset_m", scene.head.com_offset_m, "(0, 0) for carries: corners")
        if scene.support is not None:
            yield Problem("support", scene.support, "none for carries: corners, whose walls are fixed")
    if scene.head.rotation == "paper" and offset:
        yield Problem("head.com_offset_m", scene.head.com_offset_m, "(0, 0) for rotation: paper")
    if scene.head.rotation == "consistent":
        if scene.gravity.arm_m != 0.0:
            yield Problem(
                "gravity.arm_m", scene.gravity.arm_m, "0 for rotation: consistent (gravity acts at com_offset_m)"
            )
        if offset and {"x", "y"} & set(scene.locked) and "theta" not in scene.locked:
            yield Problem("locked", scene.locked, "no x or y while theta is free and the centre of mass is offset")


def _check_loads(loads: tuple[Load, ...]) -> Iterator[Problem]:
    names = [load.name for load in loads]
    for index, load in enumerate(loads):
        if not isinstance(load.name, str) or not load.name or names.count(load.name) > 1:
            yield Problem(f"loads[{index}].name", load.name, "a name that no other load has")
        if isinstance(load, Table):
            yield from _check_table(f"loads[{index}]", load)


#: Shortest time in s between two samples of a table, which is the shortest step of the solver.
LEAST_SPACING_S: Final = 1e-100


def _check_table(key: str, table: Table) -> Iterator[Problem]:
    t, wrench = np.asarray(table.t), np.asarray(table.wrench)
    for name, values in (("t", t), ("wrench", wrench)):
        if values.dtype.kind not in "fiu":
            yield Problem(f"{key}.{name}", values.tolist(), "numbers")
            return
    if t.ndim != 1 or len(t) < 1:
        yield Problem(f"{key}.t", t.shape, "shape (n,) with n >= 1")
    elif wrench.shape != (len(t), 3):
        yield Problem(f"{key}.wrench", wrench.shape, f"shape ({len(t)}, 3)")
    elif not (np.isfinite(t).all() and np.isfinite(wrench).all()):
        row = int(np.flatnonzero(~(np.isfinite(t) & np.isfinite(wrench).all(axis=1)))[0])
        yield Problem(f"{key} row {row}", (float(t[row]), *map(float, wrench[row])), "finite numbers")
    elif (np.diff(t) <= 0.0).any():
        row = int(np.flatnonzero(np.diff(t) <= 0.0)[0]) + 1
        yield Problem(f"{key}.t[{row}]", float(t[row]), f"more than the time before it, {float(t[row - 1])!r}")
    elif (np.diff(t) < LEAST_SPACING_S).any():
        row = int(np.flatnonzero(np.diff(t) < LEAST_SPACING_S)[0]) + 1
        spacing = f"at least {LEAST_SPACING_S:g} s more than the time before it, {float(t[row - 1])!r}"
        yield Problem(f"{key}.t[{row}]", float(t[row]), spacing)
