"""Archard wear: two closed forms, and no unused code."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scenes import preset, with_presets_terms

from plow_twin import Clearance, Contact, Frame, Gravity, Head, Initial, Scene, SceneError, Twin, Wear, simulate
from plow_twin.model.loads import compile_loads
from plow_twin.model.pairs import PAIR_NAMES


def pressed(wear: Wear | None, *, clearance: float, gravity: float, stiffness: float = 1e7) -> Scene:
    scene = Scene(
        Head(2000.0, 1000.0),
        Frame(0.3, 0.3),
        Clearance(0.02, clearance),
        Contact("kelvin_voigt", stiffness, damping=1e5),
        Gravity(gravity),
        initial=Initial((0.0, -0.5 * clearance if clearance > 0.0 else 0.0, 0.0)),
        wear=wear,
    )
    return with_presets_terms(scene)


def test_constant_force_and_speed_give_the_known_wear() -> None:
    """h = k_s F v t / A, where F is the weight on two pads."""
    k_s, area, speed, g, t = 1e-12, 0.015, 2.0, 9.81, 50.0
    start = simulate(pressed(Wear(k_s, area, speed), clearance=0.02, gravity=g), 5.0)
    end = simulate(pressed(Wear(k_s, area, speed), clearance=0.02, gravity=g), 5.0 + t)
    expected = k_s * (2000.0 * g / 2.0) * speed * t / area
    assert (end.wear_depth - start.wear_depth)[[0, 2]] == pytest.approx([expected] * 2, rel=1e-6)
    assert (end.wear_depth[[1, 3, 4, 5, 6, 7]] == 0.0).all()


def test_linear_feedback_of_wear_on_force() -> None:
    """For F = F0 (1 + b h), h = (exp(b r t) - 1) / b. A head clamped by interference relaxes with b = -1/d0."""
    depth, stiffness, k_s, area, speed, t = 1e-4, 1e7, 2e-9, 0.015, 2.0, 2.0
    scene = pressed(Wear(k_s, area, speed), clearance=-2.0 * depth, gravity=0.0, stiffness=stiffness)
    result = simulate(scene, t, tol=1e-10)
    b, rate = -1.0 / depth, k_s * stiffness * depth * speed / area
    expected = (math.exp(b * rate * t) - 1.0) / b
    assert expected > 0.3 * depth
    assert result.wear_depth[[0, 2, 4, 6]] == pytest.approx([expected] * 4, rel=1e-5)
    assert result.force[-1, 0] == pytest.approx(stiffness * (depth - expected), rel=1e-4)


def test_depth_follows_from_the_impulse_and_widens_the_clearance() -> None:
    # a pinned motion compiles the same kernels
    scene = dataclasses.replace(preset("bench_kv"), wear=Wear(1e-10, 0.015, 2.5))
    result = simulate(scene, 20.0)
    impulse = np.array([row["impulse"] for row in result.statistics.values()])
    assert result.wear_depth == pytest.approx(1e-10 * 2.5 / 0.015 * impulse, rel=1e-8)
    worn = simulate(dataclasses.replace(scene, wear=dataclasses.replace(scene.wear, initial_depth_m=(1e-3,) * 8)), 1.0)
    wide = Clearance(scene.clearance.horizontal_m + 2e-3, scene.clearance.vertical_m + 2e-3)
    same = simulate(dataclasses.replace(scene, clearance=wide), 1.0)
    assert worn.q == pytest.approx(same.q, abs=1e-9)


#: Wear with sliding and with running-in. The tests of both effects use one kernel.
RUBBED = Wear(1e-11, 0.015, 2.0, sliding="total", running_in_ratio=4.0, running_in_depth_m=2e-5)


def worn_by(exposure: float) -> float:
    """Return h = h0 ln(r exp(E / h0) - r + 1), the solution of dh/dE = 1 + (r - 1) exp(-h / h0)."""
    h0, ratio = RUBBED.running_in_depth_m, RUBBED.running_in_ratio
    assert h0 is not None
    return h0 * math.log(ratio * math.exp(exposure / h0) - ratio + 1.0)


# implicit steps need additional compiled kernels
@pytest.mark.parametrize(
    "contact",
    [
        pytest.param(Contact("hunt_crossley", 1e7, damping=1.0), id="explicit"),
        pytest.param(Contact("kelvin_voigt", 1e7, damping=1e8), id="implicit", marks=pytest.mark.stress),
    ],
)
@pytest.mark.parametrize(("along", "t"), [(0.0, 20.0), (0.4, 1.0)])
def test_sliding_in_the_plane_and_running_in_give_the_known_wear(contact: Contact, along: float, t: float) -> None:
    """A head that slides steadily along the bottom wears its pads by both motions, more slowly after running-in."""
    weight, stiffness = 2000.0 * 9.81, 1e7
    scene = dataclasses.replace(
        pressed(RUBBED, clearance=0.02, gravity=9.81, stiffness=stiffness),
        clearance=Clearance(1.0, 0.02),
        contact=contact,
        initial=Initial((0.0, -0.01 - 0.5 * weight / stiffness, 0.0), (along, 0.0, 0.0)),
    )
    twin = Twin(scene, tol=1e-10, excitation="sampled")
    worn = twin.advance(t, np.zeros(3)).wear_depth
    exposure = RUBBED.coefficient_m2_n / RUBBED.pad_area_m2 * 0.5 * weight * math.hypot(2.0, along) * t
    assert worn[[0, 2]] == pytest.approx([worn_by(exposure)] * 2, rel=1e-5)
    assert (twin._state.implicit_steps > 0) == (contact.law == "kelvin_voigt")
    # running-in has added h0 ln r to the depth at its end
    assert worn[0] > exposure + 1.5e-5


def test_sliding_in_the_plane_wears_the_pad_by_the_sliding_distance_of_its_corner() -> None:
    """The depth of each pad is the integral of its force times its speed over the rows, with fixed steps too."""
    wear = dataclasses.replace(RUBBED, travel_speed_m_s=0.05)
    scene = dataclasses.replace(preset("paper"), wear=wear)
    t = np.arange(1, 40_001) * 1e-4
    wrench = compile_loads(scene.loads).at(t)
    result = Twin(scene, excitation="sampled").advance_samples(t, wrench)
    fixed = simulate(scene, 4.0, method="rk4", dt=2e-5)
    (half_w, half_h), corners = 0.5 * np.array([scene.frame.width_m, scene.frame.height_m]), []
    c, s = np.cos(result.q[:, 2]), np.sin(result.q[:, 2])
    for pair, name in enumerate(PAIR_NAMES):
        x = half_w if "right" in name.rsplit("_", 1)[0] else -half_w
        y = half_h if "top" in name.rsplit("_", 1)[0] else -half_h
        # speed along the wall of the point of the head that is at the corner
        vx = result.v[:, 0] - result.v[:, 2] * (y - result.q[:, 1])
        vy = result.v[:, 1] + result.v[:, 2] * (x - result.q[:, 0])
        along = c * vx + s * vy if name.endswith(("top", "bottom")) else c * vy - s * vx
        corners.append(np.trapezoid(result.force[:, pair] * np.hypot(0.05, along), t))
    expected = [worn_by(wear.coefficient_m2_n / wear.pad_area_m2 * float(way)) for way in corners]
    impulse, worn = result.impulse.sum(axis=0), result.wear_depth[-1]
    # the pads wear far more than by the travel alone
    assert worn.max() > 1.5 * worn_by(wear.coefficient_m2_n / wear.pad_area_m2 * 0.05 * impulse.max())
    assert worn == pytest.approx(expected, rel=1e-3, abs=1e-12)
    assert fixed.wear_depth == pytest.approx(worn, rel=0.02, abs=1e-11)


def test_a_twin_continues_its_wear_from_a_snapshot() -> None:
    scene = dataclasses.replace(preset("paper"), wear=dataclasses.replace(RUBBED, coefficient_m2_n=1e-13))
    t = np.arange(1, 31) * 0.1
    wrench = compile_loads(scene.loads).at(t)
    whole, parts, other = (Twin(scene, excitation="sampled") for _ in range(3))
    expected = whole.advance_samples(t[:20], wrench[:20]).wear_depth[-1]
    parts.advance_samples(t[:7], wrench[:7])
    other.restore(parts.snapshot())
    assert np.array_equal(other.advance_samples(t[7:20], wrench[7:20]).wear_depth[-1], expected)
    # worn pads have run in, so the same motion wears them more slowly than new pads
    other.reset(0.0, wear_depth=np.full(8, 1e-3))
    assert (other.advance_samples(t[:20], wrench[:20]).wear_depth[-1] - 1e-3).max() < 0.4 * expected.max()
    other.set_travel_speed(0.0)
    depths = other.advance_samples(t[19:], wrench[19:]).wear_depth
    assert np.array_equal(depths[0], depths[-1])


def test_a_ratio_without_a_depth_is_named() -> None:
    with pytest.raises(SceneError, match="running_in_depth_m"):
        pressed(Wear(1e-14, 0.015, 2.0, running_in_ratio=3.0), clearance=0.02, gravity=9.81)


def test_without_wear_its_code_is_not_compiled() -> None:
    scenes = preset("paper"), dataclasses.replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0))
    without, with_wear = (Twin(scene, excitation="sampled") for scene in scenes)
    assert without._parts.terms.wear is None and with_wear._parts.terms.wear is not None
    assert with_wear._parts.terms.sliding is None and with_wear._parts.terms.running_in is None
    assert not without.advance(2.0).wear_depth.any()
    assert with_wear.advance(2.0).wear_depth.any()
    assert not with_wear._work.rub.any()
