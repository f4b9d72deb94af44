"""Constant facts about a machine for the page: cross-section, pads, and thresholds of the alarms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plow_twin.model.pairs import CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y, PAIR_NAMES, corner_of
from plow_twin.model.scene import Scene
from plow_twin.record.alarms import alarms_of


def facts_of(scene: Scene, parameters: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the facts about a machine that the page shows: the scene, and thresholds of alarms from `parameters`.

    `source` is a description of the origin of the samples.
    """
    places = zip(PAIR_NAMES, CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y, strict=True)
    return {
        "scene": Path(str(parameters.get("scene", ""))).name,
        "head": str(parameters.get("hardware_id", "")),
        "source": source,
        "frame": [scene.frame.width_m, scene.frame.height_m],
        "clearance": [scene.clearance.horizontal_m, scene.clearance.vertical_m],
        "pads": [
            {"name": name, "corner": scene.frame.letters.get(corner_of(pair), ""), "at": [x, y], "normal": [nx, ny]}
            for pair, (name, x, y, nx, ny) in enumerate(places)
        ],
        "thresholds": {
            name: [alarm.thresholds.warn, alarm.thresholds.error]
            for name, alarm in alarms_of(parameters).alarms.items()
        },
        "limits": list(parameters.get("forecast_limits", (0.0, 0.0))),
        "loads": parameters.get("excitation_source", "excitation") != "scene",
    }
