"""Limits of a run, Ctrl-C and progress. Each stop returns the results so far."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from commands import started
from scenes import preset

from plow_twin import (
    ArgumentError,
    Clearance,
    Contact,
    Frame,
    Friction,
    Head,
    LimitError,
    PlowTwinError,
    RunInterrupted,
    Scene,
    Twin,
    TwinBatch,
    Wear,
    simulate,
    simulate_many,
)
from plow_twin.cli.app import run
from plow_twin.solve.state import Status

BENCH = preset("paper")


def test_a_run_stops_at_its_limits_and_reports_its_state() -> None:
    scene = preset("paper")
    whole = simulate(scene, 10.0, output_dt=0.01)
    with pytest.raises(
        LimitError, match=r"max_steps = 100 reached at t = \S+ s of 10 s after 100 steps .* in contact: "
    ) as stop:
        simulate(scene, 10.0, output_dt=0.01, max_steps=100)
    part = stop.value.result
    assert part.solver["steps"] == 100 and 0 < len(part.t) < len(whole.t)
    assert stop.value.time_s == pytest.approx(part.t[-1], abs=0.01)
    # the results so far equal those of a complete run
    for name in ("t", "q", "v", "force"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[: len(part.t)]), name
    with pytest.raises(LimitError, match=r"max_wall_s = 1e-09 reached at t = "):
        simulate(scene, 1e4, max_wall_s=1e-9)
    with pytest.raises(LimitError, match=r"max_steps = 30 reached at t = 0\.003 s"):
        simulate(scene, 0.1, method="rk4", dt=1e-4, max_steps=30)
    for bad in (
        {"max_steps": 0},
        {"max_steps": 1.5},
        {"output_dt": 1e-300},
        {"max_wall_s": 0.0},
        {"max_wall_s": np.nan},
        {"tol": 1.0},
        {"tol": "1e-9"},
        {"output_dt": "0.1"},
        {"sensitivity": "contact.stiffness"},
    ):
        with pytest.raises(ArgumentError, match=next(iter(bad))) as refused:
            simulate(scene, 1.0, **bad)
        assert isinstance(refused.value, PlowTwinError) and isinstance(refused.value, ValueError)


def test_observing_a_run_does_not_change_it() -> None:
    scene, shares = preset("paper"), []
    whole = simulate(scene, 200.0, output_dt=0.1)
    looked = simulate(scene, 200.0, output_dt=0.1, on_progress=shares.append)
    assert np.array_equal(whole.q, looked.q) and np.array_equal(whole.events, looked.events)
    assert whole.solver == looked.solver and whole.statistics == looked.statistics
    assert len(shares) >= 2 and shares == sorted(shares) and shares[-1] < 1.0


@pytest.mark.parametrize("fixed", [{}, {"method": "rk4", "dt": 1e-4}], ids=["events", "rk4"])
def test_ctrl_c_ends_a_run_with_the_rows_computed_so_far(fixed: dict[str, object]) -> None:
    def press(share: float) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(RunInterrupted, match=r"interrupted at t = \S+ s of 10000 s") as stop:
        simulate(preset("paper"), 1e4, output_dt=0.1, on_progress=press, **fixed)
    # the run ends after its first slice of work
    assert 2048 <= stop.value.result.solver["steps"] < 3000
    assert isinstance(stop.value, KeyboardInterrupt) and len(stop.value.result.t) > 1


def test_the_command_line_writes_the_rows_computed_so_far(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "part.npz"
    code = run(["simulate", "paper", "--t-end", "10", "--max-steps", "100", "--out", str(out), "--json"])
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert code == 1 and "max_steps = 100 reached at t = " in printed.err
    assert result["solver"]["steps"] == 100 and 0.0 < result["t_end"] < 10.0
    with np.load(out) as file:
        assert 0 < len(file["t"]) < 1001 and np.isfinite(file["q"]).all()


def test_a_twin_stops_at_its_limits_where_its_last_advance_ended() -> None:
    times = np.linspace(0.01, 60.0, 600)
    samples = np.stack([4e4 * np.sin(2.0 * times), 1e4 * np.cos(2.0 * times), 3e4 * np.sin(2.0 * times)], axis=1)
    free = Twin(BENCH, excitation="sampled")
    whole = free.advance_samples(times, samples)
    # the limit of steps applies to the motion, so an advance that needs more steps is undone and has the status BUDGET
    tied = Twin(BENCH, excitation="sampled", max_steps=1)
    assert {tied.advance(t, load).status.name for t, load in zip(times[:50], samples, strict=False)} == {"OK", "BUDGET"}
    for name in ("sampled", "scene"):
        late = Twin(BENCH, excitation=name, max_wall_s=1e-9)
        with pytest.raises(LimitError, match=r"max_wall_s = 1e-09 reached at t = \S+ s after \d+ of ") as stop:
            if name == "sampled":
                late.advance_samples(times, samples)
            else:
                late.advance(1e4)
        part = stop.value.result
        if name == "scene":
            assert late.time == len(part) == 0 and late.digest() == Twin(BENCH).digest()
            continue
        # the twin can continue as if only these rows had been requested
        assert 0 < len(part) < len(times) and late.time == times[len(part) - 1] == stop.value.time_s
        assert np.array_equal(part.q, whole.q[: len(part)])
        late._pace.max_wall_s = np.inf
        rest = late.advance_samples(times[len(part) :], samples[len(part) :])
        assert np.array_equal(rest.q, whole.q[len(part) :]) and np.array_equal(rest.impulse, whole.impulse[len(part) :])
        assert late.digest() == free.digest()
    batch = TwinBatch([BENCH, BENCH], max_wall_s=1e-9)
    before = batch.digest()
    with pytest.raises(LimitError, match=r"max_wall_s = 1e-09 reached in advances from t = 0 s to 60 s of 2 twins"):
        batch.advance_samples(times, samples)
    assert batch.digest() == before


def test_ctrl_c_ends_the_work_of_a_twin_and_of_an_ensemble() -> None:
    twin = Twin(BENCH)
    twin.warm_up()
    for work, done in (
        (lambda: twin.advance(1e6), r"interrupted at t = 0 s after 0 of 1 advances"),
        (lambda: simulate_many([BENCH] * 3, 1e6, 1e5, workers=2), r"interrupted after \d of 3 members"),
    ):
        begin = time.perf_counter()
        press = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
        press.start()
        with pytest.raises(RunInterrupted, match=done):
            work()
        press.join()
        assert time.perf_counter() - begin < 60.0
    ensemble = simulate_many([BENCH] * 2, 1.0, 0.5, max_steps=20)
    assert {Status(code).name for code in ensemble.status} == {"BUDGET"} and np.isnan(ensemble.q[:, -1]).all()
    with pytest.raises(LimitError, match="max_wall_s = 1e-09 reached after 0 of 2 members"):
        simulate_many([BENCH] * 2, 1.0, max_wall_s=1e-9)


@pytest.mark.stress
@pytest.mark.parametrize(
    ("scene", "tol"),
    [
        (replace(BENCH, friction=Friction(5.0, 1e-9)), 1e-8),
        (replace(preset("bench_hc"), wear=Wear(1.0, 0.015, 2.0)), 1e-8),
        (replace(BENCH, frame=Frame(1e6, 1e6)), 1e-8),
        (replace(BENCH, head=Head(1e-6, 1e-6)), 1e-11),
        (Scene(Head(2430.0, 1265.0), Frame(0.33, 0.27), Clearance(0.0, 0.0), Contact("hertz", 1e13, 1.5)), 1e-12),
    ],
    ids=["friction 5", "wear 1", "frame of 1000 km", "head of 1 mg", "no clearance"],
)
def test_the_work_of_every_scene_is_bounded(scene: Scene, tol: float) -> None:
    try:
        simulate(scene, 10.0, tol=tol, max_steps=200_000)
    except PlowTwinError as error:
        assert "at t = " in str(error)


#: Program that prints its number of steps twice: when the signal arrives, from another thread, and after the call.
INTERRUPTED = """
import json, os, signal, threading, time
from plow_twin import RunInterrupted, load_scene
from plow_twin.run import simulate as module

