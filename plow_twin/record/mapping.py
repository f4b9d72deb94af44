"""Which topic of a recording is what: its fields, factors, offsets and stamps, from a YAML file or by what is there."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.sources import Arrived, Source

#: What a recording can hold, and the numbers of each, with the fields where they stand by default, by type.
ROLES: Final[dict[str, tuple[str, ...]]] = {
    "excitation": ("fx", "fy", "m"),
    "head_pose": ("x", "y", "theta"),
    "travel": ("speed",),
    "gaps": PAIR_NAMES,
    "forces": PAIR_NAMES,
    "drive": ("power", "chain_force", "speed", "depth", "position"),
}
#: Key of a mapping that is no role: how a live twin makes the load of what the drive tells.
_LOAD_MODEL: Final = "load_model"
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
_NUMBER: Final = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|inf|nan)", re.IGNORECASE)
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
#: Topics by which a role is recognised without a mapping.
_NAMES: Final = {
    "excitation": ("excitation", "load", "wrench"),
    "head_pose": ("head_pose", "pose"),
    "travel": ("travel",),
    "forces": ("measured_forces", "forces"),
    "gaps": ("gaps",),
}
_KEYS: Final = (
    *("topic", "type", "fields", "scale", "offset", "unit", "limits"),
    *("stamp", "stamp_unit", "clock_offset", "sequence"),
)
#: Units in SI, by what they measure.
UNITS: Final[dict[str, dict[str, float]]] = {
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6},
    "moment": {"N m": 1.0, "Nm": 1.0, "kN m": 1e3, "kNm": 1e3},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
    "power": {"W": 1.0, "kW": 1e3, "MW": 1e6},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "m/min": 1.0 / 60.0, "km/h": 1.0 / 3.6},
}
_QUANTITIES: Final = {
    **{("excitation", name): "force" for name in ("fx", "fy")},
    ("excitation", "m"): "moment",
    **{("head_pose", name): "length" for name in ("x", "y")},
    ("head_pose", "theta"): "angle",
    ("travel", "speed"): "speed",
    ("drive", "power"): "power",
    ("drive", "chain_force"): "force",
    ("drive", "speed"): "speed",
    **{("drive", name): "length" for name in ("depth", "position")},
    **{("gaps", name): "length" for name in PAIR_NAMES},
    **{("forces", name): "force" for name in PAIR_NAMES},
}
_STAMP_UNITS: Final = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
#: Columns and keys that hold the time where the mapping names none.
TIMES: Final = ("t", "time")
#: Times below this are no times of the epoch, but count from some start [s]: they are moved away from 0, which stands
#: for a missing stamp.
_EPOCH_S: Final = 1e9
_ORIGIN_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class Role:
    """One line of a mapping.

    The numbers are `scale` times the field plus `offset`, in a unit that `factor` takes to SI; `limits` are the
    smallest and largest that are used, in SI. `stamp` is `header`, `log`, or for CSV and JSON where the time stands (a
    number in `stamp_unit`, or a text after ISO 8601); `clock_offset_ns` is added to it. `sequence` is where the
    sender's own number of the message stands; empty: it has none.
    A field is a path of names; `[3]` or `[name]` picks from an array, the name being looked up in the message's `name`.
    A path that leads to a quaternion gives the angle about z.
    """

    topic: str
    message_type: str
    fields: Mapping[str, str]
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    stamp: str = "header"
    factor: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    stamp_unit: str = "s"
    clock_offset_ns: int = 0
    sequence: str = ""

    def read(self, arrived: Arrived) -> tuple[int, dict[str, float]] | None:
        """Return stamp [ns] and numbers (NaN where the field is empty), or None when the message does not fit."""
        values = {}
        for name, path in self.fields.items():
            value = _follow(arrived.content, path)
            if value is None:
                return None
            value = value * self.scale.get(name, 1.0) + self.offset.get(name, 0.0)
            values[name] = value * self.factor.get(name, 1.0)
        stamp_ns = self._stamp_ns(arrived)
        return None if stamp_ns is None else (stamp_ns + self.clock_offset_ns, values)

    def plausible(self, values: Mapping[str, float]) -> bool:
        """Tell whether no number is outside its limits; one that is not there is none."""
        return not any(
            values[name] < low or values[name] > high for name, (low, high) in self.limits.items() if name in values
        )

    def empty(self, arrived: Arrived) -> bool:
        """Tell whether a message says nothing in this role: its fields are there and hold nothing."""
        content = arrived.content
        return isinstance(content, Mapping) and all(_at(content, path) in (None, "") for path in self.fields.values())

    def number(self, arrived: Arrived) -> int | None:
        """Return the sender's own number of the message, or None when there is none."""
        value = _follow(arrived.content, self.sequence)
        return int(value) if value is not None and math.isfinite(value) and value == int(value) >= 0 else None

    def _stamp_ns(self, arrived: Arrived) -> int | None:
        content = arrived.content
        if self.stamp == "log":
            return arrived.log_time_ns
        if isinstance(content, Mapping):
            if self.stamp == "header":
                name = next((name for name in TIMES if name in content), None)
                return arrived.log_time_ns if name is None else time_ns(content[name], self.stamp_unit)
            time = _at(content, self.stamp)
            return arrived.log_time_ns if time is None else time_ns(time, self.stamp_unit)
        stamp = getattr(getattr(content, "header", None), "stamp", None)
        # a type without a header has only its receive time
        return arrived.log_time_ns if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def time_ns(value: Any, unit: str = "s") -> int | None:
    """Return the stamp [ns] that a number, or a text after ISO 8601 (UTC unless it says otherwise), stands for.

    None when it stands for none.
    """
    if isinstance(value, str):
        value = value.strip()
        # a number first: 20260102 would be a date too
        if value.isascii() and value.isdigit() and len(value) < 20:
            value = int(value)
        elif _NUMBER.fullmatch(value):
            value = float(value)
        else:
            return _date_ns(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e19:
        return None
    scale = _STAMP_UNITS[unit]
    # integers keep their nanoseconds; a float of today's date holds some 0.2 us
    stamp_ns = value * scale if isinstance(value, int) else round(value * scale)
    if abs(stamp_ns) > 4e18:
        return None
    return stamp_ns if stamp_ns >= _EPOCH_S * 1e9 else stamp_ns + _ORIGIN_NS


def _date_ns(text: str) -> int | None:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    time = time if time.tzinfo else time.replace(tzinfo=UTC)
    return (time - _EPOCH) // timedelta(microseconds=1) * 1000


def _at(content: Mapping[str, Any], path: str) -> Any | None:
    """Return what stands at a path of keys and indexes, or None."""
    if path in content:
        return content[path]
    value: Any = content
    for part in re.findall(r"[^.\[\]]+", path):
        if isinstance(value, Mapping):
            value = value.get(part)
        elif isinstance(value, list) and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        else:
            return None
    return value


def _plain_number(value: Any) -> float | None:
    """Return a number as a sender wrote it, NaN for an empty cell, or None for anything else."""
    if isinstance(value, str):
        if not value.strip():
            return math.nan
        if not _NUMBER.fullmatch(value.strip()):
            return None
    elif isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _follow(content: Any, path: str) -> float | None:
    """Return the number at a path, or None when there is none."""
    if isinstance(content, Mapping):
        return _plain_number(_at(content, path))
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


def roles_by_source(
    sources: Sequence[Source], path: Path | None, left_out: str = ""
) -> Iterator[tuple[Source, dict[str, Role]]]:
    """Yield several recordings of one run, each with the roles whose topics it has, as `read_map` of all together.

    Topics that begin with `left_out` are none of them.
    """
    tables = [
        {topic: kind for topic, kind in source.topics().items() if not left_out or not topic.startswith(left_out)}
        for source in sources
    ]
    roles = read_map(path, {topic: kind for table in tables for topic, kind in table.items()})
    for source, table in zip(sources, tables, strict=True):
        yield source, {name: role for name, role in roles.items() if role.topic in table}


def read_map(path: Path | None, topics: Mapping[str, str] | None) -> dict[str, Role]:
    """Return the roles of a recording's topics: as the YAML file says, else as names and types tell.

    `topics` are types by topic; None when they are not known beforehand: JSON on any topic that the file names.

    Raises
    ------
    RecordingError
        The file cannot be used; the message names key, value got and value expected.
    """
    if path is None:
        topics = topics or {}
        return {role: found for role in _NAMES if (found := _guess(role, topics)) is not None}
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        given = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RecordingError(f"{path}: cannot be read as YAML: {error}") from error
    if not isinstance(given, dict) or not given:
        raise RecordingError(f"{path}: got {type(given).__name__}, expected a mapping with {', '.join(ROLES)}")
    return {str(role): _role(path, str(role), entry, topics) for role, entry in given.items() if role != _LOAD_MODEL}


def _role(path: Path, role: str, entry: Any, topics: Mapping[str, str] | None) -> Role:
    if role not in ROLES:
        raise RecordingError(f"{path}: got {role!r}, expected one of {', '.join(ROLES)}")
    if not isinstance(entry, dict) or not isinstance(entry.get("topic"), str):
        raise RecordingError(f"{path}: {role}: got {entry!r}, expected a mapping with a topic")
    unknown = sorted(set(map(str, entry)) - set(_KEYS))
    if unknown:
        raise RecordingError(f"{path}: {role}: got {', '.join(unknown)}, expected keys among {', '.join(_KEYS)}")
    topic, kind = _topic(path, role, entry, topics)
    fields = entry.get("fields") or _default_fields(role, kind)
    if not fields:
        raise RecordingError(f"{path}: {role}: fields are missing, and there are no default ones for {kind}")
    _check_columns(path, role, kind, fields)
    return Role(
        topic,
        kind,
        _named(path, role, "fields", fields, str),
        _named(path, role, "scale", entry.get("scale") or {}, float),
        _named(path, role, "offset", entry.get("offset") or {}, float),
        str(entry.get("stamp", "header")),
        _factors(path, role, entry.get("unit") or {}),
        _limits(path, role, entry.get("limits") or {}),
        _choice(path, role, "stamp_unit", entry.get("stamp_unit", "s"), _STAMP_UNITS),
        round(_clock_offset(path, role, entry.get("clock_offset", 0.0)) * 1e9),
        str(entry.get("sequence", "")),
    )


def _check_columns(path: Path, role: str, kind: str, fields: Any) -> None:
    """Raise a `RecordingError` for fields that are neither columns of a file of lines nor lie in one (`load.f[0]`)."""
    if not kind.startswith("csv:") or not isinstance(fields, dict):
        return
    columns = kind.removeprefix("csv:").split(",")
    for name in fields.values():
        if name not in columns and re.split(r"[.\[]", name, maxsplit=1)[0] not in columns:
            raise RecordingError(f"{path}: {role}: fields: got {name!r}, expected a column of {', '.join(columns)}")


def _topic(path: Path, role: str, entry: Mapping[str, Any], topics: Mapping[str, str] | None) -> tuple[str, str]:
    """Return name and type of a role's topic."""
    if topics is None:
        return entry["topic"], str(entry.get("type", "json"))
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
    return topic, kind


def _factors(path: Path, role: str, given: Any) -> dict[str, float]:
    """Return what takes each number to SI."""
    if isinstance(given, str):
        given = dict.fromkeys(ROLES[role], given)
    units = _named(path, role, "unit", given, str)
    return {
        name: UNITS[_QUANTITIES[role, name]][_choice(path, role, "unit", unit, UNITS[_QUANTITIES[role, name]])]
        for name, unit in units.items()
    }


def _limits(path: Path, role: str, given: Any) -> dict[str, tuple[float, float]]:
    """Return smallest and largest of each number; one number given stands for both signs."""
    if isinstance(given, list):
        given = dict.fromkeys(ROLES[role], given)

    def pair(value: Any) -> tuple[float, float]:
        low, high = value if isinstance(value, list) else (-float(value), float(value))
        if not float(low) < float(high):
            raise ValueError(value)
        return float(low), float(high)

    return _named(path, role, "limits", given, pair)


def _choice(path: Path, role: str, key: str, given: Any, known: Mapping[str, Any]) -> str:
    if given not in known:
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected one of {', '.join(known)}")
    return str(given)


def _clock_offset(path: Path, role: str, given: Any) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not abs(given) < 1e9:
        raise RecordingError(f"{path}: {role}: clock_offset: got {given!r}, expected a number of seconds")
    return float(given)


def _named(path: Path, role: str, key: str, given: Any, kind: Callable[[Any], Any]) -> dict[str, Any]:
    names = ROLES[role]
    if isinstance(given, int | float) and not isinstance(given, bool):
        given = dict.fromkeys(names, given)
    if not isinstance(given, dict) or not set(map(str, given)) <= set(names):
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected a mapping of {', '.join(names)}")
    try:
        values = {str(name): kind(value) for name, value in given.items()}
    except (TypeError, ValueError) as error:
        expected = "numbers, or pairs of smallest and largest" if key == "limits" else f"{kind.__name__} values"
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected {expected}") from error
    if any(isinstance(value, float) and not math.isfinite(value) for value in values.values()):
        raise RecordingError(f"{path}: {role}: {key}: got {given!r}, expected finite numbers")
    if key == "fields" and role == "excitation" and set(values) != set(names):
        raise RecordingError(f"{path}: {role}: fields: got {sorted(values)}, expected all of {', '.join(names)}")
    return values


def _default_fields(role: str, kind: str) -> dict[str, str]:
    if kind.startswith("csv:"):
        columns = kind.removeprefix("csv:").split(",")
        return {name: name for name in ROLES[role] if name in columns}
    if kind == "json":
        return {name: name for name in ROLES[role]}
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
