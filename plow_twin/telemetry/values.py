"""The newest numbers and texts of a twin, in groups. All outputs have the same groups."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from plow_twin.live.part import number_of

#: A value, or None if the value is unknown.
Value = float | int | str | None

_POINTS: Final = ("", "/p05", "/p95")
_ALARMS: Final = ("force", "clearance", "clearance_rate", "wear_rate", "residual")
_ALARM_TEXTS: Final = ("level", "latched", "place")
_FLAGS: Final = (
    "lifecycle", "stream", "stale_inputs", "clock", "recorder", "horizontal", "vertical", "pads", "follow",
    "model", "sensor",
)  # fmt: skip
_LIFE: Final = (
    *(f"{name}/{point}" for name in ("seconds", "metres", "passes", "shifts") for point in ("p10", "p50", "p90")),
    "not_reached_in_horizon", "probability_before_stop",
)  # fmt: skip
UNITS: Final = {"clearance": "m", "wear": "m", "peaks": "N"}


class Group(NamedTuple):
    """Values in SI units that are sent together. `held` is True if the load had no new samples.

    `time_s` is the stamp that the model has reached [s since 1970]. Before the first stamp, `time_s` is 0.
    """

    time_s: float
    values: dict[str, Value]
    held: bool = False


class Newest:
    """The newest values of all groups, from the updates of a feed.

    The groups `clearance` and `wear` contain values [m] and the 5 % and 95 % points of the values. The group `peaks`
    contains the largest forces since the last update [N]. The group `life` contains the 10 %, 50 % and 90 % points of
    the forecast. The groups `flags`, `status` and `alarms` contain states of the twin. After the first update, each
    group contains all of its names.
    """

    def __init__(self) -> None:
        self.facts: dict[str, Any] = {}
        self.not_taken = 0
        self.groups: dict[str, Group] = {}
        self._time_s = 0.0
        self._held = False

    def update(self, update: Mapping[str, Any]) -> dict[str, Group]:
        """Apply an update. Return the groups that have changed."""
        self.not_taken = update.get("not_taken", self.not_taken)
        changed: dict[str, dict[str, Value]] = {}
        if "facts" in update:
            self.facts = update["facts"]
            changed |= _unknown([pad["name"] for pad in self.facts["pads"]])
        motion = update.get("motion")
        if motion is not None and (motion["t"] != self._time_s or any(motion["peak"])):
            self._time_s, self._held = motion["t"], motion["was_held"]
            changed |= self._motion(motion)
        for name, (level, message, values) in update.get("parts", {}).items():
            changed |= _part(name, level, message, values)
        groups = {name: Group(self._time_s, values, self._held) for name, values in changed.items()}
        self.groups |= groups
        return groups

    def _motion(self, motion: Mapping[str, Any]) -> dict[str, dict[str, Value]]:
        names = [pad["name"] for pad in self.facts["pads"]]
        count, points = len(names), motion.get("points") or ()
        groups_of: dict[str, dict[str, Value]] = {
            "peaks": {
                **dict(zip(names, motion["peak"], strict=True)),
                **{
                    f"{name}{point}": points[index + offset] if points else None
                    for point, offset in (("/p05", 0), ("/p95", count))
                    for index, name in enumerate(names)
                },
            }
        }
        clearance = motion.get("clearance")
        if clearance is not None:
            pads = {name.removeprefix("pad_"): value for name, value in clearance.items() if name.startswith("pad_")}
            groups_of["wear"] = pads
            groups_of["clearance"] = {name: value for name, value in clearance.items() if not name.startswith("pad_")}
        return groups_of


def _unknown(names: list[str]) -> dict[str, dict[str, Value]]:
    by_pair: dict[str, Value] = {f"{name}{point}": None for point in _POINTS for name in names}
    axes: dict[str, Value] = {f"{axis}{point}": None for point in _POINTS for axis in ("horizontal", "vertical")}
    return {
        "clearance": axes,
        "wear": dict(by_pair),
        "peaks": by_pair,
        "life": dict.fromkeys(_LIFE),
        "flags": dict.fromkeys(_FLAGS, ""),
        "status": {"level": 0, "message": ""},
        "alarms": _alarms(0, "", {}),
    }


def _part(name: str, level: int, message: str, values: Mapping[str, str]) -> dict[str, dict[str, Value]]:
    if name == "status":
        return {
            "status": {"level": level, "message": message},
            "flags": {flag: values.get(flag, "") for flag in _FLAGS},
        }
    if name == "alarms":
        return {"alarms": _alarms(level, message, values)}
    if name == "forecast":
        return {"life": {point: number_of(values.get(point, "")) for point in _LIFE}}
    return {}


def _alarms(level: int, message: str, values: Mapping[str, str]) -> dict[str, Value]:
    alarm: dict[str, Value] = {"level": level, "message": message}
    for name in _ALARMS:
        stamp = number_of(values.get(f"{name}_stamp_ns", ""))
        alarm[name] = number_of(values.get(name, ""))
        alarm |= {f"{name}_{key}": values.get(f"{name}_{key}", "") for key in _ALARM_TEXTS}
        alarm |= {f"{name}_{key}": number_of(values.get(f"{name}_{key}", "")) for key in ("raised", "threshold")}
        alarm[f"{name}_time"] = None if stamp is None else stamp * 1e-9
    return alarm
