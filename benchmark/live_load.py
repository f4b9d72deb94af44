"""The live node under load: loss, share of a core, age at a subscriber, beside a bare rclpy echo of three messages.

`python benchmark/live_load.py [--seconds N] [--repeats N]` prints a line of JSON for each case, medians of the repeats.
The machine is shared by publisher, node and subscriber: what is compared is the node and the echo in the same run.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
NS_PER_S = 1_000_000_000
#: publish mode, rate of the samples [Hz], recorded
CASES = (
    ("on_sample", 1000, False),
    ("on_sample", 1000, True),
    ("fixed_rate", 1000, False),
    ("fixed_rate", 10000, False),
)


def echo(rate_hz: float) -> None:
    """Answer each sample with three messages of the sizes that the node sends, and nothing else."""
    import rclpy
    from geometry_msgs.msg import WrenchStamped
    from nav_msgs.msg import Odometry
    from rclpy.experimental.events_executor import EventsExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    rclpy.init()
    node = rclpy.create_node("echo", namespace=f"/echo_{os.getpid()}")
    joints = [JointState(name=[f"pair_{i:016d}" for i in range(8)], position=[0.0] * 8, velocity=[0.0] * 8,
                         effort=[0.0] * 8) for _ in range(2)]  # fmt: skip
    names = ("/live_load/contact_forces", "/live_load/contact_peaks")
    sent = [(node.create_publisher(JointState, name, 1000), joint) for name, joint in zip(names, joints, strict=True)]
    sent.append((node.create_publisher(Odometry, "/live_load/head_state", 1000), Odometry()))

    def answer(message: Any) -> None:
        for publisher, reply in sent:
            reply.header.stamp = message.header.stamp
            publisher.publish(reply)

    profile = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(WrenchStamped, "/live_load/excitation", answer, profile)
    executor = EventsExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=0.1)


def send(rate_hz: float, seconds: float) -> None:
    """Publish samples with the time of sending as their stamp."""
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


def measure(answerer: list[str], rate_hz: float, seconds: float) -> dict[str, float]:
    """Run one answerer under one rate; return what was sent, used and lost, its CPU, and the age at a subscriber."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.context import Context
    from rclpy.experimental.events_executor import EventsExecutor
    from sensor_msgs.msg import JointState

    context = Context()
    context.init(args=[])
    node = rclpy.create_node("probe", context=context)
    executor = EventsExecutor(context=context)
    executor.add_node(node)
    ages: list[float] = []
    figures: dict[str, str] = {}

    def heard(data: bytes) -> None:
        sec, nanosec = struct.unpack_from("<iI", data, 4)
        ages.append((time.time_ns() - sec * NS_PER_S - nanosec) * 1e-6)

    def report(message: DiagnosticArray) -> None:
        for status in message.status:
            figures.update({item.key: item.value for item in status.values})

    node.create_subscription(JointState, "/live_load/contact_forces", heard, 5000, raw=True)
    node.create_subscription(DiagnosticArray, "/diagnostics", report, 10)
    process = subprocess.Popen(answerer, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _spin(executor, lambda: node.count_subscribers("/live_load/excitation") > 0 and
              (not figures or figures["lifecycle"] == "active"), 120.0)  # fmt: skip
        _spin(executor, lambda: False, 2.0)
        source = subprocess.Popen([sys.executable, __file__, "--role", "send", str(rate_hz), str(seconds)])
        _spin(executor, lambda: bool(ages) or figures.get("samples_used", "0") != "0", 30.0)
        busy, begin = _cpu_s(process.pid), time.monotonic()
        _spin(executor, lambda: source.poll() is not None, seconds + 30.0)
        share = (_cpu_s(process.pid) - busy) / (time.monotonic() - begin)
        figures.pop("samples_used", None)
        if "published" in figures:
            _spin(executor, lambda: "samples_used" in figures, 5.0)
    finally:
        process.terminate()
        process.wait(20.0)
        executor.remove_node(node)
        node.destroy_node()
        context.try_shutdown()
    ages.sort()
    return {
        "sent": round(rate_hz * seconds),
        "used": int(figures.get("samples_used", len(ages))),
        "lost": int(figures.get("samples_lost", 0)),
        "messages": len(ages),
        "core": round(share, 3),
        "age_p50_ms": round(ages[len(ages) // 2], 3),
        "age_p99_ms": round(ages[len(ages) * 99 // 100], 3),
    }


def environment() -> dict[str, str]:
    """Return the environment of the processes."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}


def _cpu_s(process_id: int) -> float:
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _spin(executor: Any, reached: Callable[[], bool], timeout_s: float) -> None:
    give_up = time.monotonic() + timeout_s
    while not reached() and time.monotonic() < give_up:
        executor.spin_once(timeout_sec=0.02)


def _twin(mode: str, folder: str) -> list[str]:
    given = {"publish_mode": mode, "excitation_timeout": 60.0, "record_path": folder}
    settings = [word for name, value in given.items() if value != "" for word in ("-p", f"{name}:={value}")]
    return [sys.executable, "-m", "plow_twin.ros.main", "--ros-args", "-r", "__ns:=/live_load", *settings]


def main() -> None:
    """Print the table."""
    import tempfile

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--role", nargs="+", default=[])
    options = parser.parse_args()
    if options.role:
        role, *numbers = options.role
        {"echo": echo, "send": send}[role](*map(float, numbers))
        return
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", "91")
    with tempfile.TemporaryDirectory() as folder:
        cases = [("echo", 1000, False), *CASES]
        for case, (mode, rate, recorded) in enumerate(cases):
            runs = []
            for repeat in range(options.repeats):
                path = f"{folder}/{case}_{repeat}" if recorded else ""
                answerer = [sys.executable, __file__, "--role", "echo", str(rate)]
                runs.append(measure(answerer if mode == "echo" else _twin(mode, path), rate, options.seconds))
            row = {key: median(run[key] for run in runs) for key in runs[0]}
            print(json.dumps({"mode": mode, "rate_hz": rate, "recorded": recorded, **row}), flush=True)


if __name__ == "__main__":
    main()
