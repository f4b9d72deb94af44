"""The contact model compared with published measurements of impacts and drops (`benchmark/data/measured`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plow_twin import Initial, load_scene, simulate
from plow_twin.errors import ArgumentError, RecordingError
from plow_twin.study.measured import bands, impact
from plow_twin.study.measured.drops import Drops
from plow_twin.study.measured.ellipse import ELLIPSE, GYRATION, SEMI_AXES, contact_arms, simulated_impact
from plow_twin.study.measured.square import MARKER, SQUARE, ensemble, fit_flight, toss

DATA = Path(__file__).resolve().parent.parent / "benchmark" / "data" / "measured"


@pytest.fixture(scope="module")
def impacts() -> tuple[np.ndarray, np.ndarray]:
    with np.load(DATA / "ellipse_impacts.npz") as data:
        return data["before"], data["after"]


@pytest.fixture(scope="module")
def drops() -> Drops:
    return Drops.load(DATA / "square_drops.npz")


def test_drops_with_rows_in_reverse_order_are_refused(tmp_path: Path) -> None:
    with np.load(DATA / "square_drops.npz") as data:
        arrays = {name: data[name].copy() for name in data.files}
    arrays["pose"][3] = arrays["pose"][3, ::-1]
    np.savez(tmp_path / "drops.npz", **arrays)
    with pytest.raises(RecordingError, match="drop 3 ends higher than it begins"):
        Drops.load(tmp_path / "drops.npz")


def misses(predicted: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the norm of the velocity errors [m/s]."""
    return np.linalg.norm((predicted - after)[:, 3:] * [1.0, 1.0, GYRATION], axis=1)


def energy(states: np.ndarray) -> np.ndarray:
    return 0.5 * (states[:, 3] ** 2 + states[:, 4] ** 2 + (GYRATION * states[:, 5]) ** 2)


def test_measured_impacts_are_predicted_better_than_by_a_rigid_impact(impacts) -> None:
    before, after = impacts
    missed = misses(impact(before), after)
    assert np.sqrt((missed**2).mean()) < 0.245
    assert np.median(missed) < 0.15
    # without the decrease of restitution and the damper of the spring, the model is no better than a rigid model
    plain = replace(ELLIPSE, fall=0.0, fall_along=0.0, restitution=0.54, tilt=0.0, stick_damping=0.0)
    assert np.sqrt((misses(impact(before, plain), after) ** 2).mean()) > 0.27


def test_preset_and_function_give_the_same_measured_impacts(impacts) -> None:
    before, after = impacts
    found = simulated_impact(before)
    # during an impact of finite duration, the ellipse rotates slightly, so the two results differ
    assert misses(found, impact(before)).max() < 0.015
    missed = misses(found, after)
    assert np.sqrt((missed**2).mean()) < 0.245
    assert np.median(missed) < 0.15


def test_impact_is_an_impulse_at_the_lowest_point_that_gains_no_energy(impacts) -> None:
    before, _ = impacts
    contact = replace(ELLIPSE, tilt=0.0)
    after = impact(before, contact)
    change = after - before
    along, up = contact_arms(before[:, 2])
    # x and theta of the data form a left-handed system, hence the plus sign
    moment = along * change[:, 4] + up * change[:, 3]
    np.testing.assert_allclose(change[:, 5], moment / GYRATION**2, atol=1e-9)
    assert (energy(after) < energy(before)).all()
    assert (after[:, :3] == before[:, :3]).all()


def test_central_impact_of_the_ellipse_returns_its_restitution() -> None:
    before = np.array([[0.0, SEMI_AXES[1], 0.0, 0.0, -2.5, 0.0], [0.0, SEMI_AXES[1], 0.0, 0.0, 1.0, 0.0]])
    after = impact(before, replace(ELLIPSE, tilt=0.0))
    assert after[0, 4] == pytest.approx(2.5 * ELLIPSE.restitution, rel=3e-3)
    # a body that moves away has no impact
    assert (after[1] == before[1]).all()


