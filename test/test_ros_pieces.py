"""Files and topics beside the node: markers, layouts, groups of diagnostics, and access rights."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from nav_msgs.msg import Odometry
from ros_processes import ROOT, bench
from visualization_msgs.msg import Marker, MarkerArray

from plow_twin.dashboard.feed import Feed
from plow_twin.dashboard.node import NodeWatch
from plow_twin.live.diagnostics import KEYS
from plow_twin.live.service_names import SERVICES
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.ros.start import ros
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.topics import TOPICS

CONFIG = ROOT / "config"
OUTPUTS = {topic.name for topic in TOPICS}
RELIABLE_INPUT = {"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}


def _rights(enclave: str, kind: str, right: str, namespace: str) -> set[str]:
    """Return the full names that the policy allows an enclave to use; `~` is replaced by the name of its node."""
    root = ElementTree.parse(CONFIG / "sros2" / "policy.xml").getroot()
    profiles = root.findall(f".//enclave[@path='{enclave}']//profile")
    names = [
        (item.text or "").replace("~", f"/{profile.get('node')}")
        for profile in profiles
        for item in profile.findall(f"{kind}s[@{right}='ALLOW']/{kind}")
    ]
    apart = {"/rosout", "/parameter_events", "/diagnostics", "/tf"}
    return {name if name in apart else f"{namespace}/{name.removeprefix('/')}" for name in names}


def test_the_policy_allows_exactly_the_names_of_the_node(tmp_path: Path) -> None:
    with bench(tmp_path, lifecycle="active") as running:
        name, node, ns = ("plow_twin", running.namespace), running.probe.node, running.namespace
        optional = {f"{ns}/{topic}" for topic in (*OUTPUTS, "markers")} | {"/tf"}
        running.probe.until(lambda: name in node.get_node_names_and_namespaces(), "the twin")
        running.probe.until(lambda: node.get_service_names_and_types_by_node(*name), "the services of the twin")
        running.probe.pause(1.0)
        sent = {topic for topic, _ in node.get_publisher_names_and_types_by_node(*name)}
        subscribed = {topic for topic, _ in node.get_subscriber_names_and_types_by_node(*name)}
        answered = {service for service, _ in node.get_service_names_and_types_by_node(*name)}
    assert f"{ns}/markers" not in sent and "/tf" not in sent
    allowed = _rights("/plow_twin/twin", "topic", "publish", ns)
    assert sent <= allowed and allowed - sent <= optional
    assert _rights("/plow_twin/twin", "topic", "subscribe", ns) == subscribed | {"/parameter_events"}
    assert _rights("/plow_twin/twin", "service", "reply", ns) == answered
    assert _rights("/plow_twin/manager", "service", "request", ns) == answered
    assert {f"{ns}/plow_twin/{service}" for service in SERVICES} <= answered
    # the sender of the load may publish only the inputs, and may call no service
    assert not _rights("/plow_twin/plant", "service", "request", ns)
    assert _rights("/plow_twin/plant", "topic", "publish", ns) - {"/rosout"} == subscribed - {"/parameter_events"}


def test_the_policy_contains_only_enclaves_beside_each_other() -> None:
    """sros2 reads each child of `enclaves` as an enclave, and a comment ends the generation of keys with an error."""
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    (enclaves,) = ElementTree.parse(CONFIG / "sros2" / "policy.xml", parser).getroot()
    assert len(enclaves) > 5 and {child.tag for child in enclaves} == {"enclave"}


def test_the_policy_allows_exactly_the_names_of_the_screen(tmp_path: Path) -> None:
    with bench(tmp_path, lifecycle="active") as running, ros():
        name, node, ns = ("plow_twin_screen", running.namespace), running.probe.node, running.namespace
        with closing(NodeWatch(ns, "plow_twin", 30.0, lambda: False)) as watch:
            watch.facts(None)
            watch.listen(Feed(None, {}))  # type: ignore[arg-type]  # no message is passed on
            running.probe.until(lambda: name in node.get_node_names_and_namespaces(), "the screen")
            running.probe.pause(1.0)
            sent = {topic for topic, _ in node.get_publisher_names_and_types_by_node(*name)}
            subscribed = {topic for topic, _ in node.get_subscriber_names_and_types_by_node(*name)}
            asked = {service for service, _ in node.get_client_names_and_types_by_node(*name)}
            answered = {service for service, _ in node.get_service_names_and_types_by_node(*name)}
    rights = partial(_rights, "/plow_twin/screen", namespace=ns)
    assert rights("topic", "publish") == sent and rights("topic", "subscribe") == subscribed
    assert rights("service", "request") == asked and rights("service", "reply") == answered
    assert asked <= _rights("/plow_twin/manager", "service", "request", ns)


def test_markers_show_the_head_where_it_is_and_the_forces_on_it(tmp_path: Path) -> None:
    scene = load_scene(scene_path("paper"))
    with bench(tmp_path, marker_rate=50.0, excitation_timeout=60.0, **RELIABLE_INPUT) as running:
        drawn = running.probe.listen(MarkerArray, "markers")
        moved = running.probe.listen(Odometry, "head_state")
        send = running.probe.excitation()
        for index in range(400):
            send(1_795_000_000_000_000_000 + index * 1_000_000, (40_000.0, -20_000.0, 0.0))
            running.probe.pace(index)
        last = lambda: moved and drawn and drawn[-1].markers[0].header.stamp == moved[-1].header.stamp  # noqa: E731
        running.probe.until(lambda: len(moved) == 400 and last(), "markers of the newest state")
    markers = {(marker.ns, marker.id): marker for marker in drawn[-1].markers}
    assert {marker.header.frame_id for marker in markers.values()} == {"slide_frame"}
    cavity = np.array([(point.x, point.y) for point in markers["cavity", 0].points[:4]])
    place = moved[-1].pose.pose.position
    assert cavity.mean(axis=0) == pytest.approx((place.x, place.y))
    assert np.linalg.norm(cavity[1] - cavity[0]) == pytest.approx(scene.frame.width_m + scene.clearance.horizontal_m)
    frame = np.array([(point.x, point.y) for point in markers["frame", 0].points[:4]])
    assert np.ptp(frame, axis=0) == pytest.approx((scene.frame.width_m, scene.frame.height_m))
    arrows = [marker for (kind, _), marker in markers.items() if kind == "forces" and marker.action == Marker.ADD]
    assert 0 < len(arrows) < len(PAIR_NAMES)
    # the load pushes the head to the right and down, and the forces of the walls push it back
    pushed = sum(
        np.array([arrow.points[1].x - arrow.points[0].x, arrow.points[1].y - arrow.points[0].y]) for arrow in arrows
    )
    assert pushed[0] < 0.0


def test_without_markers_their_messages_are_not_imported() -> None:
    code = "import sys, plow_twin.ros.main, plow_twin.ros.front; print('visualization_msgs' in sys.modules)"
    completed = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert completed.stdout.strip() == "False"


def test_layouts_name_topics_and_numbers_that_exist() -> None:
    foxglove = json.loads((CONFIG / "foxglove.json").read_text())
    paths = [path for panel in foxglove["configById"].values() for path in panel.get("paths", ())]
    named = {re.match(r"/(\w+)", path["value"])[1] for path in paths}  # type: ignore[index]
    for path in paths:
        if "contact_forces" in path["value"]:
            assert PAIR_NAMES[int(re.search(r"\[(\d)\]", path["value"])[1])] == path["label"]  # type: ignore[index]
    curves = [curve.get("name", "") for curve in ElementTree.parse(CONFIG / "plotjuggler.xml").iter("curve")]
    assert {curve.split("/")[2] for curve in curves if curve.startswith("/contact_forces")} == set(PAIR_NAMES)
    assert named | {curve.split("/")[1] for curve in curves} <= OUTPUTS
    displays = yaml.safe_load((CONFIG / "twin.rviz").read_text())["Visualization Manager"]["Displays"]
    assert [display["Topic"]["Value"] for display in displays if "Topic" in display] == ["markers"]
    analyzers = yaml.safe_load((CONFIG / "diagnostic_analyzers.yaml").read_text())["analyzers"]["ros__parameters"]
    parts = [part for group in analyzers["twin"]["analyzers"].values() for part in group["startswith"]]
    assert sorted(parts) == sorted(f"/plow_twin: {part}" for part in (*KEYS, "source"))
