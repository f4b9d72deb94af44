"""Test whether x, y and theta agree with the measured load in sign, order and unit.

The scene is simulated under the measured load with several stiffnesses. Averaged over a time longer than an impact, the
measured motion resembles a simulated motion, even if the contact is unknown and single impacts cannot be predicted. A
component that moves opposite to its simulated motion has the wrong sign, or the load that moves it has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.equation_error import DEPTHS
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.measurements import FEWEST_POSES, Poses, filled
from plow_twin.estimate.start import noise_level, range_of_motion
from plow_twin.estimate.unknowns import GX, GY, LEAST_CLEARANCE, Unknowns

Array = NDArray[np.float64]

#: Number of simulated motions, derived from a factor of 1.4 between the penetrations of successive motions.
_MOTIONS = 16
#: Names of the components of a pose, and of the components of the load that move them, by definition.
_POSE, _LOAD = ("x", "y", "theta"), ("fx", "fy", "m")
#: Half width of the range of plausible clearances in prior deviations, a bound on clearances from poses in wrong units.
_PLAUSIBLE = 2.0
#: Smallest scatter in m or rad of a simulated motion that moves, a guard against rounding errors of a locked component.
_STILL = 1e-9


def misfits_of_axes(forward: Forward, unknowns: Unknowns, poses: Poses) -> list[str]:
    """Return messages about components of the poses with a wrong sign, order or unit under the load of `forward`."""
    width = max(1, round(tuning.RESEMBLES / float(np.median(np.diff(poses.t)))))
    if len(poses.t) < width + FEWEST_POSES:
        return []
    q = filled(poses)
    measured, noise = _averaged(q, width), noise_level(q)
    measured[:, measured.std(axis=0) <= noise] = 0.0
    span = range_of_motion(unknowns.scene, poses)[0]
    own = _resemblance(_motions(forward, unknowns, poses.t, span, width), measured)
    crossed = _resemblance(_motions(forward, unknowns, poses.t, span[::-1], width), measured[:, [1, 0, 2]])
    if own is None or crossed is None:
        return []
    return _wrong_units(own) or _swapped(own, crossed) or _opposed(own)


@dataclass(frozen=True, eq=False)
class _Resemblance:
    """Resemblance of measured x, y and theta to those of k simulated motions.

    correlation : (k, 3) correlation of each component with its simulated motion; 0 if the component hardly moves
    ratio : (3,) scatter of each component divided by its median simulated scatter; 1 if the component hardly moves
    """

    correlation: Array
    ratio: Array

    @property
    def usual(self) -> Array:
        """Median correlation of each component, shape (3,)."""
        return np.asarray(np.median(self.correlation, axis=0), np.float64)

    @property
    def size(self) -> Array:
        """Median sizes of the correlations of x and y, shape (2,)."""
        return np.asarray(np.median(np.abs(self.correlation[:, :2]), axis=0), np.float64)


def _resemblance(simulated: Array, measured: Array) -> _Resemblance | None:
    """Return the resemblance of a measured motion, (n, 3), to simulated motions, (k, n, 3); None for k = 0."""
    if not len(simulated):
        return None
    scatters, scatter = simulated.std(axis=1), measured.std(axis=0)
    size = scatters * scatter
    product = np.einsum("kni,ni->ki", simulated, measured) / len(measured)
    correlation = np.divide(product, size, out=np.zeros_like(size), where=(scatters > _STILL) & (scatter > 0.0))
    usual = np.median(scatters, axis=0)
    return _Resemblance(
        correlation, np.divide(scatter, usual, out=np.ones(3), where=(scatter > 0.0) & (usual > _STILL))
    )


def _motions(forward: Forward, unknowns: Unknowns, t: Array, span: Array, width: int) -> Array:
    """Return averaged motions with several stiffnesses, shape (k, m, 3), whose range of motion is about `span` [m]."""
    nominal, deviation = unknowns.nominal(), unknowns.deviations()[[GX, GY]]
    low, high = (nominal[[GX, GY]] + sign * _PLAUSIBLE * deviation for sign in (-1.0, 1.0))
    start, edges, exponent = np.zeros((1, 6)), np.array([0, len(t)]), unknowns.scene.contact.exponent
    motions = []
    for depth in np.geomspace(*DEPTHS, _MOTIONS):
        vector = nominal.copy()
        vector[[GX, GY]] = np.maximum(np.clip(span - tuning.YIELDED[0] * depth, low, high), LEAST_CLEARANCE)
        scene = unknowns.scene_of(vector)
        contact = replace(scene.contact, stiffness=unknowns.force / depth**exponent)
        run = forward.run(replace(scene, contact=contact), np.ones(3), t[:1], start, edges, t)
        if run is not None:
            motions.append(_averaged(run.q, width))
    return np.array(motions)


def _averaged(q: Array, width: int) -> Array:
    """Return running means of poses over `width` rows, minus their mean over all rows."""
    total = np.cumsum(np.concatenate([np.zeros((1, 3)), q]), axis=0)
    means = (total[width:] - total[:-width]) / width
    out: Array = means - means.mean(axis=0)
    return out


def _swapped(own: _Resemblance, crossed: _Resemblance) -> list[str]:
    (first, second), size = crossed.size.tolist(), own.size
    if min(first, second) < tuning.SWAPPED[0] or first + second < size.sum() + tuning.SWAPPED[1]:
        return []
    return [
        f"x and y seem swapped, or fx and fy: exchanged, they resemble the motion that the load causes (correlations "
        f"{first:.2f}, {second:.2f}) more than as given ({size[0]:.2f}, {size[1]:.2f})"
    ]


def _opposed(own: _Resemblance) -> list[str]:
    return [
        f"{name}: opposite to the motion that the load causes (correlation {value:.2f}, expected a positive number): "
        f"the sign of {name} or of {load} is wrong"
        for name, load, value in zip(_POSE, _LOAD, own.usual.tolist(), strict=True)
        if value < -tuning.OPPOSED
    ]


def _wrong_units(own: _Resemblance) -> list[str]:
    return [
        f"{name}: {ratio:.2g} times the motion that the load causes, expected about 1: the unit of {name} is wrong"
        for name, value, ratio in zip(_POSE, own.usual.tolist(), own.ratio.tolist(), strict=True)
        if value > tuning.SWAPPED[0] and abs(math.log(ratio)) > math.log(tuning.WRONG_UNIT)
    ]
