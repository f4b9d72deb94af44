"""The eight pairs in their fixed order. A pair is one corner of the frame (the slide) and one wall of the cavity.

The corners, seen from the front, are top left, top right, bottom right, bottom left. Each corner can touch two walls;
the pair with the horizontal wall comes first.
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

#: Position of each pair's corner, shape (8,) each: x is -1 left and +1 right, y is -1 bottom and +1 top.
CORNER_X: Final[NDArray[np.float64]] = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
CORNER_Y: Final[NDArray[np.float64]] = np.array([1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0])
#: Outward normal of each pair's wall in head axes, shape (8,) each.
NORMAL_X: Final[NDArray[np.float64]] = np.array([0.0, -1.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0])
NORMAL_Y: Final[NDArray[np.float64]] = np.array([1.0, 0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0])

#: Whether the force of a pair turns the head clockwise and so stops a counter-clockwise swing, shape (8,).
STOPS_COUNTER_CLOCKWISE: Final[NDArray[np.bool_]] = CORNER_X * NORMAL_Y - CORNER_Y * NORMAL_X < 0.0


def corner_of(pair: int) -> str:
    """Return the name of a pair's corner, for the index of the pair."""
    return CORNER_NAMES[pair // 2]
