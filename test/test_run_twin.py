"""Advancing, saving and restoring give bit-identical results in all ways. Invalid input changes nothing."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import pose_error, preset, reference, wall_and_point

from plow_twin import Constant, Contact, SolverError, Status, Twin, Wear, simulate
from plow_twin.model.loads import compile_loads
from plow_twin.solve import loop
from plow_twin.solve.state import Terms

TIMES = np.arange(1, 3001) * 1e-3


def samples() -> np.ndarray:
    return compile_loads(preset("paper").loads).at(TIMES)


def test_sampled_at_1_khz_follows_the_analytic_motion() -> None:
    """Linear interpolation of the sine at 1 kHz has an error of (omega dt)^2 / 8 = 5e-7 of the load."""
    twin = Twin(preset("paper"), excitation="sampled")
    series = twin.advance_samples(TIMES, samples())
    assert (series.status == Status.OK).all()
    assert pose_error(twin.scene, series.q[9::10], reference("paper_r1")["q"][1:301]) < 1e-5
    exact = simulate(preset("paper"), 3.0)
    for pair, row in enumerate(exact.statistics.values()):
        assert series.peak[:, pair].max() == pytest.approx(row["max"], rel=1e-4)
        assert series.impulse[:, pair].sum() == pytest.approx(row["impulse"], rel=1e-4, abs=1e-9)
        assert series.makes[:, pair].sum() == row["makes"]


@pytest.mark.parametrize("name", ["paper", pytest.param("bench_hc", marks=pytest.mark.stress)])
def test_impulses_of_all_advances_agree_with_the_run(name: str) -> None:
    """In steps that begin at a touch, time is counted from the touch; with d^1.5, the series are in its root."""
    exact = simulate(preset(name), 2.0, tol=1e-9)
    expected = [row["impulse"] for row in exact.statistics.values()]
    for times in (TIMES[:2000], TIMES[1999:2000]):
        twin = Twin(preset(name), tol=1e-9)
        total = sum((twin.advance(t).impulse for t in times), np.zeros(8))
        assert total == pytest.approx(expected, rel=1e-8, abs=1e-9)


@settings(max_examples=10)
@given(st.lists(st.integers(1, 2999), max_size=6, unique=True))
def test_samples_in_any_batches_give_the_same_bits(cuts: list[int]) -> None:
    whole = Twin(preset("paper"), excitation="sampled")
    expected = whole.advance_samples(TIMES, samples())
    parts = Twin(preset("paper"), excitation="sampled")
    edges = [0, *sorted(cuts), len(TIMES)]
    rows = [parts.advance_samples(TIMES[a:b], samples()[a:b]) for a, b in itertools.pairwise(edges)]
    for name in ("q", "force", "peak", "impulse", "makes"):
        assert np.array_equal(np.concatenate([getattr(row, name) for row in rows]), getattr(expected, name))
    assert parts.digest() == whole.digest()
    single = Twin(preset("paper"), excitation="sampled")
    one_by_one = [single.advance(t, w) for t, w in zip(TIMES[:50], samples()[:50], strict=True)]
    assert np.array_equal([row.peak for row in one_by_one], expected.peak[:50])


def test_a_twin_can_be_advanced_twice_to_the_same_time() -> None:
    twin = Twin(preset("paper"))
    for t in np.random.default_rng(1).uniform(0.0, 2e-3, 500).cumsum():
        assert twin.advance(t).q.tolist() == twin.advance(t).q.tolist()
        assert twin.time == t


@settings(max_examples=10)
@given(st.lists(st.floats(0.0, 2.0), max_size=20))
def test_intermediate_advances_do_not_change_the_motion(times: list[float]) -> None:
    stepped, direct = Twin(preset("paper")), Twin(preset("paper"))
    rows = [stepped.advance(t) for t in sorted(times)]
    last, expected = stepped.advance(2.0), direct.advance(2.0)
    assert np.array_equal(last.q, expected.q) and np.array_equal(last.force, expected.force)
    assert stepped.digest() == direct.digest()
    impulse = sum((row.impulse for row in rows), last.impulse)
    assert impulse == pytest.approx(expected.impulse, rel=1e-10, abs=1e-9)
    assert np.max([row.peak for row in [*rows, last]], axis=0) == pytest.approx(expected.peak, rel=1e-10)


@pytest.mark.parametrize("excitation", ["scene", "sampled"])
def test_a_restored_twin_continues_with_the_same_bits(excitation: str) -> None:
    # wear under the scene's own loads would compile kernels of its own
    wear = Wear(1e-12, 0.015, 2.0) if excitation == "sampled" else None
    scene = dataclasses.replace(preset("paper"), wear=wear)
    first, second = (Twin(scene, excitation=excitation) for _ in range(2))  # type: ignore[arg-type]

    def go(twin: Twin, t: float) -> np.ndarray:
        return twin.advance(t, None if excitation == "scene" else np.array([4e4, 1.1e4, 3e4]) * np.sin(2 * t)).q

    for t in (0.31, 0.77, 1.03):
        go(first, t)
    first.set_travel_speed(1.5)
    go(first, 1.21)
    second.restore(first.snapshot())
    assert second.digest() == first.digest() and second.time == first.time
    assert np.array_equal(go(first, 2.5), go(second, 2.5))
    assert second.digest() == first.digest()
    second.reset(3.0)
    assert second.time == 3.0 and second.digest() != first.digest()


@pytest.mark.parametrize(
    ("t", "wrench", "words"),
    [
        (0.1, (0.0, 0.0, 0.0), "expected a time not before"),
        (np.nan, (0.0, 0.0, 0.0), "expected finite times"),
        (np.inf, (0.0, 0.0, 0.0), "expected finite times"),
        (1.0, (0.0, np.nan, 0.0), "wrench: got"),
        (1.0, (0.0, 0.0), "wrench: got"),
    ],
)
def test_bad_input_is_named_and_changes_nothing(t: float, wrench: tuple[float, ...], words: str) -> None:
    twin = Twin(preset("paper"), excitation="sampled")
    twin.advance(0.5, (1e3, 2e3, 3e3))
    before = twin.digest()
    with pytest.raises(ValueError, match=words):
        twin.advance(t, wrench)
    assert twin.digest() == before


@pytest.mark.parametrize("wrench", [(0.0, 0.0, 1e7), (1e12, 0.0, 0.0), (1e300, 0.0, 0.0)])
def test_after_a_failed_advance_the_twin_continues_from_its_last_good_state(wrench: tuple[float, ...]) -> None:
    twin = Twin(preset("paper"), excitation="sampled")
    good = twin.advance(0.5, (0.0, 0.0, 0.0))
    bad = twin.advance(0.6, wrench)
    assert bad.status in (Status.OUT_OF_RANGE, Status.NON_FINITE) and len(bad.status.text) > 10
    for name in ("q", "v", "penetration", "force", "wear_depth"):
        assert np.array_equal(getattr(bad, name), getattr(good, name)), name
    assert not bad.impulse.any() and not bad.makes.any() and twin.time == 0.6
    assert twin.advance(0.6, (0.0, 0.0, 0.0)).status is Status.OK
    after = twin.advance(0.7, (0.0, 0.0, 0.0))
    assert after.status is Status.OK and abs(after.q - good.q).max() < 0.05


@pytest.mark.stress  # this test compiles an additional kernel
@pytest.mark.parametrize("depth", [0.2, 1.3])
def test_a_failed_advance_leaves_no_trace_in_later_advances(depth: float) -> None:
    """The advance fails after the end of the ramp. The impact continues as if the advance had not been attempted."""
    ramp, idle = 1e-3, (0.0, 0.0, 0.0)
    contact = Contact("ramped_damping", 1e6, exponent=1.5, damping=2e3, ramp_m=ramp)
    twins = [Twin(wall_and_point(contact, speed=1.0), excitation="sampled") for _ in range(2)]
    t, dt = 0.0, 1e-5
    while twins[0].advance(t, idle).penetration[0] < depth * ramp:
        twins[1].advance(t, idle)
        t += dt
    twins[1].advance(t, idle)
    assert twins[1].advance(t + 0.1, (0.0, -1e6, 0.0)).status is Status.OUT_OF_RANGE
    assert twins[1].advance(t + 0.1, idle).status is Status.OK
    # a step ends at the failure, so the two motions are equal only up to rounding errors
    expected, after = twins[0].advance(t + 0.01, idle), twins[1].advance(t + 0.11, idle)
    assert after.q == pytest.approx(expected.q, abs=1e-13) and after.v == pytest.approx(expected.v, rel=1e-9)


def test_a_pose_outside_the_range_is_never_returned_as_valid() -> None:
    """A step that ends at the requested time is checked too."""
    for dt in (1e-3, 7e-4):
        twin = Twin(preset("paper"), excitation="sampled")
        rows = [twin.advance(k * dt, (0.0, 0.0, 1e6)) for k in range(1, 100)]
        assert any(row.status is Status.OUT_OF_RANGE for row in rows)
        assert all(abs(row.q[2]) <= np.pi / 4 for row in rows)
    loads = (*preset("paper").loads, Constant("turn", (0.0, 0.0), 1e6))
    analytic = Twin(dataclasses.replace(preset("paper"), loads=loads))
    for t in np.linspace(0.0, 0.1, 57):
        assert abs(analytic.advance(t).q[2]) <= np.pi / 4
    with pytest.raises(SolverError, match=r"left the model's range: the head turned to 4[5-9]"):
        simulate(analytic.scene, 0.0465)


def test_a_scene_compiles_only_its_own_terms() -> None:
    """Terms that a scene does not have are None in the compiled signature of the step."""
    twin = Twin(wall_and_point(preset("bench_kv").contact, speed=1.0))
    twin.advance(0.01)
    compiled = [str(signature[1]) for signature in loop.advance_rows.signatures]  # type: ignore[attr-defined]
    there = {"viscous", "free", "rest"}
    terms = f"Terms({', '.join('int64' if name in there else 'none' for name in Terms._fields)})"
    bare = f"Parts({terms}, none, none, none)"
    assert bare in compiled, compiled


def test_in_free_flight_no_contact_code_runs() -> None:
    scene = wall_and_point(preset("bench_kv").contact, speed=0.0, gap=2.0)
    twin = Twin(scene)
    twin.advance(3600.0)
    assert twin.steps <= 80 and twin._work.force.any() == False  # noqa: E712


def test_the_rate_of_a_locked_degree_of_freedom_is_zero() -> None:
    """In head axes, the rate of a locked x is a difference that rounding makes nonzero."""
    twin = Twin(dataclasses.replace(preset("paper"), locked=("x",)), excitation="sampled")
    digests = []
    for rate in (8e-16, 0.0):
        twin.reset(1.0, pose=((0.001, 0.002, 0.003), (rate, -0.03, -0.2)))
        digests.append(twin.digest())
        twin.move((0.001, 0.002, 0.003), (rate, -0.03, -0.2))
        digests.append(twin.digest())
    assert len(set(digests)) == 1


def test_warm_up_leaves_nothing_to_compile() -> None:
    # no other test of this file uses these kernels; `test_solve_wear` does
    wear = Wear(1e-12, 0.015, 2.0, sliding="total", running_in_ratio=4.0, running_in_depth_m=2e-5)
    twin = Twin(dataclasses.replace(preset("paper"), wear=wear), excitation="sampled")
    twin.warm_up()
    before = [len(kernel.signatures) for kernel in (loop.advance_rows, loop.interrupt_step, loop.lay_out_again)]
    assert min(before) > 0 and twin.time == 0.0
    twin.advance(0.01, np.zeros(3))
    twin.set_travel_speed(1.0)
    twin.advance(0.02, np.zeros(3))
    twin.restore(twin.snapshot())
    assert [len(kernel.signatures) for kernel in (loop.advance_rows, loop.interrupt_step, loop.lay_out_again)] == before


def test_the_limit_of_evaluations_is_kept_and_the_error_estimated() -> None:
    scene, t = preset("bench_kv"), np.arange(1, 4001) * 1e-3
    wrench = compile_loads(scene.loads).at(t)
    exact = Twin(scene, excitation="sampled").advance_samples(t, wrench)
    for bound in (16, 64, 400):
        twin = Twin(scene, excitation="sampled", max_evaluations=bound)
        before, most = 0, 0
        for row in range(len(t)):
            advance = twin.advance(t[row], wrench[row])
            used = twin.evaluations - before
            before, most = twin.evaluations, max(most, used)
            assert advance.status is Status.OK
        assert most <= bound
        series = Twin(scene, excitation="sampled", max_evaluations=bound).advance_samples(t, wrench)
        error, estimate = np.abs(series.q - exact.q).max(), series.error_estimate_m.sum()
        # the kernel of `exact` has no error bound, so a motion without bounded steps equals it only up to rounding
        # errors
        assert (twin.bounded == 0) == (estimate == 0.0) == (error < 1e-14)
        assert error <= 10.0 * estimate and error < 1e-4
    assert twin.bounded == 0
    with pytest.raises(ValueError, match="max_evaluations: got 15, expected an integer >= 16"):
        Twin(scene, max_evaluations=15)
