"""Archard wear: both closed forms, and that nothing of it runs when it is off."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scenes import preset

from plow_twin import Clearance, Contact, Frame, Gravity, Head, Initial, Scene, Twin, Wear, simulate


def pressed(wear: Wear | None, *, clearance: float, gravity: float, stiffness: float = 1e7) -> Scene:
    return Scene(
        Head(2000.0, 1000.0),
        Frame(0.3, 0.3),
        Clearance(0.02, clearance),
        Contact("kelvin_voigt", stiffness, damping=1e5),
        Gravity(gravity),
        initial=Initial((0.0, -0.5 * clearance if clearance > 0.0 else 0.0, 0.0)),
        locked=("x", "theta"),
        wear=wear,
    )


def test_constant_force_and_speed() -> None:
    """h = k_s F v t / A, with F the weight on two pads."""
    k_s, area, speed, g, t = 1e-12, 0.015, 2.0, 9.81, 50.0
    start = simulate(pressed(Wear(k_s, area, speed), clearance=0.02, gravity=g), 5.0)
    end = simulate(pressed(Wear(k_s, area, speed), clearance=0.02, gravity=g), 5.0 + t)
    expected = k_s * (2000.0 * g / 2.0) * speed * t / area
    assert (end.wear_depth - start.wear_depth)[[0, 2]] == pytest.approx([expected] * 2, rel=1e-6)
    assert (end.wear_depth[[1, 3, 4, 5, 6, 7]] == 0.0).all()


def test_linear_feedback_of_wear_on_force() -> None:
    """h = (exp(b r t) - 1) / b for F = F0 (1 + b h): a head clamped by interference relaxes as it wears, b = -1/d0."""
    depth, stiffness, k_s, area, speed, t = 1e-4, 1e7, 2e-9, 0.015, 2.0, 20.0
    scene = pressed(Wear(k_s, area, speed), clearance=-2.0 * depth, gravity=0.0, stiffness=stiffness)
    result = simulate(scene, t, tol=1e-10)
    b, rate = -1.0 / depth, k_s * stiffness * depth * speed / area
    expected = (math.exp(b * rate * t) - 1.0) / b
    assert expected > 0.3 * depth
    assert result.wear_depth[[0, 2, 4, 6]] == pytest.approx([expected] * 4, rel=1e-5)
    assert result.force[-1, 0] == pytest.approx(stiffness * (depth - expected), rel=1e-4)


def test_depth_is_the_wear_law_of_the_impulse_and_widens_the_clearance() -> None:
    scene = dataclasses.replace(preset("paper"), wear=Wear(1e-10, 0.015, 2.5))
    result = simulate(scene, 20.0)
    impulse = np.array([row["impulse"] for row in result.statistics.values()])
    assert result.wear_depth == pytest.approx(1e-10 * 2.5 / 0.015 * impulse, rel=1e-8)
    worn = simulate(dataclasses.replace(scene, wear=dataclasses.replace(scene.wear, initial_depth_m=(1e-3,) * 8)), 1.0)
    wide = Clearance(scene.clearance.horizontal_m + 2e-3, scene.clearance.vertical_m + 2e-3)
    same = simulate(dataclasses.replace(scene, clearance=wide), 1.0)
    assert worn.q == pytest.approx(same.q, abs=1e-9)


def test_without_wear_its_code_is_not_compiled() -> None:
    without, with_wear = Twin(preset("paper")), Twin(dataclasses.replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0)))
    assert without._parts.terms.wear is None and with_wear._parts.terms.wear is not None
    assert not without.advance(2.0).wear_depth.any()
    assert with_wear.advance(2.0).wear_depth.any()
