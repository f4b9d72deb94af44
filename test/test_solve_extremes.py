"""Numerical stress: stiffness, restitution, clearance and mass over their ranges, and hours of motion."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scenes import preset, wall_and_point, with_presets_terms

from plow_twin import (
    Clearance,
    Constant,
    Contact,
    Frame,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Scene,
    SceneError,
    Status,
    Table,
    Twin,
    Wear,
    simulate,
)

#: A load that moves nothing. Scenes with this load use the kernels of the presets.
PRESETS_TERMS = (Harmonic("nothing to speak of", (1e-9, 0.0), 2.0),)


def bouncing(contact: Contact, mass: float, gap: float = 0.01) -> Scene:
    pairs = ("top_left_top", "top_right_top")
    return with_presets_terms(wall_and_point(contact, speed=0.1, mass=mass, gravity=9.81, gap=gap, pairs=pairs))


@pytest.mark.parametrize("n", [1.0, 1.5])
@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e7, 1e9, 1e11, 1e13])
def test_a_head_comes_to_rest_at_any_stiffness_over_ten_decades(stiffness: float, n: float) -> None:
    """The head comes to rest. Its depth is 0.5 mm in the softest wall, and at least 1 nm in the other walls."""
    mass = max(0.1, 2e-10 * stiffness)
    contact = Contact("exact_restitution", stiffness, n, restitution=0.3, impact_speed_floor_m_s=1e-2)
    scene = bouncing(contact, mass, gap=0.1)
    if n == 1.5 and stiffness < 1e5:
        scene = dataclasses.replace(scene, head=dataclasses.replace(scene.head, mass_kg=1e-3))
    weight = scene.head.mass_kg * 9.81
    depth = (weight / 2 / stiffness) ** (1.0 / n)
    result = simulate(scene, 1.0, output_dt=0.01, tol=1e-10)
    assert result.force[-1, [0, 2]] == pytest.approx([weight / 2] * 2, rel=2e-2)
    assert result.penetration[-1, 0] == pytest.approx(depth, rel=2e-2)
    assert result.solver["steps"] < 200_000


@pytest.mark.parametrize("mass", [10.0**k for k in range(-1, 6)])
@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_the_rebound_has_the_requested_speed_for_any_mass_and_restitution(mass: float, e: float) -> None:
    """The rebound speed is e times the impact speed for all masses. At e = 0, the limit of the damping gives 1/1000."""
    contact = Contact("exact_restitution", 1e8, 1.5, restitution=e)
    result = simulate(with_presets_terms(wall_and_point(contact, speed=0.5, mass=mass)), 1.0, tol=1e-10)
    assert result.v[-1, 1] / 0.5 == pytest.approx(max(e, 1e-3), rel=1e-3)


@pytest.mark.parametrize("n", [1.0, 1.5])
@pytest.mark.parametrize("gap", [1.0, 1e-9])
def test_a_pose_stays_within_clearances_from_a_nanometre_to_a_metre(gap: float, n: float) -> None:
    contact = Contact("exact_restitution", 1e8, n, restitution=0.3 if n == 1.0 else 0.7, impact_speed_floor_m_s=1e-2)
    scene = dataclasses.replace(preset("paper"), clearance=Clearance(gap, gap), contact=contact)
    scene = dataclasses.replace(scene, frame=dataclasses.replace(scene.frame, width_m=3.3, height_m=2.7))
    result = simulate(scene, 5.0, tol=1e-8)
    assert np.isfinite(result.q).all() and result.force.max() > 1e3
    # the pose stays within the clearance plus the deflection of the walls
    give = result.penetration.max()
    assert abs(result.q[:, :2]).max() <= 0.5 * gap + 2.0 * give and give < 0.05


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_loads_with_non_finite_numbers_are_refused(bad: float) -> None:
    twin = Twin(preset("paper"), excitation="sampled")
    before = twin.digest()
    for wrench in ((bad, 0.0, 0.0), (0.0, 0.0, bad)):
        with pytest.raises(ValueError, match="wrench: got"):
            twin.advance(0.1, wrench)
    assert twin.digest() == before and twin.advance(0.1, (0.0, 0.0, 0.0)).status is Status.OK
    with pytest.raises(SceneError, match=r"loads\[0\] row 1: got"):
        table = Table("t", np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [0.0, bad, 0]]))
        dataclasses.replace(preset("paper"), loads=(table,))


def hourly(hours: int) -> np.ndarray:
    """Return the impulse [N s] of each pair in each hour of the paper's scene, shape (hours, 8)."""
    twin = Twin(preset("paper"))
    rows = [twin.advance(3600.0 * (hour + 1)) for hour in range(hours)]
    assert all(row.status is Status.OK for row in rows)
    return np.array([row.impulse for row in rows])


