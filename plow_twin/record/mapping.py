"""Assign roles to the topics of a recording, by a YAML file or by the names and types of the topics.

The *role* of a topic determines which quantities of the model the messages on the topic contain. The roles are
`excitation` (the load), `head_pose`, `travel`, `forces`, `gaps` and `drive`.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError, UnitError
from plow_twin.model.geometry import angle_of
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.column_names import TIME_EXPECTED, time_column, unit_of
from plow_twin.record.map_file import (
    LOAD_MODEL,
    OPCUA,
    QUANTITIES,
    ROLES,
    SERVER_STAMP,
    SOURCE_STAMP,
    UNITS,
    map_error,
    read_map_file,
)
from plow_twin.record.merging import StampOf
from plow_twin.record.sources import Arrived, Columns, Source, TopicType
from plow_twin.record.times import NO_TIME, NUMBER, STAMP_UNITS, TIMES, likely_unit, time_ns
from plow_twin.scene_file.parquet_lines import SUFFIX

Number = TypeVar("Number", float, NDArray[np.float64])
#: Prefix of the keys under which messages that do not fit their role are counted as losses.
UNFIT: Final = "unfit, "
_WRENCH: Final = {"fx": "wrench.force.x", "fy": "wrench.force.y", "m": "wrench.torque.z"}
_POSE: Final = {"x": "pose.position.x", "y": "pose.position.y", "theta": "pose.orientation"}
_POSE_IN_POSE: Final = {key: f"pose.{path}" for key, path in _POSE.items()}
_FIELDS: Final[dict[tuple[str, str], dict[str, str]]] = {
    ("excitation", "geometry_msgs/msg/WrenchStamped"): _WRENCH,
    ("excitation", "geometry_msgs/msg/Wrench"): {key: path.removeprefix("wrench.") for key, path in _WRENCH.items()},
    ("head_pose", "geometry_msgs/msg/PoseStamped"): _POSE,
    ("head_pose", "nav_msgs/msg/Odometry"): _POSE_IN_POSE,
    ("head_pose", "geometry_msgs/msg/PoseWithCovarianceStamped"): _POSE_IN_POSE,
    ("travel", "geometry_msgs/msg/TwistStamped"): {"speed": "twist.linear.z"},
    ("forces", "sensor_msgs/msg/JointState"): {name: f"effort[{name}]" for name in PAIR_NAMES},
    ("gaps", "sensor_msgs/msg/JointState"): {name: f"position[{name}]" for name in PAIR_NAMES},
}
#: Topic names from which a role is guessed if no mapping is given.
_NAMES: Final = {
    "excitation": ("excitation", "load", "wrench"),
    "head_pose": ("head_pose", "pose"),
    "travel": ("travel",),
    "forces": ("measured_forces", "forces"),
    "gaps": ("gaps",),
}


@dataclass(frozen=True)
class Role:
    """Role of a topic: the field of each quantity in a message, and its conversion to SI units.

    A path to a field consists of names that are separated by dots. In a path, `[3]` selects the array item with the
    index 3, and `[fx]` selects the array item with the index that `fx` has in the field `name` of the message. A path
    to a quaternion yields the angle about z.
    """

    topic: str
    message_type: TopicType
    #: path of each quantity
    fields: Mapping[str, str]
    #: conversion of each quantity to SI: (`scale` * field + `offset`) * `factor`
    scale: Mapping[str, float] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    #: `header` (stamp of the message), `log` (receive time), or the path of the time in a CSV or JSON message; at the
    #: path, the time is a number in the unit `stamp_unit` or an ISO 8601 text
    stamp: str = "header"
    factor: Mapping[str, float] = field(default_factory=dict)
    #: range of each quantity [SI units]; values outside the range are not used
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    stamp_unit: str = "s"
    #: time that is added to each stamp [ns]
    clock_offset_ns: int = 0
    #: path of the message number that the sender assigned, or an empty string
    sequence: str = ""
    #: whether the mapping or an option states `stamp_unit`
    stamp_unit_is_stated: bool = False

    def read(self, arrived: Arrived) -> tuple[int, dict[str, float]] | None:
        """Return the stamp [ns] and the values of a message, or None if a value or the stamp is missing.

        The value of an empty field is NaN.
        """
        values = {}
        for name, path in self.fields.items():
            value = _follow(arrived.content, path)
            if value is None:
                return None
            values[name] = self.in_si(name, value)
        stamp_ns = self.stamp_ns(arrived)
        return None if stamp_ns is None else (stamp_ns, values)

    def in_si(self, name: str, value: Number) -> Number:
        """Convert a number or an array of the quantity `name` from the unit in the recording to SI."""
        return (value * self.scale.get(name, 1.0) + self.offset.get(name, 0.0)) * self.factor.get(name, 1.0)

    def stamp_ns(self, arrived: Arrived) -> int | None:
        """Return the stamp of a message [ns], or None if it has no stamp."""
        stamp_ns = self._sent_ns(arrived)
        return None if stamp_ns is None else stamp_ns + self.clock_offset_ns

    def why_unfit(self, arrived: Arrived, *, with_value: bool = False) -> str:
        """Return a text with the first field of a message that is not a number, or with an invalid stamp.

        `with_value` adds the value of the field to the text.
        """
        content = arrived.content
        if with_value and content is None:
            count = len(self.message_type.names) if isinstance(self.message_type, Columns) else 0
            if not count:
                return f"{self.topic} has a message that is not a JSON object"
            return (
                f"{self.topic} has a line without the {count} cells of its header (if commas are decimal signs, "
                "semicolons or tabs must separate the columns)"
            )

        def got(path: str) -> str:
            value = _at(content, path) if isinstance(content, Mapping) else None
            return f": got {value!r:.60}" if with_value and value is not None else ""

        for name, path in self.fields.items():
            if _follow(content, path) is None:
                return f"{self.topic} has no number at {path!r} for {name}{got(path)}"
        stamp = self.stamp
        if stamp == "header" and isinstance(content, Mapping):
            stamp = next((name for name in TIMES if name in content), stamp)
        likely = likely_unit(_at(content, stamp)) if isinstance(content, Mapping) else None
        if not with_value:
            hint = f" in s (the numbers look like {likely}: stamp_unit: {likely})" if likely else ""
            return f"{self.topic} has no time at {stamp!r}{hint}"
        expected = (
            f"seconds; they look like {likely}: state the unit: --unit t={likely}"
            if likely
            else "a number or a date such as 2026-01-02T03:04:05.678Z"
        )
        return f"{self.topic} has no time at {stamp!r}{got(stamp)}, expected {expected}"

    def plausible(self, values: Mapping[str, Number]) -> bool:
        """Return whether all numbers, or arrays of numbers, are within their limits.

        NaN and a missing number count as within the limits.
        """
        return not any(
            np.any((values[name] < low) | (values[name] > high))
            for name, (low, high) in self.limits.items()
            if name in values
        )

    def empty(self, arrived: Arrived) -> bool:
        """Return whether all fields of this role are empty or missing in a message."""
        content = arrived.content
        return isinstance(content, Mapping) and all(_at(content, path) in (None, "") for path in self.fields.values())

    def number(self, arrived: Arrived) -> int | None:
        """Return the message number that the sender assigned, or None if the message has no number."""
        value = _follow(arrived.content, self.sequence)
        return int(value) if value is not None and math.isfinite(value) and value == int(value) >= 0 else None

    def _sent_ns(self, arrived: Arrived) -> int | None:
        content = arrived.content
        received_ns = None if arrived.log_time_ns == NO_TIME else arrived.log_time_ns
        if self.stamp == "log":
            return received_ns
        if isinstance(content, Mapping):
            if self.stamp == "header":
                name = next((name for name in TIMES if name in content), None)
                return received_ns if name is None else time_ns(content[name], self.stamp_unit)
            # if the mapping states the path of the stamp, the receive time does not replace a missing stamp
            return time_ns(_at(content, self.stamp), self.stamp_unit)
        stamp = getattr(getattr(content, "header", None), "stamp", None)
        # a message without a header has no stamp, so the receive time is used
        return received_ns if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _at(content: Mapping[str, Any], path: str) -> Any | None:
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
    if isinstance(value, str):
        value = value.strip()  # some space characters that `strip` removes would be refused by `float`
        if not value:
            return math.nan
        if not NUMBER.fullmatch(value):
            return None
    elif isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _follow(content: Any, path: str) -> float | None:
    """Return the number at `path` in a message, or None if the message has no number there."""
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
        return float(angle_of(float(value.z), float(value.w)))
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def readings(
    messages: Iterable[Arrived], roles: Mapping[str, Role]
) -> Iterator[tuple[str, Arrived, tuple[int, dict[str, float]] | None]]:
    """Read each message with each role of its topic.

    If a topic has several roles, a role is omitted for a message in which all fields of the role are empty.

    Yields
    ------
    tuple
        Name of the role, message, and result of `Role.read`.
    """
    by_topic = roles_by_topic(roles)
    for arrived in messages:
        shared = by_topic.get(arrived.topic, [])
        for name, role in shared:
            if len(shared) == 1 or not role.empty(arrived):
                yield name, arrived, role.read(arrived)


def roles_by_topic(roles: Mapping[str, Role]) -> dict[str, list[tuple[str, Role]]]:
    """Return the roles of each topic, with their names."""
    by_topic: dict[str, list[tuple[str, Role]]] = {}
    for name, role in roles.items():
        by_topic.setdefault(role.topic, []).append((name, role))
    return by_topic


def stamps_by(roles: Mapping[str, Role]) -> StampOf[Arrived]:
    """Return a function that returns the stamp of a message [ns].

    If a topic has several roles, the first role that finds a stamp determines it.
    """
    by_topic = roles_by_topic(roles)

    def stamp_ns(arrived: Arrived) -> int | None:
        stamps = (role.stamp_ns(arrived) for _, role in by_topic.get(arrived.topic, ()))
        return next((stamp for stamp in stamps if stamp is not None), None)

    return stamp_ns


def messages_of(source: Source, roles: Mapping[str, Role]) -> Iterator[Arrived]:
    """Yield the messages of all topics that have a role; messages from several files are merged by their stamps."""
    topics = {role.topic for role in roles.values()}
    return source.messages(topics.__contains__, stamps_by(roles))


def roles_by_source(
    sources: Sequence[Source], path: Path | None, left_out: str = ""
) -> Iterator[tuple[Source, dict[str, Role]]]:
    """Yield each recording of a run with the roles of its topics.

    The topics of all recordings are searched together for the topic of each role. Topics that begin with `left_out`
    get no role.
    """
    tables = [
        {topic: kind for topic, kind in source.topics().items() if not left_out or not topic.startswith(left_out)}
        for source in sources
    ]
    roles = read_map(path, {topic: kind for table in tables for topic, kind in table.items()})
    for source, table in zip(sources, tables, strict=True):
        yield source, {name: role for name, role in roles.items() if role.topic in table}


def read_map(path: Path | None, topics: Mapping[str, TopicType] | None) -> dict[str, Role]:
    """Return the roles of topics.

    Parameters
    ----------
    path : Path or None
        Mapping file in YAML. Without a file, the roles are guessed from the names and types of the topics.
    topics : dict or None
        Type of each topic. If it is None, the mapping file determines the type of a topic, which is JSON by default.

    Raises
    ------
    MapError
        The file cannot be read, is invalid, or does not fit the topics.
    """
    if path is None:
        topics = topics or {}
        return {role: guess for role in _NAMES if (guess := _guess(role, topics)) is not None}
    document = read_map_file(path)
    return {role: _role(path, role, entry, topics) for role, entry in document.items() if role != LOAD_MODEL}


def _role(path: Path, role: str, entry: Mapping[str, Any], topics: Mapping[str, TopicType] | None) -> Role:
    topic, kind = _topic(path, role, entry, topics)
    fields = entry.get("fields") or _default_fields(role, kind)
    if not fields:
        raise map_error(path, f"{role}.fields", entry.get("fields"), f"a mapping, because {kind} has no default fields")
    if role == "excitation" and (missing := set(ROLES[role]) - set(fields)):
        raise map_error(path, f"{role}.fields", sorted(fields), f"{', '.join(sorted(missing))} too")
    units = entry.get("unit", {})
    read_role = Role(
        topic,
        kind,
        {name: str(field) for name, field in fields.items()},
        entry.get("scale", {}),
        entry.get("offset", {}),
        str(entry.get("stamp", "header")),
        {name: UNITS[QUANTITIES[role, name]][unit] for name, unit in units.items()},
        {name: _limits(path, f"{role}.limits.{name}", limit) for name, limit in entry.get("limits", {}).items()},
        entry.get("stamp_unit", "s"),
        round(entry.get("clock_offset", 0.0) * 1e9),
        str(entry.get("sequence", "")),
        "stamp_unit" in entry,
    )
    _check_columns(path, role, read_role)
    if "stamp_unit" in entry:
        _check_stamp_unit(path, role, read_role)
    read_role = _with_time_column(read_role, lambda got, expected: map_error(path, f"{role}.stamp", str(got), expected))
    if kind == OPCUA:
        _check_nodes(path, role, read_role)
    elif not isinstance(kind, Columns) and kind != "json" and read_role.stamp not in ("header", "log"):
        raise map_error(path, f"{role}.stamp", read_role.stamp, f"header or log for {kind}")
    return read_role


def _check_nodes(path: Path, role: str, read_role: Role) -> None:
    if read_role.stamp not in (SOURCE_STAMP, SERVER_STAMP):
        raise map_error(path, f"{role}.stamp", read_role.stamp, f"{SOURCE_STAMP} or {SERVER_STAMP} for nodes")
    if read_role.stamp_unit != "ns":
        raise map_error(
            path, f"{role}.stamp_unit", read_role.stamp_unit, "no stamp_unit: the stamps of nodes are dates"
        )
    if read_role.sequence:
        raise map_error(path, f"{role}.sequence", read_role.sequence, "no sequence: the server numbers its messages")


def with_units(roles: Mapping[str, Role], units: Mapping[str, str]) -> dict[str, Role]:
    """Return the roles with the units that the user states.

    `units` maps the name of a quantity (fx, x, ..., or t for the stamps) to its unit. Raise `UnitError` if no role has
    a quantity with a stated name, or a quantity cannot have the stated unit.
    """
    changed = dict(roles)
    for name, unit in units.items():
        if name == "t":
            if unit not in STAMP_UNITS:
                raise UnitError(f"unit of t: got {unit!r}, expected one of {', '.join(STAMP_UNITS)}")
            changed = {key: replace(role, stamp_unit=unit, stamp_unit_is_stated=True) for key, role in changed.items()}
            continue
        having = [key for key, role in roles.items() if name in role.fields]
        if not having:
            names = sorted({field for role in roles.values() for field in role.fields} | {"t"})
            raise UnitError(f"unit of {name}: got an unknown name, expected one of {', '.join(names)}")
        for key in having:
            factors = UNITS[QUANTITIES[key, name]]
            if unit not in factors:
                raise UnitError(f"unit of {name}: got {unit!r}, expected one of {', '.join(factors)}")
            changed[key] = replace(changed[key], factor={**changed[key].factor, name: factors[unit]})
    return changed


def _limits(path: Path, key: str, limits: float | list[float]) -> tuple[float, float]:
    low, high = limits if isinstance(limits, list) else (-limits, limits)
    if not low < high:
        raise map_error(path, key, limits, "the smallest number, then the largest")
    return float(low), float(high)


def _check_columns(path: Path, name: str, role: Role) -> None:
    """Raise a `MapError` for a field that is neither a column nor a path within a column, such as `load.f[0]`."""
    columns = role.message_type
    if not isinstance(columns, Columns):
        return
    named = [("fields", column) for column in role.fields.values()]
    named += [("stamp", role.stamp)] if role.stamp not in ("header", "log") else []
    named += [("sequence", role.sequence)] if role.sequence else []
    for key, column in named:
        if not {column, re.split(r"[.\[]", column, maxsplit=1)[0]} & set(columns.names):
            raise map_error(path, f"{name}.{key}", column, f"one of the {columns}")


def _with_time_column(role: Role, error: Callable[[Columns, str], Exception]) -> Role:
    """Return the role with the column of the time, unless the mapping states the stamp.

    The unit in the name of the column applies unless the mapping states a unit. If no column is recognised, messages
    get the time of receipt, and a table from a file, whose rows have none, raises the error.
    """
    columns = role.message_type
    if role.stamp != "header" or not isinstance(columns, Columns):
        return role
    stamp = time_column(columns.names)
    if stamp is None:
        if columns.are_received:
            return role
        raise error(columns, f"one column with a name such as {TIME_EXPECTED}, or stamp: COLUMN in a mapping")
    in_name = unit_of(stamp)
    unit = in_name if in_name in STAMP_UNITS and not role.stamp_unit_is_stated else role.stamp_unit
    return replace(role, stamp=stamp, stamp_unit=unit)


def _check_stamp_unit(path: Path, name: str, role: Role) -> None:
    kind, reason = role.message_type, ""
    if role.stamp == "log":
        reason = "no stamp_unit with stamp: log"
    elif role.stamp == "header" and isinstance(kind, Columns) and time_column(kind.names) is None:
        reason = f"also a stamp with the name of its column: the {kind} have none of {TIME_EXPECTED}"
    elif role.stamp == "header" and not isinstance(kind, Columns) and kind != "json":
        reason = f"no stamp_unit: {kind} has stamps in ns"
    if reason:
        raise map_error(path, f"{name}.stamp_unit", role.stamp_unit, reason)


def _topic(
    path: Path, role: str, entry: Mapping[str, Any], topics: Mapping[str, TopicType] | None
) -> tuple[str, TopicType]:
    if topics is None:
        return entry["topic"], str(entry.get("type", "json"))
    topic = entry["topic"].removesuffix(".csv").removesuffix(SUFFIX)
    topic = (
        topic if topic in topics else next((name for name in topics if name.lstrip("/") == topic.lstrip("/")), topic)
    )
    if topic not in topics and len(alike := fnmatch.filter(topics, topic)) == 1:
        topic = alike[0]
    if topic not in topics:
        raise map_error(path, f"{role}.topic", topic, f"one of {', '.join(sorted(topics))}")
    kind = topics[topic]
    if not isinstance(kind, Columns) and entry.get("type", kind) != kind:
        raise map_error(path, f"{role}.type", entry["type"], f"{kind}, the type of {topic}")
    return topic, kind


def _default_fields(role: str, kind: TopicType) -> dict[str, str]:
    if isinstance(kind, Columns):
        return {name: name for name in ROLES[role] if name in kind.names}
    if kind == "json":
        return {name: name for name in ROLES[role]}
    return _FIELDS.get((role, kind), {})


def _guess(role: str, topics: Mapping[str, TopicType]) -> Role | None:
    """Find the topic of a role by the names in `_NAMES`, or as the only topic of a fitting type."""
    fitting = {}
    for topic, kind in topics.items():
        fields = _default_fields(role, kind)
        enough = len(fields) == len(ROLES[role]) if role in ("excitation", "travel") else bool(fields)
        if enough and "/journal/" not in topic:
            fitting[topic] = fields
    ending = [topic for name in _NAMES[role] for topic in fitting if topic.rpartition("/")[2] == name]
    # the roles `forces` and `gaps` are found by name only, because their message type is common
    lonely = list(fitting) if len(fitting) == 1 and role in ("excitation", "head_pose", "travel") else []
    lonely = [topic for topic in lonely if topic.rpartition("/")[2] not in ("head_state", "contact_forces")]
    found = [*ending, *lonely]
    if not found:
        return None
    return _with_time_column(
        Role(found[0], topics[found[0]], fitting[found[0]]),
        lambda got, expected: RecordingError(f"{found[0]}: time: got the {got}, expected {expected}"),
    )
