"""Publish the pose of the head on /tf, and markers for RViz of the cavity, the frame, the pads and the forces."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from geometry_msgs.msg import Point, Vector3
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from plow_twin.live.parameters import Settings
from plow_twin.model.geometry import corner_positions, corner_radius, outline, wall_distances
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y, PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.ros.messages import set_stamp
from plow_twin.solve.state import ROW

Array = NDArray[np.float64]

_GREY: Final = (0.6, 0.6, 0.6)
_BLUE: Final = (0.3, 0.55, 0.9)
_ORANGE: Final = (0.9, 0.6, 0.1)
_RED: Final = (0.9, 0.2, 0.2)
#: Width of lines and arrows, relative to the frame height.
_LINE: Final = 0.015
#: Length of the arrow for a force as large as the weight of the head, relative to the frame height.
_ARROW: Final = 0.5


class Markers:
    """Publisher of the markers. All coordinates are in the frame `frame_id`.

    The namespaces of the markers are `frame`, `cavity`, `pads` and `forces`. The distance between a pad and its wall is
    the wear depth of the pad. The arrows in `forces` are the forces on the head.
    """

    def __init__(self, node: Node, settings: Settings, scene: Scene) -> None:
        self._node, self._settings, self._scene = node, settings, scene
        self._publisher = node.create_publisher(MarkerArray, "markers", 1)
        self._transforms = _Transforms(node) if settings.tf else None
        corners_x, corners_y = corner_positions(scene)
        self._corners = np.stack([corners_x, corners_y], axis=1)
        self._walls, self._radius = wall_distances([scene])[0], corner_radius(scene)
        self._scale = scene.frame.height_m
        self._weight = scene.head.mass_kg * max(scene.gravity.acceleration_m_s2, 1.0)

    def publish(self, stamp_ns: int, row: NDArray[np.void]) -> None:
        """Send the markers for the state in a row of the type `ROW`, shape ()."""
        assert row.dtype == ROW
        q = np.asarray(row["q"], float)
        block = 0.5 * np.array([self._scene.frame.width_m, self._scene.frame.height_m])
        cavity = block + 0.5 * np.array([self._scene.clearance.horizontal_m, self._scene.clearance.vertical_m])
        still = np.zeros(3)
        walls, frame = (still, q) if self._scene.head.carries == "corners" else (q, still)
        markers = [
            self._line("cavity", 0, placed(_rectangle(cavity), walls), _BLUE),
            self._line("frame", 0, placed(outline(2.0 * block, self._radius), frame), _GREY),
        ]
        normal = np.stack([NORMAL_X, NORMAL_Y], axis=1)
        along = np.stack([-NORMAL_Y, NORMAL_X], axis=1) * 0.1 * self._scale
        side = -1.0 if self._scene.head.carries == "corners" else 1.0  # sign of the force on the head
        # a pad is drawn at the place where its corner touches the wall
        for pair in range(PAIR_COUNT):
            depth, force = float(row["wear_depth"][pair]), float(row["force"][pair])
            foot = self._corners[pair] + normal[pair] * (self._walls[pair] - normal[pair] @ self._corners[pair])
            worn = placed(np.stack([foot - along[pair], foot + along[pair]]) + depth * normal[pair], walls)
            markers.append(self._line("pads", pair, worn, _ORANGE))
            out = placed(normal[pair][None], np.array([0.0, 0.0, walls[2]]))[0]
            begin = placed(self._corners[pair][None], frame)[0] + self._radius * out
            markers.append(self._arrow(pair, begin, side * out * force / self._weight * _ARROW * self._scale))
        message = MarkerArray(markers=markers)
        for marker in markers:
            marker.header.frame_id = self._settings.frame_id
            set_stamp(marker.header, stamp_ns)
        self._publisher.publish(message)
        if self._transforms is not None:
            self._transforms(self._settings, stamp_ns, q)

    def close(self) -> None:
        """Remove the publishers from the node."""
        self._node.destroy_publisher(self._publisher)
        if self._transforms is not None:
            self._node.destroy_publisher(self._transforms.publisher)

    def _line(self, namespace: str, number: int, points: Array, color: tuple[float, float, float]) -> Marker:
        marker = Marker(ns=namespace, id=number, type=Marker.LINE_STRIP, color=_color(color))
        marker.pose.orientation.w = 1.0
        marker.scale = Vector3(x=_LINE * self._scale)
        marker.points = [Point(x=x, y=y) for x, y in points.tolist()]
        return marker

    def _arrow(self, pair: int, begin: Array, force: Array) -> Marker:
        if not force.any():
            return Marker(ns="forces", id=pair, action=Marker.DELETE)
        marker = Marker(ns="forces", id=pair, type=Marker.ARROW, color=_color(_RED))
        marker.pose.orientation.w = 1.0
        marker.scale = Vector3(x=_LINE * self._scale, y=2.0 * _LINE * self._scale)
        marker.points = [Point(x=x, y=y) for x, y in (begin.tolist(), (begin + force).tolist())]
        return marker


class _Transforms:
    """Publisher of the pose of the head on /tf, from `frame_id` to `child_frame_id`."""

    def __init__(self, node: Node) -> None:
        from tf2_msgs.msg import TFMessage

        self._message: Any = TFMessage
        self.publisher = node.create_publisher(TFMessage, "/tf", 100)

    def __call__(self, settings: Settings, stamp_ns: int, q: Array) -> None:
        from geometry_msgs.msg import TransformStamped

        transform = TransformStamped(child_frame_id=settings.child_frame_id)
        transform.header.frame_id = settings.frame_id
        set_stamp(transform.header, stamp_ns)
        transform.transform.translation = Vector3(x=float(q[0]), y=float(q[1]))
        transform.transform.rotation.z, transform.transform.rotation.w = (
            float(np.sin(q[2] / 2)),
            float(np.cos(q[2] / 2)),
        )
        self.publisher.publish(self._message(transforms=[transform]))


def placed(points: Array, q: Array) -> Array:
    """Transform points, shape (n, 2), from the axes of a body at the pose `q` to the axes of the slide.

    `q` is x, y [m] and theta [rad] of the body.
    """
    c, s = np.cos(q[2]), np.sin(q[2])
    rotated: Array = points @ np.array([[c, s], [-s, c]]) + q[:2]
    return rotated


def _rectangle(half: Array) -> Array:
    return half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])


def _color(color: tuple[float, float, float]) -> ColorRGBA:
    red, green, blue = color
    return ColorRGBA(r=red, g=green, b=blue, a=1.0)
