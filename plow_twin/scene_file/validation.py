"""Check of a scene's plain data against its schema, with messages for people: key, value got, value expected."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from functools import cache
from typing import Any, Final, cast

from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError
from jsonschema.protocols import Validator
from jsonschema.validators import extend

from plow_twin.errors import Problem
from plow_twin.scene_file.schema import scene_schema


class _Nothing:
    """The value of a key that is missing."""

    def __repr__(self) -> str:
        return "nothing"


class _Long:
    """A value too long to print."""

    def __init__(self, value: list[Any] | dict[Any, Any]) -> None:
        self.text = f"a {'list' if isinstance(value, list) else 'mapping'} of {len(value)}"

    def __repr__(self) -> str:
        return self.text


NOTHING: Final = _Nothing()
_LONGEST_VALUE: Final = 200


def validate(raw: Any) -> list[Problem]:
    """Return every problem of a scene's plain data, in the order of the schema."""
    problems = (problem for error in _validator().iter_errors(raw) for problem in _explain(error))
    # jsonschema reports a mapping once for each key that it misses
    return list({str(problem): _brief(problem) for problem in problems}.values())


@cache
def _validator() -> Validator:
    checker = Draft202012Validator.TYPE_CHECKER.redefine("number", lambda _, value: _is_number(value))
    validator: Validator = extend(Draft202012Validator, type_checker=checker)(scene_schema())  # type: ignore[no-untyped-call]
    return validator


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def _explain(error: ValidationError) -> Iterator[Problem]:
    key, instance = _key(error.absolute_path), cast(Any, error.instance)
    schema = cast(dict[str, Any], error.schema)
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
        yield from _closest_branch(key, error)
    elif error.validator == "oneOf":
        yield Problem(key, sorted(map(str, instance)), schema["description"])
    else:
        yield Problem(key or "scene", instance, schema.get("description", error.message))


def _closest_branch(key: str, error: ValidationError) -> Iterator[Problem]:
    """Explain the branch whose type fits the value; when none fits, what the key takes at all."""
    branches: dict[Any, list[ValidationError]] = {}
    for inner in error.context or ():
        branches.setdefault(inner.schema_path[0], []).append(inner)
    for errors in branches.values():
        misfit = any(not inner.relative_path and inner.validator in ("type", "const", "enum") for inner in errors)
        if not misfit:
            for inner in errors:
                yield from _explain(inner)
            return
    yield Problem(key, error.instance, cast(dict[str, Any], error.schema)["description"])


def _brief(problem: Problem) -> Problem:
    """Say of a long value only what it is."""
    if isinstance(problem.got, list | dict) and len(repr(problem.got)) > _LONGEST_VALUE:
        return Problem(problem.key, _Long(problem.got), problem.expected)
    return problem


def _unknown_keys(key: str, instance: dict[Any, Any], known: dict[str, Any]) -> Iterator[Problem]:
    for name in instance:
        if name not in known:
            near = get_close_matches(str(name), known, n=1, cutoff=0.5)
            expected = f"a known key, nearest is {near[0]}" if near else f"a known key: {', '.join(known)}"
            yield Problem(_join(key, name), instance[name], expected)


def _join(key: str, name: Any) -> str:
    return f"{key}.{name}" if key else str(name)


def _key(path: Iterable[Any]) -> str:
    key = ""
    for step in path:
        key = f"{key}[{step}]" if isinstance(step, int) else _join(key, step)
    return key
