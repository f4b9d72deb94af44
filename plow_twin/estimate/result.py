"""What an estimate says: values with 90 % intervals, the state of each, and whether model and sensor can be trusted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from statistics import NormalDist
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.unknowns import CORRELATED, QUANTITIES

Array = NDArray[np.float64]

#: Quantile of the normal distribution at which a 90 % interval ends.
NORMAL_P95: Final = 1.6448536269514722
_STANDARD: Final = NormalDist()
#: Standard deviations beyond which the normal distribution's tail is as good as exponential.
_FAR = 30.0


class State(Enum):
    """How far a value can be relied on."""

    ESTIMATED = "estimated"
    ROUGH = "rough"  #: the machine is not exactly the model: an interval that allows for it
    NOT_OBSERVABLE = "not_observable"  #: the motion does not tell it: what was known before, with its interval
    PRIOR = "prior"  #: nothing was measured
    WITHDRAWN = "withdrawn"  #: the sensor is broken, or the data contradict themselves or every motion of the model

    @property
    def known(self) -> bool:
        """Whether the measurements determine the value."""
        return self in (State.ESTIMATED, State.ROUGH)


@dataclass(frozen=True)
class Interval:
    """A value with the 5 % and 95 % points of what it may be."""

    mean: float
    p05: float
    p95: float

    @staticmethod
    def normal(mean: float, deviation: float) -> Interval:
        """Return the interval of a normal distribution."""
        half = NORMAL_P95 * float(deviation)
        return Interval(float(mean), float(mean) - half, float(mean) + half)

    @property
    def deviation(self) -> float:
        """Standard deviation of the normal distribution that has this interval."""
        return (self.p95 - self.p05) / (2.0 * NORMAL_P95)

    def times(self, unit: float) -> Interval:
        """Return the interval of the value times a unit."""
        return Interval(self.mean * unit, self.p05 * unit, self.p95 * unit)

    def above(self, least: float) -> Interval:
        """Return the interval of the same normal distribution cut off below `least`."""
        deviation = self.deviation
        if deviation <= 0.0 or (least - self.mean) < -4.0 * deviation:
            return self
        mean, p05, p95 = (self.mean + deviation * value for value in _tail((least - self.mean) / deviation))
        return Interval(mean, p05, p95)


def _tail(least: float) -> tuple[float, float, float]:
    """Return mean, 5 % and 95 % points of a standard normal number that is known to be above `least`.

    Beside scipy's `truncnorm`, whose import takes half a second.
    """
    if least > _FAR:  # exponential there
        return least + 1.0 / least, least - math.log(0.95) / least, least - math.log(0.05) / least
    share = 0.5 * math.erfc(least / math.sqrt(2.0))
    mean = math.exp(-0.5 * least * least) / (math.sqrt(2.0 * math.pi) * share)
    return mean, -_STANDARD.inv_cdf(0.95 * share), -_STANDARD.inv_cdf(0.05 * share)


@dataclass(frozen=True)
class Cell:
    """What was found of a load cell.

    rows : rows in or near contact behind it
    gain : measured over true force
    offset, noise : what it shows in flight, and its standard deviation there, in N
    left_over : share of its force that is left over beyond the noise
    """

    rows: int
    gain: Interval
    offset: float
    noise: float
    left_over: float


@dataclass(frozen=True)
class ForcesUsed:
    """How measured contact forces were used.

    cells : by pair
    delay : by which their stamps are later than the motion, in s
    unused : why they make nothing better; empty where they do
    """

    cells: dict[str, Cell] = field(default_factory=dict)
    delay: Interval | None = None
    unused: str = ""

    def in_units(self, force: float, time: float) -> ForcesUsed:
        """Return it where forces and times were in these units."""
        cells = {
            name: replace(cell, offset=cell.offset * force, noise=cell.noise * force)
            for name, cell in self.cells.items()
        }
        return replace(self, cells=cells, delay=None if self.delay is None else self.delay.times(time))

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        cells = {
            name: {
                "rows": cell.rows,
                "gain": asdict(cell.gain),
                "offset_n": cell.offset,
                "noise_n": cell.noise,
                "left_over": cell.left_over,
            }
            for name, cell in self.cells.items()
        }
        rows = 0 if self.unused else sum(cell.rows for cell in self.cells.values())
        delay = None if self.delay is None else asdict(self.delay)
        return {"rows": rows, "unused": self.unused, "delay": delay, "pairs": cells}


@dataclass(frozen=True)
class Estimate:
    """Everything that is estimated from one window.

    Attributes
    ----------
    t_start, t_end : float
        The window in s.
    horizontal, vertical : Interval
        Clearances in m; their states beside them.
    stiffness, damping : Interval
        K in N/m^n; the number that the law takes (its restitution, or its damping).
    gain_fx, gain_fy, gain_m : Interval
        Load over the load believed.
    bias_x, bias_y, bias_theta : Interval
        Measured minus true pose in m, m, rad.
    delay : Interval
        By which the stamps are later than the motion, in s.
    noise : tuple of float
        Standard deviation of the measured x, y, theta in m, m, rad.
    model, sensor : str
        `ok` or `suspect`; `reasons` says why.
    lost : int
        Rows that could not be used.
    correlation : tuple of tuple of float
        Correlation of `CORRELATED`; stiffness and clearance stand for each other in part.
    groups : dict of str to (Interval, State)
        Clearance between the pads that face each other: `horizontal_top`, `horizontal_bottom`, `vertical_left`,
        `vertical_right`, in m.
    forces_measured : ForcesUsed, optional
        How measured contact forces were used, where there were some.
    differs : dict of str to (float, float, float)
        Of each further quantity of machine and sensor the probability that it differs from the scene, and by how much
        then: mean and standard deviation.
    """

    t_start: float
    t_end: float
    horizontal: Interval
    vertical: Interval
    horizontal_state: State
    vertical_state: State
    stiffness: Interval
    damping: Interval | None = None
    gain_fx: Interval | None = None
    gain_fy: Interval | None = None
    gain_m: Interval | None = None
    bias_x: Interval | None = None
    bias_y: Interval | None = None
    bias_theta: Interval | None = None
    delay: Interval | None = None
    noise: tuple[float, float, float] | None = None
    model: str = "ok"
    sensor: str = "ok"
    reasons: tuple[str, ...] = ()
    lost: int = 0
    correlation: tuple[tuple[float, ...], ...] | None = None
    figures: dict[str, float] = field(default_factory=dict)
    groups: dict[str, tuple[Interval, State]] = field(default_factory=dict)
    forces_measured: ForcesUsed | None = None
    differs: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Estimate:
        """Return what `as_dict` told of the machine and the sensor that it moves; groups and figures are left out."""

        def clearance(name: str) -> tuple[Interval, State]:
            one = told[name]
            return Interval(one["mean_m"], one["p05_m"], one["p95_m"]), State(one["state"])

        (horizontal, horizontal_state), (vertical, vertical_state) = clearance("horizontal"), clearance("vertical")
        others: dict[str, Any] = {
            quantity.name: Interval(**told[quantity.name])
            for quantity in QUANTITIES
            if quantity.name in told and quantity.name not in ("horizontal", "vertical")
        }
        correlation = told["correlation"]
        return cls(
            told["t_start"], told["t_end"], horizontal, vertical, horizontal_state, vertical_state,
            noise=None if told["noise"] is None else tuple(told["noise"]), model=told["model"], sensor=told["sensor"],
            reasons=tuple(told["reasons"]), lost=told["lost"],
            correlation=None if correlation is None else tuple(tuple(row) for row in correlation["matrix"]), **others,
        )  # fmt: skip

    def values(self) -> dict[str, Interval]:
        """Return all that is told, by the names of `QUANTITIES`."""
        every = ((quantity.name, getattr(self, quantity.name)) for quantity in QUANTITIES)
        return {name: value for name, value in every if value is not None}

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON, as `plow-twin estimate --json` prints it."""

        def clearance(value: Interval, state: State) -> dict[str, Any]:
            return {"mean_m": value.mean, "p05_m": value.p05, "p95_m": value.p95, "state": state.value}

        return {
            "t_start": self.t_start,
            "t_end": self.t_end,
            "horizontal": clearance(self.horizontal, self.horizontal_state),
            "vertical": clearance(self.vertical, self.vertical_state),
            **{name: asdict(value) for name, value in self.values().items() if name not in ("horizontal", "vertical")},
            "noise": None if self.noise is None else list(self.noise),
            "model": self.model,
            "sensor": self.sensor,
            "reasons": list(self.reasons),
            "lost": self.lost,
            "correlation": None
            if self.correlation is None
            else {"names": list(CORRELATED), "matrix": [list(row) for row in self.correlation]},
            "figures": self.figures,
            "groups": {name: clearance(value, state) for name, (value, state) in self.groups.items()},
            "differs": {
                name: {"probability": share, "by": mean, "deviation": deviation}
                for name, (share, mean, deviation) in self.differs.items()
            },
            **({} if self.forces_measured is None else {"forces_measured": self.forces_measured.as_dict()}),
        }
