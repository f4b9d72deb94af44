"""One analysis with its files, as a call that a process of its own can make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plow_twin.errors import PlowTwinError
from plow_twin.study.analysis.analyse import analyse
from plow_twin.study.analysis.report import write_report


@dataclass(frozen=True)
class Task:
    """One analysis, for a process of its own."""

    path: Path
    scene: Path | None
    mapping: Path | None
    others: tuple[Path, ...]
    out: Path | None


def analyse_task(task: Task) -> dict[str, Any]:
    """Return the facts of one analysis; `error` when it failed. Its results are written to `out`."""
    try:
        found = analyse(task.path, scene=task.scene, mapping=task.mapping, others=task.others, out=task.out)
        if task.out is not None:
            write_report(found, task.out)
        return {**found.facts(), "lossy": found.lossy}
    except PlowTwinError as error:
        return {"run": str(task.path), "error": str(error)}
