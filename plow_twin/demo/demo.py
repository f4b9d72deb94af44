"""Run a publisher of the load, and the node with its recorder, as processes, and print a summary of the recording."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from plow_twin.demo.comparison import COMPARED_S, Comparison, compare_forces
from plow_twin.demo.run_summary import SENSES, RunSummary, summarise
from plow_twin.errors import PlowTwinError
from plow_twin.model.pairs import CORNER_NAMES, PAIR_COUNT, PAIR_NAMES, corner_of
from plow_twin.model.scene import Mark, Provenance, Wear
from plow_twin.scene_file import dump_scene, load_scene

DONE, FAILED, DONE_WITH_LOSS = 0, 1, 3
#: Longest wait for an estimate, and for the compilation of the solver on a busy machine [s].
_START_TIMEOUT_S: Final = 300.0
_STOP_TIMEOUT_S: Final = 10.0
_RATE_HZ: Final = 1000.0
#: Clearance of the synthetic machine minus the clearance of the scene [mm].
_SENSOR_MM: Final = 1.5
#: Shortest demo with an estimate, length of its window, and time between two windows [s].
_ESTIMATED_S, _WINDOW_S, _INTERVAL_S = 15.0, 14.0, 3.0
_STUCK_S: Final = 30.0


class DemoError(PlowTwinError):
    """A process of the demo has failed. The message contains the output of the process."""


@dataclass
class Watch:
    """The newest values of `/diagnostics`, by part and key."""

    parts: dict[str, dict[str, str]] = field(default_factory=dict)
    reports: int = 0

    def receive(self, message: Any) -> None:
        """Store the values of a `DiagnosticArray`."""
        for status in message.status:
            part = status.name.partition(": ")[2]
            self.parts[part] = {value.key: value.value for value in status.values}
        self.reports += 1

    def text(self, part: str, key: str) -> str:
        """Return a value, or an empty text before the first report."""
        return self.parts.get(part, {}).get(key, "")

    def number(self, part: str, key: str) -> float:
        """Return a value as a number, or 0 if the value is missing."""
        return float(self.text(part, key) or 0.0)

    @property
    def dropped(self) -> int:
        """The number of samples that arrived and were not used."""
        values = self.parts.get("input", {}).items()
        return sum(int(value) for key, value in values if key.startswith("dropped_"))

    @property
    def accounted(self) -> int:
        """The number of samples that were used or dropped, or that never arrived."""
        used, lost = self.number("input", "samples_used"), self.number("input", "samples_lost")
        return int(used + lost) + self.dropped


def run_demo(speed: str, seconds: float, out: Path, quiet: bool, screen: list[str] | None = None) -> int:
    """Run the twin under the load of the paper, print a summary, and return the exit code.

    The exit code is 0 on success, 1 after a failure, or 3 after counted losses. At the speed `real`, the run uses the
    system clock. At the speed `fast`, the run uses `/clock`. `screen` contains the arguments of the operator's screen.
    """
    folder = out / datetime.now().strftime("%Y%m%d_%H%M%S_%f")
    folder.mkdir(parents=True)
    _set_environment(folder)
    console = Console(stderr=True)
    try:
        watch, sent = _run(speed, seconds, folder, console, quiet, screen)
        summary = summarise(folder / "run")
        beside = compare_forces(folder / "run", 1e-3 * _SENSOR_MM) if summary.estimate is not None else None
        view = _view(folder)
    except PlowTwinError as error:
        console.print(f"demo failed: {error}", style="red", markup=False, highlight=False)
        return FAILED
    lost = _losses(watch, sent, summary)
    if not quiet:
        _print(Console(), watch, summary, sent, lost, fast=speed == "fast")
        if beside is not None:
            _print_comparison(Console(), beside)
        _print_places(Console(), folder / "run", view)
    return DONE_WITH_LOSS if any(lost.values()) else DONE


def _set_environment(folder: Path) -> None:
    """Restrict the ROS communication of the demo to this machine and to a ROS domain of its own."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # domain numbers above 101 are not used, because outgoing connections may use their ports
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)
    os.environ.setdefault("ROS_LOG_DIR", str((folder / "log").resolve()))


def _worn_scene(folder: Path) -> Path:
    """Write the scene of the paper with wear. Return its path."""
    wear = Wear(coefficient_m2_n=1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0)
    assumed = Provenance(Mark.ASSUMED, "hard steel guide in coal dust, 1e-15 .. 1e-13 m^2/N; not in the paper")
    paper = load_scene("paper")
    path = (folder / "scene.yaml").resolve()
    scene = replace(paper, wear=wear, marks={**paper.marks, "wear.coefficient_m2_n": assumed})
    path.write_text(dump_scene(scene), encoding="utf-8")
    return path


