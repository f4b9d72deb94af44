"""Lifecycle and parameters through the services that each lifecycle manager uses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from geometry_msgs.msg import WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from record_support import records_of
from ros_processes import Bench, Process, bench, value
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from plow_twin.live.parameters import SPECS, Effect
from plow_twin.record.entries import EntryRecord
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.replay import replay
from plow_twin.stream.journal import Mark

T0 = 1_795_000_000_000_000_000
RELIABLE_INPUT = {"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}


def _change(running: Bench, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(running.probe.call(ChangeState, f"{running.namespace}/plow_twin/change_state", request).success)


def _state(running: Bench) -> str:
    answer = running.probe.call(GetState, f"{running.namespace}/plow_twin/get_state", GetState.Request())
    return str(answer.current_state.label)


def _set(running: Bench, name: str, value: Any) -> Any:
    kinds = {bool: "bool", int: "integer", float: "double", str: "string"}
    if not isinstance(value, ParameterValue):
        kind = kinds[type(value)]
        number = getattr(ParameterType, f"PARAMETER_{kind.upper()}")
        value = ParameterValue(type=number, **{f"{kind}_value": value})
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
    return running.probe.call(SetParameters, f"{running.namespace}/plow_twin/set_parameters", request).results[0]


@pytest.fixture(scope="module")
def waiting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a node that waits for a manager: without `autostart`, it is unconfigured."""
    with bench(tmp_path_factory.mktemp("managed"), "unconfigured", autostart="false", file_root="/") as running:
        yield running


@pytest.fixture
def managed(waiting: Bench) -> Iterator[Bench]:
    """Yield this node in the state unconfigured, and restore its initial parameters after the test."""
    for name, text in (("scene", "paper"), ("record_path", ""), ("wear_state_path", "")):
        assert _set(waiting, name, text).successful
    yield waiting
    if _state(waiting) == "active":
        assert _change(waiting, Transition.TRANSITION_DEACTIVATE)
    if _state(waiting) == "inactive":
        assert _change(waiting, Transition.TRANSITION_CLEANUP)


def test_a_missing_scene_refuses_configuration_and_the_status_names_it(managed: Bench) -> None:
    assert _set(managed, "scene", "no/such.yaml").successful
    assert not _change(managed, Transition.TRANSITION_CONFIGURE)
    assert _state(managed) == "unconfigured"
    managed.probe.until(lambda: "no/such.yaml" in managed.probe.status[-1].message, "the reason")
    assert managed.probe.status[-1].level == b"\x02"
    assert "no/such.yaml" in managed.probe.figures("state")["reason"]


