"""Random cutting load along the face, with a Gamma distribution and a spatial correlation.

Each pass has its own random process, which depends on the position along the face, and not on the sampling rate or the
speed. A Gaussian process with exponential correlation is transformed to the Gamma distribution (a translation process).

References
----------
Grigoriu, M. (1995). Applied Non-Gaussian Processes. Prentice Hall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import gamma, norm

from plow_twin.errors import ArgumentError
from plow_twin.scene_file.validation import NUMBER, Schema, validate

Array = NDArray[np.float64]

#: Number of grid points per correlation length. Linear interpolation between these points reduces the variance by 1 %.
_POINTS: Final = 25


def _at_least(low: float, kind: str = "number") -> Schema:
    return {"type": kind, "minimum": low, "description": f"a finite {kind} >= {low:g}"}


_SCHEMA: Final[Schema] = {
    "type": "object",
    "properties": {
        "length_m": _at_least(1e-3),
        "speed_m_s": _at_least(1e-6),
        "turn_s": _at_least(0.0),
        "force_n": NUMBER,
        "lateral_n": _at_least(0.0),
        "at_m": {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2, "description": "two numbers"},
        "variation": _at_least(1e-6),
        "correlation_m": _at_least(1e-4),
        "seed": _at_least(0, "integer"),
    },
}


@dataclass(frozen=True)
class Face:
    """The face, and the motion of the plough, which travels from end to end with the speed `speed_m_s` [m/s].

    A reversal takes `turn_s` [s].
    """

    length_m: float = 250.0
    speed_m_s: float = 2.0
    turn_s: float = 4.0

    def travel(self, t: Array) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return position [m], signed speed [m/s] and number of the pass at times `t` >= 0 [s], each of shape (n,).

        During a reversal, the speed changes linearly to the opposite speed. The next pass begins at the speed zero.
        """
        # the head reaches the end of the face in the middle of a reversal
        steady = (self.length_m - 0.5 * self.speed_m_s * self.turn_s) / self.speed_m_s
        period = steady + self.turn_s
        number = np.floor(t / period).astype(np.int64)
        into = t - number * period - 0.5 * self.turn_s
        ramp = 0.5 * self.turn_s
        if ramp > 0.0:
            share = np.clip(np.minimum(1.0 + into / ramp, 1.0 - (into - steady) / ramp), 0.0, 1.0)
        else:
            share = np.ones_like(into)
        begin, end = np.clip(into + ramp, 0.0, ramp), np.clip(into - steady, 0.0, ramp)
        distance = self.speed_m_s * np.clip(into, 0.0, steady)
        if ramp > 0.0:
            distance = distance + self.speed_m_s * (0.5 * begin**2 / ramp + end - 0.5 * end**2 / ramp)
        back = number % 2 == 1
        position = np.where(back, self.length_m - distance, distance)
        return position, np.where(back, -1.0, 1.0) * self.speed_m_s * share, number


@dataclass(frozen=True)
class CuttingLoad:
    """Fluctuating cutting force into the face and lateral force with mean zero, which act at one point of the head."""

    #: the face and the motion along it
    face: Face
    #: mean cutting force along x [N]; a negative force acts against the x direction
    force_n: float
    #: standard deviation of the normally distributed lateral force along y [N]
    lateral_n: float = 0.0
    #: point of action (x, y) from the centre of the cavity [m]; the moment is M = x Fy - y Fx
    at_m: tuple[float, float] = (0.0, 0.0)
    #: coefficient of variation of the cutting force
    variation: float = 0.5
    #: distance along the face at which the correlation is 1/e [m]
    correlation_m: float = 0.05
    #: seed of the random numbers
    seed: int = 0

    def __post_init__(self) -> None:
        face = self.face
        problems = validate({**vars(face), **vars(self)}, _SCHEMA, "load")
        if problems:
            raise ArgumentError("; ".join(map(str, problems)))
        if face.speed_m_s * face.turn_s >= 2.0 * face.length_m:
            raise ArgumentError(f"turn_s: got {face.turn_s!r}, expected less than two passes of {face.length_m:g} m")

    def at(self, t: Array) -> Array:
        """Return the load Fx, Fy [N], M [N m], shape (n, 3), at times `t` [s], shape (n,).

        The load is proportional to the speed.
        """
        position, speed, number = self.face.travel(t)
        force = np.zeros((len(t), 2))
        for pass_number in np.unique(number):
            own = number == pass_number
            cutting, lateral = self._fields(int(pass_number), position[own])
            force[own] = np.column_stack([self.force_n * cutting, self.lateral_n * lateral])
        force *= (np.abs(speed) / self.face.speed_m_s)[:, None]
        x, y = self.at_m
        return np.column_stack([force, x * force[:, 1] - y * force[:, 0]])

    def _fields(self, number: int, position: Array) -> tuple[Array, Array]:
        """Return both forces at positions [m] in the pass `number`.

        The cutting force is divided by its mean, and the lateral force by its standard deviation.
        """
        step = self.correlation_m / _POINTS
        grid = np.arange(math.ceil(self.face.length_m / step) + 2) * step
        rho = math.exp(-1.0 / _POINTS)
        noise = np.random.default_rng([self.seed, number]).standard_normal((2, len(grid)))
        noise[:, 1:] *= math.sqrt(1.0 - rho * rho)
        cutting, lateral = (np.interp(position, grid, lfilter([1.0], [1.0, -rho], row)) for row in noise)
        shape = self.variation**-2
        return gamma.ppf(norm.cdf(cutting), shape, scale=1.0 / shape), lateral
