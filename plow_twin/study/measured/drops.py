"""Measured drops of the square: the first flight and the bounces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.study.measured.square import LEAST_ROWS, RATE_HZ

Array = NDArray[np.float64]

#: Half the side length of the square [m].
_HALF: Final = 0.03
#: Criteria of an impact: free-fall acceleration [m/s^2], smallest deviation from this acceleration [m/s^2], smallest
#: angular acceleration [rad/s^2], and largest gap [m].
_FALL, _JERK, _TWIST, _NEAR = 9.0, 9.0, 300.0, 0.03
#: Smallest rise [m] between two bounces.
_RISE: Final = 0.003


@dataclass(frozen=True)
class Drops:
    """Measured drops of the square."""

    #: Poses x, z [m] and unwrapped theta [rad] at 250 Hz, shape (n, rows, 3).
    pose: Array
    #: Number of rows before the first impact, shape (n,).
    flight_rows: NDArray[np.intp]
    #: Rows of the bounces of each drop: the lowest points between rises of at least 3 mm.
    bounces: tuple[tuple[int, ...], ...]

    @classmethod
    def load(cls, path: Path) -> Drops:
        """Read a file of drops such as `benchmark/data/measured/square_drops.npz`.

        Raises
        ------
        RecordingError
            The rows of a drop are in reverse order of time, because it ends higher than it begins.
        """
        with np.load(path) as data:
            pose = data["pose"] * data["scale"]
        rising = np.flatnonzero(pose[:, -1, 1] > pose[:, 0, 1])
        if len(rising):
            raise RecordingError(f"{path}: drop {rising[0]} ends higher than it begins, expected rows in order of time")
        pose[:, :, 2] = np.unwrap(pose[:, :, 2], axis=1)
        flights = np.array([_flight_rows(poses) for poses in pose])
        return cls(pose, flights, tuple(_bounces(poses[:, 1]) for poses in pose))

    def usable(self) -> list[int]:
        """Return the indices of the drops that have at least two bounces and a flight long enough for a fit."""
        return [
            i for i, flight_rows in enumerate(self.flight_rows) if flight_rows > LEAST_ROWS and len(self.bounces[i]) > 1
        ]

    def until(self, index: int, bounce: int) -> int:
        """Return the row of a bounce, counted from 0, or the row of the last bounce if the drop has fewer bounces."""
        return self.bounces[index][min(bounce, len(self.bounces[index]) - 1)]


def _flight_rows(pose: Array) -> int:
    z, theta = pose[:, 1], pose[:, 2]
    gap = z - _HALF * (np.abs(np.cos(theta)) + np.abs(np.sin(theta)))
    pushed = np.abs(np.diff(z, 2) * RATE_HZ**2 + _FALL) > _JERK
    pushed |= np.abs(np.diff(theta, 2) * RATE_HZ**2) > _TWIST
    hits = np.flatnonzero(pushed & (gap[2:] < _NEAR))
    return int(hits[0]) + 2 if hits.size else len(pose)


def _bounces(z: Array) -> tuple[int, ...]:
    found, falling, low, high = [], True, 0, 0
    for row, height in enumerate(z):
        if falling:
            low = row if height < z[low] else low
            if height > z[low] + _RISE:
                found.append(low)
                falling, high = False, row
        else:
            high = row if height > z[high] else high
            if height < z[high] - _RISE:
                falling, low = True, row
    return tuple(found)