kept, start, told = [], module._start, {}
module._start = lambda *arguments: kept.append(start(*arguments)) or kept[-1]
receive, send = os.pipe()
os.set_blocking(send, False)
signal.set_wakeup_fd(send)

def watch():
    os.read(receive, 1)
    told.update(signalled=int(kept[-1].state.steps), at=time.perf_counter())

thread = threading.Thread(target=watch)
thread.start()
shares = []

def progress(share):
    shares.append(int(kept[-1].state.steps))
    if len(shares) == 20:
        print("under way", flush=True)

try:
    module.simulate(load_scene("paper"), 1e7, 1e4, on_progress=progress)
except RunInterrupted as stop:
    took = time.perf_counter()
    thread.join()
    told.update(returned=stop.result.solver["steps"], rows=len(stop.result.t), slices=shares[-20:])
    told["took"] = took - told.pop("at")
print(json.dumps(told))
"""


def test_slices_of_lanes_stay_bounded_after_many_short_slices() -> None:
    """A scene at rest leaves its lane repeatedly, so that more than thirty consecutive slices take almost no time."""
    scene = replace(preset("bench_kv"), loads=())
    results = simulate_many([scene], 1e6, 1e6, 1e-6, workers=1)
    assert results.status[0] == Status.OK and results.steps[0] > 10_000


def test_a_process_that_gets_sigint_returns_within_a_slice_of_work() -> None:
    with started([sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == "under way\n"
        process.send_signal(signal.SIGINT)
        message = json.loads(process.communicate(timeout=60)[0])
    slices = message["slices"]
    largest = max(after - before for before, after in itertools.pairwise(slices))
    # the run ends after the slice in which the signal arrived; a slice may be four times as large as the previous slice
    assert 0 <= message["returned"] - message["signalled"] <= 4 * largest
    assert message["rows"] >= 1


#: Program that runs the command line, and prints when the motion has begun.
COMMAND = """
import sys
from plow_twin.run import simulate as module
from plow_twin.cli.app import run

