"""From a publication of the session to the messages that are sent: the live node and replay share this arithmetic."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.messages import JointState, Message, Odometry
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES

if TYPE_CHECKING:
    from plow_twin.stream.outputs import Publication

#: Base names of the topics that follow from the journal alone.
FRAME_TOPICS: Final = ("contact_forces", "contact_peaks", "head_state", "clearance", "wear_rate")


def publication_messages(publication: Publication, frame_id: str, child_frame_id: str) -> dict[str, Message]:
    """Return the messages of a publication by the base name of their topic; the slow ones only when it has them."""
    messages: dict[str, Message] = {
        "contact_forces": contact_forces(publication, frame_id),
        "contact_peaks": contact_peaks(publication, frame_id),
        "head_state": head_state(publication, frame_id, child_frame_id),
    }
    if publication.slow is not None:
        slow, stamp_ns = publication.slow, publication.stamp_ns
        messages["clearance"] = JointState(stamp_ns, frame_id, CLEARANCE_NAMES, position=slow.clearance)
        messages["wear_rate"] = JointState(stamp_ns, frame_id, PAD_NAMES, velocity=slow.wear_rate)
    return messages


def contact_forces(publication: Publication, frame_id: str) -> JointState:
    """Return penetration [m] as position, its rate [m/s] as velocity and force [N] as effort, all at the stamp."""
    return JointState(
        publication.stamp_ns, frame_id, PAIR_NAMES, publication.penetration, publication.rate, publication.force
    )


def contact_peaks(publication: Publication, frame_id: str) -> JointState:
    """Return all makes so far as position, impulse [N s] as velocity and peak force [N] as effort since the last."""
    return JointState(
        publication.stamp_ns,
        frame_id,
        PAIR_NAMES,
        publication.makes.astype(np.float64),
        publication.impulse,
        publication.peak,
    )


def head_state(publication: Publication, frame_id: str, child_frame_id: str) -> Odometry:
    """Return the head's pose in the slide's frame and its twist in the head's own axes, as Odometry asks."""
    x, y, theta = (float(value) for value in publication.q)
    vx, vy, omega = (float(value) for value in publication.v)
    cos, sin = math.cos(theta), math.sin(theta)
    return Odometry(
        publication.stamp_ns,
        frame_id,
        child_frame_id,
        position=(x, y, 0.0),
        orientation=(0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta)),
        linear=(cos * vx + sin * vy, cos * vy - sin * vx, 0.0),
        angular=(0.0, 0.0, omega),
    )
