"""List the numbers of a scene, and quantities that are derived from the numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from plow_twin.model.contact_laws import LAWS
from plow_twin.model.friction import painleve_coefficients
from plow_twin.model.scene import OPTIONAL_PARTS, SECTIONS, Harmonic, Scene, Table

Fact = dict[str, Any]


def numbers(scene: Scene) -> list[Fact]:
    """Return the key, value, unit, mark and source of each number of a scene."""
    rows = [row for key in SECTIONS for row in _numbers_of(getattr(scene, key), key, scene)]
    for index, load in enumerate(scene.loads):
        rows += _numbers_of(load, f"loads[{index}]", scene)
    for key in OPTIONAL_PARTS:
        if getattr(scene, key) is not None:
            rows += _numbers_of(getattr(scene, key), key, scene)
    return rows


def _numbers_of(part: Any, path: str, scene: Scene) -> Iterator[Fact]:
    for spec in fields(part):
        value = getattr(part, spec.name)
        if "unit" not in spec.metadata or value is None:
            continue
        key, unit = f"{path}.{spec.name}", spec.metadata["unit"]
        if key == "contact.damping":
            unit = damping_unit(scene)
        units = [text.strip() for text in unit.split(",")]
        if not isinstance(value, tuple):
            yield _row(key, value, unit, scene, (key,))
            continue
        for index, item in enumerate(value):
            place = f"{key}[{index}]"
            yield _row(place, item, units[index] if len(units) > 1 else unit, scene, (place, key))


def damping_unit(scene: Scene) -> str:
    """Return the unit of the key `contact.damping`, which is C in an additive contact law, and lambda otherwise."""
    return "N s/m" if LAWS[scene.contact.law].additive else "s/m"


def _row(key: str, value: float, unit: str, scene: Scene, paths: tuple[str, ...]) -> Fact:
    mark = next((scene.marks[path] for path in paths if path in scene.marks), None)
    name, source = (mark.mark.value, mark.source) if mark else ("", "")
    return {"key": key, "value": float(value), "unit": unit, "mark": name, "source": source}


def derived(scene: Scene) -> list[Fact]:
    """Return quantities that are derived from the numbers of a scene."""
    mass, gravity = scene.head.mass_kg, scene.gravity
    weight = mass * gravity.acceleration_m_s2
    facts = [
        _fact("cavity width", scene.frame.width_m + scene.clearance.horizontal_m, "m"),
        _fact("cavity height", scene.frame.height_m + scene.clearance.vertical_m, "m"),
        _fact("weight", weight, "N"),
        _fact("constant moment of gravity", -weight * gravity.arm_m, "N m")
        if scene.head.rotation == "paper"
        else _fact("moment of gravity at angle 0", -weight * scene.head.com_offset_m[0], "N m"),
    ]
    if scene.friction is not None:
        least = float(painleve_coefficients(scene).min())
        if math.isfinite(least):
            facts.append(_fact("friction coefficient above which a sliding corner jams (Painleve)", least, "1"))
    return [*facts, *_contact_facts(scene), *_load_facts(scene)]


def _contact_facts(scene: Scene) -> Iterator[Fact]:
    contact = scene.contact
    weight = scene.head.mass_kg * scene.gravity.acceleration_m_s2
    if weight > 0.0:
        sinkage = (weight / contact.stiffness) ** (1.0 / contact.exponent)
        yield _fact("penetration of one pair under the weight", sinkage, "m")
    if contact.exponent == 1.0:
        frequency = math.sqrt(contact.stiffness / scene.head.mass_kg) / (2.0 * math.pi)
        yield _fact("frequency of the head on one pair, undamped", frequency, "Hz")
    if contact.restitution is not None:
        number = LAWS[contact.law].damping_number(contact.restitution)
        yield _fact("damping number D = lambda v0 of the restitution", number, "1")


def _load_facts(scene: Scene) -> Iterator[Fact]:
    for load in scene.loads:
        if isinstance(load, Table):
            yield _fact(f"{load.name}: samples", len(load.t), "1")
            yield _fact(f"{load.name}: last time", float(load.t[-1]), "s")
            continue
        (fx, fy), (x, y) = load.force_n, load.at_m
        quantity = "amplitude of the moment" if isinstance(load, Harmonic) else "moment"
        yield _fact(f"{load.name}: {quantity}", x * fy - y * fx + load.moment_n_m, "N m")


def _fact(quantity: str, value: float, unit: str) -> Fact:
    return {"quantity": quantity, "value": float(value) + 0.0, "unit": unit}  # adding 0.0 makes -0.0 positive
