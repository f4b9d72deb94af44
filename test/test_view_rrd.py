"""The rerun file of a recording, read with rerun's own reader."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from figure_checks import kept_figures
from record_support import BASE_NS, STEP_NS, Run, paper_sample, record_run, records_of
from rerun.chunk import RrdReader

from plow_twin.cli.app import run as cli
from plow_twin.errors import RecordingError
from plow_twin.model.pairs import CORNER_NAMES, PAIR_NAMES
from plow_twin.model.scene import Wear
from plow_twin.record.entries import NO_ENTRIES, Batch, EntryRecord
from plow_twin.record.messages import JointState, Odometry
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Entry, Hold, Parameter, Pose, Reset, Sample, SetWear, Travel, Unload
from plow_twin.study.analysis.analyse import analyse
from plow_twin.view import ViewSummary, layout, to_rrd
from plow_twin.view.columns import TimeAxis, extremes
from plow_twin.view.contact_sets import ContactSets, masks_of, set_color
from plow_twin.view.picture import to_png
from plow_twin.view.section import ARROW_MM_PER_N, LABEL_MM, Section

COUNT = 1500


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_run(tmp_path_factory.mktemp("runs") / "paper", map(paper_sample, range(COUNT)))


@pytest.fixture(scope="module")
def view(run: Run) -> tuple[ViewSummary, dict[str, pa.Table]]:
    summary = to_rrd(run.file, run.folder.parent / "paper.rrd")
    return summary, read(summary.path)


def read(path: Path) -> dict[str, pa.Table]:
    """Return the rows of each entity in a rerun file. Colours that change in time are under `<entity> colors`."""
    batches: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(str(path)).stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            kind = " colors" if "SeriesLines:colors" in batch.schema.names else ""
            batches.setdefault(chunk.entity_path + kind, []).append(batch)
    return {entity: pa.concat_tables([pa.Table.from_batches([b]) for b in rows]) for entity, rows in batches.items()}


def curve_names(path: Path) -> dict[str, str]:
    names: dict[str, str] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        if chunk.is_static and "SeriesLines:names" in batch.schema.names:
            names[chunk.entity_path] = batch["SeriesLines:names"].to_pylist()[-1][0]
    return names


def journal_around_the_hole(folder: Path) -> list[Sample]:
    samples = [
        (record.sequence, record.entry)
        for record in records_of(folder)
        if isinstance(record, EntryRecord) and isinstance(record.entry, Sample)
    ]
    place = int(np.argmax(np.diff([sequence for sequence, _ in samples])))
    return [samples[place][1], samples[place + 1][1]]


def scalars(table: pa.Table) -> np.ndarray:
    return np.array(table["Scalars:scalars"].to_pylist(), dtype=np.float64).ravel()


def test_rerun_verifies_the_file_and_finds_a_blueprint(view: tuple[ViewSummary, dict[str, pa.Table]]) -> None:
    path = view[0].path
    assert [entry.application_id for entry in RrdReader(str(path)).blueprints()] == ["plow_twin"]
    command = [str(Path(sys.executable).with_name("rerun")), "rrd", "verify", str(path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr


def test_no_peak_is_lost_from_the_force_curves(run: Run, view: tuple[ViewSummary, dict[str, pa.Table]]) -> None:
    summary, tables = view
    sent = [m for topic, m in run.outputs if topic == "/contact_peaks" and isinstance(m, JointState)]
    efforts = np.array([message.effort for message in sent])
    assert efforts.max() > 5e4
    for pair, name in enumerate(PAIR_NAMES):
        table = tables[f"/force/{name}"]
        np.testing.assert_array_equal(scalars(table), efforts[:, pair] / 1e3)
        times = table["ros_time"].combine_chunks().cast(pa.int64()).to_numpy()
        np.testing.assert_array_equal(times, BASE_NS + STEP_NS * np.arange(COUNT))
        np.testing.assert_array_equal(table["step"].to_numpy(), np.arange(COUNT))
        since = table["run_time"].combine_chunks().cast(pa.int64()).to_numpy()
        np.testing.assert_array_equal(since, STEP_NS * np.arange(COUNT))
    assert summary.curve_rows == COUNT and summary.status is FileStatus.COMPLETE


def test_a_view_has_curves_of_penetration_clearance_and_load(
    run: Run, view: tuple[ViewSummary, dict[str, pa.Table]]
) -> None:
    tables = view[1]
    forces = [m for topic, m in run.outputs if topic == "/contact_forces" and isinstance(m, JointState)]
    np.testing.assert_array_equal(
        scalars(tables["/penetration/bottom_right_bottom"]), [1e3 * message.position[4] for message in forces]
    )
    for name in ("horizontal", "horizontal/p05", "horizontal/p95"):
        np.testing.assert_allclose(scalars(tables[f"/clearance/{name}"]), 25.0, atol=1e-9)
    assert set(tables) >= {"/wear/pad_top_left_top", "/wear/pad_top_left_top/p95", "/quality/sample_interval_ms"}
    np.testing.assert_array_equal(scalars(tables["/load/fx"]), [paper_sample(i).wrench[0] / 1e3 for i in range(COUNT)])
    assert set(scalars(tables["/quality/sample_interval_ms"])) == {1.0}
    largest = np.abs([paper_sample(i).wrench for i in range(COUNT)]).max(axis=0) / 1e3
    names = curve_names(view[0].path)
    expected = (f"{name}, to {value:.3g}" for name, value in zip(("Fx", "Fy", "M"), largest, strict=True))
    assert [names[f"/load/{part}"].removesuffix(" m") for part in ("fx", "fy", "moment")] == [
        f"{e} kN" for e in expected
    ]


def test_the_growth_of_the_clearance_is_drawn_in_micrometres(tmp_path: Path) -> None:
    wear = Wear(1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0, prior_m2_n=(1e-15, 1e-13))
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), wear=wear)
    to_rrd(run.file, tmp_path / "run.rrd")
    tables = read(tmp_path / "run.rrd")
    sent = [message for topic, message in run.outputs if topic == "/clearance" and isinstance(message, JointState)]
    for name, new_m in (("horizontal", 0.025), ("vertical", 0.030)):
        low, best, high = (scalars(tables[f"/growth/{name}{point}"]) for point in ("/p05", "", "/p95"))
        index = sent[0].name.index(name)
        np.testing.assert_allclose(best, [1e6 * (m.position[index] - new_m) for m in sent], rtol=0, atol=1e-9)
        assert 0.0 < low[-1] < 0.2 * best[-1] < best[-1] < 0.2 * high[-1]
        # the legend shows the colour of the first stroke of a band, so this stroke is not faint
        colors = tables[f"/growth/band/{name} colors"]["SeriesLines:colors"].to_pylist()
        assert [color[0] & 0xFF for color in colors] == [255, layout._BAND_ALPHA]


def test_the_cross_section_moves_with_the_head(run: Run, view: tuple[ViewSummary, dict[str, pa.Table]]) -> None:
    summary, tables = view
    poses = [message for _, message in run.outputs if isinstance(message, Odometry)][::10]
    head = tables["/section/head"]
    assert len(head) == summary.section_rows == len(poses) == COUNT // 10
    cavity = np.array([355.0, 300.0])
    for strips, pose in zip(head["LineStrips2D:strips"].to_pylist(), poses, strict=True):
        inner = np.array(strips[0])[:4]
        # the drawing is in mm with y down; its centre is the pose, and its first side is the top side, rotated by theta
        centre = inner.mean(axis=0)
        np.testing.assert_allclose(centre, [1e3 * pose.position[0], -1e3 * pose.position[1]], atol=1e-3)
        top = inner[1] - inner[0]
        theta = 2.0 * np.arctan2(pose.orientation[2], pose.orientation[3])
        np.testing.assert_allclose(top, cavity[0] * np.array([np.cos(theta), -np.sin(theta)]), atol=1e-3)
    arrows = [len(row or []) for row in tables["/section/force"]["Arrows2D:vectors"].to_pylist()]
    assert max(arrows) >= 2 and len(arrows) == len(head)


@pytest.mark.parametrize("follow", [(), ("--follow", "--wait", "0")])
def test_a_full_disk_is_reported_and_leaves_no_incomplete_file(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], follow: tuple[str, ...]
) -> None:
    out, before = tmp_path / "run.rrd", resource.getrlimit(resource.RLIMIT_FSIZE)
    command = ["view", str(run.file), "--out", str(out), "--quiet", *follow]
    assert cli(command) == 0  # the kernels are in the cache from now on
    for room in (0, 1000, 10_000, out.stat().st_size // 2):
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
        try:
            assert cli(command) == 1
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert not out.exists()
        assert capsys.readouterr().err == f"plow-twin: {out}: cannot be written: File too large\n"


def test_forces_along_the_face_measured_poses_and_other_scenes_are_drawn(tmp_path: Path) -> None:
    entries: list[Entry] = []
    scene = load_scene(scene_path("paper"))
    twin, offset = Twin(scene, excitation="sampled"), np.array([1e-3, -5e-4, 2e-3])
    for index in range(COUNT):
        sample = paper_sample(index)
        if index in (0, 700):  # the second speed is given before it takes effect
            entries.append(Travel(BASE_NS + (index and 999) * STEP_NS, -2.0 if index else 2.0))
        entries.append(sample)
        pose = twin.advance(index * 1e-3, sample.wrench).q + offset
        if index % 10 == 0:
            entries.append(Pose(sample.stamp_ns, tuple(pose.tolist())))
    wear = Wear(1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0, prior_m2_n=(1e-15, 1e-13))
    run = record_run(tmp_path / "run", entries, wear=wear)
    wide = replace(scene, clearance=replace(scene.clearance, horizontal_m=0.05))
    to_rrd(run.file, tmp_path / "run.rrd", others={"the same": scene, "wide": wide})
    tables = read(tmp_path / "run.rrd")
    # the face is passed there and back; the second pass ends half way
    first, second = tables["/face/force"]["LineStrips2D:strips"].to_pylist()[-1][1:]
    assert first[0][0] < 10.0 and first[-1][0] > 290.0 and 140.0 < second[0][0] < 160.0
    assert "2 m" in tables["/face/ticks"]["Points2D:labels"].to_pylist()[-1]
    for name, value in (("x", 1.0), ("y", -0.5), ("theta", 2.0)):
        residual = scalars(tables[f"/residual/{name}"])
        assert len(residual) >= COUNT // 10 - 1
        # the poses are from a twin whose pads do not wear, so the tolerance is larger
        np.testing.assert_allclose(residual, value, atol=0.01)
    largest, same, other = (scalars(tables[f"/what_if/{number}"]) for number in range(3))
    np.testing.assert_allclose(same, largest, rtol=0.01, atol=1.0)
    assert len(same) == COUNT and np.abs(other - largest).max() > 10.0
    # bars and texts at the corners of the frame show the depths of the pads
    depths = tables["/exaggerated/pads/wear"]["Points2D:labels"].to_pylist()[-1]
    assert len(depths) == 8 and all(depth.endswith(" µm") for depth in depths)
    for group in ("clearance", "growth"):
        band, low, high = (
            scalars(tables[f"/{group}/{part}"]) for part in ("band/vertical", "vertical/p05", "vertical/p95")
        )
        assert band.min() >= low.min() and high[-2] <= band.max() <= high.max()


def test_samples_that_come_too_late_for_other_scenes_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = RunReader.batches

    def divided(reader: RunReader, **options: bool) -> Iterator[Batch]:
        """Samples are sorted within a batch, so a sample can be too late only if it is in a later batch."""
        for batch in batches(reader, **options):
            yield from (Batch(batch.entries[index : index + 1], []) for index in range(len(batch.entries)))
            yield Batch(NO_ENTRIES, batch.outputs)

    monkeypatch.setattr(RunReader, "batches", divided)
    entries: list[Entry] = [paper_sample(index) for index in range(60)]
    entries[50:50] = [replace(paper_sample(20), stamp_ns=entries[20].stamp_ns + 1)]
    run = record_run(tmp_path / "run", entries, rollback_span_s=1.0)
    lost = [
        to_rrd(run.file, tmp_path / "run.rrd", others=others).lost
        for others in ({}, {"the same": load_scene(scene_path("paper"))})
    ]
    assert lost == [{}, {"samples_too_late": 1}] and analyse(run.file).lost == lost[1]


def test_each_change_of_the_corners_that_carry_force_is_drawn(
    run: Run, view: tuple[ViewSummary, dict[str, pa.Table]]
) -> None:
    forces = [m for topic, m in run.outputs if topic == "/contact_forces" and isinstance(m, JointState)]
    masks = masks_of(np.array([message.effort for message in forces]))
    states = [row[0] for row in view[1]["/contact_set"]["StateChange:state"].to_pylist()]
    assert len(states) == 1 + np.count_nonzero(np.diff(masks)) and states[0] == "free"
    assert {state.split()[0] for state in states} == {"free", "ccw", "cw"}
    assert set_color(0b1) != set_color(0b10) != set_color(0)


def test_a_touch_ends_at_the_right_time_in_a_thinned_run(tmp_path: Path) -> None:
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "sets.rrd")
    sets = ContactSets(stream, TimeAxis(), ("a", "b", "c", "d"), span_ns=40)
    touching = [0] * 5 + [1, 1] + [0] * 93 + [1] * 100
    force = np.outer(touching, [1e3] + [0.0] * 7)
    stamps = np.arange(0, 2000, 10)
    for some in (slice(0, 6), slice(6, 150), slice(150, 200)):
        sets.add(stamps[some], np.arange(200)[some], force[some])
    sets.finish()
    sets.flush()
    stream.flush()
    stream.disconnect()
    found = read(tmp_path / "sets.rrd")["/contact_set"]
    times = found["ros_time"].combine_chunks().cast(pa.int64()).to_pylist()
    states = [row[0] for row in found["StateChange:state"].to_pylist()]
    assert list(zip(times, states, strict=True)) == [(0, "free"), (50, "ccw a"), (80, "free"), (1000, "ccw a")]


def test_finished_pieces_are_not_redrawn(tmp_path: Path) -> None:
    """The pieces are a load that has decreased to zero, a held load, and the wear of replaced pads."""
    wear = Wear(1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0)
    end = BASE_NS + 1000 * STEP_NS
    silent: list[Entry] = [Hold(end), *(Unload(end + index * 10 * STEP_NS) for index in range(1, 30))]
    new = SetWear(end + 300 * STEP_NS, (0.0,) * 8, "new pads")
    still = [Unload(new.stamp_ns + index * 100 * STEP_NS) for index in range(1, 21)]
    after = [paper_sample(index) for index in range(3400, 5000)]
    run = record_run(tmp_path / "run", [*map(paper_sample, range(1000)), *silent, new, *still, *after], wear=wear)
    tables = read(to_rrd(run.file, tmp_path / "run.rrd").path)
    load = scalars(tables["/load/fx"])
    held = paper_sample(999).wrench[0] / 1e3
    assert load[999] == load[1000] == held != 0.0 and set(load[1001:1030]) == {0.0}
    labels = [row[0] for row in tables["/section/load"]["Arrows2D:labels"].to_pylist()]
    assert labels.count("load 0 kN, +0 kN m") == 29 + 20
    drawn = [len(row) for row in tables["/exaggerated/pads"]["Boxes2D:half_sizes"].to_pylist()]
    assert 0 in drawn[1:] and drawn[0] and drawn[-1]


def test_an_arrow_has_the_direction_of_the_force_on_the_head() -> None:
    section = Section.of(load_scene(scene_path("paper")))
    force = np.zeros(8)
    force[2] = 1e5  # at the top right corner, the top wall pushes the head up, which is -y on the screen
    origins, vectors, pairs = section.arrows((0.0, 0.0, 0.0), force)
    np.testing.assert_allclose(origins, [[165.0, -135.0]])
    np.testing.assert_allclose(vectors, [[0.0, -ARROW_MM_PER_N * 1e5]], atol=1e-9)
    assert list(pairs) == [2]


def test_a_block_moves_in_its_guide_and_a_wall_pushes_its_corner_inwards() -> None:
    scene = load_scene("paper")
    section = Section.of(replace(scene, head=replace(scene.head, carries="corners")))
    np.testing.assert_allclose(np.abs(section.frame_strip()).max(axis=0), 0.5 * section.cavity)
    # after a rotation by more than 45 degrees, the former bottom right corner is the top right corner
    pose = (0.01, 0.02, 0.5 * np.pi + 0.1)
    (outline,) = section.head_strips(pose)
    corners = section.corners(pose)
    assert corners[CORNER_NAMES.index("top_right")] == pytest.approx(outline[CORNER_NAMES.index("bottom_right")])
    force = np.zeros(8)
    force[PAIR_NAMES.index("bottom_left_bottom")] = 1e5
    origins, vectors, _ = section.arrows(pose, force)
    np.testing.assert_allclose(origins, corners[[CORNER_NAMES.index("bottom_left")]])
    np.testing.assert_allclose(vectors, [[0.0, -ARROW_MM_PER_N * 1e5]], atol=1e-9)  # up is -y on the screen


def test_events_show_touches_and_the_end_of_the_file(
    run: Run, view: tuple[ViewSummary, dict[str, pa.Table]], tmp_path: Path
) -> None:
    summary, tables = view
    lines = [text[0] for text in tables["/events"]["TextLog:text"].to_pylist()]
    assert len(lines) == summary.events and any("touches" in line for line in lines)
    data = run.file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: 2 * len(data) // 3])
    short = to_rrd(cut, tmp_path / "cut.rrd")
    assert short.status is FileStatus.TRUNCATED and 0 < short.curve_rows < COUNT
    assert "truncated" in read(short.path)["/events"]["TextLog:text"].to_pylist()[-1][0]


def test_only_changes_of_the_travel_speed_are_events(tmp_path: Path) -> None:
    speeds = [1.5] * 20 + [0.0] * 20 + [1.5] * 20
    entries = [Travel(BASE_NS + index * STEP_NS, speed) for index, speed in enumerate(speeds)]
    run = record_run(tmp_path / "run", [paper_sample(0), *entries, paper_sample(100)])
    to_rrd(run.file, tmp_path / "run.rrd")
    lines = [text[0] for text in read(tmp_path / "run.rrd")["/events"]["TextLog:text"].to_pylist()]
    expected = [f"travel along the face at {speed} m/s" for speed in ("1.5", "0", "1.5")]
    assert [line for line in lines if "travel" in line] == expected


def test_a_long_run_is_thinned_without_losing_a_peak(run: Run, tmp_path: Path) -> None:
    thin = to_rrd(run.file, tmp_path / "thin.rrd", most_rows=200)
    sent = [m for topic, m in run.outputs if topic == "/contact_peaks" and isinstance(m, JointState)]
    efforts = np.array([message.effort for message in sent])
    tables = read(thin.path)
    for pair, name in enumerate(PAIR_NAMES):
        values = scalars(tables[f"/force/{name}"])
        # a span has at most three values; the end of a batch ends a span too
        assert len(values) <= 750 < COUNT and values.max() == efforts[:, pair].max() / 1e3
    assert thin.section_rows < COUNT // 10


def test_places_of_extremes_are_in_order() -> None:
    spans, values = np.array([0, 0, 0, 1, 1, 2]), np.array([1.0, 5.0, -2.0, 3.0, 3.0, 7.0])
    assert np.flatnonzero(extremes(spans, values[:, None])).tolist() == [1, 2, 3, 5]


def test_gaps_are_drawn_with_the_requested_factor_and_the_wear() -> None:
    section = Section.of(load_scene(scene_path("paper")))
    gaps = np.array([-0.01, -0.02, -0.01, -0.03, -0.005, -0.03, -0.005, 0.001])
    walls, touching = section.exaggerated(gaps, 2.0)
    top, right, bottom, left = walls
    # the top gap of 10 mm is drawn twice as wide, and y points down
    np.testing.assert_allclose(top[:, 1], -(135.0 + 20.0))
    np.testing.assert_allclose(right[:, 0], 165.0 + 60.0)
    np.testing.assert_allclose(bottom[:, 1], 135.0 + 10.0)
    # the left wall is inclined, and passes through its points beside the corners
    slope = (left[0, 0] - left[1, 0]) / (left[0, 1] - left[1, 1])
    np.testing.assert_allclose(
        left[0, 0] + slope * (np.array([-135.0, 135.0]) - left[0, 1]), [-165.0 - 40.0, -165.0 + 2.0]
    )
    np.testing.assert_allclose(walls[:, 1], np.roll(walls[:, 0], -1, axis=0))  # the outline is closed
    assert touching.tolist() == [False, False, False, True]


def test_wear_depths_are_printed_inside_the_frame_without_overlap() -> None:
    section = Section.of(load_scene(scene_path("paper")))
    places = section.pads(np.full(8, 1e-3))[2]
    assert (np.abs(places) < [0.3 * section.frame[0], 0.4 * section.frame[1]]).all()
    column = np.sort(places[places[:, 0] < 0.0][:, 1])
    assert len(column) == 4 and np.diff(column).min() > 1.5 * LABEL_MM


def test_a_picture_needs_no_viewer(run: Run, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rerun'] = None\n"
        "from plow_twin.cli import main; main(['view', sys.argv[1], '--png', sys.argv[2], '--quiet'])"
    )
    command = [sys.executable, "-c", code, str(run.folder), str(tmp_path / "run.png")]
    completed = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert completed.returncode == 0, completed.stderr
    assert (tmp_path / "run.png").read_bytes()[:4] == b"\x89PNG" and (tmp_path / "run.png").stat().st_size > 50_000


def test_a_picture_shows_only_contents_of_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = kept_figures(monkeypatch)
    journal = [Parameter("hold", "hold"), *map(paper_sample, range(100))]
    run = record_run(tmp_path / "run", journal, frame_every=10**9)
    to_png(run.folder, tmp_path / "run.png")
    section, wide, force, load, clearance = figures[0].axes
    texts = [axis.texts[0].get_text() for axis in (section, wide, force, clearance)]
    assert all(text.endswith("in the recording") for text in texts) and not section.lines and load.lines


def test_a_run_without_a_row_has_no_picture(tmp_path: Path) -> None:
    empty = record_run(tmp_path / "run", ())
    with pytest.raises(RecordingError, match=r"run_0\.mcap: got no row to draw"):
        to_png(empty.folder, tmp_path / "run.png")
    assert not (tmp_path / "run.png").exists()


def test_progress_runs_from_the_first_record_to_the_whole(run: Run, tmp_path: Path) -> None:
    shares: list[float] = []
    to_rrd(run.file, tmp_path / "run.rrd", on_progress=shares.append)
    assert len(shares) > 1 and shares == sorted(shares) and shares[-1] == 1.0


def test_an_unwritable_path_is_named(run: Run, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        to_rrd(run.file, blocked / "run.rrd")


def test_contact_sets_are_visible_in_a_low_window() -> None:
    blueprint = layout.blueprint(Section.of(load_scene(scene_path("paper"))), 3.0)
    curves = blueprint.root_container.contents[1]
    names = [getattr(part, "name", None) for part in curves.contents]
    share = curves.row_shares[names.index("Corners that carry force")] / sum(curves.row_shares)
    # in a window of 1000 x 620 pixels, the curves have a height of 555; the contact sets need 87 for lane, title and
    # axis
    assert share * 555.0 > 87.0


def test_the_legends_of_the_clearance_are_complete_in_a_low_window(
    view: tuple[ViewSummary, dict[str, pa.Table]],
) -> None:
    curves = layout.blueprint(Section.of(load_scene(scene_path("paper"))), 3.0).root_container.contents[1]
    # the title and the axis of the plot take 46 pixels
    height = curves.row_shares[-1] / sum(curves.row_shares) * 555.0 - 46.0
    for group in ("growth", "clearance"):
        names = {
            name
            for entity, name in curve_names(view[0].path).items()
            if entity.startswith(f"/{group}/") and not entity.endswith(("/p05", "/p95"))
        }
        # each line of a legend takes 23 pixels, and equal names share a line; with 94 of 112 pixels, a legend lost its
        # last line
        assert names >= {"horizontal", "vertical"} and 23 * len(names) + 2 < 0.77 * height


def test_no_line_is_drawn_over_a_missing_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = map(paper_sample, range(100)), (paper_sample(index) for index in range(100, 3000))
    entries = [*first, Reset(BASE_NS + 99 * STEP_NS, "asked for"), *second]
    run = record_run(tmp_path / "run", entries, part_bytes=200_000, flush_period_s=0.01, chunk_size=50_000)
    whole = read(to_rrd(run.folder, tmp_path / "whole.rrd").path)
    # the only empty value belongs to the reset
    assert [scalar for scalar in whole["/load/fx"]["Scalars:scalars"].to_pylist() if not scalar] == [[]]
    RunReader(run.folder).parts[1].unlink()
    before, after = (sample.stamp_ns for sample in journal_around_the_hole(run.folder))
    for most_rows in (10**6, 300):  # once with all rows, and once thinned
        summary = to_rrd(run.folder, tmp_path / "run.rrd", most_rows=most_rows)
        tables = read(summary.path)
        assert summary.lost == {"missing_parts": 1}
        for name in ("/load/fx", f"/force/{PAIR_NAMES[0]}", "/growth/horizontal"):
            table = tables[name]
            stamps = np.array(table["ros_time"].cast(pa.int64()).to_pylist())
            ends = stamps[[not scalar for scalar in table["Scalars:scalars"].to_pylist()]]
            # clearances are published at 10 Hz, so their curves end up to 0.1 s earlier
            behind = ends - np.array([entries[99].stamp_ns, before])
            assert (behind > -(10**8)).all() and (behind <= 1).all() and after - before > 10**8
        assert [state for state in tables["/contact_set"]["StateChange:state"].to_pylist() if not state] == [[], []]
    lines = [text[0] for text in tables["/events"]["TextLog:text"].to_pylist()]
    assert lines[-1] == "recording: 1 missing parts" and sum("are missing after this" in line for line in lines) == 1
    figures = kept_figures(monkeypatch)
    assert cli(["view", str(run.folder), "--png", str(tmp_path / "run.png")]) == 3
    assert "lost missing_parts: 1" in capsys.readouterr().err
    for axis in figures[0].axes[2:]:
        for times in (np.asarray(line.get_xdata(), float) for line in axis.lines):
            if times.min() == times.max():
                continue  # this line marks an instant
            assert np.isnan(times).sum() == 2 and np.nanmax(np.diff(times)) < 0.11