def _run(
    speed: str, seconds: float, folder: Path, console: Console, quiet: bool, screen: list[str] | None
) -> tuple[Watch, int]:
    """Run all processes until they end. Return the last diagnostics of the node, and the number of sent samples."""
    from plow_twin.demo.excitation_publisher import QUEUE, while_progress

    parameters = {
        "scene": _worn_scene(folder),
        "record_path": (folder / "run").resolve(),
        "expected_rate": _RATE_HZ,
        # no sample is lost on a busy machine
        "qos_overrides./excitation.subscription.reliability": "reliable",
        "input_depth": QUEUE,
        "excitation_timeout": 60.0,  # longer than the run, so that the hold policy is never applied
        "use_sim_time": str(speed == "fast").lower(),
    }
    publisher = ["plow_twin.demo.excitation_publisher", "--speed", speed, "--seconds", repr(seconds)]
    estimating = seconds >= _ESTIMATED_S
    if estimating:
        parameters |= {"estimate": "true", "estimate_window": _WINDOW_S, "estimate_interval": _INTERVAL_S}
        parameters["qos_overrides./head_pose.subscription.reliability"] = "reliable"
        publisher += ["--sensor", repr(_SENSOR_MM)]
    node = ["plow_twin.ros.main", "--ros-args"]
    for name, value in parameters.items():
        node += ["-p", f"{name}:={value}"]
    with ExitStack() as opened:
        bar = opened.enter_context(_progress(console, quiet))
        watch, spin = opened.enter_context(_watching())
        twin = opened.enter_context(Child(node, folder / "node.log"))
        task = bar.add_task("compiling the solver", total=None)
        until = partial(_until, spin=spin, child=twin, timeout_s=_START_TIMEOUT_S)
        until("active node", lambda: watch.text("state", "lifecycle") == "active")
        if estimating:
            bar.update(task, description="compiling the estimator")
            until("compiled estimator", lambda: watch.number("estimate", "ready") or watch.text("estimate", "error"))
        if screen is not None:
            command = ["plow_twin", "dashboard", "--ros", *screen]
            shown = opened.enter_context(Child(command, folder / "screen.log"))
            until("screen", lambda: "screen: " in shown.output(), child=shown)
            console.print(shown.output(), highlight=False, markup=False)
        bar.update(task, description="running", total=seconds, completed=0.0)
        with Child([*publisher, "--rate", repr(_RATE_HZ)], folder / "publisher.log") as source:
            _follow(source, twin, watch, spin, bar, task)
            sent = int(json.loads(source.output().splitlines()[-1])["sent"])
        bar.update(task, description="using the last samples", total=None)
        # on a busy machine, the node falls behind, and samples at the end may never arrive
        while_progress(lambda: watch.accounted, sent, lambda: _wait(spin, twin), _STUCK_S)
        if estimating:
            bar.update(task, description="estimating", total=None)
            until("estimate", lambda: watch.number("estimate", "estimates") or watch.text("estimate", "error"))
        reports = watch.reports
        until("report of the node", lambda: watch.reports > reports, timeout_s=_STOP_TIMEOUT_S)
        twin.stop()
    return watch, sent


def _wait(spin: Callable[[], object], twin: Child) -> bool:
    spin()
    twin.check()
    return True


def _follow(source: Child, twin: Child, watch: Watch, spin: Any, bar: Progress, task: TaskID) -> None:
    moved, reached = time.monotonic(), 0.0
    while source.running:
        spin()
        twin.check()
        now = watch.number("state", "model_time_s")
        if now > reached:
            moved, reached = time.monotonic(), now
        # on a busy machine, the publisher starts slowly
        elif time.monotonic() - moved > (patience := _STUCK_S if reached else _START_TIMEOUT_S):
            raise DemoError(f"no progress for {patience:g} s at model time {reached:g} s\n{twin.output()}")
        bar.update(task, completed=reached)
    source.check(allowed=(0, 3))


def _until(name: str, reached: Callable[[], Any], spin: Callable[[], Any], child: Child, timeout_s: float) -> None:
    """Wait until `reached` is true. Raise `DemoError` after the time limit, or if the process `child` has ended."""
    give_up = time.monotonic() + timeout_s
    while not reached():
        spin()
        child.check()
        if time.monotonic() > give_up:
            raise DemoError(f"no {name} within {timeout_s:g} s\n{child.output()}")


