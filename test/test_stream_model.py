"""Changes of the running model, and motions that are restored: journaled, continuous, and exact in a second run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plow_twin.errors import ArgumentError
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Scene, Wear
from plow_twin.record.journal_codec import from_message, to_message
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.driver import Driver, Policy
from plow_twin.stream.intake import Intake
from plow_twin.stream.journal import Entry, Mark, Restore, SetModel, Snapshot
from plow_twin.stream.model_changes import changed_scene
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Session

T0 = 1_795_000_000_000_000_000
MS = 1_000_000
PAPER = load_scene(scene_path("paper"))
WORN = replace(PAPER, wear=Wear(coefficient_m2_n=1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0))
WRENCH = compile_loads(PAPER.loads).at(np.arange(2000) * 1e-3).tolist()


class Bench:
    def __init__(self, scene: Scene) -> None:
        self.journal: list[Entry] = []
        self.out: list[Published] = []
        self.session = Session(Twin(scene, excitation="sampled"), on_entry=self.journal.append, rollback_span_s=0.5)
        self.driver = Driver(self.session, Intake(), Policy())
        self.session.start()

    def send(self, first: int, last: int, shift_ns: int = 0) -> list[Published]:
        arrived = [(T0 + shift_ns + k * MS, tuple(WRENCH[k])) for k in range(first, last)]
        publications = list(self.driver.samples(arrived, 0))  # type: ignore[arg-type]
        self.out += publications
        return publications


def _same(first: list[Published], second: list[Published]) -> bool:
    names = ("q", "v", "force", "penetration", "peak", "impulse")
    pairs = list(zip(first, second, strict=True))
    return all((a.rows[name] == b.rows[name]).all() for a, b in pairs for name in names)


def _again(scene: Scene, entries: list[Entry]) -> list[Entry]:
    """Run a journal as read from a file. Return the entries that the session writes."""
    emitted: list[Entry] = []
    session = Session(Twin(scene, excitation="sampled"), on_entry=emitted.append, rollback_span_s=0.5)
    for entry in entries:
        found = from_message(to_message(entry, ""))
        assert found == entry
        session.apply(found)  # type: ignore[arg-type]
        session.outputs.pop()
    session.close()
    return emitted


def test_a_restored_motion_continues_as_after_its_snapshot_for_any_stamps() -> None:
    bench = Bench(PAPER)
    bench.send(0, 700)
    kept = bench.driver.snapshot()
    first = bench.send(700, 900)
    bench.send(900, 1300)
    makes = bench.out[-1].rows["makes"].copy()
    # the stamps continue as before, an hour later, or an hour earlier
    for shift_ns in (0, 3600 * 10**9, -3600 * 10**9):
        bench.driver.restore(T0, kept)
        again = bench.send(699, 900, shift_ns)
        assert again[0].rows["stamp_ns"][0] == T0 + 699 * MS + shift_ns
        assert (again[0].rows["q"] == bench.out[699].rows["q"]).all()
        assert _same(first, again[1:])
        assert (again[-1].rows["makes"] >= makes).all()  # counts never decrease
    assert bench.driver.resets == 0
    bench.session.apply(Mark(bench.session.stamp_ns or 0, "after the third"))
    bench.session.close()
    assert [entry.text for entry in bench.journal if isinstance(entry, Mark)] == ["after the third"]
    assert _again(PAPER, bench.journal) == bench.journal


def test_wear_survives_a_restored_motion() -> None:
    bench = Bench(WORN)
    bench.send(0, 700)
    kept = bench.driver.snapshot()
    bench.send(700, 1500)
    depth = bench.session.wear_depth.copy()
    bench.driver.restore(T0, kept)
    (again,) = bench.send(699, 700)
    assert (bench.session.wear_depth == depth).all() and depth.max() > 0.0
    np.testing.assert_allclose(again.rows["q"], bench.out[699].rows["q"], rtol=0.0, atol=1e-12)
    bench.send(700, 900)
    bench.session.close()
    assert _again(WORN, bench.journal) == bench.journal


def test_a_changed_model_continues_from_pose_rates_and_wear() -> None:
    bench = Bench(WORN)
    bench.send(0, 731)
    before, depth = bench.out[-1], bench.session.wear_depth.copy()
    bench.driver.set_model(
        T0, {"clearance.horizontal_m": 0.03, "contact.stiffness": 2e7, "wear.coefficient_m2_n": 3e-14}
    )
    (after,) = bench.send(731, 732)
    np.testing.assert_allclose(after.rows["q"], before.rows["q"] + 1e-3 * before.rows["v"], rtol=0.0, atol=1e-5)
    assert (bench.session.wear_depth >= depth).all()
    bench.send(732, 1100)
    assert bench.session.outputs.modelled(np.zeros(8))[0] == 0.03
    bench.driver.snapshot()
    bench.send(1100, 1300)
    bench.driver.reset(T0, "test")
    (start,) = bench.send(0, 1)
    np.testing.assert_allclose(start.rows["q"][0], PAPER.initial.q, rtol=0.0, atol=1e-12)
    bench.driver.set_model(T0, {})
    bench.send(1, 400)
    bench.session.close()
    assert sum(isinstance(entry, SetModel) for entry in bench.journal) == 2
    assert _again(WORN, bench.journal) == bench.journal
    # a later part of a recording contains only the entries from the snapshot on
    index = max(number for number, entry in enumerate(bench.journal) if isinstance(entry, Snapshot))
    assert _again(WORN, bench.journal[index:]) == bench.journal[index:]


def test_setting_the_same_model_has_no_effect() -> None:
    bench = Bench(PAPER)
    for _ in range(2):
        bench.driver.set_model(T0, {"clearance.vertical_m": 0.031})
    assert sum(isinstance(entry, SetModel) for entry in bench.journal) == 1
    assert not any(isinstance(entry, Restore) for entry in bench.journal)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact.damping": 0.0}, "configure the node again"),
        ({"contact.restitution": 0.4}, "the scene has no restitution"),
        ({"wear.coefficient_m2_n": 1e-14}, "the scene has no wear"),
        ({"contact.stiffness": 0.0}, "expected a finite number"),
        ({"clearance.horizontal_m": float("nan")}, "expected a finite number"),
        ({"head.mass_kg": 1.0}, "expected one of"),
    ],
)
def test_an_impossible_change_while_the_twin_runs_is_refused_without_effect(
    changes: dict[str, float], message: str
) -> None:
    bench = Bench(PAPER)
    bench.send(0, 10)
    count = len(bench.journal)
    with pytest.raises(ArgumentError, match=message):
        bench.driver.set_model(T0, changes)
    assert len(bench.journal) == count and bench.session.changes == {}
    assert changed_scene(PAPER, {}) == PAPER
