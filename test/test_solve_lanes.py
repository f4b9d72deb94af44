"""Scenes in SIMD lanes: results depend, bit for bit, on the scene alone, and agree with the loop of a single scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import pose_error, preset, reference
from test_solve_flight import swaying
from test_solve_rest import fallen

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
    Status,
    Table,
    Wear,
    simulate,
    simulate_many,
)
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.run.ensemble import Ensemble
from plow_twin.solve.compiled_scene import compile_scene
from plow_twin.solve.lanes import loop
from plow_twin.solve.lanes.record import fits_lanes

FIELDS = (
    "q",
    "v",
    "peak",
    "impulse",
    "time_in_contact",
    "makes",
    "set_time",
    "events",
    "wear_depth",
    "steps",
    "status",
)


def draw(rng: np.random.Generator, powers: bool = False) -> Scene:
    """Draw geometry, law, stiffness, loads of several frequencies and directions, pairs and initial rates.

    With `powers`, the exponent is not 1.
    """
    mass, width, height = 10 ** rng.uniform(1.0, 3.5), *rng.uniform(0.1, 0.5, 2)
    stiffness = 10 ** rng.uniform(5.5, 10.0)
    damping = 2.0 * np.sqrt(stiffness * mass) * 10 ** rng.uniform(-3.0, 0.0)
    contact = [
        Contact("hertz", stiffness, 1.0),
        Contact("kelvin_voigt", stiffness, 1.0, damping=damping),
        Contact("hunt_crossley", stiffness, 1.0, damping=10 ** rng.uniform(-1.0, 1.0)),
        Contact("exact_restitution", stiffness, 1.0, restitution=rng.uniform(0.3, 0.95)),
    ][rng.choice(4, p=[0.2, 0.4, 0.2, 0.2])]
    if powers:
        exponent = float(rng.choice([1.5, 2.0, 2.2, 3.0, 4.0], p=[0.5, 0.15, 0.1, 0.15, 0.1]))
        # with this factor, the contact at a depth of about 1 mm is as stiff as with exponent 1
        stiffness *= 1e3 ** (exponent - 1.0)
        contact = [
            Contact("hertz", stiffness, exponent),
            Contact("hunt_crossley", stiffness, exponent, damping=10 ** rng.uniform(-1.0, 1.0)),
            Contact("exact_restitution", stiffness, exponent, restitution=rng.uniform(0.3, 0.95)),
        ][rng.integers(3)]
    force, parallel = 4.0 * 9.81 * mass, rng.random() < 0.5
    directions = [rng.uniform(-1.0, 1.0, 2)] * 3 if parallel else list(rng.uniform(-1.0, 1.0, (3, 2)))
    loads = tuple(
        Harmonic(f"load {i}", tuple(force * directions[i]), rng.uniform(1.0, 30.0), rng.uniform(0.0, 6.0), 0.05 * force)
        for i in range(rng.integers(0, 4))
    )
    pairs = PAIR_NAMES if rng.random() < 0.7 else tuple(name for name in PAIR_NAMES if rng.random() < 0.8)
    return Scene(
        head=Head(mass, mass * 10 ** rng.uniform(-1.5, -0.5)),
        frame=Frame(width, height),
        clearance=Clearance(*10 ** rng.uniform(-3.0, -1.6, 2)),
        contact=contact,
        gravity=Gravity(9.81, 0.05),
        loads=loads,
        initial=Initial(v=tuple(rng.uniform(-0.3, 0.3, 3))),
        pairs=pairs,
    )


#: Combinations of the directions of harmonics and the terms of the law (viscous, hysteretic, integer, fraction). Each
#: combination needs its own compiled kernels, so each value occurs only in a few combinations. The key is True if
#: exponents differ from 1.
SOME = {
    False: {(0, 1, None, None, None), (1, 1, None, None, None)},
    True: {(1, None, 1, None, 1)},
}
#: The combination of scenes with friction.
RUBBING = {(1, 1, None, None, None)}


def drawn(seed: int, count: int, some: bool = True, powers: bool = False, friction: bool = False) -> list[Scene]:
    rng, scenes = np.random.default_rng(seed), list[Scene]()
    while len(scenes) < count:
        scene = draw(rng, powers)
        if friction:
            scene = dataclasses.replace(scene, friction=Friction(rng.uniform(0.05, 0.5), 10 ** rng.uniform(-2.5, -1.0)))
        compiled = compile_scene(scene, 1e-6)
        terms = compiled.parts.terms
        directions = (terms.harmonics or 0) + (terms.second or 0)
        kind = directions, terms.viscous, terms.hysteretic, terms.integer, terms.fraction
        if fits_lanes(compiled) and (not some or kind in (RUBBING if friction else SOME[powers])):
            scenes.append(scene)
    return scenes


def same(one: Ensemble, i: int, other: Ensemble, k: int) -> bool:
    return all(np.array_equal(getattr(one, name)[i], getattr(other, name)[k], equal_nan=True) for name in FIELDS)


@pytest.mark.parametrize(
    ("powers", "friction", "seed", "some"),
    [
        (False, False, 1, True),
        (True, False, 2, True),
        (False, True, 4, True),
        pytest.param(True, False, 2, False, marks=[pytest.mark.stress, pytest.mark.timeout(1200)]),
    ],
)
def test_a_scene_has_the_same_bits_alone_and_with_others(powers: bool, friction: bool, seed: int, some: bool) -> None:
    scenes = drawn(seed, 19, some, powers, friction)
    together = simulate_many(scenes, 1.0, 0.05, 1e-7, workers=1)
    # the lanes end at very different times and are filled again
    assert together.events.min() < together.events.max() // 10
    backwards = simulate_many(scenes[::-1], 1.0, 0.05, 1e-7, workers=3)
    for index, scene in enumerate(scenes):
        assert same(together, index, simulate_many([scene], 1.0, 0.05, 1e-7), 0)
        assert same(together, index, backwards, len(scenes) - 1 - index)


def test_rows_and_slices_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = drawn(7, 9)
    whole = simulate_many(scenes, 0.5, 0.05, 1e-7)
    monkeypatch.setattr("plow_twin.run.lane_run.next_slice", lambda size, took_s: 7)
    monkeypatch.setattr("plow_twin.run.lane_run._FIRST_SLICE", 3)
    finer = simulate_many(scenes, 0.5, 0.0125, 1e-7)
    assert np.array_equal(finer.q[:, ::4], whole.q) and np.array_equal(finer.impulse, whole.impulse)
    assert np.array_equal(finer.steps, whole.steps)


def _check_beside_the_loop(seed: int, count: int, some: bool, powers: bool, friction: bool) -> None:
    scenes = drawn(seed, count, some, powers, friction)
    many = simulate_many(scenes, 0.7, 0.02, 1e-12)
    close = 0
    for index, scene in enumerate(scenes):
        if many.status[index] != Status.OK:
            assert many.status[index] == Status.OUT_OF_RANGE
            continue
        alone = simulate(scene, 0.7, 0.02, tol=1e-12)
        error = pose_error(scene, many.q[index], alone.q)
        if error > 1e-9:
            # the scene amplifies rounding errors, so runs of the single loop with other tolerances differ too
            others = [simulate(scene, 0.7, 0.02, tol=tol).q for tol in (3e-12, 1e-11, 3e-11)]
            assert error < 300.0 * max(pose_error(scene, q, alone.q) for q in others), index
            continue
        close += 1
        rows = alone.statistics.values()
        assert many.events[index] == len(alone.events)
        assert many.makes[index].tolist() == [row["makes"] for row in rows]
        for name, values in (("max", many.peak), ("impulse", many.impulse), ("time_in_contact", many.time_in_contact)):
            expected = np.array([row[name] for row in rows])
            assert np.abs(values[index] - expected).max() <= 1e-7 * expected.max(initial=1e-9), (index, name)
        for sense, shares in zip(many.set_time[index], alone.contact_sets.values(), strict=True):
            found_shares = np.sort(sense[sense > 1e-9] / max(sense.sum(), 1e-300))
            np.testing.assert_allclose(found_shares, np.sort([x for x in shares.values() if x > 1e-9]), atol=1e-7)
    assert close >= count // 4


@pytest.mark.parametrize(("powers", "friction"), [(False, False), (True, False), (False, True)])
def test_random_scenes_move_as_in_the_loop_of_a_single_scene(powers: bool, friction: bool) -> None:
    _check_beside_the_loop(3, 16, True, powers, friction)


@pytest.mark.stress
@pytest.mark.timeout(1200)  # one test compiles the kernels of lanes and loop for four kinds of scenes
@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_many_random_scenes_move_as_in_the_loop_of_a_single_scene(seed: int, powers: bool, friction: bool) -> None:
    _check_beside_the_loop(seed, 40, False, powers, friction)


@pytest.mark.parametrize("tol", [1e-3, 1e-6, 1e-9])
def test_the_bench_scene_meets_its_reference_with_every_event(tol: float) -> None:
    results, exact = simulate_many([preset("bench_kv")], 20.0, 0.1, tol), reference("bench_kv")
    stride = round(0.1 / (exact["t"][1] - exact["t"][0]))
    assert pose_error(preset("bench_kv"), results.q[0], exact["q"][::stride]) < 10.0 * tol
    assert results.events[0] == 366 and results.makes.sum() == 120
    # a CLIPPED pair that separates changes no force, so its event ends no step
    assert results.steps[0] < 0.95 * simulate(preset("bench_kv"), 20.0, 0.1, tol=tol).solver["steps"]


@pytest.mark.parametrize("tol", [1e-3, 1e-6, 1e-9])
def test_the_bench_scene_with_exponent_one_and_a_half_meets_its_reference_with_every_event(tol: float) -> None:
    scene, exact = preset("bench_hc"), reference("bench_hc")
    results, alone = simulate_many([scene], 20.0, 0.1, tol), simulate(scene, 20.0, 0.1, tol=tol)
    stride = round(0.1 / (exact["t"][1] - exact["t"][0]))
    assert pose_error(scene, results.q[0], exact["q"][::stride]) < 10.0 * tol
    assert results.events[0] == len(alone.events) and results.steps[0] < alone.solver["steps"]


@pytest.mark.parametrize("build", [fallen, swaying])
def test_scenes_at_rest_and_in_flight_leave_the_lanes(build: Callable[[], Scene]) -> None:
    scene = build()
    many, alone = simulate_many([scene] * 3, 3600.0, 7.3), simulate(scene, 3600.0, 7.3)
    assert many.steps.max() <= alone.solver["steps"] + 64 and (many.status == Status.OK).all()
    assert pose_error(scene, many.q[1], alone.q) < 1e-8 and many.events[1] == len(alone.events)


def test_scenes_that_lanes_do_not_cover_run_one_by_one() -> None:
    scene = preset("bench_kv")
    others = [
        # with implicit steps, and with the kernels of `test_study_sweep`
        dataclasses.replace(preset("paper"), contact=Contact("exact_restitution", 1e8, restitution=0.0)),
        dataclasses.replace(scene, contact=Contact("ramped_damping", 2e7, 1.5, damping=6e4, ramp_m=1e-3)),
        dataclasses.replace(scene, friction=Friction(0.2, stick_stiffness_n_m=5e7)),
        dataclasses.replace(scene, wear=Wear(1e-11, 0.015, 2.0)),
        dataclasses.replace(scene, locked=("theta",)),
        dataclasses.replace(scene, loads=(Table("push", np.array([0.0, 1.0]), np.zeros((2, 3))),)),
    ]
    assert [fits_lanes(compile_scene(one, 1e-6)) for one in (*others, scene)] == [False] * len(others) + [True]
    mixed = simulate_many([scene, others[0], scene], 0.5, 0.1)
    assert np.array_equal(mixed.q[1], simulate(others[0], 0.5, 0.1).q) and np.array_equal(mixed.q[0], mixed.q[2])


def test_terms_that_a_scene_lacks_are_not_compiled() -> None:
    simulate_many([fallen()], 0.2, 0.1)
    names = loop.run_lanes.py_func.__code__.co_varnames  # type: ignore[attr-defined]
    signatures = loop.run_lanes.signatures  # type: ignore[attr-defined]
    compiled = [dict(zip(names, map(str, signature), strict=False)) for signature in signatures]
    absent = "waves", "second", "hysteretic", "slip", "flight"
    assert any(all(one[name] == "none" for name in absent) for one in compiled)
