"""Connect the runtime of a live twin to ROS 2 by topics, timers and services."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING

from rclpy.node import Node

from plow_twin.live.parameters import ESTIMATES, Settings
from plow_twin.live.part import Part
from plow_twin.live.realtime import raise_priority
from plow_twin.live.runtime import Runtime
from plow_twin.live.services import Services
from plow_twin.live.solver_start import Prepared
from plow_twin.live.wear_keeper import KeptWear
from plow_twin.record.messages import Message
from plow_twin.record.outputs import FOLLOWED_TOPICS
from plow_twin.record.times import time_text
from plow_twin.ros.input_loop import InputLoop, Turns
from plow_twin.ros.publishers import OutputPublishers
from plow_twin.ros.subscriptions import Subscriptions
from plow_twin.stream.alarms import Level
from plow_twin.stream.topics import TOPICS

if TYPE_CHECKING:
    from plow_twin.ros.opcua_input import OpcUaInput


class RosFront:
    """Topics, timers and services of a configured node. It is created on configure and closed on cleanup.

    The function `changed` is called when the state of the stream may have changed. All arguments except `changed`, and
    the errors, are described in `Runtime`.
    """

    def __init__(
        self,
        node: Node,
        settings: Settings,
        changed: Callable[[], None],
        prepared: Prepared,
        kept_wear: Mapping[str, KeptWear],
    ) -> None:
        self._node = node
        self.name: str = node.get_fully_qualified_name()
        self.topics: Mapping[str, str] = {topic.name: node.resolve_topic_name(topic.name) for topic in TOPICS}
        self.follows_samples: bool = node.get_parameter("use_sim_time").value
        self.sends_motion = True
        #: updates the status, because the state of the stream may have changed
        self.changed = changed
        #: lock that protects the twin; see `Turns`
        self.turns = Turns()
        self._lost: list[str] = []
        self._server: OpcUaInput | None = None
        with ExitStack() as made:
            self._make(settings, prepared, kept_wear, made)
            self._made = made.pop_all()

    def _make(self, settings: Settings, prepared: Prepared, kept_wear: Mapping[str, KeptWear], made: ExitStack) -> None:
        node = self._node
        self.runtime = runtime = Runtime(self, settings, prepared, kept_wear)
        made.callback(lambda: self._lost.extend(runtime.close()))
        enabled = (settings.estimate, settings.estimate_forces, any(settings.forecast_limits))
        without = [
            topic
            for topic, is_enabled in zip(ESTIMATES, enabled, strict=True)
            if not (settings.estimate and is_enabled)
        ]
        # the node publishes on the topic `status`, because the topic exists before configure
        if settings.follows != "full":
            without += FOLLOWED_TOPICS
        self._publishers = OutputPublishers(node, ["status", *without], runtime.publishing.memory)
        made.callback(self._publishers.close)

        def raise_thread() -> None:
            for refused in raise_priority(settings):
                node.get_logger().warning(f"refused by the system: {refused}")

        self._loop = loop = InputLoop(self.turns, self._inputs_failed, raise_thread)
        made.callback(loop.close)
        if settings.opcua_server:
            from plow_twin.ros.opcua_input import OpcUaInput

            self._server = OpcUaInput(runtime, self, node.get_logger().warning)
            loop.add(self._server, self._server, "opcua")
        elsewhere = frozenset() if self._server is None else self._server.names
        self.subscriptions = Subscriptions(node, runtime, self, loop, self.turns, elsewhere)
        if settings.marker_rate:
            self._draw(settings, made)
        for rate_hz, do in runtime.periodic():
            loop.every(1.0 / rate_hz, do)
        self._services = Services(runtime, self.changed)
        runtime.start()
        if self._server is not None:
            self._server.start()
        loop.start()

    def _draw(self, settings: Settings, made: ExitStack) -> None:
        """Publish markers. The message types are imported here, because they may not be installed."""
        from plow_twin.ros.markers import Markers

        markers = Markers(self._node, settings, self.runtime.scene)
        made.callback(markers.close)

        def publish() -> None:
            newest = self.runtime.publishing.newest
            if newest is not None:
                markers.publish(int(newest["stamp_ns"][0]), newest[0])

        self._loop.every(1.0 / settings.marker_rate, publish)

    def now_ns(self) -> int:
        """Return the time of the node's clock [ns]."""
        return int(self._node.get_clock().now().nanoseconds)

    def send(self, topic: str, message: memoryview | Message) -> None:
        """Publish a message."""
        self._publishers.send(topic, message)

    def look_for_senders(self, topic: str) -> None:
        """Check whether the followed publisher of an input still exists."""
        self.subscriptions.look_for_senders(topic)

    def sender_name(self, topic: str, sender: bytes) -> str:
        """Return the node name and the identifier of a publisher of an input."""
        return self.subscriptions.name_of(topic, sender)

    def say_alarm(self, level: int, text: str) -> None:
        """Log an alarm."""
        log = self._node.get_logger()
        if level >= Level.ERROR:
            log.error(text)
        else:
            log.warning(text)

    def time_text(self, stamp_ns: int) -> str:
        """Return a stamp as text."""
        return time_text(stamp_ns)

    def say_error(self, text: str) -> None:
        """Log an error."""
        self._node.get_logger().error(text)

    @property
    def error(self) -> Exception | None:
        """Error that ended the thread of the inputs, or None."""
        return self._loop.error

    def look_for_others(self) -> None:
        """Check whether another node publishes on the output topics. Update the state of the OPC UA connection."""
        if self._server is not None:
            with self.turns:
                self._server.look()
        self.runtime.others_publish = self._node.count_publishers(self.topics["contact_forces"]) > 1

    def parts(self) -> dict[str, Part]:
        """Return the part `source` of the diagnostics if the node has an OPC UA server."""
        return {} if self._server is None else {"source": self._server.part()}

    def activate(self) -> None:
        """Begin to use samples."""
        with self.turns:
            self.runtime.activate()
        self._loop.run_timers(True)

    def deactivate(self) -> None:
        """Stop using samples."""
        with self.turns:
            self.runtime.deactivate()
        self._loop.run_timers(False)

    def answer(self, name: str) -> tuple[bool, str]:
        """Call the service `name`; return success and an answer."""
        with self.turns:
            if self.runtime.waits_for_clock:
                return False, "use_sim_time is set and no message has arrived on /clock yet"
            return self._services.call(name)

    def close(self) -> list[str]:
        """Destroy all topics, timers and services, close the runtime, and return texts about the losses."""
        self.deactivate()
        self._made.close()
        return self._lost

    def _inputs_failed(self, error: Exception) -> None:
        self.say_error(f"the inputs are no longer read: {''.join(traceback.format_exception(error))}")
