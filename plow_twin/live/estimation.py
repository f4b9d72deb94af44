"""Between a live twin and the estimate beside it; imported only where an estimate is wanted."""

from __future__ import annotations

import json
from typing import Final

import numpy as np

from plow_twin.estimate.result import Interval, State
from plow_twin.estimate.window import Windows
from plow_twin.estimate.worker import Found, Worker
from plow_twin.live.parameters import Settings
from plow_twin.model.scene import Scene
from plow_twin.record import messages as plain
from plow_twin.stream.journal import Entry, Estimated, Pose, Reset, Sample, SetWear, Spread
from plow_twin.stream.session import Session

#: Base names of what `estimate` tells; each has its points `<name>/p05` and `<name>/p95` too.
NAMES: Final = (
    "horizontal", "vertical", "stiffness", "damping", "gain_fx", "gain_fy", "gain_m", "bias_x", "bias_y", "bias_theta",
    "delay",
)  # fmt: skip
#: How often one looks whether an estimate has come [Hz].
RATE_HZ: Final = 10.0


class Estimation:
    """The estimate of one live twin: what goes into it, and what becomes of what comes out."""

    def __init__(self, settings: Settings, scene: Scene) -> None:
        self._frame_id = settings.frame_id
        span = (settings.estimate_window, settings.estimate_interval, settings.rollback_span)
        windows = Windows(*span, settings.head_pose_deviation, settings.excitation_deviation)
        self._worker = Worker(scene, windows)
        #: where the clearances come from, and whether model and sensor can be trusted, as of the newest estimate
        self.states = {"horizontal": State.PRIOR, "vertical": State.PRIOR}
        self.trust = {"model": "", "sensor": ""}
        self.reasons: tuple[str, ...] = ()
        #: estimates that have come, windows that gave way to newer ones, and the time that the newest took [s]
        self.count = self.skipped = 0
        self.wall_s = 0.0
        self.end_ns: int | None = None
        #: the newest one, for a journal that is begun anew
        self.entry: Estimated | None = None

    @property
    def error(self) -> str:
        """Why nothing more is estimated; empty: it is."""
        return self._worker.error

    def take(self, entry: Entry) -> None:
        """Take in what the session has accepted."""
        match entry:
            case Sample(stamp_ns, wrench):
                self._worker.take_load(stamp_ns, wrench)
            case Pose(stamp_ns, pose, deviation):
                self._worker.take_pose(stamp_ns, pose, deviation)
            case Spread(_, deviation):
                self._worker.take_spread(deviation)
            case SetWear():
                self._worker.restart()
                self.entry = None
                self.states = dict.fromkeys(self.states, State.PRIOR)
            case Reset():
                self._worker.restart()

    def poll(self, session: Session) -> plain.JointState | None:
        """Hand an estimate that has come to the session; return its message, if there is one."""
        found = self._worker.poll()
        if found is None:
            return None
        self.count += 1
        self.skipped += found.skipped
        self.wall_s, self.end_ns = found.wall_s, found.end_ns
        result = found.estimate
        self.states = {"horizontal": result.horizontal_state, "vertical": result.vertical_state}
        self.trust = {"model": result.model, "sensor": result.sensor}
        self.reasons = result.reasons
        self.entry = entry_of(found, session, self.entry)
        session.apply(self.entry)
        return message_of(found, self._frame_id)

    def close(self) -> None:
        """End the process."""
        self._worker.close()


def entry_of(found: Found, session: Session, before: Estimated | None) -> Estimated:
    """Return the journal's entry of an estimate.

    A clearance that cannot be observed stays as it was estimated before, and its interval widens as the wear's prior
    does; one that is withdrawn is what the model says.
    """
    model = session.outputs.modelled(session.wear_depth)
    shift = np.array(before.shift) if before is not None else np.zeros(6)
    result = found.estimate
    for axis, (value, state) in enumerate(
        ((result.horizontal, result.horizontal_state), (result.vertical, result.vertical_state))
    ):
        own = slice(3 * axis, 3 * axis + 3)
        if state is State.ESTIMATED:
            shift[own] = np.array([value.mean, value.p05, value.p95]) - model[own]
        elif state is not State.NOT_OBSERVABLE:
            shift[own] = 0.0
    text = json.dumps(result.as_dict(), allow_nan=False)
    bounds = (found.start_ns, found.end_ns, found.samples, found.poses)
    return Estimated(*bounds, found.guess, tuple(shift.tolist()), text)


def message_of(found: Found, frame_id: str) -> plain.JointState:
    """Return the message of an estimate, stamped with the end of its window; empty where it is withdrawn."""
    result = found.estimate
    names: list[str] = []
    numbers: list[float] = []
    withdrawn = State.WITHDRAWN in (result.horizontal_state, result.vertical_state)
    for name in () if withdrawn else NAMES:
        value: Interval | None = getattr(result, name)
        if value is not None:
            names += [name, f"{name}/p05", f"{name}/p95"]
            numbers += [value.mean, value.p05, value.p95]
    return plain.JointState(found.end_ns, frame_id, tuple(names), position=np.array(numbers))
