"""The estimate beside the live node, with real processes and late data. The journal gives the same estimate."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import plow_twin
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from ros_processes import ROOT, Bench, bench, value
from scenes import gaps_at, preset
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from waiting import until

from plow_twin import Twin, Wear
from plow_twin.cli.app import run as run_cli
from plow_twin.estimate.answer import Requests
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.window import Window, Windows
from plow_twin.estimate.worker import WindowResult, Worker, serve
from plow_twin.live.estimation import Estimation, entry_of, message_of
from plow_twin.live.parameters import settings
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.estimated import live_estimates
from plow_twin.record.messages import JointState as JointStateMessage
from plow_twin.record.reader import RunReader
from plow_twin.record.replay import replay
from plow_twin.ros.messages import set_stamp
from plow_twin.scene_file import dump_scene
from plow_twin.stream.journal import Sample, SetModel, SetWear, Spread
from plow_twin.stream.outputs import CLEARANCE_NAMES
from plow_twin.stream.session import Session

sys.path.insert(0, str(ROOT / "benchmark"))
from estimate_truths import GROUPS, Truth, draw

#: Stamp of the first sample [ns].
START_NS = 1_700_000_000_000_000_000
WINDOW_S, INTERVAL_S, WAIT_S = 10.0, 4.0, 2.0
#: Settings with which no sample and no pose is lost on a busy machine. Lost rows would change a window.
RELIABLE = {
    f"qos_overrides.{{ns}}/{topic}.subscription.reliability": "reliable"
    for topic in ("excitation", "head_pose", "gaps")
}


def _windows(loads: list[tuple[int, tuple[float, ...]]], poses: list[tuple[int, tuple[float, ...]]]) -> list[Window]:
    """Pass samples and poses to a collector of windows; each pose precedes the sample with the same index."""
    windows, found = Windows(4.0, 1.0, 0.5), []
    for index, load in enumerate(loads):
        if index < len(poses):
            windows.add_pose(*poses[index])
            windows.add_gaps(poses[index][0], (1, 3), poses[index][1][:2])
        formed = windows.add_load(*load)
        if formed is not None:
            found.append(formed)
    return found


def test_windows_do_not_depend_on_the_order_of_arrival() -> None:
    rng = np.random.default_rng(3)
    stamps = START_NS + np.arange(0, 800) * 10_000_000
    loads = [(int(stamp), tuple(rng.standard_normal(3).tolist())) for stamp in stamps]
    poses = [(int(stamp) + 3, tuple(rng.standard_normal(3).tolist())) for stamp in stamps]
    # each row is late by up to 0.4 s, which is less than the waiting time
    late = [sorted(rows, key=lambda row: row[0] + int(rng.integers(0, 400_000_000))) for rows in (loads, poses)]
    ordered, mixed = _windows(loads, poses), _windows(*late)
    assert [window.end_ns for window in ordered] == [window.end_ns for window in mixed]
    assert len(ordered) >= 4
    for one, other in zip(ordered, mixed, strict=True):
        assert (one.start_ns, one.samples, one.poses, one.lost) == (other.start_ns, other.samples, other.poses, 0)
        assert one.gaps is not None and one.poses == len(one.pose.t) + len(one.gaps.t)
        for first, second in (
            (one.load.t, other.load.t),
            (one.load.wrench, other.load.wrench),
            (one.pose.q, other.pose.q),
            (one.gaps.gap[:, [1, 3]], other.gaps.gap[:, [1, 3]]),  # type: ignore[union-attr]
        ):
            assert np.array_equal(first, second)


def test_measurements_without_a_load_do_not_accumulate(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the load has stopped, or the clock of the poses is hours ahead, the queue must not grow without limit."""
    monkeypatch.setattr("plow_twin.estimate.window.MOST_KEPT", 100)
    windows = Windows(4.0, 1.0, 0.5)
    for index in range(300):
        windows.add_pose(START_NS + index, (0.0, 0.0, 0.0))
        windows.add_gaps(START_NS + index, (1,), (0.0,))
    assert len(windows._poses) == len(windows._gaps) == 100
    windows.add_load(START_NS, (0.0, 0.0, 0.0))
    windows.add_load(START_NS + 3_000_000_000, (0.0, 0.0, 0.0))
    windows.add_pose(START_NS + 10, (0.0, 0.0, 0.0))
    assert len(windows._poses) <= 100


