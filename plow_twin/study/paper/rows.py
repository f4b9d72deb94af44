"""The table published / reconstructed / difference / agrees: what a row is, and all rows of the comparison."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Final

from plow_twin.model.scene import Mark

if TYPE_CHECKING:
    from plow_twin.study.paper.runs import PaperRuns

#: What stands behind a row beside the numbers of the scene.
FITTED: Final = "fitted to this"
CHECK: Final = "not fitted to this"
ASSUMED: Final = "not fitted to this; other clearance assumed 20 mm"
UNKNOWN: Final = "the scene does not say"


class Verdict(Enum):
    """Whether a row agrees by its criterion; `NOT_COMPUTED` when the run behind it failed."""

    AGREES = "yes"
    DISAGREES = "no"
    NOT_COMPUTED = "not computed"

    @staticmethod
    def of(agrees: bool) -> Verdict:
        """Return the verdict of a criterion that could be applied."""
        return Verdict.AGREES if agrees else Verdict.DISAGREES


@dataclass(frozen=True)
class Row:
    """One published statement beside what was computed.

    Attributes
    ----------
    group, source : str
        Heading of the row and place of the statement in the paper.
    what, published, computed : str
        The statement, what the paper says, what this run gives, for people.
    verdict, criterion
        Whether it agrees, and the rule that decides it.
    inputs : str
        Whether the scene's fitted numbers were fitted to this very statement.
    published_value, value : float, optional
        The two as numbers in `unit`, for statements that are a number.
    """

    group: str
    source: str
    what: str
    published: str
    computed: str
    verdict: Verdict
    criterion: str
    inputs: str
    unit: str = ""
    published_value: float | None = field(default=None)
    value: float | None = field(default=None)

    @property
    def difference(self) -> float | None:
        """Computed minus published as a share of the published value; None without numbers."""
        if self.published_value is None or self.value is None:
            return None
        return (self.value - self.published_value) / abs(self.published_value)


def all_rows(runs: PaperRuns) -> list[Row]:
    """Return the whole comparison in the order of the paper."""
    from plow_twin.study.paper.study import rows_motion as paper_rows_motion
    from plow_twin.study.paper.study import rows_sets as paper_rows_sets
    from plow_twin.study.paper.study import rows_trends as paper_rows_trends

    rows = [
        *paper_rows_motion.rows(runs.scene, runs.case),
        *paper_rows_sets.rows(runs.scene, runs.case),
        *paper_rows_trends.rows(runs),
    ]
    if any(entry.mark is Mark.RECONSTRUCTED for entry in runs.scene.marks.values()):
        return rows
    return [replace(row, inputs=UNKNOWN) for row in rows]


def one_run_rows(runs: PaperRuns, index: int) -> list[Row]:
    """Return the rows of Figs 6 to 9 for one form of the head's rotation (see `Rotation`)."""
    from plow_twin.study.paper.study import rows_motion as paper_rows_motion
    from plow_twin.study.paper.study import rows_sets as paper_rows_sets

    assert runs.rotation is not None
    scene, result = runs.rotation.scenes[index], runs.rotation.results[index]
    return [*paper_rows_motion.rows(scene, result), *paper_rows_sets.rows(scene, result)]


def braces(corners: str) -> str:
    """Write a set of corners as people do: {a,d}; none for the empty one."""
    return "{" + ",".join(corners) + "}" if corners else "none"
