"""Combination of estimates of the same clearances by several methods; disagreement widens the intervals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.bouncing import Bounced
from plow_twin.estimate.gaps import GapsFit
from plow_twin.estimate.reason import LENGTH, Reason
from plow_twin.estimate.result import Estimate, Interval, State

Array = NDArray[np.float64]


def with_gaps(result: Estimate, by_gaps: GapsFit) -> Estimate:
    """Return an estimate that combines motion and gap sensors; a contradiction withdraws the clearances."""
    found = []
    if by_gaps.contradiction > tuning.OUTLYING:
        found.append(
            f"gaps: one sensor is {by_gaps.contradiction:.1f} times its stated error off the result of all sensors, "
            f"expected at most {tuning.OUTLYING:g} times"
        )
    values, states = [], []
    for name, value, state, mean, deviation in zip(
        ("horizontal", "vertical"),
        result.clearances,
        result.states,
        by_gaps.clearance.tolist(),
        by_gaps.deviation.tolist(),
        strict=True,
    ):
        moved = value.deviation
        apart = deviations_apart((value.mean, moved), (mean, deviation))
        if state.known and apart > tuning.OUTLYING:
            found.append(
                Reason(
                    f"gaps: {name} {{:.5f}} m by the gaps, {{:.5f}} m by the motion, {apart:.1f} deviations apart",
                    (mean, LENGTH),
                    (value.mean, LENGTH),
                )
            )
        if state.known:
            mean, deviation = weighted_mean((mean, deviation), (value.mean, moved))
        withdrawn = state is State.WITHDRAWN
        values.append(value if withdrawn else Interval.normal(mean, deviation).above(0.0))
        states.append(state if withdrawn else State.ESTIMATED)
    if found:
        states = [State.WITHDRAWN] * 2
    state = State.WITHDRAWN if found else State.ESTIMATED
    return result.having(
        values,
        states,
        groups=result.groups | {name: (value, state) for name, value in by_gaps.groups.items()},
        sensor="suspect" if found else result.sensor,
        reasons=(*result.reasons, *found),
    )


def with_bounced(result: Estimate, bounced: Bounced, spent: int) -> Estimate:
    """Return an estimate that combines the results of a fit and of a comparison; disagreement widens the intervals."""
    figures = result.figures | {"distance": bounced.distance, "path": bounced.path}
    figures["work"] += float(spent)
    if bounced.distance >= tuning.MOST_DISTANCE:
        return replace(result, figures=figures)
    apparent = tuple(
        Interval.normal(*weighted_mean_of_one((value.mean, value.deviation), (mean, deviation)))
        if state is State.ESTIMATED and deviation < tuning.OBSERVED
        else value
        for value, state, mean, deviation in zip(
            result.in_scene_frame(),
            result.states,
            bounced.clearance.tolist(),
            bounced.clearance_deviation.tolist(),
            strict=True,
        )
    )
    return replace(with_apparent(result, apparent), figures=figures)


def with_apparent(result: Estimate, apparent: tuple[Interval, ...]) -> Estimate:
    """Return an estimate with new apparent clearances, which hold for a frame of exactly the scene's size.

    The clearances allow for an error of the frame. Their shift and additional width do not change.
    """
    horizontal, vertical = (
        Interval.normal(
            value.mean + new.mean - old.mean,
            math.hypot(new.deviation, math.sqrt(max(value.deviation**2 - old.deviation**2, 0.0))),
        )
        for value, old, new in zip(result.clearances, result.in_scene_frame(), apparent, strict=True)
    )
    return replace(
        result,
        horizontal=horizontal.above(0.0),
        vertical=vertical.above(0.0),
        apparent=None if result.apparent is None else (apparent[0], apparent[1]),
    )


def weighted_mean(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return the weighted mean of two independent measurements, and its standard deviation."""
    weights = one[1] ** -2, other[1] ** -2
    return (one[0] * weights[0] + other[0] * weights[1]) / sum(weights), sum(weights) ** -0.5


def weighted_mean_of_one(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return `weighted_mean` of two estimates from the same motion, with a larger deviation if they disagree.

    Reference: Birge, Phys. Rev. 40 (1932) 207 (the ratio of external to internal consistency).
    """
    mean, deviation = weighted_mean(one, other)
    return mean, deviation * max(1.0, deviations_apart(one, other))


def deviations_apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the distance of two measurements (mean, deviation) in standard deviations of their difference."""
    return abs(one[0] - other[0]) / math.hypot(one[1], other[1])
