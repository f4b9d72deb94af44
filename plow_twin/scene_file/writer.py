"""Conversion of a `Scene` to the text of a scene file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import OPTIONAL_PARTS, SCENE_VERSION, SECTIONS, Load, Provenance, Scene, Table
from plow_twin.scene_file.schema import LOAD_KINDS
from plow_twin.scene_file.yaml_text import dump_yaml


def dump_scene(scene: Scene) -> str:
    """Return a scene as self-contained YAML text. Reading the text gives a bit-identical scene.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    str
        The text, including tables and provenance marks.
    """
    raw: dict[str, Any] = {key: _plain(getattr(scene, key), key, scene.marks) for key in SECTIONS}
    raw["loads"] = [_plain_load(load, f"loads[{index}]", scene.marks) for index, load in enumerate(scene.loads)]
    raw["locked"] = list(scene.locked)
    raw["pairs"] = "all" if scene.pairs == PAIR_NAMES else list(scene.pairs)
    for key in OPTIONAL_PARTS:
        part = getattr(scene, key)
        raw[key] = "none" if part is None else _plain(part, key, scene.marks)
    sections = {spec.name: raw[spec.name] for spec in fields(Scene) if spec.name in raw}
    return dump_yaml({"version": SCENE_VERSION, **sections})


def _plain(part: Any, path: str, marks: Mapping[str, Provenance], without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a dataclass as plain lists, mappings and numbers with provenance marks."""
    plain: dict[str, Any] = {}
    for spec in fields(part):
        value = getattr(part, spec.name)
        if spec.name in without or value is None:
            continue
        if "unit" in spec.metadata:
            plain[spec.name] = _marked(value, f"{path}.{spec.name}", marks)
        elif spec.default_factory is not MISSING:
            plain[spec.name] = dict(value)
        else:
            plain[spec.name] = value
    return plain


def _marked(value: Any, path: str, marks: Mapping[str, Provenance]) -> Any:
    if isinstance(value, tuple | list | np.ndarray):
        plain: Any = [_marked(item, f"{path}[{index}]", marks) for index, item in enumerate(value)]
    else:
        plain = float(value)
    if path not in marks:
        return plain
    mark = marks[path]
    source = {"source": mark.source} if mark.source else {}
    deviation = {} if mark.deviation is None else {"deviation": mark.deviation}
    return {"value": plain, "mark": mark.mark.value} | deviation | source


def _plain_load(load: Load, path: str, marks: Mapping[str, Provenance]) -> dict[str, Any]:
    kind = next(kind for kind, part in LOAD_KINDS.items() if isinstance(load, part))
    if isinstance(load, Table):
        body: dict[str, Any] = {
            "hold": load.hold,
            "t": np.asarray(load.t, dtype=float).tolist(),
            "wrench": np.asarray(load.wrench, dtype=float).tolist(),
        }
    else:
        body = _plain(load, path, marks, without=("name", "at_m"))
    return {"name": load.name, kind: body, "at_m": _marked(load.at_m, f"{path}.at_m", marks)}
