"""Rows of the table that compares published with reconstructed statements."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

#: Whether the numbers of the scene were fitted to the statement of a row.
FITTED: Final = "fitted to this"
CHECK: Final = "not fitted to this"
ASSUMED: Final = "not fitted to this; other clearance assumed 20 mm"
UNKNOWN: Final = "the scene does not say"


class Verdict(Enum):
    """Whether the statement of a row agrees by its criterion. `NOT_COMPUTED` means that its run failed."""

    AGREES = "yes"
    DISAGREES = "no"
    NOT_COMPUTED = "not computed"

    @staticmethod
    def of(agrees: bool) -> Verdict:
        """Return the verdict for a statement that agrees or disagrees."""
        return Verdict.AGREES if agrees else Verdict.DISAGREES


@dataclass(frozen=True)
class Row:
    """A published statement and the computed value."""

    group: str
    #: Place of the statement in the paper.
    source: str
    what: str
    published: str
    computed: str
    verdict: Verdict
    criterion: str
    #: `FITTED`, `CHECK`, `ASSUMED` or `UNKNOWN`.
    inputs: str
    #: Unit and values of a numeric statement.
    unit: str = ""
    published_value: float | None = None
    value: float | None = None

    @property
    def difference(self) -> float | None:
        """The computed minus the published value, as a share of the published value."""
        if self.published_value is None or self.value is None:
            return None
        return (self.value - self.published_value) / abs(self.published_value)


def braces(corners: str) -> str:
    """Return a set of corners as a text such as {a,d}."""
    return "{" + ",".join(corners) + "}" if corners else "none"
