"""Sets of corners that carry force at the same time, and their exact durations, from the contact events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import CORNER_NAMES, PAIR_COUNT, STOPS_COUNTER_CLOCKWISE
from plow_twin.model.scene import Scene
from plow_twin.run.simulate import Result
from plow_twin_paper.values import SHORTEST_HOLD_S, Sense

#: Mode of a pair that carries force.
_CARRIES = 1


@dataclass(frozen=True)
class Hold:
    """A time in which exactly the corners `corners`, such as `abd`, carry force."""

    start_s: float
    end_s: float
    corners: str

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class SetFigures:
    """Figures of one set. The durations are the total and the longest hold [s].

    `share` is the share of the contact time for its direction of swing, and `count` the number of long holds.
    """

    share: float
    total_s: float
    longest_s: float
    count: int


def letters_of_pairs(scene: Scene) -> list[str]:
    """Return the letter of each pair's corner, shape (8,)."""
    return [scene.frame.letters[CORNER_NAMES[pair // 2]] for pair in range(PAIR_COUNT)]


def of_sense(sense: Sense) -> NDArray[np.bool_]:
    """Return a mask of the pairs that stop a direction of swing, shape (8,)."""
    return STOPS_COUNTER_CLOCKWISE if sense == "ccw" else ~STOPS_COUNTER_CLOCKWISE


def holds(scene: Scene, result: Result, sense: Sense) -> list[Hold]:
    """Return the sets of one direction of swing in order of time, without gaps, to the end of the run."""
    letters, chosen = letters_of_pairs(scene), of_sense(sense)
    carries = result.force[0] > 0.0  # a pair that penetrates at t = 0 is in contact without a contact event
    intervals: list[Hold] = []
    start, now = 0.0, _name(letters, carries & chosen)
    for event in result.events:
        carries[event["pair"]] = event["mode_to"] == _CARRIES
        name, time = _name(letters, carries & chosen), float(event["time"])
        if name != now:
            if time > start:
                intervals.append(Hold(start, time, now))
            start, now = time, name
    intervals.append(Hold(start, float(result.t[-1]), now))
    return intervals


def _name(letters: Sequence[str], carries: NDArray[np.bool_]) -> str:
    return "".join(sorted(letter for letter, on in zip(letters, carries, strict=True) if on))


def figures(timeline: Sequence[Hold]) -> dict[str, SetFigures]:
    """Return the figures of each set that occurs, beginning with the largest share."""
    total = sum(hold.duration_s for hold in timeline if hold.corners)
    table = {}
    for name in {hold.corners for hold in timeline} - {""}:
        durations = [hold.duration_s for hold in timeline if hold.corners == name]
        long_enough = sum(duration >= SHORTEST_HOLD_S for duration in durations)
        table[name] = SetFigures(sum(durations) / total, sum(durations), max(durations), long_enough)
    return dict(sorted(table.items(), key=lambda item: -item[1].share))


def share_by_size(timeline: Sequence[Hold]) -> list[float]:
    """Return the shares of the contact time with one, two, three and four points, shape (4,)."""
    table = figures(timeline)
    return [sum(row.share for name, row in table.items() if len(name) == size) for size in (1, 2, 3, 4)]


def at(timeline: Sequence[Hold], time_s: float) -> str:
    """Return the set at a time [s]."""
    return next((hold.corners for hold in timeline if hold.start_s <= time_s < hold.end_s), timeline[-1].corners)


def nearest(timeline: Sequence[Hold], time_s: float, corners: str) -> tuple[float, Hold] | None:
    """Return the nearest hold of a set to a time, and its distance [s] from this time; earlier holds are negative."""
    matching = [hold for hold in timeline if hold.corners == corners]
    if not matching:
        return None
    distance = [min(max(time_s, hold.start_s), hold.end_s) - time_s for hold in matching]
    best = int(np.argmin(np.abs(distance)))
    return distance[best], matching[best]
