"""Answers for one window of measurements: the estimate and, on request, contact forces and a forecast of the wear."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any, Final

from plow_twin.estimate import tuning
from plow_twin.estimate.estimate import Guess, estimate_window
from plow_twin.estimate.forces import ForcesError, forces_of
from plow_twin.estimate.forecast import Plan, forecast, with_estimate
from plow_twin.estimate.life import LifeError, period_of
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.result import Estimate, State
from plow_twin.estimate.window import Window
from plow_twin.model.scene import Scene, Table

#: Length in load periods of the part before the evaluated span, derived from the decay of the members' initial states.
_SETTLE_PERIODS: Final = 1.0
#: Longest interval between two knots of a load as a share of its period, derived from twice `tuning.LOAD_KNOT` for the
#: paper's machine.
_KNOT_SHARE: Final = 1.0 / 400.0


@dataclass(frozen=True)
class Requests:
    """Settings of the answers that a caller may request in addition to the estimate: contact forces and a forecast.

    members : number of twins from which the intervals of the forces are computed; 0 if no forces are requested
    span_s : duration at the end of the window for which forces are computed [s]
    plan : limits of the clearances; None if no forecast is requested
    follows : whether twins will follow the estimate
    """

    members: int = 0
    span_s: float = 0.0
    plan: Plan | None = None
    follows: bool = False


@dataclass(frozen=True, eq=False)
class Answer:
    """The estimate from a window, the first guess for the next window, and the requested additional answers.

    also : the requested answers as JSON values, by the names `forces` and `forecast`. An answer that cannot be computed
    is null, with the reason in `forces_error` or `forecast_error`.
    """

    estimate: Estimate
    following: Guess
    also: dict[str, Any]

    @property
    def text(self) -> str:
        """The whole answer as JSON text."""
        return json.dumps({**self.estimate.as_dict(), **self.also}, allow_nan=False)


def answer(scene: Scene, window: Window, guess: Guess, requests: Requests) -> Answer:
    """Return the estimate from a window, by a fit from `guess`, and the requested answers."""
    result, following = estimate_window(scene, window.load, window.pose, window.lost, guess, window.gaps)
    also: dict[str, Any] = {}
    if requests.members:
        try:
            also["forces"] = _forces(scene, result, window.load, requests)
        except ForcesError as error:
            also |= {"forces": None, "forces_error": str(error)}
    if requests.plan is not None:
        try:
            also["forecast"] = forecast_from(scene, result, window.load, requests.plan)
        except LifeError as error:
            also |= {"forecast": None, "forecast_error": str(error)}
    return Answer(result, following, also)


def _forces(scene: Scene, result: Estimate, load: Load, requests: Requests) -> dict[str, Any]:
    if State.PRIOR in result.states:
        raise ForcesError("estimate: got only the prior, expected an estimated clearance")
    if load.constant:
        raise ForcesError("load: got the same value throughout, expected a measured load")
    period = load.period()
    settle, end = _SETTLE_PERIODS * period, float(load.t[-1])
    measured_load = followed(load.between(end - requests.span_s - settle, end), period)
    return forces_of(scene, result, measured_load, requests.members, settle, over_time=False).as_dict()


def followed(load: Load, period: float) -> Load:
    """Return the load without samples that hardly change the motion of the members."""
    knots = int((load.t[-1] - load.t[0]) / min(tuning.LOAD_KNOT, _KNOT_SHARE * period))
    thin = load.thinned(2.0 * tuning.TOLERANCE)
    return load.averaged(knots) if len(thin.t) > knots else thin


def forecast_from(scene: Scene, result: Estimate, load: Load, plan: Plan) -> dict[str, Any]:
    """Return the forecast that starts from an estimate, as JSON values.

    The forecast repeats the load of the window with the estimated gains, or the load of the scene if the window
    contains too few load periods.

    Raises
    ------
    LifeError
        If the estimate is withdrawn, or if the scene has no wear or does not travel.
    """
    now, deviation = with_estimate(scene, result.as_dict())
    return forecast(under_load(now, result, load), plan, deviation).as_dict()


def under_load(scene: Scene, result: Estimate, load: Load) -> Scene:
    """Return the scene under the load of a window times the estimated gains, if it has enough load periods."""
    gains = [1.0 if gain is None else gain.mean for gain in (result.gain_fx, result.gain_fy, result.gain_m)]
    measured_load = load.thinned() if result.load_harmonics is None else result.load_harmonics.added(load.thinned())
    loaded = replace(
        scene, loads=(Table("window", measured_load.t - measured_load.t[0], measured_load.wrench * gains),)
    )
    try:
        period_of(loaded)
    except LifeError:
        return scene
    return loaded