class Child:
    """A process of the demo, whose output is written to a file."""

    def __init__(self, arguments: list[str], log: Path) -> None:
        self._name = arguments[0]
        self._log = log
        self._stream: IO[bytes] = log.open("wb")
        command = [sys.executable, "-m", *arguments]
        bound = shutil.which("setpriv")
        if bound is not None:  # the kernel ends the child when this process ends
            command = [bound, "--pdeathsig", "TERM", *command]
        self._process = subprocess.Popen(
            command, stdout=self._stream, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
        )

    def __enter__(self) -> Self:
        return self

    @property
    def running(self) -> bool:
        """True if the process has not ended."""
        return self._process.poll() is None

    def output(self) -> str:
        """Return the output of the process so far."""
        return self._log.read_text(errors="replace").strip()

    def check(self, allowed: tuple[int, ...] = ()) -> None:
        """Raise `DemoError` if the process has ended with an exit code that is not in `allowed`."""
        code = self._process.poll()
        if code is not None and code not in allowed:
            raise DemoError(f"{self._name} ended with code {code}\n{self.output()}")

    def stop(self) -> None:
        """Request the end of the process. Raise `DemoError` if the process ends late or with an error."""
        if self.running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise DemoError(f"{self._name} did not stop within {_STOP_TIMEOUT_S:g} s\n{self.output()}") from None
        self.check(allowed=(0,))

    def __exit__(self, *error: object) -> None:
        """Terminate the process. If the process does not end, kill it."""
        if self.running:
            self._process.terminate()
            try:
                self._process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._stream.close()


@contextmanager
def _watching() -> Iterator[tuple[Watch, Any]]:
    """Subscribe to `/diagnostics`. Yield the newest values, and a function that waits briefly for messages."""
    from diagnostic_msgs.msg import DiagnosticArray

    from plow_twin.ros.connections import WithoutEvents
    from plow_twin.ros.main import make_executor
    from plow_twin.ros.qos import DIAGNOSTICS
    from plow_twin.ros.start import ros

    with ros():
        watch, node, executor = Watch(), WithoutEvents("plow_twin_demo"), make_executor()
        node.create_subscription(DiagnosticArray, "/diagnostics", watch.receive, DIAGNOSTICS)
        executor.add_node(node)
        yield watch, lambda: executor.spin_once(timeout_sec=0.1)
        executor.remove_node(node)
        node.destroy_node()


def _progress(console: Console, quiet: bool) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.1f} s"), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=quiet)


def _view(folder: Path) -> Path | None:
    try:
        from plow_twin.view import to_rrd
    except ModuleNotFoundError as error:
        if error.name != "rerun":
            raise
        return None
    path = folder / "run.rrd"
    to_rrd(folder / "run", path)
    return path


def _losses(watch: Watch, sent: int, summary: RunSummary) -> dict[str, int]:
    published, used = int(watch.number("output", "published")), int(watch.number("input", "samples_used"))
    return {
        "samples that never arrived": sent - used - watch.dropped,
        "poses that never arrived": int(watch.number("input", "messages_lost") - watch.number("input", "samples_lost")),
        "samples received, not used": watch.dropped,
        "not published": int(watch.number("output", "withheld")),
        "published, not recorded": published - summary.frames,
        "failed advances": int(watch.number("state", "solver_failures")),
    }


def _print(console: Console, watch: Watch, summary: RunSummary, sent: int, lost: dict[str, int], *, fast: bool) -> None:
    console.print(_force_table(summary))
    for sense, shares in summary.contact_sets.items():
        sets = "  ".join(f"{corners} {share:.1%}" for corners, share in shares.items() if share >= 0.001)
        console.print(f"contact sets {sense}: {sets or 'none'}", highlight=False, soft_wrap=True)
    _print_clearances(console, summary)
    wear = (
        "off in this scene" if summary.scene.wear is None else f"{summary.wear_depth.max() * 1e6:.3f} µm, deepest pad"
    )
    console.print(f"wear {wear}", highlight=False)
    used, out = watch.text("input", "samples_used"), watch.text("output", "published")
    console.print(f"samples sent {sent}, used {used}, frames out {out}, lost {sum(lost.values())}", highlight=False)
    for name, count in lost.items():
        if count:
            console.print(f"  {name}: {count}", style="red", highlight=False)
    factor = watch.text("state", "real_time_factor_mean")
    p50, p99 = watch.text("output", "latency_p50_ms"), watch.text("output", "latency_p99_ms")
    waiting = ", mostly time in the queue, because samples are sent as fast as they are used" if fast else ""
    console.print(f"real-time factor {factor}; latency p50 {p50} ms, p99 {p99} ms{waiting}", highlight=False)


