"""Read mapping files.

A mapping file assigns roles and units to topics. It may also contain a model that computes the load from the signals
of the drive.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any, Final

from plow_twin.errors import InputError, Problem, RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.times import STAMP_UNITS
from plow_twin.scene_file.validation import NUMBER, Schema, choice, mapping, validate
from plow_twin.scene_file.yaml_text import read_yaml

#: Quantities that a message may contain, for each role of a topic.
ROLES: Final[dict[str, tuple[str, ...]]] = {
    "excitation": ("fx", "fy", "m"),
    "head_pose": ("x", "y", "theta"),
    "travel": ("speed",),
    "gaps": PAIR_NAMES,
    "forces": PAIR_NAMES,
    "drive": ("power", "chain_force", "speed", "depth", "position"),
}
#: Type of a topic whose fields are nodes of an OPC UA server.
OPCUA: Final = "opcua"
#: Values of the key `stamp` for OPC UA nodes. They select the stamp of the data source or the stamp of the server.
SOURCE_STAMP: Final = "source"
SERVER_STAMP: Final = "server"
#: Keys that an OPC UA node may have in a mapping file, in addition to its identifier.
_NODE_KEYS: Final = ("scale", "offset", "unit", "limits")
#: Key of the model that computes the load from the signals of the drive.
LOAD_MODEL: Final = "load_model"
#: Units of each kind of quantity, with the factor from the unit to SI.
UNITS: Final[dict[str, dict[str, float]]] = {
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6},
    "moment": {"N m": 1.0, "Nm": 1.0, "kN m": 1e3, "kNm": 1e3},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
    "power": {"W": 1.0, "kW": 1e3, "MW": 1e6},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "m/min": 1.0 / 60.0, "km/h": 1.0 / 3.6},
}
#: Kind of each quantity, by its role and name.
QUANTITIES: Final = {
    **{("excitation", name): "force" for name in ("fx", "fy")},
    ("excitation", "m"): "moment",
    **{("head_pose", name): "length" for name in ("x", "y")},
    ("head_pose", "theta"): "angle",
    ("travel", "speed"): "speed",
    ("drive", "power"): "power",
    ("drive", "chain_force"): "force",
    ("drive", "speed"): "speed",
    **{("drive", name): "length" for name in ("depth", "position")},
    **{("gaps", name): "length" for name in PAIR_NAMES},
    **{("forces", name): "force" for name in PAIR_NAMES},
}

_PLACE: Final[Schema] = {
    "type": ["string", "integer"],
    "description": "the name of a column, a path, or {node: identifier}",
}
_LIMITS: Final[Schema] = {
    "anyOf": [
        {"type": "number", "exclusiveMinimum": 0.0, "description": "a finite number > 0"},
        {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2, "description": "two numbers"},
    ],
    "description": "a number, or the smallest and the largest",
}
#: Largest offset between two clocks that a mapping may state [s].
_MOST_OFFSET_S: Final = 1e9


class MapError(InputError, RecordingError):
    """A mapping is invalid, or does not fit the recording."""


def read_map_file(path: Path) -> dict[str, Any]:
    """Return the checked content of a mapping file: the roles, and the load model if the file has one.

    A role may state one scale, offset, unit or limit for all its quantities. In the result, the value is repeated for
    each quantity. Raise `MapError` if the file cannot be read or is invalid.
    """
    document, problems = read_yaml(path, "mapping", ", ".join(ROLES))
    if isinstance(document, dict):
        document = {role: _nodes_as_fields(role, _for_each(role, entry)) for role, entry in document.items()}
    problems = problems or validate(document, map_schema(), "mapping")
    if problems:
        raise MapError(problems, str(path))
    checked: dict[str, Any] = document
    return checked


def _for_each(role: Any, entry: Any) -> Any:
    if role not in ROLES or not isinstance(entry, dict):
        return entry
    kinds: dict[str, tuple[type, ...]] = {
        "scale": (int, float),
        "offset": (int, float),
        "unit": (str,),
        "limits": (int, float, list),
    }
    return {
        key: dict.fromkeys(ROLES[role], value)
        if isinstance(value, kinds.get(key, ())) and not isinstance(value, bool)
        else value
        for key, value in entry.items()
        if value is not None
    }


def _nodes_as_fields(role: Any, entry: Any) -> Any:
    """Convert OPC UA nodes in a role, such as `fx: {node: ns=2;s=Load.Fx, unit: kN}`, to fields with units."""
    if role not in ROLES or not isinstance(entry, dict):
        return entry
    named = {**entry, **(entry["fields"] if isinstance(entry.get("fields"), dict) else {})}
    nodes = {name: named[name] for name in ROLES[role] if _is_node(named.get(name))}
    if not nodes:
        return entry
    rest = {key: value for key, value in entry.items() if key not in nodes}
    others = {name: field for name, field in rest.get("fields", {}).items() if name not in nodes}
    fields = {**others, **{name: node["node"] for name, node in nodes.items()}}
    for key in _NODE_KEYS:
        own = {name: node[key] for name, node in nodes.items() if key in node}
        if own:
            given = rest.get(key)
            rest[key] = {**(given if isinstance(given, dict) else {}), **own}
        elif isinstance(rest.get(key), dict):
            # `_for_each` gave each quantity a value; quantities without a node or field do not need it
            rest[key] = {name: value for name, value in rest[key].items() if name in fields or name not in ROLES[role]}
    return {"stamp": SOURCE_STAMP, "stamp_unit": "ns", **rest, "topic": role, "type": OPCUA, "fields": fields}


def _is_node(field: Any) -> bool:
    return isinstance(field, dict) and isinstance(field.get("node"), str) and set(field) <= {"node", *_NODE_KEYS}


def map_error(path: Path, key: str, got: object, expected: str) -> MapError:
    """Return the error about one value in a mapping file."""
    return MapError([Problem(key, got, expected)], str(path))


@cache
def map_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of a mapping file."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "plow_twin mapping",
        **mapping({**{role: _role(role) for role in ROLES}, LOAD_MODEL: _load_model()}),
        "minProperties": 1,
    }


def _role(role: str) -> Schema:
    names = ROLES[role]
    units = {name: tuple(UNITS[QUANTITIES[role, name]]) for name in names}
    keys = {
        "topic": {"type": "string", "description": "the name of a topic"},
        "type": {"type": "string", "description": "the type of the topic"},
        "fields": mapping(dict.fromkeys(names, _PLACE)),
        "scale": mapping(dict.fromkeys(names, NUMBER)),
        "offset": mapping(dict.fromkeys(names, NUMBER)),
        "unit": mapping({name: choice(units[name]) for name in names}),
        "limits": mapping(dict.fromkeys(names, _LIMITS)),
        "stamp": {**_PLACE, "description": f"header, log, {_PLACE['description']}"},
        "stamp_unit": choice(tuple(STAMP_UNITS)),
        "clock_offset": {
            "type": "number",
            "exclusiveMinimum": -_MOST_OFFSET_S,
            "exclusiveMaximum": _MOST_OFFSET_S,
            "description": "a number of seconds",
        },
        "sequence": _PLACE,
    }
    return mapping(keys, ("topic",))


def _load_model() -> Schema:
    point = _pair([NUMBER, NUMBER], "two finite numbers: x and y [m]")
    spread = {"type": "number", "minimum": 0.0, "description": "a standard deviation >= 0"}
    coefficient = _pair([NUMBER, spread], "a mean and a standard deviation >= 0")
    factor = {"type": "number", "minimum": 0.0, "description": "a factor >= 0"}
    resistance = {
        "position_m": {"type": "array", "items": NUMBER, "minItems": 1, "description": "a list of places [m]"},
        "factor": {"type": "array", "items": factor, "minItems": 1, "description": "a list of factors >= 0"},
    }
    sources = ("efficiency", "specific_force_n_m", "idle_force_n")
    names = ("push_ratio", "lateral_ratio", *sources)
    keys = {
        **dict.fromkeys(names, coefficient),
        "at_m": point,
        "resistance": mapping(resistance, ("position_m", "factor")),
    }
    return {
        **mapping(keys, ("push_ratio", "at_m")),
        "anyOf": [{"required": [key]} for key in sources],
        "description": f"a mapping with push_ratio, at_m and {' or '.join(sources)} (for chain_force)",
    }


def _pair(items: list[Schema], expected: str) -> Schema:
    return {"type": "array", "prefixItems": items, "minItems": 2, "maxItems": 2, "description": expected}
