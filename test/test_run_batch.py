"""Many twins in one call: each twin equals its single run in numbers, snapshots and errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import preset
from test_solve_rest import fallen

from plow_twin import Clearance, Friction, Head, Scene, Twin, TwinBatch, Wear
from plow_twin.model.loads import compile_loads

TIMES = np.arange(1, 401) * 1e-3
FIELDS = ("q", "v", "penetration", "rate", "force", "peak", "impulse", "makes", "wear_depth", "steps", "status")


def members() -> list[Scene]:
    """Return scenes that differ in clearance, stiffness, damping, mass and initial pose."""
    scene, rng = preset("bench_kv"), np.random.default_rng(5)
    scenes = []
    for _ in range(9):
        gaps = dataclasses.replace(scene.clearance, horizontal_m=rng.uniform(0.02, 0.03))
        contact = dataclasses.replace(scene.contact, stiffness=rng.uniform(1e7, 4e7), damping=rng.uniform(3e4, 9e4))
        head = Head(rng.uniform(2000.0, 3000.0), rng.uniform(1000.0, 1500.0))
        initial = dataclasses.replace(scene.initial, q=tuple(rng.uniform(-2e-3, 2e-3, 3)))
        scenes.append(dataclasses.replace(scene, clearance=gaps, contact=contact, head=head, initial=initial))
    return scenes


def samples(count: int) -> np.ndarray:
    wrench = compile_loads(preset("bench_kv").loads).at(TIMES)
    return wrench * np.linspace(0.8, 1.2, count)[:, None, None]


def in_lanes() -> dict[str, list[Scene]]:
    """Return scenes for the eight lanes of a SIMD vector, by the form of their contact law."""
    laws = {
        "C d'": {},
        "lambda d'": {"law": "hunt_crossley", "damping": 0.7},
        "D / v0": {"law": "exact_restitution", "damping": None, "restitution": 0.4},
        "d^1.5": {"law": "hunt_crossley", "damping": 0.7, "exponent": 1.5, "stiffness": 1e8},
        "d^2": {"law": "hertz", "damping": None, "exponent": 2.0, "stiffness": 1e9},
    }
    scenes = {
        name: [dataclasses.replace(one, contact=dataclasses.replace(one.contact, **law)) for one in members()]
        for name, law in laws.items()
    }
    # with the kernels of `test_estimate_follow`
    rubbing = zip(scenes["lambda d'"], np.linspace(0.05, 0.5, 9), strict=True)
    return scenes | {"friction": [dataclasses.replace(one, friction=Friction(mu, 0.02)) for one, mu in rubbing]}


@pytest.mark.parametrize("workers", [1, 2])
def test_a_member_outside_the_lanes_has_the_bits_of_its_single_run(workers: int) -> None:
    paper, wear = preset("paper").contact, Wear(1e-9, 0.015, 2.0)
    scenes = [dataclasses.replace(one, contact=paper, wear=wear) for one in members()]
    wrench = samples(len(scenes))
    together = TwinBatch(scenes, tol=1e-7, workers=workers).advance_samples(TIMES, wrench)
    assert len(together) == len(scenes)
    for index, scene in enumerate(scenes):
        alone = Twin(scene, tol=1e-7, excitation="sampled").advance_samples(TIMES, wrench[index])
        for name in FIELDS:
            assert np.array_equal(getattr(together[index], name), getattr(alone, name)), (index, name)
    assert together.makes.sum() > 0


# the other forms need additional compiled kernels
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, marks=() if law in ("C d'", "lambda d'", "d^1.5", "friction") else pytest.mark.stress)
        for law in in_lanes()
    ],
)
def test_a_member_in_lanes_has_its_own_bits_and_the_motion_of_a_twin(law: str) -> None:
    scenes = in_lanes()[law]
    # pauses, jumps and short intervals need series of low and of high order
    times = np.concatenate([TIMES[:250], TIMES[250:] + 0.2, [0.7, 0.7]])
    wrench = np.concatenate([samples(len(scenes)), samples(len(scenes))[:, :2]], axis=1)
    together = TwinBatch(scenes, tol=1e-9).advance_samples(times, wrench)
    shared = TwinBatch(scenes[::-1], tol=1e-9, workers=2).advance_samples(times, wrench[::-1])
    for index, scene in enumerate(scenes):
        alone = TwinBatch([scene], tol=1e-9).advance_samples(times, wrench[index])
        twin = Twin(scene, tol=1e-9, excitation="sampled").advance_samples(times, wrench[index])
        for name in FIELDS:
            assert np.array_equal(getattr(together[index], name), getattr(alone[0], name)), (index, name)
            assert np.array_equal(getattr(together[index], name), getattr(shared[-1 - index], name)), (index, name)
        assert np.array_equal(together[index].makes, twin.makes) and not together.status[index].any()
        for name in ("q", "v", "penetration", "rate", "force", "peak", "impulse"):
            result, expected = getattr(together[index], name), getattr(twin, name)
            assert np.abs(result - expected).max() < 1e-7 * max(np.abs(expected).max(), 1e-3), (index, name)
    assert together.makes.sum() > 0 and together.steps.sum() > 1.05 * together.steps.size


def test_a_sample_soon_after_a_touch_leaves_no_false_peak() -> None:
    """A step of 1 ms, 0.12 us after a touch with exponent 1.5, is longer than the range of the force series."""
    scene = dataclasses.replace(preset("bench_hc"), clearance=Clearance(0.02177825783567106, 0.026269479985725534))
    times = np.arange(1, 852) * 1e-3
    wrench = compile_loads(scene.loads).at(times)
    alone = Twin(scene, tol=1e-6, excitation="sampled").advance_samples(times, wrench)
    lanes = TwinBatch([scene], tol=1e-6).advance_samples(times, wrench)[0]
    assert 0.0 < alone.force[849, 4] < 1e-3 and alone.force[850, 4] > 200.0
    for rows in (alone, lanes):
        assert rows.peak[850, 4] == pytest.approx(rows.force[850, 4], rel=1e-9)
        assert rows.impulse[850, 4] == pytest.approx(alone.impulse[850, 4], rel=1e-9)


def test_a_twin_at_rest_takes_almost_no_steps() -> None:
    scene = fallen()
    twins, twin = TwinBatch([scene] * 3), Twin(scene, excitation="sampled")
    for t in (600.0, 3600.0):
        row, alone = twins.advance(t), twin.advance(t)
        assert row.status.tolist() == [[0]] * 3 and row.steps.max() <= alone.steps
        assert np.abs(row.q[1, 0] - alone.q).max() < 1e-9 and np.array_equal(row.force[0], row.force[2])
    assert row.steps.max() < 40  # some steps are needed, because the longest step is 100 s


def test_one_sample_a_call_a_pause_and_a_restored_snapshot_change_no_bit() -> None:
    scenes = members()
    wrench = samples(len(scenes))
    whole = TwinBatch(scenes).advance_samples(TIMES, wrench)
    one = TwinBatch(scenes)
    for i in range(200):
        row = one.advance(TIMES[i], wrench[:, i])
        assert np.array_equal(row.q[:, 0], whole.q[:, i])
    other = TwinBatch(scenes)
    other.restore(one.snapshot())
    assert other.digest() == one.digest() and other.time == one.time
    rest = other.advance_samples(TIMES[200:], wrench[:, 200:])
    assert np.array_equal(rest.force, whole.force[:, 200:])
    held = one.advance(TIMES[200])
    assert np.isfinite(held.q).all()
    one.reset(0.0)
    assert np.array_equal(one.advance_samples(TIMES, wrench).q, whole.q)


def test_moved_twins_continue_like_restored_twins_and_an_empty_call_has_no_effect() -> None:
    scenes = members()
    wrench = samples(len(scenes))
    twins, other = TwinBatch(scenes), TwinBatch(scenes)
    twins.advance_samples(TIMES[:100], wrench[:, :100])
    twins.advance(TIMES[100], wrench[:, 100])
    before = twins.digest()
    assert len(twins.advance_samples([], np.zeros((0, 3))).t) == 0 and twins.digest() == before
    twins.move([2, 8], [[1e-3, 0.0, 0.0], [0.0, 1e-3, 1e-3]], np.zeros((2, 3)))
    other.restore(twins.snapshot())
    rows, others = (one.advance(TIMES[101], wrench[:, 101]) for one in (twins, other))
    assert np.array_equal(rows.q, others.q) and np.array_equal(rows.peak, others.peak)
    assert twins.digest() == other.digest() != before


# friction needs kernels that no other test compiles
@pytest.mark.parametrize("friction", [None, pytest.param(Friction(0.2, 0.02), marks=pytest.mark.stress)])
def test_members_may_lack_terms_that_others_have(friction: Friction | None) -> None:
    """One member has wear and friction. In the other member, both are zero."""
    plain = preset("paper")
    scenes = [plain, dataclasses.replace(plain, friction=friction, wear=Wear(1e-9, 0.015, 2.0))]
    wrench = samples(1)[0]
    twins = TwinBatch(scenes, tol=1e-10)
    twins.set_travel_speed(1.5)
    together = twins.advance_samples(TIMES, np.stack([wrench] * 2))
    for index, scene in enumerate(scenes):
        alone = Twin(scene, tol=1e-10, excitation="sampled")
        alone.set_travel_speed(1.5)
        rows = alone.advance_samples(TIMES, wrench)
        assert np.abs(together[index].q - rows.q).max() < 1e-9
        assert together[index].wear_depth == pytest.approx(rows.wear_depth, rel=1e-6, abs=1e-18)
    assert together.wear_depth[1].any() and not together.wear_depth[0].any()


def test_bad_input_is_named_and_changes_nothing() -> None:
    scenes = members()[:2]
    twins = TwinBatch(scenes)
    before = twins.digest()
    with pytest.raises(ValueError, match=r"t: got .*0.5.*, expected a time not before"):
        twins.advance_samples([1.0, 0.5], np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"wrench: got shape \(3, 3\), expected \(3,\) or \(2, 3\)"):
        twins.advance(1.0, np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"wrench: got .*nan"):
        twins.advance(1.0, (np.nan, 0.0, 0.0))
    with pytest.raises(ValueError, match="snapshot: got 3 bytes"):
        twins.restore(b"abc")
    with pytest.raises(ValueError, match="speed_m_s: got inf"):
        twins.set_travel_speed(np.inf)
    assert twins.digest() == before
    with pytest.raises(ValueError, match="scenes: got no scene"):
        TwinBatch([])
    with pytest.raises(ValueError, match=r"scenes\[1\].contact: got law .* exponent 1.5, expected the terms of scenes"):
        TwinBatch([scenes[0], preset("bench_hc")])


def test_a_member_that_fails_does_not_stop_the_others() -> None:
    scenes = members()[:3]
    wrench = np.zeros((3, len(TIMES), 3))
    wrench[1] = [1e9, 0.0, 0.0]
    together = TwinBatch(scenes).advance_samples(TIMES, wrench)
    assert together.status[1].any() and not together.status[[0, 2]].any()
    assert all(np.isfinite(getattr(together, name)).all() for name in FIELDS)