def test_a_recording_that_cannot_be_made_refuses_configuration_and_leaves_nothing(
    managed: Bench, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    assert _set(managed, "record_path", str(tmp_path / "file" / "below")).successful
    assert not _change(managed, Transition.TRANSITION_CONFIGURE)
    assert managed.probe.node.count_publishers("contact_forces") == 0


def test_an_unwritable_wear_folder_refuses_configuration_and_is_named(managed: Bench) -> None:
    # no user can create files in /proc
    assert _set(managed, "wear_state_path", "/proc/self/wear").successful
    assert not _change(managed, Transition.TRANSITION_CONFIGURE)
    expected = "wear_state_path: got '/proc/self/wear', expected a folder that can be written to: "
    assert expected in managed.twin.output()


def test_only_an_active_node_uses_samples_and_cleanup_closes_its_recording(managed: Bench, tmp_path: Path) -> None:
    probe = managed.probe
    assert _set(managed, "record_path", str(tmp_path / "run")).successful
    assert not _change(managed, Transition.TRANSITION_ACTIVATE)
    assert _change(managed, Transition.TRANSITION_CONFIGURE)
    assert _state(managed) == "inactive"
    forces = probe.listen(JointState, "contact_forces")
    send = probe.excitation()
    send(T0, (1.0, 2.0, 3.0))
    probe.until_figure("input", "dropped_inactive", "1")
    assert _change(managed, Transition.TRANSITION_ACTIVATE)
    send(T0 + 1_000_000, (1.0, 2.0, 3.0))
    probe.until(lambda: forces, "an answer of the active node")
    assert _change(managed, Transition.TRANSITION_DEACTIVATE)
    assert _change(managed, Transition.TRANSITION_CLEANUP)
    reader = RunReader(tmp_path / "run")
    assert [type(getattr(record, "entry", None)).__name__ for record in records_of(reader)].count("Sample") == 1
    assert reader.status is FileStatus.COMPLETE
    probe.until(lambda: probe.node.count_publishers("contact_forces") == 0, "released publishers")


def test_an_active_node_refuses_configuration_and_a_change_of_the_scene(managed: Bench) -> None:
    assert _change(managed, Transition.TRANSITION_CONFIGURE)
    assert _change(managed, Transition.TRANSITION_ACTIVATE)
    assert not _change(managed, Transition.TRANSITION_CONFIGURE)
    assert not _set(managed, "scene", "bench_kv").successful
    assert _state(managed) == "active"


def test_a_reconfigured_node_has_another_scene_and_a_second_recording(managed: Bench, tmp_path: Path) -> None:
    for scene in ("paper", "bench_kv"):
        assert _set(managed, "scene", scene).successful
        assert _set(managed, "record_path", str(tmp_path / "run")).successful
        assert _change(managed, Transition.TRANSITION_CONFIGURE)
        assert _change(managed, Transition.TRANSITION_ACTIVATE)
        managed.probe.until_figure("state", "scene", scene)
        assert _change(managed, Transition.TRANSITION_DEACTIVATE)
        assert _change(managed, Transition.TRANSITION_CLEANUP)
    scenes = [RunReader(tmp_path / name).header.parameters["scene"] for name in ("run", "run_2")]
    assert scenes == ["paper", "bench_kv"]


def test_a_shutdown_while_active_ends_in_finalized_and_a_clean_exit(tmp_path: Path) -> None:
    with bench(tmp_path, record_path=str(tmp_path / "run")) as running:
        assert _change(running, Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert _state(running) == "finalized"
        reader = RunReader(tmp_path / "run")
        assert len(list(records_of(reader))) > 0 and reader.status is FileStatus.COMPLETE
        assert running.twin.stop() == 0
        assert "Traceback" not in running.twin.output()


def test_a_request_during_a_cleanup_is_answered_and_the_node_continues(tmp_path: Path) -> None:
    with bench(tmp_path) as running:
        node, at = running.probe.node, f"{running.namespace}/plow_twin"
        change = node.create_client(ChangeState, f"{at}/change_state")
        clients = [node.create_client(Trigger, f"{at}/{name}") for name in ("acknowledge_alarms", "mark", "reset")]
        running.probe.until(lambda: all(client.service_is_ready() for client in (change, *clients)), "services")
        running.probe.pause(0.5)

        def beside(transition: int) -> None:
            """Send requests before and after the request for a transition, faster than they are answered."""
            request = ChangeState.Request(transition=Transition(id=transition))
            before = [client.call_async(Trigger.Request()) for client in clients]
            changed = change.call_async(request)
            after = [one.call_async(Trigger.Request()) for one in clients]
            running.probe.until(lambda: all(one.done() for one in (changed, *before, *after)), "answers")
            assert changed.result().success
            answers = [one.result() for one in (*before, *after)]
            refused = [answer.message for answer in answers if "expected a configured node" in answer.message]
            assert refused and not any(answer.success for answer in answers if answer.message in refused)

        assert _change(running, Transition.TRANSITION_DEACTIVATE)
        for _ in range(3):
            beside(Transition.TRANSITION_CLEANUP)
            assert _change(running, Transition.TRANSITION_CONFIGURE)
        beside(Transition.TRANSITION_INACTIVE_SHUTDOWN)
        assert _state(running) == "finalized"
        assert running.twin.stop() == 0


def test_all_bad_parameters_are_named_at_once(tmp_path: Path) -> None:
    assignments = ["excitation_source:=drum", "tolerance:=.nan", "jump_back:=-3", "input_depth:=5.5", "autostart:=1"]
    assignments += [r'frame_id:="a\x1b[2J"', f"child_frame_id:={'h' * 5000}"]
    assignments += [f"alarm_wear_rate:=[{', '.join(['-1.0'] * 10_000)}]"]  # not a problem for each of its items
    settings = [word for item in assignments for word in ("-p", item)]
    twin = Process("plow_twin.ros.main", ["--ros-args", *settings], tmp_path / "twin.log")
    assert twin.wait() == 2
    output = twin.output()
    twin.close()
    for name, got in (
        ("excitation_source", "'drum'"),
        ("tolerance", "nan"),
        ("jump_back", "-3"),
        ("input_depth", "5.5"),
        ("autostart", "1"),
        ("frame_id", r"'a\x1b[2J'"),
        ("child_frame_id", "'hhh"),
        ("alarm_wear_rate", "[-1.0, -1.0"),
    ):
        assert f"{name}: got {got}" in output
    assert output.count("expected one line of at most 4096 characters") == 2 and len(output) < 4000
    assert "expected a number from 0 to 3600 [s]" in output
    assert "Traceback" not in output


@pytest.mark.parametrize("program", ["ros.main", "demo.excitation_publisher"])
def test_arguments_that_ros_cannot_read_are_reported_without_a_traceback(tmp_path: Path, program: str) -> None:
    path = tmp_path / "missing.yaml"
    process = Process(f"plow_twin.{program}", ["--ros-args", "--params-file", str(path)], tmp_path / "log")
    assert process.wait() == 2
    output = process.output()
    process.close()
    assert str(path) in output and "Error opening YAML file" in output
    assert "Traceback" not in output and "/src/" not in output


def test_a_parameter_file_may_have_integers_for_doubles_and_a_misspelt_name_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "twin.yaml"
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"excitation_timeout": 2, "hold_polcy": "zero"}}}))
    # YAML 1.1 reads 1e-8 as a text, so the parameter is a text
    with bench(tmp_path, arguments=("--params-file", str(path)), tolerance="1e-8") as running:
        request = GetParameters.Request(names=["excitation_timeout", "tolerance"])
        service = f"{running.namespace}/plow_twin/get_parameters"
        response = running.probe.call(GetParameters, service, request).values
        assert [item.type for item in response] == [ParameterType.PARAMETER_DOUBLE] * 2
        assert [item.double_value for item in response] == [2.0, 1e-8]
        # an active node accepts its present parameters again
        assert _set(running, "tolerance", 1e-8).successful and _set(running, "scene", "paper").successful
        assert not _set(running, "tolerance", 1e-7).successful
        assert "unknown parameter hold_polcy: 'zero' is not used; did you mean hold_policy?" in running.twin.output()
        assert "no parameter scene: the preset paper is used, which is not your machine" in running.twin.output()


