"""Targets of a calibration: published figures, orders and trends, read from YAML.

Each target gives one residual r of a candidate, 0 if it is met exactly:

    value              r = (s - value) / (tolerance |value|)                       met: |r| <= 1
    at_least, at_most  r = max(0, shortfall) / scale                               met: r = 0
    above              r = max(0, largest of the others - s) / (tolerance |largest|)          met: r = 0
    trend              r = (steps the wrong way + shortfall of the rise or fall) / (tolerance mean)   met: r = 0

Here s is the statistic of the run with the target's `set` of parameters, or the smallest if several statistics are
named. A trend is a sequence of runs along one parameter. For `rises_then_falls` the turn with the smallest violation is
used. Rise and fall must each be at least `margin` times the mean. The objective is the sum of weight times r^2.
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
from plow_twin.scene_file.yaml_text import read_yaml
from plow_twin.study.parameters import StudyError, Value, check_path
from plow_twin.study.statistics import statistic

Array = NDArray[np.float64]

TRENDS: Final = ("rises", "falls", "rises_then_falls")
#: Residual of a target with a failed or omitted run.
FAILED_RESIDUAL: Final = 10.0
_KINDS: Final = ("value", "at_least", "at_most", "above", "trend")
_KEYS: Final = {
    "name", "statistic", *_KINDS, "along", "over", "set", "tolerance", "scale", "margin", "weight", "mark", "source",
}  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A target; the module's docstring explains each kind."""

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
        """Statistics that the target needs from each of its runs."""
        return (*self.statistics, *self.others)

    def residual(self, table: Array) -> Array:
        """Return r of m candidates; `table` has shape (m, settings, paths)."""
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
        """Return whether the target is met at this residual."""
        return abs(residual) <= 1.0 if self.kind == "value" else residual <= 1e-9


def _wrong_way(s: Array, least: Array) -> Array:
    """Return the sum of downward steps of a sequence that should rise, plus its shortfall from the least rise."""
    down = np.maximum(0.0, -np.diff(s, axis=1)).sum(axis=1)
    return np.asarray(down + np.maximum(0.0, least - (s[:, -1] - s[:, 0])))


@dataclass(frozen=True)
class TargetSet:
    """Targets and the runs that they need."""

    targets: tuple[Target, ...]
    t_end_s: float
    tol: float = 1e-6
    source: str = ""
    #: unknowns that the file proposes, as texts of the command line
    unknowns: tuple[str, ...] = ()
    settings: tuple[Mapping[str, Value], ...] = field(init=False)

    def __post_init__(self) -> None:
        unique: list[Mapping[str, Value]] = []
        for target in self.targets:
            unique += [setting for setting in target.settings if setting not in unique]
        # the most used setting first, because a candidate that fails there needs no further runs
        uses = [sum(setting in target.settings for target in self.targets) for setting in unique]
        order = sorted(range(len(unique)), key=lambda index: -uses[index])
        object.__setattr__(self, "settings", tuple(unique[index] for index in order))

    def without(self, patterns: Sequence[str]) -> TargetSet:
        """Return the set without the targets whose names match a pattern such as `max at*`.

        Raises
        ------
        StudyError
            A pattern matches no target, or no target is left.
        """
        names = [target.name for target in self.targets]
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise StudyError(f"without: got {pattern!r}, expected a pattern of {', '.join(map(repr, names))}")
        left = tuple(
            target for target in self.targets if not any(fnmatchcase(target.name, pattern) for pattern in patterns)
        )
        if not left:
            raise StudyError(f"without: got {', '.join(map(repr, patterns))}, expected patterns that leave a target")
        return TargetSet(left, self.t_end_s, self.tol, self.source, self.unknowns)


