"""All rows of the comparison with the paper."""

from __future__ import annotations

from dataclasses import replace

from plow_twin.model.scene import Mark
from plow_twin_paper import rows_motion, rows_sets, rows_trends
from plow_twin_paper.rows import UNKNOWN, Row
from plow_twin_paper.runs import PaperRuns


def all_rows(runs: PaperRuns) -> list[Row]:
    """Return all rows of the comparison in the order of the paper."""
    rows = [
        *rows_motion.rows(runs.scene, runs.case),
        *rows_sets.rows(runs.scene, runs.case),
        *rows_trends.rows(runs),
    ]
    if any(entry.mark is Mark.RECONSTRUCTED for entry in runs.scene.marks.values()):
        return rows
    return [replace(row, inputs=UNKNOWN) for row in rows]


def one_run_rows(runs: PaperRuns, index: int) -> list[Row]:
    """Return the rows of Figs 6 to 9 for one model of the head's rotation."""
    assert runs.rotation is not None
    scene, result = runs.rotation.scenes[index], runs.rotation.results[index]
    return [*rows_motion.rows(scene, result), *rows_sets.rows(scene, result)]