@pytest.fixture(scope="module")
def active(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with bench(tmp_path_factory.mktemp("active"), excitation_timeout=60.0) as running:
        yield running


@pytest.mark.parametrize(
    ("name", "value", "accepted"),
    [
        ("excitation_timeout", 0.25, True),
        ("excitation_timeout", 3, True),
        ("excitation_timeout", float("nan"), False),
        ("excitation_timeout", 1e9, False),
        ("excitation_timeout", "soon", False),
        ("hold_policy", "zero", True),
        ("hold_policy", "guess", False),
        ("failure_limit", 5, True),
        ("failure_limit", 5.0, False),
        ("autostart", False, False),
        ("use_sim_time", True, False),
        ("tolerance", 1e-8, False),
        ("no_such_parameter", 1.0, False),
        ("hold_policy", "x" * 100_000, False),
        # for both of these values, rclpy raises an error
        ("failure_limit", ParameterValue(type=200), False),
        ("hold_policy", ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY), False),
    ],
)
def test_changes_at_run_time_are_applied_or_refused_with_a_reason(
    active: Bench, name: str, value: Any, accepted: bool
) -> None:
    result = _set(active, name, value)
    assert result.successful is accepted, result.reason
    assert accepted or 0 < len(result.reason) < 1000
    assert active.twin.running


