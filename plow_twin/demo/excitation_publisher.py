"""The program `excitation_publisher`: a scene's load as samples on `excitation`, in real time or as fast as possible.

With `--sensor`, the program also publishes noisy poses of a head in a wider guide on `head_pose`. With `--cutting`, a
stochastic cutting load is added, and the speed along the face is published on `travel`.

At the speed `real`, each sample is sent at its time on the steady clock. A late sample is sent immediately. At the
speed `fast`, the program publishes `/clock`, and sends at most `WINDOW` samples ahead of the `contact_peaks` of the
twin.
"""

from __future__ import annotations

import argparse
import json
import math
import struct
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.executors import Executor
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from plow_twin.errors import ArgumentError, SceneError
from plow_twin.live.cutting_load import CuttingLoad, Face
from plow_twin.live.stop import StopRequested, StopSignals
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Clearance, Scene
from plow_twin.ros.connections import WithoutEvents
from plow_twin.ros.main import make_executor
from plow_twin.ros.messages import set_stamp
from plow_twin.ros.qos import OUTPUTS, sensor_input
from plow_twin.ros.start import RosArgumentsError, start_ros, without_ros
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.stream.intake import NS_PER_S

#: Stamp of the first sample if `/clock` is published [ns]. The stamp is not 0, because 0 means that a stamp is missing.
FIRST_STAMP_NS: Final = NS_PER_S
#: Largest number of samples without an answer at the speed `fast`.
WINDOW: Final = 200
#: Number of samples by which a reliable reader may be late, 100 s at 1 kHz.
QUEUE: Final = 100_000
_CLOCK_EVERY: Final = 10
_TRAVEL_S: Final = 0.1
_POSE_HZ: Final = 100.0
#: Standard deviations [m, m, rad] of the noise of the synthetic sensor.
_POSE_NOISE: Final = np.array([5e-4, 5e-4, 2e-3])
#: Time without an answer after which samples are counted as lost [s].
_STALL_S: Final = 2.0
#: Longest wait [ns] for acknowledgements. Fast DDS requests them every 3 s.
_ACKNOWLEDGED_NS: Final = 4 * NS_PER_S
#: Longest wait at the end for a further answer, by definition. A busy machine may stop a twin for seconds.
_SILENT_S: Final = 10.0
#: Layout of a serialised message up to its stamp: four bytes of encapsulation, sec and nanosec.
_STAMP: Final = struct.Struct("<4xiI")


@dataclass(frozen=True)
class Plan:
    """The samples to send."""

    #: loads Fx, Fy [N], M [N m], shape (n, 3); the interval between two rows is `period_ns`
    wrench: NDArray[np.float64]
    period_ns: int
    #: speed of travel [m/s], shape (n,)
    speed: NDArray[np.float64] | None = None
    #: poses x, y [m], theta [rad] of a synthetic sensor, shape (m, 3); one row is sent with every `pose_every`-th
    #: sample
    pose: NDArray[np.float64] | None = None
    pose_every: int = 1