begin = module._run

def begun(*arguments):
    if len(arguments) == 7:
        print("under way", file=sys.stderr, flush=True)
    begin(*arguments)

module._run = begun
sys.exit(run(["simulate", "paper", "--t-end", "1e7", "--output-dt", "1e3", "--json", "--out", sys.argv[1]]))
"""


def test_the_command_that_gets_sigint_writes_the_rows_computed_so_far(tmp_path: Path) -> None:
    out = tmp_path / "part.npz"
    command = [sys.executable, "-c", COMMAND, str(out)]
    with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stderr is not None and process.stderr.readline() == "under way\n"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and "interrupted at t = " in errors
    result = json.loads(output)
    assert 0.0 < result["t_end"] < 1e7 and result["solver"]["steps"] > 0
    with np.load(out) as file:
        assert len(file["t"]) >= 1 and np.isfinite(file["q"]).all()


def test_a_notebook_shows_the_contacts_of_a_motion_as_a_table() -> None:
    result = simulate(preset("paper"), 2.0)
    shown = result._repr_html_()
    root = ElementTree.fromstring(shown)
    rows = [[cell.text or "" for cell in row] for row in root.iter("tr")]
    assert rows[0][:2] == ["pair", "largest force [kN]"] and [row[0] for row in rows[1:]] == list(result.statistics)
    largest = {row[0]: float(row[1]) for row in rows[1:]}
    assert largest == pytest.approx({pair: 1e-3 * of["max"] for pair, of in result.statistics.items()}, rel=1e-3)
    assert max(largest.values()) > 50.0 and "2 s of motion" in shown
