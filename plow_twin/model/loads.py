"""Loads of a scene as the solver reads them: one list of harmonics and one piecewise linear wrench.

A load (Fx, Fy) has a constant arm (x, y) in world axes. Its moment about the centre of the cavity is M = x Fy - y Fx in
every pose (paper, section 2). Gravity is treated separately.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Constant, Harmonic, Load, Table

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pieces:
    """A piecewise linear wrench: `start + slope (t - knots[i])` on [knots[i], knots[i + 1]).

    `knots` [s], shape (n,), increases strictly. `start`, shape (n, 3), contains Fx, Fy [N] and M [N m] at each knot,
    and `slope`, shape (n, 3), their rates per second. Before the first knot, the wrench is constant.
    """

    knots: Array
    start: Array
    slope: Array

    @staticmethod
    def through(t: Array, wrench: Array) -> Pieces:
        """Return the wrench that connects samples by straight lines and is constant after the last sample."""
        slope = np.zeros_like(wrench)
        slope[:-1] = np.diff(wrench, axis=0) / np.diff(t)[:, None]
        return Pieces(t, wrench, slope)

    def at(self, t: Array) -> tuple[Array, Array]:
        """Return the wrench and its slope just after each time, shape (m, 3) each."""
        index = np.clip(np.searchsorted(self.knots, t, side="right") - 1, 0, None)
        before = t < self.knots[0]
        slope = np.where(before[:, None], 0.0, self.slope[index])
        return self.start[index] + slope * (t - self.knots[index])[:, None], slope


@dataclass(frozen=True)
class LoadSet:
    """The sum of all loads of a scene."""

    #: sum of the constant wrenches: Fx and Fy in N, M in N m, shape (3,)
    constant: Array
    #: distinct angular frequencies in rad/s, shape (h,)
    omega: Array
    #: amplitudes of sin(omega t) and cos(omega t): Fx and Fy in N, M in N m, shape (h, 3)
    sine: Array
    cosine: Array
    #: sum of the tables, or None without tables
    pieces: Pieces | None

    def at(self, t: Array) -> Array:
        """Return the wrench at each time, shape (m, 3)."""
        t = np.atleast_1d(np.asarray(t, dtype=np.float64))
        angle = t[:, None] * self.omega
        wrench = self.constant + np.sin(angle) @ self.sine + np.cos(angle) @ self.cosine
        return wrench if self.pieces is None else wrench + self.pieces.at(t)[0]

    def largest(self) -> Array:
        """Return an upper bound of |Fx|, |Fy| [N] and |M| [N m], shape (3,)."""
        amplitude: Array = np.abs(self.constant) + np.hypot(self.sine, self.cosine).sum(axis=0)
        return amplitude if self.pieces is None else amplitude + np.abs(self.pieces.start).max(axis=0)


def wrench_of(force: tuple[float, float], moment: float, at: tuple[float, float]) -> Array:
    """Return Fx, Fy and M = x Fy - y Fx + moment, shape (3,), for a force that acts at (x, y) = `at`."""
    return np.array([force[0], force[1], at[0] * force[1] - at[1] * force[0] + moment])


def load_direction(load: Harmonic | Constant) -> Array:
    """Return the wrench of a load per unit of force, shape (3,), or per unit of moment if the force is zero."""
    size = float(np.hypot(*load.force_n)) or abs(load.moment_n_m) or 1.0
    return wrench_of(load.force_n, load.moment_n_m, load.at_m) / size


def compile_loads(loads: Iterable[Load]) -> LoadSet:
    """Return the sum of the loads of a scene."""
    constant = np.zeros(3)
    spectrum: dict[float, Array] = {}
    tables: list[Pieces] = []
    for load in loads:
        if isinstance(load, Table):
            tables.append(_pieces_of(load))
            continue
        wrench = wrench_of(load.force_n, load.moment_n_m, load.at_m)
        if isinstance(load, Constant):
            constant += wrench
        else:
            phasor = spectrum.setdefault(load.omega_rad_s, np.zeros((2, 3)))
            phasor += np.outer([np.cos(load.phase_rad), np.sin(load.phase_rad)], wrench)
    phasors = np.array(list(spectrum.values())).reshape(-1, 2, 3)
    return LoadSet(constant, np.array(list(spectrum)), phasors[:, 0], phasors[:, 1], _sum_pieces(tables))


def _pieces_of(table: Table) -> Pieces:
    t = np.asarray(table.t, dtype=np.float64)
    wrench = np.array(table.wrench, dtype=np.float64)
    wrench[:, 2] += table.at_m[0] * wrench[:, 1] - table.at_m[1] * wrench[:, 0]
    return Pieces.through(t, wrench) if table.hold == "linear" else Pieces(t, wrench, np.zeros_like(wrench))


def _sum_pieces(tables: list[Pieces]) -> Pieces | None:
    if len(tables) < 2:
        return tables[0] if tables else None
    knots = np.unique(np.concatenate([table.knots for table in tables]))
    values, slopes = zip(*(table.at(knots) for table in tables), strict=True)
    return Pieces(knots, np.sum(values, axis=0), np.sum(slopes, axis=0))
