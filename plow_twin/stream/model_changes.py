"""Changes of a scene's numbers while its twin runs, limited to numbers that need no new compiled code."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from plow_twin.errors import ArgumentError
from plow_twin.model.scene import Scene
from plow_twin.stream.driven import Driven

#: Smallest value of each number that can change, by its key in the scene file.
CHANGEABLE: Final[Mapping[str, float]] = {
    "clearance.horizontal_m": 0.0,
    "clearance.vertical_m": 0.0,
    "contact.stiffness": math.ulp(0.0),
    "contact.damping": 0.0,
    "contact.restitution": 0.0,
    "wear.coefficient_m2_n": 0.0,
}


def changed_scene(scene: Scene, changes: Mapping[str, float]) -> Scene:
    """Return the scene with the numbers in `changes` replaced.

    Raise `ArgumentError` if a key is not in `CHANGEABLE`, or a number is not allowed in the scene.
    """
    for key, value in changes.items():
        if key not in CHANGEABLE:
            raise ArgumentError(f"{key}: got a change, expected one of {', '.join(CHANGEABLE)}")
        section, _, name = key.partition(".")
        part = getattr(scene, section)
        if part is None or getattr(part, name) is None:
            raise ArgumentError(f"{key}: got {value!r}, but the scene has no {name if part else section}")
        if not (math.isfinite(value) and value >= CHANGEABLE[key]):
            raise ArgumentError(f"{key}: got {value!r}, expected a finite number >= {CHANGEABLE[key]:.3g}")
        try:
            scene = replace(scene, **{section: replace(part, **{name: value})})
        except ValueError as error:
            raise ArgumentError(f"{key}: got {value!r}: {error}") from error
    return scene


def changed_twin(twin: Driven, scene: Scene, changes: Mapping[str, float]) -> Driven:
    """Return a twin of the changed scene, in the initial state of the scene and with the settings of `twin`.

    Raise `ArgumentError` as `changed_scene` does, or if the changed scene needs new compiled code. A live twin has no
    time to compile.
    """
    twin_changed = twin.like(changed_scene(scene, changes))
    if twin_changed.signature != twin.signature:
        raise ArgumentError(
            f"{', '.join(changes)}: got {', '.join(map(repr, changes.values()))}, which adds or removes a "
            "term of the equations, expected a change of numbers only: configure the node again"
        )
    return twin_changed


def read_changes(text: str) -> dict[str, float]:
    """Return the changes, by key of the scene file, from their JSON text.

    Raise `ArgumentError` if the text is not a JSON object of numbers.
    """
    try:
        found = json.loads(text)
        return {str(key): float(value) for key, value in found.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ArgumentError(f"changes: got {text[:80]!r}, expected numbers by key of the scene file") from error