def test_poses_form_windows_while_the_load_is_silent() -> None:
    stamps = [START_NS + index * 10_000_000 for index in range(1500)]
    windows, formed = Windows(4.0, 1.0, 0.5), []
    for index, stamp in enumerate(stamps):
        formed.append(windows.add_pose(stamp, (0.001 * index, 0.0, 0.0)))
        if 400 <= index < 800:
            formed.append(windows.add_load(stamp, (1.0, 2.0, 3.0)))
    found = [window for window in formed if window is not None]
    assert sorted(one.end_ns for one in found) == [one.end_ns for one in found]
    silent = [one for one in found if not one.samples]
    assert silent[0].end_ns < stamps[400] < stamps[800] < silent[-1].end_ns
    assert all(not one.load.wrench.any() and len(one.pose.t) >= 200 for one in silent)
    assert not any(stamps[400] < one.end_ns < stamps[799] for one in silent)


def test_a_pose_with_a_stamp_far_ahead_does_not_stop_the_windows() -> None:
    stamps = [START_NS + index * 10_000_000 for index in range(1000)]
    windows, formed = Windows(4.0, 1.0, 0.5), []
    for index, stamp in enumerate(stamps):
        formed.append(windows.add_pose(stamp + 3_600_000_000_000 * (index == 500), (0.0, 0.0, 0.0)))
        formed.append(windows.add_load(stamp, (1.0, 2.0, 3.0)))
    found = [window for window in formed if window is not None]
    assert len(found) == 8 and all(one.samples for one in found)


def test_a_window_begins_after_a_silence_of_the_load() -> None:
    stamps = np.delete(START_NS + np.arange(0, 1200) * 10_000_000, slice(500, 600))
    rows = [(int(stamp), (0.0, 0.0, 0.0)) for stamp in stamps]
    found = _windows(rows, rows)
    assert found
    for window in found:
        assert np.diff(window.load.t).max() < 0.5
        assert window.end_ns - window.start_ns >= 2_000_000_000


def _pose(t: float, q: np.ndarray) -> PoseStamped:
    message, (x, y, theta) = PoseStamped(), q
    set_stamp(message.header, START_NS + round(t * 1e9))
    message.pose.position.x, message.pose.position.y = x, y
    message.pose.orientation.z, message.pose.orientation.w = np.sin(0.5 * theta), np.cos(0.5 * theta)
    return message


def _play(running: Bench, truth: Truth, late: bool) -> None:
    """Send load and poses of a simulated machine faster than in real time. With `late`, some poses are late by 1 s."""
    probe = running.probe
    send = probe.excitation()
    pose, gap = probe.publisher(PoseStamped, "head_pose"), probe.publisher(JointState, "gaps")
    gaps = gaps_at(truth.scene, truth.poses.q)
    rows: list[tuple[float, int, Any]] = [
        (t, 0, wrench) for t, wrench in zip(truth.load.t, truth.load.wrench, strict=True)
    ]
    for index, (t, q) in enumerate(zip(truth.poses.t, truth.poses.q, strict=True)):
        rows.append((t + (1.0 if late and index % 7 == 3 else 0.0), 1, (t, q)))
    for index, (t, kind, content) in enumerate(sorted(rows, key=lambda row: row[:2])):
        if kind == 0:
            send(START_NS + round(t * 1e9), content)
        else:
            stamp, message = content[0], _pose(*content)
            pose.publish(message)
            place = int(np.searchsorted(truth.poses.t, stamp))
            if place % 5 == 0:
                measured = JointState(name=PAIR_NAMES, position=gaps[place].tolist())
                measured.header.stamp = message.header.stamp
                gap.publish(measured)
        probe.pace(index)


