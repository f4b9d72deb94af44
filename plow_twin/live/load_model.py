"""Compute the load on the head, and its standard deviation, from signals of the drive.

The cutting force Z along the face is computed in two ways:

- From the drive, the force is Z = C - idle, where C is the chain force. If C is not measured, it is computed from the
  motor power P and the speed v as C = efficiency P / v.
- From the coal, the force is Z = specific_force * depth * resistance(position).

If both forces can be computed, Z is their mean, weighted by the inverse variances. The force into the face is
Fx = push_ratio Z, and the lateral force is Fy = lateral_ratio Z. The forces act at the point (x, y), so that the moment
is M = x Fy - y Fx. The standard deviation of the load is computed from the standard deviations of the coefficients. The
coefficients must be measured at the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from plow_twin.record.map_file import LOAD_MODEL, map_error, read_map_file

#: Smallest speed at which the chain force is computed from the power [m/s].
SLOWEST_M_S: Final = 0.1

Number = tuple[float, float]
Wrench = tuple[float, float, float]


@dataclass(frozen=True)
class LoadModel:
    """Coefficients of the load model. Each coefficient is a mean and a standard deviation."""

    #: ratio of the force into the face to the cutting force
    push_ratio: Number
    #: point of action x, y from the centre of the cavity [m]
    at_m: tuple[float, float]
    #: ratio of the lateral force to the cutting force
    lateral_ratio: Number = (0.0, 0.0)
    #: ratio of the power at the chain to the motor power
    efficiency: Number | None = None
    #: chain force without cutting [N]
    idle_force_n: Number = (0.0, 0.0)
    #: cutting force per metre of depth [N/m]
    specific_force_n_m: Number | None = None
    #: positions along the face [m], and the factor of the specific force at each position; the factor is interpolated
    #: linearly
    resistance: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def cutting_force(self, drive: Mapping[str, float]) -> Number | None:
        """Return the mean and the standard deviation of the cutting force [N], which is zero at a standstill.

        The signals are `power` [W], `chain_force` [N], `speed` [m/s], `depth` [m] and `position` [m]. A signal may be
        missing or NaN. The result is None if the signals are not sufficient.
        """
        signals = {name: value for name, value in drive.items() if math.isfinite(value)}
        if abs(signals.get("speed", math.inf)) < SLOWEST_M_S and "chain_force" not in signals:
            return 0.0, 0.0
        opinions = [load for load in (self._by_drive(signals), self._by_coal(signals)) if load is not None]
        if not opinions:
            return None
        deviations = [max(deviation, 1.0) for _, deviation in opinions]
        # the weights are relative to the smallest deviation, so that they do not overflow for huge numbers
        smallest = min(deviations)
        shares = [smallest / deviation for deviation in deviations]
        total = sum(share * share for share in shares)
        mean = sum(share * share * value for share, (value, _) in zip(shares, opinions, strict=True)) / total
        return max(mean, 0.0), smallest / math.sqrt(total)

    def wrench(self, drive: Mapping[str, float]) -> tuple[Wrench, Wrench] | None:
        """Return Fx, Fy [N], M [N m] and their standard deviations, or None if the signals are not sufficient."""
        force = self.cutting_force(drive)
        if force is None:
            return None
        z, spread = force
        push, lateral = self.push_ratio, self.lateral_ratio
        fx, fy = push[0] * z, lateral[0] * z
        x, y = self.at_m
        arms = (x * lateral[1], y * push[1])
        deviations = (
            math.hypot(push[0] * spread, z * push[1], spread * push[1]),
            math.hypot(lateral[0] * spread, z * lateral[1], spread * lateral[1]),
            math.hypot(
                (x * lateral[0] - y * push[0]) * spread, *(z * arm for arm in arms), *(spread * arm for arm in arms)
            ),
        )
        return (fx, fy, x * fy - y * fx), deviations

    def _by_drive(self, signals: Mapping[str, float]) -> Number | None:
        if "chain_force" in signals:
            pull, deviation = signals["chain_force"], 0.0
        elif self.efficiency is not None and "power" in signals and abs(signals.get("speed", 0.0)) >= SLOWEST_M_S:
            share = signals["power"] / abs(signals["speed"])
            pull, deviation = self.efficiency[0] * share, self.efficiency[1] * abs(share)
        else:
            return None
        return pull - self.idle_force_n[0], math.hypot(deviation, self.idle_force_n[1])

    def _by_coal(self, signals: Mapping[str, float]) -> Number | None:
        if self.specific_force_n_m is None or "depth" not in signals:
            return None
        factor = 1.0
        if self.resistance is not None:
            if "position" not in signals:
                return None
            factor = float(np.interp(signals["position"], *self.resistance))
        force, deviation = self.specific_force_n_m
        return force * factor * signals["depth"], deviation * factor * abs(signals["depth"])


def read_load_model(path: Path | None) -> LoadModel | None:
    """Return the load model in a mapping file, or None if the file has no load model.

    Raise `MapError` if the file or the load model is invalid.
    """
    entry = None if path is None else read_map_file(path).get(LOAD_MODEL)
    if path is None or entry is None:
        return None
    values: dict[str, Any] = {name: _floats(value) for name, value in entry.items() if name != "resistance"}
    if "resistance" in entry:
        places, factors = (_floats(entry["resistance"][key]) for key in ("position_m", "factor"))
        if len(places) != len(factors) or not all(later > earlier for earlier, later in pairwise(places)):
            key, expected = f"{LOAD_MODEL}.resistance", "rising position_m and as many factors"
            raise map_error(path, key, entry["resistance"], expected)
        values["resistance"] = places, factors
    return LoadModel(**values)


def _floats(values: list[float]) -> tuple[float, ...]:
    return tuple(map(float, values))
