"""A head that carries corners is a block in a fixed cavity: on one wall, tumbling, and compared with walls."""

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
    Gravity,
    Harmonic,
    Head,
    Initial,
    Result,
    Scene,
    SceneError,
    Support,
    Twin,
    TwinBatch,
    simulate,
)
from plow_twin.errors import ArgumentError
from plow_twin.estimate.forward import Forward

STIFFNESS, DAMPING = 3e6, 600.0
#: A load that moves nothing. With it, a mirrored head with walls has the terms of a pinned motion.
NOTHING = Harmonic("nothing", (1e-12, 0.0), 9.0)
WALL = 1.0
block = partial(tumbling_block, contact=Contact("kelvin_voigt", STIFFNESS, damping=DAMPING), loads=(NOTHING,))


def on_table(t: float, z: np.ndarray) -> list[float]:
    """Return the time derivative of z = (x, y, theta, vx, vy, omega), computed from the four corners of the block."""
    _, y, theta, vx, vy, omega = z
    c, s, half = math.cos(theta), math.sin(theta), 0.5 * SIDE
    fx = fy = moment = 0.0
    for cx, cy in ((-half, half), (half, half), (half, -half), (-half, -half)):
        ax, ay = c * cx - s * cy, s * cx + c * cy
        depth, rate = -WALL - (y + ay), -(vy + omega * ax)
        if depth > 0.0:
            normal = max(STIFFNESS * depth + DAMPING * rate, 0.0)
            drag = -MU * normal * math.tanh((vx - omega * ay) / SLIP_SPEED)
            fx, fy, moment = fx + drag, fy + normal, moment + ax * normal - ay * drag
    return [vx, vy, omega, fx / MASS, fy / MASS - 9.81, moment / INERTIA]


@pytest.fixture(scope="module")
def falls() -> object:
    """Return a block that falls on its table, rolls over two of its corners and comes to rest."""
    return simulate(block(), t_end=0.8, output_dt=0.004, tol=1e-9, energy_balance=True)


def test_corners_agree_with_an_independent_integration_of_a_tumbling_block(falls) -> None:
    reference = solve_ivp(
        on_table, (0.0, 0.4), [0.0, -0.85, 0.3, 0.4, 0.0, 6.0], "DOP853", falls.t[:101], rtol=1e-9, atol=1e-11,
        max_step=1e-4,
    )  # fmt: skip
    assert np.abs(falls.q[:101] - reference.y[:3].T).max() < 1e-6
    assert abs(falls.q[-1, 2] - math.pi) < 0.01
    makes = {name: pair["makes"] for name, pair in falls.statistics.items() if pair["makes"]}
    assert set(makes) == {"bottom_left_bottom", "bottom_right_bottom"}


def test_corners_balance_energy_and_momentum(falls) -> None:
    balance = falls.energy_balance
    assert abs(balance.imbalance_j) < 1e-8
    assert np.abs(balance.momentum_imbalance).max() < 1e-8


def test_contact_continues_at_45_degrees_under_the_corner_s_new_name() -> None:
    # the block is pressed on the table by ten times its weight, and rolls over its lower right corner
    push = Constant("push", force_n=(0.0, -90.0), moment_n_m=-3.3)
    lying = Initial(q=(0.0, -WALL + 0.5 * SIDE, 0.0), v=(0.0, 0.0, -0.3))
    scene = block(initial=lying, loads=(push, NOTHING), friction=Friction(1.0, 0.02))
    # this call uses the kernels of the fixture `falls`
    result = simulate(scene, t_end=0.25, output_dt=1e-3, energy_balance=True)
    turned = np.flatnonzero(result.q[:, 2] < -0.25 * math.pi)
    assert turned.size > 0
    at = result.t[turned[0]]
    passed = [event for event in result.events if abs(event["time"] - at) < 1.1e-3]
    # both pairs change at the same time, in one event that is not counted as a touch
    assert {(int(e["pair"]), int(e["mode_from"]), int(e["mode_to"])) for e in passed} == {(4, 1, 0), (6, 0, 1)}
    assert passed[0]["time"] == passed[1]["time"]
    # the force is continuous across the event, so its differences are continuous too
    force = result.force[:, [4, 6]].sum(axis=1)
    # the force is smooth, so its differences before, across and after the event follow one curve
    steps = np.abs(np.diff(force[turned[0] - 3 : turned[0] + 2]))
    assert force[turned[0]] > 0.0
    assert np.abs(np.diff(steps)).max() < steps.max()


