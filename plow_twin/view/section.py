"""Geometry of the cross-section of head and frame for pictures, in mm, with y downwards."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.geometry import corner_radius, outline
from plow_twin.model.pairs import CORNER_NAMES, CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y, PAIR_COUNT
from plow_twin.model.scene import Scene

Array = NDArray[np.float64]

_MM: Final = 1000.0
#: Length of an arrow [mm] per force [N].
ARROW_MM_PER_N: Final = 7e-4
FAINT_N: Final = 500.0
#: Distance [mm] of the drawn outline of the body from the cavity. The scene contains no outline.
BODY_MARGIN_MM: Final = 60.0

#: Drawn depth of a pad per wear depth [mm/mm].
PAD_MM_PER_MM: Final = 200.0
_PAD_MM: Final = 60.0
#: Distance of a label below its point [mm].
LABEL_MM: Final = 16.0

#: Hues of the corners (palette of Okabe and Ito). The pair at the vertical wall has the lighter colour.
_HUES: Final = ((0, 114, 178), (230, 159, 0), (213, 94, 0), (0, 158, 115))
_LIGHTER: Final = ((86, 180, 233), (240, 228, 66), (255, 158, 105), (110, 220, 185))
PAIR_COLORS: Final = tuple(color for pair in zip(_HUES, _LIGHTER, strict=True) for color in pair)
#: The same colours for matplotlib.
PAIR_RGB: Final = tuple(tuple(part / 255 for part in color) for color in PAIR_COLORS)
LOAD_COLOR: Final = (204, 121, 167)

_SQUARE: Final[Array] = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
_FLIP: Final[Array] = np.array([1.0, -1.0])
_SIGNS: Final[Array] = np.stack((CORNER_X, CORNER_Y), axis=1)
_OUTWARDS: Final[Array] = np.stack((NORMAL_X, NORMAL_Y), axis=1)


@dataclass(frozen=True)
class Section:
    """Dimensions of the cross-section [mm].

    A head that carries walls is drawn as a cavity that moves about the frame. A head that carries corners is drawn as a
    block that moves in the cavity.
    """

    frame: Array
    cavity: Array
    labels: tuple[str, ...]
    #: Name of the body that is drawn at rest. If this body is on a support, the axes of the picture move with it.
    frame_name: str = "frame (fixed)"
    is_block: bool = False
    radius: float = 0.0

    @classmethod
    def of(cls, scene: Scene) -> Section:
        """Return the cross-section of a scene."""
        frame = _MM * np.array([scene.frame.width_m, scene.frame.height_m])
        gaps = _MM * np.array([scene.clearance.horizontal_m, scene.clearance.vertical_m])
        name = "frame (fixed)" if scene.support is None else "frame (on springs)"
        labels = tuple(scene.frame.letters.get(corner, "") for corner in CORNER_NAMES)
        is_block = scene.head.carries == "corners"
        radius = _MM * corner_radius(scene)
        return cls(frame, frame + gaps, labels, "guide (fixed)" if is_block else name, is_block, radius)

    @property
    def half_view(self) -> Array:
        """Half width and half height of a view that shows the body and the arrows of the largest forces, shape (2,)."""
        return 0.5 * self.cavity + BODY_MARGIN_MM + 70.0

    def frame_strip(self) -> Array:
        """Outline of the frame, or of the cavity around a block, shape (n, 2)."""
        return (outline(self.cavity, 0.0) if self.is_block else outline(self.frame, self.radius)) * _FLIP

    def corners(self, pose: Iterable[float] = (0.0, 0.0, 0.0)) -> Array:
        """Corners of the frame, or of a block at a pose, in the order of `CORNER_NAMES`, shape (4, 2).

        The corners of a block are named by their present place, even after a turn by more than 45 degrees.
        """
        # distance of the middle of a rounded corner from the intersection of its sides, along each axis
        within = self.radius * (1.0 - math.sqrt(0.5))
        corners = ((0.5 * self.frame - within) * _SIGNS)[::2]
        if not self.is_block:
            return corners * _FLIP
        x, y, theta = pose
        return np.roll(_placed(corners, (x, y, theta)), -round(theta / (0.5 * math.pi)), axis=0)

    def head_strips(self, pose: Iterable[float]) -> Array:
        """Outlines of the head at a pose x, y [m], theta [rad].

        The shape is (2, 5, 2) for cavity and body, or (1, n, 2) for a block.
        """
        if self.is_block:
            return _placed(outline(self.frame, self.radius)[None], pose)
        sides = np.stack((self.cavity, self.cavity + 2.0 * BODY_MARGIN_MM))
        return _placed(0.5 * sides[:, None, :] * _SQUARE, pose)

    def exaggeration(self) -> float:
        """Return the factor with which the clearance fills a third of the frame's smaller side."""
        gap = float((self.cavity - self.frame).max())
        return max(1.0, round(float(self.frame.min()) / 3.0 / gap, 1)) if gap > 0.0 else 1.0

    def exaggerated(self, penetration: Array, factor: float) -> tuple[Array, NDArray[np.bool_]]:
        """Return the four walls with gaps widened by `factor`, shape (4, 2, 2), and whether each touches, shape (4,).

        The walls are ordered top, right, bottom, left. The gaps at its two corners determine the line of a wall.
        """
        places = (0.5 * self.frame * _SIGNS - _OUTWARDS * (_MM * factor * penetration)[:, None]) * _FLIP
        walls = np.array([(0, 2), (3, 5), (4, 6), (7, 1)])
        return _closed(places[walls]), (penetration[walls] > 0.0).any(axis=1)

    def pads(self, wear_depth_mm: Array) -> tuple[Array, Array, Array]:
        """Return centres, half sizes and label positions, shape (8, 2) each, of bars that show the wear of the pads.

        A bar lies inside the frame along the wall of its pair and begins at the corner.
        """
        corners = 0.5 * self.frame * _SIGNS
        along = _SIGNS - _OUTWARDS
        depth = np.minimum(PAD_MM_PER_MM * wear_depth_mm, 0.25 * self.frame.min())[:, None]
        middles = (corners - 0.5 * depth * _OUTWARDS - (0.5 * _PAD_MM + 12.0) * along) * _FLIP
        # the label of a vertical wall is closer to the centre
        inwards = np.stack((np.full(PAIR_COUNT, 0.5), np.where(np.abs(_OUTWARDS[:, 0]) > 0.5, 0.26, 0.64)), axis=1)
        labels = corners * inwards * _FLIP - [0.0, LABEL_MM]
        return middles, 0.5 * (depth * np.abs(_OUTWARDS) + _PAD_MM * np.abs(along)), labels

    def head_points(self, pose: Iterable[float]) -> Array:
        """Centre of the head and position of its name, shape (2, 2)."""
        above = 0.5 * (self.frame if self.is_block else self.cavity)[1] + 0.5 * BODY_MARGIN_MM
        places = _placed(np.array([[0.0, 0.0], [0.0, above]]), pose)
        places[1, 1] -= LABEL_MM
        return places

    def arrows(self, pose: tuple[float, float, float], force: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Origins and vectors of the forces on the head, shape (k, 2), and their pairs, shape (k,)."""
        drawn = np.flatnonzero(force >= FAINT_N)
        # a corner of a frame pushes the wall of the head outwards; a wall pushes a corner of a block inwards
        theta = math.pi if self.is_block else pose[2]
        normal_x = math.cos(theta) * NORMAL_X[drawn] - math.sin(theta) * NORMAL_Y[drawn]
        normal_y = math.sin(theta) * NORMAL_X[drawn] + math.cos(theta) * NORMAL_Y[drawn]
        length = ARROW_MM_PER_N * force[drawn]
        vectors = np.stack((length * normal_x, length * normal_y), axis=1) * _FLIP
        return self.corners(pose)[drawn // 2], vectors, drawn

    def corner_radii(self, force: Array) -> Array:
        """Radius [mm] of the mark of each corner, shape (4,); it is larger if the corner carries force."""
        total = force.reshape(PAIR_COUNT // 2, 2).sum(axis=1)
        return np.where(total >= FAINT_N, 7.0, 3.0)


def _closed(walls: Array) -> Array:
    """Extend walls, shape (4, 2, 2), to their intersections, unless two neighbours are parallel."""
    along = walls[:, 1] - walls[:, 0]
    before, along_before = np.roll(walls, 1, axis=0), np.roll(along, 1, axis=0)
    across = _cross(along_before, along)
    if not np.abs(across).min() > 1e-9:  # [mm^2]
        return walls
    share = _cross(walls[:, 0] - before[:, 0], along) / across
    corners = before[:, 0] + share[:, None] * along_before
    return np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return product


def _placed(points: Array, pose: Iterable[float]) -> Array:
    """Return points of the head, shape (..., 2) [mm], at the pose x, y [m], theta [rad], with y downwards."""
    x, y, theta = pose
    turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    placed: Array = (points @ turn + _MM * np.array([x, y])) * _FLIP
    return placed
