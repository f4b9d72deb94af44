"""Parameters of a scene, named by paths such as `contact.stiffness` and `head.com_offset_m[0]`.

A parameter is a number or a word. The path of a load's parameter contains the name of the load: `loads.fx1.phase_rad`.
Four paths are no fields of a scene; they are applied after all other parameters:

    loads.<name>.sign       sign of the first non-zero component of the load's force; -1 reverses the force
    loads.<name>.arm_sign   sign of the first non-zero coordinate of the point of action; -1 reverses both coordinates
    loads.<name>.scale      factor of the load's force and free moment
    clearance.scale         factor of both clearances: 1 for a total, 2 for a published clearance per side

The path `frame.labels` takes one of eight words: `bottom_right_ccw` puts corner a at the bottom right, with b, c and d
counter-clockwise from a. Damping and restitution replace each other. A path of `friction` switches friction on.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, Final

from plow_twin.errors import PlowTwinError, Problem, SceneError
from plow_twin.model.contact_laws import LAWS
from plow_twin.model.scene import PARTS, Friction, Head, Scene, Table

#: Value of a parameter: a word for the paths in `WORDS`, a number for all other paths.
Value = float | str

WORDS: Final = ("contact.law", "head.rotation", "frame.labels")
_CORNERS_CCW: Final = ("bottom_right", "top_right", "top_left", "bottom_left")
_DERIVED: Final = ("sign", "arm_sign", "scale")
#: Initial friction of a study that varies the friction of a scene without friction.
_NO_FRICTION: Final = Friction(0.0)
#: Length to which a text is cut before the search for similar paths, which is slow for long texts [characters].
_LONGEST: Final = 100
_INDEX: Final = re.compile(r"(.+)\[(\d+)\]")


class StudyError(PlowTwinError, ValueError):
    """A study cannot be run or continued as requested."""


def parameter_paths(scene: Scene) -> tuple[str, ...]:
    """Return every path that a study can set in the scene."""
    paths: list[str] = []
    for name in PARTS:
        part = _part(scene, name)
        paths += [] if part is None else _paths_of(part, name)
    paths += ["clearance.scale", "frame.labels"]
    for load in scene.loads:
        if not isinstance(load, Table):
            paths += _paths_of(load, f"loads.{load.name}")
        paths += [f"loads.{load.name}.{name}" for name in _DERIVED]
    return tuple(paths)


def _part(scene: Scene, name: str) -> Any:
    part = getattr(scene, name)
    return _NO_FRICTION if part is None and name == "friction" else part


def _paths_of(part: Any, path: str) -> list[str]:
    paths = []
    for spec in fields(part):
        value = getattr(part, spec.name)
        if isinstance(value, tuple) and "unit" in spec.metadata:
            paths += [f"{path}.{spec.name}[{index}]" for index in range(len(value))]
        elif "unit" in spec.metadata or spec.name in ("law", "rotation"):
            paths.append(f"{path}.{spec.name}")
    return paths


def check_path(scene: Scene, path: str) -> str:
    """Return the path if the scene has it; otherwise raise a `StudyError` with the nearest paths."""
    paths = parameter_paths(scene)
    if path not in paths:
        near = ", ".join(get_close_matches(path[:_LONGEST], paths, n=3, cutoff=0.0))
        raise StudyError(f"parameter: got {path!r:.200}; nearest: {near} (plow-twin info SCENE shows all numbers)")
    return path


def nearest_of(path: str, paths: Iterable[str]) -> str:
    """Return a hint with the most similar known paths, or an empty text if no path is similar."""
    near = get_close_matches(path, paths, n=3, cutoff=0.6)
    return f"; nearest: {', '.join(near)}" if near else ""


def parameter_of(scene: Scene, path: str) -> Value | None:
    """Return the value at a path, or None for a damping or restitution that the scene does not give."""
    check_path(scene, path)
    if path == "frame.labels":
        return next((word for word, labels in _label_words().items() if labels == dict(scene.frame.labels)), None)
    part, field_name = path.rsplit(".", 1)
    if path == "clearance.scale" or field_name == "scale":
        return 1.0
    owner = _load(scene, part) if part.startswith("loads.") else _part(scene, part)
    if field_name in ("sign", "arm_sign"):
        vector = _vector(owner, field_name)
        return -1.0 if next((x for x in vector if x != 0.0), 1.0) < 0.0 else 1.0
    name, index = _split(field_name)
    value = getattr(owner, name)
    number = value if index is None else value[index]
    return number if number is None or isinstance(number, str) else float(number)


def with_parameters(scene: Scene, values: Mapping[str, Value]) -> Scene:
    """Return the scene with new values. The mark of each changed number is removed.

    Raise `StudyError` if the scene does not have a path, or a value is of the wrong kind, and `SceneError` if the scene
    cannot be used with these values; the error lists every problem.
    """
    paths = parameter_paths(scene)
    for path, value in values.items():
        if path not in paths:
            check_path(scene, path)
        words = path in WORDS
        if words != isinstance(value, str):
            raise StudyError(f"{path}: got {value!r}, expected a {'word' if words else 'number'}")
    parts: dict[str, Any] = {name: getattr(scene, name) for name in PARTS}
    loads = {load.name: load for load in scene.loads}
    # signs and scales are applied last, to the new values of the other parameters
    for path, value in sorted(values.items(), key=lambda item: item[0].rsplit(".", 1)[1] in _DERIVED):
        owner, field_name = path.rsplit(".", 1)
        if path == "frame.labels":
            parts["frame"] = _labelled(parts["frame"], str(value))
        elif path == "clearance.scale":
            gaps, factor = parts["clearance"], float(value)
            scaled = {name: factor * getattr(gaps, name) for name in ("horizontal_m", "vertical_m")}
            parts["clearance"] = replace(gaps, **scaled)
        elif owner.startswith("loads."):
            name = owner.removeprefix("loads.")
            loads[name] = _load_with(loads[name], field_name, value)
        else:
            parts[owner] = _with(parts[owner] or _NO_FRICTION, field_name, value)
    marks = {key: mark for key, mark in scene.marks.items() if not _is_set(key, values, scene)}
    return replace(scene, **parts, loads=tuple(loads.values()), marks=MappingProxyType(marks))


def _label_words() -> dict[str, dict[str, str]]:
    """Return the eight assignments of letters to corners, each named by a word such as `bottom_right_ccw`."""
    words = {}
    for turn, corners in (("ccw", _CORNERS_CCW), ("cw", _CORNERS_CCW[::-1])):
        for first in range(4):
            order = corners[first:] + corners[:first]
            words[f"{order[0]}_{turn}"] = dict(zip("abcd", order, strict=True))
    return words


def check_word(path: str, word: str) -> str:
    """Return the word if it is a valid value of `path`, a member of `WORDS`; otherwise raise a `StudyError`."""
    (rotation,) = (spec for spec in fields(Head) if spec.name == "rotation")
    words = {"contact.law": LAWS, "head.rotation": rotation.metadata["choices"], "frame.labels": _label_words()}[path]
    if word not in words:
        raise StudyError(f"{path}: got {word!r}, expected one of {', '.join(words)}")
    return word


def usable_scenes(scene: Scene, candidates: Iterable[Mapping[str, Value]]) -> tuple[list[Scene], list[int]]:
    """Return the scenes of the candidates that can be run, and the indices of these candidates."""
    scenes, places = [], []
    for place, values in enumerate(candidates):
        try:
            scenes.append(with_parameters(scene, values))
        except SceneError:
            continue
        places.append(place)
    return scenes, places


def _labelled(frame: Any, word: str) -> Any:
    words = _label_words()
    if word not in words:
        raise SceneError([Problem("frame.labels", word, f"one of {', '.join(words)}")])
    return replace(frame, labels=words[word])


def _with(part: Any, field_name: str, value: Value) -> Any:
    name, index = _split(field_name)
    if index is not None:
        items = list(getattr(part, name))
        items[index] = float(value)
        return replace(part, **{name: tuple(items)})
    new: dict[str, Any] = {name: value if isinstance(value, str) else float(value)}
    if name in ("damping", "restitution"):
        new["restitution" if name == "damping" else "damping"] = None
    return replace(part, **new)


def _load_with(load: Any, field_name: str, value: Value) -> Any:
    if field_name not in _DERIVED:
        return _with(load, field_name, value)
    number = float(value)
    if field_name == "scale":
        if isinstance(load, Table):
            return replace(load, wrench=number * load.wrench)
        return replace(load, force_n=_times(load.force_n, number), moment_n_m=number * load.moment_n_m)
    if number not in (-1.0, 1.0):
        raise SceneError([Problem(f"loads.{load.name}.{field_name}", value, "1 or -1")])
    first = next((x for x in _vector(load, field_name) if x != 0.0), 1.0)
    if first * number > 0.0:
        return load
    if field_name == "arm_sign":
        return replace(load, at_m=_times(load.at_m, -1.0))
    if isinstance(load, Table):
        return replace(load, wrench=-load.wrench)
    return replace(load, force_n=_times(load.force_n, -1.0))


def _vector(load: Any, field_name: str) -> tuple[float, ...]:
    if field_name == "arm_sign":
        return tuple(load.at_m)
    if isinstance(load, Table):
        # the sign of a table is the sign of its largest force component
        return (float(load.wrench[:, :2].flat[abs(load.wrench[:, :2]).argmax()]),)
    return tuple(load.force_n)


def _times(vector: tuple[float, ...], factor: float) -> tuple[float, ...]:
    # -0 is replaced by +0, so that two equal scenes give equal files
    return tuple(factor * x if x != 0.0 else 0.0 for x in vector)


def _split(field_name: str) -> tuple[str, int | None]:
    match = _INDEX.fullmatch(field_name)
    return (match[1], int(match[2])) if match else (field_name, None)


def _load(scene: Scene, owner: str) -> Any:
    name = owner.removeprefix("loads.")
    return next(load for load in scene.loads if load.name == name)


def _is_set(key: str, values: Mapping[str, Value], scene: Scene) -> bool:
    """Return whether the values change the number at a key of `Scene.marks`."""
    match = re.match(r"loads\[(\d+)\]\.(.+)", key)
    path = f"loads.{scene.loads[int(match[1])].name}.{match[2]}" if match else key
    whole = path.partition("[")[0]
    owner, field_name = whole.rsplit(".", 1)
    derived = {
        "sign": field_name == "force_n",
        "arm_sign": field_name == "at_m",
        "scale": field_name in ("force_n", "moment_n_m", "horizontal_m", "vertical_m"),
    }
    return any(
        path == other or (whole == other.partition("[")[0] and "[" not in path)
        or any(other == f"{owner}.{name}" and touched for name, touched in derived.items())
        for other in values
    )  # fmt: skip


def parse_settings(scene: Scene, texts: Sequence[str]) -> dict[str, Value]:
    """Read `PATH=VALUE` texts, or raise a `StudyError` that names the setting."""
    values: dict[str, Value] = {}
    for text in texts:
        path, _, rest = text.partition("=")
        check_path(scene, path)
        try:
            values[path] = check_word(path, rest) if path in WORDS else float(rest)
        except ValueError:
            raise StudyError(f"{path}: got {rest!r}, expected a number") from None
    return values
