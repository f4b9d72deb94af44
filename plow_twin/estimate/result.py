"""The result of an estimate: values with 90 % intervals and states, and faults of model and sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx, log_ndtr, ndtri, ndtri_exp

from plow_twin.estimate.harmonics import Harmonics
from plow_twin.estimate.unknowns import CORRELATED, QUANTITIES

Array = NDArray[np.float64]

#: 95 % quantile of the standard normal distribution, from which the ends of a 90 % interval are derived.
NORMAL_P95: Final = float(ndtri(0.95))


class State(Enum):
    """Reliability of an estimated value."""

    ESTIMATED = "estimated"
    ROUGH = "rough"  #: the machine differs from the model, or the interval is wide
    NOT_OBSERVABLE = "not_observable"  #: the prior's value, because the motion does not determine the quantity
    PRIOR = "prior"  #: the prior's value, because the quantity was not measured
    WITHDRAWN = "withdrawn"  #: the sensor is faulty, the data are contradictory, or no motion of the model fits

    @property
    def known(self) -> bool:
        """Whether the measurements determine the value."""
        return self in (State.ESTIMATED, State.ROUGH)


@dataclass(frozen=True)
class Interval:
    """A value with the 5 % and 95 % quantiles of its distribution."""

    mean: float
    p05: float
    p95: float

    @staticmethod
    def normal(mean: float, deviation: float) -> Interval:
        """Return mean, 5 % quantile and 95 % quantile of a normal distribution."""
        return Interval.of_halves(mean, deviation, deviation)

    @staticmethod
    def of_halves(mean: float, below: float, above: float) -> Interval:
        """Return the interval of a distribution of two normal halves with the deviations `below` and `above`."""
        return Interval(float(mean), float(mean - NORMAL_P95 * below), float(mean + NORMAL_P95 * above))

    @property
    def deviation(self) -> float:
        """Standard deviation of the normal distribution with the same 5 % and 95 % quantiles."""
        return (self.p95 - self.p05) / (2.0 * NORMAL_P95)

    def times(self, unit: float) -> Interval:
        """Return the interval with value and quantiles multiplied by `unit`."""
        return Interval(self.mean * unit, self.p05 * unit, self.p95 * unit)

    def above(self, least: float) -> Interval:
        """Return the interval of the normal distribution truncated below `least`."""
        deviation = self.deviation
        if deviation <= 0.0 or (least - self.mean) < -4.0 * deviation:
            return self
        mean, p05, p95 = (self.mean + deviation * value for value in _tail((least - self.mean) / deviation))
        return Interval(mean, p05, p95)


def _tail(least: float) -> tuple[float, float, float]:
    """Return mean, 5 % quantile and 95 % quantile of the standard normal distribution truncated below `least`.

    The import of `scipy.stats.truncnorm` would take half a second.
    """
    p05, p95 = (-float(ndtri_exp(math.log(share) + log_ndtr(-least))) for share in (0.95, 0.05))
    return math.sqrt(2.0 / math.pi) / float(erfcx(least / math.sqrt(2.0))), p05, p95


@dataclass(frozen=True)
class Cell:
    """Estimated properties of a load cell.

    rows : number of rows in which the pair of the cell is in or near contact
    gain : measured force divided by true force
    offset : median of the readings during flight in N
    noise : standard deviation of the readings during flight in N
    left_over : share of the force that neither the motion nor the noise explains
    """

    rows: int
    gain: Interval
    offset: float
    noise: float
    left_over: float


@dataclass(frozen=True)
class ForcesUsed:
    """Use of measured contact forces in an estimate.

    cells : properties of the load cells, by pair
    delay : delay in s of the stamps of the forces relative to the motion
    unused : reason why the forces were not used; empty if they were used
    """

    cells: dict[str, Cell] = field(default_factory=dict)
    delay: Interval | None = None
    unused: str = ""

    def in_units(self, force: float, time: float) -> ForcesUsed:
        """Return the result converted to SI from given units of force and time."""
        cells = {
            name: replace(cell, offset=cell.offset * force, noise=cell.noise * force)
            for name, cell in self.cells.items()
        }
        return replace(self, cells=cells, delay=None if self.delay is None else self.delay.times(time))

    def as_dict(self) -> dict[str, Any]:
        """Return the result as JSON values."""
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


@dataclass(frozen=True, eq=False)
class Motion:
    """The measured motion, and the fitted motion with the bias and delay of the sensor.

    t : (n,) stamps in s
    measured : (n, 3) x, y in m and theta in rad, NaN without a measurement
    model : (n, 3) fitted motion in the same units, NaN where the model was not fitted
    """

    t: Array
    measured: Array
    model: Array

    @property
    def residual(self) -> Array:
        """Measured motion minus fitted motion, shape (n, 3)."""
        return self.measured - self.model

    def in_units(self, length: float, time: float) -> Motion:
        """Return the motion converted to SI from given units of length and time."""
        scale = np.array([length, length, 1.0])
        return Motion(self.t * time, self.measured * scale, self.model * scale)

    def moved(self, by: Array) -> Motion:
        """Return the motion with `by` (x, y, theta), shape (3,), added to the measured and to the fitted poses."""
        return Motion(self.t, self.measured + by, self.model + by)


@dataclass(frozen=True)
class Estimate:
    """Result of the estimate from one window.

    Attributes
    ----------
    t_start, t_end : float
        Beginning and end of the window in s.
    horizontal, vertical : Interval
        Clearances in m. The fields `horizontal_state` and `vertical_state` contain the states of the clearances.
    stiffness, damping : Interval
        Stiffness K in N/m^n, and damping or restitution of the contact law.
    gain_fx, gain_fy, gain_m : Interval
        True load divided by measured load.
    bias_x, bias_y, bias_theta : Interval
        Measured minus true pose in m, m, rad.
    delay : Interval
        Delay in s of the stamps of the poses relative to the motion.
    noise : tuple of float
        Standard deviation of the measured x, y, theta in m, m, rad.
    model, sensor : str
        Either `ok` or `suspect`; the field `reasons` contains the causes.
    lost : int
        Number of rows that could not be used.
    correlation : tuple of tuple of float
        Correlation matrix of the quantities in `CORRELATED`. For example, errors of clearance and stiffness can
        partly compensate each other.
    groups : dict of str to (Interval, State)
        Clearance in m between facing pads: `horizontal_top`, `horizontal_bottom`, `vertical_left`,
        `vertical_right`.
    forces_measured : ForcesUsed, optional
        Use of measured contact forces; None if no forces were measured.
    differs : dict of str to (float, float, float)
        Probability, mean and standard deviation of a difference from the scene, for each further quantity of the
        machine and of the sensor.
    apparent : tuple of (Interval, Interval), optional
        Clearances in m that a machine with exactly the scene's frame would need to move like the measured machine. If
        they are more accurate than the true clearances, they are present, and twins are drawn from them.
    load_harmonics : Harmonics, optional
        Harmonics that are missing from the measured load, with times of the window; None without evidence of
        harmonics.
    motion : Motion, optional
        The fitted motion, which is not part of `as_dict`; None if the fit does not give it at each time.
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
    apparent: tuple[Interval, Interval] | None = None
    load_harmonics: Harmonics | None = None
    motion: Motion | None = field(default=None, compare=False, repr=False)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Estimate:
        """Return the estimate from `data`, a result of `as_dict`, but without groups, figures and motion."""

        def clearance(name: str) -> tuple[Interval, State]:
            facts = data[name]
            return Interval(facts["mean_m"], facts["p05_m"], facts["p95_m"]), State(facts["state"])

        (horizontal, horizontal_state), (vertical, vertical_state) = clearance("horizontal"), clearance("vertical")
        others: dict[str, Any] = {
            quantity.name: Interval(**data[quantity.name])
            for quantity in QUANTITIES
            if quantity.name in data and quantity.name not in ("horizontal", "vertical")
        }
        correlation, apparent, harmonics = data["correlation"], data.get("apparent"), data.get("load_harmonics")
        others["differs"] = {
            name: (difference["probability"], difference["by"], difference["deviation"])
            for name, difference in data["differs"].items()
        }
        if apparent is not None:
            others["apparent"] = tuple(Interval(**apparent[name]) for name in ("horizontal", "vertical"))
        if harmonics is not None:
            others["load_harmonics"] = Harmonics.from_dict(harmonics)
        return cls(
            data["t_start"], data["t_end"], horizontal, vertical, horizontal_state, vertical_state,
            noise=None if data["noise"] is None else tuple(data["noise"]), model=data["model"], sensor=data["sensor"],
            reasons=tuple(data["reasons"]), lost=data["lost"],
            correlation=None if correlation is None else tuple(tuple(row) for row in correlation["matrix"]), **others,
        )  # fmt: skip

    def _repr_html_(self) -> str:
        states = {"horizontal": self.horizontal_state, "vertical": self.vertical_state}
        values, rows = self.values(), []
        for shown in (quantity for quantity in QUANTITIES if quantity.name in values):
            value = values[shown.name].times(shown.factor)
            cells = [shown.label, *(format(number, shown.digits) for number in (value.mean, value.p05, value.p95))]
            cells.append(states[shown.name].value.replace("_", " ") if shown.name in states else "")
            rows.append("".join(f"<td>{escape(cell)}</td>" for cell in cells))
        title = f"window from {self.t_start:.2f} s to {self.t_end:.2f} s; {self.trust}"
        heads = "".join(f"<th>{name}</th>" for name in ("", "mean", "5 %", "95 %", ""))
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        reasons = "".join(f"<p>{escape(reason)}</p>" for reason in self.reasons)
        return f"<table><caption>{title}</caption><tr>{heads}</tr>{body}</table>{reasons}"

    @property
    def clearances(self) -> tuple[Interval, Interval]:
        """Horizontal and vertical clearance in m."""
        return self.horizontal, self.vertical

    @property
    def states(self) -> tuple[State, State]:
        """States of the horizontal and the vertical clearance."""
        return self.horizontal_state, self.vertical_state

    @property
    def unchecked(self) -> bool:
        """Whether the measurements were too few to check the model and the sensor."""
        return self.states == (State.PRIOR, State.PRIOR)

    @property
    def trust(self) -> str:
        """Text with the results of the checks of the model and the sensor."""
        return "model and sensor not checked" if self.unchecked else f"model {self.model}, sensor {self.sensor}"

    def having(self, clearances: Sequence[Interval], states: Sequence[State], **others: Any) -> Estimate:
        """Return the estimate with other clearances, states of clearances, and fields `others`."""
        (horizontal, vertical), (first, second) = clearances, states
        return replace(
            self, horizontal=horizontal, vertical=vertical, horizontal_state=first, vertical_state=second, **others
        )

    def in_scene_frame(self) -> tuple[Interval, Interval]:
        """Return the clearances for a frame of exactly the scene's size: `apparent` if present, else the clearances."""
        return self.apparent or self.clearances

    def values(self) -> dict[str, Interval]:
        """Return all estimated values, by the names of `QUANTITIES`."""
        every = ((quantity.name, getattr(self, quantity.name)) for quantity in QUANTITIES)
        return {name: value for name, value in every if value is not None}

    def as_dict(self) -> dict[str, Any]:
        """Return the estimate as JSON values, in the format of `plow-twin estimate --json`."""

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
            **(
                {}
                if self.apparent is None
                else {"apparent": dict(zip(("horizontal", "vertical"), map(asdict, self.apparent), strict=True))}
            ),
            **({} if self.load_harmonics is None else {"load_harmonics": self.load_harmonics.as_dict()}),
            **({} if self.forces_measured is None else {"forces_measured": self.forces_measured.as_dict()}),
        }
