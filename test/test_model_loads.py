"""Loads: arms, phases, tables, and the directions that the kernels use."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import preset

from plow_twin import Constant, Harmonic, SceneError, Table
from plow_twin.model.loads import compile_loads

TIMES = np.linspace(-1.0, 7.0, 97)


def test_loads_add_up_with_their_arms_and_phases() -> None:
    loads = (
        Harmonic("a", (3.0, -2.0), 2.0, 0.3, 0.5, (0.4, -0.7)),
        Harmonic("b", (1.0, 4.0), 2.0, -1.0, 0.0, (0.0, 0.2)),
        Harmonic("c", (0.0, 1.0), 5.0, 0.0, -3.0, (1.0, 0.0)),
        Constant("d", (7.0, 8.0), 9.0, (0.1, 0.2)),
    )
    expected = np.zeros((len(TIMES), 3))
    for load in loads:
        fx, fy = load.force_n
        wave = np.sin(load.omega_rad_s * TIMES + load.phase_rad) if isinstance(load, Harmonic) else np.ones_like(TIMES)
        moment = load.at_m[0] * fy - load.at_m[1] * fx + load.moment_n_m
        expected += wave[:, None] * np.array([fx, fy, moment])
    compiled = compile_loads(loads)
    assert compiled.at(TIMES) == pytest.approx(expected, abs=1e-12)
    assert len(compiled.omega) == 2


def test_tables_are_joined_held_and_summed() -> None:
    t1, t2 = np.array([0.0, 1.0, 4.0]), np.array([0.5, 2.0])
    w1, w2 = np.array([[0.0, 1, 2], [3, -1, 0], [1, 1, 1]]), np.array([[1.0, 2, 0], [5, 6, 7]])
    loads = (Table("linear", t1, w1), Table("steps", t2, w2, "zero", (0.5, 0.0)))
    wrench = compile_loads(loads).at(TIMES)
    linear = np.stack([np.interp(TIMES, t1, w1[:, i]) for i in range(3)], axis=1)
    steps = w2[np.clip(np.searchsorted(t2, TIMES, side="right") - 1, 0, None)]
    steps = steps + np.outer(0.5 * steps[:, 1], [0, 0, 1])
    assert wrench == pytest.approx(linear + steps, abs=1e-12)


def test_the_papers_loads_are_reconstruction_r1() -> None:
    wrench = compile_loads(preset("paper").loads).at(np.array([np.pi / 4]))[0]
    assert wrench == pytest.approx([32e3, -11e3, -45495.0], rel=1e-12)


def test_a_table_out_of_order_is_refused_with_its_row() -> None:
    table = Table("t", np.array([0.0, 2.0, 1.0]), np.zeros((3, 3)))
    scene = preset("paper")
    with pytest.raises(SceneError, match=r"loads\[0\]\.t\[2\]: got 1\.0, expected more than the time before it, 2\.0"):
        type(scene)(scene.head, scene.frame, scene.clearance, scene.contact, scene.gravity, (table,))
