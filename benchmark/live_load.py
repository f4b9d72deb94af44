"""The live node under load: loss, share of a core and age of messages, compared with a bare rclpy echo.

`python benchmark/live_load.py [--seconds N] [--repeats N]` runs all cases once in each repeat. It prints a line of JSON
for each case, then the medians and the targets. Other options replace these cases:

    --minutes N   run the node with its recorder at 1 kHz (or `--rate`) for N minutes; print a line every ten seconds,
                  the growth of each figure, and whether each sent message was used or counted
    --beside      run the echo, the node and a recording node at the same time with the same samples; other programs
                  disturb all of them equally, so the ratios are valid on a busy machine too
    --estimate    run the node alternately without and with the estimate and its 256 twins, under the paper's load and
                  a synthetic pose at 100 Hz, for `--seconds` after the first window has been formed
    --opcua       run `plow-twin live` with an OPC UA server for `--minutes` (10): see `opcua_load.py`

Publisher, node and subscriber share the machine, so only figures of the same run can be compared.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
NS_PER_S = 1_000_000_000
PERIOD_S = 10.0
#: Time [s] from the first published message until the first window of an estimate has been formed.
FORMED_S = 34.0


class Case(NamedTuple):
    """A case: publish mode of the node (or `echo`, `raw_echo`), sample rate [Hz], and whether the node records."""

    mode: str
    rate_hz: float
    recorded: bool = False


ECHO, RAW_ECHO = Case("echo", 1000), Case("raw_echo", 1000)
ON_SAMPLE, RECORDED = Case("on_sample", 1000), Case("on_sample", 1000, True)
FIXED, FIXED_RECORDED = Case("fixed_rate", 1000), Case("fixed_rate", 1000, True)
CASES = (ECHO, RAW_ECHO, ON_SAMPLE, RECORDED, FIXED, FIXED_RECORDED, Case("fixed_rate", 10000))


def echo(raw: bool = False, namespace: str = "live_load") -> None:
    """Answer each sample with three messages of the size of the node's messages.

    With `raw`, the messages are serialised in advance, and only the stamp of the sample is written into them.
    """
    import rclpy
    from geometry_msgs.msg import WrenchStamped
    from nav_msgs.msg import Odometry
    from rclpy.experimental.events_executor import EventsExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import JointState

    rclpy.init()
    node = rclpy.create_node("echo", namespace=f"/echo_{os.getpid()}")
    joints = [JointState(name=[f"pair_{i:016d}" for i in range(8)], position=[0.0] * 8, velocity=[0.0] * 8,
                         effort=[0.0] * 8) for _ in range(2)]  # fmt: skip
    names = (f"/{namespace}/contact_forces", f"/{namespace}/contact_peaks")
    sent = [(node.create_publisher(JointState, name, 1000), joint) for name, joint in zip(names, joints, strict=True)]
    sent.append((node.create_publisher(Odometry, f"/{namespace}/head_state", 1000), Odometry()))

    def answer(message: Any) -> None:
        for publisher, reply in sent:
            reply.header.stamp = message.header.stamp
            publisher.publish(reply)

    ready = [(publisher, bytearray(serialize_message(reply))) for publisher, reply in sent]

    def answer_raw(data: bytes) -> None:
        for publisher, reply in ready:
            reply[4:12] = data[4:12]
            publisher.publish(bytes(reply))

    profile = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)  # type: ignore[no-untyped-call]
    how = answer_raw if raw else answer
    node.create_subscription(WrenchStamped, "/live_load/excitation", how, profile, raw=raw)
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


def send(rate_hz: float, seconds: float) -> None:
    import rclpy
    from geometry_msgs.msg import WrenchStamped

    rclpy.init()
    node = rclpy.create_node("source")
    publisher = node.create_publisher(WrenchStamped, "/live_load/excitation", 1000)
    while publisher.get_subscription_count() < 1:
        time.sleep(0.05)
    time.sleep(1.0)
    message, begin = WrenchStamped(), time.monotonic()
    for index in range(round(rate_hz * seconds)):
        wait_s = begin + index / rate_hz - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), NS_PER_S)
        publisher.publish(message)
    time.sleep(1.0)


class Probe:
    """A node that subscribes to the forces and the diagnostics."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.context import Context
        from rclpy.experimental.events_executor import EventsExecutor
        from sensor_msgs.msg import JointState

        self.context = Context()
        self.context.init(args=[])
        self.node = rclpy.create_node("probe", context=self.context)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        #: Age of each message [ms].
        self.ages: list[float] = []
        #: Values of the newest diagnostics.
        self.figures: dict[str, str] = {}
        self.node.create_subscription(JointState, "/live_load/contact_forces", self._heard, 5000, raw=True)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._report, 10)

    def _heard(self, data: bytes) -> None:
        _append_age(self.ages, data)

    def _report(self, message: Any) -> None:
        for status in message.status:
            self.figures.update({item.key: item.value for item in status.values})

    def spin(self, reached: Callable[[], bool], timeout_s: float) -> None:
        """Process messages until `reached` returns True, or until the timeout."""
        give_up = time.monotonic() + timeout_s
        while not reached() and time.monotonic() < give_up:
            self._executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        """Shut the node down."""
        self._executor.remove_node(self.node)
        self.node.destroy_node()  # type: ignore[no-untyped-call]
        self.context.try_shutdown()


