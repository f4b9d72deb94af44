"""Rounded corners: a block that rolls on them, a frame with rounded corners, and no effect on sharp corners."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scenes import INERTIA, MASS, MU, SIDE, SLIP_SPEED, tumbling_block
from scipy.integrate import solve_ivp

from plow_twin import (
    Clearance,
    Constant,
    Contact,
    Frame,
    Friction,
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
from plow_twin.errors import ArgumentError
from plow_twin.model.friction import painleve_coefficients
from plow_twin.model.loads import compile_loads

RADIUS, STIFFNESS = 0.01, 3e6
#: A law with the terms of the preset `measured_square`, whose kernels are compiled for other tests too.
LAW = Contact(
    "exact_restitution", STIFFNESS, restitution=0.8, restitution_fall=0.1, restitution_speed_m_s=0.1,
    impact_speed_floor_m_s=0.05,
)  # fmt: skip
#: The same law with negligible damping.
ELASTIC = replace(LAW, restitution=1.0 - 1e-9, restitution_fall=1e-12)
STICK = Friction(MU, stick_stiffness_n_m=1e6, stick_damping_n_s_m=20.0)
block = partial(tumbling_block, contact=LAW, frame=Frame(SIDE, SIDE, corner_radius_m=RADIUS))


def in_guide(carries: str, **changes: object) -> Scene:
    """Return a rotating head that bounces between the walls of its guide."""
    scene = block(
        head=Head(MASS, 0.01, carries=carries),
        frame=Frame(0.3, 0.2, corner_radius_m=0.03),
        clearance=Clearance(0.01, 0.012),
        loads=(Constant("push", (6.0, 4.0), moment_n_m=0.5),),
        initial=Initial(v=(0.9, -0.6, 1.5)),
    )
    return replace(scene, **changes)  # type: ignore[arg-type]


def on_table(t: float, z: np.ndarray) -> list[float]:
    """Return the time derivative of z = (x, y, theta, vx, vy, omega).

    Four discs touch the table at their lowest points. The table is smooth and elastic;
    `test_disc_of_rounded_corners_rolls_without_sliding` has friction.
    """
    _, y, theta, vx, vy, omega = z
    c, s, half = math.cos(theta), math.sin(theta), 0.5 * SIDE - RADIUS
    fy = moment = 0.0
    for cx, cy in ((-half, half), (half, half), (half, -half), (-half, -half)):
        ax, ay = c * cx - s * cy, s * cx + c * cy - RADIUS
        depth = -1.0 - (y + ay)
        if depth > 0.0:
            normal = STIFFNESS * depth
            fy, moment = fy + normal, moment + ax * normal
    return [vx, vy, omega, 0.0, fy / MASS - 9.81, moment / INERTIA]


def test_rounded_block_agrees_with_an_independent_integration_of_four_discs() -> None:
    # the friction moves nothing; with it, the kernels of the tests below are used
    scene = block(friction=replace(STICK, coefficient=1e-12), contact=ELASTIC)
    result = simulate(scene, t_end=0.4, output_dt=0.004, tol=1e-9, energy_balance=True)
    reference = solve_ivp(
        on_table, (0.0, 0.4), [0.0, -0.85, 0.3, 0.4, 0.0, 6.0], "DOP853", result.t, rtol=1e-9, atol=1e-11, max_step=1e-4
    )
    np.testing.assert_allclose(result.q, reference.y[:3].T, atol=1e-6)
    assert abs(result.q[-1, 2]) > 1.0, "the block turns over a corner"


def test_disc_of_rounded_corners_rolls_without_sliding() -> None:
    """A disc that is pushed along a table without slip rolls: x = -r theta and x'' = F / (m + I / r^2)."""
    radius = 0.5 * SIDE * (1.0 - 1e-9)
    inertia, push = 0.5 * MASS * radius**2, 0.5
    disc = block(
        head=Head(MASS, inertia, carries="corners"),
        frame=Frame(SIDE, SIDE, corner_radius_m=radius),
        friction=Friction(0.5, stick_stiffness_n_m=1e7, stick_damping_n_s_m=200.0),
        loads=(Constant("push", (push, 0.0)),),
        initial=Initial(q=(0.0, -1.0 + 0.5 * SIDE, 0.0)),
    )
    result = simulate(disc, t_end=0.6, output_dt=0.01, energy_balance=True)
    expected = 0.5 * push / (MASS + inertia / radius**2) * result.t**2
    np.testing.assert_allclose(result.q[:, 0], expected, atol=1e-5)
    np.testing.assert_allclose(result.q[:, 2], -expected / radius, atol=1e-3)
    # the disc has rolled by more than a quarter turn
    assert result.q[-1, 2] < -1.6


def pairings(*quick: str) -> pytest.MarkDecorator:
    """Return the combinations. Each needs its own compiled kernels; those not in `quick` are in the full run only."""
    drag = {"stick": STICK, "regularised": Friction(MU, SLIP_SPEED)}
    names = [(carries, name, f"{carries}, {name}") for carries in ("corners", "walls") for name in drag]
    parts = [
        pytest.param(carries, drag[name], id=both, marks=() if both in quick else pytest.mark.stress)
        for carries, name, both in names
    ]
    return pytest.mark.parametrize(("carries", "friction"), parts)


@pairings("corners, stick")
def test_rounded_corners_balance_energy_and_momentum(carries: str, friction: Friction) -> None:
    result = simulate(in_guide(carries, friction=friction), t_end=0.5, output_dt=0.01, energy_balance=True)
    balance = result.energy_balance
    assert balance is not None
    assert sum(pair["makes"] for pair in result.statistics.values()) > 5
    assert abs(balance.imbalance_j) < 1e-8
    assert np.abs(balance.momentum_imbalance).max() < 1e-8


@pairings()
def test_rounded_corners_move_the_same_by_fixed_steps(carries: str, friction: Friction) -> None:
    scene = in_guide(carries, friction=friction)
    run = simulate(scene, t_end=0.1, output_dt=0.01, energy_balance=True)
    fixed = simulate(scene, t_end=0.1, output_dt=0.01, method="rk4", dt=1e-5)
    # fixed steps detect a touch or a slip only at the end of a step, so the bound is wide
    np.testing.assert_allclose(fixed.q, run.q, atol=1e-3)


def test_rounded_corners_stick_in_a_live_twin_that_is_restored() -> None:
    scene = in_guide("corners", friction=STICK)
    run = simulate(scene, t_end=0.2, output_dt=0.01, energy_balance=True)
    # not sampled, so nearly all kernels are those of the run
    twin, other = Twin(scene), Twin(scene)
    for t, q in zip(run.t[1:], run.q[1:], strict=True):
        row = twin.advance(float(t))
        np.testing.assert_allclose(row.q, q, atol=1e-7)
        assert np.array_equal(other.advance(float(t)).q, row.q)
        other.restore(twin.snapshot())


@pairings()
def test_rounded_corners_move_the_same_in_a_live_twin_and_a_batch(carries: str, friction: Friction) -> None:
    scene = in_guide(carries, friction=friction)
    run = simulate(scene, t_end=0.1, output_dt=0.01, energy_balance=True)
    # with a sample at t = 0, the interpolated load is the constant load of the scene
    times = np.arange(101) * 1e-3
    wrench = compile_loads(scene.loads).at(times)
    twin = Twin(scene, excitation="sampled").advance_samples(times, wrench)
    np.testing.assert_allclose(twin.q[::10], run.q, atol=1e-7)
    batch = TwinBatch([scene, scene]).advance_samples(times, wrench)
    np.testing.assert_array_equal(batch.q, [twin.q] * 2)


@pytest.mark.stress  # this test compiles four additional kernels
def test_rounded_corners_hold_with_implicit_steps_and_wear() -> None:
    """The balance of energy closes with a damper stronger than its spring, and with pads that wear by sliding."""
    damped = in_guide(
        "corners",
        contact=Contact("kelvin_voigt", 1e6, damping=2e5),
        friction=Friction(MU, 1e-3),
        wear=Wear(1e-13, 1e-3, 0.2, sliding="total"),
    )
    result = simulate(damped, t_end=0.3, output_dt=0.01, energy_balance=True)
    twin = Twin(damped)
    twin.advance(0.3)
    assert twin._state.implicit_steps > 0
    assert result.energy_balance is not None and abs(result.energy_balance.imbalance_j) < 1e-6
    assert result.wear_depth.max() > 0.0


def test_painleves_case_of_a_rounded_corner_is_at_its_touching_point() -> None:
    scene = block(initial=Initial())
    half, arm = 0.5 * SIDE - RADIUS, 0.5 * SIDE
    expected = (INERTIA / MASS + half**2) / (half * arm)
    np.testing.assert_allclose(painleve_coefficients(scene), expected)
    np.testing.assert_allclose(
        painleve_coefficients(replace(scene, head=replace(scene.head, carries="walls")))[0], expected
    )


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: block(frame=Frame(SIDE, 0.5 * SIDE, corner_radius_m=0.25 * SIDE)), "shorter side"),
        (lambda: block(frame=Frame(SIDE, SIDE, corner_radius_m=-1e-3)), "> 0"),
        (lambda: in_guide("walls", support=Support(1.0, 1.0, 1e6, 1e6, 1e6)), "none with frame.corner_radius_m"),
    ],
)
def test_invalid_rounded_corners_are_named(make: Callable[[], Scene], expected: str) -> None:
    with pytest.raises(SceneError, match=expected):
        make()


def test_batch_of_sharp_and_rounded_corners_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"scenes\[1\].*corner_radius_m"):
        TwinBatch([block(), block(frame=Frame(SIDE, SIDE))])
