"""Names of parameters and statistics, with units, for pictures."""

from __future__ import annotations

import re
from typing import Final

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.study.statistics import unit_of

#: Unit in pictures and its factor from SI, by the first suffix that a parameter's name has.
_ENDS: Final = {
    "_kg_m2": ("kg m²", 1.0),
    "_kg": ("kg", 1.0),
    "_rad_s": ("rad/s", 1.0),
    "_rad": ("rad", 1.0),
    "_m_s2": ("m/s²", 1.0),
    "_m_s": ("m/s", 1.0),
    "_n_m": ("kN m", 1e-3),
    "_n": ("kN", 1e-3),
    "_m": ("mm", 1e3),
}
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
_SCALED: Final = {"N": ("kN", 1e-3), "N s": ("kN s", 1e-3), "m": ("mm", 1e3)}
_SENSES: Final = {"ccw": "counter-clockwise", "cw": "clockwise"}


def parameter_words(path: str) -> tuple[str, float]:
    """Return the name of a parameter with a unit for pictures, and the factor from SI to this unit."""
    if path == "contact.stiffness":
        return "contact stiffness [MN/mⁿ]", 1e-6
    plain, index = re.fullmatch(r"(.*?)(\[\d+\])?", path).groups()  # type: ignore[union-attr]
    end = next((end for end in _ENDS if plain.endswith(end)), "")
    words = _PARAMETERS.get(plain) or plain.removesuffix(end).removeprefix("loads.").replace(".", " ").replace("_", " ")
    if path.startswith("loads."):
        words = f"load {words}"
    unit, factor = _ENDS.get(end, ("", 1.0))
    return f"{words}{index or ''}" + (f" [{unit}]" if unit else ""), factor


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