@pytest.mark.parametrize("spin", [40.0, -25.0])
def test_a_block_in_flight_turns_without_limit(spin: float) -> None:
    thrown = Initial(q=(0.0, 0.5, 1.0), v=(0.2, 1.0, spin))
    result = simulate(block(initial=thrown), t_end=0.5, output_dt=0.01, tol=1e-9, energy_balance=True)
    t = result.t
    expected = np.stack([0.2 * t, 0.5 + t - 0.5 * 9.81 * t * t, 1.0 + spin * t], axis=1)
    np.testing.assert_allclose(result.q, expected, atol=1e-11)
    assert not result.force.any()


def mirrored(scene: Scene) -> Scene:
    """Return a head with walls. Without rotation, its motion is that of the block with the opposite sign."""
    q, v = scene.initial.q, scene.initial.v
    turned = tuple(replace(load, force_n=(-load.force_n[0], -load.force_n[1])) for load in scene.loads)
    return replace(
        scene,
        head=replace(scene.head, carries="walls"),
        gravity=Gravity(-9.81),
        loads=turned,
        initial=Initial(q=(-q[0], -q[1], -q[2]), v=(-v[0], -v[1], -v[2])),
    )


STICK = Friction(0.2, stick_stiffness_n_m=1e6, stick_damping_n_s_m=20.0)
#: A block whose inertia is so large that it does not rotate. A locked angle would need additional kernels.
GUIDED = block(
    head=Head(MASS, 1e12, carries="corners"),
    frame=Frame(0.3, 0.2),
    clearance=Clearance(0.01, 0.012),
    loads=(Harmonic("push", force_n=(120.0, 40.0), omega_rad_s=9.0),),
    initial=Initial(q=(0.001, 0.002, 0.0), v=(0.3, -0.2, 0.0)),
)
RESTITUTION = Contact("exact_restitution", stiffness=1e7, exponent=1.5, restitution=0.5)


def both(scene: Scene, **options: float) -> tuple[Result, Result]:
    """Return the run of a block, with the kernels of `falls`, and that of its mirrored head."""
    return simulate(scene, energy_balance=True, **options), simulate(mirrored(scene), **options)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, id="regularised friction"),
        pytest.param({"friction": STICK, "contact": RESTITUTION}, id="stick", marks=pytest.mark.stress),
        pytest.param({"friction": None, "loads": ()}, id="smooth and free", marks=pytest.mark.stress),
        pytest.param({"friction": None}, id="smooth", marks=pytest.mark.stress),
        pytest.param({"loads": ()}, id="free", marks=pytest.mark.stress),
    ],
)
def test_without_rotation_a_head_with_corners_moves_like_the_mirrored_head_with_walls(
    changes: dict[str, object],
) -> None:
    block_run, head_run = both(replace(GUIDED, **changes), t_end=0.5, output_dt=1e-3, tol=1e-9)  # type: ignore[arg-type]
    np.testing.assert_allclose(block_run.q, -head_run.q, atol=1e-8)
    assert sum(pair["makes"] for pair in block_run.statistics.values()) > 4
    assert {n: s["makes"] for n, s in block_run.statistics.items()} == {
        n: s["makes"] for n, s in head_run.statistics.items()
    }


def test_with_little_rotation_a_head_with_corners_moves_nearly_like_the_mirrored_head_with_walls() -> None:
    def difference(angle: float) -> float:
        scene = replace(
            GUIDED,
            head=block().head,
            # friction and load are negligible but present, because the kernels of the test above contain both
            friction=Friction(1e-12, SLIP_SPEED),
            loads=(NOTHING,),
            initial=Initial(q=(0.0, 0.0, angle), v=(0.4, -0.3, 0.0)),
        )
        block_run, head_run = both(scene, t_end=0.03, output_dt=1e-3, tol=1e-10)
        return float(np.abs(block_run.q + head_run.q).max())

    # the arms of the contacts differ between block and head, by the ratio of clearance to size and by the angle
    assert difference(1e-3) < 0.1 * 0.03


