"""The outputs of a live twin without ROS."""

from __future__ import annotations

from dataclasses import asdict

from plow_twin.dashboard.facts import facts_of
from plow_twin.live.front import BridgeFront
from plow_twin.live.services import Services
from plow_twin.live.timer import Timer
from plow_twin.telemetry.access import OutputSpec
from plow_twin.telemetry.outlet import Outlet


def open_output(front: BridgeFront, output: OutputSpec, rate_hz: float, source: str) -> Outlet:
    """Open an output of a twin that has not been started yet. The errors are those of `Outlet`."""
    runtime = front.runtime
    answer = Services(runtime, front.changed).answer if output.may_acknowledge else None
    outlet = Outlet(output, facts_of(runtime.scene, asdict(runtime.settings), source), answer, front.say_error)
    front.attach(outlet.feed)
    front.more_parts[output.name] = outlet.part
    front.timers.append(Timer(1.0 / rate_hz, outlet.turn))
    return outlet
