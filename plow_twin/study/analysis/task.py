"""One analysis with its files, as a task that can run in another process."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from plow_twin.build import package_version
from plow_twin.errors import PlowTwinError, RecordingError
from plow_twin.record.bag import beside_folders
from plow_twin.record.chunks import ChunkReader
from plow_twin.record.durable import write_whole
from plow_twin.record.reader import read_header
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.study.analysis.analyse import MAPPED_LOAD, Analysis, OnProgress, analyse
from plow_twin.study.analysis.report import write_report

#: File with the inputs of an analysis. It is written last, so it shows that the analysis is complete.
_INPUTS: Final = "asked.json"
_FILES: Final = (_INPUTS, "analysis.json", "report.html", "measured.parquet")
#: Names of the tables. A number marks a table of a further scene (`--with`).
_TABLE: Final = re.compile(r"(predicted|clearance|face|slide_wear)(_\d+)?\.parquet")


def names_apart(paths: Sequence[Path]) -> list[str]:
    """Return a name for each recording: the shortest end of its path that is unique."""
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


class RunTask(Protocol):
    """Work on one recording that can run in another process."""

    @property
    def path(self) -> Path:
        """Path of the recording."""

    def stored(self) -> dict[str, Any] | None:
        """Return the stored result of an earlier, identical task, or None."""

    def run(self) -> dict[str, Any]:
        """Do the work and return its result."""


@dataclass(frozen=True)
class Task:
    """Analysis of one recording."""

    path: Path
    scene: Path | None
    mapping: Path | None
    others: tuple[Path, ...]
    out: Path | None
    #: Items in the folder of the recording that are not analysed.
    left_out: tuple[Path, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    def stored(self) -> dict[str, Any] | None:
        """Return the result of an earlier, complete analysis of the same inputs, or None."""
        if self.out is None:
            return None
        try:
            inputs = json.loads((self.out / _INPUTS).read_text(encoding="utf-8"))
            facts: dict[str, Any] = json.loads((self.out / "analysis.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return {**facts, "lossy": bool(facts["lost"])} if inputs == self._input_facts() else None

    def clear(self, inputs: Sequence[Path] = ()) -> None:
        """Remove the files of an earlier analysis. A run that a twin has recorded is not removed.

        Raise `RecordingError` if a file to remove is an input of this analysis.
        """
        old = self._old()
        self._keep(old, (*self._inputs(), *inputs))
        for path in old:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def check(self, inputs: Sequence[Path]) -> None:
        """Raise a `RecordingError` if this analysis would replace one of the files or folders `inputs`."""
        self._keep(self._old(), inputs)

    def _old(self) -> list[Path]:
        """Return the files of an earlier analysis, beginning with `_INPUTS`."""
        if self.out is None or not self.out.is_dir():
            return []
        old_files = sorted(path for path in self.out.iterdir() if path.name in _FILES or _TABLE.fullmatch(path.name))
        run = self.out / "run"
        if run.is_dir() and all(map(_is_ours, run.iterdir())):
            old_files.append(run)
        return sorted(old_files, key=lambda path: path.name != _INPUTS)

    def _keep(self, old: Sequence[Path], inputs: Sequence[Path]) -> None:
        for path in inputs:
            real = path.resolve()
            for output in old:
                if real.is_relative_to(output.resolve()):
                    raise RecordingError(f"{path}: --out {self.out} would replace it, expected another folder")

    def _inputs(self) -> list[Path]:
        return [self.path, *(path for path in (self.scene, self.mapping, *self.others) if path is not None)]

    def analyse(self, **following: Any) -> Analysis:
        """Do the analysis without its report. The arguments are passed to the function `analyse`."""
        return analyse(
            self.path, scene=self.scene, mapping=self.mapping, units=self.units, others=self.others, out=self.out,
            **following,
        )  # fmt: skip

    def run(self, on_progress: OnProgress = lambda share: None) -> dict[str, Any]:
        """Do the analysis, write its files and return its result, or raise a `PlowTwinError`."""
        self.clear()
        inputs = self._input_facts()  # the files may change during the analysis
        analysis = self.analyse(on_progress=on_progress)
        analysis.left_out = self.left_out
        if self.out is not None:
            write_report(analysis, self.out)
            write_whole(self.out / _INPUTS, json.dumps(inputs, indent=1).encode(), sync=True)
        return {**analysis.facts(), "lossy": analysis.lossy}

    def _input_facts(self) -> dict[str, Any]:
        """Return the inputs that determine the result."""
        folder = self.path if self.path.is_dir() else self.path.parent
        parts = [*sorted(folder.glob("*.mcap")), *beside_folders(folder)]
        beside = folder / "scene.yaml" if self.scene is None else None
        return {
            "run": _state(self.path, self.out),
            # all parts, and folders beside a part, may contain measurements
            "parts": [] if self.path.is_dir() else [_state(path, self.out) for path in parts],
            "scene": _scene_state(self.scene),
            "scene_beside": _scene_state(beside) if beside is not None and beside.is_file() else None,
            "map": None if self.mapping is None else _state(self.mapping, None),
            "units": dict(self.units),
            "with": [_scene_state(other) for other in self.others],
            "version": package_version(),
        }


def _is_ours(file: Path) -> bool:
    if file.name in ("metadata.yaml", "metadata.yaml.partial"):
        return True
    if not re.fullmatch(r"run_\d+\.mcap", file.name):
        return False
    if file.stat().st_size == 0:  # the process was killed before it wrote the first byte
        return True
    try:
        header = read_header(file)
        if header is None and next(iter(ChunkReader(file)), None) is None:
            return True  # the process was killed before it wrote the header
    except RecordingError:
        return False
    return header is not None and MAPPED_LOAD in header.parameters


def _state(path: Path, out: Path | None) -> list[Any]:
    """Return the names, sizes and times of a file, or of all files in a folder except the results in `out`."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    if out is not None and out.resolve().is_relative_to(path.resolve()):
        results = out.resolve()
        files = [file for file in files if not _is_result(file.resolve(), results)]
    return [str(path), *([file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in files if file.is_file())]


def _is_result(file: Path, out: Path) -> bool:
    if file.is_relative_to(out / "run"):
        return True
    return file.parent == out and (file.name in _FILES or _TABLE.fullmatch(file.name) is not None)


def _scene_state(scene: Path | None) -> list[str] | None:
    if scene is None:
        return None
    try:
        text = dump_scene(load_scene(scene))
    except (PlowTwinError, OSError, ValueError):  # the analysis reports the error
        text = ""
    return [str(scene), hashlib.blake2b(text.encode(), digest_size=16).hexdigest()]


def run_task(task: RunTask) -> dict[str, Any]:
    """Return the result of a task, or a mapping with the key `error` if the task failed."""
    try:
        return task.run()
    except PlowTwinError as error:
        return {"run": str(task.path), "error": str(error)}
    except Exception as error:
        return {"run": str(task.path), "error": f"{task.path}: {error!r}"}
