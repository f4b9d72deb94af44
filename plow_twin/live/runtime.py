"""The live twin without its transport.

A *front*, which is the ROS node or the command `plow-twin live`, delivers samples and sends messages. Each valid sample
advances the twin and causes a publication, which is recorded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast

from plow_twin.errors import ArgumentError
from plow_twin.live.inputs import SILENT_NS, Inputs
from plow_twin.live.parameters import MODEL, ParameterError, Settings, model_changes, outside
from plow_twin.live.publishing import Front, Outgoing, Publishing
from plow_twin.live.service_names import mark_problem
from plow_twin.live.solver_start import Prepared
from plow_twin.live.wear_keeper import KeptWear, WearKeeper
from plow_twin.model.scene import fastest_travel
from plow_twin.record.alarms import alarms_of
from plow_twin.record.messages import DiagnosticStatus
from plow_twin.record.times import EPOCH_S
from plow_twin.record.wear_state import scene_identity
from plow_twin.stream.driver import Arrival, Block, Driver, Policy, StreamState
from plow_twin.stream.health import Periods
from plow_twin.stream.intake import Verdict
from plow_twin.stream.journal import Entry, Gaps, Mark, Parameter, Pose, pose_entry
from plow_twin.stream.limits import Limits, excitation_limits, pose_limits, value_limits
from plow_twin.stream.model_changes import changed_scene, changed_twin
from plow_twin.stream.session import Series, Session

if TYPE_CHECKING:
    from plow_twin.estimate.follow import Follower
    from plow_twin.live.estimation import Estimation
    from plow_twin.live.recording import Recording

_CATCH_UP_S: Final = 0.002
_LOOK_FOR_CLOCK_HZ: Final = 20.0
#: Rate at which unused messages are written to the journal [Hz].
_UNUSED_HZ: Final = 5.0
#: Twins that follow measurements are too slow if samples wait for longer than `_LONGEST_WAIT_S` [s] in each of
#: `_WAITING_SECONDS` consecutive seconds.
_LONGEST_WAIT_S, _WAITING_SECONDS = 0.5, 5


class Runtime:
    """A configured twin, from configure to cleanup.

    No other runtime may use `prepared`. `kept_wear` is the wear of earlier runtimes of this process, by
    `scene_identity`. Raise `RecordingError`, `WearStateError` or `OSError` if the recording or the saved wear cannot be
    used, and `ParameterError` or `ArgumentError` if parameters contradict each other or the scene.
    """

    def __init__(
        self,
        front: Front,
        settings: Settings,
        prepared: Prepared,
        kept_wear: Mapping[str, KeptWear] = MappingProxyType({}),
    ) -> None:
        self._front = front
        self.settings = settings
        self.scene = prepared.scene
        #: time in which the solver was compiled or loaded [s]
        self.compile_s = prepared.compile_s
        #: statistics of the publishing period or the step period; None if the samples determine the times
        self.periods = _periods(settings)
        #: `waiting` until the first message on `/clock`, then `paused` or `running`
        self.clock = "running"
        #: whether another node publishes on the output topics of this twin
        self.others_publish = False
        #: whether measured poses no longer correct the motion, because the twins were too slow
        self.reduced = False
        self._waiting_seconds = 0
        self._clock_before_ns = 0
        #: whether the journal is not open, because the time is unknown; services are refused in this state
        self.waits_for_clock = True
        self._early: list[Arrival] = []
        self._last_condition: tuple[Any, ...] = ()
        self.wear_keeper: WearKeeper | None = None
        self.identity = scene_identity(self.scene)
        kept = kept_wear.get(self.identity)
        depth = kept.depth_m if kept else None
        misplaced = outside(settings)
        if misplaced:
            raise ParameterError(misplaced)
        self.alarms = alarms_of(asdict(settings))
        # an invalid change of the model raises an error here, before the first sample
        changed_twin(prepared.twin, prepared.scene, model_changes(settings))
        with ExitStack() as made:
            if settings.wear_state_path:
                self.wear_keeper = WearKeeper(Path(settings.wear_state_path), settings.hardware_id, self.scene)
                made.callback(self.wear_keeper.release)
                depth = self.wear_keeper.load(kept)
                if kept and kept.older_files and depth == kept.depth_m:
                    front.say_error(f"{settings.wear_state_path}: the file is older than the wear of this process")
            self.recording = self._record()
            if self.recording:
                made.callback(self.recording.recorder.close)
            self.estimation = self._estimate()
            made.pop_all()
        self._active_since_ns = 0
        session = Session(
            prepared.twin, on_entry=self._journal, rollback_span_s=settings.rollback_span, wear_depth=depth
        )
        catch_up = None
        if session.following is not None:
            session.following.defers = front.sends_motion
            catch_up = session.catch_up
        self.publishing = Publishing(front, settings, self.alarms, self.recording, self.mark, catch_up)
        self.inputs = Inputs(
            front,
            settings.excitation_source,
            settings.input_depth,
            settings.rollback_span,
            journaled=self.recording is not None,
            expected_rate_hz=settings.expected_rate,
        )
        every_sample = settings.publish_mode == "on_sample"
        self.driver = Driver(session, self.inputs.intake, policy(settings), every_sample=every_sample)
        self._set_limits(settings)

    def start(self) -> None:
        """Open the journal if the time is known, otherwise wait for the first message on `/clock`."""
        self.waits_for_clock = self.without_clock
        self.inputs.started = not self.waits_for_clock
        self.clock = "waiting" if self.waits_for_clock else "running"
        if not self.waits_for_clock:
            self.driver.session.start()
            self.driver.set_model(self.stamp_ns, model_changes(self.settings))

    def refusals(self, settings: Settings) -> list[str]:
        """Return the reasons why the running twin cannot use new parameters."""
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
    def without_samples(self) -> bool:
        """Whether the active twin has waited for its first sample for 10 s."""
        waits = self.inputs.active and self.driver.state is StreamState.WAITING and not self.driver.intake.arrived
        return waits and time.monotonic_ns() - self._active_since_ns > SILENT_NS

    @property
    def without_clock(self) -> bool:
        """Whether the node uses `/clock` and has received no message on it."""
        return self._front.now_ns() == 0

    def kept_wear(self) -> KeptWear:
        """Return the wear for the next runtime of this process. `close` must be called before."""
        depth = self.driver.session.wear_depth
        return self.wear_keeper.kept(depth) if self.wear_keeper else KeptWear(tuple(depth.tolist()))

    @property
    def follower(self) -> Follower | None:
        """The twin, or None if it does not follow measurements."""
        return cast("Follower | None", self.driver.session.following)

    @property
    def reads_at_once(self) -> bool:
        """Whether `step` can use a `Block`: only samples advance the time, and the motion is not sent."""
        return self._front.follows_samples and not self._front.sends_motion

    @property
    def recorder_state(self) -> str:
        """State of the recorder: `off`, `recording`, or `trouble` if data were lost or the recording has stopped."""
        if self.recording is None:
            return "off"
        counters = self.recording.recorder.counters
        return "trouble" if counters.error or counters.lost else "recording"

    def residual(self) -> tuple[float, float, float] | None:
        """Return the pose of the model minus the last measured pose: x, y [m], theta [rad], or None."""
        newest = self.publishing.newest
        return None if newest is None else self.inputs.residual(newest["q"][0])

    def age_s(self, stamp_ns: int | None) -> float | None:
        """Return the time since a stamp [s], or None if it is unknown."""
        now_ns = self._front.now_ns()
        # a stamp that is not a date cannot be compared with a date
        if stamp_ns is None or stamp_ns < EPOCH_S * 1e9 <= now_ns:
            return None
        return (now_ns - stamp_ns) * 1e-9

    def look_at_clock(self) -> None:
        """Update the state of the clock. A clock without a change since the last call is paused."""
        now_ns = self._front.now_ns()
        if self._front.follows_samples:
            stands = now_ns == self._clock_before_ns
            self.clock = "waiting" if now_ns == 0 else "paused" if stands else "running"
        self._clock_before_ns = now_ns

    def time_text(self, stamp_ns: int) -> str:
        """Return a stamp as text."""
        return self._front.time_text(stamp_ns)

    def send_alarms(self) -> None:
        """Send the current alarms."""
        self._send([self.publishing.alarms_now(self.stamp_ns)])

    def mark(self, text: str) -> tuple[bool, str]:
        """Write a text to the journal, and the ring of the recorder to the disk; return success and an answer."""
        if (problem := mark_problem(text)) is not None:
            return False, problem
        self.driver.session.apply(Mark(self.stamp_ns, text))
        if self.recording is None:
            return False, "nothing is recorded"
        folder = self.recording.recorder.mark()
        if folder is None:
            return True, "written to the recording"
        self._renew_recording()
        return True, f"the last seconds of the run will be written to {folder}"

    def record_status(self, status: DiagnosticStatus) -> None:
        """Record a published status."""
        if self.recording and not self.waits_for_clock:
            self.recording.message("status", self.stamp_ns, status)

    def activate(self) -> None:
        """Begin to use samples."""
        self._active_since_ns = time.monotonic_ns()
        self.driver.resume(self._active_since_ns)
        if self.periods:
            self.periods.begin()
        self.inputs.active = True

    def deactivate(self) -> None:
        """Stop using samples."""
        self.inputs.active = False
        self.driver.pause()
        self._journal_unused()

    def close(self) -> list[str]:
        """Save the wear, close the journal and the recording, and return texts about the losses."""
        self.deactivate()
        lost = []
        if self.estimation:
            restarts = self.estimation.restarts
            lost += [f"the estimator has ended and was started again: {restarts} times"] if restarts else []
            lost += [self.estimation.worker.error] if self.estimation.worker.error else []
            self.estimation.worker.close()
        if self.wear_keeper:
            self.wear_keeper.close(self.driver.session.wear_depth)
            lost += [self.wear_keeper.error] if self.wear_keeper.error else []
        self.driver.close()
        if self.recording is not None and not (report := self.recording.recorder.close()).complete:
            lost.append(report.sentence(self.recording.recorder.path.parent))
        return lost

    def periodic(self) -> list[tuple[float, Callable[[], float | None]]]:
        """Return the functions to call periodically while the twin is active, each with its rate [Hz].

        The result of a function is described in `Timer`.
        """
        settings = self.settings
        periodic: list[tuple[float, Callable[[], float | None]]] = []
        if settings.excitation_source == "scene":
            periodic.append((settings.step_rate, self.clock_tick))
        elif not self._front.follows_samples:
            periodic.append((settings.step_rate, self.silence))
        if settings.publish_mode == "fixed_rate":
            periodic.append((settings.publish_rate, self.publish_due))
        if self.wear_keeper:
            periodic.append((1.0 / settings.wear_save_period, self.save_wear))
        if self.recording:
            periodic.append((_UNUSED_HZ, self._journal_unused))
        if settings.follows == "full" and not self._front.follows_samples:
            periodic.append((1.0, self._look_for_lag))
        if self.without_clock:
            periodic.append((_LOOK_FOR_CLOCK_HZ, self._look_for_clock))
        if self.estimation:
            from plow_twin.live.estimation import RATE_HZ

            periodic.append((RATE_HZ, self._look_for_estimate))
        return periodic

    def parameter(self, name: str, value: Any, settings: Settings) -> None:
        """Apply a parameter that takes effect immediately."""
        self.settings = settings
        self.driver.policy = policy(settings)
        self._set_limits(settings)
        if self.waits_for_clock:
            return  # the journal is not open, and `start` will apply the settings
        if name in MODEL:
            self.driver.set_model(self.stamp_ns, model_changes(settings))
            self._front.changed()
        elif not isinstance(value, tuple):  # the list `set_wear` takes effect, and is journalled, by its service
            self.driver.session.apply(Parameter(name, value))

    def _set_limits(self, settings: Settings) -> None:
        for intake in (self.driver.intake, self.driver.clock):
            intake.jump_back_s, intake.jump_forward_s = settings.jump_back, settings.jump_forward
        self.driver.intake.limits = excitation_limits(
            self.scene,
            settings.limit_force,
            settings.limit_moment,
            settings.limit_force_rate,
            settings.limit_moment_rate,
        )
        travel = value_limits(settings.limit_travel, settings.limit_travel_rate)
        scene = changed_scene(self.scene, model_changes(settings))
        self.inputs.set_limits(
            Limits((min(settings.limit_travel, fastest_travel(scene.wear, scene.contact)),), travel.fastest),
            pose_limits(self.scene, settings.limit_pose, settings.limit_pose_rate),
            value_limits(settings.limit_gap or pose_limits(self.scene).largest[0], settings.limit_gap_rate),
        )

    def step(self, arrived: list[Arrival] | Block) -> Iterator[Outgoing]:
        """Use samples in the order of arrival, and yield each message as soon as it is computed.

        A `Block` may be passed only if `reads_at_once` is true.
        """
        if self.waits_for_clock:
            self.start()
        if self.waits_for_clock:
            # samples are stored, because the player of a recording may send the first samples before `/clock`
            for stamp_ns, wrench in arrived:
                if len(self._early) < self.settings.input_depth:
                    self._early.append((stamp_ns, wrench))
                else:
                    self.driver.intake.refuse(Verdict.NO_CLOCK, stamp_ns, wrench)
            return
        if self._early or self.publishing.watch is not None or self.settings.record_ring:
            # a watcher must receive each publication, and the ring of the recorder needs the state directly after the
            # sample of an alarm, so the samples of a block are used one by one
            arrived, self._early = [*self._early, *arrived], []
        self.publishing.received_ns = now_ns = time.monotonic_ns()
        for applied in self.driver.samples(arrived, now_ns):
            if isinstance(applied, Series):
                yield from self.publishing.series(applied, self._journal_series)
            else:
                yield from self.publishing.messages(applied)
        self._advanced(len(arrived))

    def _send(self, outgoing: Iterable[Outgoing]) -> None:
        for topic, message in outgoing:
            self._front.send(topic, message)

    def silence(self) -> float:
        """Advance without samples if samples are overdue. Return the time until samples can be overdue [s]."""
        holds, now_ns = self.driver.holds, time.monotonic_ns()
        published = self.driver.silence(now_ns)
        if len(published.rows) or self.driver.holds != holds:
            self.publishing.received_ns = 0
            self._send(self.publishing.messages(published))
            self._advanced()
        return self.driver.quiet_ns(now_ns) * 1e-9

    def clock_tick(self) -> None:
        """Advance under the loads in the scene."""
        if self.periods and self.settings.publish_mode != "fixed_rate":
            self.periods.turn(time.monotonic())
        if self.waits_for_clock:
            self.start()
            if self.waits_for_clock:
                return
        self.publishing.received_ns = now_ns = time.monotonic_ns()
        self._send(self.publishing.messages(self.driver.clock_tick(self._front.now_ns(), now_ns)))
        self._advanced()

    def publish_due(self) -> None:
        """Publish the current state if the twin has advanced since the last publication."""
        if self.periods:
            self.periods.turn(time.monotonic())
        self._send(self.publishing.messages(self.driver.due()))

    def _record(self) -> Recording | None:
        if not self.settings.record_path:
            return None
        from plow_twin.live.recording import Recording

        front = self._front
        clock = front.now_ns if front.follows_samples else None
        return Recording(self.settings, self.scene, front.name, front.topics, clock, front.say_error)

    def _estimate(self) -> Estimation | None:
        if not self.settings.estimate:
            return None
        from plow_twin.live.estimation import Estimation, problems

        found = problems(self.settings, self.scene)
        if found:
            raise ParameterError(found)
        return Estimation(self.settings, self.scene)

    def _journal(self, entry: Entry) -> None:
        if self.recording:
            self.recording.recorder.journal(entry)
        if self.estimation:
            self.estimation.add(entry)

    def _journal_series(self, series: Series) -> None:
        if self.recording:
            self.recording.series(series)
        if self.estimation:
            self.estimation.add_series(series)

    def add_travel(self, stamp_ns: int, speed_m_s: float) -> None:
        """Check and use a speed along the face."""
        if self.inputs.uses_travel(stamp_ns, speed_m_s):
            self.driver.travel(stamp_ns, speed_m_s)

    def add_pose(self, stamp_ns: int, pose: tuple[float, float, float], deviation: tuple[float, ...] = ()) -> None:
        """Check and use a measured pose. The arguments are described in `Inputs.uses_pose`."""
        if not self.inputs.uses_pose(stamp_ns, pose, deviation):
            return
        entry = pose_entry(stamp_ns, pose, deviation)
        self.driver.session.apply(entry)
        if isinstance(entry, Pose) and self.alarms.feed_pose(stamp_ns, pose):
            self._send(self.publishing.alarms_changed(stamp_ns))

    def add_gaps(self, stamp_ns: int, gaps: Mapping[int, float]) -> None:
        """Check and use measured gaps [m], by number of the pair."""
        if self.inputs.uses_gaps(stamp_ns, gaps):
            self.driver.session.apply(Gaps(stamp_ns, tuple(gaps), tuple(gaps.values())))

    def _look_for_estimate(self) -> None:
        assert self.estimation is not None
        messages = self.estimation.poll(self.driver.session)
        if revived := self.estimation.revive():
            self._front.say_error(revived)
        for topic, message in messages.items():
            self._front.send(topic, message)
            if self.recording:
                self.recording.message(topic, message.stamp_ns, message)
        if messages:
            self._front.changed()

    def _look_for_lag(self) -> None:
        """Stop the correction of the motion by measured poses if the twins are too slow."""
        waited_s, self.inputs.wait_s = self.inputs.wait_s, 0.0
        self._waiting_seconds = self._waiting_seconds + 1 if waited_s > _LONGEST_WAIT_S else 0
        if self._waiting_seconds == _WAITING_SECONDS and not self.reduced and not self.waits_for_clock:
            self.reduced = True
            self.driver.session.apply(Parameter("follow", "parameters"))
            self._front.changed()

    def _look_for_clock(self) -> None:
        if self.waits_for_clock and not self.without_clock:
            self._send(self.step([]))

    def _journal_unused(self) -> None:
        if not self.waits_for_clock:
            for entry in self.inputs.unused.pop_all(self._front.sender_name):
                self.driver.session.emit(entry)

    def save_wear(self) -> None:
        """Save the wear if the parameter `wear_state_path` is set."""
        if self.wear_keeper:
            self.wear_keeper.save(self.driver.session.wear_depth)

    @property
    def stamp_ns(self) -> int:
        """The time that the model has reached [ns], or the current time before the first sample."""
        stamp_ns = self.publishing.series_ns or self.driver.session.stamp_ns
        return self._front.now_ns() if stamp_ns is None else stamp_ns

    def _advanced(self, count: int = 1) -> None:
        if self.recording and self.recording.recorder.snapshot_wanted:
            self._renew_recording()
        if self._front.follows_samples:
            # a twin without a deadline lets the recorder and the estimate catch up, for at most `_CATCH_UP_S` a sample
            while count and self._behind:
                time.sleep(_CATCH_UP_S)
                count -= 1
        condition = (self.driver.state, tuple(self.inputs.other_senders()), self.unsteady)
        if condition != self._last_condition:
            self._last_condition = condition
            self._front.changed()

    @property
    def _behind(self) -> bool:
        return bool((self.recording and self.recording.behind) or (self.estimation and self.estimation.worker.behind))

    def _renew_recording(self) -> None:
        assert self.recording is not None
        renewed = self.recording.renew(self.driver.session)
        if renewed and self.estimation and self.estimation.entry and self.driver.session.following is None:
            # if the twin does not follow measurements, a snapshot does not contain the estimate
            self.recording.recorder.journal(self.estimation.entry)


def _periods(settings: Settings) -> Periods | None:
    if settings.publish_mode == "fixed_rate":
        return Periods(1.0 / settings.publish_rate)
    return Periods(1.0 / settings.step_rate) if settings.excitation_source == "scene" else None


def policy(settings: Settings) -> Policy:
    """Return the policy for silences and failures from the parameters."""
    return Policy(settings.excitation_timeout, settings.hold_policy, settings.hold_limit, settings.failure_limit)
