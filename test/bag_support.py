"""Bags in the format of other programs, with the paper's load and poses of a sensor with bias, delay and noise."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from record_support import BASE_NS, STEP_NS, paper_sample
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]

COUNT = 8000
LAG_S = 0.037
BIAS = (0.002, -0.003, 0.004)
STORE = get_typestore(Stores.ROS2_JAZZY)
PAPER = scene_path("paper")
MAP = """
excitation: {topic: /load, type: geometry_msgs/msg/WrenchStamped, stamp: header, scale: {fx: 1000, fy: 1000, m: 1000},
  fields: {fx: wrench.force.x, fy: wrench.force.y, m: wrench.torque.z}}
head_pose: {topic: /pose}
"""


@cache
def motion() -> Motion:
    """Return times (n,), loads (n, 3) and poses (n, 3) of the paper's head during 8 s."""
    twin = Twin(load_scene(PAPER), excitation="sampled")
    times = np.arange(COUNT) * 1e-3
    wrench = np.array([paper_sample(index).wrench for index in range(COUNT)])
    return times, wrench, twin.advance_samples(times, wrench).q


def measured(motion: Motion) -> Iterable[tuple[float, np.ndarray]]:
    """Yield times and poses at 100 Hz, with delay, bias and noise."""
    times, _, q = motion
    rng = np.random.default_rng(4)
    for t in np.arange(0.1, times[-1], 0.01):
        late = np.array([np.interp(t - LAG_S, times, q[:, k]) for k in range(3)])
        yield t, late - BIAS + rng.normal(0.0, [1e-4, 1e-4, 2e-4])


def wrench_message(stamp_ns: int, wrench: Any) -> bytes:
    types = STORE.types
    vector = types["geometry_msgs/msg/Vector3"]
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = types["std_msgs/msg/Header"](stamp, "f")
    body = types["geometry_msgs/msg/Wrench"](vector(wrench[0], wrench[1], 0.0), vector(0.0, 0.0, wrench[2]))
    message = types["geometry_msgs/msg/WrenchStamped"](header, body)
    return bytes(STORE.serialize_cdr(message, "geometry_msgs/msg/WrenchStamped"))


def pose_message(stamp_ns: int, q: Any) -> bytes:
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(q[2] / 2), np.cos(q[2] / 2))
    pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](q[0], q[1], 0.0), turn)
    message = types["geometry_msgs/msg/PoseStamped"](types["std_msgs/msg/Header"](stamp, "f"), pose)
    return bytes(STORE.serialize_cdr(message, "geometry_msgs/msg/PoseStamped"))


def write_bag(folder: Path, motion: Motion, plugin: StoragePlugin) -> Path:
    messages = [
        (BASE_NS + i * STEP_NS, "/load", wrench_message(BASE_NS + i * STEP_NS, wrench / 1000.0))
        for i, wrench in enumerate(motion[1])
    ]
    messages += [
        (BASE_NS + round(t * 1e9), "/pose", pose_message(BASE_NS + round(t * 1e9), q)) for t, q in measured(motion)
    ]
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        kinds = {"/load": "geometry_msgs/msg/WrenchStamped", "/pose": "geometry_msgs/msg/PoseStamped"}
        connections = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}
        for time_ns, topic, data in sorted(messages):
            writer.write(connections[topic], time_ns + 1_000_000, data)
    (folder.parent / "map.yaml").write_text(MAP)
    return folder
