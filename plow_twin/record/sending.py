"""The messages of a publication as the bytes that are sent: one compiled call for those that each publication has."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.outputs import head_numbers, publication_templates
from plow_twin.record.template import STAMP_AT, Template, compiled, fill, stamp_word
from plow_twin.record.words import bits, set_word
from plow_twin.solve.state import ROW
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
        each = [templates[topic] for topic in _EACH]
        ends = np.cumsum([0, *map(len, each)])
        #: the three messages one behind the other; only stamps and numbers change
        self._buffer = np.concatenate([template.data for template in each])
        self._starts = ends[:-1].copy()
        self._places = np.concatenate([start + template.places for start, template in zip(ends, each, strict=False)])
        whole = self._buffer.data
        #: each of them by base name of its topic, in the order in which they are sent
        self.parts = [(topic, whole[begin:end]) for topic, begin, end in zip(_EACH, ends, ends[1:], strict=False)]

    def write(self, publication: Publication) -> dict[str, bytes] | None:
        """Return the bytes by base name of the topic, forces first; None when a number is not finite."""
        return self.taken() | self.slow(publication) if self.fill(publication) else None

    def fill(self, publication: Publication) -> bool:
        """Write the messages that each publication has into `parts`; False when a number of it is not finite."""
        finite = _write(publication.stamp_ns, publication.rows, self._buffer, self._starts, self._places)
        return bool(finite) and (publication.slow is None or publication.finite)

    def taken(self) -> dict[str, bytes]:
        """Return what `fill` has written, by base name of the topic."""
        return {topic: part.tobytes() for topic, part in self.parts}

    def slow(self, publication: Publication) -> dict[str, bytes]:
        """Return the messages of its slow part, if it has one."""
        slow, stamp_ns = publication.slow, publication.stamp_ns
        if slow is None:
            return {}
        numbers = {"clearance": slow.clearance, "wear_rate": slow.wear_rate}
        return {topic: self._slow[topic].write(stamp_ns, found) for topic, found in numbers.items()}


def warm_up() -> None:
    """Compile what is needed, or load it from the cache on disk."""
    slow = Slow(np.zeros(len(CLEARANCE_NAMES)), np.zeros(PAIR_COUNT))
    PublicationBytes("", "").write(Publication.of_row(np.zeros((1, 1), ROW), stamp_ns=0, slow=slow))


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
def _write(stamp_ns, rows, buffer, starts, places):  # type: ignore[no-untyped-def]
    """Write stamp and numbers of a `ROW` into the three messages; False when a number is not finite."""
    row, motion, stamp = rows[0, 0], np.empty((1, 7)), stamp_word(stamp_ns)
    head_numbers(row.q.reshape(1, 3), row.v.reshape(1, 3), motion)
    for start in starts:
        set_word(buffer, start + STAMP_AT, stamp)
    total = 0.0
    for pair in range(PAIR_COUNT):
        numbers = (
            row.penetration[pair], row.rate[pair], row.force[pair],
            float(row.makes[pair]), row.impulse[pair], row.peak[pair],
        )  # fmt: skip
        for k in range(6):
            set_word(buffer, places[8 * k + pair], bits(numbers[k]))
            total += numbers[k]
    for k in range(7):
        set_word(buffer, places[48 + k], bits(motion[0, k]))
        total += motion[0, k]
    return np.isfinite(total)