def test_the_live_estimate_is_published_and_repeated_by_the_journal(tmp_path: Path) -> None:
    truth = draw(replace(GROUPS["plain"], periods=5.0, rate_hz=50.0), 3)
    scene = tmp_path / "worn.yaml"
    scene.write_text(dump_scene(replace(preset("paper"), wear=Wear(2e-14, 0.015, 2.0))), encoding="utf-8")
    settings = {
        "scene": scene,
        "estimate": "true",
        "estimate_forces": 20,
        "forecast_limits": "[0.04, 0.05]",
        "forecast_horizon": 3.6e7,
        "hold_limit": 3600.0,  # an estimate may take long on a busy machine, so the hold must not end first
        "estimate_window": WINDOW_S,
        "estimate_interval": INTERVAL_S,
        "rollback_span": WAIT_S,
    }
    run = tmp_path / "run"
    with bench(tmp_path, record_path=run, **settings, **RELIABLE) as running:
        probe = running.probe
        estimates: list[JointState] = probe.listen(JointState, "estimate")
        clearances: list[JointState] = probe.listen(JointState, "clearance")
        forces: list[JointState] = probe.listen(JointState, "window_forces")
        forecasts: list[JointState] = probe.listen(JointState, "forecast")
        assert value(probe.status[-1], "horizontal") == "prior"
        probe.until_figure("estimate", "ready", "1", timeout_s=100.0)  # before the first sample
        _play(running, truth, late=True)
        # windows end every 4 s; on a slow machine a window may be skipped, but not the last window
        last_s = (START_NS + round((truth.load.t[-1] - WAIT_S) * 1e9)) // round(INTERVAL_S * 1e9) * round(INTERVAL_S)
        probe.until(lambda: estimates and estimates[-1].header.stamp.sec == last_s, "the last window's estimate", 100.0)
        probe.until_figure("estimate", "estimates", *map(str, range(1, 9)))
        probe.until(lambda: value(probe.status[-1], "horizontal") == "estimated", "the flag")
        published = dict(zip(estimates[-1].name, estimates[-1].position, strict=True))
        # the hold policy applies the estimate in the next slow publication
        probe.until(lambda: abs(clearances[-1].position[0] - published["horizontal"]) < 1e-9, "the clearance")
        last = dict(zip(clearances[-1].name, clearances[-1].position, strict=True))
        status: DiagnosticStatus = probe.status[-1]
        answer = probe.call(Trigger, f"{running.namespace}/plow_twin/forecast", Trigger.Request())
        assert running.twin.stop() == 0
    for name, true in zip(("horizontal", "vertical"), truth.clearance, strict=True):
        assert published[f"{name}/p05"] < published[name] < published[f"{name}/p95"]
        assert published[name] == pytest.approx(true, abs=3e-4)
        assert [last[f"{name}{point}"] for point in ("", "/p05", "/p95")] == pytest.approx(
            [published[f"{name}{point}"] for point in ("", "/p05", "/p95")], abs=1e-12
        )
        assert value(status, name) == "estimated"
    assert (value(status, "model"), value(status, "sensor")) == ("ok", "ok")

    completed = plow_twin("estimate", run, "--json")
    assert completed.returncode == 0, completed.stderr
    facts = json.loads(completed.stdout)
    assert facts["live"]["repeated"] is True and facts["live"]["estimates"] >= 1
    assert facts["horizontal"]["mean_m"] == published["horizontal"]
    # gaps were measured, so clearances of the groups of pads are estimated too
    group = facts["groups"]["horizontal_top"]
    assert group["mean_m"] == pytest.approx(truth.clearance[0], abs=3e-4) and group["p95_m"] - group["p05_m"] > 4e-4
    # forecast and forces are computed from the same estimate
    assert facts["forecast"] == json.loads(answer.message)
    forecast = dict(zip(forecasts[-1].name, forecasts[-1].position, strict=True))
    assert forecast["seconds/p50"] == pytest.approx(3600.0 * facts["forecast"]["p50"]["hours"])
    assert forecast["seconds/p10"] < forecast["seconds/p50"] and forecast["not_reached_in_horizon"] < 0.5
    peaks = dict(zip(forces[-1].name, forces[-1].effort, strict=True))
    assert peaks["top_left_top/p95"] == facts["forces"]["pairs"]["top_left_top"]["peak_n"]["p95"] > 0.0
    assert len(peaks) == len(forces[-1].velocity) == 24 and facts["forces"]["members"] == 20
    report = replay(run)
    assert (report.exit_code, report.first_divergence) == (0, None)
    assert report.compared["clearance"] > 0


