"""Runs of many scenes, and the statistics of each motion for studies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.run.ensemble import Ensemble, simulate_many
from plow_twin.solve.state import Status

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Members:
    """The motions of m scenes over `duration_s` seconds."""

    duration_s: float
    motions: Ensemble

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Flags of the runs that did not reach their end, shape (m,)."""
        return np.asarray(self.motions.status != Status.OK)

    def at(self, rows: NDArray[np.int64]) -> Members:
        """Return the members with these numbers."""
        names = [spec.name for spec in fields(Ensemble) if spec.name != "t"]
        part = {name: getattr(self.motions, name)[rows] for name in names}
        return Members(self.duration_s, replace(self.motions, **part))


def run_members(
    scenes: Sequence[Scene],
    t_end: float,
    tol: float = 1e-9,
    output_dt: float | None = None,
    workers: int | None = None,
    on_done: Callable[[int], None] | None = None,
) -> Members:
    """Run every scene from t = 0 to `t_end` (see `simulate_many`); without `output_dt` rows are start and end."""
    return Members(t_end, simulate_many(scenes, t_end, output_dt or t_end, tol, workers, on_done))
