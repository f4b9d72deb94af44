"""All that a configured node holds, and the way of one sample through it: intake, twin, publication, recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus as RosDiagnosticStatus
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

from plow_twin.errors import Problem
from plow_twin.model.scene import Scene
from plow_twin.record.messages import DiagnosticStatus
from plow_twin.record.outputs import publication_messages, quality
from plow_twin.record.wear_state import scene_identity
from plow_twin.ros.inputs import Inputs
from plow_twin.ros.messages import ros_status
from plow_twin.ros.parameters import ParameterError, Settings
from plow_twin.ros.publishers import QUALITY, TOPICS, OutputPublishers
from plow_twin.ros.qos import LATCHED
from plow_twin.ros.solver_start import Prepared
from plow_twin.ros.wear_keeper import WearKeeper
from plow_twin.run.twin import Twin
from plow_twin.stream.alarms import Alarms, Thresholds
from plow_twin.stream.driver import Arrival, Driver, Policy
from plow_twin.stream.health import DurationHistogram
from plow_twin.stream.intake import Intake
from plow_twin.stream.journal import Entry, Pose
from plow_twin.stream.limits import Limits, excitation_limits
from plow_twin.stream.outputs import Publication
from plow_twin.stream.session import Session

if TYPE_CHECKING:
    from plow_twin.ros.estimation import Estimation
    from plow_twin.ros.recording import Recording

_CATCH_UP_S: Final = 0.002


class Runtime:
    """Everything made on configure and released on cleanup.

    Parameters
    ----------
    node
        The node; its clock stamps the scene's own loads.
    settings
        Its parameters.
    changed
        Called when the state of the stream may have changed.
    prepared
        Scene and twin, the solver compiled; nobody else may use the twin.
    kept_wear
        Wear depths [m] of earlier runtimes of this process, by the scene's identity.

    Raises
    ------
    RecordingError, WearStateError, OSError
        The recording or the saved wear cannot be used.
    """

    def __init__(
        self,
        node: Node,
        settings: Settings,
        changed: Callable[[], None],
        prepared: Prepared,
        kept_wear: Mapping[str, tuple[float, ...]] = MappingProxyType({}),
    ) -> None:
        self._node = node
        self._settings = settings
        self._changed = changed
        self.sim_time: bool = node.get_parameter("use_sim_time").value
        self.scene = prepared.scene
        #: seconds that compiling or loading the solver took
        self.compile_s = prepared.compile_s
        self.latency = DurationHistogram()
        self.age = DurationHistogram()
        #: publications that were not published because a number was not finite
        self.withheld = 0
        #: frames computed without a sample, and frames after late samples have been worked in
        self.held_frames = self.corrected_frames = 0
        self._received_ns = 0
        self._q: NDArray[np.float64] | None = None
        self._seen: tuple[Any, ...] = ()
        self.wear_keeper: WearKeeper | None = None
        #: what the wear's identity is
        self.identity = scene_identity(self.scene)
        depth = kept_wear.get(self.identity)
        if settings.wear_state_path:
            self.wear_keeper = WearKeeper(Path(settings.wear_state_path), settings.hardware_id, self.scene)
            depth = self.wear_keeper.load() or depth
        with ExitStack() as made:
            self._make(prepared.twin, depth, made)
            made.pop_all()

    def _make(self, twin: Twin, wear_depth: tuple[float, ...] | None, made: ExitStack) -> None:
        """Open the recording and make everything on the node; what is made is noted to be undone on an error."""
        node, settings = self._node, self._settings
        self.recording = self._record()
        if self.recording:
            made.callback(self.recording.close)
        self._publishers = OutputPublishers(node)
        made.callback(self._publishers.close)
        thresholds = {
            "force": Thresholds(*settings.alarm_force),
            "clearance": Thresholds(*settings.alarm_clearance),
            "wear_rate": Thresholds(*settings.alarm_wear_rate),
        }
        self.alarms = Alarms(thresholds, settings.alarm_duration)
        self._alarms_publisher = node.create_publisher(RosDiagnosticStatus, "alarms", LATCHED)
        made.callback(node.destroy_publisher, self._alarms_publisher)
        self.estimation = self._estimate()
        if self.estimation:
            made.callback(self.estimation.close)
        session = Session(
            twin,
            on_entry=self._journal(),
            rollback_span_s=settings.rollback_span,
            wear_depth=wear_depth,
        )
        every_sample = settings.publish_mode == "on_sample"
        self.driver = Driver(session, self._intake(), policy(settings), every_sample=every_sample)
        self.inputs = Inputs(
            node,
            self.scene,
            settings.excitation_source,
            settings.input_depth,
            self.driver.intake,
            self._on_samples,
            self.driver.travel,
            self._changed,
            self._on_pose if self.estimation else None,
            settings.rollback_span,
        )
        self.inputs.set_limits(settings.limit_travel, settings.limit_pose)
        made.callback(self.inputs.close)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers: list[Any] = []
        for rate, callback in self._periodic():
            self._timers.append(self._timer(rate, callback))
            made.callback(node.destroy_timer, self._timers[-1])
        self._services: list[Any] = []
        for name, answer in (
            ("~/reset", self._on_reset),
            ("~/switch_publisher", self._on_switch),
            ("~/set_wear", self._on_set_wear),
            ("~/acknowledge_alarms", self._on_acknowledge),
        ):
            self._services.append(node.create_service(Trigger, name, answer))
            made.callback(node.destroy_service, self._services[-1])
        session.start()

    @property
    def published(self) -> int:
        """Number of publications."""
        return self._publishers.published

    @property
    def unsteady(self) -> bool:
        """Whether the stamps jump so often that resets are refused."""
        return self.driver.unsteady(time.monotonic_ns())

    @property
    def without_clock(self) -> bool:
        """Whether the node is to follow `/clock` and has heard none."""
        return self.sim_time and self._ros_time_ns() == 0

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

    def residual(self) -> tuple[float, float, float] | None:
        """Return model minus newest measured pose: x, y [m], theta [rad], or None without a measurement."""
        return self.inputs.residual(self._q) if self._q is not None else None

    def newest_sample_age_s(self) -> float | None:
        """Return the node's time minus the stamp of the newest sample used [s], or None before one."""
        newest_ns = self.driver.newest_ns
        return None if newest_ns is None else (self._ros_time_ns() - newest_ns) * 1e-9

    def estimate_age_s(self) -> float | None:
        """Return the node's time minus the end of the newest estimate's window [s], or None before one."""
        end_ns = self.estimation.end_ns if self.estimation else None
        return None if end_ns is None else (self._ros_time_ns() - end_ns) * 1e-9

    def record_status(self, status: DiagnosticStatus) -> None:
        """Put a published status into the recording."""
        if self.recording:
            self.recording.message("status", self._stamp_ns(), status)

    def activate(self) -> None:
        """Start taking samples."""
        self.driver.resume(time.monotonic_ns())
        self.inputs.active = True
        for timer in self._timers:
            timer.reset()

    def deactivate(self) -> None:
        """Stop taking samples."""
        self.inputs.active = False
        for timer in self._timers:
            timer.cancel()

    def close(self) -> list[str]:
        """Release everything; return what was lost, in words."""
        self.deactivate()
        for timer in self._timers:
            self._node.destroy_timer(timer)
        for service in self._services:
            self._node.destroy_service(service)
        self.inputs.close()
        lost = []
        if self.estimation:
            lost += [self.estimation.error] if self.estimation.error else []
            self.estimation.close()
        if self.wear_keeper:
            self.wear_keeper.close(self.driver.session.wear_depth)
            lost += [self.wear_keeper.error] if self.wear_keeper.error else []
        self.driver.close()
        self._publishers.close()
        self._node.destroy_publisher(self._alarms_publisher)
        report = self.recording.close() if self.recording else None
        if report is not None and not report.complete:
            lost.append(f"recording incomplete: lost {dict(report.lost)}, closed {report.closed}, error {report.error}")
        return lost

    def parameter(self, name: str, value: Any, settings: Settings) -> None:
        """Take over a parameter that takes effect at once."""
        self._settings = settings
        self.driver.policy = policy(settings)
        self.driver.intake.limits = limits(settings, self.scene)
        self.inputs.set_limits(settings.limit_travel, settings.limit_pose)
        for intake in (self.driver.intake, self.driver.clock):
            intake.jump_back_s, intake.jump_forward_s = settings.jump_back, settings.jump_forward
        if not isinstance(value, tuple):  # a list acts through the service that takes it, and its entry
            self.driver.parameter(name, value)

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
        from plow_twin.ros.recording import Recording

        clock = self._ros_time_ns if self.sim_time else None
        topics = {topic: self._node.resolve_topic_name(topic) for topic in (*TOPICS, "status", "alarms", "estimate")}
        name = self._node.get_fully_qualified_name()
        return Recording(self._settings, self.scene, name, topics, clock, self._node.get_logger().error)

    def _estimate(self) -> Estimation | None:
        if not self._settings.estimate:
            return None
        if self.source == "scene":
            raise ParameterError([Problem("estimate", True, "false where excitation_source is scene: no load comes")])
        from plow_twin.ros.estimation import Estimation

        return Estimation(self._node, self._settings, self.scene)

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

    def _periodic(self) -> list[tuple[float, Callable[[], None]]]:
        settings = self._settings
        periodic: list[tuple[float, Callable[[], None]]] = []
        if settings.excitation_source == "scene":
            periodic.append((settings.step_rate, self._on_clock))
        elif not self.sim_time:
            periodic.append((settings.step_rate, self._on_silence))
        if settings.publish_mode == "fixed_rate":
            periodic.append((settings.publish_rate, lambda: self._publish(self.driver.due())))
        if self.wear_keeper:
            periodic.append((1.0 / settings.wear_save_period, self._save_wear))
        if self.estimation:
            from plow_twin.ros.estimation import RATE_HZ

            periodic.append((RATE_HZ, self._on_estimate))
        return periodic

    def _timer(self, rate_hz: float, callback: Callable[[], None]) -> Any:
        # steady: steps of the system's clock and a paused /clock do not touch it
        timer = self._node.create_timer(1.0 / rate_hz, callback, clock=self._steady)
        timer.cancel()
        return timer

    def _save_wear(self) -> None:
        if self.wear_keeper:
            self.wear_keeper.save(self.driver.session.wear_depth)

    def _stamp_ns(self) -> int:
        """Return the time that the model has reached, or the node's before the first sample [ns]."""
        stamp_ns = self.driver.session.stamp_ns
        return self._ros_time_ns() if stamp_ns is None else stamp_ns

    def _ros_time_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _on_samples(self, arrived: list[Arrival]) -> None:
        self._received_ns = now_ns = time.monotonic_ns()
        for publication in self.driver.samples(arrived, now_ns):
            self._publish(publication)
        self._advanced()

    def _on_silence(self) -> None:
        holds = self.driver.holds
        publication = self.driver.silence(time.monotonic_ns())
        if self.driver.holds != holds:
            # what is published next answers no message
            self._received_ns = 0
            self._publish(publication)
            self._advanced()

    def _on_pose(self, stamp_ns: int, pose: tuple[float, float, float]) -> None:
        self.driver.session.apply(Pose(stamp_ns, pose))

    def _on_estimate(self) -> None:
        assert self.estimation is not None
        message = self.estimation.poll(self.driver.session)
        if message is not None:
            if self.recording:
                self.recording.message("estimate", message.stamp_ns, message)
            self._changed()

    def _on_clock(self) -> None:
        self._received_ns = now_ns = time.monotonic_ns()
        self._publish(self.driver.clock_tick(self._ros_time_ns(), now_ns))
        self._advanced()

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.driver.reset(self._stamp_ns(), "service")
        self._changed()
        response.success = True
        response.message = "initial motion restored, the wear stays; the next sample starts model time anew"
        return response

    def _on_acknowledge(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        left = self.alarms.acknowledge()
        self.driver.parameter("alarms_acknowledged", self._stamp_ns())
        self._publish_alarms(self._stamp_ns())
        response.success = True
        response.message = f"still there: {', '.join(left)}" if left else "no alarm is left"
        return response

    def _on_set_wear(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        depth = self._settings.set_wear
        try:
            self.driver.set_wear(self._stamp_ns(), depth, "service")
        except ValueError as error:
            response.success, response.message = False, f"parameter set_wear: {error}"
            return response
        self._save_wear()
        self._changed()
        response.success = True
        response.message = f"the pads are worn by {list(depth)} m from now on; the motion starts anew"
        return response

    def _on_switch(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.inputs.senders.switch()
        response.message = (
            f"the other publisher of {self.source} is followed from now on"
            if response.success
            else f"no other publisher of {self.source} has been heard"
        )
        self._changed()
        return response

    def _advanced(self) -> None:
        if self.recording:
            renewed = self.recording.renew(self.driver.session)
            if renewed and self.estimation and self.estimation.entry:
                # no part of a snapshot
                self.recording.journal(self.estimation.entry)
            if self.sim_time and self.recording.behind:
                # under /clock nothing is late: a bounded pause lets the recorder's thread catch up
                time.sleep(_CATCH_UP_S)
        seen = (self.driver.state, self.inputs.other_sender, self.unsteady)
        if seen != self._seen:
            self._seen = seen
            self._changed()

    def _publish(self, publication: Publication | None) -> None:
        if publication is None:
            return
        if not publication.finite:
            self.withheld += 1
            return
        self._q = publication.q
        self.held_frames += publication.held
        self.corrected_frames += publication.corrected
        messages = publication_messages(publication, self._settings.frame_id, self._settings.child_frame_id)
        if publication.marked:
            messages[QUALITY] = quality(publication, self._settings.frame_id)
        self._publishers.publish(messages, self._forces_sent)
        changed = self.alarms.take(publication)
        if self._received_ns and not self.sim_time:
            self.age.add((time.time_ns() - publication.stamp_ns) * 1e-9)
        if self.recording:
            self.recording.publication(publication)
            if publication.marked:
                self.recording.message(QUALITY, publication.stamp_ns, messages[QUALITY])
        if changed:
            self._publish_alarms(publication.stamp_ns)

    def _publish_alarms(self, stamp_ns: int) -> None:
        name, head = self._node.get_fully_qualified_name(), self._settings.hardware_id
        alarms = self.alarms.alarms.items()
        there = [name for name, alarm in alarms if alarm.level or alarm.latched]
        values = {
            key: text
            for name, alarm in alarms
            for key, text in (
                (name, f"{alarm.value:.6g}"),
                (f"{name}_level", alarm.level.name.lower()),
                (f"{name}_latched", alarm.latched.name.lower()),
            )
        }
        status = DiagnosticStatus(
            int(self.alarms.worst), f"{name}: alarms", ", ".join(there) or "none", head, tuple(values.items())
        )
        self._alarms_publisher.publish(ros_status(status))
        if self.recording:
            self.recording.message("alarms", stamp_ns, status)

    def _forces_sent(self) -> None:
        if self._received_ns:
            self.latency.add((time.monotonic_ns() - self._received_ns) * 1e-9)


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