def test_tossed_block_moves_as_the_preset_computed_by_the_solver(drops) -> None:
    scene = load_scene("measured_square")
    contact, friction, radius = scene.contact, scene.friction, scene.frame.corner_radius_m
    assert friction is not None and friction.stick_stiffness_n_m and friction.stick_damping_n_s_m and radius
    assert contact.restitution and contact.restitution_fall and contact.restitution_mass_power
    block, fall, power = SQUARE.copy(), contact.restitution_fall, contact.restitution_mass_power
    for name, value in dict(
        half=0.5 * scene.frame.width_m - radius, radius=radius, gyration=scene.head.inertia_kg_m2**0.5, table=0.0,
        stiffness=contact.stiffness, tangential=friction.stick_stiffness_n_m / contact.stiffness,
        tangential_damping=0.5 * friction.stick_damping_n_s_m / friction.stick_stiffness_n_m**0.5,
        # restitution of an impact at 1 m/s, with a mass relative to that of an impact on the edge of the square
        restitution=contact.restitution * (1.5**power * (contact.restitution_speed_m_s or 1.0)) ** fall,
        restitution_fall=fall, mass_power=power, friction=friction.coefficient, friction_fall=0.0,
        gravity=scene.gravity.acceleration_m_s2, drag=0.0, spin_drag=0.0,
    ).items():  # fmt: skip
        block[name] = value
    far, apart = [], []
    for index in drops.usable()[::8]:
        first, until = int(drops.flight_rows[index]) - 1, drops.until(index, 1)
        measured = drops.pose[index, first:until]
        x, z, theta, *rates = MARKER.state_of_block(fit_flight(drops.pose[index, : first + 1]).state)
        if z < radius + float(block["half"]) * (abs(np.cos(theta)) + abs(np.sin(theta))):
            continue  # this state penetrates the table, so the scene would begin within an impact
        start = Initial((x, z - 1.0, theta), (rates[0], rates[1], rates[2]))
        # with the balance, the kernels of test_solve_rounded are used
        moving = replace(scene, initial=start)
        solved = simulate(moving, t_end=len(measured) / 250.0, output_dt=0.004, energy_balance=True).q
        path = toss(np.array([[x, z, theta, *rates]]), len(solved), np.array([block], block.dtype))[0, :, :3]
        apart.append(np.abs(path[:20] - solved[:20] - [0.0, 1.0, 0.0]).max(axis=0))
        off = MARKER.measured(solved + np.array([0.0, 1.0, 0.0]))[: len(measured), :2] - measured[:, :2]
        far.append(np.hypot(*off.T).mean())
    # impacts amplify the difference between fixed steps and event detection
    assert (np.max(apart, axis=0) < [2e-3, 2e-3, 0.1]).all()
    assert (np.median(apart, axis=0) < [4e-4, 3e-4, 0.03]).all()
    # a model with rigid impacts has an error of 10 mm
    assert np.median(far) < 9e-3, far


def test_flight_is_fitted_to_its_measured_rows(drops) -> None:
    for pose, rows in list(zip(drops.pose, drops.flight_rows, strict=True))[:40]:
        if rows < 8:
            continue
        flight = fit_flight(pose[:rows])
        assert abs(flight.state[0] - pose[rows - 1, 0]) < 3e-4
        # the last given row may be after the impact; the flight then ends one row earlier
        assert len(flight.times) in (rows, rows - 1, rows - 2)
    assert fit_flight(np.delete(pose[:rows], 4, axis=0)).times[0] == pytest.approx(fit_flight(pose[:rows]).times[0])


def test_bands_contain_nine_of_ten_measured_rows(drops) -> None:
    shares = []
    for index in drops.usable()[::3]:
        rows = drops.until(index, 2) + 1
        pose, points = drops.pose[index, :rows], bands(drops.pose[index, : drops.flight_rows[index]], rows)
        shares.append(((pose >= points[:, 0]) & (pose <= points[:, 2])).mean(axis=0))
    inside = np.array(shares)
    assert (np.abs(inside.mean(axis=0) - 0.9) < 0.05).all(), inside.mean(axis=0)


