"""Results of a calibration: the fitted scene, the comparison with the targets, and the uniqueness of the fit."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from plow_twin.build import build_fingerprint, package_version
from plow_twin.model.scene import Mark, Provenance, Scene
from plow_twin.record.durable import write_whole
from plow_twin.scene_file import dump_scene
from plow_twin.study.calibration.calibrate import Calibration, Search
from plow_twin.study.calibration.objective import TargetObjective
from plow_twin.study.calibration.uniqueness import Cluster, Identifiability
from plow_twin.study.calibration.unknowns import Space
from plow_twin.study.parameters import Value, with_parameters

_NOT_NUMBERS: Final = ("sign", "scale", "labels", "law", "rotation")


@dataclass(frozen=True)
class TargetRow:
    """A target and the statistics of the best fit."""

    name: str
    kind: str
    statistic: str
    asked: str
    got: tuple[float, ...]
    residual: float
    met: bool
    mark: str
    source: str


def fitted_scene(scene: Scene, values: Mapping[str, Value], source: str) -> Scene:
    """Return the scene with the fitted values. Every number that the fit has changed is marked as reconstructed.

    If only the sign of a number has changed, the source of its magnitude is kept in the mark.
    """
    fit = with_parameters(scene, values)
    marks = dict(fit.marks)
    index = {load.name: number for number, load in enumerate(scene.loads)}
    keys = set(scene.marks) - set(fit.marks)
    for path in values:
        match = re.fullmatch(r"loads\.(.+)\.(\w+(?:\[\d+\])?)", path)
        key = f"loads[{index[match[1]]}].{match[2]}" if match else path
        if not key.endswith(_NOT_NUMBERS):
            keys.add(key)
    for key in sorted(keys):
        marks[key] = _mark(_number_at(scene, key), _number_at(fit, key), scene.marks.get(key), source)
    return replace(fit, marks=MappingProxyType(marks))


def _mark(before: Any, after: Any, old: Provenance | None, source: str) -> Provenance:
    if old is not None and before == after:
        return old
    same_size = isinstance(before, float) and isinstance(after, float) and abs(before) == abs(after)
    if old is not None and same_size:
        size = old.source if old.mark is Mark.RECONSTRUCTED else f"size {old.mark.value}: {old.source}"
        return Provenance(Mark.RECONSTRUCTED, size)
    return Provenance(Mark.RECONSTRUCTED, f"fitted to {source}")


def _number_at(scene: Scene, key: str) -> Any:
    """Return the number at a key such as `loads[0].force_n[1]`."""
    value: Any = scene
    for name, place in re.findall(r"(\w+)|\[(\d+)\]", key):
        value = getattr(value, name) if name else value[int(place)]
    return value


def target_rows(objective: TargetObjective, values: Mapping[str, Value]) -> list[TargetRow]:
    """Return a row for every target, with the statistics of the candidate `values`."""
    numbers, paths = objective.table(values)
    settings = list(objective.targets.settings)
    rows = []
    for target, residual in zip(objective.targets.targets, objective.unweighted(values), strict=True):
        columns = [paths.index(path) for path in target.statistics]
        got = tuple(float(numbers[settings.index(setting), columns].min()) for setting in target.settings)
        requirement = {
            "value": f"{target.number:g} within {target.tolerance:.0%}",
            "above": f"above {', '.join(target.others)}",
            "trend": f"{target.shape.replace('_', ' ')}",
        }.get(target.kind, f"{target.kind.replace('_', ' ')} {target.number:g}")
        met = target.met(float(residual))
        kind, first = target.kind, target.statistics[0]
        rows.append(
            TargetRow(target.name, kind, first, requirement, got, float(residual), met, target.mark, target.source)
        )
    return rows


@dataclass(frozen=True)
class Fit:
    """All results of a calibration."""

    scene: Scene
    calibration: Calibration
    search: Search
    source: str
    identifiability: Identifiability
    clusters: list[Cluster]
    #: Objective of the given scene, or None if the scene lies outside the ranges of the unknowns.
    before: float | None
    targets: list[TargetRow]

    def plain(self, space: Space, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return all results as plain data for JSON."""
        calibration = self.calibration
        starts = [
            {key: getattr(start, key) for key in ("number", "objective", "before_polish", "runs", "values")}
            for start in calibration.starts
        ]
        return {
            "arguments": dict(arguments), "seed": calibration.seed, "search": asdict(self.search),
            "unknowns": [asdict(unknown) for unknown in space.unknowns], "source": self.source,
            "runs": calibration.runs,
            "objective_before": self.before, "objective": calibration.best.objective, "values": calibration.best.values,
            "targets": [asdict(row) for row in self.targets], "starts": starts,
            "identifiability": asdict(self.identifiability), "clusters": [asdict(cluster) for cluster in self.clusters],
            "package_version": package_version(), "build": dict(build_fingerprint()),
        }  # fmt: skip


def write_fit(fit: Fit, space: Space, arguments: Mapping[str, Any], folder: Path) -> None:
    """Write the fitted scene to `fit.yaml` and all other results to `calibration.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "fit.yaml", dump_scene(fit.scene).encode(), sync=True)
    content = json.dumps(fit.plain(space, arguments), indent=1).encode()
    write_whole(folder / "calibration.json", content, sync=True)
