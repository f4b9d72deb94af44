"""The eight pairs of a corner and a wall, in their fixed order.

The corners are those of the frame (the slide), seen from the front: top left, top right, bottom right, bottom left.
Each corner can touch two walls of the head's cavity. Its pair at the horizontal wall comes first.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

PAIR_NAMES: Final[tuple[str, ...]] = (
    "top_left_top",
    "top_left_left",
    "top_right_top",
    "top_right_right",
    "bottom_right_bottom",
    "bottom_right_right",
    "bottom_left_bottom",
    "bottom_left_left",
)
PAIR_COUNT: Final = len(PAIR_NAMES)

CORNER_NAMES: Final[tuple[str, ...]] = ("top_left", "top_right", "bottom_right", "bottom_left")

#: Side of each pair's corner, shape (8,) each: -1 left, +1 right; -1 bottom, +1 top.
CORNER_X: Final[NDArray[np.float64]] = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
CORNER_Y: Final[NDArray[np.float64]] = np.array([1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0])
#: Outward normal of each pair's wall in head axes, shape (8,) each.
NORMAL_X: Final[NDArray[np.float64]] = np.array([0.0, -1.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0])
NORMAL_Y: Final[NDArray[np.float64]] = np.array([1.0, 0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0])

#: Pairs whose force turns the head clockwise, and so stops a counter-clockwise swing.
STOPS_COUNTER_CLOCKWISE: Final[NDArray[np.bool_]] = CORNER_X * NORMAL_Y - CORNER_Y * NORMAL_X < 0.0


def corner_of(pair: int) -> str:
    """Return the name of a pair's corner."""
    return CORNER_NAMES[pair // 2]
