"""Largest size and rate of measured values; larger values are treated as faults of the measurement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import gt, sub
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.geometry import half_diagonal
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Scene

#: Largest plausible load, as a multiple of the sum of the scene's largest loads and the head's weight.
_MARGIN: Final = 10.0
#: Shortest time [s] in which a load may change by its largest value; an impact lasts a millisecond.
_SHORTEST_S: Final = 1e-3


@dataclass(frozen=True)
class Limits:
    """Largest magnitude of each value, and of its change per second."""

    largest: tuple[float, ...]
    fastest: tuple[float, ...]

    def exceeded(self, values: Sequence[float]) -> bool:
        """Return whether a value is impossibly large."""
        return any(map(gt, map(abs, values), self.largest))

    def keep(self, before: Sequence[float], values: Sequence[float], duration_s: float) -> bool:
        """Return whether values are finite and within the limits, also in their rates of change."""
        for old, value, largest, fastest in zip(before, values, self.largest, self.fastest, strict=True):
            if not (abs(value) <= largest and abs(value - old) <= fastest * duration_s):
                return False
        return True

    def kept(self, values: NDArray[np.float64], duration_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return `keep` for each row of `values` (n, k) after the first, with the row before; shape (n-1,).

        `duration_s`, shape (n-1,), is the time between rows in s.
        """
        within = np.abs(values[1:]) <= np.array(self.largest)
        with np.errstate(invalid="ignore"):  # inf - inf is NaN, which counts as too fast
            steady = np.abs(np.diff(values, axis=0)) <= np.array(self.fastest) * duration_s[:, None]
        return np.asarray((within & steady).all(axis=1))

    def too_fast(self, before: Sequence[float], values: Sequence[float], duration_s: float) -> bool:
        """Return whether a value has changed impossibly fast."""
        most = [fastest * duration_s for fastest in self.fastest]
        return any(map(gt, map(abs, map(sub, values, before)), most))


def pose_limits(scene: Scene, displacement: float = 0.0, rate: float = 0.0) -> Limits:
    """Return the limits of a pose x, y [m], theta [rad] and of its rates; a limit given as 0 follows from the scene.

    The derived limits are `largest_displacement`, and a change by this displacement within a millisecond. An angle may
    be up to half a turn (or any angle, if the head is a block) and change by half a turn within a millisecond.
    """
    displacement = displacement or largest_displacement(scene)
    rate = rate or displacement / _SHORTEST_S
    angle = math.inf if scene.head.carries == "corners" else math.pi
    return Limits((displacement, displacement, angle), (rate, rate, math.pi / _SHORTEST_S))


def largest_displacement(scene: Scene) -> float:
    """Return a displacement in m that no head reaches: half the largest side of the frame or clearance."""
    frame, clearance = scene.frame, scene.clearance
    return 0.5 * max(frame.width_m, frame.height_m, clearance.horizontal_m, clearance.vertical_m)


def value_limits(largest: float, rate: float = 0.0) -> Limits:
    """Return the limits of a number and its rate; `rate` 0 allows a change by `largest` within 1 ms."""
    return Limits((largest,), (rate or largest / _SHORTEST_S,))


def excitation_limits(
    scene: Scene, force: float = 0.0, moment: float = 0.0, force_rate: float = 0.0, moment_rate: float = 0.0
) -> Limits:
    """Return the limits of Fx, Fy [N] and M [N m] and of their rates; a limit of 0 is derived from the scene.

    The derived limit of a force is ten times the sum of all loads of the scene and the head's weight. The limit of the
    moment is this force times half the frame's diagonal, plus ten times the largest moment of the loads. Each value may
    change by its limit within a millisecond.
    """
    amplitude = compile_loads(scene.loads).largest()
    total = float(amplitude[:2].sum()) + scene.head.mass_kg * abs(scene.gravity.acceleration_m_s2)
    force = force or _MARGIN * total
    moment = moment or _MARGIN * (float(amplitude[2]) + total * half_diagonal(scene))
    force_rate, moment_rate = force_rate or force / _SHORTEST_S, moment_rate or moment / _SHORTEST_S
    return Limits((force, force, moment), (force_rate, force_rate, moment_rate))
