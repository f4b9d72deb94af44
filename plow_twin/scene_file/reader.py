"""Conversion of a scene file to a `Scene`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from plow_twin.errors import Problem, SceneError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import (
    OPTIONAL_PARTS,
    SECTIONS,
    Clearance,
    Contact,
    Frame,
    Head,
    Load,
    Mark,
    Provenance,
    Scene,
    Table,
)
from plow_twin.scene_file.presets import PRESETS, scene_path
from plow_twin.scene_file.schema import LOAD_KINDS, scene_schema
from plow_twin.scene_file.table import read_table, sample_table
from plow_twin.scene_file.validation import validate
from plow_twin.scene_file.yaml_text import load_yaml, read_yaml

_SECTIONS: Final = "the sections of a scene"
#: Valid parts in place of parts with problems, so that a `Scene` can report conflicts between the other parts.
_SOUND: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "head": Head(1.0, 1.0),
        "frame": Frame(1.0, 1.0),
        "clearance": Clearance(0.0, 0.0),
        "contact": Contact("hertz", 1.0),
    }
)


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    path : str or Path
        Path of a YAML file, or the name of a preset such as paper. Paths of load tables are relative to the file.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        The file cannot be read or used. The error lists all problems.
    """
    path = scene_path(path)
    if not (path.suffix or path.exists()):
        problem = Problem("file", str(path), f"a scene file, or one of the presets {', '.join(PRESETS)}")
        return _scene(None, [problem], path.parent, str(path))
    return _scene(*read_yaml(path, "scene", _SECTIONS), path.parent, str(path))


def loads_scene(text: str, base: str | Path | None = ".", *, source: str = "scene") -> Scene:
    """Read a scene from YAML text.

    Parameters
    ----------
    text : str
        The scene as YAML.
    base : str or Path, optional
        Folder to which the paths of load tables are relative. With None, load tables in files are rejected.
    source : str
        Name of the scene in messages.

    Raises
    ------
    SceneError
        The scene cannot be used. The error lists all problems.
    """
    return _scene(*load_yaml(text, "scene", _SECTIONS), None if base is None else Path(base), source)


_schema = cache(scene_schema)


def _scene(raw: Any, problems: list[Problem], base: Path | None, source: str) -> Scene:
    """Convert a document to a scene, or raise a `SceneError` that lists all problems."""
    if raw is None and problems:
        raise SceneError(problems, source)
    problems += validate(raw, _schema(), "scene")
    bad = {problem.key.partition(".")[0] for problem in problems}
    marks: dict[str, Provenance] = {}
    parts = _read_parts(raw, bad, marks, base, problems) if isinstance(raw, dict) else {}
    if problems:
        raise SceneError([*problems, *_problems_across(parts)], source)
    try:
        return Scene(**parts, marks=MappingProxyType(marks))
    except SceneError as error:
        raise SceneError([_as_written(problem, raw) for problem in error.problems], source) from None


def _read_parts(
    raw: Mapping[str, Any], bad: set[str], marks: dict[str, Provenance], base: Path | None, problems: list[Problem]
) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for key, part in SECTIONS.items():
        if key in raw and key not in bad:
            parts[key] = part(**_arguments(part, raw[key], key, marks))
    if "loads" in raw and "loads" not in bad:
        parts["loads"] = tuple(_read_loads(raw["loads"], bad, marks, base, problems))
    if "locked" in raw and not any(key.startswith("locked") for key in bad):
        parts["locked"] = tuple(raw["locked"])
    if "pairs" in raw and not any(key.startswith("pairs") for key in bad):
        parts["pairs"] = PAIR_NAMES if raw["pairs"] == "all" else tuple(raw["pairs"])
    for key, part in OPTIONAL_PARTS.items():
        if isinstance(raw.get(key), dict) and key not in bad:
            parts[key] = part(**_arguments(part, raw[key], key, marks))
    return parts


def _arguments(part: type, raw: Mapping[str, Any], path: str, marks: dict[str, Provenance]) -> dict[str, Any]:
    """Return the keyword arguments of a dataclass. The marks of its numbers are added to `marks`."""
    specs = {spec.name: spec for spec in fields(part)}
    return {
        key: _number(value, f"{path}.{key}", marks) if "unit" in specs[key].metadata else value
        for key, value in raw.items()
    }


def _number(raw: Any, path: str, marks: dict[str, Provenance]) -> float | tuple[float, ...]:
    if isinstance(raw, dict):
        deviation = float(raw["deviation"]) if "deviation" in raw else None
        marks[path] = Provenance(Mark(raw["mark"]), raw.get("source", ""), deviation)
        raw = raw["value"]
    if isinstance(raw, list):
        return tuple(float(_number(item, f"{path}[{index}]", marks)) for index, item in enumerate(raw))  # type: ignore[arg-type]
    return float(raw)


def _read_loads(
    raw: list[dict[str, Any]], bad: set[str], marks: dict[str, Provenance], base: Path | None, problems: list[Problem]
) -> Iterator[Load]:
    for index, item in enumerate(raw):
        path = f"loads[{index}]"
        if path in bad:
            continue
        kind = next(kind for kind in LOAD_KINDS if kind in item)
        shared = {"name": item["name"]}
        if "at_m" in item:
            shared["at_m"] = _number(item["at_m"], f"{path}.at_m", marks)
        if kind != "table":
            part = LOAD_KINDS[kind]
            yield part(**shared, **_arguments(part, item[kind], path, marks))
            continue
        try:
            t, wrench = _samples(item["table"], f"{path}.table", base)
        except SceneError as error:
            problems += error.problems
        else:
            hold = {"hold": item["table"]["hold"]} if "hold" in item["table"] else {}
            yield Table(**shared, t=t, wrench=wrench, **hold)


def _samples(raw: Mapping[str, Any], path: str, base: Path | None) -> tuple[Any, Any]:
    if "file" in raw:
        if base is None:
            raise SceneError([Problem(f"{path}.file", raw["file"], "the rows of the table instead of a file")])
        return read_table(base / raw["file"], raw.get("columns"), f"{path}.file")
    return sample_table(raw["t"], raw["wrench"], path)


def _problems_across(parts: Mapping[str, Any]) -> tuple[Problem, ...]:
    try:
        Scene(**{**_SOUND, **parts})
    except SceneError as error:
        return error.problems
    return ()


def _as_written(problem: Problem, raw: Mapping[str, Any]) -> Problem:
    """Return the problem with the key as it stands in the file, which has the kind of a load before its numbers."""
    head, _, rest = problem.key.partition("].")
    index = head.removeprefix("loads[")
    if index == head or not index.isdigit() or rest.startswith(("name", "at_m")):
        return problem
    kind = next(kind for kind in LOAD_KINDS if kind in raw["loads"][int(index)])
    return Problem(f"{head}].{kind}.{rest}", problem.got, problem.expected)
