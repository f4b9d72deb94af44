"""An ensemble gives bit-identical results to single runs, and a failure affects only its member."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scenes import preset

from plow_twin import (
    Clearance,
    Contact,
    Frame,
    Gravity,
    Harmonic,
    Head,
    Initial,
    Scene,
    Status,
    Table,
    simulate,
    simulate_many,
)
from plow_twin.errors import ArgumentError, SceneError
from plow_twin.model import geometry
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import variants
from plow_twin.solve import compiled_scene


def members() -> list[Scene]:
    """Return scenes that cannot be computed in lanes (see `test_solve_lanes`)."""
    scene = preset("bench_hc")
    scene = dataclasses.replace(scene, contact=Contact("ramped_damping", 1e8, 1.5, damping=6e4, ramp_m=1e-3))
    pairs = [(gx, gy) for gx in (0.020, 0.025, 0.030) for gy in (0.021, 0.028)]
    scenes = [dataclasses.replace(scene, clearance=Clearance(gx, gy)) for gx, gy in pairs]
    soft = dataclasses.replace(scene.contact, stiffness=3e7)
    return [*scenes, dataclasses.replace(scene, contact=soft)]


@pytest.mark.parametrize("workers", [1, 3])
def test_each_member_has_the_bits_of_its_single_run(workers: int) -> None:
    progress: list[int] = []
    ensemble = simulate_many(members(), 4.0, output_dt=0.1, tol=1e-7, workers=workers, on_progress=progress.append)
    assert max(progress) == len(members()) and (ensemble.status == Status.OK).all()
    for index, scene in enumerate(members()):
        single = simulate(scene, 4.0, output_dt=0.1, tol=1e-7)
        assert np.array_equal(ensemble.q[index], single.q) and np.array_equal(ensemble.v[index], single.v)
        rows = list(single.statistics.values())
        assert ensemble.peak[index].tolist() == [row["max"] for row in rows]
        assert ensemble.impulse[index].tolist() == [row["impulse"] for row in rows]
        assert ensemble.makes[index].tolist() == [row["makes"] for row in rows]
        assert ensemble.events[index] == len(single.events)
        for sense, shares in zip(ensemble.set_time[index], single.contact_sets.values(), strict=True):
            assert sorted(sense[sense > 0.0] / sense.sum()) == sorted(shares.values())
        assert ensemble.steps[index] == single.solver["steps"]


def test_members_with_other_terms_do_not_affect_later_members() -> None:
    """The members of a thread share its scratch memory: scenes for lanes, a flight and a rest."""
    scene = preset("bench_kv")
    swing = Harmonic("swing", (200.0, 50.0), 20.0)
    swinging = dataclasses.replace(scene, gravity=Gravity(0.0), loads=(swing,))
    scenes = [members()[0], swinging, dataclasses.replace(scene, loads=()), swinging]
    together = simulate_many(scenes, 0.9, 0.1, workers=1)
    alone = [simulate_many([one], 0.9, 0.1, workers=1).q[0] for one in reversed(scenes)]
    assert all(np.array_equal(one, q) for one, q in zip(together.q, reversed(alone), strict=True))


def test_a_run_inside_the_callback_of_another_run_changes_no_bit() -> None:
    scene, within = preset("bench_kv"), []
    expected = simulate(scene, 60.0, 0.1, 1e-11)
    inner = dataclasses.replace(scene, loads=())

    def run_another(share: float) -> None:
        within.append(simulate(inner, 0.9, 0.1).q)

    result = simulate(scene, 60.0, 0.1, 1e-11, on_progress=run_another)
    assert within and np.array_equal(result.q, expected.q) and np.array_equal(result.v, expected.v)
    assert all(np.array_equal(q, within[0]) for q in within)


def test_equal_parts_of_successive_scenes_are_converted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    summed: list[object] = []

    def counted(loads: object) -> object:
        summed.append(loads)
        return compile_loads(loads)

    monkeypatch.setattr(compiled_scene, "compile_loads", counted)
    scene = preset("paper")
    table = Table("ramp", np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [4e4, -1e4, 2e3]]))
    for gap in (0.020, 0.025, 0.030):
        simulate(dataclasses.replace(scene, clearance=Clearance(gap, gap)), 1e-3)
    assert len(summed) == 1
    for _ in range(2):  # loads given as a table are not cached, so each run computes them again
        simulate(dataclasses.replace(scene, loads=(table,)), 1e-3)
    assert len(summed) == 3


def test_parts_independent_of_clearance_and_contact_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    unchanged, rows, computed, corners = compiled_scene._unchanged, geometry.arm_rows, list[Scene](), list[Scene]()

    def counted(params: np.dtype[np.void], scene: Scene, sampled: bool, shared: Any) -> object:
        computed.append(scene)
        return unchanged(params, scene, sampled, shared)

    def counted_rows(scene: Scene) -> object:
        corners.append(scene)
        return rows(scene)

    monkeypatch.setattr(compiled_scene, "_unchanged", counted)
    monkeypatch.setattr(geometry, "arm_rows", counted_rows)
    centred = preset("bench_kv")
    # off centre, the head may touch walls at the start
    beside = dataclasses.replace(centred, initial=Initial(q=(1e-3, 2e-3, 0.01)))
    gaps = [Clearance(gap, 0.03) for gap in (0.015, 0.020, 0.025)]
    scenes = [dataclasses.replace(scene, clearance=gap) for scene in (centred, beside) for gap in gaps]
    # the second contact is overdamped
    scenes += variants([centred] * 2, {"contact": {"stiffness": np.array([2e8, 3e6]), "damping": np.array([1e3, 1e9])}})
    params, _ = compiled_scene.compile_scenes(scenes, 1e-6)
    assert len(computed) == 1 + len(gaps)
    assert len(corners) == 1
    alone = [compiled_scene.compile_scenes([scene], 1e-6)[0] for scene in scenes]
    assert [one.tobytes() for one in alone] == [params[i : i + 1].tobytes() for i in range(len(scenes))]
    for damping in (-1.0, np.nan, np.inf):
        with pytest.raises(SceneError, match=r"contact\.damping"):
            variants([centred] * 3, {"contact": {"damping": np.array([1.0, damping, 2.0])}})


def test_a_member_that_fails_does_not_stop_the_others() -> None:
    good = preset("bench_kv")
    weak = dataclasses.replace(good, contact=dataclasses.replace(good.contact, stiffness=1e3, damping=1.0))
    ensemble = simulate_many([good, weak, good], 4.0, output_dt=0.5)
    assert ensemble.status.tolist() == [Status.OK, Status.OUT_OF_RANGE, Status.OK]
    assert np.isfinite(ensemble.q[[0, 2]]).all() and np.array_equal(ensemble.q[0], ensemble.q[2])
    assert np.isfinite(ensemble.q[1, 0]).all() and np.isnan(ensemble.q[1, -1]).all()


@pytest.mark.parametrize("t_end", [-1.0, float("nan"), float("inf")])
def test_times_are_checked_as_in_simulate(t_end: float) -> None:
    with pytest.raises(ValueError, match="t_end: got"):
        simulate_many([preset("paper")], t_end)


@pytest.mark.parametrize("scenes", [preset("paper"), ["mine.yaml"]])
def test_scenes_of_a_wrong_type_are_named(scenes: Any) -> None:
    with pytest.raises(ArgumentError, match=r"scenes?: got .*expected a"):
        simulate_many(scenes, 1.0)


#: Load that begins to push a head without weight between walls without clearance.
SMALL_LOAD = Harmonic("load", (-3.0931353695787673, -2.0267345092034312), 21.16137888565331, 1.7436965700134877, 0.08)


def test_a_head_between_its_walls_has_the_same_bits_in_an_ensemble() -> None:
    """The guard of a pair that separates at once falls from a double zero. Its root is 0, wherever the search ends."""
    scene = Scene(
        Head(0.2376573288673373, 0.001142509680508577),
        Frame(0.26358762310928385, 0.28687215851288694),
        Clearance(0.0, 0.0),
        Contact("exact_restitution", 33954981.51011205, 1.5, restitution=0.9),
        Gravity(0.0),
        (SMALL_LOAD,),
        initial=Initial(v=(0.00023219528530390025, 0.00025219026623066686, -0.0003327659050526975)),
    )
    alone, beside = simulate_many([scene], 0.1, 0.01, 1e-4), simulate_many([scene] * 8, 0.1, 0.01, 1e-4)
    assert alone.events[0] > 10 and alone.set_time[0].max() > 0.0
    for name in ("q", "v", "peak", "impulse", "time_in_contact", "set_time", "steps", "events"):
        for member in range(8):
            np.testing.assert_array_equal(getattr(beside, name)[member], getattr(alone, name)[0])


def test_a_force_with_an_exponent_near_1_stays_finite() -> None:
    """At a depth comparable to rounding errors, the series of the power could overflow."""
    scenes = [
        Scene(
            Head(1000.0, 20.0),
            Frame(0.5, 0.4),
            Clearance(1e-3, 1e-4),
            Contact("hunt_crossley", 3e9, 1.1, damping=0.1),
            Gravity(0.0),
            # the load moves the head by only 2 nm, but it is large enough to prevent the search for rest, as in other
            # tests
            (Harmonic("hardly any", (1e3, 0.0), 2e4),),
            initial=Initial((1e-4, -5e-5 - depth, 0.0)),
        )
        for depth in np.linspace(1e-5, 6e-5, 8)
    ]
    many = simulate_many(scenes, 0.2, 0.01)
    assert (many.status == Status.OK).all() and (many.events > 20).all()
    one = simulate(scenes[0], 0.2, 0.01)
    assert len(one.events) == pytest.approx(many.events[0], rel=0.1)
    assert one.q == pytest.approx(many.q[0], abs=1e-7)