def _print_clearances(console: Console, summary: RunSummary) -> None:
    for name, (value, low, high) in summary.clearance.items():
        estimate = None if summary.estimate is None else summary.estimate[name]
        if estimate is None:
            text = f"{value * 1e3:.6f} mm (prior {low * 1e3:.6f} .. {high * 1e3:.6f} mm)"
        elif estimate["state"] in ("estimated", "rough"):
            true = 1e3 * getattr(summary.scene.clearance, f"{name}_m") + _SENSOR_MM
            low, high = 1e3 * estimate["p05_m"], 1e3 * estimate["p95_m"]
            interval = f"{estimate['state']} {low:.3f} .. {high:.3f} mm"
            text = f"{1e3 * estimate['mean_m']:.3f} mm ({interval}; true of the synthetic sensor: {true:.3f} mm)"
        else:
            text = f"{estimate['state']} from the synthetic sensor"
        console.print(f"{name} clearance {text}", highlight=False, soft_wrap=True)


def _print_comparison(console: Console, beside: Comparison) -> None:
    table = Table(title=f"Largest forces of the last {COMPARED_S:g} s in kN")
    table.add_column("pair", no_wrap=True)
    names = ("nominal", "followed", "true")
    for name in names:
        table.add_column(name, justify="right")
    for pair, title in enumerate(PAIR_NAMES):
        table.add_row(title, *(f"{beside.peaks[name][pair] / 1e3:.1f}" for name in names))
    console.print(table)
    shares = ", ".join(f"{name} {share:.1%}" for name, share in beside.error.items())
    console.print(f"error of the forces against the synthetic machine: {shares} of their RMS", highlight=False)
    came = ", ".join(f"{time_s:.1f}" for time_s in beside.estimates_s)
    text = f"estimates were made at {came} s of the run" if came else "no estimate was made during the run"
    if not came or beside.estimates_s[0] > beside.since_s:
        text += ", too late for these forces: before the first estimate, the twin uses the values of the scene"
    console.print(text, highlight=False)


def _force_table(summary: RunSummary) -> Table:
    table = Table(title="Contact forces in kN: largest, mean in contact, makes")
    letters = summary.scene.frame.corner_labels
    table.add_column("corner", no_wrap=True)
    for sense in SENSES:
        for column in ("max", "mean", "makes"):
            table.add_column(f"{sense}\n{column}", justify="right", no_wrap=True)
    for corner in CORNER_NAMES:
        pairs = [pair for pair in range(PAIR_COUNT) if corner_of(pair) == corner]
        cells = []
        for mask in SENSES.values():
            pair = next(pair for pair in pairs if mask[pair])
            cells += [f"{summary.largest[pair] / 1e3:.1f}", f"{summary.mean_in_contact[pair] / 1e3:.1f}"]
            cells.append(f"{summary.makes[pair]:.0f}")
        table.add_row(f"{letters[corner]} {corner.replace('_', ' ')}", *cells)
    return table


def program(name: str, module: str) -> str:
    """Return the shell command that starts a program of this environment from the current folder."""
    beside = Path(sys.executable).with_name(name)
    path, arguments = (beside, []) if beside.exists() else (Path(sys.executable), ["-m", module])
    relative = os.path.relpath(path)
    # the shell would search PATH for a name without a slash
    relative = relative if os.sep in relative else os.path.join(os.curdir, relative)
    return shlex.join([min(str(path), relative, key=len), *arguments])


def _print_places(console: Console, recording: Path, view: Path | None) -> None:
    again = f"{program('plow-twin', 'plow_twin')} replay {shlex.quote(str(recording))}"
    console.print(f"recording  {recording}", highlight=False, soft_wrap=True)
    console.print(f"  again, bit for bit:  {again}", highlight=False, soft_wrap=True)
    if view is None:
        console.print("no view: rerun is not installed (pip install 'plow_twin[view]')", markup=False, highlight=False)
        return
    viewer_command = f"{program('rerun', 'rerun')} {shlex.quote(str(view))}"
    console.print(f"view       {view}", highlight=False, soft_wrap=True)
    console.print(f"  look at it:          {viewer_command}", highlight=False, soft_wrap=True)
