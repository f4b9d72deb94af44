"""A restitution that decreases with the speed of impact: single impacts, no gain of energy, and no unused code."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from plow_twin import (
    Clearance,
    Constant,
    Contact,
    Frame,
    Friction,
    Gravity,
    Head,
    Initial,
    Scene,
    SceneError,
    Twin,
    TwinBatch,
    dump_scene,
    simulate,
)
from plow_twin.errors import ArgumentError
from plow_twin.model.contact_laws import LAWS
from plow_twin.scene_file.reader import loads_scene
from plow_twin.solve.compiled_scene import compile_scene
from plow_twin.solve.state import PARAMS

SIDE, MASS = 0.06, 2.0
INERTIA = MASS * SIDE**2 / 6.0
E, FALL, SPEED = 0.7, 0.25, 0.1
LAW = Contact(
    "exact_restitution", 1e8, restitution=E, restitution_fall=FALL, restitution_speed_m_s=SPEED,
    impact_speed_floor_m_s=0.01,
)  # fmt: skip
#: A block with a huge inertia, which no impact rotates. With negligible friction, a negligible radius and the energy
#: balance, the scenes of this file use the kernels of `test_solve_rounded`.
HEAVY = Head(MASS, 1e12, carries="corners")
SMOOTH = Friction(1e-12, stick_stiffness_n_m=1e6)
SHARP = Frame(SIDE, SIDE, corner_radius_m=1e-9)


def impact(contact: Contact, v: tuple[float, float, float], angle: float = 0.0, **changes: object) -> Scene:
    """Return a weightless block whose lower left corner is one micrometre above the table."""
    lowest = 0.5 * SIDE * (math.sin(angle) + math.cos(angle))
    scene = Scene(
        Head(MASS, INERTIA, carries="corners"),
        SHARP,
        Clearance(2.0, 2.0),
        contact,
        Gravity(0.0),
        initial=Initial(q=(0.0, -1.0 - 0.5 * SIDE + lowest + 1e-6, angle), v=v),
        friction=SMOOTH,
    )
    return replace(scene, **changes)  # type: ignore[arg-type]


def returned(scene: Scene) -> float:
    """Return the ratio of the lower left corner's normal speeds after and before its impact."""
    (_, _, angle), (_, fall, omega) = scene.initial.q, scene.initial.v
    arm = -0.5 * SIDE * (math.cos(angle) - math.sin(angle))
    result = simulate(scene, t_end=2e-6 / -fall + 0.01, output_dt=1e-3, energy_balance=True)
    assert sum(pair["makes"] for pair in result.statistics.values()) == 1
    return float(result.v[-1, 1] + result.v[-1, 2] * arm) / -(fall + omega * arm)


@pytest.mark.parametrize("speed", [0.02, 0.1, 0.11, 0.7, 3.0, 40.0])
# the other exponent, and corners without any radius, need additional compiled kernels
@pytest.mark.parametrize(
    ("exponent", "frame"),
    [
        (1.0, SHARP),
        pytest.param(1.5, SHARP, marks=pytest.mark.stress),
        pytest.param(1.0, Frame(SIDE, SIDE), marks=pytest.mark.stress),
    ],
)
def test_a_drop_has_the_restitution_for_its_speed(speed: float, exponent: float, frame: Frame) -> None:
    contact = replace(LAW, exponent=exponent, stiffness=1e8 * 1e3 ** (exponent - 1.0))
    restitution = returned(impact(contact, (0.0, -speed, 0.0), head=HEAVY, frame=frame, pairs=("bottom_left_bottom",)))
    assert restitution == pytest.approx(E * max(speed / SPEED, 1.0) ** -FALL, abs=2e-5)


@pytest.mark.parametrize("law", [name for name, law in LAWS.items() if law.takes_restitution])
def test_every_law_uses_the_reduced_restitution(law: str) -> None:
    falling = impact(replace(LAW, law=law), (0.0, -2.0, 0.0), head=HEAVY, pairs=("bottom_left_bottom",))
    reduced = E * (2.0 / SPEED) ** -FALL
    # this restitution is practically constant, and has the same compiled kernels
    constant = replace(falling, contact=replace(LAW, law=law, restitution=reduced, restitution_fall=1e-12))
    assert returned(falling) == pytest.approx(returned(constant), abs=2e-5)


