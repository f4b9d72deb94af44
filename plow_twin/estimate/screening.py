"""Checks of the measurements before a fit, and the choice of the samples of the load that a fit uses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import FEWEST_POSES, Load, Poses, filled, useless_deviation
from plow_twin.estimate.reason import FREQUENCY, LENGTH, NUMBER, Reason
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.verdict import COMPONENTS
from plow_twin.model import geometry
from plow_twin.model.scene import Gravity, Scene

Array = NDArray[np.float64]


def shortages(poses: Poses) -> tuple[str, ...]:
    """Return messages about components that were hardly measured, or about poses that are too rare."""
    useless = tuple(
        Reason(f"{name}: stated deviation {{:g}}, expected at most {{:g}}", (deviation, dimension), (most, dimension))
        for name, deviation, most, dimension in zip(
            COMPONENTS, poses.deviation, useless_deviation(), (LENGTH, LENGTH, NUMBER), strict=True
        )
        if deviation > most
    )
    if useless:
        return useless
    counts = np.isfinite(poses.q).sum(axis=0).tolist()
    reasons = tuple(
        f"{name}: measured {count} times, expected at least {FEWEST_POSES}"
        for name, count in zip(COMPONENTS, counts, strict=True)
        if count < FEWEST_POSES
    )
    if reasons:
        return reasons
    # a flight within a gap is not measured
    apart = max(poses.interval(), poses.gap())
    if apart > tuning.SPARSEST:
        rates = (1.0 / apart, FREQUENCY), (1.0 / tuning.SPARSEST, FREQUENCY)
        return (Reason("poses: got {:.1f} a second, expected at least {:.1f}", *rates),)
    return ()


def well_measured(poses: Poses) -> Poses | None:
    """Return the poses without components that were hardly measured.

    The result is None if all or no components were measured well, or if the remaining poses are too rare.
    """
    counts = np.isfinite(poses.q).sum(axis=0)
    well = (np.array(poses.deviation) <= useless_deviation()) & (counts >= FEWEST_POSES)
    if well.all() or not well.any():
        return None
    q = np.where(well, poses.q, np.nan)
    rows = np.isfinite(q).any(axis=1)
    some = replace(poses, t=poses.t[rows], q=q[rows])
    return some if max(float(np.median(np.diff(some.t))), some.gap()) <= tuning.SPARSEST else None


def is_dead(load: Load, poses: Poses) -> bool:
    """Return whether the measured load is constant although the head moves, which shows a failed load sensor."""
    late = filled(poses)[len(poses.t) // 2 :, poses.measured]
    return load.constant and bool((late.std(axis=0) > tuning.OUTLYING * noise_level(late)).any())


def is_idle(scene: Scene, load: Load, poses: Poses) -> bool:
    """Return whether the head rests under a load that hardly changes."""
    weight = scene.head.mass_kg * Gravity().acceleration_m_s2
    most = tuning.IDLE_LOAD * weight * np.array([1.0, 1.0, geometry.half_diagonal(scene)])
    return bool((load.wrench.std(axis=0) < most).all()) and rests(poses)


def rests(poses: Poses) -> bool:
    """Return whether the head rests after the first quarter of the window."""
    q = filled(poses)[len(poses.t) // 4 :, poses.measured]
    return bool((q.std(axis=0) < tuning.RESTS * noise_level(q)).all())


def thinned(load: Load, period: float) -> tuple[Load, bool]:
    """Return a load without samples that hardly move the head, and whether the load is broad-band.

    A load is broad-band if nearly all its samples move the head. It is then averaged. A load whose samples are too rare
    to show a broad-band part also counts as broad-band.
    """
    load = load.believable()
    most = tuning.KNOTS[0] * max(1.0, float(load.t[-1] - load.t[0]) / period)
    shares = (5e-4, 1e-3, 2e-3, 4e-3, 8e-3)
    significance = load.significance(shares[0])
    thin = load
    for share in shares:
        thin = load.kept(significance > share)
        if len(thin.t) <= most:
            break
    broad = len(thin.t) > most
    measured_load = load.averaged(tuning.KNOTS[1] * int(most)) if len(thin.t) > tuning.KNOTS[1] * most else thin
    return replace(measured_load, unknown=load.unknown), broad or load.rare
