"""Targets of a calibration: published figures, orders and trends, read from YAML.

Each target gives one residual r of a candidate. A target that is met exactly has r = 0:

    value              r = (s - value) / (tolerance |value|)                            met if |r| <= 1
    at_least           r = max(0, at_least - s) / scale                                 met if r = 0
    at_most            r = max(0, s - at_most) / scale                                  met if r = 0
    above              r = max(0, largest - s) / (tolerance |largest|)                  met if r = 0
    trend              r = (sum of wrong steps + missing change) / (tolerance mean)     met if r = 0

Here s is the statistic of the target. If a target names several statistics, s is the smallest of them. The run of a
target has the parameters `set`. In `above`, `largest` is the largest of the statistics with which s is compared. A
trend is judged over a sequence of runs along one parameter: wrong steps go against the trend, and the required change
is `margin` times the mean. In `rises_then_falls`, rise and fall must each reach the required change. The turning point
is the point with the smallest violation. The objective is the sum of weight times r^2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Mark, Scene
from plow_twin.scene_file.validation import NUMBER, TEXT, Schema, choice, mapping, validate
from plow_twin.scene_file.yaml_text import read_yaml
from plow_twin.study.parameters import StudyError, Value, check_path
from plow_twin.study.statistics import statistic

Array = NDArray[np.float64]

TRENDS: Final = ("rises", "falls", "rises_then_falls")
#: Residual of a target whose run failed or was skipped.
FAILED_RESIDUAL: Final = 10.0


@dataclass(frozen=True)
class Target:
    """A target. The docstring of the module defines the kinds of targets."""

    name: str
    kind: str
    statistics: tuple[str, ...]
    number: float = 0.0
    others: tuple[str, ...] = ()
    shape: str = ""
    settings: tuple[Mapping[str, Value], ...] = ()
    tolerance: float = 0.05
    scale: float = 1.0
    margin: float = 0.0
    weight: float = 1.0
    mark: str = ""
    source: str = ""

    @property
    def paths(self) -> tuple[str, ...]:
        """The statistics that the target needs from each of its runs."""
        return (*self.statistics, *self.others)

    def residual(self, table: Array) -> Array:
        """Return the residuals r of m candidates, shape (m,).

        `table`, shape (m, settings, paths), contains the statistics of the candidates.
        """
        mine = table[:, :, : len(self.statistics)].min(axis=2)
        if self.kind == "trend":
            return self._trend(mine)
        s = mine[:, 0]
        if self.kind == "value":
            return np.asarray((s - self.number) / (self.tolerance * abs(self.number)))
        if self.kind == "above":
            largest = table[:, 0, len(self.statistics) :].max(axis=1)
            return np.asarray(np.maximum(0.0, largest - s) / (self.tolerance * np.maximum(np.abs(largest), 1e-300)))
        lack = self.number - s if self.kind == "at_least" else s - self.number
        return np.asarray(np.maximum(0.0, lack) / self.scale)

    def _trend(self, s: Array) -> Array:
        mean = np.maximum(np.abs(s).mean(axis=1), 1e-300)
        if self.shape == "rises_then_falls":
            turns = [
                _wrong_way(s[:, : k + 1], mean * self.margin) + _wrong_way(-s[:, k:], mean * self.margin)
                for k in range(1, s.shape[1] - 1)
            ]
            wrong: Array = np.min(turns, axis=0)
        else:
            wrong = _wrong_way(s if self.shape == "rises" else -s, mean * self.margin)
        return np.asarray(wrong / (self.tolerance * mean))

    def met(self, residual: float) -> bool:
        """Return whether a target with this residual is met."""
        return abs(residual) <= 1.0 if self.kind == "value" else residual <= 1e-9


def _wrong_way(s: Array, least: Array) -> Array:
    """Return the sum of all downward steps, plus the part of the rise `least` that is missing."""
    down = np.maximum(0.0, -np.diff(s, axis=1)).sum(axis=1)
    return np.asarray(down + np.maximum(0.0, least - (s[:, -1] - s[:, 0])))


@dataclass(frozen=True)
class TargetSet:
    """A set of targets, and the parameters of the runs that the targets need."""

    targets: tuple[Target, ...]
    t_end_s: float
    tol: float = 1e-6
    source: str = ""
    #: Unknowns that the file proposes, in the syntax of the command line.
    unknowns: tuple[str, ...] = ()
    settings: tuple[Mapping[str, Value], ...] = field(init=False)

    def __post_init__(self) -> None:
        unique: list[Mapping[str, Value]] = []
        for target in self.targets:
            unique += [setting for setting in target.settings if setting not in unique]
        # the setting of most targets comes first: a candidate that fails there needs no further runs
        uses = [sum(setting in target.settings for target in self.targets) for setting in unique]
        order = sorted(range(len(unique)), key=lambda index: -uses[index])
        object.__setattr__(self, "settings", tuple(unique[index] for index in order))

    def without(self, patterns: Sequence[str]) -> TargetSet:
        """Return the set without the targets whose names match one of the patterns, such as `max at*`.

        Raise `StudyError` if a pattern matches no target, or no target is left.
        """
        names = [target.name for target in self.targets]
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise StudyError(f"without: got {pattern!r}, expected a pattern of {', '.join(map(repr, names))}")
        remaining = tuple(
            target for target in self.targets if not any(fnmatchcase(target.name, pattern) for pattern in patterns)
        )
        if not remaining:
            raise StudyError(f"without: got {', '.join(map(repr, patterns))}, expected patterns that leave a target")
        return TargetSet(remaining, self.t_end_s, self.tol, self.source, self.unknowns)


_ABOVE_0: Final[Schema] = {"type": "number", "exclusiveMinimum": 0.0, "description": "a number > 0"}
_TEXTS: Final[Schema] = {
    "anyOf": [TEXT, {"type": "array", "items": TEXT, "minItems": 1, "description": "one or more texts"}],
    "description": "a text, or a list of texts",
}
_KINDS: Final[dict[str, Schema]] = {
    "value": {**NUMBER, "not": {"const": 0}, "description": "a number but 0, because the tolerance is relative"},
    "at_least": NUMBER,
    "at_most": NUMBER,
    "above": _TEXTS,
    "trend": choice(TRENDS),
}
_TARGET: Final[Schema] = {
    **mapping(
        {
            "name": TEXT, "statistic": _TEXTS, **_KINDS, "along": TEXT,
            "over": {"type": "array", "items": NUMBER, "minItems": 2, "description": "at least 2 numbers"},
            "set": {"type": "object", "description": "parameters and their values"},
            "tolerance": _ABOVE_0, "scale": _ABOVE_0, "margin": NUMBER, "weight": NUMBER,
            "mark": choice([mark.value for mark in Mark]), "source": TEXT,
        },
        ["statistic"],
    ),
    "oneOf": [{"required": [kind]} for kind in _KINDS],
    "dependentRequired": {"trend": ["along", "over"]},
    "if": {"properties": {"trend": {"const": "rises_then_falls"}}, "required": ["trend"]},
    "then": {"properties": {"over": {"minItems": 3, "description": "at least 3 numbers"}}},
    "description": f"a mapping with statistic and one of {', '.join(_KINDS)}; with trend also along and over",
}  # fmt: skip
_TARGETS: Final[Schema] = {"type": "array", "items": _TARGET, "minItems": 1, "description": "a list of targets"}
_FILE: Final = mapping(
    {
        "version": {"const": 1, "description": "1"},
        **{"t_end": _ABOVE_0, "tol": _ABOVE_0, "unknowns": _TEXTS, "targets": _TARGETS},
    },
    ("version", "t_end", "targets"),
)


def load_targets(path: Path, scene: Scene) -> TargetSet:
    """Read a target file, or raise a `StudyError` that lists all problems of the file."""
    raw, found = read_yaml(path, "target", "version, t_end, targets")
    problems = [str(problem) for problem in found or validate(raw, _FILE, "targets")]
    items = raw.get("targets") if isinstance(raw, dict) and not found else None
    targets: list[Target] = []
    for index, item in enumerate(items if isinstance(items, list) else ()):
        place = f"targets[{index}]"
        if not any(problem.startswith(place) for problem in problems):
            try:
                targets.append(_target(item, scene))
            except StudyError as error:
                problems.append(f"{place}: {error}")
    if problems:
        lines = "\n".join(f"  {problem}" for problem in problems)
        raise StudyError(f"{path}: {len(problems)} problem(s)\n{lines}")
    unknowns = _texts(raw.get("unknowns", []))
    return TargetSet(tuple(targets), float(raw["t_end"]), float(raw.get("tol", 1e-6)), str(path), unknowns)


def _target(item: Mapping[str, Any], scene: Scene) -> Target:
    kind = next(kind for kind in _KINDS if kind in item)
    names = _texts(item["statistic"])
    others = _texts(item["above"]) if kind == "above" else ()
    for name in (*names, *others):
        statistic(scene, name)
    base = item.get("set", {})
    for path in base:
        check_path(scene, str(path))
    settings: tuple[Mapping[str, Value], ...] = (dict(base),)
    if kind == "trend":
        along = check_path(scene, item["along"])
        settings = tuple({**base, along: float(x)} for x in item["over"])
    return Target(
        name=item.get("name", f"{kind} {' '.join(names)}"), kind=kind, statistics=names, others=others,
        number=float(item[kind]) if kind in ("value", "at_least", "at_most") else 0.0,
        shape=item.get("trend", ""), settings=settings, mark=item.get("mark", ""), source=item.get("source", ""),
        **{key: float(item[key]) for key in ("tolerance", "scale", "margin", "weight") if key in item},
    )  # fmt: skip


def _texts(texts: str | list[str]) -> tuple[str, ...]:
    return (texts,) if isinstance(texts, str) else tuple(texts)
