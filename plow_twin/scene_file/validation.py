"""Validation of plain data with a JSON schema.

An error message names the key, the actual value and the expected value. The expected value is the `description` in the
schema.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from itertools import islice
from typing import Any, Final, cast

from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError
from jsonschema.protocols import Validator
from jsonschema.validators import extend

from plow_twin.errors import Problem

Schema = dict[str, Any]

TEXT: Final[Schema] = {"type": "string", "description": "a text"}
NUMBER: Final[Schema] = {"type": "number", "description": "a finite number"}


def mapping(properties: Mapping[str, Schema], required: Sequence[str] = ()) -> Schema:
    """Return the schema of a mapping that has no keys other than the keys of `properties`."""
    return {
        "type": "object",
        "properties": dict(properties),
        "required": list(required),
        "additionalProperties": False,
        "description": f"a mapping with {', '.join(properties)}",
    }


def choice(choices: Sequence[str]) -> Schema:
    """Return the schema of a text that is one of `choices`."""
    return {"enum": list(choices), "description": f"one of {', '.join(choices)}"}


class _Shown:
    """Text that replaces a value in a message."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


#: Replacement for the value of a missing key.
NOTHING: Final = _Shown("nothing")
#: Largest length of a value or a name in a message, in characters.
_LONGEST: Final = 200
#: Largest number of reported problems.
MOST_PROBLEMS: Final = 50


def validate(raw: Any, schema: Schema, name: str) -> list[Problem]:
    """Return the problems of plain data in the order of the schema. Messages call the data `name`."""
    problems = (problem for error in _validator()(schema).iter_errors(raw) for problem in _explain(error, name))
    # if n keys are missing, `_explain` yields each of them n times
    unique: dict[str, Problem] = {}
    for problem in islice(map(_brief, problems), 2 * MOST_PROBLEMS):
        unique[str(problem)] = problem
    return list(unique.values())[:MOST_PROBLEMS]


@cache
def _validator() -> Callable[[Schema], Validator]:
    """Return a validator for which NaN, infinity and integers beyond float64 are no numbers, and 1.0 is no integer."""
    checker = Draft202012Validator.TYPE_CHECKER.redefine_many(
        {
            "number": lambda _, value: is_number(value),
            "integer": lambda _, value: isinstance(value, int) and not isinstance(value, bool),
            "array": lambda _, value: isinstance(value, list | tuple),
        }
    )
    return cast("Callable[[Schema], Validator]", extend(Draft202012Validator, type_checker=checker))  # type: ignore[no-untyped-call]


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number within the range of float64."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _explain(error: ValidationError, whole: str) -> Iterator[Problem]:
    key, instance = _key(error.absolute_path), cast(Any, error.instance)
    schema = cast(Schema, error.schema)
    if error.validator == "required":
        for name in schema["required"]:
            if name not in instance:
                yield Problem(_join(key, name), NOTHING, schema["properties"][name]["description"])
    elif error.validator == "additionalProperties":
        yield from _unknown_keys(key, instance, schema["properties"])
    elif error.validator == "propertyNames":
        yield from (
            Problem(_join(key, name), name, "a text as label") for name in instance if not isinstance(name, str)
        )
    elif error.validator == "anyOf":
        yield from _closest_branch(key or whole, error, whole)
    elif error.validator == "oneOf":
        if isinstance(instance, dict):  # for a value of another type, jsonschema reports a separate error
            yield Problem(key or whole, sorted(map(str, instance)), schema["description"])
    else:
        yield Problem(key or whole, instance, schema.get("description", error.message))


def _closest_branch(key: str, error: ValidationError, whole: str) -> Iterator[Problem]:
    """Yield the problems of the `anyOf` branch for the type of the value, or one problem of the key."""
    branches: dict[Any, list[ValidationError]] = {}
    for inner in error.context or ():
        branches.setdefault(inner.schema_path[0], []).append(inner)
    for errors in branches.values():
        if not any(not inner.relative_path and _is_misfit(inner) for inner in errors):
            for inner in errors:
                yield from _explain(inner, whole)
            return
    yield Problem(key, error.instance, cast(Schema, error.schema)["description"])


def _is_misfit(error: ValidationError) -> bool:
    """Return whether the type or the keys of a value do not fit the `anyOf` branch of an error."""
    keys_alone = error.validator == "required" and "properties" not in cast(Schema, error.schema)
    return keys_alone or error.validator in ("type", "const", "enum")


def _brief(problem: Problem) -> Problem:
    """Replace a value that is too long to print by a description."""
    got = problem.got
    if isinstance(got, list | tuple | dict) and len(repr(got)) > _LONGEST:
        shown = _Shown(f"a {'mapping' if isinstance(got, dict) else 'list'} of {len(got)}")
    elif isinstance(got, str) and len(got) > _LONGEST:
        shown = _Shown(f"{got[:_LONGEST]!r}... ({len(got)} characters)")
    else:
        return problem
    return Problem(problem.key, shown, problem.expected)


def _unknown_keys(key: str, instance: dict[Any, Any], properties: Schema) -> Iterator[Problem]:
    for name in instance:
        if name not in properties:
            near = get_close_matches(str(name)[:_LONGEST], properties, n=1, cutoff=0.5)
            expected = f"a known key; did you mean {near[0]}?" if near else f"a known key: {', '.join(properties)}"
            yield Problem(_join(key, name), instance[name], expected)


def _join(key: str, name: Any) -> str:
    name = str(name)[:_LONGEST]
    return f"{key}.{name}" if key else name


def _key(path: Iterable[Any]) -> str:
    key = ""
    for step in path:
        key = f"{key}[{step}]" if isinstance(step, int) else _join(key, step)
    return key
