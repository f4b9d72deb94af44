"""Send the results of a running ROS node to a plant, from another process that subscribes to the node's topics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing

from plow_twin.dashboard.node import NodeWatch
from plow_twin.live.timer import Timer
from plow_twin.ros.start import ros
from plow_twin.telemetry.access import OutputSpec
from plow_twin.telemetry.outlet import Outlet


def send_node(
    namespace: str,
    name: str,
    scene: str | None,
    outputs: Sequence[OutputSpec],
    rate_hz: float,
    wait_s: float,
    stopped: Callable[[], bool],
    on_error: Callable[[str], object],
) -> int:
    """Send the results of a node until `stopped` returns True. Return the number of lost messages.

    The argument `scene` is needed if the scene file of the node cannot be read on this machine. The function `on_error`
    receives a text whenever the receiver of an output stops or resumes accepting messages. Raise `DashboardError` if
    the node does not exist, `SceneError` if the scene cannot be read, and `TelemetryError` or `ModuleNotFoundError` if
    an output cannot be opened.
    """
    with ExitStack() as opened:
        opened.enter_context(ros())
        listeners: list[tuple[NodeWatch, Outlet]] = []
        timers = []
        for output in outputs:
            watch = opened.enter_context(closing(NodeWatch(namespace, name, wait_s, stopped)))
            answer = watch.answer if output.may_acknowledge else None
            outlet = opened.enter_context(Outlet(output, watch.facts(scene), answer, on_error))
            watch.listen(outlet.feed)
            listeners.append((watch, outlet))
            timers.append(Timer(1.0 / rate_hz, outlet.turn))
        while not stopped() and any(not outlet.link.broken for _, outlet in listeners):
            for watch, _ in listeners:
                watch.spin()
            for timer in timers:
                timer.look()
    return sum(int(outlet.feed.report["lost"]) for _, outlet in listeners)
