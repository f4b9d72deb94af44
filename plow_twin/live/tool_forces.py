"""Measured forces of the tools as one wrench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.loads import load_direction
from plow_twin.model.scene import Constant, Harmonic, Scene

Wrench = tuple[float, float, float]


class ToolForces:
    """The wrench of measured forces along the directions of the scene's loads.

    An effort of 1 N along a load's direction, at its point of action, gives a fixed wrench about the centre; the effort
    of a pure moment is in N m. A table and a constant of zero have no direction: messages may name them, but their
    effort is ignored.
    """

    def __init__(self, scene: Scene) -> None:
        self._directions: Mapping[str, NDArray[np.float64]] = {
            load.name: load_direction(load)
            for load in scene.loads
            if isinstance(load, Harmonic | Constant) and np.any(load_direction(load))
        }
        self._known = frozenset(load.name for load in scene.loads)

    @property
    def names(self) -> tuple[str, ...]:
        """The loads that each message must name."""
        return tuple(self._directions)

    def wrench(self, names: Sequence[str], efforts: Sequence[float]) -> Wrench | None:
        """Return the total wrench, or None unless the names give each measurable load exactly once."""
        named = set(names)
        if len(efforts) != len(names) or len(named) != len(names):
            return None
        if not self._directions.keys() <= named <= self._known:
            return None
        total = np.zeros(3)
        for name, effort in zip(names, efforts, strict=True):
            if name in self._directions:
                total += effort * self._directions[name]
        return (float(total[0]), float(total[1]), float(total[2]))
