"""Picture of an estimate. It shows the fitted motion, and each quantity with its interval and its prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import Estimate, Interval, Motion
from plow_twin.estimate.unknowns import QUANTITIES
from plow_twin.view.fitted import FittedPicture, FittedValue


def estimate_picture(
    result: Estimate, prior: Mapping[str, Interval], poses: Poses, labels: Mapping[str, str], title: str
) -> FittedPicture:
    """Return the picture of an estimate. Without a fitted motion, only the measured `poses` are drawn.

    For each name in `QUANTITIES`, `prior` contains an interval, and `labels` a name with unit.
    """
    rows = [
        _value(row, prior.get(name.split("_")[0] if name in result.groups else name))
        for name, row in estimated_rows(result, labels).items()
    ]
    motion = result.motion or Motion(poses.t, poses.q, np.full_like(poses.q, np.nan))
    trust = f"window from {result.t_start:.2f} s to {result.t_end:.2f} s; {result.trust}"
    notes = (trust, *result.reasons)
    return FittedPicture(title, motion, rows, "prior", "90 % interval of the prior", result.noise, notes)


class EstimatedRow(NamedTuple):
    """An estimated value with its label, the factor from SI to the unit of the label, its digits and its state."""

    label: str
    value: Interval
    factor: float
    digits: str
    state: str


def estimated_rows(result: Estimate, labels: Mapping[str, str]) -> dict[str, EstimatedRow]:
    """Return a row for each estimated quantity and each group of clearances, by name; `labels` is as above."""
    states = {"horizontal": result.horizontal_state.value, "vertical": result.vertical_state.value}
    values = result.values()
    rows = {
        one.name: EstimatedRow(labels[one.name], values[one.name], one.factor, one.digits, states.get(one.name, ""))
        for one in QUANTITIES
        if one.name in values
    }
    return rows | {
        name: EstimatedRow(f"{name.replace('_', ', ')} [mm]", value, 1e3, ".3f", state.value)
        for name, (value, state) in result.groups.items()
    }


def _value(row: EstimatedRow, prior: Interval | None) -> FittedValue:
    scaled_prior = None if prior is None else _scaled(prior, row.factor)
    state, logarithmic = row.state.replace("_", " "), row.label.startswith(("stiffness", "damping"))
    return FittedValue(row.label, _scaled(row.value, row.factor), scaled_prior, row.digits, state, logarithmic)


def _scaled(value: Interval, factor: float) -> tuple[float, float, float]:
    return factor * value.mean, factor * value.p05, factor * value.p95
