"""A frame on springs: two coupled masses in closed form, independent references, and no unused code."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import pose_error, preset
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from plow_twin import (
    ArgumentError,
    Clearance,
    Contact,
    Frame,
    Friction,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Scene,
    SceneError,
    Support,
    Twin,
    TwinBatch,
    Wear,
    simulate,
)
from plow_twin.model.pairs import CORNER_X, CORNER_Y, NORMAL_X, NORMAL_Y
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.solve import compiled_scene
from plow_twin.solve.state import STATE

SUPPORT = Support(800.0, 60.0, 3e7, 5e7, 4e6, 2e4, 3e4, 5e3)
#: Head and contact law that several tests share, so that they share compiled code.
HEAD, LAW = Head(2430.0, 1265.0), Contact("kelvin_voigt", 2e7, damping=6e4)


def pressed(load: Harmonic) -> Scene:
    """Return a head that lies on both upper corners of its frame, with a penetration of 0.6 mm."""
    return Scene(
        HEAD, Frame(0.33, 0.27), Clearance(0.025, 0.030), LAW, loads=(load,), support=SUPPORT,
        initial=Initial((0.0, -0.0156, 0.0)),
    )  # fmt: skip


def test_two_masses_pressed_together_move_in_their_eigenmodes() -> None:
    """Under the weight and a harmonic load, the contact remains closed, so the system is linear."""
    omega, amplitude = 40.0, 4e3
    scene = pressed(Harmonic("up and down", (0.0, amplitude), omega_rad_s=omega))
    result = simulate(scene, 1.0, output_dt=0.01, tol=1e-10)
    # The state contains y of the head and v of the frame, both measured from the start of contact, and their rates. The
    # weight, and sine and cosine of the load, follow.
    k, c, mass = 2.0 * LAW.stiffness, 2.0 * (LAW.damping or 0.0), HEAD.mass_kg
    matrix = np.zeros((7, 7))
    matrix[0, 2] = matrix[1, 3] = 1.0
    contact = np.array([k, -k, c, -c, 0.0, 0.0, 0.0])
    matrix[2] = -contact / mass + np.array([0.0, 0.0, 0.0, 0.0, -9.81, amplitude / mass, 0.0])
    matrix[3] = contact / SUPPORT.mass_kg
    matrix[3, 1] -= SUPPORT.vertical_stiffness_n_m / SUPPORT.mass_kg
    matrix[3, 3] -= SUPPORT.vertical_damping_n_s_m / SUPPORT.mass_kg
    matrix[5, 6], matrix[6, 5] = omega, -omega
    start = np.array([-0.6e-3, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    expected = np.array([expm(matrix * t) @ start for t in result.t])
    assert (result.force[:, 0] > 0.0).all() and len(result.events) == 0
    assert result.frame is not None
    assert np.abs(result.frame[:, 1] - expected[:, 1]).max() < 1e-10 * np.abs(expected[:, 1]).max()
    distance = result.q[:, 1] + 0.015
    assert np.abs(distance - (expected[:, 0] - expected[:, 1])).max() < 1e-10 * np.abs(expected[:, 0]).max()


def reference(scene: Scene, times: np.ndarray) -> np.ndarray:
    """Return head and frame, shape (n, 6), by SciPy with independent equations from points in world axes."""
    (load,) = scene.loads
    support, contact = scene.support, scene.contact
    assert isinstance(load, Harmonic) and support is not None and contact.damping is not None
    corners = 0.5 * np.array([scene.frame.width_m, scene.frame.height_m]) * np.stack([CORNER_X, CORNER_Y], axis=1)
    normals = np.stack([NORMAL_X, NORMAL_Y], axis=1)
    cavity = 0.5 * np.array([scene.frame.width_m + scene.clearance.horizontal_m,
                             scene.frame.height_m + scene.clearance.vertical_m])  # fmt: skip
    springs = np.array(
        [support.horizontal_stiffness_n_m, support.vertical_stiffness_n_m, support.rotational_stiffness_n_m_rad]
    )
    dampers = np.array(
        [support.horizontal_damping_n_s_m, support.vertical_damping_n_s_m, support.rotational_damping_n_m_s_rad]
    )
    masses = np.array([scene.head.mass_kg] * 2 + [scene.head.inertia_kg_m2])
    frame_masses = np.array([support.mass_kg] * 2 + [support.inertia_kg_m2])

    def turn(angle: float) -> np.ndarray:
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    def velocity(rate: np.ndarray, arm: np.ndarray) -> np.ndarray:
        return np.asarray(rate[:2] + rate[2] * np.stack([-arm[:, 1], arm[:, 0]], axis=1))

    def change(t: float, z: np.ndarray) -> np.ndarray:
        head, frame, rate, frame_rate = z[:3], z[3:6], z[6:9], z[9:]
        places = frame[:2] + corners @ turn(frame[2]).T
        arms, frame_arms, outward = places - head[:2], places - frame[:2], normals @ turn(head[2]).T
        depth = (arms * outward).sum(axis=1) - np.abs(normals) @ cavity
        sliding = velocity(frame_rate, frame_arms) - velocity(rate, arms)
        inward = (sliding * outward).sum(axis=1)
        push = np.where(depth > 0.0, np.maximum(contact.stiffness * depth + contact.damping * inward, 0.0), 0.0)
        force = push[:, None] * outward
        total = np.append(force.sum(axis=0), cross(arms, force).sum())
        swing = math.sin(load.omega_rad_s * t + load.phase_rad)
        fx, fy = load.force_n
        applied = swing * np.array([fx, fy, load.at_m[0] * fy - load.at_m[1] * fx + load.moment_n_m])
        applied[1] -= scene.head.mass_kg * scene.gravity.acceleration_m_s2
        transferred = np.append(force.sum(axis=0), cross(frame_arms, force).sum())
        held = -springs * frame - dampers * frame_rate - transferred
        return np.concatenate([rate, frame_rate, (applied + total) / masses, held / frame_masses])

    start = np.concatenate([scene.initial.q, np.zeros(3), scene.initial.v, np.zeros(3)])
    solution = solve_ivp(change, (0.0, times[-1]), start, "DOP853", times, rtol=1e-11, atol=1e-13, max_step=2e-3)
    return np.asarray(solution.y[:6].T)


def test_a_tilted_throw_agrees_with_independent_equations() -> None:
    """All six coordinates move, and corners touch and separate.

    q is the pose of the head relative to the frame, in the rotated axes of the frame.
    """
    load = Harmonic("cut", (4e4, 1.1e4), omega_rad_s=9.0, at_m=(0.1, -0.6))
    scene = replace(pressed(load), initial=Initial((1e-3, 2e-3, 0.01), (0.3, -0.2, 0.5)))
    result = simulate(scene, 0.5, output_dt=0.025, tol=1e-10)
    assert len(result.events) > 10 and result.frame is not None
    expected = reference(scene, result.t)
    head, frame = expected[:, :3], expected[:, 3:]
    c, s = np.cos(frame[:, 2]), np.sin(frame[:, 2])
    apart = head[:, :2] - frame[:, :2]
    relative = np.stack(
        [c * apart[:, 0] + s * apart[:, 1], c * apart[:, 1] - s * apart[:, 0], head[:, 2] - frame[:, 2]], 1
    )
    assert np.abs(frame).max(axis=0).min() > 1e-4
    assert pose_error(scene, result.q, relative) < 2e-8
    assert np.abs(result.frame[:, :3] - frame).max() < 1e-9


def test_a_restored_twin_and_a_batch_have_the_same_motion() -> None:
    """The state contains the motion of the frame."""
    scene = replace(pressed(Harmonic("unused", (1.0, 1.0))), initial=Initial())
    times = np.linspace(0.01, 0.4, 23)
    loads = np.stack([4e4 * np.sin(20.0 * times), -1e4 * np.cos(9.0 * times), 2e4 * np.sin(7.0 * times)], axis=1)
    twin, other = (Twin(scene, excitation="sampled") for _ in range(2))
    soft = replace(scene, support=replace(SUPPORT, vertical_stiffness_n_m=1e6))
    batch = TwinBatch([soft, scene])
    for t, load in zip(times, loads, strict=True):
        row = twin.advance(t, load)
        assert row.status.name == "OK"
        members = batch.advance(t, load)
        assert np.array_equal(members.q[1, 0], row.q) and np.array_equal(members.force[1, 0], row.force)
        assert np.array_equal(other.advance(t, load).q, row.q)
        other.restore(twin.snapshot())
    assert twin.frame is not None and np.abs(twin.frame[:3]).max() > 1e-4
    assert np.array_equal(twin.frame, other.frame)
    assert not np.array_equal(members.q[0], members.q[1])
    # a failed advance moves neither body
    held = Twin(scene, excitation="sampled", max_steps=1)
    held.restore(twin.snapshot())
    assert held.advance(0.9, [9e4, 0.0, 0.0]).status.name == "BUDGET" and np.array_equal(held.frame, twin.frame)
    with pytest.raises(ArgumentError, match="a support in all or in none"):
        TwinBatch([scene, replace(scene, support=None)])


def test_a_scene_without_a_support_compiles_no_support() -> None:
    compiled = compiled_scene.compile_scene(preset("paper"), 1e-9)
    assert compiled.parts.terms.support is None and compiled.initial_state().dtype == STATE
    assert Twin(preset("paper")).frame is None


def test_a_support_is_read_from_a_file_and_invalid_supports_are_refused(tmp_path: Path) -> None:
    scene = replace(preset("paper"), support=SUPPORT)
    path = tmp_path / "scene.yaml"
    path.write_text(dump_scene(scene), encoding="utf-8")
    assert load_scene(path) == scene
    with pytest.raises(SceneError, match=r"support.mass_kg: got 0.0, expected a finite number > 0"):
        replace(scene, support=replace(SUPPORT, mass_kg=0.0))
    with pytest.raises(ArgumentError, match="expected a scene without support"):
        simulate(replace(pressed(Harmonic("load", (0.0, 1.0))), support=SUPPORT), 0.01, sensitivity=True)


@pytest.mark.stress
def test_free_bodies_separate_with_the_requested_restitution_and_conserve_momentum() -> None:
    floating = Support(800.0, 60.0, 0.0, 0.0, 0.0)
    scene = Scene(
        HEAD, Frame(0.33, 0.27), Clearance(0.025, 0.030), Contact("exact_restitution", 1e9, restitution=0.4),
        Gravity(0.0), initial=Initial((0.0, 0.0, 0.0), (0.0, 0.7, 0.0)), support=floating,
    )  # fmt: skip
    result = simulate(scene, 0.04, output_dt=0.001, energy_balance=True)
    assert result.frame is not None
    assert result.v[-1, 1] == pytest.approx(-0.4 * 0.7, rel=1e-6)
    momentum = HEAD.mass_kg * (result.v[-1, 1] + result.frame[-1, 4]) + 800.0 * result.frame[-1, 4]
    assert momentum == pytest.approx(HEAD.mass_kg * 0.7, rel=1e-12)


@pytest.mark.stress
@pytest.mark.parametrize("friction", [None, Friction(0.2), Friction(0.3, stick_stiffness_n_m=5e7)], ids=str)
@pytest.mark.parametrize("name", ["paper", "bench_kv", "bench_hc"])
def test_fixed_steps_give_the_same_motion_and_conserve_energy(name: str, friction: Friction | None) -> None:
    # with fixed steps, wear is accurate to first order only
    wear = Wear(1e-11, 0.015, 2.0)
    scene = replace(preset(name), support=SUPPORT, friction=friction, wear=wear)
    events = simulate(scene, 1.0, output_dt=0.1, energy_balance=True)
    assert events.energy_balance is not None and events.energy_balance.relative_imbalance < 1e-10
    # the Kelvin-Voigt force jumps at a touch, for which fixed steps are accurate to first order only
    steps = simulate(scene, 1.0, output_dt=0.1, method="rk4", dt=2e-6)
    assert pose_error(scene, steps.q, events.q) < (1e-4 if name == "bench_kv" else 1e-6)
    bounded = Twin(scene, max_evaluations=20_000)
    assert bounded.advance(1.0).q == pytest.approx(events.q[-1], abs=1e-7)


@pytest.mark.stress
@pytest.mark.parametrize(
    ("damping", "support"),
    [(1e10, SUPPORT), (6e4, replace(SUPPORT, horizontal_damping_n_s_m=1e10)), (1e8, SUPPORT)],
)
def test_strong_dampers_in_contact_or_support_meet_the_tolerance(damping: float, support: Support) -> None:
    scene = replace(preset("bench_kv"), contact=replace(LAW, damping=damping), support=support)
    tight = simulate(scene, 1.0, output_dt=0.1, tol=1e-12)
    for tol in (1e-3, 1e-6, 1e-9):
        loose = simulate(scene, 1.0, output_dt=0.1, tol=tol)
        assert pose_error(scene, loose.q, tight.q) < 10.0 * tol and loose.solver["steps"] < 15_000