def test_without_a_load_the_interval_of_the_rough_clearance_contains_the_truth(tmp_path: Path) -> None:
    truth = draw(replace(GROUPS["hard"], periods=5.0, rate_hz=50.0), 30100)
    settings = {"estimate": "true", "estimate_window": WINDOW_S, "estimate_interval": INTERVAL_S}
    with bench(tmp_path, **settings, **RELIABLE) as running:
        probe = running.probe
        estimates: list[JointState] = probe.listen(JointState, "estimate")
        pose = probe.publisher(PoseStamped, "head_pose")
        probe.until_figure("estimate", "ready", "1", timeout_s=100.0)
        for index, (t, q) in enumerate(zip(truth.poses.t, truth.poses.q, strict=True)):
            pose.publish(_pose(t, q))
            probe.pace(index)
        probe.until(lambda: len(estimates) >= 1, "an estimate", 100.0)
        probe.until(lambda: value(probe.status[-1], "horizontal") == "rough", "the flag")
        assert [value(probe.status[-1], key) for key in ("vertical", "model")] == ["rough", "suspect"]
    published = dict(zip(estimates[-1].name, estimates[-1].position, strict=True))
    for name, true in zip(("horizontal", "vertical"), truth.clearance, strict=True):
        assert published[f"{name}/p05"] < true < published[f"{name}/p95"] < published[f"{name}/p05"] + 5e-3


def _found(horizontal: State, vertical: State) -> WindowResult:
    result = Estimate(
        0.0, 1.0, Interval(0.02, 0.019, 0.021), Interval(0.03, 0.028, 0.032), horizontal, vertical,
        stiffness=Interval(1e7, 9e6, 1.1e7),
    )  # fmt: skip
    return WindowResult(START_NS, START_NS + 1, 2, 3, (), result, 0.1, 0, 0)


def test_an_estimate_stays_until_it_is_withdrawn_or_the_pads_are_changed() -> None:
    wear = Wear(1e-13, 0.015, 2.0, prior_m2_n=(5e-14, 2e-13))
    scene = replace(preset("paper"), wear=wear)
    session = Session(Twin(scene, excitation="sampled"), rollback_span_s=2.0)

    def clearance(stamp_s: float) -> dict[str, float]:
        session.apply(Sample(START_NS + round(stamp_s * 1e9), (5e4, -1e4, 0.0)))
        publication = session.outputs.pop()
        return dict(zip(CLEARANCE_NAMES, publication.slow["clearance"][0].tolist(), strict=True))

    assert clearance(0.0)["horizontal"] == 0.025
    first = entry_of(_found(State.ESTIMATED, State.ESTIMATED), session, None)
    session.apply(first)
    now = clearance(0.2)
    assert [now[f"horizontal{point}"] for point in ("", "/p05", "/p95")] == pytest.approx(
        [0.02, 0.019, 0.021], abs=1e-6
    )
    # a late sample takes the model back to a time before the estimate, but the estimate remains valid
    clearance(0.6)
    session.apply(Sample(START_NS + 100_000_000, (4e4, -1e4, 0.0)))
    later = clearance(1.8)
    assert later["vertical"] == pytest.approx(0.03, abs=1e-6)
    # the prior of the wear widens the interval of the horizontal clearance
    assert later["horizontal/p95"] - later["horizontal/p05"] > now["horizontal/p95"] - now["horizontal/p05"]
    second = entry_of(_found(State.NOT_OBSERVABLE, State.WITHDRAWN), session, first)
    assert second.shift == (*first.shift[:3], 0.0, 0.0, 0.0)
    assert message_of(_found(State.ESTIMATED, State.WITHDRAWN), "f").name == ()
    session.apply(SetWear(START_NS + 2_000_000_000, (0.0,) * 8, "new pads"))
    assert clearance(3.0)["horizontal"] == pytest.approx(0.025, abs=1e-6)