@contextmanager
def running(answerer: list[str]) -> Iterator[tuple[Probe, int]]:
    """Start an answering process. Yield a probe and the process id after the first answer."""
    probe = Probe()
    process = subprocess.Popen(answerer, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        probe.spin(lambda: probe.node.count_subscribers("/live_load/excitation") > 0 and
                   (not probe.figures or probe.figures["lifecycle"] == "active"), 120.0)  # fmt: skip
        probe.spin(lambda: False, 2.0)
        yield probe, process.pid
    finally:
        process.terminate()
        process.wait(20.0)
        probe.close()


def source(rate_hz: float, seconds: float) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, __file__, "--role", "send", str(rate_hz), str(seconds)], env=environment())


def measure(answerer: list[str], rate_hz: float, seconds: float) -> dict[str, float]:
    """Run an answering process. Return its counts of samples, its share of a core, and the ages of its messages."""
    with running(answerer) as (probe, process_id):
        sender, ages, figures = source(rate_hz, seconds), probe.ages, probe.figures
        try:
            probe.spin(lambda: bool(ages) or figures.get("samples_used", "0") != "0", 30.0)
            busy, begin = cpu_s(process_id), time.monotonic()
            probe.spin(lambda: False, 1.0)
            first_s = max(ages, default=0.0)
            probe.spin(lambda: sender.poll() is not None, seconds + 30.0)
            share = (cpu_s(process_id) - busy) / (time.monotonic() - begin)
        finally:
            sender.kill()  # otherwise the sender would send to the next case
            sender.wait()
        figures.pop("samples_used", None)
        if "published" in figures:
            probe.spin(lambda: "samples_used" in figures, 5.0)
    return {
        "sent": round(rate_hz * seconds),
        "used": int(figures.get("samples_used", len(ages))),
        "lost": int(figures.get("samples_lost", 0)),
        "messages": len(ages),
        "core": round(share, 3),
        **quantiles(ages),
        "age_max_of_first_second_ms": round(first_s, 3),
    }