def test_corners_move_the_same_by_fixed_steps(falls) -> None:
    # the Kelvin-Voigt force jumps at a touch, for which fixed steps are accurate to first order only
    fixed = simulate(block(), t_end=0.2, output_dt=0.004, method="rk4", dt=1e-6)
    np.testing.assert_allclose(fixed.q, falls.q[:51], atol=1e-3)


# in the quick run, test_solve_falling tests a live twin of a block
@pytest.mark.stress
def test_corners_move_the_same_by_a_live_twin(falls) -> None:
    twin = Twin(block())
    for t in falls.t[1:101]:
        now = twin.advance(float(t))
    np.testing.assert_allclose(now.q, falls.q[100], atol=1e-9)


def test_pairs_of_a_block_stop_the_rotations_of_the_block() -> None:
    # a moment turns the block counter-clockwise against its guide; a larger moment would need implicit steps, which
    # must be compiled
    scene = block(
        frame=Frame(0.3, 0.2), clearance=Clearance(0.01, 0.01), friction=Friction(1e-12, 0.05), gravity=Gravity(0.0),
        loads=(Constant("turn", moment_n_m=5.0), NOTHING), initial=Initial(),
    )  # fmt: skip
    result = simulate(scene, t_end=0.2, output_dt=1e-2, energy_balance=True)
    assert result.contact_sets["ccw"] and not result.contact_sets["cw"]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: replace(block(), head=Head(1.0, 1.0, "consistent", (0.01, 0.0), "corners")), "head.com_offset_m"),
        (lambda: block(support=Support(1.0, 1.0, 1e6, 1e6, 1e6)), "carries: corners"),
        (lambda: block(head=Head(1.0, 1.0, carries="edges")), "walls, corners"),
    ],
)
def test_features_that_corners_cannot_have_are_named(make: Callable[[], Scene], expected: str) -> None:
    with pytest.raises(SceneError, match=expected):
        make()


def test_block_that_is_not_square_ends_at_45_degrees_with_a_named_error() -> None:
    with pytest.raises(ArgumentError, match="carries"):
        TwinBatch([block(), mirrored(block())])
    with pytest.raises(Exception, match="valid up to 45"):
        simulate(block(frame=Frame(SIDE, 0.05)), t_end=0.5, output_dt=0.01, energy_balance=True)


def test_estimate_refuses_a_block() -> None:
    with pytest.raises(Exception, match=r"head\.carries"):
        Forward(block(), None)  # type: ignore[arg-type]


@pytest.mark.stress  # these twins compile additional kernels
@pytest.mark.parametrize("radius", [pytest.param(None, id="sharp"), pytest.param(0.01, id="rounded")])
def test_twins_with_walls_and_with_corners_share_no_compiled_code(radius: float | None) -> None:
    """Both twins have the same terms, and only the record types of their constants differ."""
    walls = replace(mirrored(block()), frame=Frame(SIDE, SIDE))
    corners = block(frame=Frame(SIDE, SIDE, corner_radius_m=radius))
    expected = simulate(corners, t_end=0.3, output_dt=0.1, energy_balance=True).q[-1]
    for scenes in ((walls, corners), (corners, walls)):
        twins = [Twin(scene) for scene in scenes]
        ends = [twin.advance(0.3).q for twin in twins]
        np.testing.assert_allclose(ends[scenes.index(corners)], expected, atol=1e-9)
        assert twins[0].signature != twins[1].signature


@pytest.mark.stress  # this test compiles additional kernels
def test_strongly_damped_block_sinks_in_as_deep_as_its_weight_presses() -> None:
    """Two corners with overdamped contact creep to the static depth in implicit steps."""
    stiffness, start = 1e4, -WALL + 0.5 * SIDE
    damped = Contact("kelvin_voigt", stiffness=stiffness, damping=4e4)
    scene = block(contact=damped, initial=Initial((0.0, start, 0.0), (0.0, 0.0, 0.0)), friction=None)
    result = simulate(scene, t_end=60.0, output_dt=1.0)
    # each corner obeys C x' = m g / 2 - K x, except in the first m / (2 C) = 13 us
    depth = 0.5 * MASS * 9.81 / stiffness * (1.0 - np.exp(-result.t * stiffness / 4e4))
    np.testing.assert_allclose(start - result.q[:, 1], depth, atol=2e-7)
    assert result.solver["steps"] < 2000
