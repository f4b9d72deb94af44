"""Analysis of recordings of other programs: bias and delay of a sensor, all kinds of files, and damage."""

from __future__ import annotations

import csv
import json
import random
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rainflow
from bag_support import BIAS, COUNT, LAG_S, PAPER, STORE, measured, motion, pose_message, wrench_message, write_bag
from commands import plow_twin
from pyarrow import parquet
from record_support import BASE_NS, STEP_NS, paper_sample, record_run
from rosbags.rosbag2 import StoragePlugin, Writer
from scenes import ROOT

from plow_twin import Initial, Support, Wear
from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.bag import BagWriter, Topic
from plow_twin.record.cdr import schema_text, type_hash
from plow_twin.record.measured import read_recording
from plow_twin.record.reader import RunReader
from plow_twin.record.replay import replay
from plow_twin.run.energy_balance import elastic_energy
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.stream.journal import Entry, Pose, Restore, SetModel, Travel
from plow_twin.stream.session import Session
from plow_twin.study.analysis import loads, thinned
from plow_twin.study.analysis.analyse import Analysis, analyse
from plow_twin.study.analysis.loads import LoadTotals, reversals
from plow_twin.study.analysis.report import _write_tables, write_report
from plow_twin.study.analysis.signals import LARGEST_LAG_S, compare

BEST_FIT = PAPER.with_name("paper_best_fit.yaml")


