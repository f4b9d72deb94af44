"""The lifecycle node `plow_twin`, with its transitions, status and diagnostics. `RosFront` processes the messages."""

from __future__ import annotations

import gc
import time
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from plow_twin.errors import PlowTwinError
from plow_twin.live import diagnostics
from plow_twin.live.parameters import Settings
from plow_twin.live.realtime import apply_realtime
from plow_twin.live.runtime import Runtime
from plow_twin.live.service_names import SERVICES
from plow_twin.live.solver_start import Preparation, key
from plow_twin.live.wear_keeper import KeptWear
from plow_twin.record import messages as plain
from plow_twin.record import sending
from plow_twin.ros.connections import LOOK_S, Connections, WithoutEvents
from plow_twin.ros.front import RosFront
from plow_twin.ros.messages import ros_status
from plow_twin.ros.parameter_server import ParameterServer
from plow_twin.ros.qos import DIAGNOSTICS, OUTPUTS

#: Number of reports between two log messages about the same problem.
_REPORTS_APART: Final = 5


class TwinNode(WithoutEvents, LifecycleNode):
    """The ROS 2 node of the twin. Several nodes can use the same process and executor.

    While the solver is compiled, the node calls `stop_asked`, which returns True if a stop was requested. `options` are
    those of `rclpy.node.Node`. Raise `ParameterError`, which lists all invalid parameters.
    """

    def __init__(self, *, stop_asked: Callable[[], bool] = lambda: False, **options: Any) -> None:
        super().__init__("plow_twin", automatically_declare_parameters_from_overrides=True, **options)
        self._stop_asked = stop_asked
        self._connections = Connections(self)
        self._front: RosFront | None = None
        self.lifecycle = "unconfigured"
        #: reason why the last configure failed
        self.reason = ""
        #: wear of each scene at its last cleanup
        self._kept_wear: dict[str, KeptWear] = {}
        self._preparation: Preparation | None = None
        self._health = diagnostics.Health()
        self._published_status: tuple[Any, ...] = ()
        self._table = ParameterServer(self, lambda: self.runtime is None, self._parameter_changed, self._refusals)
        for refused in apply_realtime(self._table.settings):
            self.get_logger().warning(f"refused by the system: {refused}")
        self._status = self.create_publisher(DiagnosticStatus, "status", OUTPUTS["status"])
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS)
        for name in SERVICES:
            # the services exist in all states, because a request to a destroyed service would end the executor of rclpy
            self.create_service(Trigger, f"~/{name}", partial(self._answer, name))
        # the timers use the steady clock, so that reports continue while /clock is paused
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self.create_timer(LOOK_S, self._look_for_publishers, clock=steady)
        self._refuse_invalid_transitions()
        self._reports = 0
        self._publish_status()

    @property
    def runtime(self) -> Runtime | None:
        """The live twin, or None in the state unconfigured."""
        return None if self._front is None else self._front.runtime

    @property
    def autostart(self) -> bool:
        """Whether the program must configure and activate the node."""
        return self._table.settings.autostart

    def prepare(self) -> None:
        """Start to compile the solver for the current parameters in a thread, unless it has been started before."""
        settings = self._table.settings
        if self.runtime is None and (self._preparation is None or self._preparation.key != key(settings)):
            self.get_logger().info(f"scene {settings.scene}: preparing the solver (the first time it is compiled)")
            self._preparation = Preparation(settings, sending.warm_up)

    @property
    def prepared(self) -> bool:
        """Whether the solver is ready, so that configure does not wait for it."""
        return self._preparation is None or self._preparation.done

    def start(self) -> bool:
        """Configure and activate the node; return False if a transition fails."""
        done = TransitionCallbackReturn.SUCCESS
        return self.trigger_configure() == done and self.trigger_activate() == done

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the scene, open the recording, and create all topics. After a failure, `reason` contains the cause."""
        settings = self._table.settings
        try:
            self.prepare()
            preparation, self._preparation = self._preparation, None
            assert preparation is not None
            prepared = preparation.result(self._stop_asked)
            self._front = RosFront(self, settings, self._publish_status, prepared, self._kept_wear)
        except (PlowTwinError, OSError, ModuleNotFoundError) as error:
            self.reason = f"scene {settings.scene!r}, record_path {settings.record_path!r}: {error}"
        except Exception:  # rclpy would hide the traceback
            self.reason = traceback.format_exc()
        else:
            self.get_logger().info(f"scene {settings.scene}: solver ready in {prepared.compile_s:.2f} s")
            return self._entered("inactive")
        self.get_logger().error(f"not configured: {self.reason}")
        self._publish_status()
        return TransitionCallbackReturn.FAILURE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to use samples."""
        super().on_activate(state)
        # the garbage collector skips all existing objects while samples arrive
        gc.collect()
        gc.freeze()
        assert self._front is not None, "the node is configured"
        self._front.activate()
        return self._entered("active")

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop using samples. The state of the model does not change."""
        super().on_deactivate(state)
        gc.unfreeze()
        assert self._front is not None, "the node is configured"
        self._front.deactivate()
        return self._entered("inactive")

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the live twin with its topics and its recording."""
        self.release()
        return self._entered("unconfigured")

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the live twin with its topics and its recording."""
        self.release()
        return self._entered("finalized")

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the live twin with its topics and its recording, so that the node can be configured again."""
        self.release()
        return self._entered("unconfigured")

    def release(self) -> None:
        """Close the live twin with its topics and its recording, if the node is configured."""
        # without this call, the garbage collector would not free the runtime, which is part of reference cycles
        gc.unfreeze()
        front, self._front = self._front, None
        if front is None:
            return
        runtime = front.runtime
        try:
            for lost in front.close():
                self.get_logger().error(lost)
        finally:
            self._kept_wear[runtime.identity] = runtime.kept_wear()

    def _answer(self, name: str, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._front is None:
            response.message = f"lifecycle: got {self.lifecycle}, expected a configured node"
        else:
            response.success, response.message = self._front.answer(name)
        return response

    def _entered(self, lifecycle: str) -> TransitionCallbackReturn:
        self.lifecycle = lifecycle
        self.reason = ""
        self._publish_status()
        return TransitionCallbackReturn.SUCCESS

    def _turn(self) -> AbstractContextManager[None]:
        return nullcontext() if self._front is None else self._front.turns

    def _refusals(self, settings: Settings) -> list[str]:
        with self._turn():
            return [] if self.runtime is None else self.runtime.refusals(settings)

    def _parameter_changed(self, name: str, value: Any) -> None:
        with self._turn():
            if self.runtime is not None:
                self.runtime.parameter(name, value, self._table.settings)

    def _refuse_invalid_transitions(self) -> None:
        """Answer requests of invalid transitions, at which the callback of rclpy would end the process."""
        service = self._service_change_state
        change = service.callback

        def answer(request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
            try:
                return change(request, response)
            except RuntimeError as error:
                transition = request.transition.label or request.transition.id
                self.get_logger().warning(f"transition {transition!r} refused in state {self.lifecycle}: {error}")
                response.success = False
                return response

        service.callback = answer

    def _publish_status(self) -> None:
        with self._turn():
            preparing = self.runtime is None and not self.prepared
            report = diagnostics.summary(self.lifecycle, self.reason, self.runtime, preparing)
            if report == self._published_status:
                return
            self._published_status = report
            level, message, values = report
            name, head = self.get_fully_qualified_name(), self._table.settings.hardware_id
            status = plain.DiagnosticStatus(level, name, message, head, tuple(values.items()))
            self._status.publish(ros_status(status))
            if self.runtime is not None:
                self.runtime.record_status(status)

    def _look_for_publishers(self) -> None:
        if self._front is not None:
            self._front.subscriptions.look()

    def _publish_diagnostics(self) -> None:
        if self._front is not None:
            if self._front.error is not None:
                raise self._front.error  # the error ends the program
            self._connections.look_for_subscribers(self.publishers)
            self._front.look_for_others()
        elif self.lifecycle == "unconfigured" and not self.reason:
            # the solver is compiled before configure, so that a lifecycle manager does not have to wait for it
            self.prepare()
        runtime = self.runtime
        if runtime is not None and runtime.without_clock and self._reports % _REPORTS_APART == 0:
            self.get_logger().warning(
                "use_sim_time is set and no message has arrived on /clock: the twin waits and records nothing"
            )
        self._reports += 1
        with self._turn():
            if runtime is not None:
                runtime.look_at_clock()
            parts = self._health.parts(self.lifecycle, self.reason, self.runtime, time.monotonic_ns())
            parts |= {} if self._front is None else self._front.parts()
        array = DiagnosticArray()
        array.header.stamp = self.get_clock().now().to_msg()
        name, head = self.get_fully_qualified_name(), self._table.settings.hardware_id
        array.status = [
            ros_status(plain.DiagnosticStatus(level, f"{name}: {part}", message, head, tuple(values.items())))
            for part, (level, message, values) in parts.items()
        ]
        self._diagnostics.publish(array)
        self._publish_status()