@pytest.mark.parametrize(("angle", "omega"), [(0.3, 0.0), (0.0, 0.0), (0.2, -20.0)])
@pytest.mark.parametrize("power", [0.5, 1.3])
def test_impact_counts_by_the_mass_at_the_corner(angle: float, omega: float, power: float) -> None:
    speed, arm = 2.0, 0.5 * SIDE * (math.cos(angle) - math.sin(angle))
    # the contact is so hard that the block hardly rotates during the impact
    contact = replace(LAW, stiffness=1e12, restitution_mass_power=power)
    restitution = returned(impact(contact, (0.0, -speed, omega), angle, pairs=("bottom_left_bottom",)))
    approach = speed + omega * arm
    mass = 1.0 / (1.0 + MASS * arm**2 / INERTIA)
    assert restitution == pytest.approx(E * (approach * mass**power / SPEED) ** -FALL, abs=2e-3)


@pytest.mark.parametrize("along", [1.5, -1.5])
def test_restitution_falls_with_the_speed_along_the_wall(along: float) -> None:
    contact = Contact("exact_restitution", 1e8, restitution=E, restitution_fall_along_s_m=0.2)
    scene = impact(contact, (along, -1.0, 0.0), head=HEAVY, pairs=("bottom_left_bottom",))
    assert returned(scene) == pytest.approx(E - 0.2 * 1.5, abs=2e-5)
    # the formula of the law would give a negative restitution, which is limited to zero
    fast = replace(scene, initial=replace(scene.initial, v=(10.0 * along, -1.0, 0.0)))
    assert 0.0 <= returned(fast) < 2e-3


@pytest.mark.parametrize("exponent", [1.0, pytest.param(1.5, marks=pytest.mark.stress)])
def test_head_with_walls_reads_the_same_restitution(exponent: float) -> None:
    contact = replace(LAW, exponent=exponent, stiffness=1e8 * 1e3 ** (exponent - 1.0), restitution_fall_along_s_m=0.1)
    # offset and grip are negligible; with both, the kernels of the preset `measured_ellipse` are used
    scene = Scene(
        Head(MASS, 1e12, "consistent", (1e-12, 0.0)), Frame(SIDE, SIDE), Clearance(3e-3, 2e-3), contact,
        Gravity(0.0), initial=Initial(v=(0.5, 0.8, 0.0)), pairs=("top_left_left", "bottom_left_bottom"),
        friction=Friction(1e-12, stick_stiffness_n_m=1e6),
    )  # fmt: skip
    result = simulate(scene, t_end=4e-3, output_dt=5e-4)
    by_wall = [float(rate) for rate in result.v[-1, :2]]
    before = (0.5, 0.8)
    # the head touches the lower wall first; the speed along the left wall is therefore the speed after this impact
    for axis, along in ((1, before[0]), (0, by_wall[1])):
        expected = E * (before[axis] / SPEED) ** -FALL - 0.1 * abs(along)
        assert -by_wall[axis] / before[axis] == pytest.approx(expected, abs=2e-5)


speeds = st.floats(0.01, 5.0)


@settings(max_examples=25, deadline=None)
@given(
    speeds, st.floats(-3.0, 3.0), st.floats(-30.0, 30.0), st.floats(0.0, 0.7), st.floats(0.0, 1.0),
    st.floats(0.0, 1.0), st.floats(0.01, 2.0), st.floats(0.0, 3.0), st.floats(0.0, 0.5),
)  # fmt: skip
def test_no_impact_gains_energy(fall, along, omega, angle, e, power, least, mass, sideways) -> None:
    contact = Contact(
        "exact_restitution", 1e8, restitution=e, restitution_fall=power, restitution_speed_m_s=least,
        restitution_mass_power=mass, restitution_fall_along_s_m=sideways,
        impact_speed_floor_m_s=0.2,  # with a lower floor, implicit steps would be compiled
    )  # fmt: skip
    scene = impact(contact, (along, -fall, omega), angle, friction=replace(SMOOTH, coefficient=0.3))
    result = simulate(scene, t_end=0.02, output_dt=1e-3, energy_balance=True)
    energy = 0.5 * MASS * (result.v[:, :2] ** 2).sum(axis=1) + 0.5 * INERTIA * result.v[:, 2] ** 2
    assert energy[-1] <= energy[0] * (1.0 + 1e-9)
    assert result.energy_balance is not None
    assert abs(result.energy_balance.imbalance_j) < 1e-8 * (energy[0] + 1.0)


def test_impact_that_contains_the_start_continues_unchanged() -> None:
    whole = impact(LAW, (0.0, -3.0, 0.0), head=HEAVY, pairs=("bottom_left_bottom",))
    run = simulate(whole, t_end=3e-4, output_dt=1e-6, energy_balance=True)
    inside = int(np.argmax(run.penetration[:, 6] > 1e-5))
    begun = replace(whole, initial=Initial(tuple(run.q[inside]), tuple(run.v[inside])))  # type: ignore[arg-type]
    result = simulate(begun, t_end=0.01, output_dt=1e-3, energy_balance=True)
    assert result.v[-1, 1] == pytest.approx(3.0 * E * 30.0**-FALL, abs=2e-4)


