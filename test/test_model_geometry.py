"""Geometry: signed penetration compared with the paper's test, rates with differences, and directions of contacts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import preset

from plow_twin import PAIR_NAMES, Scene
from plow_twin.model import geometry
from plow_twin.model.pairs import CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y, STOPS_COUNTER_CLOCKWISE

offset = st.floats(-0.05, 0.05)
angle = st.floats(-0.6, 0.6)


def penetration(scene: Scene, q: np.ndarray) -> np.ndarray:
    y = geometry.body_state(q, np.zeros(3), scene.head.com_offset_m)
    c, s = y[5], y[6]
    return np.array([c, s, y[0], y[1], 1.0]) @ geometry.penetration_rows(scene)


def distance_sum_excess(scene: Scene, q: np.ndarray, pair: int) -> float:
    """Return the paper's criterion (eq. 2): the distances to the wall and its opposite, minus the side."""
    width = scene.frame.width_m + scene.clearance.horizontal_m
    height = scene.frame.height_m + scene.clearance.vertical_m
    x, y, theta = q
    rotation = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    corners = {  # corners of the cavity, moved by eq. (1) of the paper
        (sx, sy): rotation @ np.array([sx * width / 2, sy * height / 2]) + [x, y] for sx in (-1, 1) for sy in (-1, 1)
    }
    point = np.array([CORNER_X[pair] * scene.frame.width_m / 2, CORNER_Y[pair] * scene.frame.height_m / 2])
    if NORMAL_Y[pair] != 0.0:
        walls, side = [[corners[-1, sy], corners[1, sy]] for sy in (-1, 1)], height
    else:
        walls, side = [[corners[sx, -1], corners[sx, 1]] for sx in (-1, 1)], width
    return float(sum(_distance(point, *wall) for wall in walls) - side)


def _distance(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    along = b - a
    return abs(along[0] * (point - a)[1] - along[1] * (point - a)[0]) / float(np.hypot(*along))


@given(offset, offset, angle)
def test_the_papers_distance_sum_exceeds_the_side_by_twice_the_penetration(x: float, y: float, theta: float) -> None:
    scene, q = preset("paper"), np.array([x, y, theta])
    depth = penetration(scene, q)
    for pair in range(8):
        opposite = _opposite_depth(scene, q, pair)
        expected = 2.0 * (max(depth[pair], 0.0) + max(opposite, 0.0))
        assert distance_sum_excess(scene, q, pair) == pytest.approx(expected, abs=1e-15)


def _opposite_depth(scene: Scene, q: np.ndarray, pair: int) -> float:
    """Return the depth of the corner behind the opposite wall of the strip."""
    size = scene.frame.height_m + scene.clearance.vertical_m
    if NORMAL_X[pair] != 0.0:
        size = scene.frame.width_m + scene.clearance.horizontal_m
    return -float(penetration(scene, q)[pair]) - size


@given(offset, offset, angle, st.tuples(*[st.floats(-2.0, 2.0)] * 3), st.tuples(offset, offset))
def test_pose_and_body_coordinates_agree(
    x: float, y: float, theta: float, v: tuple[float, float, float], com: tuple[float, float]
) -> None:
    scene = preset("paper")
    head = dataclasses.replace(scene.head, rotation="consistent", com_offset_m=com)
    scene = dataclasses.replace(scene, head=head, gravity=dataclasses.replace(scene.gravity, arm_m=0.0))
    q, rate = np.array([x, y, theta]), np.array(v)
    step = 1e-6
    difference = (penetration(scene, q + step * rate) - penetration(scene, q - step * rate)) / (2.0 * step)
    body = geometry.body_state(q, rate, com)
    rows = geometry.penetration_rows(scene)
    c, s, om = body[5], body[6], body[4]
    rates = np.array([-om * s, om * c, body[2] + om * body[1], body[3] - om * body[0]])
    assert rates @ rows[:4] == pytest.approx(difference, abs=1e-7)


def test_senses_agree_with_the_paper() -> None:
    labels = preset("paper").frame.labels
    stops_ccw = {PAIR_NAMES[i] for i in np.flatnonzero(STOPS_COUNTER_CLOCKWISE)}
    expected = {
        f"{labels[letter]}_{wall}" for letter, wall in (("a", "bottom"), ("b", "right"), ("c", "top"), ("d", "left"))
    }
    assert stops_ccw == expected


def test_length_scale_ignores_tiny_clearances() -> None:
    scene = preset("paper")
    for horizontal, vertical, expected in (
        (0.025, 0.03, 0.025),
        (0.0, 0.03, 0.03),
        (-1e-3, 1e-9, 1e-4 * np.hypot(0.33, 0.27)),
    ):
        clearance = dataclasses.replace(scene.clearance, horizontal_m=horizontal, vertical_m=vertical)
        assert geometry.length_scale(dataclasses.replace(scene, clearance=clearance)) == pytest.approx(expected)
