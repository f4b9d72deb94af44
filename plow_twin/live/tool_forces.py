"""Compute the load on the head from the measured forces of the tools."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.loads import load_direction
from plow_twin.model.scene import Constant, Harmonic, Scene

Wrench = tuple[float, float, float]


class ToolForces:
    """Sum of measured forces, each in the direction of a load in the scene.

    The measured effort of a load is a force [N] or, for a pure moment, a moment [N m]. Efforts for tables and constants
    of zero are ignored, because these loads have no direction.
    """

    def __init__(self, scene: Scene) -> None:
        self._directions: Mapping[str, NDArray[np.float64]] = {
            load.name: load_direction(load)
            for load in scene.loads
            if isinstance(load, Harmonic | Constant) and np.any(load_direction(load))
        }
        self._load_names = frozenset(load.name for load in scene.loads)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the loads that each message must contain."""
        return tuple(self._directions)

    def wrench(self, names: Sequence[str], efforts: Sequence[float]) -> Wrench | None:
        """Return the total wrench about the centre: Fx, Fy [N], M [N m].

        Returns None if a load in `names` is missing, repeated or unknown.
        """
        named = set(names)
        if len(efforts) != len(names) or len(named) != len(names):
            return None
        if not self._directions.keys() <= named <= self._load_names:
            return None
        total = np.zeros(3)
        for name, effort in zip(names, efforts, strict=True):
            if name in self._directions:
                total += effort * self._directions[name]
        return (float(total[0]), float(total[1]), float(total[2]))