def test_a_changed_timeout_takes_effect_at_once(active: Bench) -> None:
    forces = active.probe.listen(JointState, "contact_forces")
    assert _set(active, "excitation_timeout", 3600.0).successful
    active.probe.excitation()(T0, (1.0, 2.0, 3.0))
    active.probe.until(lambda: forces and value(active.probe.status[-1], "stream") == "running", "an answer")
    assert _set(active, "excitation_timeout", 0.05).successful
    active.probe.until(lambda: value(active.probe.status[-1], "stream") == "stale", "the hold policy")


def test_the_journal_repeats_changes_of_the_model_and_a_restored_motion(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with bench(tmp_path, record_path=str(run), excitation_timeout=3600.0, **RELIABLE_INPUT) as running:
        probe = running.probe
        heads = probe.listen(Odometry, "head_state")
        send = probe.excitation()
        sent = 0

        def feed(count: int) -> list[tuple[float, float]]:
            nonlocal sent
            for index in range(count):
                send(T0 + (sent + index) * 1_000_000, (30e3, 0.0, -40e3))
                probe.pace(index)
            sent += count
            probe.until(lambda: len(heads) == sent, f"{sent} answers")
            return [(head.pose.pose.position.x, head.pose.pose.position.y) for head in heads[-count:]]

        def ask(service: str) -> Any:
            return probe.call(Trigger, f"{running.namespace}/plow_twin/{service}", Trigger.Request())

        feed(200)
        assert "no snapshot" in ask("restore").message
        assert ask("snapshot").success
        first = feed(100)
        assert ask("restore").success
        # the first sample after the restore gets the time of the snapshot
        assert feed(101)[1:] == first
        answer = _set(running, "damping", 0.0)
        assert not answer.successful and "configure the node again" in answer.reason
        assert not _set(running, "wear_coefficient", 1e-14).successful
        assert _set(running, "clearance_horizontal", 0.04).successful
        assert _set(running, "mark", "wider").successful and ask("mark").success
        feed(50)
        clearances = probe.listen(JointState, "clearance")
        feed(150)
        assert clearances[-1].position[0] == 0.04
        assert running.twin.stop() == 0
    entries = [record.entry for record in records_of(run) if isinstance(record, EntryRecord)]
    assert [entry.text for entry in entries if isinstance(entry, Mark)] == ["wider"]
    report = replay(run)
    assert (report.exit_code, report.samples, report.first_divergence) == (0, sent, None)


def test_every_parameter_has_a_descriptor_with_meaning_range_and_effect(active: Bench) -> None:
    request = DescribeParameters.Request(names=list(SPECS))
    service = f"{active.namespace}/plow_twin/describe_parameters"
    response = active.probe.call(DescribeParameters, service, request).descriptors
    assert [item.name for item in response] == list(SPECS)
    for item in response:
        spec = SPECS[item.name]
        assert spec.metadata["doc"] in item.description
        assert item.read_only == (spec.metadata["effect"] is Effect.START)
        if item.type == ParameterType.PARAMETER_DOUBLE:
            bounds = item.floating_point_range[0]
            assert (bounds.from_value, bounds.to_value) == (spec.metadata["low"], spec.metadata["high"])
            assert f"[{spec.metadata['unit']}]" in item.description
        if item.type == ParameterType.PARAMETER_INTEGER:
            assert item.integer_range[0].to_value == spec.metadata["high"]


def test_quality_of_service_of_an_input_can_be_overridden(tmp_path: Path) -> None:
    overrides = {"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}
    with bench(tmp_path, **overrides) as running:
        node = running.probe.node
        offered = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = node.create_publisher(WrenchStamped, "excitation", offered)
        kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscription = node.create_subscription(JointState, "contact_forces", lambda message: None, kept)
        running.probe.until_figure("input", "refused_publishers", "1", timeout_s=60.0)
        assert value(running.probe.status[-1], "publishers_excitation") == "0"
        running.probe.until(lambda: "nothing is sent to the subscriber" in running.twin.output(), "said")
        output = running.twin.output()
        assert (
            f"{publisher.topic_name}: nothing is received from the publisher {node.get_name()}: incompatible" in output
        )
        assert output.count("is sent to the subscriber") == 1 and f"{subscription.topic_name}: nothing is" in output