@pytest.mark.stress
def test_ten_hours_of_driven_motion_do_not_drift() -> None:
    impulse = hourly(10)
    # except in the first seconds, the motion and its impulses are periodic
    assert abs(impulse[1:] / impulse[1] - 1.0).max() < 1e-3


@pytest.mark.parametrize(
    ("contact", "clearance"),
    [
        pytest.param(Contact("kelvin_voigt", 4e7, damping=2.5e4), -1e-5, marks=pytest.mark.stress),
        (Contact("exact_restitution", 4e7, 1.0, restitution=0.2), -1e-5),
        pytest.param(Contact("exact_restitution", 4e9, 1.5, restitution=0.2), -1e-5, marks=pytest.mark.stress),
    ],
    ids=["viscous", "n = 1", "n = 1.5"],
)
def test_a_start_inside_the_wall_is_never_pulled(contact: Contact, clearance: float) -> None:
    scene = Scene(
        Head(45.0, 0.3), Frame(0.15, 1.0), Clearance(clearance, clearance), contact, Gravity(0.0), PRESETS_TERMS,
        Initial((0.0, 0.0, 0.0), (-0.09, -0.13, 0.0)),
    )  # fmt: skip
    events = simulate(scene, 4e-4, output_dt=1e-4, tol=1e-11)
    fixed = simulate(scene, 4e-4, output_dt=1e-4, method="rk4", dt=1e-7)
    assert events.v == pytest.approx(fixed.v, abs=1e-6)


@pytest.mark.parametrize("speed", [0.0, 1e-160])
def test_a_start_exactly_on_the_wall_is_solved(speed: float) -> None:
    contact = Contact("exact_restitution", 1e9, 1.5, restitution=0.5)
    scene = Scene(
        Head(10.0, 0.1), Frame(1.0, 0.4), Clearance(0.0, 0.0), contact,
        loads=(Constant("f", (3.0, 1.0)), Harmonic("swing", (3.0, 0.0), 2.0)),
        initial=Initial(v=(0.0, -speed, 0.0)),
    )  # fmt: skip
    result = simulate(scene, 0.1)
    assert np.isfinite(result.q).all() and result.force[-1].max() > 0.0


def test_rows_within_a_step_show_the_wear_of_their_time() -> None:
    """A clamped head relaxes as its pads wear: F = K d0 exp(-K k_s v t / A)."""
    stiffness, depth, k_s, area, speed = 1e7, 1e-4, 2e-9, 0.015, 2.0
    scene = Scene(
        Head(2000.0, 1000.0), Frame(0.3, 0.3), Clearance(0.02, -2.0 * depth),
        Contact("kelvin_voigt", stiffness, damping=1.0), Gravity(0.0), PRESETS_TERMS,
        wear=Wear(k_s, area, speed),
    )  # fmt: skip
    result = simulate(scene, 0.2, output_dt=0.01, tol=1e-10)
    expected = stiffness * depth * np.exp(-stiffness * k_s * speed / area * result.t)
    assert result.force[:, 0] == pytest.approx(expected, rel=1e-5)
