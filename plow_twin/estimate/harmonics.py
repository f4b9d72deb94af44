"""Harmonics that are missing from a measured load, as Fourier terms at low multiples of the load's frequency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import Load

Array = NDArray[np.float64]

#: Names of the components of a load.
COMPONENTS: Final = ("fx", "fy", "m")
#: Upper bound on the number of corrections of a load's frequency, which converge quadratically.
_CORRECTIONS = 6
#: Number of knots in the shortest period of a harmonic, derived from an error of linear interpolation of 0.9 %.
_KNOTS = 24


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Fourier terms that are added to a load: a constant, and sine and cosine of each multiple of the frequency.

    omega : angular frequency of the load in rad/s
    multiples : multiples of `omega` for which there are terms
    size : (3,) unit of the amplitudes in N, N, N m; in a fit, half the range of the measured load
    amplitude : (k, 3) amplitude of each term in units of `size`
    variance : (k, 3) variance of each amplitude in units of the square of `size`
    begin : time in s at which the phases are zero
    """

    omega: float
    multiples: tuple[int, ...]
    size: Array
    amplitude: Array
    variance: Array
    begin: float = 0.0

    @staticmethod
    def of(load: Load) -> Harmonics | None:
        """Return harmonics of a load's frequency with zero amplitude; None with fewer than two periods."""
        omega = frequency(load)
        if omega is None:
            return None
        size, no_amplitude = np.ptp(load.wrench, axis=0) / 2.0, np.zeros((1 + 2 * len(tuning.MULTIPLES), 3))
        return Harmonics(omega, tuning.MULTIPLES, np.maximum(size, 1e-3 * size.max()), no_amplitude, no_amplitude)

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Harmonics:
        """Return the harmonics from `data`, a result of `as_dict`."""
        mean, deviation = np.array(data["mean"]), np.array(data["deviation"])
        return Harmonics(
            data["omega_rad_s"], tuple(data["multiples"]), np.ones(3), mean, deviation**2, data.get("begin_s", 0.0)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the harmonics as JSON values, in N, N, N m."""
        return {
            "omega_rad_s": self.omega,
            "multiples": list(self.multiples),
            "mean": (self.amplitude * self.size).tolist(),
            "deviation": (np.sqrt(self.variance) * self.size).tolist(),
        }

    def in_units(self, force: float, length: float, time: float) -> Harmonics:
        """Return the harmonics converted to SI from given units of force, length and time."""
        size = self.size * [force, force, force * length]
        return replace(self, omega=self.omega / time, size=size, begin=self.begin * time)

    def basis(self, t: Array) -> Array:
        """Return the value of each term with amplitude 1 at n times `t` in s, shape (n, k)."""
        turns = self.omega * np.outer(t - self.begin, self.multiples)
        waves = np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(t), -1)
        return np.concatenate([np.ones((len(t), 1)), waves], axis=1)

    def at(self, t: Array) -> Array:
        """Return the sum of all terms at n times `t` in s, shape (n, 3), in N, N, N m."""
        coefficients: Array = self.basis(t) @ self.amplitude * self.size
        return coefficients

    def added(self, load: Load) -> Load:
        """Return the sum of a load and the harmonics, with additional knots that resolve the harmonics."""
        step = 2.0 * math.pi / (self.omega * max(self.multiples) * _KNOTS)
        t = np.union1d(load.t, np.arange(load.t[0], load.t[-1], step))
        wrench = load.at(t)
        return replace(load, t=t, wrench=wrench + self.at(t))

    def moved(self, by: Array, variance: Array | None = None) -> Harmonics:
        """Return harmonics with `by`, shape (3 k,), added to the amplitudes, and with the given variances, if any."""
        shape = self.amplitude.shape
        new_variance = self.variance if variance is None else variance.reshape(shape)
        return replace(self, amplitude=self.amplitude + by.reshape(shape), variance=new_variance)

    def drawn(self, members: int, rng: np.random.Generator) -> Array:
        """Return random amplitudes in N, N, N m, shape (members, k, 3); the first member has the means."""
        white = rng.standard_normal((members, *self.amplitude.shape))
        white[0] = 0.0
        coefficients: Array = (self.amplitude + np.sqrt(self.variance) * white) * self.size
        return coefficients

    @property
    def names(self) -> list[str]:
        """Names of the amplitudes in the order of `amplitude.ravel()`."""
        terms = ["constant", *(f"{wave}_{multiple}" for multiple in self.multiples for wave in ("sin", "cos"))]
        return [f"load_{component}_{term}" for term in terms for component in COMPONENTS]


def frequency(load: Load) -> float | None:
    """Return the angular frequency in rad/s of the strongest oscillation of a load; None with fewer than two periods.

    The frequency is corrected by the phase difference between the first half and the second half of the load.
    """
    period, span = load.oscillation(), float(load.t[-1] - load.t[0])
    if period is None:
        return None
    omega = 2.0 * math.pi / period
    t = np.linspace(load.t[0], load.t[-1], 2 * len(load.t))
    wrench = load.at(t)
    wrench = wrench / np.maximum(wrench.std(axis=0), 1e-12 * np.abs(wrench).max())
    halves = slice(len(t) // 2), slice(len(t) // 2, None)
    for _ in range(_CORRECTIONS):
        first, second = (_phasor(omega, t[half], wrench[half]) for half in halves)
        omega += float(np.angle((second * first.conj()).sum())) / (0.5 * span)
    return omega if span * omega >= 4.0 * math.pi else None


def _phasor(omega: float, t: Array, wrench: Array) -> NDArray[np.complex128]:
    """Return the complex amplitude of exp(i omega t) in each component, shape (3,)."""
    turns = omega * t
    basis = np.stack([np.cos(turns), np.sin(turns), np.ones(len(t))], axis=1)
    coefficients = np.linalg.lstsq(basis, wrench, rcond=None)[0]
    return np.asarray(coefficients[0] - 1j * coefficients[1])
