"""Table of the node's parameters, from which defaults, checks, ROS descriptors and config/twin.yaml follow."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Final

from plow_twin.errors import InputError, Problem
from plow_twin.live.service_names import SERVICES
from plow_twin.scene_file.presets import PRESETS
from plow_twin.stream.topics import Cadence, names_of

#: Topics of the estimate and of results that follow from it.
ESTIMATES: Final = names_of(Cadence.ESTIMATE)


class Effect(Enum):
    """When a changed value takes effect."""

    START = "at start (read only)"
    CONFIGURE = "on configure; can be changed while unconfigured"
    NOW = "at once"


class ParameterError(InputError):
    """Parameters cannot be used."""

    def __init__(self, problems: Iterable[Problem], source: str = "parameters") -> None:
        super().__init__(problems, source)


def _number(default: float | tuple[float, ...], unit: str, low: float, high: float, effect: Effect, doc: str) -> Any:
    return field(default=default, metadata={"unit": unit, "low": low, "high": high, "effect": effect, "doc": doc})


def _limit(unit: str, doc: str, default: float = 0.0, high: float = 1e300) -> Any:
    return _number(default, unit, 0.0, high, Effect.NOW, f"largest plausible {doc}")


def _of_scene(unit: str, high: float, doc: str) -> Any:
    return _number(-1.0, unit, -1.0, high, Effect.NOW, f"{doc}; -1: as in the scene")


def _alarm(unit: str, high: float, doc: str) -> Any:
    doc = f"{doc} that raise a warning and an error; 0: never"
    return _number((0.0, 0.0), unit, 0.0, high, Effect.CONFIGURE, doc)


def _choice(default: str, choices: tuple[str, ...], effect: Effect, doc: str) -> Any:
    return field(default=default, metadata={"choices": choices, "effect": effect, "doc": doc})


def _plain(default: bool | str, effect: Effect, doc: str) -> Any:
    return field(default=default, metadata={"effect": effect, "doc": doc})


@dataclass(frozen=True)
class Settings:
    """All parameters with their defaults; numbers in SI units."""

    autostart: bool = _plain(True, Effect.START, "configure and activate at start; false: wait for lifecycle requests")
    hardware_id: str = _plain("plough_head", Effect.START, "serial number of the head, shown in status and diagnostics")
    file_root: str = _plain(
        "",
        Effect.START,
        "folder within which scene, record_path and wear_state_path must be; empty: after the start they can only be "
        "changed to the name of a preset",
    )
    services_off: str = _plain(
        "", Effect.START, "services that are refused, separated by commas, e.g. set_wear,acknowledge_alarms"
    )
    opcua_server: str = _plain(
        "", Effect.START, "OPC UA server, opc.tcp://HOST:PORT, that replaces the topics of some inputs; empty: none"
    )
    opcua_map: str = _plain("", Effect.START, "YAML file that gives the nodes of opcua_server for these inputs")
    opcua_access: str = _plain(
        "", Effect.START, "YAML file with the credentials for opcua_server; empty: none (a server on this machine)"
    )
    priority: int = _number(
        0,
        "SCHED_FIFO",
        0,
        99,
        Effect.START,
        "priority of the computing thread; 0: normal; a refusal by the system is a warning",
    )
    cpu_affinity: str = _plain("", Effect.START, "processors to run on, e.g. 2,3; empty: all; a refusal is a warning")
    lock_memory: bool = _plain(False, Effect.START, "keep all memory from being paged out; a refusal is a warning")
    scene: str = _plain("paper", Effect.CONFIGURE, "scene file, or the name of a preset: paper, bench_kv, bench_hc")
    tolerance: float = _number(1e-9, "1", 1e-13, 1e-3, Effect.CONFIGURE, "relative tolerance of the solver")
    excitation_source: str = _choice(
        "excitation",
        ("excitation", "tool_forces", "scene"),
        Effect.CONFIGURE,
        "source of the load: a topic, or the scene's own loads by the node's clock; samples on the other topic are "
        "counted and ignored",
    )
    input_depth: int = _number(1000, "messages", 200, 100000, Effect.CONFIGURE, "queue depth of the excitation topics")
    expected_rate: float = _number(
        0.0,
        "Hz",
        0.0,
        1e5,
        Effect.CONFIGURE,
        "expected rate of the samples, from which gaps in the stamps are counted as missing samples; 0: not counted",
    )
    publish_mode: str = _choice(
        "on_sample",
        ("on_sample", "fixed_rate"),
        Effect.CONFIGURE,
        "publish after each sample used, or at publish_rate; the stamp is that of the newest sample used",
    )
    publish_rate: float = _number(100.0, "Hz", 0.1, 1000.0, Effect.CONFIGURE, "rate of publish_mode fixed_rate")
    missed_periods: int = _number(
        1,
        "periods",
        0,
        1000000,
        Effect.NOW,
        "number of missed periods between two reports that gives a warning; 0: never",
    )
    step_rate: float = _number(
        100.0, "Hz", 1.0, 1000.0, Effect.CONFIGURE, "rate of advances under the scene's own loads and the hold policy"
    )
    rollback_span: float = _number(
        2.0,
        "s",
        0.0,
        600.0,
        Effect.CONFIGURE,
        "largest age, relative to the newest sample, at which a late sample is used; 0: late samples are dropped",
    )
    estimate: bool = _plain(
        False,
        Effect.CONFIGURE,
        "estimate clearances and contact from load and head_pose or gaps, in a process of its own",
    )
    estimate_window: float = _number(
        32.0, "s", 1.0, 600.0, Effect.CONFIGURE, "length of the window of an estimate; ten load periods are enough"
    )
    estimate_interval: float = _number(10.0, "s", 0.5, 3600.0, Effect.CONFIGURE, "time between the ends of two windows")
    estimate_forces: int = _number(
        0,
        "twins",
        0,
        4096,
        Effect.CONFIGURE,
        "number of twins drawn from each estimate for window_forces, at least 20; 256 is plenty; 0: no intervals",
    )
    follow: str = _choice(
        "full",
        ("off", "parameters", "full"),
        Effect.CONFIGURE,
        "how the twin follows the machine with `estimate`; off: not at all; parameters: each estimate sets the numbers "
        "of the model; full: each measured pose also corrects the motion, and the forces have intervals",
    )
    follow_members: int = _number(
        128,
        "twins",
        20,
        4096,
        Effect.CONFIGURE,
        "number of twins with follow: full; each takes the same computing time",
    )
    forecast_limits: tuple[float, ...] = _number(
        (0.0, 0.0),
        "m",
        0.0,
        1.0,
        Effect.CONFIGURE,
        "limits of the horizontal and the vertical clearance for the forecast after each estimate; 0: no forecast",
    )
    forecast_horizon: float = _number(
        1.44e7, "s", 1.0, 1e10, Effect.CONFIGURE, "time of operation beyond which a limit counts as not reached"
    )
    forecast_stop: float = _number(
        0.0,
        "s",
        0.0,
        1e10,
        Effect.CONFIGURE,
        "time of operation to a planned stop; the forecast gives the probability of a limit before it; 0: no stop",
    )
    forecast_scenarios: str = _plain(
        "",
        Effect.CONFIGURE,
        "scenarios as multiples of load and wear coefficient: NAME:load=X,coefficient=Y; NAME:...; the answer of "
        "~/forecast has a forecast for each scenario",
    )
    wear_state_path: str = _plain(
        "",
        Effect.CONFIGURE,
        "folder that keeps the wear of the pads after the process ends; the wear of another head or scene is refused; "
        "empty: not kept",
    )
    wear_save_period: float = _number(10.0, "s", 0.1, 3600.0, Effect.CONFIGURE, "interval at which the wear is saved")
    frame_id: str = _plain("slide_frame", Effect.CONFIGURE, "frame of all outputs: centre of the slide, x right, y up")
    child_frame_id: str = _plain("head_frame", Effect.CONFIGURE, "frame of the head in head_state")
    marker_rate: float = _number(
        0.0,
        "Hz",
        0.0,
        100.0,
        Effect.CONFIGURE,
        "rate of the topic markers: walls, pads and forces for RViz; needs visualization_msgs; node only; 0: off",
    )
    tf: bool = _plain(
        False,
        Effect.CONFIGURE,
        "send the head's pose on /tf with the markers, from frame_id to child_frame_id; needs tf2_msgs; node only",
    )
    record_path: str = _plain(
        "",
        Effect.CONFIGURE,
        "folder for the recording of each configured run, with _2, _3, ... if it exists; empty: no recording",
    )
    record_outputs: str = _choice(
        "all",
        ("all", "decimated", "none"),
        Effect.CONFIGURE,
        "recorded outputs; none: the journal alone, from which `plow-twin replay --write` computes them",
    )
    record_rate: float = _number(
        50.0, "Hz", 0.1, 10000.0, Effect.CONFIGURE, "rate of the outputs in a decimated recording; peaks are kept"
    )
    record_part_mb: float = _number(
        0.0, "MB", 0.0, 1e6, Effect.CONFIGURE, "size at which the recording continues in a new part; 0: never"
    )
    record_part_s: float = _number(
        0.0, "s", 0.0, 1e9, Effect.CONFIGURE, "time after which the recording continues in a new part; 0: never"
    )
    record_keep_mb: float = _number(
        0.0, "MB", 0.0, 1e9, Effect.CONFIGURE, "total size of closed parts above which the oldest are removed; 0: never"
    )
    record_ring: float = _number(
        0.0,
        "s",
        0.0,
        3600.0,
        Effect.CONFIGURE,
        "keep only the last seconds, in memory, and write them to a folder at each alarm or mark; 0: record everything",
    )
    record_sync: bool = _plain(
        False, Effect.CONFIGURE, "wait for the disk every half second, so that the recording survives a loss of power"
    )
    excitation_timeout: float = _number(
        0.5,
        "s",
        0.01,
        3600.0,
        Effect.NOW,
        "silence after which the excitation counts as stale; in files and under use_sim_time it is only counted",
    )
    hold_policy: str = _choice(
        "hold", ("hold", "zero"), Effect.NOW, "load while the excitation is stale: the last load, or zero"
    )
    hold_limit: float = _number(
        60.0, "s", 0.0, 86400.0, Effect.NOW, "silence beyond the timeout after which the model stops"
    )
    limit_force: float = _limit("N", "force component; 0: ten times the scene's loads and weight")
    limit_moment: float = _limit("N m", "moment; 0: derived from the scene's loads and weight")
    limit_force_rate: float = _limit("N/s", "rate of change of a force; 0: a change by limit_force within 1 ms")
    limit_moment_rate: float = _limit("N m/s", "rate of change of the moment; 0: a change by limit_moment within 1 ms")
    limit_travel: float = _limit("m/s", "speed along the face", 10.0, 1000.0)
    limit_travel_rate: float = _limit("m/s^2", "acceleration along the face; 0: a change by limit_travel within 1 ms")
    limit_pose: float = _limit(
        "m", "measured displacement; 0: half the larger side of the frame or clearance", high=1000.0
    )
    limit_pose_rate: float = _limit("m/s", "rate of change of a displacement; 0: a change by limit_pose within 1 ms")
    limit_gap: float = _limit("m", "measured gap; 0: as limit_pose", high=1000.0)
    limit_gap_rate: float = _limit("m/s", "rate of change of a gap; 0: a change by limit_gap within 1 ms")
    set_wear: tuple[float, ...] = _number(
        (0.0,) * 8,
        "m",
        0.0,
        1.0,
        Effect.NOW,
        "wear depth of the eight pads for the service ~/set_wear; all 0: new pads",
    )
    mark: str = _plain("", Effect.NOW, "text that the service ~/mark puts into the journal")
    clearance_horizontal: float = _of_scene("m", 10.0, "horizontal clearance of unworn pads")
    clearance_vertical: float = _of_scene("m", 10.0, "vertical clearance of unworn pads")
    stiffness: float = _of_scene("N/m^exponent", 1e300, "stiffness of the contact law")
    damping: float = _of_scene("as in the scene", 1e300, "damping of the contact law, if it has one")
    restitution: float = _of_scene("1", 1.0, "restitution of the contact law, if it has one")
    wear_coefficient: float = _of_scene("m^2/N", 1.0, "wear coefficient")
    max_evaluations: int = _number(
        0,
        "evaluations",
        0,
        1000000000,
        Effect.CONFIGURE,
        "largest number of evaluations of the equations of motion in an advance, at least 16; the rest is computed "
        "coarsely, with an estimate of its error; 0: unlimited",
    )
    head_pose_type: str = _choice(
        "pose",
        ("pose", "pose_with_covariance"),
        Effect.CONFIGURE,
        "message of head_pose: PoseStamped, or PoseWithCovarianceStamped with variances of x, y and theta",
    )
    head_pose_deviation: tuple[float, ...] = _number(
        (0.0, 0.0, 0.0),
        "m, m, rad",
        0.0,
        1.0,
        Effect.CONFIGURE,
        "standard deviation of head_pose: x, y, theta; 0: not known",
    )
    gaps_deviation: float = _number(0.0, "m", 0.0, 1.0, Effect.CONFIGURE, "standard deviation of gaps; 0: not known")
    excitation_deviation: tuple[float, ...] = _number(
        (0.0, 0.0, 0.0),
        "N, N, N m",
        0.0,
        1e12,
        Effect.CONFIGURE,
        "standard deviation of the excitation: Fx, Fy, M; 0: not known",
    )
    alarm_force: tuple[float, ...] = _alarm("N", 1e12, "forces")
    alarm_clearance: tuple[float, ...] = _alarm("m", 10.0, "values of the larger clearance")
    alarm_wear_rate: tuple[float, ...] = _alarm("m/s", 1.0, "wear rates of a pad")
    alarm_clearance_rate: tuple[float, ...] = _alarm("m/s", 1.0, "growth rates of the larger clearance, over 10 s,")
    alarm_residual: tuple[float, ...] = _alarm("m", 10.0, "distances of head_pose from the model at the same stamp")
    alarm_duration: float = _number(
        0.0, "s", 0.0, 3600.0, Effect.CONFIGURE, "time that a level must last before it raises an alarm"
    )
    jump_back: float = _number(
        1.0, "s", 0.0, 3600.0, Effect.NOW, "a stamp older than the newest by more than this resets the model"
    )
    jump_forward: float = _number(
        10.0, "s", 0.1, 3600.0, Effect.NOW, "a stamp ahead of the model's time by more than this resets the model"
    )
    failure_limit: int = _number(
        10, "advances", 0, 1000000, Effect.NOW, "failed advances in a row after which the model is reset; 0: never"
    )

    @property
    def follows(self) -> str:
        """`follow`, or `off` without an estimate."""
        return self.follow if self.estimate else "off"


#: Parameters that change the running model, by their keys in the scene file.
MODEL: Final[Mapping[str, str]] = {
    "clearance_horizontal": "clearance.horizontal_m",
    "clearance_vertical": "clearance.vertical_m",
    "stiffness": "contact.stiffness",
    "damping": "contact.damping",
    "restitution": "contact.restitution",
    "wear_coefficient": "wear.coefficient_m2_n",
}
#: Parameters that name files or folders. Anybody on the ROS graph may set parameters, so these are limited.
FILES: Final = ("scene", "record_path", "wear_state_path")
SPECS: Final[Mapping[str, Field[Any]]] = {spec.name: spec for spec in fields(Settings)}
#: A number, also in a form like 1e-9 that YAML 1.1, which ROS launch files use, reads as a text.
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
#: Longest text [characters], which is the longest path on Linux.
_LONGEST: Final = 4096
#: One line without control characters, which a terminal would obey.
_ONE_LINE: Final = r"^[^\x00-\x1f\x7f-\x9f]*\Z"
_FOREIGN: Final = ("use_sim_time", "start_type_description_service")


def coerce(name: str, value: Any) -> Any:
    """Return the value in the parameter's type, or unchanged if the conversion would not be exact.

    Integers and texts like `1e-9`, which YAML 1.1 does not read as numbers, become doubles; sequences become tuples.
    """
    default = SPECS[name].default
    if isinstance(default, tuple):
        return tuple(float(item) for item in value) if _is_list(value) else value
    if not isinstance(default, float):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return float(value)
    return value


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and all(
        isinstance(item, int | float) and not isinstance(item, bool) for item in value
    )


def expected(spec: Field[Any]) -> str:
    """Return in words which values a parameter can have."""
    if "choices" in spec.metadata:
        return f"one of {', '.join(spec.metadata['choices'])}"
    if isinstance(spec.default, tuple):
        return _range(f"{len(spec.default)} numbers", spec)
    if "unit" in spec.metadata:
        return _range("an integer" if isinstance(spec.default, int) else "a number", spec)
    return "true or false" if isinstance(spec.default, bool) else f"one line of at most {_LONGEST} characters"


def _range(kind: str, spec: Field[Any]) -> str:
    return f"{kind} from {spec.metadata['low']:g} to {spec.metadata['high']:g} [{spec.metadata['unit']}]"


def problems(values: Mapping[str, Any]) -> list[Problem]:
    """Return the problems of values; unknown names are ignored."""
    from plow_twin.scene_file.validation import validate

    known = {name: coerce(name, value) for name, value in values.items() if name in SPECS}
    found = validate(known, schema(), "parameters")
    return [Problem(problem.key, values.get(problem.key, problem.got), problem.expected) for problem in found]


@cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of the parameters."""
    return {"type": "object", "properties": {name: _property(spec) for name, spec in SPECS.items()}}


