"""From what the twin computed to what is sent; the live node and replay share this arithmetic."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.record.messages import Float64s, JointState, Odometry

if TYPE_CHECKING:
    from plow_twin.twin import Advance


def contact_forces(stamp_ns: int, frame_id: str, advance: Advance) -> JointState:
    """Return penetration [m] as position, its rate [m/s] as velocity and force [N] as effort, all at the stamp."""
    return JointState(stamp_ns, frame_id, PAIR_NAMES, advance.penetration, advance.rate, advance.force)


def head_state(stamp_ns: int, frame_id: str, child_frame_id: str, advance: Advance) -> Odometry:
    """Return the head's pose in the slide's frame and its twist in the head's own axes, as Odometry asks."""
    x, y, theta = (float(value) for value in advance.q)
    vx, vy, omega = (float(value) for value in advance.v)
    cos, sin = math.cos(theta), math.sin(theta)
    return Odometry(
        stamp_ns,
        frame_id,
        child_frame_id,
        position=(x, y, 0.0),
        orientation=(0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta)),
        linear=(cos * vx + sin * vy, cos * vy - sin * vx, 0.0),
        angular=(0.0, 0.0, omega),
    )


class PeakWindow:
    """What happened between two messages on `contact_peaks`, whatever the number of advances between them."""

    def __init__(self) -> None:
        self._impacts = np.zeros(PAIR_COUNT)
        self._clear()

    def _clear(self) -> None:
        self._impulse = np.zeros(PAIR_COUNT)
        self._peak = np.zeros(PAIR_COUNT)

    def add(self, advance: Advance) -> None:
        """Take in one advance."""
        self._impacts += advance.makes
        self._impulse += advance.impulse
        np.maximum(self._peak, advance.peak, out=self._peak)

    def take(self, stamp_ns: int, frame_id: str) -> JointState:
        """Return the message and start the next window.

        Position is the count of impacts since the start, velocity the impulse [N s] and effort the largest force [N]
        since the last message.
        """
        message = JointState(stamp_ns, frame_id, PAIR_NAMES, self._impacts.copy(), self._impulse, self._peak)
        self._clear()
        return message

    def restart(self, impacts: Float64s | None = None) -> None:
        """Begin anew, with the counters at `impacts`, shape (8,), or at zero."""
        self._impacts = np.zeros(PAIR_COUNT) if impacts is None else np.array(impacts, dtype=np.float64)
        self._clear()
