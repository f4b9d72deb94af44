"""Which topic of a recording is what: its fields, factors, offsets and stamps, from a YAML file or by what is there."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.sources import Arrived

#: What a recording can hold, and the numbers of each, with the fields where they stand by default, by type.
ROLES: Final[dict[str, tuple[str, ...]]] = {
    "excitation": ("fx", "fy", "m"),
    "head_pose": ("x", "y", "theta"),
    "travel": ("speed",),
    "gaps": PAIR_NAMES,
    "forces": PAIR_NAMES,
}
_WRENCH: Final = {"fx": "wrench.force.x", "fy": "wrench.force.y", "m": "wrench.torque.z"}
_FIELDS: Final[dict[tuple[str, str], dict[str, str]]] = {
    ("excitation", "geometry_msgs/msg/WrenchStamped"): _WRENCH,
    ("excitation", "geometry_msgs/msg/Wrench"): {key: path.removeprefix("wrench.") for key, path in _WRENCH.items()},
    ("head_pose", "geometry_msgs/msg/PoseStamped"): {
        "x": "pose.position.x",
        "y": "pose.position.y",
        "theta": "pose.orientation",
    },
    ("head_pose", "nav_msgs/msg/Odometry"): {
        "x": "pose.pose.position.x",
        "y": "pose.pose.position.y",
        "theta": "pose.pose.orientation",
    },
    ("head_pose", "geometry_msgs/msg/PoseWithCovarianceStamped"): {
        "x": "pose.pose.position.x",
        "y": "pose.pose.position.y",
        "theta": "pose.pose.orientation",
    },
    ("travel", "geometry_msgs/msg/TwistStamped"): {"speed": "twist.linear.z"},
    ("forces", "sensor_msgs/msg/JointState"): {name: f"effort[{name}]" for name in PAIR_NAMES},
    ("gaps", "sensor_msgs/msg/JointState"): {name: f"position[{name}]" for name in PAIR_NAMES},
}
#: Topics by which a role is recognised without a mapping.
_NAMES: Final = {
    "excitation": ("excitation", "load", "wrench"),
    "head_pose": ("head_pose", "pose"),
    "travel": ("travel",),
    "forces": ("measured_forces", "forces"),
    "gaps": ("gaps",),
}
_KEYS: Final = ("topic", "type", "fields", "scale", "offset", "stamp")


@dataclass(frozen=True)
class Role:
    """One line of a mapping.

    The numbers are `scale` times the field plus `offset`; `stamp` is `header`, `log`, or for CSV a column of times.
    A field is a path of names; `[3]` or `[name]` picks from an array, the name being looked up in the message's `name`.
    A path that leads to a quaternion gives the angle about z.
    """

    topic: str
    message_type: str
    fields: Mapping[str, str]
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    stamp: str = "header"

    def read(self, arrived: Arrived) -> tuple[int, dict[str, float]] | None:
        """Return stamp [ns] and numbers (NaN where the field is empty), or None when the message does not fit."""
        values = {}
        for name, path in self.fields.items():
            value = _follow(arrived.content, path)
            if value is None:
                return None
            values[name] = value * self.scale.get(name, 1.0) + self.offset.get(name, 0.0)
        stamp_ns = self._stamp_ns(arrived)
        return None if stamp_ns is None else (stamp_ns, values)

    def _stamp_ns(self, arrived: Arrived) -> int | None:
        content = arrived.content
        if self.stamp == "log":
            return arrived.log_time_ns
        if isinstance(content, Mapping):
            if self.stamp == "header" or self.stamp not in content:
                return arrived.log_time_ns
            time = content[self.stamp]
            return None if not math.isfinite(time) else round(time * 1e9) + 1_000_000_000
        stamp = getattr(getattr(content, "header", None), "stamp", None)
        # a type without a header has only its receive time
        return arrived.log_time_ns if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _follow(content: Any, path: str) -> float | None:
    """Return the number at a path, or None when there is none."""
    if isinstance(content, Mapping):
        return content.get(path)
    value = content
    for part in path.split("."):
        name, *picks = re.split(r"[\[\]]+", part.rstrip("]"))
        value = getattr(value, name, None)
        for pick in picks:
            try:
                value = value[int(pick) if pick.lstrip("-").isdigit() else list(content.name).index(pick)]  # type: ignore[index]
            except (AttributeError, ValueError, IndexError, TypeError):
                return None
        if value is None:
            return None
    if hasattr(value, "w") and hasattr(value, "z"):
        return 2.0 * math.atan2(float(value.z), float(value.w))
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def read_map(path: Path | None, topics: Mapping[str, str]) -> dict[str, Role]:
    """Return the roles of a recording's topics: as the YAML file says, else as names and types tell.

    Raises
    ------
    RecordingError
        The file cannot be used; the message names key, value got and value expected.
    """
    if path is None:
        return {role: found for role in ROLES if (found := _guess(role, topics)) is not None}
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        given = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RecordingError(f"{path}: cannot be read as YAML: {error}") from error
    if not isinstance(given, dict) or not given:
        raise RecordingError(f"{path}: got {type(given).__name__}, expected a mapping with {', '.join(ROLES)}")
    return {str(role): _role(path, str(role), entry, topics) for role, entry in given.items()}


def _role(path: Path, role: str, entry: Any, topics: Mapping[str, str]) -> Role:
    if role not in ROLES:
        raise RecordingError(f"{path}: got {role!r}, expected one of {', '.join(ROLES)}")
    if not isinstance(entry, dict) or not isinstance(entry.get("topic"), str):
        raise RecordingError(f"{path}: {role}: got {entry!r}, expected a mapping with a topic")
    unknown = sorted(set(map(str, entry)) - set(_KEYS))
    if unknown:
        raise RecordingError(f"{path}: {role}: got {', '.join(unknown)}, expected keys among {', '.join(_KEYS)}")
    topic = entry["topic"].removesuffix(".csv")
    topic = (
        topic if topic in topics else next((name for name in topics if name.lstrip("/") == topic.lstrip("/")), topic)
    )
    if topic not in topics:
        raise RecordingError(f"{path}: {role}: topic: got {topic!r}, expected one of {', '.join(sorted(topics))}")
    kind = str(entry.get("type", topics[topic]))
    if topics[topic].startswith("csv"):
        kind = topics[topic]
    elif kind != topics[topic]:
        raise RecordingError(f"{path}: {role}: type: got {kind!r}, but {topic} is of type {topics[topic]!r}")
    fields = entry.get("fields") or _default_fields(role, kind)
    if not fields:
        raise RecordingError(f"{path}: {role}: fields are missing, and there are no default ones for {kind}")
    return Role(
        topic,
        kind,
        _named(path, role, "fields", fields, str),
        _named(path, role, "scale", entry.get("scale") or {}, float),
        _named(path, role, "offset", entry.get("offset") or {}, float),
        str(entry.get("stamp", "header")),
    )


def _named(path: Path, role: str, key: str, given: Any, kind: Callable[[Any], Any]) -> dict[str, Any]:
    names = ROLES[role]
    if isinstance(given, int | float) and not isinstance(given, bool):
        given = dict.fromkeys(names, given)
    if not isinstance(given, dict) or not set(map(str, given)) <= set(names):
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected a mapping of {', '.join(names)}")
    try:
        values = {str(name): kind(value) for name, value in given.items()}
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected {kind.__name__} values") from error
    if any(isinstance(value, float) and not math.isfinite(value) for value in values.values()):
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected finite numbers")
    if key == "fields" and role == "excitation" and set(values) != set(names):
        raise RecordingError(f"{path}: {role}: fields: got {sorted(values)}, expected all of {', '.join(names)}")
    return values


def _default_fields(role: str, kind: str) -> dict[str, str]:
    if kind.startswith("csv:"):
        columns = kind.removeprefix("csv:").split(",")
        return {name: name for name in ROLES[role] if name in columns}
    return _FIELDS.get((role, kind), {})


def _guess(role: str, topics: Mapping[str, str]) -> Role | None:
    """Return the topic that a role is to be read from: by its name, else when it alone has a fitting type."""
    fitting = {}
    for topic, kind in topics.items():
        fields = _default_fields(role, kind)
        enough = len(fields) == len(ROLES[role]) if role in ("excitation", "travel") else bool(fields)
        if enough and "/journal/" not in topic:
            fitting[topic] = fields
    ending = [topic for name in _NAMES[role] for topic in fitting if topic.rpartition("/")[2] == name]
    # forces and gaps look like many others: only by name
    lonely = list(fitting) if len(fitting) == 1 and role in ("excitation", "head_pose", "travel") else []
    lonely = [topic for topic in lonely if topic.rpartition("/")[2] not in ("head_state", "contact_forces")]
    for topic in (*ending, *lonely):
        return Role(topic, topics[topic], fitting[topic])
    return None