def _property(spec: Field[Any]) -> dict[str, Any]:
    words = {"description": expected(spec)}
    if "choices" in spec.metadata:
        return {"enum": list(spec.metadata["choices"]), **words}
    if "unit" not in spec.metadata:
        if isinstance(spec.default, bool):
            return {"type": "boolean", **words}
        return {"type": "string", "maxLength": _LONGEST, "pattern": _ONE_LINE, **words}
    bounds = {"minimum": spec.metadata["low"], "maximum": spec.metadata["high"]}
    if isinstance(spec.default, tuple):
        count = len(spec.default)
        number = {"type": "number", **bounds, "description": _range("a number", spec)}
        return {"type": "array", "items": number, "minItems": count, "maxItems": count, **words}
    return {"type": "integer" if isinstance(spec.default, int) else "number", **bounds, **words}


def settings(values: Mapping[str, Any]) -> Settings:
    """Return the settings with given values in place of defaults; raise ParameterError if some cannot be used."""
    found = problems(values)
    if found:
        raise ParameterError(found)
    made = Settings(**{name: coerce(name, value) for name, value in values.items() if name in SPECS})
    found = [*outside(made), *_unknown_services(made), *_swapped_thresholds(made)]
    if bool(made.opcua_server) != bool(made.opcua_map):
        found.append(Problem("opcua_map", made.opcua_map, "a mapping to nodes, together with opcua_server"))
    if found:
        raise ParameterError(found)
    return made


