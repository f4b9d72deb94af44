"""One analysis with its files, as a call that a process of its own can make."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from plow_twin.build import package_version
from plow_twin.errors import PlowTwinError, RecordingError
from plow_twin.record.reader import read_header
from plow_twin.study.analysis.analyse import MAPPED_LOAD, analyse
from plow_twin.study.analysis.report import write_report
from plow_twin.study.store import write_atomically

#: Written last: what the other files of an analysis were made of.
_ASKED: Final = "asked.json"


def names_apart(paths: Sequence[Path]) -> list[str]:
    """Return a short name for each recording: as much of its path as tells it from the others."""
    whole = [path.absolute() for path in paths]
    stems = Counter(path if path.is_dir() else path.with_suffix("") for path in whole)
    parts = [
        (*path.parts[1:-1], path.stem if path.is_file() and stems[path.with_suffix("")] == 1 else path.name)
        for path in whole
    ]
    deepest = max(map(len, parts), default=0)
    ends = [Counter(part[-depth:] for part in parts) for depth in range(1, deepest + 1)]
    return [
        next(("_".join(part[-n:]) for n in range(1, deepest) if ends[n - 1][part[-n:]] == 1), "_".join(part))
        for part in parts
    ]


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
        """Remove the run that an analysis before has left; a run that a twin has recorded stays."""
        if self.out is None:
            return
        (self.out / _ASKED).unlink(missing_ok=True)
        if (self.out / "run").is_dir() and all(map(_is_ours, (self.out / "run").iterdir())):
            shutil.rmtree(self.out / "run")

    def run(self, on_progress: Callable[[float], object] | None = None) -> dict[str, Any]:
        """Return the facts of the analysis and write its files.

        Raises
        ------
        PlowTwinError
            It cannot be made.
        """
        self.clear()
        found = analyse(
            self.path,
            scene=self.scene,
            mapping=self.mapping,
            others=self.others,
            out=self.out,
            on_progress=on_progress,
        )
        if self.out is not None:
            write_report(found, self.out)
            self.store()
        return {**found.facts(), "lossy": found.lossy}

    def store(self) -> None:
        """Note what the files in `out` are, once all are written."""
        if self.out is not None:
            write_atomically(self.out / _ASKED, json.dumps(self._asked(), indent=1).encode())

    def _asked(self) -> dict[str, Any]:
        """Return what the result depends on: the recording and the files that say how to read it."""
        inputs = [self.path, *(path for path in (self.scene, self.mapping, *self.others) if path is not None)]
        return {"inputs": [_state(path) for path in inputs], "version": package_version()}


def _is_ours(file: Path) -> bool:
    """Tell whether a file belongs to a run that an analysis has made."""
    if file.name in ("metadata.yaml", "metadata.yaml.partial"):
        return True
    if not re.fullmatch(r"run_\d+\.mcap", file.name):
        return False
    if file.stat().st_size == 0:  # killed before its first byte
        return True
    try:
        header = read_header(file)
    except RecordingError:
        return False
    return header is not None and MAPPED_LOAD in header.parameters


def _state(path: Path) -> list[Any]:
    """Return name, sizes and times of a file, or of those in a folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [str(path), *([file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in files if file.is_file())]


def analyse_task(task: Task) -> dict[str, Any]:
    """Return the facts of one analysis; `error` when it failed. Its results are written to `out`."""
    try:
        return task.run()
    except PlowTwinError as error:
        return {"run": str(task.path), "error": str(error)}
