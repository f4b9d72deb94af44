"""Writing of a `Scene` as the text of a scene file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any, Final

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import OPTIONAL_PARTS, SCENE_VERSION, Load, Provenance, Scene, Table
from plow_twin.scene_file.schema import LOAD_KINDS, SECTIONS
from plow_twin.scene_file.yaml_text import dump_yaml

#: The sections of a scene file, in the order in which they are written.
_ORDER: Final = (
    "version",
    "head",
    "frame",
    "clearance",
    "contact",
    "gravity",
    "loads",
    "initial",
    "locked",
    "pairs",
    "wear",
    "friction",
    "support",
)


def dump_scene(scene: Scene) -> str:
    """Return a scene as YAML text that needs no other file; reading the text gives an equal scene, bit for bit.

    Parameters
    ----------
    scene : Scene
        The scene; its tables are written into the text.

    Returns
    -------
    str
        The text, including the provenance marks.
    """
    raw: dict[str, Any] = {"version": SCENE_VERSION}
    for key in SECTIONS:
        raw[key] = _plain(getattr(scene, key), key, scene.marks)
    raw["loads"] = [_plain_load(load, f"loads[{index}]", scene.marks) for index, load in enumerate(scene.loads)]
    raw["locked"] = list(scene.locked)
    raw["pairs"] = "all" if scene.pairs == PAIR_NAMES else list(scene.pairs)
    for key in OPTIONAL_PARTS:
        part = getattr(scene, key)
        raw[key] = "none" if part is None else _plain(part, key, scene.marks)
    return dump_yaml({key: raw[key] for key in _ORDER})


def _plain(part: Any, path: str, marks: Mapping[str, Provenance], without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a dataclass as plain lists, mappings and numbers, with the provenance marks put back."""
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
