"""Picture of an estimate. It shows the fitted motion, and each quantity with its interval and its prior."""

from __future__ import annotations

from collections.abc import Mapping

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
    states = {"horizontal": result.horizontal_state, "vertical": result.vertical_state}
    values = result.values()
    rows = [
        _value(labels[quantity.name], values[quantity.name], prior.get(quantity.name), quantity.factor, quantity.digits,
               states[quantity.name].value.replace("_", " ") if quantity.name in states else "")
        for quantity in QUANTITIES
        if quantity.name in values
    ]  # fmt: skip
    rows += [
        _value(f"{name.replace('_', ', ')} [mm]", value, prior.get(name.split("_")[0]), 1e3, ".3f",
               state.value.replace("_", " "))
        for name, (value, state) in result.groups.items()
    ]  # fmt: skip
    motion = result.motion or Motion(poses.t, poses.q, np.full_like(poses.q, np.nan))
    trust = f"window from {result.t_start:.2f} s to {result.t_end:.2f} s; model {result.model}, sensor {result.sensor}"
    notes = (trust, *result.reasons)
    return FittedPicture(title, motion, rows, "prior", "90 % interval of the prior", result.noise, notes)


def _value(label: str, value: Interval, prior: Interval | None, factor: float, digits: str, state: str) -> FittedValue:
    scaled_prior = None if prior is None else _scaled(prior, factor)
    logarithmic = label.startswith(("stiffness", "damping"))
    return FittedValue(label, _scaled(value, factor), scaled_prior, digits, state, logarithmic)


def _scaled(value: Interval, factor: float) -> tuple[float, float, float]:
    return factor * value.mean, factor * value.p05, factor * value.p95