def test_block_with_a_falling_restitution_agrees_with_an_independent_integration() -> None:
    scene = impact(replace(LAW, stiffness=3e6), (0.3, -1.5, 8.0), 0.25, gravity=Gravity())
    reduced = E * ((1.5 + 8.0 * 0.5 * SIDE * (math.cos(0.25) - math.sin(0.25))) / SPEED) ** -FALL
    arm = 0.5 * SIDE * (math.cos(0.25) - math.sin(0.25))
    approach = 1.5 + 8.0 * arm
    damping = LAWS["exact_restitution"].damping_number(reduced) / approach

    def rate(t: float, z: np.ndarray) -> list[float]:
        _, y, theta, vx, vy, omega = z  # the friction is negligible
        c, s, half = math.cos(theta), math.sin(theta), 0.5 * SIDE
        ax, ay = -half * c + half * s, -half * s - half * c
        depth, speed = -1.0 - 0.5 * SIDE - (y + ay), -(vy + omega * ax)
        normal = max(3e6 * depth * (1.0 + damping * speed), 0.0) if depth > 0.0 else 0.0
        return [vx, vy, omega, 0.0, normal / MASS - 9.81, ax * normal / INERTIA]

    only = replace(scene, pairs=("bottom_left_bottom",))
    result = simulate(only, t_end=0.006, output_dt=1e-3, tol=1e-9, energy_balance=True)
    z0 = [*scene.initial.q, *scene.initial.v]
    reference = solve_ivp(rate, (0.0, 0.006), z0, "DOP853", rtol=1e-10, atol=1e-12, max_step=1e-6)
    # the touch follows a flight of a microsecond, in which weight and rotation change the speed slightly
    assert (np.abs(result.v[-1] - reference.y[3:, -1]) < [1e-3, 1e-3, 0.05]).all()


def test_live_twin_and_batch_have_the_motion_of_the_run() -> None:
    scene = impact(LAW, (0.2, -1.0, 3.0), 0.1, friction=replace(SMOOTH, coefficient=0.2), gravity=Gravity())
    run = simulate(scene, t_end=0.05, output_dt=0.01, energy_balance=True)
    # the twin samples a zero load, for which the kernel of the batch is used
    twin = Twin(scene, excitation="sampled")
    np.testing.assert_allclose([twin.advance(float(t)).q for t in run.t[1:]], run.q[1:], atol=1e-9)
    rows = TwinBatch([scene, scene]).advance(0.05)
    np.testing.assert_allclose(rows.q[:, 0], [run.q[-1]] * 2, atol=1e-9)
    constant = replace(scene, contact=replace(LAW, restitution_fall=None, restitution_speed_m_s=None))
    with pytest.raises(ArgumentError, match=r"scenes\[1\].*falls"):
        TwinBatch([scene, constant])


def test_a_constant_restitution_compiles_no_further_code() -> None:
    plain = Scene(
        Head(1.0, 1.0), Frame(1.0, 1.0), Clearance(0.1, 0.1), Contact("exact_restitution", 1e6, restitution=E)
    )
    assert compile_scene(plain, 1e-9).params.dtype == PARAMS
    assert "fall" not in dump_scene(plain) and "corner_radius" not in dump_scene(plain)
    falling = replace(plain, contact=LAW)
    assert "damping_numbers" in (compile_scene(falling, 1e-9).params.dtype.names or ())
    assert loads_scene(dump_scene(falling)) == falling


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: replace(LAW, restitution_speed_m_s=None), "both or neither"),
        (lambda: replace(LAW, restitution_fall=None), "both or neither"),
        (lambda: Contact("exact_restitution", 1e6, restitution=E, restitution_mass_power=1.0), "restitution_fall"),
        (lambda: Contact("kelvin_voigt", 1e6, damping=1.0, restitution_fall_along_s_m=0.1), "without contact.restit"),
        (lambda: replace(LAW, restitution_fall=-0.1), ">= 0"),
        (lambda: replace(LAW, restitution_speed_m_s=math.inf), "restitution_speed_m_s"),
    ],
)
def test_invalid_falling_restitutions_are_named(make: Callable[[], Contact], expected: str) -> None:
    with pytest.raises(SceneError, match=expected):
        impact(make(), (0.0, -1.0, 0.0))


def test_resting_block_comes_to_rest() -> None:
    """Slow touches have the restitution of the law's lowest speed, so bounces decay as with a constant restitution."""
    scene = impact(LAW, (0.0, -0.3, 0.0), gravity=Gravity(), loads=(Constant("press", (0.0, -5.0)),))
    result = simulate(scene, t_end=0.5, output_dt=0.01, energy_balance=True)
    assert abs(result.v[-1]).max() < 1e-4
