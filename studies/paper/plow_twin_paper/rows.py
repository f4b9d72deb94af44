"""Rows of the table published / reconstructed / difference / agrees."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Final

#: Whether the scene's numbers were fitted to a row of the comparison.
FITTED: Final = "fitted to this"
CHECK: Final = "not fitted to this"
ASSUMED: Final = "not fitted to this; other clearance assumed 20 mm"
UNKNOWN: Final = "the scene does not say"


class Verdict(Enum):
    """Whether a row agrees by its criterion, or `NOT_COMPUTED` if the row's run failed."""

    AGREES = "yes"
    DISAGREES = "no"
    NOT_COMPUTED = "not computed"

    @staticmethod
    def of(agrees: bool) -> Verdict:
        """Return the verdict of a criterion that could be applied."""
        return Verdict.AGREES if agrees else Verdict.DISAGREES


@dataclass(frozen=True)
class Row:
    """One published statement beside the computed value.

    Attributes
    ----------
    group, source : str
        Heading of the row and place of the statement in the paper.
    what, published, computed : str
        The statement, the paper's value and this run's value, as text.
    verdict, criterion
        Whether the values agree, and the rule that decides this.
    inputs : str
        Whether the scene's fitted numbers were fitted to this statement (`FITTED`) or not (`CHECK`).
    published_value, value : float, optional
        Both values as numbers in `unit`, for numeric statements.
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
        """Computed minus published value as a share of the published value, or None without numbers."""
        if self.published_value is None or self.value is None:
            return None
        return (self.value - self.published_value) / abs(self.published_value)


def braces(corners: str) -> str:
    """Write a set of corners as {a,d}; `none` for the empty set."""
    return "{" + ",".join(corners) + "}" if corners else "none"