class _Finished:
    """A worker without a process. The test sets its results and its error."""

    def __init__(self, *_: Any) -> None:
        self.found: list[WindowResult] = []
        self.error, self.ended = "", None
        self.deviations: list[tuple[float, ...]] = []
        self.closed = False

    def poll(self) -> WindowResult | None:
        return self.found.pop() if self.found else None

    def add_load(self, *_: Any) -> None:
        pass

    def set_load_deviation(self, deviation: tuple[float, ...]) -> None:
        self.deviations.append(deviation)

    def restart(self) -> None:
        self.found.clear()

    def finish(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


def test_an_estimator_that_ends_after_an_estimate_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plow_twin.live.estimation.Worker", _Finished)
    scene = preset("paper")
    estimation = Estimation(settings({"estimate": True}), scene)
    session = Session(Twin(scene, excitation="sampled"), on_entry=estimation.add)
    session.apply(Sample(START_NS, (0.0, 0.0, 0.0)))
    session.apply(Spread(START_NS, (1.0, 2.0, 3.0)))

    def after_end(*, estimates: int, finish: bool = False) -> str:
        estimation.worker.error = ""
        if finish:
            estimation.finish()
        estimation.worker.found += [_found(State.ESTIMATED, State.ESTIMATED)] * estimates
        for _ in range(estimates):
            assert estimation.poll(session) and not estimation.revive()
        estimation.worker.error = "the estimator ended with code -9"
        return estimation.revive()

    first = estimation.worker
    assert after_end(estimates=2).startswith("the estimator ended with code -9 and is started again")
    assert first.closed and estimation.worker.deviations == [(1.0, 2.0, 3.0)] and not estimation.done
    # not before its first estimate, nor after the end of the input
    assert after_end(estimates=0) == after_end(estimates=1, finish=True) == ""
    assert estimation.done and estimation.restarts == 1


def test_changes_of_pads_and_model_discard_earlier_estimates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("plow_twin.live.estimation.Worker", _Finished)
    scene = replace(preset("paper"), wear=Wear(1e-13, 0.015, 2.0))
    estimation = Estimation(settings({"estimate": True, "forecast_limits": [0.04, 0.05]}), scene)
    session = Session(Twin(scene, excitation="sampled"), on_entry=estimation.add)
    session.apply(Sample(START_NS, (0.0, 0.0, 0.0)))

    def told() -> dict[str, JointStateMessage]:
        found = _found(State.ESTIMATED, State.ESTIMATED)
        suspect = replace(found.estimate, model="suspect", reasons=("why",))
        found = replace(found, estimate=suspect, also={"forecast": {"p50": {"hours": 3.0}}})
        estimation.worker.found.append(found)
        return estimation.poll(session)

    assert told()["forecast"].name == ("seconds/p50",)
    # when the model is changed, an estimate of the previous machine is still being computed
    estimation.worker.found.append(_found(State.ESTIMATED, State.ESTIMATED))
    session.apply(SetModel(START_NS, json.dumps({"clearance.horizontal_m": 0.026})))
    # the model determines the clearance again: no estimate remains if the other clearance is not observable
    assert estimation.entry is None and set(estimation.states.values()) == {State.PRIOR}
    assert estimation.forecast is not None and estimation.poll(session) == {}
    told()
    session.apply(SetWear(START_NS + 1, (0.0,) * 8, "new pads"))
    assert (estimation.forecast, estimation.reasons, estimation.end_ns) == (None, (), None)
    assert estimation.forecast_error and set(estimation.trust.values()) == {""}
    # empty messages replace the latched messages of estimate and forecast
    messages = estimation.poll(session)
    assert {topic: (message.stamp_ns, message.name) for topic, message in messages.items()} == dict.fromkeys(
        ("estimate", "forecast"), (START_NS + 1, ())
    )
    assert estimation.poll(session) == {}


def test_an_estimator_is_ready_after_its_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = Pipe()
    compiled = []

    def compile_all(scene: Scene) -> None:
        compiled.append(scene)
        raise KeyboardInterrupt

    monkeypatch.setattr("plow_twin.estimate.worker.warm_up", compile_all)
    near.send((preset("paper"), Windows(10.0, 4.0, 1.0), Requests()))
    with pytest.raises(KeyboardInterrupt):
        serve(far)
    assert len(compiled) == 1 and not near.poll()


def test_a_frozen_worker_is_reported_and_takes_no_further_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plow_twin.estimate.worker._MOST_WAITING", 20_000)
    worker = Worker(preset("paper"), Windows(10.0, 4.0, 1.0))
    os.kill(worker._process.pid, signal.SIGSTOP)

    def look() -> str:
        for _ in range(1000):
            worker.add_load(START_NS, (0.0, 0.0, 0.0))
        assert worker.poll() is None
        return worker.error

    until(look, "a report", pause_s=0.1)  # a source pauses in the same way while it waits for a slow worker
    assert worker.error == "the estimator did not read for 20000 samples"
    assert not worker.ready
    worker.add_load(START_NS, (0.0, 0.0, 0.0))
    assert not worker._waiting
    worker.close()
    assert not worker._thread.is_alive()


def test_the_end_of_a_worker_is_reported_and_the_twin_continues() -> None:
    worker = Worker(preset("paper"), Windows(10.0, 4.0, 1.0))
    os.kill(worker._process.pid, signal.SIGSTOP)
    worker._connection.close()
    # the worker has not ended yet, and `poll` does not wait for it
    assert worker.poll() is None and not worker.error
    worker._process.kill()

    def look() -> str:
        worker.add_load(START_NS, (0.0, 0.0, 0.0))
        assert worker.poll() is None
        return worker.error

    until(look, "a report")
    assert worker.error == "the estimator ended with code -9"
    worker.close()


def test_without_an_estimate_its_code_is_not_loaded(tmp_path: Path) -> None:
    program = """
import sys
import ros_processes
from rclpy.context import Context
from plow_twin.ros.node import TwinNode
context = Context()
context.init(args=[])
node = TwinNode(namespace="/off", context=context)
assert node.start()
loaded = [name for name in sys.modules if name.startswith(("plow_twin.estimate", "plow_twin.live.estimation"))]
assert not loaded, loaded
assert node.count_publishers("estimate") == 0
node.release()
node.destroy_node()
context.try_shutdown()
"""
    completed = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT / "test", capture_output=True, text=True, timeout=110
    )
    assert completed.returncode == 0, completed.stderr