def test_bands_are_ordered_start_narrow_and_repeat(drops) -> None:
    flight = drops.pose[0, : drops.flight_rows[0]]
    bands_found = bands(flight, 100)
    assert bands_found.shape == (100, 3, 3)
    assert (np.diff(bands_found, axis=1) > 0.0).all()
    assert (bands_found[0, 2] - bands_found[0, 0] < [1e-3, 1e-3, 0.01]).all()
    assert (bands_found[80, 2] - bands_found[80, 0] > 0.01).all()
    assert (bands(flight, 100) == bands_found).all()
    assert (bands(flight, 5) == bands_found[:5]).all() is np.True_ or bands(flight, 5).shape == (5, 3, 3)
    assert ensemble(flight, 30, members=7).shape == (7, 30, 3)


def test_bad_rows_of_a_flight_are_named(drops) -> None:
    flight = drops.pose[0, : drops.flight_rows[0]]
    wrong: list[Any] = [np.zeros((3, 3)), np.zeros((8, 2)), np.full((8, 3), np.nan), [], [["a", "b", "c"]] * 5]
    # the last three are a whole drop that ends at rest, a pose below the table, and lengths in millimetres
    wrong += [drops.pose[0], flight - [0.0, 1.0, 0.0], flight * [1e3, 1e3, 1.0]]
    for rows in wrong:
        with pytest.raises(ArgumentError, match="first_flight"):
            bands(rows, 10)
    for count in (0, 20_000, 50.5, "50", np.nan):
        with pytest.raises(ArgumentError, match="n_rows"):
            bands(flight, count)  # type: ignore[arg-type]


def test_bad_numbers_of_an_impact_are_named() -> None:
    with pytest.raises(ArgumentError, match=r"before.*\(n, 6\)"):
        impact(np.zeros((2, 5)))
    with pytest.raises(ArgumentError, match=r"before.*\(n, 6\)"):
        impact([[1.0, 2.0], [3.0]])  # type: ignore[list-item]
    with pytest.raises(ArgumentError, match=r"before\[1\].*nan"):
        impact(np.array([[0.0] * 6, [0.0] * 5 + [np.nan]]))
    assert impact(np.zeros((0, 6))).shape == (0, 6)
    with pytest.raises(ArgumentError, match=r"before\[0\].*rates below"):
        impact([[0.0, 0.0, 0.3, 1e200, -1e200, 1e200]])
    for name, number in (("restitution", np.nan), ("stick_stiffness", -1.0), ("friction", np.inf)):
        with pytest.raises(ArgumentError, match=f"contact.{name}"):
            impact(np.ones((1, 6)), replace(ELLIPSE, **{name: number}))


def test_marker_is_turned_as_the_angles_at_rest_show(drops) -> None:
    end = drops.pose[:, -10:]
    rests = (np.ptp(end[:, :, 1], axis=1) < 1e-3) & (np.ptp(end[:, :, 2], axis=1) < 5e-3)
    angle = end[rests, :, 2].mean(axis=1)
    right = np.pi / 2.0
    assert rests.sum() > 200
    assert np.median((angle + 0.5 * right) % right - 0.5 * right) == pytest.approx(MARKER.turn, abs=5e-3)


def test_the_state_of_the_marker_is_converted_to_the_block_and_back() -> None:
    state = np.random.default_rng(0).standard_normal((20, 6))
    np.testing.assert_allclose(MARKER.state_of_block(MARKER.measured(state)), state, atol=1e-12)
    # the marker moves like a point of the block
    h = 1e-6
    moved = state.copy()
    moved[:, :3] += h * state[:, 3:]
    rate = (MARKER.measured(moved) - MARKER.measured(state))[:, :3] / h
    np.testing.assert_allclose(rate, MARKER.measured(state)[:, 3:], atol=1e-5)
