"""Sets of corners that carry force at the same time, coloured by the direction of rotation that they stop.

Each pair of a corner and a wall stops either a counter-clockwise (ccw) or a clockwise (cw) rotation of the head. A set
is a bit mask of pairs.
"""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
import rerun as rr

from plow_twin.model.pairs import CORNER_NAMES, PAIR_COUNT, STOPS_COUNTER_CLOCKWISE
from plow_twin.view.columns import Array, Batches, Indexes, TimeAxis

ENTITY: Final = "contact_set"
FREE: Final = "free"
Color = tuple[int, int, int]
#: Colours of sets: no contact, contacts that stop a ccw rotation, contacts that stop a cw rotation, and both.
_COLORS: Final[tuple[Color, ...]] = ((235, 235, 235), (86, 180, 233), (240, 160, 60), (204, 121, 167))
_CCW_BITS: Final = int((STOPS_COUNTER_CLOCKWISE.astype(np.int64) << np.arange(PAIR_COUNT)).sum())


def set_color(mask: int) -> Color:
    """Return the colour of a set of pairs."""
    return _COLORS[(1 if mask & _CCW_BITS else 0) + (2 if mask & ~_CCW_BITS else 0)]


def masks_of(force: Array) -> Indexes:
    """Return for each row of forces, shape (n, 8), the set of pairs that carry force, shape (n,)."""
    masks: Indexes = ((force > 0.0) << np.arange(PAIR_COUNT)).sum(axis=1)
    return masks


class ContactSets:
    """Writer of the changes of the contact set.

    In a thinned run, the writer sends the first change and the last set of each span.
    """

    def __init__(self, stream: rr.RecordingStream, axis: TimeAxis, labels: tuple[str, ...], span_ns: int) -> None:
        self._names = tuple(label or name for label, name in zip(labels, CORNER_NAMES, strict=True))
        self._states = Batches(stream, axis, ENTITY, rr.StateChange, ("state",))
        self._span_ns = span_ns
        self._before: str | None = None
        self._at: int | None = None
        self._last: tuple[int, int] | None = None
        #: Newest contact set that has not been written, and the step of its row; a span is written at its end.
        self._pending: tuple[str, int] | None = None
        names: dict[str, Color] = {}
        for ccw, cw in product(range(16), range(16)):
            mask = self._pairs(ccw, True) | self._pairs(cw, False)
            names[self.name(mask)] = set_color(mask)
        style = rr.StateConfiguration(values=list(names), labels=list(names), colors=list(names.values()))
        stream.log(ENTITY, style, static=True)

    @staticmethod
    def _pairs(corners: int, ccw: bool) -> int:
        return sum(
            1 << pair
            for pair in range(PAIR_COUNT)
            if bool(STOPS_COUNTER_CLOCKWISE[pair]) == ccw and corners >> pair // 2 & 1
        )

    def name(self, mask: int) -> str:
        """Return the name of a set of pairs, such as `ccw a+d, cw b`."""
        parts = []
        for word, bits in (("ccw", mask & _CCW_BITS), ("cw", mask & ~_CCW_BITS)):
            corners = sorted(self._names[corner] for corner in range(4) if bits >> 2 * corner & 3)
            parts += [f"{word} {'+'.join(corners)}"] if corners else []
        return ", ".join(parts) or FREE

    def add(self, stamps: Indexes, steps: Indexes, force: Array) -> None:
        """Add stamps [ns], shape (n,), steps, shape (n,), and forces, shape (n, 8)."""
        masks = masks_of(force)
        if len(stamps):
            self._last = int(stamps[-1]) + 1, int(steps[-1])
        changed = np.flatnonzero(np.diff(masks, prepend=-1))
        for row in changed.tolist():
            self._end_span(int(stamps[row]))
            name = self.name(int(masks[row]))
            span = int(stamps[row]) // self._span_ns if self._span_ns else None
            if span is not None and span == self._at:
                self._pending = name, int(steps[row])
            elif name != self._before:
                self._states.add(int(stamps[row]), int(steps[row]), state=[name])
                self._before, self._at = name, span
        if len(stamps):
            self._end_span(int(stamps[-1]))

    def _end_span(self, stamp_ns: int) -> None:
        """Write the last set of the present span if the stamp lies after the span."""
        if self._pending is None or self._at is None or stamp_ns // self._span_ns == self._at:
            return
        name, step = self._pending
        if name != self._before:
            self._states.add((self._at + 1) * self._span_ns, step, state=[name])
        self._before, self._pending = name, None

    def finish(self) -> None:
        """Write the last set of the last span."""
        if self._pending is not None and self._at is not None:
            self._end_span((self._at + 1) * self._span_ns)

    def end(self) -> None:
        """End the curve. After this call, the set is unknown."""
        if self._last is not None:
            self._states.add(*self._last, state=[])
        self._before = self._at = self._last = self._pending = None

    def flush(self) -> None:
        """Send the buffered changes."""
        self._states.flush()
