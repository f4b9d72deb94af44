"""Report that compares the paper's figures and numbers with computed values."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from plow_twin.model.scene import Mark, Scene
from plow_twin.run.simulate import Result
from plow_twin.study.report import require
from plow_twin_paper import rows_motion, rows_sets, rows_trends
from plow_twin_paper.contradictions import Contradiction, contradictions
from plow_twin_paper.figures import Picture, draw_all, draw_rotation
from plow_twin_paper.recording import Recording, record
from plow_twin_paper.rotation import RotationRow, rotation_rows
from plow_twin_paper.rows import FITTED, UNKNOWN, Row, Verdict
from plow_twin_paper.runs import PaperRuns, run_all

OnProgress = Callable[[float], object]
#: Names of the models of rotation, in the order of `Rotation.scenes`.
FORMS = ("constant moment", "exact, I about the centre of mass", "exact, I about the cavity's centre")


@dataclass(frozen=True)
class Change:
    """A statement with a verdict that depends on the model of the head's rotation."""

    form: str
    row: Row


@dataclass(frozen=True)
class PaperStudy:
    """All results, and the paths of the files if they were written."""

    runs: PaperRuns
    rows: list[Row]
    rotation: list[RotationRow]
    changes: list[Change]
    contradictions: list[Contradiction]
    wall_s: float
    name: str = ""
    pictures: list[Picture] = field(default_factory=list)
    rotation_picture: Picture | None = None
    recording: Recording | None = None

    @property
    def verdicts(self) -> dict[str, int]:
        """The number of rows with each verdict."""
        return {verdict.value: sum(row.verdict is verdict for row in self.rows) for verdict in Verdict}

    @property
    def recording_error_m(self) -> float | None:
        """Largest distance [m] between the head in the recording and in the run of the report."""
        if self.recording is None:
            return None
        difference = self.recording.q[:, :2] - self.runs.case.q[:, :2]
        return float(np.hypot(*difference.T).max())


def compare(
    scene: Scene, t_end: float, workers: int | None = None, on_progress: OnProgress = lambda share: None
) -> PaperStudy:
    """Compute the comparison without writing files. Arguments and errors are those of `run_all`."""
    begin = time.perf_counter()
    runs = run_all(scene, t_end, workers, on_progress)
    rotation = [] if runs.rotation is None else rotation_rows(runs.rotation)
    wall_s = time.perf_counter() - begin
    return PaperStudy(runs, all_rows(runs), rotation, _changes(runs), contradictions(runs), wall_s)


def study_paper(
    scene: Scene,
    name: str,
    out: Path,
    t_end: float,
    workers: int | None = None,
    recording: bool = True,
    on_progress: OnProgress = lambda share: None,
) -> PaperStudy:
    """Compare a scene with the paper, and write a report into the folder `out`.

    The files are report.html, table.json, table.csv, figures/, run/ and run.rrd.

    Raises
    ------
    SceneError, SolverError
        The errors of `run_all`.
    ModuleNotFoundError
        One of the extras `study`, `record` and `view` is not installed. The last two are needed only with `recording`.
    OSError
        A file cannot be written.
    """
    begin = time.perf_counter()
    require("matplotlib", "jinja2", *(("mcap", "rosbags", "rerun") if recording else ()))
    comparison = compare(scene, t_end, workers, lambda share: on_progress(0.2 * share))
    figures = out / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    pictures = draw_all(comparison.runs, name, figures, lambda share: on_progress(0.2 + 0.2 * share))
    rotation_picture = draw_rotation(comparison.runs, name, figures)
    recorded = record(scene, t_end, out / "run", lambda share: on_progress(0.4 + 0.6 * share)) if recording else None
    study = replace(
        comparison,
        name=name,
        pictures=pictures,
        rotation_picture=rotation_picture,
        recording=recorded,
        wall_s=time.perf_counter() - begin,
    )
    _write(study, out)
    on_progress(1.0)
    return study


def all_rows(runs: PaperRuns) -> list[Row]:
    """Return all rows of the comparison in the order of the paper."""
    rows = [*_rows_of_run(runs.scene, runs.case), *rows_trends.rows(runs)]
    if any(entry.mark is Mark.RECONSTRUCTED for entry in runs.scene.marks.values()):
        return rows
    return [replace(row, inputs=UNKNOWN) for row in rows]


def _rows_of_run(scene: Scene, result: Result) -> list[Row]:
    return [*rows_motion.rows(scene, result), *rows_sets.rows(scene, result)]


def _changes(runs: PaperRuns) -> list[Change]:
    if runs.rotation is None:
        return []
    first, *others = map(_rows_of_run, runs.rotation.scenes, runs.rotation.results)
    return [
        Change(form, row)
        for form, rows in zip(FORMS[1:], others, strict=True)
        for before, row in zip(first, rows, strict=True)
        if before.verdict is not row.verdict
    ]


def _row_as_plain(row: Row) -> dict[str, Any]:
    return asdict(row) | {
        "difference": row.difference,
        "verdict": row.verdict.value,
        "published_mark": Mark.GIVEN.value,
    }


def _write(study: PaperStudy, out: Path) -> None:
    from plow_twin.study.report import write_csv, write_html, write_json

    rows = [_row_as_plain(row) for row in study.rows]
    write_csv(out / "table.csv", rows)
    write_json(out / "table.json", _as_plain(study))
    write_html(out / "report.html", "paper.html.j2", _context(study), "plow_twin_paper")


def _as_plain(study: PaperStudy) -> dict[str, Any]:
    from plow_twin.build import build_fingerprint
    from plow_twin.scene_file import dump_scene

    runs, rotation = study.runs, study.runs.rotation
    return {
        "scene": study.name,
        "t_end_s": runs.t_end,
        "clearance_scale": runs.scale,
        "verdicts": study.verdicts,
        "rows": [_row_as_plain(row) for row in study.rows],
        "rotation": {
            "offset_m": None if rotation is None else rotation.offset_m,
            "parted_s": None if rotation is None else rotation.parted_s,
            "rows": [asdict(row) for row in study.rotation],
            "changed_verdicts": [{"form": change.form, **_row_as_plain(change.row)} for change in study.changes],
        },
        "contradictions": [asdict(entry) for entry in study.contradictions],
        "failed_runs": runs.failed,
        "recording_error_m": study.recording_error_m,
        "wall_s": study.wall_s,
        "build": dict(build_fingerprint()),
        "scene_yaml": dump_scene(runs.scene),
    }


def _context(study: PaperStudy) -> dict[str, Any]:
    marks = study.runs.scene.marks
    return {
        **_as_plain(study),
        "study": study,
        "groups": {group: list(rows) for group, rows in groupby(study.rows, attrgetter("group"))},
        "disagreeing": [row for row in study.rows if row.verdict is Verdict.DISAGREES],
        "fitted": [row for row in study.rows if row.inputs == FITTED],
        "checks": [row for row in study.rows if row.inputs != FITTED],
        "yes": Verdict.AGREES,
        "marks": [(path, entry.mark.value, entry.source) for path, entry in marks.items()],
        "mark_counts": Counter(entry.mark.value for entry in marks.values()),
        "forms": FORMS,
    }