def check(analysis: Analysis, bias: tuple[float, ...] = BIAS) -> None:
    signals = analysis.comparisons(analysis.predictions[0])
    assert set(signals) == {"x", "y", "theta"}
    for name, expected in zip(signals, bias, strict=True):
        signal = signals[name]
        assert signal.lag_s == pytest.approx(LAG_S, abs=0.004), name
        assert signal.bias == pytest.approx(expected, abs=4e-4), name
        assert signal.rms >= abs(signal.bias) and signal.correlation is not None and signal.correlation > 0.5


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_an_analysis_of_a_bag_finds_bias_and_lag_and_writes_a_run(plugin: StoragePlugin, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", motion(), plugin)
    analysis = analyse(bag, scene=PAPER, mapping=tmp_path / "map.yaml", out=tmp_path / "out")
    check(analysis)
    assert analysis.input == {"samples_in": COUNT, "samples_used": COUNT} and not analysis.lossy
    assert RunReader(tmp_path / "out" / "run").duration_s() == pytest.approx(COUNT * 1e-3, abs=0.01)
    report = replay(tmp_path / "out" / "run")
    assert (report.exit_code, report.samples, report.digests_compared) == (0, COUNT, COUNT // 100 + 1)
    assert report.compared["contact_forces"] == COUNT


def test_csv_files_are_read_by_their_columns(tmp_path: Path) -> None:
    with (tmp_path / "load.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["t", "fx", "fy", "m"])
        rows.writerows([t, *wrench] for t, wrench in zip(motion()[0], motion()[1], strict=True))
    with (tmp_path / "pose.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["t", "x", "y", "theta"])
        rows.writerows([t, q[0], "", q[2]] for t, q in measured(motion()))
    analysis = analyse(tmp_path, scene=PAPER)
    signals = analysis.comparisons(analysis.predictions[0])
    assert set(signals) == {"x", "theta"}  # the cells of y are empty, so y was not measured
    assert signals["x"].lag_s == pytest.approx(LAG_S, abs=0.004)


def test_values_of_another_clock_and_impossible_values_are_counted(tmp_path: Path) -> None:
    load, pose = tmp_path / "load.csv", tmp_path / "pose.csv"
    rows = [f"{t},{w[0]},{w[1]},{w[2]}\n" for t, w in zip(motion()[0][:500], motion()[1], strict=False)]
    load.write_text("t,fx,fy,m\n" + "".join(rows))
    poses = [(0.01 + 0.01 * n, [n * 1e-5, 0.0, 0.0]) for n in range(40)]
    poses[7][1][0] = 1e200
    pose.write_text("t,x,y,theta\n" + "".join(f"{t},{x},{y},{theta}\n" for t, (x, y, theta) in poses))
    analysis = analyse(tmp_path, scene=PAPER)
    assert analysis.lost == {"measured_implausible": 1} and analysis.lossy
    facts = json.loads(json.dumps(analysis.facts(), allow_nan=False))
    assert facts["signals"]["x"]["n"] == 39 and facts["lost"] == analysis.lost
    assert "outside" not in facts
    late = ((t + 0.3, x, "", "") if t < 0.3 else (t + 1e6, "", y, "") for t, (x, y, _) in poses)
    pose.write_text("t,x,y,theta\n" + "".join(f"{t},{x},{y},{theta}\n" for t, x, y, theta in late))
    analysis = analyse(tmp_path, scene=PAPER, out=tmp_path / "out")
    assert analysis.facts()["outside"] == {"x": 10, "y": 11} and analysis.facts()["signals"]["x"]["n"] == 18
    # no value of y is within the time of the load
    assert analysis.lost == {"measured_implausible": 1, "measured_outside_the_load": 11}
    write_report(analysis, tmp_path / "out")
    assert "outside the time of the load" in (tmp_path / "out" / "report.html").read_text()
    pose.write_text("t,x,y,theta\n" + "".join(f"{t + 1e6},{0},{y},{theta}\n" for t, (_, y, theta) in poses))
    analysis = analyse(tmp_path, scene=PAPER)
    assert analysis.lost == {"measured_outside_the_load": 120} and analysis.lossy and analysis.facts()["signals"] == {}


def test_other_scenes_are_predicted_in_the_same_pass(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", motion(), StoragePlugin.MCAP)
    words = ["analyse", bag, "--scene", "paper", "--with", BEST_FIT, "--map", tmp_path / "map.yaml"]
    completed = plow_twin(*words, "--out", tmp_path / "out", "--json")
    assert completed.returncode == 0, completed.stderr
    facts = json.loads(completed.stdout)
    assert set(facts["signals"]["x"]) >= {"n", "bias", "rms", "correlation", "lag_s"}
    assert facts["with"][0]["scene"] == str(BEST_FIT)
    assert facts["with"][0]["signals"]["x"]["rms"] != facts["signals"]["x"]["rms"]
    page = (ROOT / "docs" / "analysis.md").read_text()
    assert all(f"`{key}`" in page for key in (*facts, *facts["loads"]))
    loads = facts["loads"]
    assert sum(loads["impacts"].values()) > 5 and loads["cycles"] and loads["contact_loss_j"] > 0.0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {"report.html", "analysis.json", "predicted.parquet", "predicted_1.parquet", "measured.parquet"}


def test_a_run_of_plow_twin_is_analysed_from_its_journal(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(1000)), frame_every=10**9)
    analysis = analyse(run.folder)
    assert (
        analysis.input == {"samples_used": 1000}
        and not analysis.lossy
        and not analysis.comparisons(analysis.predictions[0])
    )
    assert analysis.predictions[0].loads.duration_s == pytest.approx(0.999)


def test_poses_in_the_journal_are_measurements(tmp_path: Path) -> None:
    entries: list[Entry] = [paper_sample(index) for index in range(500)]
    entries[20::21] = [Pose(BASE_NS + index * STEP_NS, (1e-3, 2e-3, 3e-3)) for index in range(20, 500, 21)]
    run = record_run(tmp_path / "run", entries)
    analysis = analyse(run.folder)
    assert {name: one.n for name, one in analysis.comparisons(analysis.predictions[0]).items()} == dict.fromkeys(
        ("x", "y", "theta"), len(range(20, 500, 21))
    )


def test_the_prediction_of_a_run_includes_changes_of_the_model(tmp_path: Path) -> None:
    """The forces are the recorded forces despite parameter changes, a restored motion, poses and speeds."""
    samples = [*map(paper_sample, range(1500))]
    session = Session(Twin(load_scene(PAPER), excitation="sampled"))
    for sample in samples[:400]:
        session.apply(sample)
    changes = SetModel(samples[599].stamp_ns, json.dumps({"contact.stiffness": 3e7, "clearance.vertical_m": 0.02}))
    again = Restore(samples[999].stamp_ns, session.snapshot().data)
    poses = [Pose(sample.stamp_ns, (0.0, 0.0, 0.0)) for sample in samples]
    entries = [entry for both in zip(samples, poses, strict=True) for entry in both]
    # the second speed is given before it takes effect
    speeds = [Travel(BASE_NS, 1.0), Travel(BASE_NS + 300 * STEP_NS, -1.0)]
    entries = [*entries[:2], *speeds, *entries[2:1200], changes, *entries[1200:2000], again, *entries[2000:]]
    run = record_run(tmp_path / "run", entries, frame_every=1)
    peaks = [message for topic, message in run.outputs if topic.endswith("contact_peaks")]
    (tmp_path / "other.yaml").write_text(dump_scene(load_scene(PAPER)))
    mine, other = analyse(run.folder, others=[tmp_path / "other.yaml"]).predictions
    force = np.array([message.effort for message in peaks])
    assert force[:1200].any() and force[1200:].any()
    assert mine.loads.impulse == pytest.approx(sum(message.velocity for message in peaks), rel=1e-9)
    np.testing.assert_array_equal(mine.loads.largest, force.max(axis=0))
    assert other.loads.impulse != pytest.approx(mine.loads.impulse, rel=0.01)
    # a sample may be alone between other entries, but the cycles are those of the whole series
    for name, counted in mine.loads.cycles().items():
        whole = rainflow.count_cycles(force[:, PAIR_NAMES.index(name)], nbins=loads.CYCLE_BINS)
        assert [one["count"] for one in counted] == [count for _, count in whole]
    assert [item.start_s for item in mine.loads.passes] == pytest.approx([0.0, 0.301], abs=1e-9)


def test_late_samples_of_a_run_are_inserted_at_their_stamps(tmp_path: Path) -> None:
    samples = [*map(paper_sample, range(1000))]
    entries: list[Entry] = sorted(samples, key=lambda one: (n := one.stamp_ns - BASE_NS) + 5.5 * STEP_NS * (n % 7 == 3))
    entries[500:500] = [Pose(BASE_NS, (0.0, 0.0, 0.0))] * 3
    analysis = analyse(record_run(tmp_path / "run", entries, frame_every=10**9, rollback_span_s=1.0).folder)
    assert analysis.input == {"samples_used": 1000} and not analysis.lost
    twin = Twin(load_scene(PAPER), excitation="sampled")
    series = twin.advance_samples(1e-3 * np.arange(1000), np.array([sample.wrench for sample in samples]))
    assert analysis.predictions[0].loads.impulse == pytest.approx(series.impulse.sum(axis=0), rel=1e-9)


def test_a_measured_gap_is_compared_with_the_distance_to_the_wall(tmp_path: Path) -> None:
    load = np.column_stack(motion()[:2])[:1000]
    pair = PAIR_NAMES.index("top_right_right")
    penetration = Twin(load_scene(PAPER), excitation="sampled").advance_samples(load[:, 0], load[:, 1:]).penetration
    gap = np.column_stack([load[:, 0], 1e-3 - penetration[:, pair]])  # the gap is too large by 1 mm
    for name, rows, header in (("load", load, "t,fx,fy,m"), ("gaps", gap, "t,top_right_right")):
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=header, comments="")
    analysis = analyse(tmp_path, scene=PAPER)
    signal = analysis.comparisons(analysis.predictions[0])["gap_top_right_right"]
    assert signal.bias == pytest.approx(-1e-3, abs=1e-6) and signal.correlation == pytest.approx(1.0, abs=1e-6)


def test_messages_beside_a_run_that_do_not_fit_are_counted_by_topic(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(100)))
    messages = [("/pose", pose_message(0 if i == 3 else BASE_NS + i * 10**7, (1e-3, 0.0, 0.0))) for i in range(10)]
    with Writer(run.folder / "beside", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/pose", "geometry_msgs/msg/PoseStamped", typestore=STORE)
        for number, (_, data) in enumerate(messages):
            writer.write(connection, BASE_NS + number * 10**7, data)
    analysis = analyse(run.folder)
    assert analysis.lost == {"unfit, head_pose: /pose has stamps of 0": 1}
    (mapping := tmp_path / "map.yaml").write_text("head_pose: {topic: /pose, fields: {x: pose.x}}")
    analysis = analyse(run.folder, mapping=mapping)
    assert analysis.lost == {"unfit, head_pose: /pose has no number at 'pose.x' for x": 10} and analysis.lossy


def test_a_partial_recording_beside_a_run_is_read_to_its_end_and_its_loss_counted(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(1000)))
    for name, data in (("beside", b""), ("beside_2", b"no such file")):
        (run.folder / name).mkdir()
        (run.folder / name / f"{name}_0.mcap").write_bytes(data)
    text = "geometry_msgs/msg/PoseStamped"
    writer = BagWriter(run.folder / "beside_3")
    number = writer.topic(Topic("/pose", text, schema_text(text), type_hash(text), "[]"))
    for index in range(90):
        stamp = BASE_NS + index * 10**7
        writer.add(number, index, stamp, stamp, bytes(pose_message(stamp, (1e-3, 0.0, 0.0))))
        writer.flush()
    writer.lost["/pose"] = 7  # a loss that the recorder has counted, for example on a full disk
    writer.close()
    counted = {"truncated_files": 1, "damaged_files": 1, "/pose": 7}
    analysis = analyse(run.folder)
    assert analysis.lost == counted and analysis.comparisons(analysis.predictions[0])["x"].n == 90
    assert read_recording(run.folder).lost == counted
    writer.path.write_bytes(writer.path.read_bytes()[:8000])
    analysis = analyse(run.folder)
    assert (
        analysis.lost == {**counted, "truncated_files": 2}
        and 10 < analysis.comparisons(analysis.predictions[0])["x"].n < 90
    )


def test_a_stamp_unit_without_a_stamp_column_is_refused(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("clock,fx,fy,m\n" + "".join(f"{t},0,0,0\n" for t in range(100)))
    mapping = tmp_path / "map.yaml"
    for stamp, message in (
        ("", "with the name of its column: the columns clock, fx, fy, m have none of"),
        ("stamp: log, ", "no stamp_unit with stamp: log"),
    ):
        mapping.write_text(f"excitation: {{topic: load, {stamp}stamp_unit: ms}}")
        with pytest.raises(RecordingError, match=f"excitation.stamp_unit: got 'ms', expected .*{message}"):
            analyse(tmp_path, scene=PAPER, mapping=mapping)
    mapping.write_text("excitation: {topic: load, stamp: clock, stamp_unit: ms}")
    assert analyse(tmp_path, scene=PAPER, mapping=mapping).predictions[0].loads.duration_s == pytest.approx(0.099)
    (bag := tmp_path / "bag").mkdir()
    kind = "geometry_msgs/msg/WrenchStamped"
    with Writer(bag / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/load", kind, typestore=STORE)
        writer.write(connection, BASE_NS, wrench_message(BASE_NS, (0.0, 0.0, 0.0)))
    mapping.write_text("excitation: {topic: /load, stamp_unit: ms}")
    with pytest.raises(RecordingError, match=f"stamp_unit: got 'ms', expected no stamp_unit: {kind} has stamps in ns"):
        analyse(bag / "run", scene=PAPER, mapping=mapping)


def test_a_smaller_unit_of_dates_is_named(tmp_path: Path) -> None:
    rows = "".join(f"{BASE_NS + 10**6 * row},0,0,0\n" for row in range(100))
    (load := tmp_path / "load.csv").write_text(f"timestamp,fx,fy,m\n{rows}")
    with pytest.raises(RecordingError, match=r"'timestamp' in s \(the numbers look like ns: stamp_unit: ns\)"):
        analyse(load, scene=PAPER)
    assert analyse(load, scene=PAPER, units={"t": "ns"}).predictions[0].loads.duration_s == pytest.approx(0.099)


def test_the_travel_determines_the_passes_of_the_face(tmp_path: Path) -> None:
    with (tmp_path / "load.csv").open("w") as stream:
        stream.write("t,fx,fy,m\n")
        stream.writelines(f"{t},{w[0]},{w[1]},{w[2]}\n" for t, w in zip(motion()[0], motion()[1], strict=True))
    (tmp_path / "travel.csv").write_text("t,speed\n0.5,2.0\n4.0,-2.0\n")
    wear = Wear(1e-12, 0.015, 0.0, pad_length_m=0.3)
    worn = replace(load_scene(PAPER), wear=wear)
    (scene := tmp_path / "worn.yaml").write_text(dump_scene(worn))
    prediction = analyse(tmp_path, scene=scene, out=tmp_path / "out").predictions[0]
    loads = prediction.loads
    assert len(loads.passes) == 2 and sum(item.impacts for item in loads.passes) == loads.impacts.sum()
    assert loads.passes[0].end_m == pytest.approx(7.0, abs=0.01) and loads.passes[1].end_m == pytest.approx(
        -1.0, abs=0.01
    )
    assert replay(tmp_path / "out" / "run").exit_code == 0
    again = analyse(tmp_path / "out" / "run").predictions[0].loads
    np.testing.assert_array_equal(again.impacts, loads.impacts)
    # the journal contains the direction of travel, so passes and wear are equal
    assert len(again.passes) == 2
    assert again.pad_wear == pytest.approx(loads.pad_wear, rel=1e-12)
    facts = loads.wear_facts()
    assert facts is not None and loads.pad_wear[0].max() > 0.0 < loads.pad_wear[1].max()
    # the sum of the wear of the pads in both directions is the wear of the model
    assert loads.pad_wear.sum(axis=0) == pytest.approx(prediction.clearance.series()[1][-1][2:10], rel=0.03)
    # the total wear of the slide is the wear of the pads times the ratio of pad length to distance; a pad wears each
    # place that it passes
    whole = np.array(list(facts["slide_mean_m"].values())) * facts["slide_pieces"]
    assert whole == pytest.approx(0.3 * loads.pad_wear.sum(axis=0), rel=1e-12)
    assert {backward for backward, _ in loads.slide_wear} == {0, 1}
    _write_tables(prediction, tmp_path, "")
    table = parquet.read_table(tmp_path / "slide_wear.parquet")
    assert table.num_rows == len(loads.slide_wear)

    # without measured speeds, the head travels at the speed in the scene
    (alone := tmp_path / "alone").mkdir()
    (tmp_path / "load.csv").rename(alone / "load.csv")
    scene.write_text(dump_scene(replace(worn, wear=replace(wear, travel_speed_m_s=2.0))))
    prediction = analyse(alone, scene=scene).predictions[0]
    only = prediction.loads
    assert [item.end_m for item in only.passes] == [pytest.approx(2.0 * only.duration_s)]
    assert only.pad_wear[0] == pytest.approx(prediction.clearance.series()[1][-1][2:10], rel=0.03)
    assert only.slide_wear and not only.pad_wear[1].any()


def test_a_late_speed_acts_from_its_stamp_on_as_in_the_twin(tmp_path: Path) -> None:
    entries: list[Entry] = [paper_sample(index) for index in range(301)]
    for place, late in ((290, -3), (250, 5), (150, 40)):
        entries.insert(place, Travel(BASE_NS + (place - late) * STEP_NS + 300_000, 1e-2 * place))
    run = record_run(tmp_path / "run", entries, wear=Wear(1e-9, 0.015, 2.0), rollback_span_s=0.1)
    depth = [message.position[2:10] for topic, message in run.outputs if topic.endswith("clearance")][-1]
    worn = analyse(run.folder).predictions[0].loads.pad_wear.sum(axis=0)
    assert worn.max() > 0.0 and worn == pytest.approx(np.array(depth), rel=1e-9)


@pytest.mark.parametrize("lag_s", [0.0, 0.0203, -0.4])
@pytest.mark.parametrize(("rate_hz", "times_each"), [(1000, 1), (1000, 2), (200, 1), (37, 1)])
def test_the_lag_is_found_at_any_rate_of_the_sensor(rate_hz: int, times_each: int, lag_s: float) -> None:
    """The lag is found even if the signal is slow compared with the recorded time, or if rows are repeated."""
    t = np.arange(0.0, 3.0, 1e-3)

    def signal(at: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(2.0 * at) + 0.2 * np.abs(np.sin(7.0 * at)) + 0.3 * at)

    at = np.repeat(np.arange(0.0, 3.0, 1.0 / rate_hz), times_each)
    comparison = compare(t, signal(t), at, signal(at - lag_s))
    assert comparison is not None and comparison.lag_s == pytest.approx(lag_s, abs=2e-4)
    assert comparison.rms_aligned == pytest.approx(0.0, abs=1e-3)


def test_lag_and_correlation_stay_within_their_bounds() -> None:
    t = np.arange(0.0, 40.0, 0.01)
    predicted = np.sin(2.0 * np.pi * t / 2.06)
    for factor in (-1.0, 1.1, 1.3):
        comparison = compare(t, predicted, t[::2], factor * predicted[::2])
        assert comparison is not None and comparison.lag_s is not None and comparison.correlation is not None
        assert abs(comparison.lag_s) <= LARGEST_LAG_S and abs(comparison.correlation) <= 1.0
        assert comparison.coherence is not None and comparison.coherence <= 1.0


def test_duty_is_a_share_of_time_at_any_sampling_rate(tmp_path: Path) -> None:
    """One load, linear between four knots, is given by its knots, or by many samples on the lines."""
    knots, count = np.array([0.0, 0.7, 1.5, 2.0]), 2001
    wrench = np.array([[0, 0, 0], [32e3, -11e3, -45e3], [-32e3, 11e3, 45e3], [0, 0, 0]])
    loads = {}
    for name, times in (("coarse", knots), ("fine", np.unique(np.append(np.linspace(0.0, 2.0, count), knots)))):
        values = np.column_stack([np.interp(times, knots, column) for column in wrench.T])
        (tmp_path / name).mkdir()
        np.savetxt(
            tmp_path / name / "load.csv", np.column_stack([times, values]), delimiter=",",
            header="t,fx,fy,m", comments="", fmt="%.12g",
        )  # fmt: skip
        loads[name] = analyse(tmp_path / name, scene=PAPER).predictions[0].loads
    coarse, fine = (np.array(list(loads[name].facts()["duty"].values())) for name in ("coarse", "fine"))
    assert 0.05 < fine.max() < 1.0
    assert coarse == pytest.approx(fine, abs=2e-3)
    # duty is the share of time in contact, not the share of the intervals with an impulse
    twin = Twin(load_scene(PAPER), excitation="sampled", tol=1e-9)
    force = twin.advance_samples(
        grid := np.arange(0.0, 2.0, 2e-5), np.column_stack([np.interp(grid, knots, column) for column in wrench.T])
    ).force
    assert fine == pytest.approx((force > 0.0).mean(axis=0), abs=1e-3)


@pytest.mark.parametrize("clock_s", [2.0, 3600.0])
def test_measured_values_are_compared_with_their_stretch(clock_s: float, tmp_path: Path) -> None:
    """The clock steps back, or ahead by an hour. The stretches before and after the step are predicted as measured."""
    times, wrench, q = motion()
    short = 3000
    weak = 0.3 * wrench[:short]
    after = Twin(load_scene(PAPER), excitation="sampled").advance_samples(times[:short], weak).q
    stretches = ((times, wrench, q), (times[:short] + clock_s, weak, after))
    load = np.concatenate([np.column_stack([t, w]) for t, w, _ in stretches])
    pose = np.concatenate([np.column_stack([t, w])[::10] for t, _, w in stretches])
    np.savetxt(tmp_path / "load.csv", load, delimiter=",", header="t,fx,fy,m", comments="")
    np.savetxt(tmp_path / "pose.csv", pose, delimiter=",", header="t,x,y,theta", comments="")
    facts = analyse(tmp_path, scene=PAPER).facts()
    assert facts["stretches"] == 2 and facts["not_compared"] == dict.fromkeys(("x", "y", "theta"), short // 10)
    for signal in facts["signals"].values():
        assert signal["n"] == COUNT // 10
        assert signal["rms"] == pytest.approx(0.0, abs=2e-5) and signal["correlation"] == pytest.approx(1.0, abs=1e-4)


# each rotation needs its own compiled kernel
@pytest.mark.parametrize("rotation", ["paper", pytest.param("consistent", marks=pytest.mark.stress)])
def test_contacts_under_gravity_dissipate_the_potential_energy(rotation: str, tmp_path: Path) -> None:
    """In flight, contacts dissipate nothing. Up to rest, they dissipate m g times the drop minus the stored energy."""
    scene = load_scene(PAPER)
    arm, height = scene.gravity.arm_m, 0.1
    assert arm > 0.1
    if rotation == "consistent":
        head = replace(scene.head, rotation="consistent", com_offset_m=(arm, height))
        scene = replace(scene, head=head, gravity=replace(scene.gravity, arm_m=0.0))
    (tmp_path / "scene.yaml").write_text(dump_scene(scene))
    weight = scene.head.mass_kg * scene.gravity.acceleration_m_s2
    for end in (0.03, 20.0):
        times = np.arange(0.0, end, 2e-3)
        run = Twin(scene, excitation="sampled").advance_samples(times, np.zeros((len(times), 3)))
        q, stored = run.q, elastic_energy(scene, run.penetration[-1])
        (tmp_path / "load.csv").write_text("t,fx,fy,m\n" + "".join(f"{t:.3f},0,0,0\n" for t in times))
        loads = analyse(tmp_path).predictions[0].loads
        theta = q[:, 2]
        if rotation == "consistent":
            level = q[:, 1] + np.sin(theta) * arm + np.cos(theta) * height
        else:
            level = q[:, 1] + theta * arm
        lost = weight * (level[0] - level[-1])
        assert lost > (1.0 if end < 1.0 else 400.0)
        assert loads.contact_loss_j == pytest.approx(0.0 if end < 1.0 else lost - stored, abs=0.05)
        assert loads.impulse.any() == (end > 1.0)


def test_energy_stored_at_the_start_of_a_recording_is_no_gain(tmp_path: Path) -> None:
    """Contacts almost without damping dissipate nothing, although 66 J are stored at the start of the recording."""
    scene = load_scene(PAPER)
    scene = replace(scene, initial=Initial(q=(0.0151, 0.0, 0.0)), contact=replace(scene.contact, damping=1e-9))
    (tmp_path / "scene.yaml").write_text(dump_scene(scene))
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n" + "".join(f"{0.002 * n},0,0,0\n" for n in range(200)))
    loads = analyse(tmp_path).predictions[0].loads
    assert loads.impulse.any() and loads.contact_loss_j == pytest.approx(0.0, abs=1e-3)
    on_springs = replace(scene, support=Support(1e3, 1e2, 1e7, 1e7, 1e6))  # takes energy that the motion does not show
    assert LoadTotals(on_springs).facts()["contact_loss_j"] is None


@pytest.mark.parametrize(
    ("header", "first", "scale", "clock", "stamp"),
    [
        ("t,speed", None, 1000.0, 0.0, "stamp_unit: ms"),
        ("n,zeit,speed", "7", 1.0, 0.0, "stamp: zeit"),
        ("t,speed", None, 1.0, 100.0, "clock_offset: -100"),
    ],
)
def test_speeds_act_at_the_stamps_that_the_mapping_reads(
    header: str, first: str | None, scale: float, clock: float, stamp: str, tmp_path: Path
) -> None:
    times = np.arange(0.0, 8.0, 0.01)
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n" + "".join(f"{t},0,0,0\n" for t in times))
    speeds = ((0.0, 1.0), (3.0, -1.0), (5.0, 2.0))
    rows = [f"{first + ',' if first else ''}{(t + clock) * scale},{speed}\n" for t, speed in speeds]
    (tmp_path / "travel.csv").write_text(header + "\n" + "".join(rows))
    (tmp_path / "map.yaml").write_text(f"excitation: {{topic: load}}\ntravel: {{topic: travel, {stamp}}}\n")
    analysis = analyse(tmp_path, scene=PAPER, mapping=tmp_path / "map.yaml")
    passes = [(item.start_s, item.end_s, item.start_m, item.end_m) for item in analysis.predictions[0].loads.passes]
    expected = [(0.0, 3.0, 0.0, 3.0), (3.0, 5.0, 3.0, 1.0), (5.0, 8.0, 1.0, 7.0)]
    assert len(passes) == 3
    for one, expected_pass in zip(passes, expected, strict=True):
        assert one == pytest.approx(expected_pass, abs=0.05)


def test_late_repeated_and_non_finite_samples_are_counted_as_in_a_live_run(tmp_path: Path) -> None:
    stamps = [BASE_NS + i * STEP_NS for i in range(200)]
    arrivals = [(stamp, motion()[1][i]) for i, stamp in enumerate(stamps)]
    arrivals[50], arrivals[51] = arrivals[51], arrivals[50]
    arrivals.insert(100, arrivals[99])
    arrivals[150] = (arrivals[150][0], np.array([np.nan, 0.0, 0.0]))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/excitation", "geometry_msgs/msg/WrenchStamped", typestore=STORE)
        for index, (stamp, wrench) in enumerate(arrivals):
            writer.write(connection, BASE_NS + index * STEP_NS, wrench_message(stamp, wrench))
    analysis = analyse(tmp_path / "bag", scene=PAPER)
    assert analysis.input == {
        "samples_in": 201,
        "samples_used": 198,
        "dropped_non_finite": 1,
        "dropped_duplicate": 1,
        "dropped_out_of_order": 1,
    }
    assert analysis.lossy


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return the data with some bytes flipped, removed, repeated or overwritten."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 20))):
        place = rng.randrange(len(changed))
        size = rng.choice((1, 1, 4, 8, 64, 1000))
        kind = rng.randrange(6)
        if kind == 0:
            changed[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            changed[place : place + size] = rng.randbytes(size)
        elif kind == 2:
            changed[place : place + size] = b"\xff" * size
        elif kind == 3 and len(changed) > 2 * size:
            del changed[place : place + size]
        elif kind == 4:
            changed[place:place] = changed[place : place + size]
        else:
            del changed[max(1, place) :]
    return bytes(changed)


def read_everything(path: Path, read: Callable[[Path], object]) -> None:
    try:
        read(path)
    except RecordingError as error:
        assert str(error)


def mutate_many(tmp_path: Path, seeds: Iterable[int]) -> None:
    short = (motion()[0][:150], motion()[1][:150], motion()[2][:150])
    files = [
        record_run(tmp_path / "run", map(paper_sample, range(150))).file,
        next(write_bag(tmp_path / "sqlite", short, StoragePlugin.SQLITE3).glob("*.db3")),
        next(write_bag(tmp_path / "mcap", short, StoragePlugin.MCAP).glob("*.mcap")),
    ]
    contents = [file.read_bytes() for file in files]
    mapping = tmp_path / "map.yaml"
    readers: list[Callable[[Path], object]] = [
        replay,
        lambda path: analyse(path, scene=PAPER, mapping=mapping),
        lambda path: analyse(path, scene=PAPER, mapping=mapping),
    ]
    for seed in seeds:
        rng = random.Random(seed)
        kind = seed % 3
        target = tmp_path / f"mutated{files[kind].suffix}"
        target.write_bytes(mutate(contents[kind], rng))
        try:
            read_everything(target, readers[kind])
        except Exception as error:
            raise AssertionError(f"seed {seed}: {error!r}") from error


def test_mutated_files_give_an_error_or_counted_loss(tmp_path: Path) -> None:
    mutate_many(tmp_path, range(120))


@pytest.mark.stress
@pytest.mark.timeout(3600)
def test_mutated_files_many_times(tmp_path: Path) -> None:
    mutate_many(tmp_path, range(1000, 11_000))


def test_rows_beyond_the_limit_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinned, "MOST_ROWS", 100)
    rows, signal = thinned.Thinned(1), thinned.Thinned(1)
    for begin, end in pairwise((0, 1, 70, 71, 350, 900, 901)):
        stamps = np.arange(begin, end)
        rows.add(stamps, 2.0 * stamps[:, None])
    for stamp in range(901):
        signal.add_row(stamp, 2.0 * stamp)
    assert (rows.rows, rows.stride) == (901, 16)
    for stamps, values in (rows.series(), signal.series()):
        np.testing.assert_array_equal(stamps, np.arange(0, 901, 16))
        np.testing.assert_array_equal(values.ravel(), 2.0 * stamps)


def test_rainflow_cycles_of_long_and_short_series_are_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loads, "_IN_MEMORY", 4096)  # this limit is below the 40,000 bytes of the series
    forces, series = np.abs(np.random.default_rng(1).normal(size=5000)), loads.Series()
    for part in np.array_split(forces, 7):
        series.add(reversals(part))
    expected = rainflow.count_cycles(forces, nbins=loads.CYCLE_BINS)
    for _ in range(2):  # in a run that is still being written, cycles are counted again at each poll
        counted = rainflow.count_cycles(series, binsize=(series.high - series.low) / loads.CYCLE_BINS)
        np.testing.assert_allclose(counted, expected, rtol=1e-12)


def test_turning_points_keep_peaks_and_ends() -> None:
    np.testing.assert_array_equal(reversals(np.array([0.0, 0, 1, 3, 3, 2, 5, 0, 0])), [0, 3, 2, 5, 0])
    np.testing.assert_array_equal(reversals(np.zeros(5)), [0.0])


@pytest.mark.parametrize(("content", "expected"), [(b"", "empty"), (b"\x89MCAP0\r\n", "truncated")])
@pytest.mark.parametrize("read", [analyse, read_recording])
def test_a_recording_without_a_message_is_not_called_a_recording_of_another_program(
    read: Callable[[Path], object], content: bytes, expected: str, tmp_path: Path
) -> None:
    file = tmp_path / "cut.mcap"
    file.write_bytes(content)
    with pytest.raises(RecordingError, match=f"^{file}: {expected}"):
        read(file)