def services_off(given: Settings) -> frozenset[str]:
    """Return the services that the settings switch off."""
    return frozenset(name.strip() for name in given.services_off.split(",") if name.strip())


def _unknown_services(given: Settings) -> list[Problem]:
    unknown_names = sorted(services_off(given) - set(SERVICES))
    return (
        [Problem("services_off", ", ".join(unknown_names), f"some of {', '.join(SERVICES)}")] if unknown_names else []
    )


def _swapped_thresholds(given: Settings) -> list[Problem]:
    alarms = {name: getattr(given, name) for name in SPECS if name.startswith("alarm_")}
    return [
        Problem(name, list(pair), "the warning's threshold, then the larger one of the error")
        for name, pair in alarms.items()
        if isinstance(pair, tuple) and pair[0] > pair[1] > 0.0
    ]


def outside(settings: Settings) -> list[Problem]:
    """Return a problem for each parameter that names a file outside `file_root`, after symbolic links."""
    if not settings.file_root:
        return []
    root = Path(settings.file_root).resolve()
    named = {name: getattr(settings, name) for name in FILES}
    return [
        Problem(name, given, f"a path within file_root, {root}")
        for name, given in named.items()
        if _is_path(name, given) and not Path(given).resolve().is_relative_to(root)
    ]


def refused_changes(before: Settings, after: Settings) -> list[str]:
    """Return why parameters that name files cannot be changed after the start; presets can."""
    if after.file_root:
        return [str(problem) for problem in outside(after)]
    changed = [name for name in FILES if getattr(before, name) != getattr(after, name)]
    return [
        f"{name}: names a file, and is read-only without the parameter file_root"
        for name in changed
        if not (name == "scene" and getattr(after, name) in PRESETS)
    ]


