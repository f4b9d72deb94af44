"""Chart of the largest contact force in each piece of the face, for each pass."""

from __future__ import annotations

import math
from bisect import insort
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from plow_twin.stream.journal import Travel
from plow_twin.view.columns import Array, Batches, Indexes, TimeAxis

#: Size of the chart, in the units of its view.
WIDTH: Final = 300.0
HEIGHT: Final = 90.0
#: Initial length of a piece [m]. It is doubled when a pass has more than `_MOST_PIECES` pieces.
_PIECE_M: Final = 0.1
_MOST_PIECES: Final = 600
#: Number of passes in the chart; the newest pass is drawn in a bright colour.
_MOST_PASSES: Final = 8
_AXIS: Final = (110, 115, 125)
_NEWEST: Final = (240, 160, 60)
_EARLIER: Final = (90, 110, 130)


class FaceChart:
    """Chart of the forces along the face. `known` is true once the head has moved along the face."""

    def __init__(self, stream: rr.RecordingStream, axis: TimeAxis) -> None:
        self._lines = Batches(stream, axis, "face/force", rr.LineStrips2D, ("strips", "colors"))
        self._ticks = Batches(stream, axis, "face/ticks", rr.Points2D, ("positions", "labels"))
        style: Any = rr.LineStrips2D.from_fields(radii=[0.5])
        stream.log("face/force", style, static=True)
        style = rr.Points2D.from_fields(colors=[_AXIS], radii=[0.1], show_labels=True)
        stream.log("face/ticks", style, static=True)
        self._passes: list[dict[int, float]] = [{}]
        self._piece_m = _PIECE_M
        self._speed = self._place_m = 0.0
        self._direction = 0.0
        self._reached_ns: int | None = None
        #: Speeds with stamps that the forces have not reached, sorted by stamp.
        self._coming: list[Travel] = []
        self.known = False

    def travel(self, travel: Travel) -> None:
        """Change the speed from the stamp of `travel` on."""
        if self._reached_ns is not None and travel.stamp_ns > self._reached_ns:
            insort(self._coming, travel, key=lambda waiting: waiting.stamp_ns)
        else:
            self._set_speed(travel.speed_m_s)

    def _set_speed(self, speed_m_s: float) -> None:
        direction = math.copysign(1.0, speed_m_s) if speed_m_s else 0.0
        if direction and self._direction and direction != self._direction:
            self._passes.append({})
            del self._passes[:-_MOST_PASSES]
        self._speed, self._direction = speed_m_s, direction or self._direction
        self.known = self.known or bool(speed_m_s)

    def forces(self, stamps: Indexes, force: Array) -> None:
        """Add forces [N], shape (n,), with their stamps [ns]. Each force belongs to the speed at its stamp."""
        while len(stamps) and self._coming and stamps[-1] > self._coming[0].stamp_ns:
            count = int(np.searchsorted(stamps, self._coming[0].stamp_ns, "right"))
            self._forces(stamps[:count], force[:count])
            stamps, force = stamps[count:], force[count:]
            self._set_speed(self._coming.pop(0).speed_m_s)
        self._forces(stamps, force)

    def _forces(self, stamps: Indexes, force: Array) -> None:
        if not len(stamps):
            return
        last = int(stamps[0]) if self._reached_ns is None else self._reached_ns
        steps = np.maximum(np.diff(stamps, prepend=last), 0) * 1e-9
        place = self._place_m + self._speed * np.cumsum(steps)
        self._place_m, self._reached_ns = float(place[-1]), int(stamps[-1])
        if not self._speed:
            return
        newest_pass = self._passes[-1]
        pieces: NDArray[np.int64] = np.floor(place / self._piece_m).astype(np.int64)
        for piece in np.unique(pieces).tolist():
            newest_pass[piece] = max(newest_pass.get(piece, 0.0), float(force[pieces == piece].max()))
        while len(newest_pass) > _MOST_PIECES:
            self._piece_m *= 2.0
            self._passes = [_halved(forces) for forces in self._passes]
            newest_pass = self._passes[-1]

    def restart(self) -> None:
        """Continue after a reset. A reset can decrease the stamps, so the waiting speeds are applied at once."""
        for travel in self._coming:
            self._set_speed(travel.speed_m_s)
        self._coming, self._reached_ns = [], None

    def draw(self, stamp_ns: int, step: int) -> None:
        """Draw the chart."""
        filled = [forces for forces in self._passes if forces]
        if not filled:
            return
        places = [piece * self._piece_m for pass_forces in filled for piece in (min(pass_forces), max(pass_forces) + 1)]
        first, last = min(places), max(places)
        top = _round_up(max(1.0, max(max(pass_forces.values()) for pass_forces in filled) / 1e3))
        across, up = WIDTH / max(last - first, self._piece_m), HEIGHT / top
        strips = [np.array([[0.0, -HEIGHT], [0.0, 0.0], [WIDTH, 0.0]])]
        colors = [_AXIS]
        for number, pass_forces in enumerate(filled):
            pieces = np.array(sorted(pass_forces))
            force = np.array([pass_forces[piece] for piece in pieces.tolist()]) / 1e3
            middle = (pieces + 0.5) * self._piece_m
            strips.append(np.column_stack((across * (middle - first), -up * force)))
            colors.append(_NEWEST if number == len(filled) - 1 else _EARLIER)
        ticks = [(across * (x - first), 6.0, f"{x:g} m") for x in (first, 0.5 * (first + last), last)]
        ticks += [(-12.0, -up * force, f"{force:g} kN") for force in (0.5 * top, top)]
        self._lines.add(stamp_ns, step, strips=strips, colors=colors)
        self._ticks.add(stamp_ns, step, positions=[(x, y) for x, y, _ in ticks], labels=[text for *_, text in ticks])

    def flush(self) -> None:
        """Send the buffered charts."""
        self._lines.flush()
        self._ticks.flush()


def _halved(forces: dict[int, float]) -> dict[int, float]:
    halved: dict[int, float] = {}
    for piece, force in forces.items():
        halved[piece // 2] = max(halved.get(piece // 2, 0.0), force)
    return halved


def _round_up(value: float) -> float:
    """Return the smallest number of the form 1, 2, 5 or 10 times a power of ten that is not below the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value)
