"""Unknowns of a calibration: the map between the unit cube and the values of parameters.

A *place* is a coordinate 0..1 in the cube.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.study.parameters import (
    WORDS,
    StudyError,
    Value,
    check_path,
    check_word,
    parameter_of,
    usable_scenes,
    with_parameters,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Unknown:
    """An unknown: a number from `low` to `high`, or one of `choices`.

    With `log`, the logarithm is distributed uniformly.
    """

    path: str
    low: float = 0.0
    high: float = 1.0
    log: bool = False
    choices: tuple[Value, ...] = ()

    def value(self, place: float) -> Value:
        """Return the value at a place."""
        if self.choices:
            return self.choices[min(int(place * len(self.choices)), len(self.choices) - 1)]
        if self.log:
            return float(self.low * (self.high / self.low) ** place)
        return float(self.low + (self.high - self.low) * place)

    def place(self, value: Value) -> float:
        """Return the place of a value.

        Each choice has an equal share of 0..1, and its place is the middle of the share.
        """
        if self.choices:
            return (self.choices.index(value) + 0.5) / len(self.choices)
        number = float(value)
        share = (
            math.log(number / self.low) / math.log(self.high / self.low)
            if self.log
            else (number - self.low) / (self.high - self.low)
        )
        return min(max(share, 0.0), 1.0)


def parse_unknown(text: str, scene: Scene) -> Unknown:
    """Parse `PATH=LOW:HIGH[:log]`, `PATH=CHOICE,CHOICE..`, or `PATH` for a sign; raise a `StudyError` otherwise."""
    path, equals, rest = text.partition("=")
    check_path(scene, path)
    if not equals:
        if not path.endswith("sign"):
            raise StudyError(f"unknown {path}: got no range, expected {path}=LOW:HIGH[:log] or {path}=CHOICE,CHOICE")
        return Unknown(path, choices=(1.0, -1.0))
    if ":" not in rest:
        items = [item.strip() for item in rest.split(",") if item.strip()]
        choices: tuple[Value, ...] = tuple((check_word if path in WORDS else _number)(path, item) for item in items)
        if len(set(choices)) < 2:
            either = "" if path in WORDS else "LOW:HIGH[:log] or "
            raise StudyError(f"unknown {path}: got {rest!r}, expected {either}at least two choices")
        return Unknown(path, choices=choices)
    low, high, *scale = rest.split(":")
    bounds = _number(path, low), _number(path, high)
    if not bounds[0] < bounds[1] or scale not in ([], ["log"], ["lin"]) or (scale == ["log"] and bounds[0] <= 0.0):
        raise StudyError(
            f"unknown {path}: got {rest!r}, expected LOW:HIGH or LOW:HIGH:log with LOW < HIGH (log: LOW > 0)"
        )
    return Unknown(path, *bounds, log=scale == ["log"])


def _number(path: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise StudyError(f"{path}: got {text!r}, expected a finite number")
    return number


@dataclass(frozen=True)
class Space:
    """The unit cube, with one dimension for each unknown."""

    unknowns: tuple[Unknown, ...]

    def __post_init__(self) -> None:
        paths = [unknown.path for unknown in self.unknowns]
        if not paths or len(set(paths)) < len(paths):
            raise StudyError(f"unknowns: got {paths}, expected at least one, each parameter once")

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.unknowns)

    @property
    def continuous(self) -> NDArray[np.int64]:
        """Indexes of the unknowns that have a range."""
        return np.array([i for i, unknown in enumerate(self.unknowns) if not unknown.choices], dtype=np.int64)

    def values(self, point: Array) -> dict[str, Value]:
        """Return the values of the unknowns at a point, shape (n,)."""
        return {u.path: u.value(float(place)) for u, place in zip(self.unknowns, point, strict=True)}

    def values_of(self, points: Array) -> list[dict[str, Value]]:
        """Return the values of the unknowns at m points, shape (m, n)."""
        return [self.values(point) for point in points]

    def point(self, scene: Scene) -> Array | None:
        """Return the point of a scene, or None if one of its values is outside the range of the unknown."""
        places = []
        for unknown in self.unknowns:
            value = parameter_of(scene, unknown.path)
            within = isinstance(value, float) and unknown.low <= value <= unknown.high
            inside = value in unknown.choices if unknown.choices else within
            if value is None or not inside:
                return None
            places.append(unknown.place(value))
        return np.array(places)

    def settled(self, point: Array) -> Array:
        """Return the point with the place of each choice in the middle of its share."""
        places = zip(self.unknowns, point, strict=True)
        return np.array([u.place(u.value(float(x))) if u.choices else float(x) for u, x in places])


def check_usable(space: Space, scene: Scene) -> None:
    """Raise a `SceneError` if none of 100 random points gives a usable scene."""
    points = np.random.default_rng(0).random((100, space.size))
    if not usable_scenes(scene, space.values_of(points))[0]:
        with_parameters(scene, space.values(points[0]))
