"""A folder with what was measured: scene.yaml, load.csv (t, fx, fy, m) and pose.csv (t, x, y, theta)."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.scene import Scene
from plow_twin.scene_file import load_scene

Array = NDArray[np.float64]

SCENE_FILE, LOAD_FILE, POSE_FILE = "scene.yaml", "load.csv", "pose.csv"
_LOAD_COLUMNS: Final = ("t", "fx", "fy", "m")
_POSE_COLUMNS: Final = ("t", "x", "y", "theta")


@dataclass(frozen=True, eq=False)
class Measured:
    """What a folder holds.

    load : (n, 4) t [s], Fx, Fy [N], M [N m] believed; poses : (k, 4) t [s], x, y [m], theta [rad], NaN where a cell is
    empty; unreadable : rows that are not numbers.
    """

    scene: Scene
    load: Array
    poses: Array
    unreadable: int


def read_measured(folder: Path, scene: Path | None = None) -> Measured:
    """Read a folder; `scene` takes the place of its scene.yaml.

    Raises
    ------
    RecordingError
        When a file or a column is missing.
    SceneError
        When the scene cannot be used.
    """
    load, bad_load = _read(folder / LOAD_FILE, _LOAD_COLUMNS)
    poses, bad_poses = _read(folder / POSE_FILE, _POSE_COLUMNS)
    return Measured(load_scene(scene or folder / SCENE_FILE), load, poses, bad_load + bad_poses)


def _read(path: Path, columns: tuple[str, ...]) -> tuple[Array, int]:
    """Return the rows of a csv file, NaN for an empty cell, and how many could not be read."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise RecordingError(f"{path}: {reason}") from None
    header = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in columns if name not in header]
    if missing:
        raise RecordingError(f"{path}: got the columns {', '.join(header)}, expected {', '.join(columns)}")
    places = [header.index(name) for name in columns]
    found, bad = [], 0
    for row in rows[1:]:
        numbers = [_number(row[place]) if place < len(row) else math.nan for place in places]
        if None in numbers:
            bad += 1
        else:
            found.append(numbers)
    return np.array(found, dtype=float).reshape(-1, len(columns)), bad


def _number(cell: str) -> float | None:
    if not cell.strip():
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return None
