"""The messages of a publication as the bytes that are sent: one compiled call for those that each publication has."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.outputs import head_numbers, publication_templates, side_by_side
from plow_twin.record.template import Template, compiled, fill
from plow_twin.stream.outputs import CLEARANCE_NAMES, Publication, Slow

#: Those messages, in the order in which they are sent.
_EACH: Final = ("contact_forces", "contact_peaks", "head_state")


class PublicationBytes:
    """Write messages of one publication after the other.

    Parameters
    ----------
    frame_id, child_frame_id
        Frames named in the messages.
    """

    def __init__(self, frame_id: str, child_frame_id: str) -> None:
        templates = publication_templates(frame_id, child_frame_id)
        self._slow = {topic: _Filled(templates[topic]) for topic in ("clearance", "wear_rate")}
        pairs, head = templates["contact_forces"], templates["head_state"]
        self._buffers = [bytearray(pairs.data), bytearray(pairs.data), bytearray(head.data)]
        self._arrays = [np.frombuffer(buffer, np.uint8) for buffer in self._buffers]
        self._layouts = (pairs.data, pairs.places, head.data, head.places)

    def write(self, publication: Publication) -> dict[str, bytes] | None:
        """Return the bytes by base name of the topic, forces first; None when a number is not finite."""
        now = publication
        finite = _write(
            now.stamp_ns, now.penetration, now.rate, now.force, now.makes, now.impulse, now.peak, now.q, now.v,
            *self._arrays, *self._layouts,
        )  # fmt: skip
        if not finite or (now.slow is not None and not publication.finite):
            return None
        found = dict(zip(_EACH, map(bytes, self._buffers), strict=True))
        if now.slow is not None:
            slow = {"clearance": now.slow.clearance, "wear_rate": now.slow.wear_rate}
            found |= {topic: self._slow[topic].write(now.stamp_ns, numbers) for topic, numbers in slow.items()}
        return found


def warm_up() -> None:
    """Compile what is needed, or load it from the cache on disk."""
    none, motion = np.zeros(PAIR_COUNT), np.zeros(3)
    slow = Slow(np.zeros(len(CLEARANCE_NAMES)), none)
    PublicationBytes("", "").write(
        Publication(0, none, none, none, np.zeros(PAIR_COUNT, np.int64), none, none, motion, motion, slow)
    )


class _Filled:
    """The bytes of one message of a template after the other."""

    def __init__(self, template: Template) -> None:
        self._template, self._buffer = template, np.zeros(len(template), np.uint8)

    def write(self, stamp_ns: int, numbers: NDArray[np.float64]) -> bytes:
        """Return the template's bytes with a stamp and its numbers (count,)."""
        template = self._template
        fill(self._buffer, _START, template.data, template.places, np.array([stamp_ns]), numbers[None])
        return self._buffer.tobytes()


_START: Final = np.zeros(1, np.int64)


@compiled
def _write(  # type: ignore[no-untyped-def]
    stamp_ns, penetration, rate, force, makes, impulse, peak, q, v,
    forces, peaks, head, pairs_data, pairs_places, head_data, head_places,
):  # fmt: skip
    """Write the three messages to `forces`, `peaks` and `head`; False when a number is not finite."""
    start, stamp, motion, numbers = np.zeros(1, np.int64), np.full(1, stamp_ns), np.empty((1, 7)), np.empty((1, 24))
    head_numbers(q.reshape(1, 3), v.reshape(1, 3), motion)
    fill(head, start, head_data, head_places, stamp, motion)
    side_by_side(penetration.reshape(1, 8), rate.reshape(1, 8), force.reshape(1, 8), numbers)
    fill(forces, start, pairs_data, pairs_places, stamp, numbers)
    total = motion.sum() + numbers.sum()
    side_by_side(makes.reshape(1, 8), impulse.reshape(1, 8), peak.reshape(1, 8), numbers)
    fill(peaks, start, pairs_data, pairs_places, stamp, numbers)
    return np.isfinite(total + numbers.sum())
