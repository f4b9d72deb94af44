"""Tangential friction: closed forms of a sliding block with both solvers, and no unused code."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import FIRM, TURNING_NOTHING, pose_error, preset

from plow_twin import Clearance, Constant, Contact, Frame, Friction, Gravity, Head, Initial, Scene, simulate
from plow_twin.solve import compiled_scene

MASS, G, STIFFNESS, MU, SPEED = 800.0, 9.81, 1e8, 0.3, 0.02


def block(push: float, speed: float) -> Scene:
    """Return a head whose roof rests on the two upper corners, at rest vertically and free to slide.

    With its inertia and its loads, it uses the kernels of a pinned motion.
    """
    depth = MASS * G / (2.0 * STIFFNESS)
    return Scene(
        Head(MASS, FIRM),
        Frame(0.3, 0.3),
        Clearance(1.0, 0.01),
        Contact("kelvin_voigt", STIFFNESS, damping=1e4),
        Gravity(G),
        (Constant("push", (push, 0.0)), TURNING_NOTHING),
        initial=Initial((0.0, -0.005 - depth, 0.0), (speed, 0.0, 0.0)),
        friction=Friction(MU, SPEED),
    )


def test_a_sliding_block_slows_down_as_the_law_says() -> None:
    """m v' = -mu N tanh(v / v_s) has the solution sinh(v / v_s) = sinh(v0 / v_s) exp(-mu N t / (m v_s))."""
    v0 = 0.6
    result = simulate(block(0.0, v0), 0.3, output_dt=0.01, tol=1e-11)
    expected = SPEED * np.arcsinh(math.sinh(v0 / SPEED) * np.exp(-MU * G * result.t / SPEED))
    assert result.v[:, 0] == pytest.approx(expected, abs=1e-9)
    assert result.v[-1, 0] < 1e-6 * v0


@pytest.mark.parametrize("share", [0.5, -0.9])
def test_a_push_below_the_limit_makes_the_block_creep(share: float) -> None:
    """In the steady state, mu N tanh(v / v_s) = F."""
    result = simulate(block(share * MU * MASS * G, 0.0), 1.0, output_dt=0.5)
    assert result.v[-1, 0] == pytest.approx(SPEED * math.atanh(share), rel=1e-9)


def test_a_push_above_the_limit_accelerates_the_head_by_the_excess() -> None:
    result = simulate(block(1.5 * MU * MASS * G, 0.0), 0.2, output_dt=0.1)
    assert (result.v[-1, 0] - result.v[-2, 0]) / 0.1 == pytest.approx(0.5 * MU * G, rel=1e-6)


# in the quick run, test_solve_corners compares both solvers with friction and checks the balance
@pytest.mark.stress
@pytest.mark.parametrize("name", ["paper", "bench_hc"])
def test_both_solvers_agree_and_the_energy_balances(name: str) -> None:
    scene = replace(preset(name), friction=Friction(0.3, 0.02))
    events = simulate(scene, 2.0, output_dt=0.1, energy_balance=True)
    steps = simulate(scene, 2.0, output_dt=0.1, method="rk4", dt=1e-5)
    assert pose_error(scene, steps.q, events.q) < 1e-7
    assert events.energy_balance is not None and events.energy_balance.relative_imbalance < 1e-12
    assert events.energy_balance.friction_work_j > 100.0
    without = simulate(preset(name), 2.0, output_dt=0.1)
    assert pose_error(scene, without.q, events.q) > 1e-3


def test_a_scene_without_friction_compiles_no_friction() -> None:
    for friction in (None, Friction(0.0)):
        assert compiled_scene.compile_scene(replace(preset("paper"), friction=friction), 1e-9).parts.terms.slip is None