@pytest.mark.timeout(600)  # at first, the twin and the worker each compile for 65 s of processor time
@pytest.mark.parametrize(("rows", "code"), [(None, 0), (100, 3)])
def test_the_last_window_of_a_file_is_estimated_or_too_few_data_are_reported(
    rows: int | None, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = draw(replace(GROUPS["plain"], periods=5.0, rate_hz=50.0), 3)
    names = ("t", "fx", "fy", "m", "x", "y", "theta")
    measured = dict(zip(truth.poses.t.tolist(), truth.poses.q.tolist(), strict=True))
    lines = [
        ",".join(map(repr, (t, *load, *measured[t])) if t in measured else [*map(repr, (t, *load)), "", "", ""])
        for t, load in zip(truth.load.t.tolist(), truth.load.wrench.tolist(), strict=True)
    ]
    (tmp_path / "own.csv").write_text("\n".join([",".join(names), *lines[:rows]]) + "\n")
    (tmp_path / "own.yaml").write_text("excitation: {topic: own}\nhead_pose: {topic: own}\n")
    (tmp_path / "scene.yaml").write_text(dump_scene(truth.scene), encoding="utf-8")
    options = ["--map", tmp_path / "own.yaml", "--scene", tmp_path / "scene.yaml", "--record", tmp_path / "run"]
    settings = ["estimate=true", "follow=off", f"estimate_window={WINDOW_S}", f"estimate_interval={INTERVAL_S}"]
    words = ["live", tmp_path / "own.csv", *options, *(word for text in settings for word in ("--set", text))]
    assert run_cli(list(map(str, words))) == code
    shown = capsys.readouterr()
    estimates = list(live_estimates(RunReader(tmp_path / "run")))
    if rows is not None:
        span_s = truth.load.t[rows - 1] - truth.load.t[0]
        assert (
            f"estimate: got {span_s:.3g} s of load without a gap" in shown.err and "expected at least 5 s" in shown.err
        )
        assert estimates == []
        return
    last_s = truth.load.t[-1] + 1.0  # stamps that begin at 0 are shifted by a second
    window = estimates[-1].window
    assert window is not None and window.end_ns == pytest.approx(last_s * 1e9 + 1, abs=1.0)
    assert "Estimate of the window" in shown.out and "horizontal clearance" in shown.out.lower()
    assert replay(tmp_path / "run").exit_code == 0
