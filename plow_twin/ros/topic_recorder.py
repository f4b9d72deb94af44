"""Record the bytes of messages on any topics in the folder of a run, for the command `plow-twin record`."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from plow_twin.record.bag import BagWriter, Topic
from plow_twin.record.cdr import schema_text
from plow_twin.record.metadata_yaml import offered
from plow_twin.record.writer import in_free_folder
from plow_twin.ros.connections import WithoutEvents
from plow_twin.ros.input_loop import InputLoop, Turns
from plow_twin.ros.input_queue import InputQueue, Received
from plow_twin.ros.main import make_executor
from plow_twin.ros.start import ros
from plow_twin.scene_file.yaml_text import dump_yaml

#: Length of the queue of each topic, in which messages wait for a slow disk.
_DEPTH: Final = 5000
_LOOK_S: Final = 0.5
_FLUSH_S: Final = 1.0


class _Quality(NamedTuple):
    reliable: bool
    latched: bool


def _quality(profile: Any) -> _Quality:
    return _Quality(
        profile.reliability == ReliabilityPolicy.RELIABLE, profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    )


def message_class(message_type: str) -> Any:
    """Return the class of an installed message type."""
    package, folder, kind = message_type.split("/")
    return getattr(import_module(f"{package}.{folder}"), kind)


class TopicRecorder:
    """Recorder of all topics for whose names `wanted` returns True, including topics that appear later."""

    def __init__(self, node: Node, writer: BagWriter, wanted: Callable[[str], bool]) -> None:
        self._node, self._writer, self._wanted = node, writer, wanted
        #: message type, channel number and qualities of service of the subscriptions of each topic
        self._topics: dict[str, tuple[str, int, set[_Quality]]] = {}
        #: quality of service of the subscription that records the messages of each publisher
        self._taken_as: dict[tuple[str, bytes], _Quality] = {}
        self._turns = Turns()
        self._loop = InputLoop(self._turns, lambda error: None)
        #: reason why a topic is not recorded, by topic
        self.skipped: dict[str, str] = {}
        #: number of messages that were not received according to the sequence numbers, by topic
        self.missed: dict[str, int] = {}
        self._newest: dict[tuple[str, bytes], int] = {}
        self._loop.every(_FLUSH_S, writer.flush)
        node.create_timer(_LOOK_S, self.look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._loop.run_timers(True)
        self._loop.start()

    @property
    def topics(self) -> list[str]:
        """Names of the recorded topics."""
        return sorted(self._topics)

    def look(self) -> None:
        """Subscribe to new topics."""
        if self._loop.error is not None:
            raise self._loop.error
        for name, types in self._node.get_topic_names_and_types():
            publishers = self._node.get_publishers_info_by_topic(name)
            if publishers and self._wanted(name) and (name in self._topics or name not in self.skipped):
                try:
                    self._subscribe(name, types, publishers)
                except (LookupError, ImportError, AttributeError, OSError) as error:
                    self.skipped[name] = f"{', '.join(types)}: {error}"

    def _subscribe(self, name: str, types: Sequence[str], publishers: Sequence[Any]) -> None:
        if name not in self._topics:
            if len(types) != 1:
                raise LookupError("expected one type")
            profiles = [publisher.qos_profile for publisher in publishers]
            topic = Topic(
                name,
                types[0],
                schema_of(types[0]),
                str(publishers[0].topic_type_hash),
                dump_yaml(
                    [offered(*_quality(profile), max(1, profile.depth)) for profile in profiles], flow=False
                ).strip(),
            )
            message_class(types[0])
            with self._turns:
                self._topics[name] = types[0], self._writer.topic(topic), set()
        kind, number, subscribed = self._topics[name]
        for publisher in publishers:
            if publisher.topic_type != kind:
                self.skipped[name] = f"{publisher.topic_type}: the topic is recorded as {kind}"
                continue
            quality = _quality(publisher.qos_profile)
            with self._turns:
                self._taken_as.setdefault((name, bytes(publisher.endpoint_gid)), quality)
            if quality not in subscribed:
                subscribed.add(quality)
                self._add_queue(name, kind, quality, number)

    def _add_queue(self, name: str, kind: str, quality: _Quality, number: int) -> None:
        subscription = self._node.create_subscription(
            message_class(kind),
            name,
            lambda message: None,
            QoSProfile(
                depth=_DEPTH,
                reliability=ReliabilityPolicy.RELIABLE if quality.reliable else ReliabilityPolicy.BEST_EFFORT,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if quality.latched else DurabilityPolicy.VOLATILE,
            ),
            raw=True,
        )
        self._loop.add(InputQueue(self._node, subscription), _Subscription(self, quality, number), name)

    def add(self, name: str, quality: _Quality, number: int, messages: list[Received]) -> None:
        """Write the messages that a subscription received, without duplicates."""
        for message in messages:
            key = (name, message.sender)
            # a best-effort subscription receives the messages of reliable publishers in addition
            if self._taken_as.setdefault(key, quality) != quality:
                continue
            before = self._newest.get(key, message.number - 1)
            self.missed[name] = self.missed.get(name, 0) + max(0, message.number - before - 1)
            self._newest[key] = message.number
            received_ns = message.received_ns or time.time_ns()
            self._writer.add(number, message.number, received_ns, message.sent_ns or received_ns, message.data)

    def close(self) -> None:
        """Write the messages in the queues, and end the subscriptions."""
        self._loop.flush()
        self._loop.close()


class _Subscription(NamedTuple):
    recorder: TopicRecorder
    quality: _Quality
    number: int

    def receive(self, topic: str, batch: list[Received]) -> None:
        self.recorder.add(topic, self.quality, self.number, batch)


def record_topics(
    folder: Path,
    topics: Iterable[str],
    *,
    every: bool,
    exclude: str | None,
    but: Iterable[str],
    stopped: Callable[[], bool],
    on_started: Callable[[Path], object],
    on_trouble: Callable[[str], object],
) -> Mapping[str, Any]:
    """Record topics to a new folder until `stopped` returns True.

    If the folder exists and is not empty, `<folder>_2`, `<folder>_3`, ... is created. With `every`, all topics are
    recorded except hidden topics, topics that match the regular expression `exclude`, and the topics `but`.
    `on_started` receives the created folder. `on_trouble` receives a text when the disk becomes full, and a text when
    it has space after that.

    Returns
    -------
    dict
        Numbers of written and lost messages by topic, and the topics that were not recorded. The value of `complete` is
        True if no message was lost and all topics in the argument `topics` were recorded.
    """
    named = {name if name.startswith("/") else f"/{name}" for name in topics}
    left_out = {*but, "/parameter_events"}

    def wanted(name: str) -> bool:
        if name in named:
            return True
        hidden = any(part.startswith("_") for part in name.split("/"))
        excluded = exclude is not None and re.search(exclude, name) is not None
        return every and not hidden and not excluded and name not in left_out

    with ExitStack() as opened:
        opened.enter_context(ros())
        node = WithoutEvents("plow_twin_record", start_parameter_services=False, enable_rosout=False)
        opened.callback(node.destroy_node)
        writer = in_free_folder(folder, partial(BagWriter, on_trouble=on_trouble))
        recorder = TopicRecorder(node, writer, wanted)
        executor = make_executor()
        executor.add_node(node)
        on_started(writer.folder)
        while not stopped():
            executor.spin_once(timeout_sec=0.1)
        executor.remove_node(node)
        recorder.close()
        writer.close()
    lost = {name: writer.lost[name] + recorder.missed.get(name, 0) for name in {*writer.lost, *recorder.missed}}
    counted = {name: count for name, count in sorted(lost.items()) if count}
    silent = sorted(named - {*recorder.topics, *recorder.skipped})
    return {
        "file": str(writer.path),
        "messages": {name: writer.written[name] for name in recorder.topics},
        "lost": counted,
        "skipped_topics": recorder.skipped,
        "without_publisher": silent,
        "error": writer.error,
        "complete": not (counted or silent or writer.error or named & recorder.skipped.keys()),
    }


def schema_of(message_type: str) -> str:
    """Return the `ros2msg` text of a message type, including the types of its fields.

    The text is read from the installed packages or, if a package is missing, from the types of ROS 2 Jazzy.
    """
    from ament_index_python.packages import get_package_share_directory

    definitions: dict[str, str] = {}
    waiting = [message_type]
    try:
        while waiting:
            name = waiting.pop(0)
            if name in definitions:
                continue
            package, _, kind = name.split("/")
            text = (Path(get_package_share_directory(package)) / "msg" / f"{kind}.msg").read_text(encoding="utf-8")
            definitions[name] = text
            waiting += _parts_of(name)
    except (LookupError, OSError):
        return schema_text(message_type)
    first, *others = definitions.items()
    line = "=" * 80
    return first[1] + "".join(f"\n{line}\nMSG: {name.replace('/msg/', '/')}\n{text}" for name, text in others)


def _parts_of(message_type: str) -> list[str]:
    """Return the message types of the fields of a message type."""
    # an array or a sequence has the type of its items as `value_type`
    kinds = (getattr(kind, "value_type", kind) for kind in message_class(message_type).SLOT_TYPES)
    return ["/".join(kind.namespaced_name()) for kind in kinds if hasattr(kind, "namespaced_name")]