class ExcitationPublisher(WithoutEvents):
    """Publisher of the samples of a plan."""

    def __init__(self, plan: Plan, stop: StopSignals, *, fast: bool) -> None:
        super().__init__("excitation_publisher")
        self._plan = plan
        self._travel_every = max(1, round(_TRAVEL_S * NS_PER_S / plan.period_ns))
        self._stop = stop
        self._executor: Executor = make_executor()
        self._executor.add_node(self)
        self._message = WrenchStamped()
        self._message.header.frame_id = "slide_frame"
        self._samples = self.create_publisher(WrenchStamped, "excitation", QoSProfile(depth=QUEUE))
        self._travel = None if plan.speed is None else self.create_publisher(TwistStamped, "travel", 100)
        self._twist = TwistStamped()
        self._poses = None if plan.pose is None else self.create_publisher(PoseStamped, "head_pose", QUEUE)
        self._pose = PoseStamped()
        self._pose.header.frame_id = "slide_frame"
        self._twin_reads = False
        self._answered_ns = FIRST_STAMP_NS
        self._last_ns = 0
        self._fast = fast
        self.sent = 0
        self.latest_s = 0.0
        #: Number of times that the twin did not answer in time.
        self.stalls = 0
        self.create_subscription(DiagnosticStatus, "status", self._on_status, OUTPUTS["status"])
        quality = sensor_input(1000 if fast else 1)
        self.create_subscription(JointState, "contact_peaks", self._on_answer, quality, raw=True)

    def wait_for_twin(self, timeout_s: float) -> bool:
        """Wait until a twin subscribes to `excitation`. Return False after the time limit or a requested stop."""
        give_up = time.monotonic() + timeout_s
        while not self._connected():
            if self._stop.stopped or time.monotonic() > give_up:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _connected(self) -> bool:
        answering = not self._fast or self.count_publishers("contact_peaks") > 0
        return self._twin_reads and self._samples.get_subscription_count() > 0 and answering

    def run_real(self) -> None:
        """Send each sample at its time. The stamp of a sample is its time."""
        stamp_ns, start_ns = time.time_ns(), time.monotonic_ns()
        for index, wrench in enumerate(self._plan.wrench.tolist()):
            due_ns = start_ns + index * self._plan.period_ns
            wait_ns = due_ns - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
            else:
                self.latest_s = max(self.latest_s, -wait_ns * 1e-9)
            if self._stop.stopped:
                return
            self._send(stamp_ns + index * self._plan.period_ns, wrench)

    def run_fast(self) -> None:
        """Send `/clock` and samples as fast as the twin answers."""
        clock = self.create_publisher(Clock, "/clock", QoSProfile(depth=1000))
        message, ahead_ns = Clock(), WINDOW * self._plan.period_ns
        for index, wrench in enumerate(self._plan.wrench.tolist()):
            stamp_ns = FIRST_STAMP_NS + index * self._plan.period_ns
            if index % _CLOCK_EVERY == 0:
                message.clock.sec, message.clock.nanosec = divmod(stamp_ns, NS_PER_S)
                clock.publish(message)
                self._executor.spin_once(timeout_sec=0.0)
                self._wait_for_answer(stamp_ns - ahead_ns)
            if self._stop.stopped:
                return
            self._send(stamp_ns, wrench)
        self._wait_for_answer(FIRST_STAMP_NS + (self.sent - 1) * self._plan.period_ns)

    def flush(self) -> None:
        """Wait until a twin has used all samples, and all reliable subscribers have received all messages.

        When a publisher ends, the middleware discards the messages that a slow subscriber has not read. A twin that has
        answered the last sample has read all samples, so only other messages and subscribers need acknowledgements.
        """
        while_progress(lambda: self._answered_ns, self._last_ns, self._hear_twin, _SILENT_S)
        sent = [publisher for publisher in (self._samples, self._travel, self._poses) if publisher is not None]
        if not self._stop.stopped and (len(sent) > 1 or self._samples.get_subscription_count() > 1):
            for publisher in sent:
                publisher.wait_for_all_acked(Duration(nanoseconds=_ACKNOWLEDGED_NS))

    def _hear_twin(self) -> bool:
        """Wait briefly for an answer. Return False if there is no twin, or a stop was requested."""
        if self._stop.stopped or not self.count_publishers("contact_peaks"):
            return False
        self._executor.spin_once(timeout_sec=0.05)
        return True

    def _wait_for_answer(self, stamp_ns: int) -> None:
        give_up = time.monotonic() + _STALL_S
        while self._answered_ns < stamp_ns and not self._stop.stopped:
            self._executor.spin_once(timeout_sec=0.01)
            if time.monotonic() > give_up:
                self.stalls += 1
                self._answered_ns = stamp_ns

    def _send(self, stamp_ns: int, wrench: list[float]) -> None:
        set_stamp(self._message.header, stamp_ns)
        force = self._message.wrench.force
        force.x, force.y, self._message.wrench.torque.z = wrench
        self._samples.publish(self._message)
        self._last_ns = stamp_ns
        if self._travel is not None and self._plan.speed is not None and self.sent % self._travel_every == 0:
            set_stamp(self._twist.header, stamp_ns)
            self._twist.twist.linear.z = float(self._plan.speed[self.sent])
            self._travel.publish(self._twist)
        if self._poses is not None and self._plan.pose is not None and self.sent % self._plan.pose_every == 0:
            set_stamp(self._pose.header, stamp_ns)
            pose = self._pose.pose
            pose.position.x, pose.position.y, theta = self._plan.pose[self.sent // self._plan.pose_every].tolist()
            pose.orientation.z, pose.orientation.w = math.sin(0.5 * theta), math.cos(0.5 * theta)
            self._poses.publish(self._pose)
        self.sent += 1

    def _on_status(self, message: DiagnosticStatus) -> None:
        values = {value.key: value.value for value in message.values}
        # this process may detect the connection before the twin detects it
        self._twin_reads = values.get("lifecycle") == "active" and values.get("publishers_excitation", "0") != "0"

    def _on_answer(self, data: bytes) -> None:
        sec, nanosec = _STAMP.unpack_from(data)
        self._answered_ns = max(self._answered_ns, sec * NS_PER_S + nanosec)


def while_progress(reached: Callable[[], int], target: int, wait: Callable[[], bool], longest_s: float) -> None:
    """Call `wait` until `reached()` is `target` or has not changed for `longest_s`, or `wait` returns False."""
    moved, before = time.monotonic(), reached()
    while reached() < target and time.monotonic() - moved < longest_s and wait():
        if reached() > before:
            moved, before = time.monotonic(), reached()


def plan(
    scene_name: str, rate_hz: float, seconds: float, cutting: CuttingLoad | None = None, sensor_mm: float | None = None
) -> Plan:
    """Sample the loads of a scene, except gravity, and add a cutting load.

    With `sensor_mm`, the plan contains noisy poses of a head whose clearances are larger by `sensor_mm` [mm].
    """
    period_ns = round(NS_PER_S / rate_hz)
    scene = load_scene(scene_name)
    times = np.arange(max(1, round(seconds * NS_PER_S / period_ns)), dtype=np.float64) * (period_ns * 1e-9)
    wrench, speed = compile_loads(scene.loads).at(times), None
    if cutting is not None:
        wrench, speed = wrench + cutting.at(times), cutting.face.travel(times)[1]
    if sensor_mm is None:
        return Plan(wrench, period_ns, speed)
    every = max(1, round(rate_hz / _POSE_HZ))
    return Plan(wrench, period_ns, speed, _measured(scene, times, wrench, sensor_mm)[::every], every)


def _measured(
    scene: Scene, times: NDArray[np.float64], wrench: NDArray[np.float64], wider_mm: float
) -> NDArray[np.float64]:
    """Return the noisy poses of a head in a wider guide, shape (n, 3)."""
    clearance = Clearance(scene.clearance.horizontal_m + 1e-3 * wider_mm, scene.clearance.vertical_m + 1e-3 * wider_mm)
    twin = Twin(replace(scene, clearance=clearance), excitation="sampled")
    noise = np.random.default_rng(0).standard_normal((len(times), 3)) * _POSE_NOISE
    measured: NDArray[np.float64] = twin.advance_samples(times, wrench).q + noise
    return measured


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("excitation_publisher", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scene", default="paper", help="scene file or preset whose loads are sent")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples per second of machine time [Hz]")
    parser.add_argument("--seconds", type=float, default=20.0, help="machine time [s]")
    parser.add_argument("--speed", choices=("real", "fast"), default="real", help="by the clock, or at full speed")
    parser.add_argument("--wait", type=float, default=60.0, help="longest wait for an active twin [s]")
    parser.add_argument(
        "--sensor", type=float, metavar="MM", help="publish a synthetic head_pose; clearances are larger by MM [mm]"
    )
    group = parser.add_argument_group("cutting load", "added to the scene's loads; the speed is published on travel")
    group.add_argument("--cutting", type=float, metavar="N", help="mean force into the face, along x [N]")
    group.add_argument("--lateral", type=float, default=0.0, metavar="N", help="deviation of the force along y [N]")
    group.add_argument("--at", type=float, nargs=2, default=(0.0, 0.0), metavar="M", help="point of action x y [m]")
    group.add_argument("--variation", type=float, default=0.5, help="coefficient of variation (Gamma distribution)")
    group.add_argument("--correlation", type=float, default=0.05, help="correlation length along the face [m]")
    group.add_argument("--travel-speed", type=float, default=2.0, help="speed along the face [m/s]")
    group.add_argument("--face", type=float, default=250.0, help="length of the face between two turns [m]")
    group.add_argument("--turn", type=float, default=4.0, help="duration of a turn [s]")
    group.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    for name in ("rate", "seconds", "wait"):
        if not 0.0 < getattr(options, name) < 1e6:
            parser.error(f"--{name}: got {getattr(options, name)!r}, expected a number between 0 and 1e6")
    return options


def _cutting(options: argparse.Namespace) -> CuttingLoad | None:
    if options.cutting is None:
        return None
    return CuttingLoad(
        Face(options.face, options.travel_speed, options.turn),
        options.cutting,
        options.lateral,
        (options.at[0], options.at[1]),
        options.variation,
        options.correlation,
        options.seed,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Send the load of a scene, and return the exit code.

    The exit code is 0 on success, 1 without a twin, 2 for wrong usage, or 3 if answers are missing.
    """
    import rclpy.utilities

    command_line = list(sys.argv if arguments is None else ["excitation_publisher", *arguments])
    stop = StopSignals()
    try:
        options = _parse(without_ros(command_line)[1:])
        samples = plan(options.scene, options.rate, options.seconds, _cutting(options), options.sensor)
        stop.interrupt = False
        start_ros(command_line)
    except StopRequested:
        stop.ignore()
        return 0
    except (SceneError, ArgumentError, OSError, RosArgumentsError) as error:
        print(f"excitation_publisher: {error}", file=sys.stderr)
        return 2
    node = ExcitationPublisher(samples, stop, fast=options.speed == "fast")
    try:
        return _publish(node, options)
    finally:
        node.destroy_node()
        rclpy.utilities.try_shutdown()
        stop.ignore()


def _publish(node: ExcitationPublisher, options: argparse.Namespace) -> int:
    if not node.wait_for_twin(options.wait):
        print(f"excitation_publisher: no active twin within {options.wait:g} s", file=sys.stderr)
        return 1
    begin = time.monotonic()
    if options.speed == "real":
        node.run_real()
    else:
        node.run_fast()
    node.flush()
    report = {
        "sent": node.sent,
        "seconds": round(time.monotonic() - begin, 3),
        "latest_ms": round(node.latest_s * 1e3, 3),
        "stalls": node.stalls,
    }
    print(json.dumps(report), flush=True)
    return 3 if node.stalls else 0


if __name__ == "__main__":
    sys.exit(main())