def quantiles(ages: list[float], without: Any = math.nan) -> dict[str, Any]:
    ordered = sorted(ages)
    return {f"age_p{p}_ms": round(ordered[len(ordered) * p // 100], 3) if ordered else without for p in (50, 99)}


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}


def _twin(mode: str, folder: str, namespace: str = "/live_load", parameters: dict[str, str] | None = None) -> list[str]:
    named = {"publish_mode": mode, "excitation_timeout": 60.0, "record_path": folder} | (parameters or {})
    settings = [word for name, value in named.items() if value != "" for word in ("-p", f"{name}:={value}")]
    return [sys.executable, "-m", "plow_twin.ros.main", "--ros-args", "-r", f"__ns:={namespace}", "-r",
            "excitation:=/live_load/excitation", *settings]  # fmt: skip


def estimating(seconds: float, repeats: int) -> None:
    runs: dict[bool, list[dict[str, float]]] = {False: [], True: []}
    for _ in range(repeats):
        for on, results in runs.items():
            results.append(_one_estimating(on, seconds))
            print(json.dumps({"estimate": on, **results[-1]}), flush=True)
    print("medians", flush=True)
    for on, results in runs.items():
        print(
            json.dumps({"estimate": on} | {key: median(run[key] for run in results) for key in results[0]}), flush=True
        )


def _one_estimating(on: bool, seconds: float) -> dict[str, float]:
    options = {"estimate": "true", "estimate_forces": "256"} if on else {}
    command = _twin("on_sample", "", parameters=options)
    publisher = [sys.executable, "-m", "plow_twin.demo.excitation_publisher", "--sensor", "3", "--seconds",
                 str(seconds + FORMED_S + 10.0), "--ros-args", "-r", "__ns:=/live_load"]  # fmt: skip
    with running(command) as (probe, process_id):
        sender = subprocess.Popen(publisher, env=environment(), stdout=subprocess.DEVNULL)
        try:
            probe.spin(lambda: bool(probe.ages), 60.0)
            probe.spin(lambda: False, FORMED_S)
            probe.ages.clear()
            beside = _children(process_id)
            busy = [cpu_s(process_id), sum(map(cpu_s, beside))]
            begin = time.monotonic()
            probe.spin(lambda: False, seconds)
            passed_s = time.monotonic() - begin
            share = (cpu_s(process_id) - busy[0]) / passed_s
            estimate_share = (sum(map(cpu_s, beside)) - busy[1]) / passed_s
        finally:
            sender.kill()
            sender.wait()
        return {
            "messages": len(probe.ages),
            "core": round(share, 3),
            "core_of_the_estimate": round(estimate_share, 3),
            "estimates": int(probe.figures.get("estimates") or 0),
            **quantiles(probe.ages),
        }


def _children(process_id: int) -> list[int]:
    tasks = Path(f"/proc/{process_id}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


def compare(seconds: float, repeats: int) -> None:
    runs: dict[Case, list[dict[str, float]]] = {case: [] for case in CASES}
    with tempfile.TemporaryDirectory() as folder:
        for repeat in range(repeats):
            for number, case in enumerate(CASES):
                path = f"{folder}/{number}_{repeat}" if case.recorded else ""
                answerer = [sys.executable, __file__, "--role", case.mode]
                command = answerer if case in (ECHO, RAW_ECHO) else _twin(case.mode, path)
                measured = measure(command, case.rate_hz, seconds)
                print(json.dumps(case._asdict() | measured), flush=True)
                if measured["messages"]:  # a case without an answer is reported below
                    runs[case].append(measured)
    if not all(runs.values()):
        sys.exit("a case was never answered: no medians")
    rows = {case: {key: median(run[key] for run in results) for key in results[0]} for case, results in runs.items()}
    print("medians", flush=True)
    for case, row in rows.items():
        print(json.dumps(case._asdict() | row), flush=True)
    for text, reached, most in _targets(rows):
        print(f"{'reached' if reached <= most else 'MISSED '} {reached:8.3f} of {most:g}: {text}", flush=True)


def _targets(rows: dict[Case, dict[str, float]]) -> Iterator[tuple[str, float, float]]:
    bare = rows[ECHO]
    for case, how in ((ON_SAMPLE, ""), (RECORDED, ", recording")):
        row = rows[case]
        yield f"CPU against the echo, 1 kHz out{how}", row["core"] / bare["core"], 1.3
        yield f"median age against the echo, 1 kHz out{how}", row["age_p50_ms"] / bare["age_p50_ms"], 1.3
        yield f"p99 of the age above the echo [ms], 1 kHz out{how}", row["age_p99_ms"] - bare["age_p99_ms"], 1.0
    for case, how in ((FIXED, ""), (FIXED_RECORDED, ", recording")):
        yield f"share of a core, 100 Hz out{how}", rows[case]["core"], 1.0 / 3.0


def beside(seconds: float) -> None:
    from sensor_msgs.msg import JointState

    probe, cases = Probe(), {"echo": ECHO, "on_sample": ON_SAMPLE, "recording": RECORDED}
    heard: dict[str, list[float]] = {name: [] for name in cases}
    shares: dict[str, list[float]] = {name: [] for name in cases}
    running: dict[str, subprocess.Popen[bytes]] = {}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name, case in cases.items():
                command = [sys.executable, __file__, "--role", f"echo:{name}"]
                if case is not ECHO:
                    command = _twin(case.mode, f"{folder}/run" if case.recorded else "", f"/{name}")
                running[name] = subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL)
                hear = partial(_append_age, heard[name])
                probe.node.create_subscription(JointState, f"/{name}/contact_forces", hear, 5000, raw=True)
            probe.spin(lambda: probe.node.count_subscribers("/live_load/excitation") >= len(cases), 120.0)
            probe.spin(lambda: False, 3.0)
            sender = source(1000.0, seconds)
            probe.spin(lambda: all(len(ages) > 500 for ages in heard.values()), 60.0)
            for ages in heard.values():
                ages.clear()
            while sender.poll() is None:
                before, begin = {name: cpu_s(process.pid) for name, process in running.items()}, time.monotonic()
                probe.spin(lambda: sender.poll() is not None, 2.0)
                passed_s = time.monotonic() - begin
                if passed_s > 1.9:
                    for name, process in running.items():
                        shares[name].append((cpu_s(process.pid) - before[name]) / passed_s)
        finally:
            for process in running.values():
                process.terminate()
            for process in running.values():
                process.wait(20.0)
            probe.close()
    for name, ages in heard.items():
        ratios = [share / echo_s for share, echo_s in zip(shares[name], shares["echo"], strict=True)]
        print(json.dumps({
            "case": name, "messages": len(ages),
            "core": round(median(shares[name]), 3), "x_echo": round(median(ratios), 3),
            **quantiles(ages),
        }))  # fmt: skip


def _append_age(ages: list[float], data: bytes) -> None:
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    ages.append((time.time_ns() - sec * NS_PER_S - nanosec) * 1e-6)


def cpu_s(process_id: int) -> float:
    """Return the CPU time [s] of all threads of a process, from the scheduler, which is more precise than `stat`."""
    tasks = Path(f"/proc/{process_id}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) * 1e-9


def soak(minutes: float, rate_hz: float) -> bool:
    """Run the node with its recorder. Print its figures, their growth, and the account of the messages.

    Return whether each sent message was used, dropped for a reason, or counted as lost.
    """
    rows: list[dict[str, float | None]] = []
    with tempfile.TemporaryDirectory() as folder, running(_twin("on_sample", f"{folder}/soak")) as (probe, process_id):
        sender, begin = source(rate_hz, 60.0 * minutes), time.monotonic()
        while sender.poll() is None:
            count, busy = len(probe.ages), cpu_s(process_id)
            probe.spin(lambda: sender.poll() is not None, PERIOD_S)
            ages, figures = probe.ages[count:], probe.figures
            rows.append({
                "minute": round((time.monotonic() - begin) / 60.0, 2),
                "rss_mib": round(_status(process_id, "VmRSS") / 1024.0, 2),
                "threads": _status(process_id, "Threads"),
                "files": len(os.listdir(f"/proc/{process_id}/fd")),
                "core": round((cpu_s(process_id) - busy) / PERIOD_S, 3),
                **quantiles(ages, None),  # None instead of NaN if no message arrived
                "queued": int(figures.get("queued") or 0),
                **account(figures),
            })  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
            probe.ages.clear()
        probe.figures.clear()
        probe.spin(lambda: "samples_used" in probe.figures, 10.0)
        counted = account(probe.figures)
    later = rows[len(rows) // 2 :]
    hours = ((later[-1]["minute"] or 0.0) - (later[0]["minute"] or 0.0)) / 60.0
    for key in ("rss_mib", "threads", "files", "age_p50_ms", "queued"):
        first, last = later[0][key], later[-1][key]
        if first is not None and last is not None:
            print(f"{key}: {first:g} -> {last:g}, {(last - first) / hours if hours else 0.0:.3g} an hour")
    slope, width = _growth([row["minute"] or 0.0 for row in rows], [row["rss_mib"] or 0.0 for row in rows])
    print(f"rss_mib after the first quarter: {slope:.2f} +- {width:.2f} an hour (95 %)")
    sent = round(rate_hz * 60.0 * minutes)
    print(f"sent {sent}, {counted}: {sent - sum(counted.values())} not accounted for")
    return sent == sum(counted.values())


def _growth(minutes: list[float], sizes: list[float]) -> tuple[float, float]:
    """Return the slope per hour after the first quarter, and the half-width of its 95 % interval.

    Memory grows in steps, so the slope is fitted to the means of six blocks.
    """
    import numpy as np

    blocks = np.array_split(np.array([minutes, sizes])[:, len(minutes) // 4 :], 6, axis=1)
    if any(part.shape[1] == 0 for part in blocks):
        return math.nan, math.nan
    hours, means = np.array([part.mean(axis=1) for part in blocks]).T / np.array([[60.0], [1.0]])
    (slope, start), away = np.polyfit(hours, means, 1), hours - hours.mean()
    spread = math.sqrt(((means - slope * hours - start) ** 2).sum() / (len(blocks) - 2) / (away**2).sum())
    return float(slope), 2.776 * spread  # 97.5 % point of Student's t with four degrees of freedom


def account(figures: dict[str, str]) -> dict[str, int]:
    dropped = sum(int(value) for key, value in figures.items() if key.startswith("dropped_"))
    return {
        "used": int(figures.get("samples_used", 0)),
        "dropped": dropped,
        "lost": int(figures.get("samples_lost", 0)),
    }


def _status(process_id: int, key: str) -> int:
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="sample rate for --minutes [Hz]")
    parser.add_argument("--beside", action="store_true", help="run echo and nodes at the same time, for --seconds")
    parser.add_argument("--role", nargs="+", default=[])
    parser.add_argument(
        "--estimate", action="store_true", help="run the node without and with the estimate, for --seconds each"
    )
    parser.add_argument(
        "--opcua", action="store_true", help="run `plow-twin live` with an OPC UA server, for --minutes"
    )
    options = parser.parse_args()
    if options.opcua:
        import opcua_load

        sys.exit(0 if opcua_load.measure(options.minutes or 10.0, options.rate) else 1)
    if options.role:
        role, *numbers = options.role
        roles: dict[str, Callable[..., None]] = {"echo": echo, "raw_echo": partial(echo, True), "send": send,
                                                 "echo:echo": partial(echo, False, "echo")}  # fmt: skip
        roles[role](*map(float, numbers))
        return
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", "91")
    if options.beside:
        beside(options.seconds)
        return
    if options.estimate:
        estimating(options.seconds, options.repeats)
        return
    if options.minutes:
        sys.exit(0 if soak(options.minutes, options.rate) else 1)
    compare(options.seconds, options.repeats)


if __name__ == "__main__":
    main()
