"""The session of live node and replay: equal entries give bit-identical results, and publications lose nothing."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plow_twin.errors import ArgumentError
from plow_twin.live.wear_keeper import WearKeeper
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Contact, Scene, Wear
from plow_twin.run.batch import TwinBatch
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.solve.state import ROW
from plow_twin.stream.journal import Digest, Entry, Hold, Loss, Reset, Sample, Snapshot, Travel
from plow_twin.stream.outputs import CLEARANCE_NAMES, ONLY_ROW, SLOW_PERIOD_NS, Outputs, Published, prior_points
from plow_twin.stream.session import DIGEST_INTERVAL, Session

T0 = 1_795_000_000_123_456_789
MS = 1_000_000
STEPS = 900


def _scene() -> Scene:
    wear = Wear(coefficient_m2_n=1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0, prior_m2_n=(2e-15, 5e-14))
    return replace(load_scene(scene_path("paper")), wear=wear)


SCENE = _scene()
WRENCH = compile_loads(SCENE.loads).at(np.arange(STEPS) * 2e-3)


def _sample(index: int) -> Sample:
    return Sample(T0 + 2 * index * MS, tuple(WRENCH[index].tolist()))


def _entries() -> list[Entry]:
    """Return entries of all kinds that change the motion."""
    entries: list[Entry] = [_sample(index) for index in range(STEPS)]
    entries[700:700] = [Hold(T0 + 1398 * MS + 500_000), Travel(T0, 3.5)]
    entries[200:200] = [Reset(T0 + 398 * MS, "test"), Hold(T0 + 399 * MS)]
    return entries


class Run:
    def __init__(self) -> None:
        self.emitted: list[Entry] = []
        self.publications: list[Published] = []
        self.session = Session(Twin(SCENE, excitation="sampled"), on_entry=self.emitted.append)

    def apply(self, entries: list[Entry], take: bool = True) -> Run:
        for entry in entries:
            self.session.apply(entry)
            if take and len((published := self.session.outputs.pop()).rows):
                self.publications.append(published)
        return self


#: Numeric fields of a published row, except the stamp.
NUMBERS = ("penetration", "rate", "force", "makes", "impulse", "peak", "q", "v")


def _number(published: Published, name: str) -> np.ndarray:
    column: np.ndarray = published.rows[name][0]
    return column


def _stamp(published: Published) -> int:
    return int(published.rows["stamp_ns"][0])


def _bits(published: Published) -> bytes:
    parts = [published.rows["stamp_ns"], *(published.rows[name] for name in NUMBERS)]
    parts += [published.slow["clearance"], published.slow["wear_rate"]]
    return b"".join(part.tobytes() for part in parts)


@pytest.fixture(scope="module")
def reference() -> Run:
    run = Run()
    run.session.start()
    run.apply(_entries())
    run.session.close()
    return run


def test_the_emitted_journal_repeats_the_run_bit_for_bit(reference: Run) -> None:
    emitted = reference.emitted
    again = Run().apply([entry for entry in emitted if not isinstance(entry, Snapshot)])
    again.session.close()
    assert [_bits(publication) for publication in again.publications] == [
        _bits(publication) for publication in reference.publications
    ]
    assert again.emitted == [entry for entry in emitted if not isinstance(entry, Snapshot)]
    digests = [entry for entry in emitted if isinstance(entry, Digest)]
    assert len(digests) == (STEPS + 2) // DIGEST_INTERVAL + 1
    assert len({entry.digest for entry in digests}) == len(digests)


def test_one_flipped_bit_of_a_sample_shows_in_the_next_digest(reference: Run) -> None:
    entries = _entries()
    index = 350
    sample = entries[index]
    assert isinstance(sample, Sample)
    flipped = float((np.array(sample.wrench[0]).view(np.int64) ^ 1).view(np.float64))
    entries[index] = replace(sample, wrench=(flipped, *sample.wrench[1:]))
    run = Run().apply(entries)
    pairs = zip(
        [entry for entry in reference.emitted if isinstance(entry, Digest)],
        [entry for entry in run.emitted if isinstance(entry, Digest)],
        strict=False,
    )
    # later digests may agree again, because a damped contact forgets differences in the last bits
    same = [(ours.stamp_ns < sample.stamp_ns, ours == theirs) for ours, theirs in pairs]
    before = sum(earlier for earlier, _ in same)
    assert 0 < before < len(same)
    assert [equal for _, equal in same[: before + 1]] == [True] * before + [False]


def test_publications_contain_the_twins_numbers(reference: Run) -> None:
    twin = Twin(SCENE, excitation="sampled")
    series = twin.advance_samples(np.arange(200) * 2 * MS * 1e-9, WRENCH[:200])
    for index, publication in enumerate(reference.publications[:200]):
        for name in ("penetration", "rate", "force", "impulse", "peak", "q", "v"):
            assert _number(publication, name).tobytes() == getattr(series, name)[index].tobytes()
    touches = np.cumsum(series.makes, axis=0)
    assert touches[-1].sum() > 0
    assert (np.array([_number(publication, "makes") for publication in reference.publications[:200]]) == touches).all()


@settings(max_examples=8)
@given(st.sets(st.integers(1, STEPS - 1), max_size=12))
def test_rare_publications_lose_no_peak_impulse_or_touch(cuts: set[int]) -> None:
    every, rare = Run(), Run()
    entries = [_sample(index) for index in range(STEPS)]
    every.apply(entries)
    bounds = [0, *sorted(cuts), STEPS]
    for begin, end in itertools.pairwise(bounds):
        rare.apply(entries[begin : end - 1], take=False)
        rare.apply(entries[end - 1 : end])
    assert len(rare.publications) == len(bounds) - 1
    assert (_number(rare.publications[-1], "makes") == _number(every.publications[-1], "makes")).all()
    for publication, begin, end in zip(rare.publications, bounds, bounds[1:], strict=False):
        part = every.publications[begin:end]
        assert (_number(publication, "peak") == np.max([_number(single, "peak") for single in part], axis=0)).all()
        impulse = np.sum([_number(single, "impulse") for single in part], axis=0)
        np.testing.assert_allclose(_number(publication, "impulse"), impulse, rtol=1e-12)
        assert _bits(publication)[:200] == _bits(part[-1])[:200]


@pytest.mark.parametrize("at", [0, 1, 333, 801])
def test_a_session_continues_from_a_snapshot_with_the_same_bits(reference: Run, at: int) -> None:
    before = Run().apply(_entries()[:at])
    after = Run().apply([Loss(at), before.session.snapshot(), *_entries()[at:]])
    # an entry that advances nothing publishes nothing
    publications = reference.publications[len(before.publications) :]
    assert [_bits(publication) for publication in after.publications] == [
        _bits(publication) for publication in publications
    ]
    assert after.session.twin.digest() == reference.session.twin.digest()


def test_an_entry_that_cannot_be_applied_changes_nothing(reference: Run) -> None:
    run = Run().apply([_sample(0), _sample(5)])
    emitted, digest = len(run.emitted), run.session.twin.digest()
    with pytest.raises(ValueError, match="expected at least the time reached"):
        run.session.apply(_sample(4))
    assert (len(run.emitted), run.session.twin.digest()) == (emitted, digest)


def test_clearance_is_base_plus_mean_wear_of_each_side_with_the_priors_interval() -> None:
    outputs = Outputs(SCENE)
    twin = Twin(SCENE, excitation="sampled")
    rows = np.zeros(1, ROW)
    twin.advance_rows(np.zeros(1), np.zeros((1, 3)), rows)
    rows["wear_depth"] = np.arange(1.0, 9.0) * 1e-3
    published = outputs.add(rows, np.array([T0]), ONLY_ROW)
    named = dict(zip(CLEARANCE_NAMES, published.slow["clearance"][0], strict=True))
    # pads 1 and 7 are on the left, 3 and 5 on the right, 0 and 2 at the top, and 4 and 6 at the bottom
    assert named["horizontal"] == pytest.approx(0.025 + (2e-3 + 8e-3) / 2 + (4e-3 + 6e-3) / 2)
    assert named["vertical"] == pytest.approx(0.030 + (1e-3 + 3e-3) / 2 + (5e-3 + 7e-3) / 2)
    assert named["pad_top_right_right"] == 4e-3
    assert named["pad_top_right_right/p05"] == pytest.approx(4e-3 * 0.2)
    assert named["pad_top_right_right/p95"] == pytest.approx(4e-3 * 5.0)
    assert named["horizontal/p95"] == pytest.approx(0.025 + 5.0 * 0.010)


def test_without_wear_the_interval_is_the_value() -> None:
    scene = replace(SCENE, wear=None)
    depth = np.zeros(8)
    assert prior_points(scene, depth) == (depth, depth)


def test_the_wear_rate_times_the_time_is_the_growth(reference: Run) -> None:
    stamps = [_stamp(publication) for publication in reference.publications[:200]]
    slow = np.concatenate([publication.slow for publication in reference.publications[:200]])
    spans = (slow["stamp_ns"] // SLOW_PERIOD_NS).tolist()
    assert spans == sorted({stamp // SLOW_PERIOD_NS for stamp in stamps})
    for before, after in itertools.pairwise(slow):
        growth = after["clearance"][2:10] - before["clearance"][2:10]
        seconds = (int(after["stamp_ns"]) - int(before["stamp_ns"])) * 1e-9
        np.testing.assert_allclose(after["wear_rate"] * seconds, growth, atol=1e-18)
    assert slow["wear_rate"].max() > 0.0


def test_running_in_and_sliding_in_the_plane_wear_equally_live_and_offline(tmp_path: Path) -> None:
    wear = Wear(1e-12, 0.015, 2.0, sliding="total", running_in_ratio=4.0, running_in_depth_m=2e-5)
    scene = replace(SCENE, wear=wear)

    def lived(kept: WearKeeper) -> np.ndarray:
        session = Session(Twin(scene, excitation="sampled"), wear_depth=kept.load())
        for index in range(STEPS):
            session.apply(_sample(index))
        session.close()
        kept.close(session.wear_depth)
        return session.wear_depth

    def offline(before: np.ndarray) -> np.ndarray:
        worn = replace(scene, wear=replace(wear, initial_depth_m=tuple(before.tolist())))
        twin = Twin(worn, excitation="sampled", tol=1e-9)
        return twin.advance_samples(2e-3 * np.arange(STEPS), WRENCH).wear_depth[-1]

    new = lived(WearKeeper(tmp_path, "head 7", scene))
    # the wear is equal within the tolerance of the motion
    assert new == pytest.approx(offline(np.zeros(8)), rel=1e-3, abs=1e-12)
    assert new.max() > 1.5 * wear.running_in_depth_m
    worn = lived(WearKeeper(tmp_path, "head 7", scene))
    assert worn == pytest.approx(offline(new), rel=1e-3, abs=1e-12)
    # pads that have run in wear more slowly, by the given ratio
    assert (worn - new).max() < 0.6 * new.max()


def test_a_speed_beyond_the_limit_of_the_damping_is_refused_by_name() -> None:
    """A force would wear a pad faster than it moves the head. The speed is rejected before it is journaled."""
    damping, area = 2e5, 0.015
    contact = Contact("kelvin_voigt", 1e9, damping=damping)
    scene = replace(SCENE, contact=contact, wear=Wear(area / (4.0 * damping), area, 2.0, prior_m2_n=(1e-15, 1e-6)))
    twin, emitted = Twin(scene, excitation="sampled"), []
    session = Session(twin, on_entry=emitted.append)
    session.stamp_ns = T0
    session.apply(Travel(T0 + 10 * MS, -3.9))
    for refuse in (
        lambda: twin.set_travel_speed(-4.1),
        lambda: TwinBatch([scene, scene]).set_travel_speed([2.0, 4.1]),
        lambda: session.apply(Travel(T0 + 20 * MS, 4.1)),
    ):
        with pytest.raises(ArgumentError, match=r"got -?4.1, expected at most 4 m/s, .* contact.damping 200000.0 N"):
            refuse()
    # if such a speed is queued, a damping that does not allow this speed is rejected too
    with pytest.raises(ArgumentError, match=r"speed_m_s: got -3.9, expected at most 3.2 m/s"):
        session.check_model({"contact.damping": 1.25 * damping})
    session.check_model({"contact.damping": damping})
    assert emitted == [Travel(T0 + 10 * MS, -3.9)] and session.twin is twin
