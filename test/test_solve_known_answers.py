"""Known solutions, each with its source: Hertz, depth and time of an impact, statics, momentum.

The files test_known_* contain further solutions. docs/known_answers.md lists all of them.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import preset, wall_and_point, with_presets_terms
from scipy.integrate import trapezoid

from plow_twin import Clearance, Constant, Contact, Frame, Gravity, Head, Scene, SolverError, simulate
from plow_twin.model.contact_laws import exact_damping_number


def test_a_hertz_impact_of_a_sphere_agrees_with_the_published_values() -> None:
    """Chung and Ooi, Granular Matter 13 (2011) 643, test 2: 49.7172 um, 11.36986 kN and 731.66 us."""
    radius, modulus, poisson, density = 0.1, 7e10, 0.30, 2699.0
    stiffness = 4.0 / 3.0 * modulus / (1.0 - poisson**2) * math.sqrt(radius)
    mass = 4.0 / 3.0 * math.pi * radius**3 * density
    scene = with_presets_terms(wall_and_point(Contact("hertz", stiffness, 1.5), speed=0.2, mass=mass))
    result = simulate(scene, 0.1, tol=1e-11)
    force = result.statistics["top_left_top"]["max"]
    assert force == pytest.approx(11369.86, abs=0.006)
    assert (force / stiffness) ** (2.0 / 3.0) == pytest.approx(49.7172e-6, abs=6e-11)
    assert np.diff(result.events["time"])[0] == pytest.approx(731.66e-6, abs=6e-9)


@pytest.mark.parametrize(("n", "duration"), [(1.0, math.pi), (1.5, 2.94327518)])
def test_depth_and_time_of_an_impact_agree_with_the_closed_form(n: float, duration: float) -> None:
    """d_max^(n+1) = (n+1) m v0^2 / K (D - ln(1+D)) / D^2. Without damping, T = c_n d_max / v0."""
    stiffness, mass, speed = 1e8, 2.0, 0.7
    # for n = 1 a damping without effect gives the scene the law of a preset
    elastic = Contact("hertz", stiffness, n) if n > 1.0 else Contact("kelvin_voigt", stiffness, damping=1e-6)
    undamped = simulate(with_presets_terms(wall_and_point(elastic, speed=speed, mass=mass)), 0.1, tol=1e-11)
    depth = ((n + 1.0) * mass * speed**2 / (2.0 * stiffness)) ** (1.0 / (n + 1.0))
    assert np.diff(undamped.events["time"])[0] == pytest.approx(duration * depth / speed, rel=1e-8)
    d = exact_damping_number(0.4)
    expected = ((n + 1.0) * mass * speed**2 / stiffness * (d - math.log1p(d)) / d**2) ** (1.0 / (n + 1.0))
    scene = wall_and_point(Contact("exact_restitution", stiffness, n, restitution=0.4), speed=speed, mass=mass)
    damped = simulate(with_presets_terms(scene), 0.009, output_dt=1e-7, tol=1e-11)
    assert damped.penetration[:, 0].max() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("n", "law"),
    [
        # test_solve_extremes tests these laws with a head that comes to rest
        *(pytest.param(n, "exact_restitution", marks=pytest.mark.stress) for n in (1.0, 1.5)),
        (1.0, "kelvin_voigt"),
    ],
)
def test_a_constant_load_settles_on_statics(n: float, law: str) -> None:
    stiffness, mass, g, fx, moment = 1e8, 2430.0, 9.81, 3e3, 800.0
    damping = {"damping": 2e5} if law == "kelvin_voigt" else {"restitution": 0.2, "impact_speed_floor_m_s": 0.05}
    scene = Scene(
        Head(mass, 1265.0), Frame(0.33, 0.27), Clearance(0.01, 0.012), Contact(law, stiffness, n, **damping),
        Gravity(g), (Constant("push", (fx, 0.0), moment),),
    )  # fmt: skip
    end = simulate(scene, 30.0, output_dt=30.0, tol=1e-10)
    force, depth = end.force[-1], end.penetration[-1]
    # the roof of the head rests on the two upper corners, and its left wall touches one or both left corners
    c, s = math.cos(end.q[-1, 2]), math.sin(end.q[-1, 2])
    normal = np.array([[0, 1], [-1, 0], [0, 1], [1, 0], [0, -1], [1, 0], [0, -1], [-1, 0]]) @ np.array(
        [[c, s], [-s, c]]
    )
    corner = 0.5 * np.array([[-0.33, 0.27]] * 2 + [[0.33, 0.27]] * 2 + [[0.33, -0.27]] * 2 + [[-0.33, -0.27]] * 2)
    arm = corner - end.q[-1, :2]
    assert force @ normal == pytest.approx([-fx, mass * g], abs=1e-2)
    assert force @ (arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]) == pytest.approx(-moment, abs=1e-2)
    touching = force > 0.0
    assert depth[touching] == pytest.approx((force[touching] / stiffness) ** (1.0 / n), rel=1e-6)


@pytest.mark.parametrize("name", ["paper", "bench_kv", "bench_hc"])
def test_impulses_add_up_to_the_change_of_momentum(name: str) -> None:
    """The vertical impulse is the time integral of contact forces in world axes, excitation and weight."""
    scene = preset(name)
    result = simulate(scene, 3.0, output_dt=1e-5, tol=1e-10)
    theta = result.q[:, 2]
    normal_y = np.array([1.0, 0, 1, 0, -1, 0, -1, 0])
    normal_x = np.array([0.0, -1, 0, 1, 0, 1, 0, -1])
    contact_y = (result.force * (np.outer(np.sin(theta), normal_x) + np.outer(np.cos(theta), normal_y))).sum(axis=1)
    amplitude = sum(load.force_n[1] for load in scene.loads)  # type: ignore[union-attr]
    excitation = amplitude * (1.0 - math.cos(2.0 * 3.0)) / 2.0
    change = scene.head.mass_kg * (result.v[-1, 1] - result.v[0, 1])
    total = trapezoid(contact_y, result.t) + excitation - scene.head.mass_kg * 9.81 * 3.0
    assert total == pytest.approx(change, abs=2.0)


def test_leaving_the_model_s_range_is_a_named_error() -> None:
    scene = Scene(
        Head(10.0, 1.0),
        Frame(0.3, 0.3),
        Clearance(0.02, 0.02),
        Contact("kelvin_voigt", 1e3, damping=1.0),
        Gravity(0.0),
        (Constant("f", (5e4, 0.0)),),
    )
    with pytest.raises(
        SolverError, match=r"at t = 0\.0\d+ s: the head left the model's range: \w+ penetrated \d+\.\d mm deep"
    ):
        simulate(scene, 1.0)
