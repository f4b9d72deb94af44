"""Names of parameters and statistics, with units, for pictures."""

from __future__ import annotations

import re
from dataclasses import fields
from typing import Final

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import PARTS, Constant, Harmonic, Table
from plow_twin.study.statistics import unit_of

_PARAMETERS: Final = {
    "clearance.horizontal_m": "horizontal clearance",
    "clearance.vertical_m": "vertical clearance",
}
_STATISTICS: Final = {
    "max": "largest force",
    "mean_in_contact": "mean force in contact",
    "mean_over_time": "mean force over time",
    "impulse": "impulse",
    "time_in_contact": "time in contact",
    "makes": "number of touches",
    "wear_depth": "wear depth",
    "contact_sets": "share of contact time",
    "contact_set_time": "contact time",
    "contact_points": "share of contact time",
    "events": "changes of contact",
    "steps": "steps of the solver",
}
_SCALED: Final = {"N": ("kN", 1e-3), "N m": ("kN m", 1e-3), "N s": ("kN s", 1e-3), "m": ("mm", 1e3)}
_SENSES: Final = {"ccw": "counter-clockwise", "cw": "clockwise"}


def parameter_words(path: str) -> tuple[str, float]:
    """Return the name of a parameter with a unit for pictures, and the factor from SI to this unit."""
    if path == "contact.stiffness":
        return "contact stiffness [MN/mⁿ]", 1e-6
    plain, index = re.fullmatch(r"(.*?)(\[\d+\])?", path).groups()  # type: ignore[union-attr]
    part, *_, name = plain.split(".")
    si = _unit_of_field(part, name, int(index[1:-1]) if index else 0)
    suffix = re.sub("[ /]", "_", si.replace("^", "").lower())
    words = _PARAMETERS.get(plain) or plain.removesuffix(f"_{suffix}").removeprefix("loads.").replace(".", " ")
    words = f"load {words}" if part == "loads" else words
    unit, factor = _SCALED.get(si, (si.replace("^2", "²").replace("^3", "³"), 1.0))
    return f"{words.replace('_', ' ')}{index or ''}" + (f" [{unit}]" if unit else ""), factor


def _unit_of_field(part: str, name: str, index: int) -> str:
    """Return the SI unit of an item of a field of a scene, or an empty text for a number without a unit."""
    kinds = (Harmonic, Constant, Table) if part == "loads" else (PARTS[part],)
    found = (spec.metadata.get("unit", "") for kind in kinds for spec in fields(kind) if spec.name == name)
    units = next(found, "").split(", ")
    unit = units[index] if len(units) > 1 else units[0]
    return "" if unit == "1" else unit


def statistic_words(path: str) -> tuple[str, float]:
    """Return the name of a statistic with a unit for pictures, and the factor from SI to this unit."""
    kind, *places = path.split(".")
    unit, factor = _SCALED.get(unit_of(path), (unit_of(path), 1.0))
    words = [_STATISTICS[kind]]
    for place in places:
        if place in _SENSES:
            words.append(_SENSES[place])
        elif kind == "contact_points":
            words.append(f"force at {place} {'corner' if place == '1' else 'corners'}")
        elif kind.startswith("contact_set"):
            words.append(f"force at {place} alone")
        else:
            words.append(place if place in PAIR_NAMES else f"corner {place}".replace("_", " "))
    return ", ".join(words) + (f" [{unit}]" if unit != "1" else ""), factor
