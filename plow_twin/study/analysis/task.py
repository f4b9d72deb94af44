"""One analysis with its files, as a call that a process of its own can make."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from plow_twin.build import package_version
from plow_twin.errors import PlowTwinError
from plow_twin.study.analysis.analyse import analyse
from plow_twin.study.analysis.report import write_report
from plow_twin.study.store import write_atomically

#: Written last: what the other files of an analysis were made of.
_ASKED: Final = "asked.json"


@dataclass(frozen=True)
class Task:
    """One analysis, for a process of its own."""

    path: Path
    scene: Path | None
    mapping: Path | None
    others: tuple[Path, ...]
    out: Path | None

    def stored(self) -> dict[str, Any] | None:
        """Return the facts of this very analysis when its files are there, whole."""
        if self.out is None:
            return None
        try:
            asked = json.loads((self.out / _ASKED).read_text(encoding="utf-8"))
            facts: dict[str, Any] = json.loads((self.out / "analysis.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return {**facts, "lossy": bool(facts["lost"])} if asked == self._asked() else None

    def clear(self) -> None:
        """Remove the run that an analysis which did not end has left."""
        if self.out is None or not (self.out / "run").is_dir():
            return
        files = list((self.out / "run").iterdir())
        if all(re.fullmatch(r"run_\d+\.mcap|metadata\.yaml(\.partial)?", file.name) for file in files):
            shutil.rmtree(self.out / "run")

    def store(self) -> None:
        """Note what the files in `out` are, once all are written."""
        if self.out is not None:
            write_atomically(self.out / _ASKED, json.dumps(self._asked(), indent=1).encode())

    def _asked(self) -> dict[str, Any]:
        """Return what the result depends on: the recording and the files that say how to read it."""
        inputs = [self.path, *(path for path in (self.scene, self.mapping, *self.others) if path is not None)]
        return {"inputs": [_state(path) for path in inputs], "version": package_version()}


def _state(path: Path) -> list[Any]:
    """Return name, sizes and times of a file, or of those in a folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [str(path), *([file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in files if file.is_file())]


def analyse_task(task: Task) -> dict[str, Any]:
    """Return the facts of one analysis; `error` when it failed. Its results are written to `out`."""
    try:
        task.clear()
        found = analyse(task.path, scene=task.scene, mapping=task.mapping, others=task.others, out=task.out)
        if task.out is not None:
            write_report(found, task.out)
            task.store()
        return {**found.facts(), "lossy": found.lossy}
    except PlowTwinError as error:
        return {"run": str(task.path), "error": str(error)}
