"""JSON Schema of the scene file, made from the dataclasses of `plow_twin.model.scene`.

A number or a list of numbers, except the samples of a table, may be a mapping `{value, mark, source}`.
"""

from __future__ import annotations

from dataclasses import MISSING, Field, fields
from typing import Any, Final

from plow_twin.model.scene import (
    OPTIONAL_PARTS,
    SCENE_VERSION,
    SECTIONS,
    Constant,
    Harmonic,
    Load,
    Mark,
    Scene,
    Table,
    describe,
    must_be_given,
)
from plow_twin.scene_file.validation import TEXT, Schema, choice, mapping

LOAD_KINDS: Final[dict[str, type[Load]]] = {"harmonic": Harmonic, "constant": Constant, "table": Table}
#: Default columns of a load file: time, Fx, Fy, M.
TABLE_COLUMNS: Final = ("t", "fx", "fy", "m")

_BOUNDS: Final = {"gt": "exclusiveMinimum", "ge": "minimum", "lt": "exclusiveMaximum", "le": "maximum"}


def scene_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of scene files of version 1."""
    described = {spec.name: spec for spec in fields(Scene)}
    names = {key: _name_list(described[key]) for key in ("locked", "pairs")}
    properties: Schema = {
        "version": {"const": SCENE_VERSION, "description": f"{SCENE_VERSION}, the supported version of the scene file"},
        **{key: _object(part) for key, part in SECTIONS.items()},
        "loads": {"type": "array", "items": _load(), "description": "a list of loads"},
        "locked": names["locked"],
        "pairs": _either(names["pairs"], {"const": "all"}, "all, or " + names["pairs"]["description"]),
        **{
            key: _either(_object(part), {"enum": ["none", None]}, f"none, or the parameters of {key}")
            for key, part in OPTIONAL_PARTS.items()
        },
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "plow_twin scene",
        **mapping(properties, ["version", *(key for key in SECTIONS if must_be_given(described[key]))]),
        "description": "a mapping with the sections of a scene",
    }


def _object(part: type, without: tuple[str, ...] = ()) -> Schema:
    specs = [spec for spec in fields(part) if spec.name not in without]
    return mapping({spec.name: _property(spec) for spec in specs}, [s.name for s in specs if must_be_given(s)])


def _property(spec: Field[Any]) -> Schema:
    if "unit" in spec.metadata:
        return _quantity(spec)
    if spec.default_factory is not MISSING:
        return _labels(spec)
    if "choices" in spec.metadata:
        return choice(spec.metadata["choices"])
    return {"type": "string", "minLength": 1, "description": "a name"}


def _quantity(spec: Field[Any]) -> Schema:
    expected = describe(spec)
    number: Schema = {"type": "number", "description": expected}
    number |= {keyword: spec.metadata[name] for name, keyword in _BOUNDS.items() if name in spec.metadata}
    if not isinstance(spec.default, tuple):
        return _markable(number)
    length = len(spec.default)
    plain = {"type": "array", "items": _markable(number), "minItems": length, "maxItems": length}
    return _markable({**plain, "description": f"a list of {length}: {expected}"})


def _markable(plain: Schema) -> Schema:
    deviation = {"type": "number", "minimum": 0.0}
    properties = {
        "value": plain,
        "mark": choice([mark.value for mark in Mark]),
        "source": TEXT,
        "deviation": {**deviation, "description": "a standard deviation in the unit of the value, at least 0"},
    }
    expected = f"a mapping with value, mark, source and deviation, value: {plain['description']}"
    marked = {**mapping(properties, ("value", "mark")), "description": expected}
    return _either(plain, marked, plain["description"])


def _either(first: Schema, second: Schema, expected: str) -> Schema:
    return {"anyOf": [first, second], "description": expected}


def _labels(spec: Field[Any]) -> Schema:
    return {
        "type": "object",
        "description": "a mapping from letters to corners",
        "additionalProperties": choice(spec.metadata["choices"]),
        "propertyNames": {"type": "string", "description": "a text as label"},
    }


def _name_list(spec: Field[Any]) -> Schema:
    choices = spec.metadata["choices"]
    return {"type": "array", "items": choice(choices), "description": f"a list of {', '.join(choices)}"}


def _load() -> Schema:
    at_m = _property(next(spec for spec in fields(Constant) if spec.name == "at_m"))
    kinds = {kind: _object(part, without=("name", "at_m")) for kind, part in LOAD_KINDS.items()}
    kinds["table"] = _table(kinds["table"])
    name = {"type": "string", "minLength": 1, "description": "a name"}
    return {
        **mapping({"name": name, **kinds, "at_m": at_m}, ("name",)),
        "description": f"a mapping with name, at_m and one of {', '.join(kinds)}",
        "oneOf": [{"required": [kind]} for kind in kinds],
    }


def _table(plain: Schema) -> Schema:
    """Return the schema of a load table: a file and its columns, or samples in the scene."""
    columns = {
        "type": "array",
        "items": {"type": "string", "description": "the name of a column"},
        "minItems": len(TABLE_COLUMNS),
        "maxItems": len(TABLE_COLUMNS),
        "description": "a list of 4 column names: time, Fx, Fy, M",
    }
    samples = {
        "t": {"type": "array", "description": "a list of times [s]"},
        "wrench": {"type": "array", "description": "a list of [Fx, Fy, M] [N, N, N m]"},
    }
    file = {"file": {"type": "string", "minLength": 1, "description": "the path of a csv file"}, "columns": columns}
    return {
        **mapping({**plain["properties"], **file, **samples}),
        "description": "a mapping with file (and columns), or with t and wrench",
        "oneOf": [{"required": ["file"]}, {"required": ["t", "wrench"]}],
    }
