"""`plow-twin record` beside a node writes other topics, byte for byte, into the folder of the run."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
from commands import started
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_processes import bench
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from plow_twin.record.reader import RunReader
from plow_twin.ros.messages import set_stamp
from plow_twin.study.analysis.analyse import analyse

COUNT = 300
T0 = 1_795_000_000_000_000_000
MAP = "head_pose: {topic: %s/camera/pose, type: geometry_msgs/msg/PoseStamped}\n"


def test_other_topics_are_recorded_in_the_run_s_folder_with_their_types(tmp_path: Path) -> None:
    run, log = tmp_path / "run", tmp_path / "record.log"
    parameters = {"record_path": run, "qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}
    with bench(tmp_path, excitation_timeout=60.0, **parameters) as running:
        probe, namespace = running.probe, running.namespace
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        notes = probe.node.create_publisher(DiagnosticArray, "notes", latched)
        note = DiagnosticArray(status=[DiagnosticStatus(name="n", values=[KeyValue(key="k", value="v")])])
        notes.publish(note)
        camera = probe.node.create_publisher(PoseStamped, "camera/pose", 1000)
        strong = probe.node.create_publisher(PoseStamped, "gauge", 1000)
        others = f"^(?!{namespace}/)"  # other tests may run at the same time
        command = [sys.executable, "-m", "plow_twin", "record", str(run), "--all", "--exclude", others, "--json"]
        with log.open("wb") as stream:
            recorder = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stream, text=True)
        try:
            probe.until(lambda: camera.get_subscription_count() == 1, "the recorder")
            # a publisher with a weaker QoS starts later; messages of both publishers are received once
            best_effort = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
            weak = probe.node.create_publisher(PoseStamped, "gauge", best_effort)
            probe.until(lambda: weak.get_subscription_count() == 1, "a subscription that the weaker publisher matches")
            send = probe.excitation()
            for index in range(COUNT):
                send(T0 + index * 1_000_000, (32e3, 0.0, -45e3))
                pose = PoseStamped()
                set_stamp(pose.header, T0 + index * 1_000_000)
                pose.pose.position.x = float(index)
                for publisher in (camera, strong, weak):
                    publisher.publish(pose)
                probe.pace(index)
            probe.until_figure("input", "samples_used", str(COUNT))
            recorder.send_signal(signal.SIGTERM)
            out, _ = recorder.communicate(timeout=20)
        finally:
            recorder.kill()
            recorder.wait()
    facts = json.loads(out)
    assert recorder.returncode == (3 if facts["lost"] else 0), log.read_text()
    assert facts["messages"][f"{namespace}/camera/pose"] == COUNT and facts["messages"][f"{namespace}/notes"] == 1
    gauge = f"{namespace}/gauge"
    assert facts["messages"][gauge] + facts["lost"].pop(gauge, 0) == 2 * COUNT  # best-effort messages may be lost
    assert facts["lost"] == {} == facts["skipped_topics"] and facts["without_publisher"] == []
    # topics of the run itself are not recorded again
    assert not facts["messages"].keys() & {*RunReader(run).header.topics.values()}
    with Reader(run / "beside") as reader:
        store = get_typestore(Stores.EMPTY)
        for connection in reader.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        poses = [store.deserialize_cdr(data, c.msgtype) for c, _, data in reader.messages() if "camera" in c.topic]
        assert [pose.pose.position.x for pose in poses] == list(np.arange(COUNT, dtype=float))
    (tmp_path / "map.yaml").write_text(MAP % namespace)
    analysis = analyse(run, mapping=tmp_path / "map.yaml")
    assert analysis.comparisons(analysis.predictions[0])["x"].n == COUNT


def test_a_named_topic_without_a_publisher_is_an_error(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "plow_twin", "record", str(tmp_path / "run"), "never", "--wait", "0"]
    with started(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as recorder:
        assert recorder.stderr is not None
        assert "recording to" in recorder.stderr.readline()
        recorder.send_signal(signal.SIGTERM)
        errors = recorder.stderr.read()
    assert "/never: not recorded: got no publisher, expected at least one" in errors
    assert recorder.returncode == 3
