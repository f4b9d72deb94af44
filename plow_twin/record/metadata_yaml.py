"""Read and write `metadata.yaml` of rosbag2 in ROS 2 Jazzy (version 9), and the QoS texts in MCAP files."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import type_hash
from plow_twin.record.durable import sync_path
from plow_twin.scene_file.yaml_text import dump_yaml, load_yaml, read_yaml
from plow_twin.stream.topics import TOPICS

METADATA_VERSION: Final = 9
_INFINITE: Final = {"sec": 9223372036, "nsec": 854775807}
#: Prefix of the keys in `custom_data` whose values are numbers of lost messages. The topic follows the prefix.
_LOST: Final = "plow_twin_lost "


@dataclass
class TopicCount:
    """A topic of a recording with its number of messages. `bag_metadata` replaces an unreadable QoS or type hash."""

    topic: str
    message_type: str
    count: int = 0
    qos: str = ""
    type_hash: str = ""


def qos_profile(base_name: str) -> dict[str, Any]:
    """Return the QoS that the node offers on the topic with this base name.

    For a topic on which the node does not publish, the QoS is reliable with depth 10.
    """
    for topic in TOPICS:
        if topic.name == base_name:
            return offered(True, topic.latched, topic.depth)
    return offered(True, False, 10)


def offered(reliable: bool, latched: bool, depth: int) -> dict[str, Any]:
    """Return a QoS profile in the format of rosbag2."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_INFINITE),
        "lifespan": dict(_INFINITE),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_INFINITE),
        "avoid_ros_namespace_conventions": False,
    }


def qos_text(base_name: str) -> str:
    """Return the QoS of a topic as the YAML text that its channel in an MCAP file contains."""
    return dump_yaml([qos_profile(base_name)], flow=False).strip()


@dataclass(frozen=True)
class PartFacts:
    """A file of a recording, with the first and last receive time [ns] and the topics."""

    name: str
    start_ns: int
    end_ns: int
    topics: Sequence[TopicCount]


def bag_metadata(
    parts: Sequence[PartFacts], lost: Mapping[str, int], custom: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """Return the content of `metadata.yaml` for the files `parts` of a recording, in order.

    `lost` is the number of lost messages by topic, and `custom` contains further entries of `custom_data`.
    """
    totals: dict[str, TopicCount] = {}
    for part in parts:
        for topic in part.topics:
            total = totals.setdefault(topic.topic, replace(topic, count=0))
            total.count += topic.count

    def span(counted: Sequence[PartFacts]) -> dict[str, Any]:
        filled = [part for part in counted if any(topic.count for topic in part.topics)]
        start = min((part.start_ns for part in filled), default=0)
        end = max((part.end_ns for part in filled), default=0)
        return {
            "duration": {"nanoseconds": max(0, end - start)},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(topic.count for part in counted for topic in part.topics),
        }

    listed = [
        {
            "topic_metadata": {
                "name": topic.topic,
                "type": topic.message_type,
                "serialization_format": "cdr",
                "offered_qos_profiles": profiles(topic.qos) or [qos_profile("")],
                "type_description_hash": topic.type_hash or type_hash(topic.message_type),
            },
            "message_count": topic.count,
        }
        for topic in totals.values()
    ]
    return {
        "rosbag2_bagfile_information": {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            **span(parts),
            "topics_with_message_count": listed,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [part.name for part in parts],
            "files": [{"path": part.name, **span([part])} for part in parts],
            "custom_data": {**{f"{_LOST}{topic}": str(count) for topic, count in lost.items()}, **custom} or None,
            "ros_distro": "jazzy",
        }
    }


def profiles(qos: str) -> list[Any]:
    """Return the QoS profiles in the text of a channel; the list is empty if the text is missing or damaged."""
    document, problems = load_yaml(qos, "QoS", "profiles")
    return document if not problems and isinstance(document, list) else []


def listed_parts(folder: Path) -> list[str]:
    """Return the names of the files in `metadata.yaml`.

    Raise `RecordingError` if `metadata.yaml` is not the metadata of a bag.
    """
    path = folder / "metadata.yaml"
    try:
        information = _information(folder)["relative_file_paths"]
    except (RecordingError, LookupError, TypeError) as error:
        raise RecordingError(f"{path}: cannot be read as metadata of a bag") from error
    return [str(name) for name in information]


def _information(folder: Path) -> Any:
    document, problems = read_yaml(folder / "metadata.yaml", "metadata", "those of a bag")
    if problems:
        raise RecordingError(f"{problems[0]}")
    return document["rosbag2_bagfile_information"]


def recorded_losses(folder: Path) -> dict[str, int]:
    """Return the number of lost messages by topic from `metadata.yaml`.

    The result is empty if the file is missing or invalid.
    """
    try:
        custom = _information(folder)["custom_data"] or {}
        return {key.removeprefix(_LOST): int(count) for key, count in custom.items() if key.startswith(_LOST)}
    except (RecordingError, LookupError, TypeError, AttributeError, ValueError):
        return {}


def missing_files(folder: Path, without: Collection[str] = ()) -> list[str]:
    """Return the files in `metadata.yaml` that do not exist or that are in the collection `without`."""
    try:
        listed = listed_parts(folder)
    except RecordingError:
        return []
    # in `metadata.yaml` of old versions of rosbag2, the name of the folder precedes the name of the file
    return [
        name
        for name in listed
        if Path(name).name in without or not ((folder / name).is_file() or (folder / Path(name).name).is_file())
    ]


def write_metadata(folder: Path, metadata: Mapping[str, Any], *, sync: bool = False) -> None:
    """Replace `metadata.yaml` atomically; with `sync`, wait until the file is on the disk."""
    partial = folder / "metadata.yaml.partial"
    partial.write_text(dump_yaml(metadata, flow=False), encoding="utf-8")
    if sync:
        sync_path(partial)
    partial.replace(folder / "metadata.yaml")
    if sync:
        sync_path(folder)
