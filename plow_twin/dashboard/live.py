"""The screen of a live twin without ROS."""

from __future__ import annotations

from dataclasses import asdict

from plow_twin.dashboard.access import PageAccess
from plow_twin.dashboard.facts import facts_of
from plow_twin.dashboard.feed import RATE_HZ
from plow_twin.dashboard.screen import Screen
from plow_twin.live.front import BridgeFront
from plow_twin.live.services import Services
from plow_twin.live.timer import Timer


def open_screen(front: BridgeFront, access: PageAccess, source: str) -> Screen:
    """Open the screen of a twin that has not been started yet. The errors are those of `Screen`."""
    runtime = front.runtime
    facts = facts_of(runtime.scene, asdict(runtime.settings), source)
    load = (lambda: runtime.driver.session.twin.wrench) if facts["loads"] else None
    screen = Screen(access, facts, Services(runtime, front.changed).answer, load, front.say_error)
    front.attach(screen.feed)
    front.timers.append(Timer(1.0 / RATE_HZ, screen.feed.turn))
    return screen
