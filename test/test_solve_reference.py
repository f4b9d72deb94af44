"""Trajectories compared with extended-precision references by another method, and with fixed-step RK4."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes import pose_error, preset, reference
from scipy.integrate import trapezoid

from plow_twin import Clearance, Constant, Contact, Frame, Gravity, Harmonic, Head, Initial, Scene, Table, simulate


@pytest.mark.parametrize(
    ("name", "tol", "bound"), [("paper", 1e-9, 1e-9), ("bench_kv", 1e-9, 1e-9), ("bench_hc", 1e-12, 1e-8)]
)
def test_trajectory_and_every_event_match_the_reference(name: str, tol: float, bound: float) -> None:
    scene, expected = preset(name), reference("paper_r1" if name == "paper" else name)
    result = simulate(scene, 20.0, output_dt=0.01, tol=tol)
    assert pose_error(scene, result.q, expected["q"]) < bound
    assert len(result.events) == len(expected["event_time"])
    for field, key in (("pair", "event_pair"), ("mode_from", "event_from"), ("mode_to", "event_to")):
        assert (result.events[field] == expected[key]).all()
    assert result.events["time"] == pytest.approx(expected["event_time"], abs=10 * bound)
    assert result.events["rate"] == pytest.approx(expected["event_rate"], abs=100 * bound)


@pytest.mark.parametrize("name", ["paper", "bench_kv"])
def test_a_tighter_tolerance_gives_a_smaller_error_within_the_tolerance(name: str) -> None:
    scene, expected = preset(name), reference("paper_r1" if name == "paper" else name)
    for tol in (1e-4, 1e-6, 1e-8, 1e-10):
        assert pose_error(scene, simulate(scene, 20.0, output_dt=0.1, tol=tol).q, expected["q"][::10]) < tol


def test_reconstruction_r1_gives_the_published_table() -> None:
    """The figures are those of R1 over 60 s. The paper states 153 and 74 kN at a, and 177 and 82 kN at b."""
    result = simulate(preset("paper"), 60.0)
    ccw = {"a": "bottom_right_bottom", "b": "top_right_right", "c": "top_left_top", "d": "bottom_left_left"}
    cw = {"a": "bottom_right_right", "b": "top_right_top", "c": "top_left_left", "d": "bottom_left_bottom"}
    table = result.statistics
    assert table[ccw["a"]]["max"] == pytest.approx(147.60e3, abs=5.0)
    assert table[ccw["a"]]["mean_in_contact"] == pytest.approx(74.99e3, abs=5.0)
    assert table[cw["b"]]["max"] == pytest.approx(183.25e3, abs=5.0)
    assert table[cw["b"]]["mean_in_contact"] == pytest.approx(90.24e3, abs=5.0)
    assert [round(table[name]["max"] / 1e3) for name in ccw.values()] == [148, 127, 155, 102]
    assert [round(table[name]["max"] / 1e3) for name in cw.values()] == [107, 183, 141, 156]
    assert result.contact_sets["ccw"]["abcd"] == pytest.approx(0.67, abs=0.005)
    assert result.contact_sets["cw"]["abcd"] == pytest.approx(0.76, abs=0.005)
    assert result.contact_sets["cw"]["a"] > 0.0


def test_force_rows_and_statistics_describe_the_same_motion() -> None:
    result = simulate(preset("paper"), 20.0, output_dt=1e-3)
    for pair, row in enumerate(result.statistics.values()):
        sampled = result.force[:, pair]
        assert row["max"] >= sampled.max() and row["max"] == pytest.approx(sampled.max(), rel=2e-3)
        assert row["impulse"] == pytest.approx(trapezoid(sampled, result.t), rel=2e-3)
        assert row["time_in_contact"] == pytest.approx(1e-3 * (sampled > 0.0).sum(), abs=0.05)
        makes = (result.events["pair"] == pair) & (result.events["mode_from"] == 0)
        assert row["makes"] == makes.sum()


VARIANTS = {
    "two directions": (
        Harmonic("one", (3e4, 1e4), 2.0, 0.0, 2e4),
        Harmonic("two", (-5e3, 9e3), 5.0, 1.0, -4e3, (0.2, 0.1)),
        Constant("bias", (2e3, 0.0), 500.0),
    ),
    "table": (
        Table(
            "measured",
            np.array([0.0, 0.3, 0.4, 1.1]),
            1e4 * np.array([[1.0, 3, 1], [-4, 2, -1], [5, -1, 2], [0, 0, 0]]),
        ),
    ),
}


def test_a_fractional_exponent_meets_the_tolerance_at_slow_separations() -> None:
    """The slower a separation, the larger is the neglected force before it. Here, damping slows a thrown head."""
    scene = preset("bench_hc")
    contact = Contact("hunt_crossley", 3e9 * 1e-3**-1.2, 2.2, damping=3.0)
    scene = dataclasses.replace(scene, contact=contact, initial=Initial((0.0, 0.0, 0.0), (-1.1, 0.3, -6.0)))
    exact = simulate(scene, 3.0, output_dt=0.02, tol=1e-12)
    for tol in (1e-4, 1e-8):
        assert pose_error(scene, simulate(scene, 3.0, output_dt=0.02, tol=tol).q, exact.q) < 3.0 * tol


# each combination needs its own compiled kernels, so most combinations are in the full run only
@pytest.mark.parametrize(
    ("offset", "loads", "contact"),
    [
        pytest.param(
            (0.05, -0.08), (*VARIANTS["two directions"], *VARIANTS["table"]), (2e9, 2.0), id="offset, both loads"
        ),
        pytest.param((0.0, 0.0), VARIANTS["table"], (6e6, 1.0), id="centred, table", marks=pytest.mark.stress),
        pytest.param(
            (0.05, -0.08), VARIANTS["two directions"], (2e9, 2.0), id="offset, two directions", marks=pytest.mark.stress
        ),
        pytest.param(
            (0.0, 0.0), VARIANTS["two directions"], (2e9, 2.0), id="centred, two directions", marks=pytest.mark.stress
        ),
        pytest.param((0.05, -0.08), VARIANTS["table"], (2e9, 2.0), id="offset, table", marks=pytest.mark.stress),
    ],
)
def test_loads_and_offset_mass_agree_with_rk4_in_world_axes(
    offset: tuple[float, float], loads: tuple, contact: tuple[float, float]
) -> None:
    scene = Scene(
        Head(2000.0, 900.0, "consistent", offset),
        Frame(0.3, 0.25),
        Clearance(0.02, 0.03),
        Contact("hunt_crossley", *contact, damping=0.6),
        Gravity(9.81),
        loads,
        Initial((1e-3, -2e-3, 0.01), (0.1, 0.0, 0.2)),
    )
    events, rk4 = simulate(scene, 1.5, output_dt=0.1), simulate(scene, 1.5, output_dt=0.1, method="rk4", dt=2e-5)
    assert pose_error(scene, events.q, rk4.q) < 2e-6
    assert events.statistics["top_left_top"]["impulse"] == pytest.approx(
        rk4.statistics["top_left_top"]["impulse"], rel=1e-4
    )


@pytest.mark.parametrize("locked", [("x",), ("y",), ("theta",), ("x", "y")])
def test_locked_coordinates_stay_while_the_others_agree_with_rk4(locked: tuple[str, ...]) -> None:
    scene = dataclasses.replace(preset("paper"), locked=locked)
    events, rk4 = simulate(scene, 1.0, output_dt=0.1), simulate(scene, 1.0, output_dt=0.1, method="rk4", dt=2e-5)
    held = [name in locked for name in ("x", "y", "theta")]
    assert np.abs(events.q[:, held]).max() < 1e-10
    assert pose_error(scene, events.q, rk4.q) < 2e-6


@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.floats(0.005, 0.05), st.floats(0.005, 0.05), st.floats(6.8, 9.0), st.floats(0.2, 0.95),
    st.floats(1e3, 6e4), st.floats(-6e4, 6e4), st.floats(-5e4, 5e4), st.floats(0.5, 12.0),
)  # fmt: skip
def test_random_scenes_converge_to_one_motion(
    gx: float, gy: float, log_k: float, e: float, fx: float, fy: float, moment: float, omega: float
) -> None:
    """Runs with three tolerances agree pulse by pulse until impacts have amplified their differences."""
    scene = Scene(
        Head(2430.0, 1265.0), Frame(0.33, 0.27), Clearance(gx, gy),
        Contact("exact_restitution", 10.0**log_k, 1.0, restitution=e), Gravity(9.81), (Harmonic("f", (fx, fy), omega,
        0.0, moment),),
    )  # fmt: skip
    loose, tight = (simulate(scene, 1.0, output_dt=0.05, tol=tol) for tol in (1e-7, 1e-11))
    assert pose_error(scene, loose.q, tight.q) < 1e-4
    assert np.isfinite(tight.force).all() and (tight.force >= 0.0).all()


def test_output_times_do_not_change_a_bit() -> None:
    scene = preset("bench_hc")
    coarse, fine = simulate(scene, 3.0, output_dt=1.0), simulate(scene, 3.0, output_dt=1.0 / 1024)
    assert np.array_equal(coarse.q, fine.q[::1024])
    assert coarse.statistics == fine.statistics and coarse.solver == fine.solver


def test_all_events_are_logged_beyond_the_first_size_of_the_log() -> None:
    scene = preset("bench_kv")
    long = simulate(scene, 300.0, output_dt=100.0, tol=1e-5)
    assert len(long.events) > 4096
    assert (np.diff(long.events["time"]) >= 0.0).all()
    assert sum(row["makes"] for row in long.statistics.values()) == (long.events["mode_from"] == 0).sum()


@pytest.mark.parametrize(
    ("name", "dt", "bound"),
    [
        ("paper", 1e-4, 1e-5),
        pytest.param("bench_kv", 1e-5, 1e-3, marks=pytest.mark.stress),
        pytest.param("bench_hc", 1e-4, 1e-4, marks=pytest.mark.stress),
    ],
)
def test_fixed_step_rk4_agrees_with_the_reference_up_to_its_error(name: str, dt: float, bound: float) -> None:
    scene, expected = preset(name), reference("paper_r1" if name == "paper" else name)
    result = simulate(scene, 5.0, output_dt=0.01, method="rk4", dt=dt)
    assert pose_error(scene, result.q, expected["q"][:501]) < bound
    located = simulate(scene, 5.0, output_dt=0.01, tol=1e-10)
    assert result.force == pytest.approx(located.force, abs=2e3 * bound / 1e-5)


def test_the_last_row_of_a_fixed_step_run_has_the_stated_time() -> None:
    scene = preset("paper")
    uneven, even = (simulate(scene, 1.0, output_dt=dt, method="rk4", dt=1e-3) for dt in (0.3, 0.1))
    assert uneven.t[-1] == 1.0 and uneven.solver["steps"] == 1000
    assert np.array_equal(uneven.q[-1], even.q[-1]) and np.array_equal(uneven.q[1], even.q[3])
    with pytest.raises(ValueError, match=r"t_end: got 1\.0005, expected a whole multiple of dt"):
        simulate(scene, 1.0005, method="rk4", dt=1e-3)
