"""Forecast of the remaining life, the time until a clearance reaches its limit, as a distribution.

The wear coefficient, the present clearances and the size of the load are drawn at random. A scenario repeats the
forecast with the same random numbers, but with a different load or wear coefficient.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.coefficient import Coefficient
from plow_twin.estimate.life import LifeError, Path, wear_in_travel, wear_path
from plow_twin.estimate.result import NORMAL_P95, State
from plow_twin.estimate.unknowns import contact_with
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y, PAIR_COUNT
from plow_twin.model.scene import Clearance, Scene, Table, Wear

Array = NDArray[np.float64]

#: Seconds per hour, by definition.
HOUR_S = 3600.0
#: Upper bound on the share by which a drawn clearance is smaller than the estimated clearance.
_LEAST_SHARE = 0.9


@dataclass(frozen=True)
class Scenario:
    """Multiples of the expected load and of the expected wear coefficient for a forecast."""

    name: str
    load: float = 1.0
    coefficient: float = 1.0

    @staticmethod
    def parse(text: str) -> Scenario:
        """Return the scenario of a text like `hard coal:load=1.3,coefficient=2`.

        Raises
        ------
        LifeError
            If the text has a different form, or a multiple is not above 0.
        """
        name, _, settings = text.partition(":")
        numbers = {}
        for part in settings.split(","):
            key, _, value = part.partition("=")
            try:
                numbers[key.strip()] = float(value)
            except ValueError:
                numbers[key.strip()] = math.nan
        good = bool(name.strip()) and numbers.keys() <= {"load", "coefficient"}
        if not good or not all(0.0 < value < math.inf for value in numbers.values()):
            raise LifeError(f"scenario: got {text!r}, expected NAME:load=X,coefficient=Y, one or both factors, above 0")
        return Scenario(name.strip(), **numbers)


@dataclass(frozen=True)
class Plan:
    """Settings of a forecast, such as the limits of the clearances [m] and the horizon [h]."""

    limit_horizontal_m: float
    limit_vertical_m: float
    horizon_h: float
    stop_h: float | None = None
    face_length_m: float = 250.0
    shift_h: float = 8.0
    #: relative standard deviation of the size of the load
    load_deviation: float = 0.05
    draws: int = 2000
    seed: int = 0
    scenarios: tuple[Scenario, ...] = ()

    def __post_init__(self) -> None:
        """Raise `LifeError` for an impossible plan."""
        settings = ("limit_horizontal_m", "limit_vertical_m", "horizon_h", "stop_h", "face_length_m", "shift_h")
        for name in (*settings, "load_deviation"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise LifeError(f"{name}: got {value}, expected a finite number >= 0")
        if self.stop_h is not None and self.stop_h > self.horizon_h:
            raise LifeError(f"stop_h: got {self.stop_h:g} h, expected at most the horizon of {self.horizon_h:g} h")
        names = [scenario.name for scenario in self.scenarios]
        if len(set(names)) < len(names):
            raise LifeError(f"scenarios: got the names {', '.join(names)}, expected distinct names")


@dataclass(frozen=True, eq=False)
class Forecast:
    """Distribution of the hours until a clearance reaches its limit.

    hours : (draws,) hours to the limit; infinite if the limit is not reached within the horizon
    rate : (draws,) exposure per hour in 1/N
    now : (draws, 2) present clearances in m
    speed_m_s : travel speed in m/s
    plan : the plan of this forecast
    path : wear path that begins at the present clearances
    scenarios : forecast of each scenario of the plan, by name
    """

    hours: Array
    rate: Array
    now: Array
    speed_m_s: float
    plan: Plan
    path: Path
    scenarios: dict[str, Forecast] = field(default_factory=dict)

    def quantile(self, share: float) -> float | None:
        """Return the hours within which the limit is reached with the probability `share`; None beyond the horizon."""
        value = float(np.sort(self.hours)[min(int(share * len(self.hours)), len(self.hours) - 1)])
        return value if math.isfinite(value) else None

    def probability_before(self, hours: float) -> float:
        """Return the probability that the limit is reached within a number of hours."""
        return float(np.mean(self.hours <= hours))

    def clearances(self, hours: Array) -> Array:
        """Return the 10 %, 50 % and 90 % quantiles of both clearances in m after `hours`, shape (n,), as (3, n, 2).

        At the end of the path, where a limit is reached, the clearances stop.
        """
        growth = self.path.clearance_growth()
        exposure = np.multiply.outer(self.rate, hours)
        each = [self.now[:, axis, None] + np.interp(exposure, self.path.exposure, growth[:, axis]) for axis in range(2)]
        return np.quantile(np.stack(each, axis=2), (0.1, 0.5, 0.9), axis=0, method="lower")

    def as_dict(self) -> dict[str, Any]:
        """Return the forecast as JSON values; times beyond the horizon are null."""
        plan = self.plan
        return {
            **self._times(),
            "horizon_h": plan.horizon_h,
            "limit_m": [plan.limit_horizontal_m, plan.limit_vertical_m],
            "path_steps": len(self.path.exposure),
            "path_error_m": self.path.error,
            "scenarios": {
                scenario.name: {
                    "load": scenario.load,
                    "coefficient": scenario.coefficient,
                    **self.scenarios[scenario.name]._times(),
                }
                for scenario in plan.scenarios
            },
        }

    def _times(self) -> dict[str, Any]:
        plan, out = self.plan, {}
        for name, share in (("p10", 0.10), ("p50", 0.50), ("p90", 0.90)):
            hours = self.quantile(share)
            km = None if hours is None else hours * HOUR_S * self.speed_m_s / 1000.0
            out[name] = {
                "hours": hours,
                "km": km,
                "passes": None if km is None else km * 1000.0 / plan.face_length_m,
                "shifts": None if hours is None else hours / plan.shift_h,
            }
        return {
            **out,
            "not_reached_in_horizon": float(np.mean(~np.isfinite(self.hours))),
            "probability_before_stop": None if plan.stop_h is None else self.probability_before(plan.stop_h),
        }


def forecast(
    scene: Scene, plan: Plan, deviation_m: tuple[float, float] = (0.0, 0.0), known: Coefficient | None = None
) -> Forecast:
    """Return the forecast of the time at which a clearance of the scene reaches its limit.

    Parameters
    ----------
    scene : Scene
        A scene with wear, the present clearances and the expected loads. `wear.prior_m2_n` contains the 5 % and 95 %
        quantiles of the log-normal distribution of the wear coefficient.
    plan : Plan
        Limits and operation of the machine.
    deviation_m : tuple of float
        Standard deviations of the present clearances in m.
    known : Coefficient or None
        Posterior of the wear coefficient from a history of clearances; None for the prior. It includes the uncertainty
        of the load, so the model error `tuning.PATH_DEVIATION` is drawn instead of the size of the load.

    Raises
    ------
    LifeError
        If the scene has no wear, no travel or no period, or if its wear coefficient lies outside the prior.
    """
    others = {
        scenario.name: _forecast(with_load(scene, scenario.load), plan, deviation_m, known, scenario.coefficient)
        for scenario in plan.scenarios
    }
    return replace(_forecast(scene, plan, deviation_m, known), scenarios=others)


def _forecast(
    scene: Scene,
    plan: Plan,
    deviation_m: tuple[float, float],
    coefficient_known: Coefficient | None,
    multiple: float = 1.0,
) -> Forecast:
    wear = wear_in_travel(scene)
    if not all(0.0 <= value < math.inf for value in deviation_m):
        raise LifeError(f"deviations: got {deviation_m} m, expected two finite numbers >= 0")
    if coefficient_known is None:
        check_prior(wear)
    low, high = (math.log(value) for value in wear.prior_m2_n)
    travel = plan.horizon_h * HOUR_S * wear.travel_speed_m_s
    rng = np.random.default_rng(plan.seed)
    coefficient = np.exp(rng.normal(0.5 * (low + high), (high - low) / (2.0 * NORMAL_P95), plan.draws))
    load = np.maximum(1.0 + plan.load_deviation * rng.standard_normal(plan.draws), 0.1)
    if coefficient_known is not None:
        coefficient = coefficient_known.draw(plan.draws, rng)
        load = 1.0 + tuning.PATH_DEVIATION * rng.standard_normal(plan.draws)
    coefficient = coefficient * multiple
    size = np.array([scene.clearance.horizontal_m, scene.clearance.vertical_m])
    # a drawn clearance must stay above zero
    now = np.maximum(rng.normal(0.0, 1.0, (plan.draws, 2)) * deviation_m, -_LEAST_SHARE * size)
    most = float(coefficient.max() * load.max()) * travel / wear.pad_area_m2
    # even the smallest drawn clearance must reach its limit
    spare = tuple(float(value) for value in -now.min(axis=0))
    limit = (plan.limit_horizontal_m + spare[0], plan.limit_vertical_m + spare[1])
    path = wear_path(scene, limit, most)
    clearance = size + path.clearance_growth()
    limits = np.array([plan.limit_horizontal_m, plan.limit_vertical_m])
    needed = np.minimum(
        *(_exposure_at(path.exposure, *pair) for pair in zip(clearance.T, (limits - now).T, strict=True))
    )
    rate = coefficient * load * wear.travel_speed_m_s * HOUR_S / wear.pad_area_m2
    hours = needed / rate
    reached = np.where(hours <= plan.horizon_h, hours, np.inf)
    return Forecast(reached, rate, size + now, wear.travel_speed_m_s, plan, path)


def check_prior(wear: Wear) -> None:
    """Raise `LifeError` if the wear coefficient of the scene lies outside the prior that forecasts use."""
    low, high = wear.prior_m2_n
    if not low <= wear.coefficient_m2_n <= high:
        raise LifeError(
            f"wear.coefficient_m2_n: got {wear.coefficient_m2_n:g} m^2/N, expected a value within wear.prior_m2_n, "
            f"{low:g} to {high:g}: the forecast draws from this prior"
        )


def _exposure_at(exposure: Array, clearance: Array, limit: Array) -> Array:
    """Return the exposure at which a non-decreasing clearance reaches each limit; infinite for a limit out of reach."""
    rising = np.maximum.accumulate(clearance) + 1e-15 * np.arange(len(clearance))
    at = np.interp(limit, rising, exposure)
    return np.where(limit > rising[-1], np.inf, np.where(limit <= rising[0], 0.0, at))


def with_load(scene: Scene, multiple: float) -> Scene:
    """Return the scene with all loads except gravity multiplied by `multiple`."""

    def times(values: tuple[float, float]) -> tuple[float, float]:
        return multiple * values[0], multiple * values[1]

    return replace(
        scene,
        loads=tuple(
            replace(load, wrench=multiple * load.wrench)
            if isinstance(load, Table)
            else replace(load, force_n=times(load.force_n), moment_n_m=multiple * load.moment_n_m)
            for load in scene.loads
        ),
    )


def with_clearances(scene: Scene, horizontal_m: float, vertical_m: float, depth: Array | None = None) -> Scene:
    """Return the scene with estimated clearances, which are clearances of worn pads.

    `depth`, shape (8,), contains the wear depths of the pads in m. For a scene with running-in, in which worn pads wear
    more slowly than new pads, the default is computed from the growth of the clearances.
    """
    wear, new = scene.wear, scene.clearance
    if wear is None:
        return replace(scene, clearance=Clearance(horizontal_m, vertical_m))
    if depth is None:
        depth = np.zeros(PAIR_COUNT)
        if wear.running_in_ratio > 1.0:
            # each of two opposite walls is assumed to contribute half of the growth of the clearance
            depth += 0.5 * max(horizontal_m - new.horizontal_m, 0.0) * np.abs(NORMAL_X)
            depth += 0.5 * max(vertical_m - new.vertical_m, 0.0) * np.abs(NORMAL_Y)
    growth = 0.5 * depth @ np.abs(NORMAL_X), 0.5 * depth @ np.abs(NORMAL_Y)
    clearance = Clearance(horizontal_m - float(growth[0]), vertical_m - float(growth[1]))
    return replace(scene, clearance=clearance, wear=replace(wear, initial_depth_m=tuple(depth.tolist())))


def with_estimate(scene: Scene, facts: Mapping[str, Any]) -> tuple[Scene, tuple[float, float]]:
    """Return the scene with the values of an estimate (JSON), and the standard deviations of the clearances in m.

    The estimated contact parameters are used if a clearance was estimated.

    Raises
    ------
    LifeError
        If the estimate is withdrawn, or `facts` is not an estimate.
    """
    if not isinstance(facts, Mapping):
        raise LifeError(f"estimate: got {type(facts).__name__}, expected the output of `plow-twin estimate --json`")
    horizontal, vertical = (_estimated(name, facts.get(name)) for name in ("horizontal", "vertical"))
    estimated = any(State(facts[name]["state"]).known for name in ("horizontal", "vertical"))
    if estimated and "stiffness" in facts:
        damping = _mean("damping", facts["damping"]) if "damping" in facts else None
        scene = replace(scene, contact=contact_with(scene.contact, _mean("stiffness", facts["stiffness"]), damping))
    return with_clearances(scene, horizontal[0], vertical[0]), (horizontal[1], vertical[1])


def _mean(name: str, facts: Any) -> float:
    try:
        mean = float(facts["mean"])
    except (KeyError, TypeError, ValueError):
        mean = math.nan
    if not 0.0 < mean < math.inf:
        raise LifeError(f"estimate: {name}: got {reprlib.repr(facts)}, expected an interval with a mean above 0")
    return mean


def _estimated(name: str, facts: Any) -> tuple[float, float]:
    try:
        state = State(facts["state"])
        mean, low, high = (float(facts[key]) for key in ("mean_m", "p05_m", "p95_m"))
    except (KeyError, TypeError, ValueError) as error:
        raise LifeError(
            f"estimate: {name}: got {reprlib.repr(facts)}, expected the output of `plow-twin estimate --json`: state, "
            "mean_m, p05_m, p95_m"
        ) from error
    if state is State.WITHDRAWN:
        raise LifeError(f"estimate: got a withdrawn {name} clearance, expected a valid one")
    if not (mean > 0.0 and -math.inf < low <= mean <= high < math.inf):
        raise LifeError(f"estimate: {name}: got {mean} m from {low} to {high}, expected finite values in order")
    return mean, (high - low) / (2.0 * NORMAL_P95)
