"""Limits of measured values and of their rates of change; a value beyond a limit is treated as a measurement fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import gt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.geometry import half_diagonal
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Scene

#: Largest plausible force, divided by the sum of the scene's loads and the head's weight.
_MARGIN: Final = 10.0
#: Shortest time [s] in which a value may change by its largest magnitude; an impact lasts about a millisecond.
_SHORTEST_S: Final = 1e-3


@dataclass(frozen=True)
class Limits:
    """Largest plausible magnitude of each value, and of its change per second."""

    largest: tuple[float, ...]
    fastest: tuple[float, ...]

    def exceeded(self, values: Sequence[float]) -> bool:
        """Return whether a value exceeds its largest magnitude."""
        return any(map(gt, map(abs, values), self.largest))

    def keep(self, before: Sequence[float], values: Sequence[float], duration_s: float) -> bool:
        """Return whether `values`, which follow `before` after `duration_s` [s], are finite and within all limits.

        Values without a limit, such as the standard deviations of a pose, are ignored.
        """
        for old, value, largest, fastest in zip(before, values, self.largest, self.fastest, strict=False):
            if not (abs(value) <= largest and abs(value - old) <= fastest * duration_s):
                return False
        return True

    def kept(self, values: NDArray[np.float64], duration_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the result of `keep` for each row of `values` after the first row, shape (n-1,).

        `values` has the shape (n, k); `duration_s`, shape (n-1,), contains the times between the rows [s].
        """
        within = np.abs(values[1:]) <= np.array(self.largest)
        with np.errstate(invalid="ignore"):  # inf - inf is NaN, and a comparison with NaN is False
            steady = np.abs(np.diff(values, axis=0)) <= np.array(self.fastest) * duration_s[:, None]
        return np.asarray((within & steady).all(axis=1))


def pose_limits(scene: Scene, displacement: float = 0.0, rate: float = 0.0) -> Limits:
    """Return the limits of a pose (x, y [m], theta [rad]) and of its rates.

    If `displacement` [m] is 0, the result of `largest_displacement` is used. If `rate` [m/s] is 0, a change by the
    largest displacement within a millisecond is allowed. The limit of an angle is half a turn, or infinite if the head
    is a block. The limit of the angular rate is half a turn per millisecond.
    """
    displacement = displacement or largest_displacement(scene)
    rate = rate or displacement / _SHORTEST_S
    angle = math.inf if scene.head.carries == "corners" else math.pi
    return Limits((displacement, displacement, angle), (rate, rate, math.pi / _SHORTEST_S))


def largest_displacement(scene: Scene) -> float:
    """Return half of the largest side of the frame or clearance [m], a displacement that no head reaches."""
    frame, clearance = scene.frame, scene.clearance
    return 0.5 * max(frame.width_m, frame.height_m, clearance.horizontal_m, clearance.vertical_m)


def value_limits(largest: float, rate: float = 0.0) -> Limits:
    """Return the limits of a value and its rate. If `rate` is 0, a change by `largest` within 1 ms is allowed."""
    return Limits((largest,), (rate or largest / _SHORTEST_S,))


def excitation_limits(
    scene: Scene, force: float = 0.0, moment: float = 0.0, force_rate: float = 0.0, moment_rate: float = 0.0
) -> Limits:
    """Return the limits of a load (Fx, Fy [N], M [N m]) and of its rates; a limit of 0 is derived from the scene.

    The derived limit of a force is ten times the sum of all loads and the head's weight. The derived limit of a moment
    is this force times half the frame's diagonal, plus ten times the largest moment of the loads. The derived limits of
    the rates allow a change by the limit of the value within a millisecond.
    """
    amplitude = compile_loads(scene.loads).largest()
    total = float(amplitude[:2].sum()) + scene.head.mass_kg * abs(scene.gravity.acceleration_m_s2)
    force = force or _MARGIN * total
    moment = moment or _MARGIN * (float(amplitude[2]) + total * half_diagonal(scene))
    force_rate, moment_rate = force_rate or force / _SHORTEST_S, moment_rate or moment / _SHORTEST_S
    return Limits((force, force, moment), (force_rate, force_rate, moment_rate))
