"""Friction with stick: closed forms of stick-slip, a hold without creep, Painleve's case, and no unused code."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scenes import FIRM, pose_error, preset
from scipy.optimize import brentq
from test_solve_friction import MASS, MU, G, block

from plow_twin import (
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
    ToleranceWarning,
    Twin,
    TwinBatch,
    simulate,
)
from plow_twin.model.friction import painleve_coefficients
from plow_twin.solve import compiled_scene
from plow_twin.solve.state import STATE

GRIP = 1e9
#: Tangential damping [N s/m] of each of the two corners from which the block hangs.
HELD_DAMPING = 2e5
#: Friction of each of these corners.
HELD = Friction(MU, stick_stiffness_n_m=GRIP, stick_damping_n_s_m=HELD_DAMPING)


@dataclass
class Slider:
    """Closed form of m x'' + spring x = F(t) - T, phase by phase. In stick, T is the force of a spring `grip`."""

    mass: float
    spring: float
    grip: float
    static: float
    kinetic: float
    load: tuple[float, float, float]  # F = rate t + amplitude sin(omega t)

    def phase(
        self, t0: float, x0: float, v0: float, stiffness: float, constant: float
    ) -> Callable[[float], np.ndarray]:
        """Return x and v of m x'' + stiffness x = F(t) + constant, starting from a state."""
        rate, amplitude, omega = self.load
        m, w = self.mass, math.sqrt(stiffness / self.mass)

        def forced(t: float) -> np.ndarray:
            if stiffness == 0.0:
                swing = -amplitude / (m * omega**2) if omega else 0.0
                x = rate * t**3 / (6.0 * m) + constant * t**2 / (2.0 * m) + swing * math.sin(omega * t)
                return np.array([x, rate * t**2 / (2.0 * m) + constant * t / m + swing * omega * math.cos(omega * t)])
            swing = amplitude / (stiffness - m * omega**2)
            x = (rate * t + constant) / stiffness + swing * math.sin(omega * t)
            return np.array([x, rate / stiffness + swing * omega * math.cos(omega * t)])

        x, v = np.array([x0, v0]) - forced(t0)

        def motion(t: float) -> np.ndarray:
            turn = w * (t - t0)
            if stiffness == 0.0:
                free = np.array([x + v * (t - t0), v])
            else:
                free = np.array(
                    [x * math.cos(turn) + v / w * math.sin(turn), v * math.cos(turn) - x * w * math.sin(turn)]
                )
            return forced(t) + free

        return motion

    def left(self, motion: Callable[[float], np.ndarray], slip: int, anchor: float, t: float) -> float:
        """Return a function of time whose zero is the next slip or stick of the block."""
        x, v = motion(t)
        return slip * v if slip else self.static - abs(self.grip * (x - anchor))

    def run(self, times: np.ndarray) -> tuple[np.ndarray, list[float]]:
        """Return x and v at the given times, shape (n, 2), and the times at which the block begins to slip or stick."""
        rows, switches = [], []
        t, state, anchor, slip = 0.0, np.zeros(2), 0.0, 0
        while len(rows) < len(times):
            if slip == 0:
                motion = self.phase(t, *state, self.spring + self.grip, self.grip * anchor)
            else:
                motion = self.phase(t, *state, self.spring, -slip * self.kinetic)
            left = partial(self.left, motion, slip, anchor)
            step, at = 2e-5, t + 1e-9
            while left(at + step) > 0.0 and at < times[-1]:
                at += step
            end = brentq(left, at, at + step, xtol=1e-15) if at < times[-1] else math.inf
            while len(rows) < len(times) and times[len(rows)] <= end:
                rows.append(motion(times[len(rows)]))
            if end == math.inf:
                break
            t, state = end, motion(end)
            switches.append(end)
            if slip == 0:
                slip = 1 if state[0] > anchor else -1
            else:
                anchor, slip = state[0] - slip * self.kinetic / self.grip, 0
        return np.array(rows), switches


def test_a_block_pulled_back_and_forth_sticks_and_slips_as_in_closed_form() -> None:
    """The load exceeds mu N periodically.

    The block slips as long as the load exceeds mu N, and is held elastically otherwise.
    """
    normal, amplitude, omega = MASS * G, 1.6 * MU * MASS * G, 12.0
    friction = Friction(MU, stick_stiffness_n_m=GRIP)
    scene = replace(block(0.0, 0.0), friction=friction, loads=(Harmonic("pull", (amplitude, 0.0), omega_rad_s=omega),))
    result = simulate(scene, 1.5, output_dt=0.01, tol=1e-11, energy_balance=True)
    slider = Slider(MASS, 0.0, 2.0 * GRIP, MU * normal, MU * normal, (0.0, amplitude, omega))
    expected, switches = slider.run(result.t)
    assert len(switches) > 8
    assert np.abs(result.q[:, 0] - expected[:, 0]).max() < 1e-9 * np.abs(expected[:, 0]).max()


def belt(speed: float) -> tuple[Scene, Slider]:
    """Return a block on a moving belt, in the frame of the belt: four corners clamp it, and moving springs hold it.

    At first, the springs move like a slow sine. The damping has no effect on the motion; with it, the kernels of other
    tests are used.
    """
    stiffness, deep, wide, static, kinetic, omega = 1e6, 1e-3, 0.02, 0.5, 0.3, 0.05
    friction = Friction(kinetic, stick_stiffness_n_m=1e7, static_coefficient=static)
    # the four side pairs act as a spring: both walls remain penetrated, which gives a force of 4 K x. The friction of
    # these pairs acts along y, in which nothing moves.
    pull = 4.0 * stiffness * speed
    scene = Scene(
        Head(MASS, FIRM), Frame(0.3, 0.3), Clearance(-2.0 * wide, -2.0 * deep),
        Contact("kelvin_voigt", stiffness, damping=1e-6), Gravity(0.0), (Harmonic("belt", (pull / omega, 0.0), omega),),
        friction=friction,
    )  # fmt: skip
    normal = 4.0 * stiffness * deep
    return scene, Slider(MASS, 4.0 * stiffness, 4e7, static * normal, kinetic * normal, (0.0, pull / omega, omega))


def test_a_block_on_a_moving_belt_keeps_sticking_and_slipping() -> None:
    speed, seconds = 2e-3, 2.0
    scene, slider = belt(speed)
    result = simulate(scene, seconds, output_dt=0.01, tol=1e-11, energy_balance=True)
    expected, switches = slider.run(result.t)
    assert len(switches) >= 10
    assert np.abs(result.q[:, 0] - expected[:, 0]).max() < 1e-9


def test_a_load_below_the_limit_is_held_without_creep() -> None:
    """Under a load of up to 0.9 mu N back and forth, the displacement is F / k, without creep in 20 periods."""
    amplitude, omega = 0.9 * MU * MASS * G, 2.0 * math.pi
    load = Harmonic("pull", (amplitude, 0.0), omega_rad_s=omega)
    scene = replace(block(0.0, 0.0), friction=HELD, loads=(load,))
    result = simulate(scene, 20.0, output_dt=0.05, tol=1e-10, energy_balance=True)
    settled = result.t > 1.0
    # the motion is a forced oscillation far below the natural frequency of the grip
    stiffness, lag = 2.0 * GRIP - MASS * omega**2, 2.0 * HELD_DAMPING * omega
    swing = amplitude / math.hypot(stiffness, lag)
    expected = swing * np.sin(omega * result.t - math.atan2(lag, stiffness))
    assert result.q[settled, 0] == pytest.approx(expected[settled], abs=1e-9 * swing)
    creeping = simulate(block(amplitude, 0.0), 0.5, output_dt=0.5)
    assert creeping.q[-1, 0] > 1000.0 * swing


# this test compiles additional kernels; in the quick run, `test_a_corner_sticks_at_its_touch_as_with_fixed_steps`
# replaces it
@pytest.mark.stress
@pytest.mark.parametrize("name", ["paper", "bench_hc"])
def test_fixed_steps_give_the_same_motion_and_the_energy_balances(name: str) -> None:
    friction = Friction(0.3, stick_stiffness_n_m=5e7, stick_damping_n_s_m=1e5, static_coefficient=0.3)
    scene = replace(preset(name), friction=friction)
    events = simulate(scene, 1.0, output_dt=0.1, energy_balance=True)
    steps = simulate(scene, 1.0, output_dt=0.1, method="rk4", dt=2e-6)
    assert pose_error(scene, steps.q, events.q) < 3e-6
    assert events.energy_balance is not None and events.energy_balance.relative_imbalance < 1e-11
    loose = simulate(scene, 1.0, output_dt=0.1, tol=1e-5, energy_balance=True)
    assert pose_error(scene, loose.q, events.q) < 1e-4


#: A contact with the damping and the exponent of `held_scene`, whose kernels have implicit steps.
HYSTERETIC = Contact("exact_restitution", 1.6e10, 1.5, restitution=0.5)


# implicit steps with the block's own law compile kernels of their own
@pytest.mark.parametrize(
    ("contact", "damping"),
    [
        pytest.param(HYSTERETIC, 1e8, id="hysteretic"),
        *(pytest.param(block(0.0, 0.0).contact, damping, marks=pytest.mark.stress) for damping in (1e10, 1e7)),
    ],
)
def test_strong_dampers_meet_the_tolerance(contact: Contact, damping: float) -> None:
    """A grip with a damper that is far stronger than its spring needs implicit steps."""
    friction = Friction(MU, stick_stiffness_n_m=GRIP, stick_damping_n_s_m=damping)
    push, omega = 1.3 * MU * MASS * G, 9.0
    load = Harmonic("pull", (push, 0.0), omega_rad_s=omega)
    scene = replace(block(0.0, 0.0), contact=contact, friction=friction, loads=(load,))
    tight = simulate(scene, 1.0, output_dt=0.05, tol=1e-12)
    loose = simulate(scene, 1.0, output_dt=0.05, tol=1e-5)
    assert pose_error(scene, loose.q, tight.q) < 1e-4 and loose.solver["steps"] < 3000


def test_rounding_does_not_decide_whether_a_corner_sticks_at_its_touch() -> None:
    """The Kelvin-Voigt force exists from the touch on, so a grip without tension sticks."""
    scene = replace(preset("bench_kv"), friction=Friction(0.3, stick_stiffness_n_m=5e7))
    loose, tight = (simulate(scene, 1.0, output_dt=0.1, tol=tol, energy_balance=True) for tol in (1e-6, 1e-10))
    assert pose_error(scene, loose.q, tight.q) < 1e-8


def test_rounding_does_not_decide_whether_a_clipped_corner_sticks() -> None:
    """The force of the corner begins at zero. With mu_s > mu, both stick and slip are then possible."""
    friction = Friction(0.2, stick_stiffness_n_m=1e8, static_coefficient=0.28)
    scene = replace(
        preset("bench_kv"), contact=Contact("kelvin_voigt", 2.6e9, damping=1e7), friction=friction,
        initial=Initial((0.005, -0.0002, 0.018), (0.12, 0.48, -0.6)),
    )  # fmt: skip
    tight = simulate(scene, 1.0, output_dt=0.01, tol=1e-12, energy_balance=True)
    for tol in (1e-8, 1e-9, 1e-10):
        assert pose_error(scene, simulate(scene, 1.0, output_dt=0.01, tol=tol, energy_balance=True).q, tight.q) < tol


@pytest.mark.parametrize("damping", [1e5, 1e6])
def test_a_corner_sticks_at_its_touch_as_with_fixed_steps(damping: float) -> None:
    """The Kelvin-Voigt force exists from the touch on.

    The corner sticks from the touch on, or slips if its damper is too strong.
    """
    friction = Friction(0.3, stick_stiffness_n_m=5e7, stick_damping_n_s_m=damping)
    scene = replace(preset("bench_kv"), friction=friction)
    events = simulate(scene, 0.3, output_dt=0.1, energy_balance=True)
    steps = simulate(scene, 0.3, output_dt=0.1, method="rk4", dt=4e-6)
    assert pose_error(scene, steps.q, events.q) < 3e-5
    assert events.energy_balance is not None and events.energy_balance.relative_imbalance < 1e-11


def test_painleves_case_is_an_impact_without_collision() -> None:
    """The friction of the corner presses it into the wall. The force grows as cosh and stops the slip."""
    mass, inertia, stiffness, mu = 1.0, 0.002, 1e8, 0.5
    scene = Scene(
        Head(mass, inertia), Frame(0.1, 0.6), Clearance(0.1, 0.1), Contact("kelvin_voigt", stiffness, damping=1e-3),
        Gravity(0.0), (Harmonic("nothing to speak of", (1e-9, 0.0), 2.0),),
        initial=Initial((0.0, -0.05, 0.0)), pairs=("top_right_top",),
        friction=Friction(mu, stick_stiffness_n_m=stiffness),
    )  # fmt: skip
    pair = 2
    assert painleve_coefficients(scene)[pair] == pytest.approx((inertia / mass + 0.05**2) / (0.05 * 0.3))
    for speed, jams in ((-1.0, True), (1.0, False)):
        moving = replace(scene, initial=Initial((0.0, -0.05, 0.0), (speed, -1e-3, 0.0)))
        result = simulate(moving, 0.01, output_dt=1e-6, tol=1e-10, energy_balance=True)
        assert result.energy_balance is not None and result.energy_balance.relative_imbalance < 1e-8
        p = 1.0 / mass + 0.05**2 / inertia - (1.0 if jams else -1.0) * mu * 0.05 * 0.3 / inertia
        assert (p < 0.0) == jams
        # the corner obeys d'' = -p N while it slips
        rate, t = math.sqrt(abs(p) * stiffness), result.t[1:40]
        expected = stiffness * 1e-3 / rate * (np.sinh(rate * t) if jams else np.sin(rate * t))
        assert result.force[1:40, pair] == pytest.approx(expected, rel=0.02)
        # a corner that jams rebounds far faster than it arrived; otherwise, its speed is only reversed
        assert (result.v[-1, 1] > 0.1) == jams and (result.statistics["top_right_top"]["max"] > 1e3) == jams
        assert result.force[-1, pair] == 0.0


# in the quick run, `test_solve_rounded` restores a twin with stick
@pytest.mark.stress
@pytest.mark.parametrize("most", [None, 2000])
def test_a_restored_twin_a_batch_and_a_limited_twin_have_the_same_motion(most: int | None) -> None:
    scene = replace(preset("paper"), friction=Friction(0.3, stick_stiffness_n_m=5e7, stick_damping_n_s_m=1e5))
    times = np.linspace(0.01, 0.4, 23)
    loads = np.stack([4e4 * np.sin(20.0 * times), -1e4 * np.cos(9.0 * times), 2e4 * np.sin(7.0 * times)], axis=1)
    twin, other, bounded = (Twin(scene, excitation="sampled", max_evaluations=limit) for limit in (None, None, most))
    batch = TwinBatch([scene, scene])
    for t, load in zip(times, loads, strict=True):
        row = twin.advance(t, load)
        assert row.status.name == "OK"
        assert np.array_equal(batch.advance(t, load).q[1, 0], row.q)
        assert np.array_equal(other.advance(t, load).q, row.q)
        other.restore(twin.snapshot())
        assert bounded.advance(t, load).q == pytest.approx(row.q, abs=1e-6)


def test_moving_a_twin_that_sticks_to_its_own_pose_keeps_its_friction() -> None:
    scene = replace(preset("paper"), friction=Friction(0.1, stick_stiffness_n_m=5e6), loads=())
    twins, alone = TwinBatch([scene] * 2, tol=1e-9), Twin(scene, tol=1e-9, excitation="sampled")
    for index in range(1, 400):
        wrench = np.array([2e4 * np.sin(0.03 * index), 0.0, 1e4])
        row, one = twins.advance(1e-3 * index, wrench), alone.advance(1e-3 * index, wrench)
        twins.move([1], row.q[1], row.v[1])
        alone.move(one.q, one.v)
    assert np.allclose(row.q[0], row.q[1], atol=1e-8) and np.allclose(row.q[0], one.q, atol=1e-8)
    assert np.allclose(row.force[0], row.force[1], rtol=1e-4, atol=1.0)


def test_a_batch_of_heads_that_stick_and_heads_that_do_not_is_refused() -> None:
    scene = replace(preset("paper"), friction=Friction(0.3, stick_stiffness_n_m=5e7))
    with pytest.raises(ValueError, match="friction with stick in all or in none"):
        TwinBatch([scene, preset("paper")])


def test_a_scene_without_stick_compiles_no_stick() -> None:
    for friction in (None, Friction(0.2), Friction(0.0, stick_stiffness_n_m=1e8)):
        compiled = compiled_scene.compile_scene(replace(preset("paper"), friction=friction), 1e-9)
        assert compiled.parts.terms.stick is None and compiled.initial_state().dtype == STATE


def test_contradictory_friction_is_refused() -> None:
    for friction, problem in (
        (Friction(0.3, stick_damping_n_s_m=1.0), "stick_damping_n_s_m: got 1.0, expected no value without"),
        (Friction(0.3, stick_stiffness_n_m=1e8, static_coefficient=0.2), "at least the coefficient 0.3"),
        (Friction(0.0, stick_stiffness_n_m=1e8, static_coefficient=0.2), "got 0.2, expected no value, or 0, with"),
        (Friction(0.3, stick_stiffness_n_m=0.0), "stick_stiffness_n_m: got 0.0, expected a finite number > 0"),
    ):
        with pytest.raises(SceneError, match=problem):
            replace(preset("paper"), friction=friction)


def held_scene(law: str, seed: int) -> Scene:
    """Return a random head, light or heavy, with soft or stiff grips, which a moderate load moves along its walls."""
    random = np.random.default_rng(seed)

    def decades(low: float, high: float) -> float:
        return float(10.0 ** random.uniform(math.log10(low), math.log10(high)))

    def spread(*scale: float) -> tuple[float, ...]:
        return tuple(random.uniform(-1.0, 1.0, len(scale)) * scale)

    mass, size, share = decades(10.0, 1e4), decades(0.1, 1.0), decades(1e-3, 1.0)
    weight, depth, mu = mass * G, size * decades(1e-6, 1e-3), random.uniform(0.05, 0.8)
    stiffness = weight / depth
    if law == "kelvin_voigt":
        contact = Contact(law, stiffness, damping=2.0 * share * math.sqrt(stiffness * mass))
    else:
        exponent = 1.5 if law == "hertz" else 1.0
        contact = Contact(
            "exact_restitution", weight / depth**exponent, exponent, restitution=random.uniform(0.05, 0.95)
        )
    grip = stiffness * decades(0.1, 3.0)
    damping = random.choice([0.0, 2.0]) * decades(1e-2, 1.0) * math.sqrt(grip * mass)
    friction = Friction(
        mu, stick_stiffness_n_m=grip, stick_damping_n_s_m=float(damping) or None,
        static_coefficient=mu * float(random.choice([1.0, 1.3])),
    )  # fmt: skip
    gaps = size * decades(1e-3, 0.6), size * decades(1e-3, 0.6)
    force = weight * decades(0.05, 2.0)
    pull = spread(force, force)
    load = Harmonic(
        "pull", (pull[0], pull[1]), decades(1.0, 60.0), random.uniform(0.0, 6.28), *spread(0.3 * force * size)
    )
    return Scene(
        Head(mass, mass * size**2 * decades(0.05, 1.0)), Frame(size, size * random.uniform(0.5, 1.0)), Clearance(*gaps),
        contact, Gravity(G), (load,),
        initial=Initial(spread(0.3 * gaps[0], 0.3 * gaps[1], 0.2 * min(gaps) / size), spread(0.1, 0.1, 0.1 / size)),
        friction=friction,
    )  # fmt: skip


def furthest_off(scene: Scene, tolerances: tuple[float, ...]) -> float:
    """Return the largest error, in tolerances, relative to a more accurate run. The work of the runs is limited."""
    tight = simulate(scene, 1.0, output_dt=0.01, tol=1e-12, max_steps=100_000)
    runs = [(tol, simulate(scene, 1.0, output_dt=0.01, tol=tol, max_steps=100_000)) for tol in tolerances]
    return max(pose_error(scene, run.q, tight.q) / tol for tol, run in runs)


@pytest.mark.parametrize(
    ("law", "seed"),
    [
        ("hertz", 8),
        pytest.param("hertz", 47, marks=pytest.mark.stress),
        ("hertz", 81),
        ("hertz", 178),
        pytest.param("kelvin_voigt", 57, marks=pytest.mark.stress),
        pytest.param("exact_restitution", 237, marks=pytest.mark.stress),
    ],
)
def test_even_a_tiny_force_decides_whether_a_corner_sticks(law: str, seed: int) -> None:
    """A step that controls only the error of the motion would release sticking corners and move their anchors."""
    assert furthest_off(held_scene(law, seed), (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)) < 10.0


@pytest.mark.parametrize("seed", [6, 17])
def test_a_soft_tangential_spring_at_a_tight_tolerance_stays_finite(seed: int) -> None:
    """The corner must not cross the release penetration faster than the series can resolve."""
    scene = held_scene("hertz", seed)
    assert scene.friction is not None
    scene = replace(scene, friction=replace(scene.friction, stick_stiffness_n_m=1e8, stick_damping_n_s_m=None))
    tight, other = (simulate(scene, 1.0, output_dt=0.01, tol=tol) for tol in (1e-12, 1e-8))
    assert pose_error(scene, other.q, tight.q) < 1e-7


@pytest.mark.stress
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("law", ["kelvin_voigt", "exact_restitution", "hertz"])
def test_random_scenes_without_amplification_meet_the_tolerance(law: str) -> None:
    """In these scenes, a displacement grows by less than a factor of 1e4."""
    checked = 0
    for seed in range(200):
        scene = held_scene(law, seed)
        if furthest_off(scene, (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)) < 10.0:
            checked += 1
            continue
        with pytest.warns(ToleranceWarning):
            sensitivity = simulate(scene, 1.0, sensitivity=True).sensitivity
        assert sensitivity is not None and not sensitivity.trusted, seed
    assert checked > 100