def load_targets(path: Path, scene: Scene) -> TargetSet:
    """Read a target file.

    Raises
    ------
    StudyError
        The file cannot be read or used; the error lists every problem.
    """
    raw, found = read_yaml(path, "target", "version, t_end, targets")
    problems = [str(problem) for problem in found]
    if not problems and not (isinstance(raw, dict) and isinstance(raw.get("targets"), list) and raw["targets"]):
        problems.append("got no list `targets`, expected version, t_end, targets")
    targets: list[Target] = []
    if not problems:
        extra = set(raw) - {"version", "t_end", "tol", "targets", "unknowns"}
        problems += [f"{key}: expected version, t_end, tol, unknowns, targets" for key in sorted(map(str, extra))]
        if raw.get("version") != 1:
            problems.append(f"version: got {raw.get('version')!r}, expected 1")
        for key in ("t_end", "tol"):
            if not _positive(raw.get(key, 1e-6 if key == "tol" else None)):
                problems.append(f"{key}: got {raw.get(key)!r}, expected a number > 0")
        for index, item in enumerate(raw["targets"]):
            try:
                targets.append(_target(item, scene))
            except StudyError as error:
                problems.append(f"targets[{index}]: {error}")
    if problems:
        lines = "\n".join(f"  {problem}" for problem in problems)
        raise StudyError(f"{path}: {len(problems)} problem(s)\n{lines}")
    return TargetSet(
        tuple(targets), float(raw["t_end"]), float(raw.get("tol", 1e-6)), str(path), _texts(raw.get("unknowns"))
    )


def _target(item: Any, scene: Scene) -> Target:
    if not isinstance(item, dict) or not set(item) <= _KEYS:
        got = sorted(set(item) - _KEYS) if isinstance(item, dict) else item
        raise StudyError(f"got {got!r}, expected keys of {', '.join(sorted(_KEYS))}")
    kinds = [kind for kind in _KINDS if kind in item]
    if len(kinds) != 1:
        raise StudyError(f"got {kinds}, expected exactly one of {', '.join(_KINDS)}")
    kind = kinds[0]
    names = _texts(item.get("statistic"))
    others = _texts(item["above"]) if kind == "above" else ()
    for name in (*names, *others):
        statistic(scene, name)
    if not names or (kind == "above" and not others):
        raise StudyError(f"got statistic {item.get('statistic')!r}, expected one or more paths of statistics")
    if item.get("mark") not in (None, *(mark.value for mark in Mark)):
        raise StudyError(f"mark: got {item['mark']!r}, expected one of {', '.join(m.value for m in Mark)}")
    numbers = {key: _float(item, key) for key in ("tolerance", "scale", "margin", "weight") if key in item}
    return Target(
        name=str(item.get("name", f"{kind} {' '.join(names)}")), kind=kind, statistics=names, others=others,
        number=_float(item, kind) if kind in ("value", "at_least", "at_most") else 0.0,
        shape=_shape(item) if kind == "trend" else "", settings=_settings(item, kind, scene),
        mark=str(item.get("mark", "")), source=str(item.get("source", "")), **numbers,
    )  # fmt: skip


def _settings(item: Mapping[str, Any], kind: str, scene: Scene) -> tuple[Mapping[str, Value], ...]:
    base = item.get("set", {})
    if not isinstance(base, dict):
        raise StudyError(f"set: got {base!r}, expected parameters and their values")
    for path in base:
        check_path(scene, str(path))
    if kind != "trend":
        return (dict(base),)
    over, along = item.get("over"), check_path(scene, str(item.get("along")))
    least = 3 if item["trend"] == "rises_then_falls" else 2
    if not isinstance(over, list) or len(over) < least or not all(isinstance(x, int | float) for x in over):
        raise StudyError(f"over: got {over!r}, expected at least {least} numbers")
    return tuple({**base, along: float(x)} for x in over)


def _shape(item: Mapping[str, Any]) -> str:
    if item["trend"] not in TRENDS:
        raise StudyError(f"trend: got {item['trend']!r}, expected one of {', '.join(TRENDS)}")
    return str(item["trend"])


def _texts(raw: Any) -> tuple[str, ...]:
    items: Sequence[Any] = raw if isinstance(raw, list) else [raw] if raw is not None else []
    return tuple(map(str, items))


def _float(item: Mapping[str, Any], key: str) -> float:
    value = item[key]
    positive = key in ("tolerance", "scale")
    if isinstance(value, bool) or not isinstance(value, int | float) or (positive and value <= 0.0):
        raise StudyError(f"{key}: got {value!r}, expected a number{' > 0' if positive else ''}")
    if key == "value" and value == 0.0:
        raise StudyError("value: got 0, expected another number (use at_most, because the tolerance is relative)")
    return float(value)


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value > 0.0
