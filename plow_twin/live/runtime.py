"""A live twin without its transport, and the way of one sample through it: intake, twin, publication, recording.

A front brings samples and takes messages away: the ROS node is one, `plow-twin live` another. Nothing here knows which.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError
from plow_twin.live.inputs import Inputs
from plow_twin.live.parameters import MODEL, ParameterError, Settings, model_changes
from plow_twin.live.solver_start import Prepared
from plow_twin.live.wear_keeper import WearKeeper
from plow_twin.model.scene import Scene
from plow_twin.record.alarms import ACKNOWLEDGED, ALARMS, alarms_message, alarms_of
from plow_twin.record.messages import DiagnosticStatus, JointState
from plow_twin.record.outputs import quality
from plow_twin.record.wear_state import scene_identity
from plow_twin.stream.driver import Arrival, Driver, Policy
from plow_twin.stream.health import DurationHistogram, Periods
from plow_twin.stream.intake import Intake, Verdict
from plow_twin.stream.journal import Entry, Gaps, PartOfPose, Pose, Snapshot
from plow_twin.stream.limits import Limits, excitation_limits, pose_limits, value_limits
from plow_twin.stream.model_changes import changed_twin
from plow_twin.stream.outputs import Publication
from plow_twin.stream.session import Session

if TYPE_CHECKING:
    from plow_twin.live.estimation import Estimation
    from plow_twin.live.recording import Recording

#: Topic of the marks.
QUALITY: Final = "quality"
_CATCH_UP_S: Final = 0.002
_LOOK_FOR_CLOCK_HZ: Final = 20.0
#: What is not used goes into the journal so often [Hz].
_UNUSED_HZ: Final = 5.0


class Front(Protocol):
    """Where samples come from and messages go.

    Attributes
    ----------
    name : str
        Name of the twin, with its namespace.
    topics : mapping
        Resolved names of the outputs by their base names.
    follows_samples : bool
        Whether time is that of the samples alone (`/clock`, a file): nothing is held for want of them.
    """

    name: str
    topics: Mapping[str, str]
    follows_samples: bool

    def now_ns(self) -> int:
        """Return the time on the clock of the stamps [ns]."""

    def publish(self, publication: Publication, forces_sent: Callable[[], None]) -> Mapping[str, bytes] | None:
        """Send the messages of a publication; call `forces_sent` right after the forces.

        Returns the bytes that were sent by base name of the topic; None, and nothing is sent, when a number is not
        finite.
        """

    def publish_quality(self, marks: JointState) -> None:
        """Send the marks of a publication that has some, or follows one that had."""

    def publish_alarms(self, status: DiagnosticStatus) -> None:
        """Send the alarms."""

    def publish_estimate(self, topic: str, message: JointState) -> None:
        """Send an estimate, or what follows from it, on one of `ESTIMATES`."""

    def changed(self) -> None:
        """Take note that the state of the stream may have changed."""

    def say_error(self, text: str) -> None:
        """Log an error; may be called from another thread."""


class Runtime:
    """A configured twin: made on configure, closed on cleanup.

    Parameters
    ----------
    front
        Where messages go.
    settings
        The parameters.
    prepared
        Scene and twin, the solver compiled; nobody else may use the twin.
    kept_wear
        Wear depths [m] of earlier runtimes of this process, by the scene's identity.

    Raises
    ------
    RecordingError, WearStateError, OSError
        The recording or the saved wear cannot be used.
    ParameterError, ArgumentError
        Parameters contradict each other or the scene.
    """

    def __init__(
        self,
        front: Front,
        settings: Settings,
        prepared: Prepared,
        kept_wear: Mapping[str, tuple[float, ...]] = MappingProxyType({}),
    ) -> None:
        self._front = front
        self._settings = settings
        self.scene = prepared.scene
        #: seconds that compiling or loading the solver took
        self.compile_s = prepared.compile_s
        self.latency = DurationHistogram()
        self.age = DurationHistogram()
        #: turns of the loop that publishes at a fixed rate, or else follows the clock; None: samples set the pace
        self.periods = _periods(settings)
        #: why time stands still, where it does: `waiting` for the first `/clock`, or `paused`
        self.clock = "running"
        self._clock_before_ns = 0
        #: publications, and those that were not published because a number was not finite
        self.published = self.withheld = 0
        #: frames computed without a sample, and frames after late samples have been worked in
        self.held_frames = self.corrected_frames = 0
        self._received_ns = 0
        self._kept: Snapshot | None = None
        self._start_due = True
        self._early: list[Arrival] = []
        self._q: NDArray[np.float64] | None = None
        self._seen: tuple[Any, ...] = ()
        self.wear_keeper: WearKeeper | None = None
        #: what the wear's identity is
        self.identity = scene_identity(self.scene)
        depth = kept_wear.get(self.identity)
        if settings.wear_state_path:
            self.wear_keeper = WearKeeper(Path(settings.wear_state_path), settings.hardware_id, self.scene)
            depth = self.wear_keeper.load() or depth
        self.alarms = alarms_of(asdict(settings))
        # refuses, here and not while samples come, what the settings would change
        changed_twin(prepared.twin, prepared.scene, model_changes(settings))
        with ExitStack() as made:
            self.recording = self._record()
            if self.recording:
                made.callback(self.recording.close)
            self.estimation = self._estimate()
            made.pop_all()
        session = Session(
            prepared.twin,
            on_entry=self._journal(),
            rollback_span_s=settings.rollback_span,
            wear_depth=depth,
        )
        every_sample = settings.publish_mode == "on_sample"
        self.driver = Driver(session, self._intake(), policy(settings), every_sample=every_sample)
        self.inputs = Inputs(
            self.source,
            self.driver.intake,
            self.driver.travel,
            settings.input_depth,
            self._pose,
            settings.rollback_span,
            self._gaps,
        )
        self.inputs.without_clock = lambda: self._start_due and self.without_clock
        self._set_limits(settings)
        if self.recording:
            self.inputs.unused.journal = session.emit

    def start(self) -> None:
        """Open the journal; nothing of the front can fail any more. Without a clock the first sample opens it."""
        self._start_due = self.without_clock
        self.clock = "waiting" if self._start_due else "running"
        if not self._start_due:
            self.driver.session.start()
            self.driver.set_model(self._stamp_ns(), model_changes(self._settings))

    def refusals(self, settings: Settings) -> list[str]:
        """Return why parameters cannot be taken while the twin runs."""
        try:
            self.driver.session.check_model(model_changes(settings))
        except ArgumentError as error:
            return [str(error)]
        return []

    @property
    def unsteady(self) -> bool:
        """Whether the stamps jump so often that resets are refused."""
        return self.driver.unsteady(time.monotonic_ns())

    @property
    def without_clock(self) -> bool:
        """Whether the time is to come from outside and has not come."""
        return self._front.now_ns() == 0

    @property
    def waits_for_clock(self) -> bool:
        """Whether the journal is not open yet for want of a clock: nothing can be asked of the twin."""
        return self._start_due

    @property
    def wear_error(self) -> str:
        """Why the wear could not be saved; empty: it could, or it is not kept."""
        return self.wear_keeper.error if self.wear_keeper else ""

    @property
    def recorder_state(self) -> str:
        """`off`, `recording`, or `trouble`: something was lost or it has stopped."""
        if self.recording is None:
            return "off"
        found = self.recording.counters
        return "trouble" if found.error or found.lost else "recording"

    @property
    def scene_name(self) -> str:
        """Scene file or preset in use."""
        return self._settings.scene

    @property
    def source(self) -> str:
        """Excitation source in use."""
        return self._settings.excitation_source

    @property
    def poses_have_covariance(self) -> bool:
        """Whether measured poses bring their covariance."""
        return self._settings.head_pose_type == "pose_with_covariance"

    def residual(self) -> tuple[float, float, float] | None:
        """Return model minus newest measured pose: x, y [m], theta [rad], or None without a measurement."""
        return self.inputs.residual(self._q) if self._q is not None else None

    def newest_sample_age_s(self) -> float | None:
        """Return the present time minus the stamp of the newest sample used [s], or None before one."""
        newest_ns = self.driver.newest_ns
        return None if newest_ns is None else (self._front.now_ns() - newest_ns) * 1e-9

    def estimate_age_s(self) -> float | None:
        """Return the present time minus the end of the newest estimate's window [s], or None before one."""
        end_ns = self.estimation.end_ns if self.estimation else None
        return None if end_ns is None else (self._front.now_ns() - end_ns) * 1e-9

    def look_at_clock(self) -> None:
        """Find out whether the time of the samples goes on; called at intervals."""
        now_ns = self._front.now_ns()
        if self._front.follows_samples:
            stands = now_ns == self._clock_before_ns
            self.clock = "waiting" if now_ns == 0 else "paused" if stands else "running"
        self._clock_before_ns = now_ns

    @property
    def missed_periods(self) -> int:
        """Periods left out between two reports from which on there is a warning; 0: none."""
        return self._settings.missed_periods

    def mark(self, text: str = "") -> tuple[bool, str]:
        """Put a text, by default the parameter `mark`, into the journal and have the ring written, if there is one."""
        self.driver.mark(self._stamp_ns(), text or self._settings.mark or "service")
        if self.recording is None:
            return False, "nothing is recorded"
        folder = self.recording.mark()
        if folder is None:
            return True, "noted in the recording"
        self._renew_recording()
        return True, f"what is kept in memory goes to {folder}"

    def record_status(self, status: DiagnosticStatus) -> None:
        """Put a published status into the recording."""
        if self.recording and not self._start_due:
            self.recording.message("status", self._stamp_ns(), status)

    def activate(self) -> None:
        """Start taking samples."""
        self.driver.resume(time.monotonic_ns())
        if self.periods:
            self.periods.begin()
        self.inputs.active = True

    def deactivate(self) -> None:
        """Stop taking samples."""
        self.inputs.active = False
        self._journal_unused()

    def close(self) -> list[str]:
        """Save the wear, end journal and recording; return what was lost, in words."""
        self.deactivate()
        lost = []
        if self.estimation:
            lost += [self.estimation.error] if self.estimation.error else []
            self.estimation.close()
        if self.wear_keeper:
            self.wear_keeper.close(self.driver.session.wear_depth)
            lost += [self.wear_keeper.error] if self.wear_keeper.error else []
        self.driver.close()
        report = self.recording.close() if self.recording else None
        if report is not None and not report.complete:
            lost.append(f"recording incomplete: lost {dict(report.lost)}, closed {report.closed}, error {report.error}")
        return lost

    def periodic(self) -> list[tuple[float, Callable[[], None]]]:
        """Return what the front is to call while the twin is active, each with its rate [Hz] on a steady clock."""
        settings = self._settings
        periodic: list[tuple[float, Callable[[], None]]] = []
        if settings.excitation_source == "scene":
            periodic.append((settings.step_rate, self.clock_tick))
        elif not self._front.follows_samples:
            periodic.append((settings.step_rate, self.silence))
        if settings.publish_mode == "fixed_rate":
            periodic.append((settings.publish_rate, self.publish_due))
        if self.wear_keeper:
            periodic.append((1.0 / settings.wear_save_period, self._save_wear))
        if self.recording:
            periodic.append((_UNUSED_HZ, self._journal_unused))
        if self.without_clock:
            periodic.append((_LOOK_FOR_CLOCK_HZ, self._look_for_clock))
        if self.estimation:
            from plow_twin.live.estimation import RATE_HZ

            periodic.append((RATE_HZ, self._look_for_estimate))
        return periodic

    def parameter(self, name: str, value: Any, settings: Settings) -> None:
        """Take over a parameter that takes effect at once."""
        self._settings = settings
        self.driver.policy = policy(settings)
        self.driver.intake.limits = limits(settings, self.scene)
        self._set_limits(settings)
        for intake in (self.driver.intake, self.driver.clock):
            intake.jump_back_s, intake.jump_forward_s = settings.jump_back, settings.jump_forward
        if self._start_due:
            return  # nothing is journaled yet
        if name in MODEL:
            self.driver.set_model(self._stamp_ns(), model_changes(settings))
            self._front.changed()
        elif not isinstance(value, tuple):  # a list acts through the service that takes it, and its entry
            self.driver.parameter(name, value)

    def _set_limits(self, settings: Settings) -> None:
        """Set what of the inputs besides the load is plausible."""
        pose = pose_limits(self.scene, settings.limit_pose, settings.limit_pose_rate)
        self.inputs.set_limits(
            value_limits(settings.limit_travel, settings.limit_travel_rate),
            pose,
            value_limits(settings.limit_gap or pose_limits(self.scene).largest[0], settings.limit_gap_rate),
        )

    def samples(self, arrived: list[Arrival]) -> None:
        """Take samples in order of arrival."""
        if self._start_due:
            self.start()
        if self._start_due:
            # kept until the clock comes: one that plays a recording may hear it a little later
            room = self._settings.input_depth - len(self._early)
            self._early += arrived[:room]
            for stamp_ns, wrench in arrived[max(room, 0) :]:
                self.driver.intake.refuse(Verdict.NO_CLOCK, stamp_ns, wrench)
            return
        if self._early:
            arrived, self._early = self._early + arrived, []
        self._received_ns = now_ns = time.monotonic_ns()
        for publication in self.driver.samples(arrived, now_ns):
            self._publish(publication)
        self._advanced()

    def silence(self) -> None:
        """Go on without samples when they have been missing for too long."""
        holds = self.driver.holds
        publication = self.driver.silence(time.monotonic_ns())
        if self.driver.holds != holds:
            # what is published next answers no message
            self._received_ns = 0
            self._publish(publication)
            self._advanced()

    def clock_tick(self) -> None:
        """Go on under the scene's own loads."""
        if self.periods and self._settings.publish_mode != "fixed_rate":
            self.periods.turn(time.monotonic())
        if self._start_due:
            self.start()
            if self._start_due:
                return
        self._received_ns = now_ns = time.monotonic_ns()
        self._publish(self.driver.clock_tick(self._front.now_ns(), now_ns))
        self._advanced()

    def publish_due(self) -> None:
        """Publish all since the last publication."""
        if self.periods:
            self.periods.turn(time.monotonic())
        self._publish(self.driver.due())

    def reset(self) -> tuple[bool, str]:
        """Put the motion back to its initial state; return whether that was done, and a text for who asked."""
        self.driver.reset(self._stamp_ns(), "service")
        self._front.changed()
        return True, "initial motion restored, the wear stays; the next sample starts model time anew"

    def snapshot(self) -> tuple[bool, str]:
        """Journal the exact state and keep it for `restore`."""
        self._kept = self.driver.snapshot()
        return True, f"the state at {self._kept.stamp_ns} ns is kept and stands in the journal"

    def restore(self) -> tuple[bool, str]:
        """Go back to the motion of the snapshot kept."""
        if self._kept is None:
            return False, "no snapshot has been taken since configure"
        self.driver.restore(self._stamp_ns(), self._kept)
        self._front.changed()
        return True, f"the motion is that at {self._kept.stamp_ns} ns; the next sample is that of its time, wear stays"

    def acknowledge_alarms(self) -> tuple[bool, str]:
        """Let go the alarms that are latched."""
        left = self.alarms.acknowledge()
        self.driver.parameter(ACKNOWLEDGED, self._stamp_ns())
        self._publish_alarms(self._stamp_ns())
        return True, f"still there: {', '.join(left)}" if left else "no alarm is left"

    def forecast(self) -> tuple[bool, str]:
        """Return the newest forecast as JSON."""
        if self.estimation is None or not any(self._settings.forecast_limits):
            return False, "no forecast is made: estimate is false or forecast_limits are 0"
        found = self.estimation.forecast
        return (True, json.dumps(found)) if found is not None else (False, self.estimation.forecast_error)

    def set_wear(self) -> tuple[bool, str]:
        """Set the wear of the pads to the parameter `set_wear`."""
        depth = self._settings.set_wear
        try:
            self.driver.set_wear(self._stamp_ns(), depth, "service")
        except ValueError as error:
            return False, f"parameter set_wear: {error}"
        self._save_wear()
        self._front.changed()
        return True, f"the pads are worn by {list(depth)} m from now on; the motion starts anew"

    def switch_publisher(self) -> tuple[bool, str]:
        """Follow the other sender of the excitation."""
        done = self.inputs.senders.switch()
        self._front.changed()
        if done:
            return True, f"the other publisher of {self.source} is followed from now on"
        return False, f"no other publisher of {self.source} has been heard"

    def _intake(self) -> Intake:
        settings = self._settings
        return Intake(
            jump_back_s=settings.jump_back,
            jump_forward_s=settings.jump_forward,
            expected_rate_hz=settings.expected_rate,
            limits=limits(settings, self.scene),
        )

    def _record(self) -> Recording | None:
        if not self._settings.record_path:
            return None
        from plow_twin.live.recording import Recording

        front = self._front
        clock = front.now_ns if front.follows_samples else None
        return Recording(self._settings, self.scene, front.name, front.topics, clock, front.say_error)

    def _estimate(self) -> Estimation | None:
        if not self._settings.estimate:
            return None
        from plow_twin.live.estimation import Estimation, problems

        found = problems(self._settings, self.scene)
        if found:
            raise ParameterError(found)
        return Estimation(self._settings, self.scene)

    def _journal(self) -> Callable[[Entry], object]:
        """Return who is told of each entry: the recording, the estimate, both or nobody."""
        recording, estimation = self.recording, self.estimation
        if estimation is None:
            return recording.journal if recording else _ignore
        if recording is None:
            return estimation.take

        def both(entry: Entry) -> None:
            recording.journal(entry)
            estimation.take(entry)

        return both

    def _pose(self, stamp_ns: int, pose: tuple[float, float, float], deviation: tuple[float, ...]) -> None:
        known = tuple(index for index, value in enumerate(pose) if math.isfinite(value))
        if len(known) < len(pose):
            self.driver.session.apply(PartOfPose(stamp_ns, known, tuple(pose[index] for index in known)))
            return
        self.driver.session.apply(Pose(stamp_ns, pose, deviation))
        if self.alarms.take_pose(stamp_ns, pose):
            self._alarms_changed(stamp_ns)

    def _gaps(self, stamp_ns: int, gaps: Mapping[int, float]) -> None:
        self.driver.session.apply(Gaps(stamp_ns, tuple(gaps), tuple(gaps.values())))

    def _look_for_estimate(self) -> None:
        assert self.estimation is not None
        messages = self.estimation.poll(self.driver.session)
        for topic, message in messages.items():
            self._front.publish_estimate(topic, message)
            if self.recording:
                self.recording.message(topic, message.stamp_ns, message)
        if messages:
            self._front.changed()

    def _look_for_clock(self) -> None:
        if self._start_due and not self.without_clock:
            self.samples([])

    def _journal_unused(self) -> None:
        """Put what was not used into the journal, once there is one."""
        if not self._start_due:
            self.inputs.unused.flush()

    def _save_wear(self) -> None:
        if self.wear_keeper:
            self.wear_keeper.save(self.driver.session.wear_depth)

    def _stamp_ns(self) -> int:
        """Return the time that the model has reached, or the present one before the first sample [ns]."""
        stamp_ns = self.driver.session.stamp_ns
        return self._front.now_ns() if stamp_ns is None else stamp_ns

    def _advanced(self) -> None:
        if self.recording:
            self._renew_recording()
            if self._front.follows_samples and self.recording.behind:
                # nothing is late: a bounded pause lets the recorder's thread catch up
                time.sleep(_CATCH_UP_S)
        seen = (self.driver.state, self.inputs.other_sender, self.unsteady)
        if seen != self._seen:
            self._seen = seen
            self._front.changed()

    def _renew_recording(self) -> None:
        assert self.recording is not None
        renewed = self.recording.renew(self.driver.session)
        if renewed and self.estimation and self.estimation.entry:
            # no part of a snapshot
            self.recording.journal(self.estimation.entry)

    def _publish(self, publication: Publication | None) -> None:
        if publication is None:
            return
        sent = self._front.publish(publication, self._forces_sent)
        if sent is None:
            self.withheld += 1
            return
        self._q = publication.q
        self.held_frames += publication.held
        self.corrected_frames += publication.corrected
        marks = quality(publication, self._settings.frame_id) if publication.marked else None
        if marks is not None:
            self._front.publish_quality(marks)
        self.published += 1
        changed = self.alarms.take(publication)
        if self._received_ns and not self._front.follows_samples:
            self.age.add((time.time_ns() - publication.stamp_ns) * 1e-9)
        if self.recording:
            self.recording.publication(publication, sent)
            if marks is not None:
                self.recording.message(QUALITY, publication.stamp_ns, marks)
        if changed:
            self._alarms_changed(publication.stamp_ns)

    def _alarms_changed(self, stamp_ns: int) -> None:
        self._publish_alarms(stamp_ns)
        if self.alarms.raised:
            self.mark(f"alarm: {', '.join(self.alarms.raised)}")

    def _publish_alarms(self, stamp_ns: int) -> None:
        status = alarms_message(self.alarms, self._front.name, self._settings.hardware_id)
        self._front.publish_alarms(status)
        if self.recording:
            self.recording.message(ALARMS, stamp_ns, status)

    def _forces_sent(self) -> None:
        if self._received_ns:
            self.latency.add((time.monotonic_ns() - self._received_ns) * 1e-9)


def _periods(settings: Settings) -> Periods | None:
    if settings.publish_mode == "fixed_rate":
        return Periods(1.0 / settings.publish_rate)
    return Periods(1.0 / settings.step_rate) if settings.excitation_source == "scene" else None


def policy(settings: Settings) -> Policy:
    """Return the part of the settings that rules over silence and failures."""
    return Policy(settings.excitation_timeout, settings.hold_policy, settings.hold_limit, settings.failure_limit)


def limits(settings: Settings, scene: Scene) -> Limits:
    """Return what a measured load can be at most."""
    return excitation_limits(
        scene, settings.limit_force, settings.limit_moment, settings.limit_force_rate, settings.limit_moment_rate
    )


def _ignore(entry: Entry) -> None:
    """Drop an entry: nothing is recorded."""
