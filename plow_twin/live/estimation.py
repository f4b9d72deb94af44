"""Pass the measurements of a live twin to another process that computes estimates, and use its results."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from plow_twin.errors import Problem
from plow_twin.estimate.answer import Requests
from plow_twin.estimate.forces import FEWEST
from plow_twin.estimate.forecast import HOUR_S, Plan, Scenario, check_prior
from plow_twin.estimate.life import LifeError
from plow_twin.estimate.measurements import Deviation
from plow_twin.estimate.result import State
from plow_twin.estimate.window import Windows
from plow_twin.estimate.worker import WindowResult, Worker
from plow_twin.live.parameters import ESTIMATES, Settings
from plow_twin.model.scene import Scene
from plow_twin.record import messages as plain
from plow_twin.stream import journal
from plow_twin.stream.session import Series, Session

ESTIMATE, WINDOW_FORCES, FORECAST = ESTIMATES
#: SI unit in which a forecast is published, for each unit in which it is computed.
_SI: Final = {"hours": "seconds", "km": "metres"}
#: Rate of the checks for a finished estimate [Hz].
RATE_HZ: Final = 10.0


class Estimation:
    """Interface of a live twin to the process that computes its estimates."""

    def __init__(self, settings: Settings, scene: Scene) -> None:
        self._frame_id, self._follows = settings.frame_id, settings.follows != "off"
        span = (settings.estimate_window, settings.estimate_interval, settings.rollback_span)
        windows = Windows(*span, settings.head_pose_deviation, settings.excitation_deviation, settings.gaps_deviation)
        requests = requests_of(settings)
        self._start = partial(Worker, scene, windows, requests)
        self.worker = self._start()
        #: number of times that the process was started again
        self.restarts = 0
        self._proven = self._finishing = False  # whether the process has sent an estimate, and whether the input ended
        self._spread: Deviation | None = None
        sent = {ESTIMATE: True, WINDOW_FORCES: bool(requests.members), FORECAST: requests.plan is not None}
        self._topics = [topic for topic, wanted in sent.items() if wanted]
        #: stamp [ns] at which the wear of the pads was set; None after empty messages have withdrawn the old estimate
        self._set_ns: int | None = None
        #: state of each clearance in the last estimate
        self.states = {"horizontal": State.PRIOR, "vertical": State.PRIOR}
        #: agreement of the model and of the sensor with the measurements, according to the last estimate
        self.trust = {"model": "", "sensor": ""}
        self.reasons: tuple[str, ...] = ()
        #: numbers of estimates, and of windows that were skipped for a newer window
        self.count = self.skipped = 0
        self.wall_s = 0.0
        self.end_ns: int | None = None
        #: last forecast, or None; the reason for None is in `forecast_error`
        self.forecast: dict[str, Any] | None = None
        self.forecast_error = "nothing has been estimated yet"
        #: journal entry of the last estimate, which is repeated at the start of a new part of the recording
        self.entry: journal.Estimated | None = None

    @property
    def done(self) -> bool:
        """Whether the last window has been estimated, or the process has failed."""
        return self.worker.ended is not None or bool(self.worker.error)

    @property
    def shortage(self) -> str:
        """Reason why no estimate was computed before the source ended. The text is empty if there is an estimate."""
        return "" if self.count else self.worker.ended or ""

    def add(self, entry: journal.Entry) -> None:
        """Pass a journal entry to the estimating process."""
        match entry:
            case journal.Sample(stamp_ns, wrench):
                self.worker.add_load(stamp_ns, wrench)
            case journal.Pose(stamp_ns, pose, deviation):
                self.worker.add_pose(stamp_ns, pose, deviation)
            case journal.PartOfPose(stamp_ns) as part:
                self.worker.add_pose(stamp_ns, journal.whole_pose(part))
            case journal.Gaps(stamp_ns, pairs, gaps):
                self.worker.add_gaps(stamp_ns, pairs, gaps)
            case journal.Spread(_, deviation):
                self._spread = deviation
                self.worker.set_load_deviation(deviation)
            case journal.SetWear(stamp_ns):
                self.worker.restart()
                self._drop_estimate()
                self._set_ns, self.end_ns = stamp_ns, None
                self.trust, self.reasons = dict.fromkeys(self.trust, ""), ()
                self.forecast, self.forecast_error = None, "nothing has been estimated since the pads were set"
            case journal.SetModel():
                # the new clearances of the model replace the clearances of an older estimate
                self.worker.restart()
                self._drop_estimate()
            case journal.Reset():
                self.worker.restart()
                if self._follows:
                    self._drop_estimate()

    def add_series(self, series: Series) -> None:
        """Pass a series of samples to the estimating process."""
        for stamp_ns, wrench in zip(series.stamps.tolist(), series.wrench.tolist(), strict=True):
            self.worker.add_load(stamp_ns, tuple(wrench))

    def finish(self) -> None:
        """Request the estimate of the last window at the end of the input, after which `done` is true."""
        self._finishing = True
        self.worker.finish()

    def revive(self) -> str:
        """Start the process again if it has ended after an estimate. Return a text about it, otherwise an empty text.

        A process that ends before its first estimate is not started again, because it would probably end again. After
        the end of the input, a new process would have no measurements.
        """
        if not self.worker.error or not self._proven or self._finishing:
            return ""
        try:
            ended, self.worker = self.worker, self._start()
        except OSError:  # the next call tries again
            return ""
        ended.close()
        if self._spread is not None:
            self.worker.set_load_deviation(self._spread)
        self.restarts, self._proven = self.restarts + 1, False
        return f"{ended.error} and is started again; its windows begin with the measurements from now on"

    def poll(self, session: Session) -> dict[str, plain.JointState]:
        """Apply a finished estimate to the session, and return its messages by topic.

        Without a finished estimate, the result is an empty dictionary. If the wear of the pads has been set, the
        messages have no values, and they replace the latched messages of the old estimate.
        """
        reply = self.worker.poll()
        stamp_ns, self._set_ns = self._set_ns, None
        if reply is None:
            topics = self._topics if stamp_ns is not None else ()
            return {topic: plain.JointState(stamp_ns or 0, self._frame_id, ()) for topic in topics}
        self._proven = True
        self.count += 1
        self.skipped += reply.skipped
        self.wall_s, self.end_ns = reply.wall_s, reply.end_ns
        result = reply.estimate
        self.states = {"horizontal": result.horizontal_state, "vertical": result.vertical_state}
        self.trust = {"model": result.model, "sensor": result.sensor}
        self.reasons = result.reasons
        self.entry = entry_of(reply, session, self.entry)
        session.apply(self.entry)
        self.forecast, self.forecast_error = reply.also.get("forecast"), reply.also.get("forecast_error", "")
        messages = {ESTIMATE: message_of(reply, self._frame_id)}
        if "forces" in reply.also:
            messages[WINDOW_FORCES] = forces_message(reply, self._frame_id)
        if "forecast" in reply.also:
            messages[FORECAST] = forecast_message(reply, self._frame_id)
        return messages

    def _drop_estimate(self) -> None:
        self.entry = None
        self.states = dict.fromkeys(self.states, State.PRIOR)


def entry_of(answer: WindowResult, session: Session, before: journal.Estimated | None) -> journal.Estimated:
    """Return the journal entry of an estimate.

    If a clearance is not observable, its shift is that of the previous estimate `before`. If a clearance is withdrawn,
    its shift is 0, so that the clearance of the model is used.
    """
    model = session.outputs.modelled(session.wear_depth)
    shift = np.array(before.shift) if before is not None else np.zeros(6)
    result = answer.estimate
    for axis, (value, state) in enumerate(
        ((result.horizontal, result.horizontal_state), (result.vertical, result.vertical_state))
    ):
        own = slice(3 * axis, 3 * axis + 3)
        if state.known:
            shift[own] = np.array([value.mean, value.p05, value.p95]) - model[own]
        elif state is not State.NOT_OBSERVABLE:
            shift[own] = 0.0
    bounds = (answer.start_ns, answer.end_ns, answer.samples, answer.poses)
    return journal.Estimated(*bounds, answer.guess, tuple(shift.tolist()), answer.text)


def message_of(answer: WindowResult, frame_id: str) -> plain.JointState:
    """Return the message of an estimate, with the end of its window as stamp.

    The message of a withdrawn estimate has no values.
    """
    result = answer.estimate
    names: list[str] = []
    numbers: list[float] = []
    withdrawn = State.WITHDRAWN in (result.horizontal_state, result.vertical_state)
    for name, value in ({} if withdrawn else result.values()).items():
        names += [name, f"{name}/p05", f"{name}/p95"]
        numbers += [value.mean, value.p05, value.p95]
    return plain.JointState(answer.end_ns, frame_id, tuple(names), position=np.array(numbers))


def forces_message(answer: WindowResult, frame_id: str) -> plain.JointState:
    """Return the message of the contact forces in a window, in the form of the messages on `contact_peaks`.

    If the forces were not computed, the message has no values.
    """
    names: list[str] = []
    peaks: list[float] = []
    impulses: list[float] = []
    for pair, forces in ((answer.also["forces"] or {}).get("pairs", {})).items():
        for suffix, point in (("", "p50"), ("/p05", "p05"), ("/p95", "p95")):
            names.append(f"{pair}{suffix}")
            peaks.append(forces["peak_n"][point])
            impulses.append(forces["impulse_n_s"][point])
    numbers = {"velocity": np.array(impulses), "effort": np.array(peaks)}
    return plain.JointState(answer.end_ns, frame_id, tuple(names), **numbers)


def forecast_message(answer: WindowResult, frame_id: str) -> plain.JointState:
    """Return the message of a forecast.

    It contains the time [s], the distance [m], the passes and the shifts until a clearance reaches its limit.
    """
    forecast = answer.also["forecast"] or {}
    names: list[str] = []
    numbers: list[float] = []
    for point in ("p10", "p50", "p90"):
        for key, factor in (("hours", HOUR_S), ("km", 1e3), ("passes", 1.0), ("shifts", 1.0)):
            value = forecast.get(point, {}).get(key)
            if value is not None:
                names.append(f"{_SI.get(key, key)}/{point}")
                numbers.append(factor * value)
    for key in ("not_reached_in_horizon", "probability_before_stop"):
        if forecast.get(key) is not None:
            names.append(key)
            numbers.append(forecast[key])
    return plain.JointState(answer.end_ns, frame_id, tuple(names), position=np.array(numbers))


def requests_of(settings: Settings) -> Requests:
    """Return the results that the parameters request in addition to the estimate."""
    horizontal, vertical = settings.forecast_limits
    plan = None
    if horizontal or vertical:
        stop_h = settings.forecast_stop / HOUR_S or None
        plan = Plan(horizontal, vertical, settings.forecast_horizon / HOUR_S, stop_h, scenarios=scenarios_of(settings))
    return Requests(settings.estimate_forces, settings.estimate_interval, plan, settings.follows != "off")


def scenarios_of(settings: Settings) -> tuple[Scenario, ...]:
    """Return the scenarios from the parameter `forecast_scenarios`. Raise `LifeError` if the text is invalid."""
    return tuple(Scenario.parse(text) for text in settings.forecast_scenarios.split(";") if text.strip())


def problems(settings: Settings, scene: Scene) -> list[Problem]:
    """Return contradictions between the parameters of the estimate, or between these parameters and the scene."""
    problems_found = []
    if settings.excitation_source == "scene":
        problems_found.append(Problem("estimate", True, "false with excitation_source scene: no load arrives"))
    if scene.support is not None:
        problems_found.append(
            Problem("estimate", True, "false where the scene has a support: the fit assumes a fixed frame")
        )
    if settings.follows != "off" and settings.max_evaluations:
        expected = "0 unless follow is off: the number is not limited for twins that follow"
        problems_found.append(Problem("max_evaluations", settings.max_evaluations, expected))
    limits = settings.forecast_limits
    if any(limits) and not all(limits):
        problems_found.append(Problem("forecast_limits", limits, "both limits, or 0 for both"))
    if any(limits) and (scene.wear is None or scene.wear.travel_speed_m_s <= 0.0):
        problems_found.append(Problem("forecast_limits", limits, "0 where the scene has no wear or no travel speed"))
    if any(limits) and scene.wear is not None:
        try:
            check_prior(scene.wear)
        except LifeError as error:
            problems_found.append(Problem("forecast_limits", limits, f"0 with this scene: {error}"))
    if any(limits) and settings.forecast_stop > settings.forecast_horizon:
        expected = f"at most forecast_horizon, {settings.forecast_horizon:g} s"
        problems_found.append(Problem("forecast_stop", settings.forecast_stop, expected))
    try:
        scenarios_of(settings)
    except LifeError as error:
        problems_found.append(Problem("forecast_scenarios", settings.forecast_scenarios, str(error)))
    if 0 < settings.estimate_forces < FEWEST:
        problems_found.append(Problem("estimate_forces", settings.estimate_forces, f"0, or at least {FEWEST}"))
    return problems_found
