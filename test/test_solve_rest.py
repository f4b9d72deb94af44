"""Rest is recognised only if the contacts hold the head permanently. A changing load ends the rest."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from scenes import FIRM, preset, wall_and_point
from scipy.optimize import fsolve

from plow_twin import Gravity, Harmonic, Head, Initial, Scene, Twin, Wear, simulate
from plow_twin.model import geometry
from plow_twin.model.geometry import arm_rows, body_state, penetration_rows
from plow_twin.solve import compiled_scene
from plow_twin.solve.compiled_scene import compile_scene


def fallen(law: str = "kelvin_voigt") -> Scene:
    """Return a head that falls on the frame and comes to rest on three pairs."""
    scene = dataclasses.replace(preset("bench_kv"), loads=())
    if law != "kelvin_voigt":
        contact = dataclasses.replace(preset("bench_hc").contact, law=law, damping=None, restitution=0.2)
        scene = dataclasses.replace(scene, contact=contact)
    return scene


def fallen_under_a_harmonic(force: float, omega: float) -> Scene:
    """Return this head under a harmonic and its weight. At 23.2 rad/s, the head on its three pairs is in resonance."""
    return dataclasses.replace(fallen(), loads=(Harmonic("small", (force, 0.3 * force), omega, 0.3, 0.1 * force),))


def static_pose(scene: Scene, guess: np.ndarray) -> np.ndarray:
    """Solve the balance of weight and springs with scipy, from forces in the axes of the head."""
    mass, g, arm = scene.head.mass_kg, scene.gravity.acceleration_m_s2, scene.gravity.arm_m
    rows, arms, contact = penetration_rows(scene), arm_rows(scene), scene.contact

    def balance(q: np.ndarray) -> np.ndarray:
        y = body_state(q, (0.0, 0.0, 0.0), (0.0, 0.0))
        x, yy, c, s = y[0], y[1], np.cos(q[2]), np.sin(q[2])
        at = np.array([c, s, x, yy])
        force = contact.stiffness * np.maximum(at @ rows[:4] + rows[4], 0.0) ** contact.exponent
        weight = np.array([-mass * g * s, -mass * g * c])
        return np.array([*(weight - rows[2:4] @ force), (at @ arms * force).sum() - mass * g * arm])

    return np.asarray(fsolve(balance, guess, xtol=1e-14))


# runs without a load compute the balance, and thus share kernels
balanced = partial(simulate, energy_balance=True)


# the other law needs additional compiled kernels
@pytest.mark.parametrize("law", ["kelvin_voigt", pytest.param("exact_restitution", marks=pytest.mark.stress)])
def test_an_hour_at_rest_takes_few_steps_and_is_in_balance(law: str) -> None:
    scene = fallen(law)
    result = balanced(scene, 3600.0, 360.0)
    settled = balanced(scene, 120.0, 1.0)
    assert result.solver["steps"] < settled.solver["steps"] + 40
    assert np.array_equal(result.q[1], result.q[-1]) and not result.v[-1].any()
    assert np.abs(result.q[-1] - static_pose(scene, result.q[-1])).max() < 1e-12
    weight = scene.head.mass_kg * scene.gravity.acceleration_m_s2
    sums = result.energy_balance
    assert sums is not None and sums.imbalance_j < 1e-12 * sums.turnover_j
    assert np.abs(sums.momentum_imbalance).max() < 1e-12 * weight * 3600.0
    # during rest, the pads support the weight, so the totals grow
    carried = sum(row["impulse"] for row in result.statistics.values())
    before = sum(row["impulse"] for row in settled.statistics.values())
    assert carried == pytest.approx(before + result.force[-1].sum() * (3600.0 - 120.0), rel=1e-9)


def test_a_change_of_the_load_ends_a_rest() -> None:
    """The head rests for 50 s under samples and is then pushed.

    A run with a tolerance at which the rest begins later gives the same motion.
    """
    t = np.concatenate([np.arange(1, 51) * 1.0, 50.0 + np.arange(1, 501) * 1e-3])
    wrench = np.where(t[:, None] > 50.0, [4e4, 1e4, 2e3], [0.0, 0.0, 0.0])
    twins = [Twin(fallen(), tol=tol, excitation="sampled") for tol in (1e-6, 1e-12)]
    rows = [twin.advance_samples(t, wrench) for twin in twins]
    assert rows[0].steps[45:50].max() <= 1
    assert np.abs(rows[0].q[50:] - rows[1].q[50:]).max() < 1e-8
    assert np.ptp(rows[0].q[50:], axis=0).max() > 1e-3 and twins[0]._state.at_rest == 0


def test_a_sliding_head_is_not_at_rest() -> None:
    sliding = dataclasses.replace(
        fallen(), head=Head(2430.0, FIRM), gravity=Gravity(9.81), pairs=("top_left_top", "top_right_top"),
        initial=Initial((0.0, 0.0, 0.0), (1e-9, 0.0, 0.0)),
    )  # fmt: skip
    result = balanced(sliding, 300.0, 30.0)
    assert np.abs(np.diff(result.q[:, 0]) - 3e-8).max() < 1e-11


@pytest.mark.parametrize("corners", [("left", "right"), ("left",)])
def test_an_unstable_balance_is_not_rest(corners: tuple[str, ...]) -> None:
    """On two upper corners, the head rests. On one corner above its weight, the smallest tilt grows."""
    scene, stable = fallen(), len(corners) == 2
    sunk = scene.head.mass_kg * 9.81 / len(corners) / scene.contact.stiffness + 0.5 * scene.clearance.vertical_m
    arm = 0.0 if stable else -0.5 * scene.frame.width_m
    scene = dataclasses.replace(
        scene, gravity=Gravity(9.81, arm), pairs=tuple(f"top_{corner}_top" for corner in corners), locked=("x",),
        initial=Initial((0.0, -sunk, 0.0)),
    )  # fmt: skip
    twin = Twin(scene, tol=1e-6)
    twin.advance(1e-3)
    assert bool(twin._state.at_rest) == stable
    nudged = dataclasses.replace(scene, initial=Initial((0.0, -sunk, 1e-9)))
    theta = np.abs(simulate(nudged, 9.0, 0.01, tol=1e-9).q[:, 2])
    assert theta.max() < 2e-9 if stable else theta.max() > 1e-3


def test_advances_and_snapshots_at_rest_do_not_change_the_motion() -> None:
    # with these degrees of freedom locked, the kernels of other tests are used
    scene = dataclasses.replace(fallen(), locked=("x", "theta"))
    twin, other = Twin(scene), Twin(scene)
    rows = [twin.advance(t) for t in np.linspace(0.5, 77.7, 300)]
    assert twin._state.at_rest == 1 and not rows[-1].v.any()
    assert other.advance(77.7).q.tolist() == rows[-1].q.tolist()
    restored = Twin(scene)
    restored.restore(twin.snapshot())
    for t in (78.0, 300.0):
        a, b = restored.advance(t), twin.advance(t)
        assert a.q.tolist() == b.q.tolist() and a.impulse.tolist() == b.impulse.tolist()
    assert restored.digest() == twin.digest()


def test_rest_is_compiled_only_for_scenes_in_which_it_is_possible() -> None:
    scene = fallen()
    driven = dataclasses.replace(scene, loads=(Harmonic("shake", (1e3, 0.0), 5.0),))
    shaken = fallen_under_a_harmonic(1e-6, 5.0)
    undamped = dataclasses.replace(shaken, contact=dataclasses.replace(scene.contact, damping=0.0))
    worn = dataclasses.replace(scene, wear=Wear(1e-12, 0.015, 2.0))
    cases = scene, shaken, driven, undamped, worn
    assert [compile_scene(one, 1e-9).parts.terms.rest for one in cases] == [1, 1, None, None, None]


# without any damping, kernels of their own are compiled
@pytest.mark.parametrize(
    ("law", "damping"), [("kelvin_voigt", 1e-9), pytest.param("hertz", None, marks=pytest.mark.stress)]
)
def test_an_undamped_spring_keeps_oscillating(law: str, damping: float | None) -> None:
    contact = dataclasses.replace(preset("bench_kv").contact, law=law, damping=damping, stiffness=2e5)
    scene = wall_and_point(contact, speed=0.0, gravity=9.81)
    result = simulate(scene, 60.0, 0.01, tol=1e-9)
    late = result.q[result.t > 50.0, 1]
    assert np.ptp(late) > 1e-3


@pytest.mark.parametrize(("force", "omega"), [(1e-5, 2.0), (3e-7, 23.2), (3e-5, 300.0)])
def test_a_negligible_harmonic_allows_rest(force: float, omega: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The harmonic moves the head by less than a thousandth of the tolerance, as a run without rest confirms."""
    tol, scene = 1e-6, fallen_under_a_harmonic(force, omega)
    rested = simulate(scene, 400.0, 0.317, tol=tol)
    assert rested.solver["steps"] == simulate(scene, 200.0, tol=tol).solver["steps"] + 2
    larger = simulate(fallen_under_a_harmonic(1e3 * force, omega), 60.0, 0.317, tol=tol)
    monkeypatch.setattr(compiled_scene, "_harmonics_are_small", lambda *arguments: False)
    monkeypatch.setattr(compiled_scene, "_LATELY", compiled_scene._Shared())  # nothing about the scene is cached
    followed = simulate(scene, 400.0, 0.317, tol=tol)
    assert followed.solver["steps"] > 4 * rested.solver["steps"]
    way = tol * geometry.length_scale(scene)
    assert 0.0 < np.abs(rested.q - followed.q).max() < 1e-3 * way
    # a harmonic that is a thousand times as large exceeds the tolerance, so the head follows it
    swing = np.ptp(larger.q[larger.t > 50.0], axis=0).max()
    assert swing > 1e-2 * way


def test_loose_tolerances_find_the_same_rest() -> None:
    """After steps near the limit of stability, the stiffest pairs vibrate slightly, which hardly moves the head."""
    steps = [balanced(fallen(), t_end, tol=1e-3).solver["steps"] for t_end in (100.0, 1000.0)]
    assert steps[1] == steps[0] + 9


def test_a_zero_load_allows_rest() -> None:
    still = fallen()
    silent = dataclasses.replace(still, loads=(*still.loads, Harmonic("nothing", (0.0, 0.0), 2.0)))
    assert balanced(silent, 1000.0).solver == balanced(still, 1000.0).solver
