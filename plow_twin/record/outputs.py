"""From a publication of the session to the messages that are sent: the live node and replay share this arithmetic."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.record.messages import JointState, Message, Odometry
from plow_twin.record.template import Template, compiled
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES
from plow_twin.stream.topics import Cadence, names_of

if TYPE_CHECKING:
    from plow_twin.stream.outputs import Publication, Publications

Array = NDArray[np.float64]

#: Base names of the topics that follow from the journal alone.
PUBLICATION_TOPICS: Final = names_of(Cadence.EACH, Cadence.SLOW)
#: Names of `quality`: 1 where a publication was computed without a sample, and where late samples have been worked in.
QUALITY_NAMES: Final = ("held", "corrected")

#: Those of them that not every publication has.
SLOW_TOPICS: Final = frozenset(names_of(Cadence.SLOW))


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


def quality(publication: Publication, frame_id: str) -> JointState:
    """Return the marks of a publication as position; sent only when it or the one before it is marked."""
    marks = np.array([publication.held, publication.corrected], np.float64)
    return JointState(publication.stamp_ns, frame_id, QUALITY_NAMES, position=marks)


def publication_templates(frame_id: str, child_frame_id: str) -> dict[str, Template]:
    """Return, by base name of the topic, the template whose numbers are the columns of `publication_numbers`."""

    def joints(values: Array) -> Message:
        return JointState(0, frame_id, PAIR_NAMES, *values.reshape(3, PAIR_COUNT))

    return {
        "contact_forces": Template.of(joints, 3 * PAIR_COUNT),
        "contact_peaks": Template.of(joints, 3 * PAIR_COUNT),
        "head_state": Template.of(lambda numbers: _odometry(0, frame_id, child_frame_id, numbers), 7),
        "clearance": Template.of(
            lambda values: JointState(0, frame_id, CLEARANCE_NAMES, position=values), len(CLEARANCE_NAMES)
        ),
        "wear_rate": Template.of(lambda values: JointState(0, frame_id, PAD_NAMES, velocity=values), len(PAD_NAMES)),
    }


def publication_numbers(publications: Publications) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Return, by base name of the topic, stamps (n,) and numbers (n, k) of the messages of many publications."""
    stamps, slow = publications.stamp_ns, publications.stamp_ns[publications.slow_index]
    count = len(publications)
    motion, forces, peaks = np.empty((count, 7)), np.empty((count, 3 * PAIR_COUNT)), np.empty((count, 3 * PAIR_COUNT))
    head_numbers(publications.q, publications.v, motion)
    side_by_side(publications.penetration, publications.rate, publications.force, forces)
    side_by_side(publications.makes, publications.impulse, publications.peak, peaks)
    return {
        "contact_forces": (stamps, forces),
        "contact_peaks": (stamps, peaks),
        "head_state": (stamps, motion),
        "clearance": (slow, publications.clearance),
        "wear_rate": (slow, publications.wear_rate),
    }


@compiled
def side_by_side(first, second, third, out):  # type: ignore[no-untyped-def]
    """Write three arrays (n, 8) beside each other to `out`, (n, 24)."""
    for n in range(len(first)):
        for pair in range(8):
            out[n, pair], out[n, 8 + pair], out[n, 16 + pair] = first[n, pair], second[n, pair], third[n, pair]


@compiled
def head_numbers(q, v, out):  # type: ignore[no-untyped-def]
    """Write position, quaternion z and w, and the twist in the head's own axes, (n, 7), as `head_state` does."""
    for n in range(len(q)):
        cos, sin = math.cos(q[n, 2]), math.sin(q[n, 2])
        out[n, 0], out[n, 1] = q[n, 0], q[n, 1]
        out[n, 2], out[n, 3] = math.sin(0.5 * q[n, 2]), math.cos(0.5 * q[n, 2])
        out[n, 4], out[n, 5] = cos * v[n, 0] + sin * v[n, 1], cos * v[n, 1] - sin * v[n, 0]
        out[n, 6] = v[n, 2]


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
    numbers = np.empty((1, 7))
    head_numbers(publication.q[None], publication.v[None], numbers)
    return _odometry(publication.stamp_ns, frame_id, child_frame_id, numbers[0])


def _odometry(stamp_ns: int, frame_id: str, child_frame_id: str, numbers: Array) -> Odometry:
    """Return the message of what `head_numbers` writes."""
    x, y, z, w, vx, vy, omega = numbers.tolist()
    return Odometry(stamp_ns, frame_id, child_frame_id, (x, y, 0.0), (0.0, 0.0, z, w), (vx, vy, 0.0), (0.0, 0.0, omega))