def _is_path(name: str, given: str) -> bool:
    return bool(given) and not (name == "scene" and given in PRESETS)


def model_changes(given: Settings) -> dict[str, float]:
    """Return the numbers of the scene that parameters change, by their keys in the scene."""
    values = {key: getattr(given, name) for name, key in MODEL.items()}
    return {key: value for key, value in values.items() if value != -1.0}


def read_parameters(path: Path) -> dict[str, Any]:
    """Return the parameters in a YAML file, by plain names or under `ros__parameters` as for a ROS node."""
    from plow_twin.scene_file.yaml_text import read_yaml

    given, found = read_yaml(path, "parameter", "a mapping of names to values")
    if found:
        raise ParameterError(found, str(path))
    nodes = [given] if isinstance(given, dict) else []
    nodes += [node for node in nodes[0].values() if isinstance(node, dict)] if nodes else []
    values = next((node["ros__parameters"] for node in nodes if "ros__parameters" in node), given)
    if not isinstance(values, dict):
        raise ParameterError([Problem("file", type(values).__name__, "a mapping of names to values")], str(path))
    return {str(name): value for name, value in values.items()}


def read_value(text: str) -> Any:
    """Return a value read as YAML; other text stays text."""
    from plow_twin.scene_file.yaml_text import load_yaml

    value, found = load_yaml(text, "value", "a value")
    return text if found else value


def unknown(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield unknown names, each with the nearest parameter or an empty text."""
    for name in names:
        if name not in SPECS and name not in _FOREIGN and not name.startswith("qos_overrides."):
            yield name, next(iter(difflib.get_close_matches(name[:100], SPECS, 1)), "")


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml_value, value))}]"
    if isinstance(value, float):
        # YAML 1.1 needs a point in the mantissa
        return f"{value!r}" if "e" not in repr(value) else f"{value:.1e}"
    return f'"{value}"' if isinstance(value, str) else str(value)


def yaml_text() -> str:
    """Return a parameter file with all defaults and their meanings."""
    lines = ["# Parameters of the node plow_twin, all at their defaults.", "/**:", "  ros__parameters:"]
    for spec in SPECS.values():
        doc, effect = spec.metadata["doc"], spec.metadata["effect"].value
        lines += [
            f"    # {doc}",
            f"    # {expected(spec)}; takes effect {effect}",
            f"    {spec.name}: {_yaml_value(spec.default)}",
        ]
    return "\n".join(lines) + "\n"
