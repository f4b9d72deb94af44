"""Table of the parameters of the node. The checks, the ROS descriptors and config/twin.yaml are made from the table."""

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
from plow_twin.live.service_names import MOST_MARK, SERVICES
from plow_twin.scene_file.presets import PRESETS
from plow_twin.stream.topics import Cadence, names_of

#: Names of the topics with the estimate, and of the topics with results that are computed from the estimate.
ESTIMATES: Final = names_of(Cadence.ESTIMATE)


class Effect(Enum):
    """Time at which a changed value takes effect."""

    START = "at start (read only)"
    CONFIGURE = "on configure; can be changed while unconfigured"
    NOW = "at once"


class ParameterError(InputError):
    """Parameters are invalid."""

    def __init__(self, problems: Iterable[Problem], source: str = "parameters") -> None:
        super().__init__(problems, source)


def _number(
    default: float | tuple[float, ...], unit: str, low: float, high: float, doc: str, effect: Effect = Effect.CONFIGURE
) -> Any:
    return field(default=default, metadata={"unit": unit, "low": low, "high": high, "effect": effect, "doc": doc})


def _limit(unit: str, doc: str, default: float = 0.0, high: float = 1e300) -> Any:
    return _number(default, unit, 0.0, high, f"largest plausible {doc}", Effect.NOW)


def _of_scene(unit: str, high: float, doc: str) -> Any:
    return _number(-1.0, unit, -1.0, high, f"{doc}; with -1, the value in the scene", Effect.NOW)


def _alarm(unit: str, high: float, doc: str) -> Any:
    doc = f"{doc} that raise a warning and an error; with 0, no alarm is raised"
    return _number((0.0, 0.0), unit, 0.0, high, doc)


def _choice(default: str, choices: tuple[str, ...], doc: str, effect: Effect = Effect.CONFIGURE) -> Any:
    return field(default=default, metadata={"choices": choices, "effect": effect, "doc": doc})


#: Largest length of a text [characters]. A path on Linux has the same limit.
_LONGEST: Final = 4096


def _plain(default: bool | str, doc: str, effect: Effect = Effect.CONFIGURE, longest: int = _LONGEST) -> Any:
    return field(default=default, metadata={"effect": effect, "doc": doc, "longest": longest})


@dataclass(frozen=True)
class Settings:
    """All parameters with their defaults. Numbers are in SI units."""

    # fmt: off
    autostart: bool = _plain(True,
        "configure and activate the node at start; if false, the node waits for lifecycle requests", Effect.START)
    hardware_id: str = _plain("plough_head", "serial number of the head, shown in status and diagnostics", Effect.START)
    file_root: str = _plain("",
        "folder that must contain the paths scene, record_path and wear_state_path; if empty, these parameters cannot "
        "be changed after the start, but scene can be set to the name of a preset", Effect.START)
    services_off: str = _plain("",
        "services that are refused, separated by commas, e.g. set_wear,acknowledge_alarms", Effect.START)
    opcua_server: str = _plain("",
        "OPC UA server, opc.tcp://HOST:PORT, whose nodes replace the topics of some inputs; if empty, all inputs are "
        "topics", Effect.START)
    opcua_map: str = _plain("", "YAML file that assigns nodes of opcua_server to inputs", Effect.START)
    opcua_access: str = _plain("",
        "YAML file with the credentials for opcua_server; a server on this machine may need no "
        "credentials", Effect.START)
    priority: int = _number(0, "SCHED_FIFO", 0, 99,
        "real-time priority of the computing thread; with 0, the normal priority; a refusal by the system is a "
        "warning", Effect.START)
    cpu_affinity: str = _plain("",
        "processors on which the node runs, e.g. 2,3; if empty, all processors; a refusal by the system is a "
        "warning", Effect.START)
    lock_memory: bool = _plain(False,
        "lock all memory, so that it is not paged out; a refusal by the system is a warning", Effect.START)
    scene: str = _plain("paper", f"scene file, or the name of a preset: {', '.join(PRESETS)}")
    tolerance: float = _number(1e-9, "1", 1e-13, 1e-3, "relative tolerance of the solver")
    excitation_source: str = _choice("excitation", ("excitation", "tool_forces", "scene"),
        "source of the load: a topic, or the loads in the scene at the time of the node's clock; samples on the other "
        "topic are counted and ignored")
    input_depth: int = _number(1000, "messages", 200, 100000, "queue depth of the excitation topics")
    expected_rate: float = _number(0.0, "Hz", 0.0, 1e5,
        "expected rate of the samples, from which missing samples are counted; with 0, they are not counted")
    publish_mode: str = _choice("on_sample", ("on_sample", "fixed_rate"),
        "publish after each used sample, or at publish_rate; each message has the stamp of the newest used sample")
    publish_rate: float = _number(100.0, "Hz", 0.1, 1000.0, "rate with publish_mode fixed_rate")
    missed_periods: int = _number(1, "periods", 0, 1000000,
        "number of missed periods between two reports that causes a warning; with 0, no warning", Effect.NOW)
    step_rate: float = _number(100.0, "Hz", 1.0, 1000.0,
        "rate of advances under the loads in the scene and the hold policy")
    rollback_span: float = _number(2.0, "s", 0.0, 600.0,
        "largest age, relative to the newest sample, at which a late sample is used; with 0, late samples are dropped")
    estimate: bool = _plain(False,
        "estimate clearances and contact parameters from the load and head_pose or gaps, in a separate process")
    estimate_window: float = _number(32.0, "s", 1.0, 600.0,
        "duration of the window of an estimate; ten load periods are enough")
    estimate_interval: float = _number(10.0, "s", 0.5, 3600.0, "time between the ends of two windows")
    estimate_forces: int = _number(0, "twins", 0, 4096,
        "number of twins, at least 20, that are drawn from each estimate for the intervals on window_forces; 256 are "
        "sufficient; with 0, window_forces is not published")
    follow: str = _choice("full", ("off", "parameters", "full"),
        "how the twin follows the machine if `estimate` is true. With off, it does not follow. With parameters, each "
        "estimate sets the parameters of the model. With full, each measured pose also corrects the motion, and the "
        "forces have intervals")
    follow_members: int = _number(128, "twins", 20, 4096,
        "number of twins with follow: full; the computing time is proportional to this number")
    forecast_limits: tuple[float, ...] = _number((0.0, 0.0), "m", 0.0, 1.0,
        "limits of the horizontal and the vertical clearance for the forecast after each estimate; with 0, no forecast")
    forecast_horizon: float = _number(1.44e7, "s", 1.0, 1e10,
        "time of operation after which a limit counts as not reached")
    forecast_stop: float = _number(0.0, "s", 0.0, 1e10,
        "time of operation until a planned stop; the forecast contains the probability that a limit is reached before "
        "the stop; with 0, no stop is planned")
    forecast_scenarios: str = _plain("",
        "scenarios with factors of the load and the wear coefficient: NAME:load=X,coefficient=Y; NAME:...; the answer "
        "of ~/forecast contains a forecast for each scenario")
    wear_state_path: str = _plain("",
        "folder in which the wear of the pads is saved; the wear of another head or scene is refused; if empty, the "
        "wear is not saved")
    wear_save_period: float = _number(10.0, "s", 0.1, 3600.0, "interval at which the wear is saved")
    frame_id: str = _plain("slide_frame",
        "frame of all outputs; the origin is the centre of the slide, x points to the right and y points up")
    child_frame_id: str = _plain("head_frame", "frame of the head in messages on head_state")
    marker_rate: float = _number(0.0, "Hz", 0.0, 100.0,
        "rate of the topic markers, on which the ROS node sends walls, pads and forces for RViz; needs "
        "visualization_msgs; with 0, no markers are sent")
    tf: bool = _plain(False,
        "send the pose of the head on /tf with the markers, from frame_id to child_frame_id; needs the ROS node and "
        "tf2_msgs")
    record_path: str = _plain("",
        "folder for the recording of each configured run; if it exists, _2, _3, ... is added to its name; if empty, no "
        "run is recorded")
    record_outputs: str = _choice("all", ("all", "decimated", "none"),
        "recorded outputs; with none, only the journal is recorded, from which `plow-twin replay --write` computes the "
        "outputs")
    record_rate: float = _number(50.0, "Hz", 0.1, 10000.0,
        "rate of the outputs in a decimated recording; each output contains the peaks since the previous output")
    record_part_mb: float = _number(0.0, "MB", 0.0, 1e6,
        "size after which a new file of the recording begins; with 0, no limit")
    record_part_s: float = _number(0.0, "s", 0.0, 1e9,
        "time after which a new file of the recording begins; with 0, no limit")
    record_keep_mb: float = _number(0.0, "MB", 0.0, 1e9,
        "total size of completed files of the present run above which its oldest files are removed; with 0, no file is "
        "removed")
    record_ring: float = _number(0.0, "s", 0.0, 3600.0,
        "duration of a recording in memory, which is written to a folder at each alarm or mark; with 0, the whole run "
        "is recorded on the disk")
    record_sync: bool = _plain(False,
        "wait for the disk every half second, so that the recording survives a loss of power")
    excitation_timeout: float = _number(0.5, "s", 0.01, 3600.0,
        "time without samples after which the excitation counts as stale; in files and under use_sim_time, such a "
        "silence is only counted", Effect.NOW)
    hold_policy: str = _choice("hold", ("hold", "zero"),
        "load while the excitation is stale: the last load, or zero", Effect.NOW)
    hold_limit: float = _number(60.0, "s", 0.0, 86400.0,
        "time for which the model continues while the excitation is stale", Effect.NOW)
    limit_force: float = _limit("N", "force component; with 0, ten times the loads and the weight in the scene")
    limit_moment: float = _limit("N m", "moment; with 0, derived from the loads and the weight in the scene")
    limit_force_rate: float = _limit("N/s", "rate of change of a force; with 0, a change by limit_force within 1 ms")
    limit_moment_rate: float = _limit(
        "N m/s", "rate of change of the moment; with 0, a change by limit_moment within 1 ms"
    )
    limit_travel: float = _limit("m/s", "speed along the face", 10.0, 1000.0)
    limit_travel_rate: float = _limit(
        "m/s^2", "acceleration along the face; with 0, a change by limit_travel within 1 ms"
    )
    limit_pose: float = _limit(
        "m", "measured displacement; with 0, half the larger side of the frame or clearance", high=1000.0
    )
    limit_pose_rate: float = _limit(
        "m/s", "rate of change of a displacement; with 0, a change by limit_pose within 1 ms"
    )
    limit_gap: float = _limit("m", "measured gap; with 0, the limit of a displacement", high=1000.0)
    limit_gap_rate: float = _limit("m/s", "rate of change of a gap; with 0, a change by limit_gap within 1 ms")
    set_wear: tuple[float, ...] = _number((0.0,) * 8, "m", 0.0, 1.0,
        "wear depths of the eight pads, which the service ~/set_wear applies; new pads have the depth 0", Effect.NOW)
    mark: str = _plain("", "text that the service ~/mark writes to the journal", Effect.NOW, MOST_MARK)
    clearance_horizontal: float = _of_scene("m", 10.0, "horizontal clearance of unworn pads")
    clearance_vertical: float = _of_scene("m", 10.0, "vertical clearance of unworn pads")
    stiffness: float = _of_scene("N/m^exponent", 1e300, "stiffness of the contact law")
    damping: float = _of_scene("as in the scene", 1e300, "damping of the contact law, if it has one")
    restitution: float = _of_scene("1", 1.0, "restitution of the contact law, if it has one")
    wear_coefficient: float = _of_scene("m^2/N", 1.0, "wear coefficient")
    max_evaluations: int = _number(0, "evaluations", 0, 1000000000,
        "largest number of evaluations of the equations of motion in an advance, at least 16; the rest of the advance "
        "is computed coarsely, with an estimate of the error; with 0, the number is unlimited")
    head_pose_type: str = _choice("pose", ("pose", "pose_with_covariance"),
        "type of the messages on head_pose: PoseStamped, or PoseWithCovarianceStamped with variances of x, y and theta")
    head_pose_deviation: tuple[float, ...] = _number((0.0, 0.0, 0.0), "m, m, rad", 0.0, 1.0,
        "standard deviations of x, y and theta on head_pose; 0 means unknown")
    gaps_deviation: float = _number(0.0, "m", 0.0, 1.0,
        "standard deviation of the constant error of a gap sensor; with 0, 0.1 mm")
    excitation_deviation: tuple[float, ...] = _number((0.0, 0.0, 0.0), "N, N, N m", 0.0, 1e12,
        "standard deviations of Fx, Fy and M on excitation; 0 means unknown")
    alarm_force: tuple[float, ...] = _alarm("N", 1e12, "contact forces")
    alarm_clearance: tuple[float, ...] = _alarm("m", 10.0, "values of the larger clearance")
    alarm_wear_rate: tuple[float, ...] = _alarm("m/s", 1.0, "wear rates of a pad")
    alarm_clearance_rate: tuple[float, ...] = _alarm("m/s", 1.0, "growth rates of the larger clearance, over 10 s,")
    alarm_residual: tuple[float, ...] = _alarm("m", 10.0, "distances of head_pose from the model at the same stamp")
    alarm_duration: float = _number(0.0, "s", 0.0, 3600.0,
        "time for which a value must exceed a threshold to raise an alarm; impacts last milliseconds, so a longer time "
        "prevents most alarms on forces")
    jump_back: float = _number(2.0, "s", 0.0, 3600.0,
        "largest age relative to the newest stamp; repeated older stamps reset the model, so no sample older than this "
        "is used as a late sample", Effect.NOW)
    jump_forward: float = _number(10.0, "s", 0.1, 3600.0,
        "largest lead of a stamp ahead of the model time; a stamp further ahead resets the model", Effect.NOW)
    failure_limit: int = _number(10, "advances", 0, 1000000,
        "number of consecutive failed advances after which the model is reset; with 0, the model is not "
        "reset", Effect.NOW)
    # fmt: on

    @property
    def follows(self) -> str:
        """The parameter `follow`, or `off` if the parameter `estimate` is false."""
        return self.follow if self.estimate else "off"


#: Parameters that change the running model. The value is the key of the parameter in the scene file.
MODEL: Final[Mapping[str, str]] = {
    "clearance_horizontal": "clearance.horizontal_m",
    "clearance_vertical": "clearance.vertical_m",
    "stiffness": "contact.stiffness",
    "damping": "contact.damping",
    "restitution": "contact.restitution",
    "wear_coefficient": "wear.coefficient_m2_n",
}
#: Parameters that contain paths. Any participant of the ROS graph can set parameters, so the paths are restricted.
FILES: Final = ("scene", "record_path", "wear_state_path")
SPECS: Final[Mapping[str, Field[Any]]] = {spec.name: spec for spec in fields(Settings)}
#: Pattern of a number. ROS launch files use YAML 1.1, which reads a number such as 1e-9 as a string.
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
#: Largest number of items of a list for a separate check of each item. The lists of parameters are shorter.
_MOST_ITEMS: Final = 20
#: Pattern of a line without control characters, which could change the state of a terminal.
_ONE_LINE: Final = r"^[^\x00-\x1f\x7f-\x9f]*\Z"
_FOREIGN: Final = ("use_sim_time", "start_type_description_service")


def coerce(name: str, value: Any) -> Any:
    """Convert a value to the type of the parameter `name`; return the value unchanged if this is impossible.

    Integers become floats, and sequences become tuples. A string such as `1e-9` becomes a float, because YAML 1.1 does
    not read it as a number.
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
    """Return a text that describes the values that a parameter can have."""
    if "choices" in spec.metadata:
        return f"one of {', '.join(spec.metadata['choices'])}"
    if isinstance(spec.default, tuple):
        return _range(f"{len(spec.default)} numbers", spec)
    if "unit" in spec.metadata:
        return _range("an integer" if isinstance(spec.default, int) else "a number", spec)
    if isinstance(spec.default, bool):
        return "true or false"
    return f"one line of at most {spec.metadata['longest']} characters"


def _range(kind: str, spec: Field[Any]) -> str:
    return f"{kind} from {spec.metadata['low']:g} to {spec.metadata['high']:g} [{spec.metadata['unit']}]"


def problems(values: Mapping[str, Any]) -> list[Problem]:
    """Return the problems of parameter values. Unknown names are ignored."""
    from plow_twin.scene_file.validation import validate

    checked = {name: _bounded(coerce(name, value)) for name, value in values.items() if name in SPECS}
    problems_found = validate(checked, schema(), "parameters")
    return [Problem(problem.key, values.get(problem.key, problem.got), problem.expected) for problem in problems_found]


def _bounded(value: Any) -> Any:
    """Return the first `_MOST_ITEMS` items of a list, which are more than any parameter has; checks take time."""
    return value[:_MOST_ITEMS] if isinstance(value, Sequence) and not isinstance(value, str) else value


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
        return {"type": "string", "maxLength": spec.metadata["longest"], "pattern": _ONE_LINE, **words}
    bounds = {"minimum": spec.metadata["low"], "maximum": spec.metadata["high"]}
    if isinstance(spec.default, tuple):
        count = len(spec.default)
        number = {"type": "number", **bounds, "description": _range("a number", spec)}
        return {"type": "array", "items": number, "minItems": count, "maxItems": count, **words}
    return {"type": "integer" if isinstance(spec.default, int) else "number", **bounds, **words}


def settings(values: Mapping[str, Any]) -> Settings:
    """Return the settings in which `values` replace the defaults.

    Raise `ParameterError` if a value is invalid, or if values contradict each other.
    """
    problems_found = problems(values)
    if problems_found:
        raise ParameterError(problems_found)
    made = Settings(**{name: coerce(name, value) for name, value in values.items() if name in SPECS})
    problems_found = [*outside(made), *_unknown_services(made), *_swapped_thresholds(made)]
    if bool(made.opcua_server) != bool(made.opcua_map):
        problems_found.append(Problem("opcua_map", made.opcua_map, "a mapping to nodes, together with opcua_server"))
    if problems_found:
        raise ParameterError(problems_found)
    return made


def services_off(settings: Settings) -> frozenset[str]:
    """Return the services that the settings switch off."""
    return frozenset(name.strip() for name in settings.services_off.split(",") if name.strip())


def _unknown_services(settings: Settings) -> list[Problem]:
    unknown_names = sorted(services_off(settings) - set(SERVICES))
    return [Problem("services_off", ", ".join(unknown_names), f"one of {', '.join(SERVICES)}")] if unknown_names else []


def _swapped_thresholds(settings: Settings) -> list[Problem]:
    alarms = {name: getattr(settings, name) for name in SPECS if name.startswith("alarm_")}
    return [
        Problem(name, list(pair), "the threshold of the warning, followed by the larger threshold of the error")
        for name, pair in alarms.items()
        if isinstance(pair, tuple) and pair[0] > pair[1] > 0.0
    ]


def outside(settings: Settings) -> list[Problem]:
    """Return a problem for each path outside the folder `file_root`, after symbolic links have been resolved."""
    if not settings.file_root:
        return []
    root = Path(settings.file_root).resolve()
    named = {name: getattr(settings, name) for name in FILES}
    return [
        Problem(name, path, f"a path within file_root, {root}")
        for name, path in named.items()
        if _is_path(name, path) and not Path(path).resolve().is_relative_to(root)
    ]


def refused_changes(before: Settings, after: Settings) -> list[str]:
    """Return the reasons why changes of paths are refused after the start. A change to a preset scene is allowed."""
    if after.file_root:
        return [str(problem) for problem in outside(after)]
    changed = [name for name in FILES if getattr(before, name) != getattr(after, name)]
    return [
        f"{name}: names a file, and is read-only without the parameter file_root"
        for name in changed
        if not (name == "scene" and getattr(after, name) in PRESETS)
    ]


def _is_path(name: str, value: str) -> bool:
    return bool(value) and not (name == "scene" and value in PRESETS)


def model_changes(settings: Settings) -> dict[str, float]:
    """Return the numbers that replace numbers of the scene, by their keys in the scene file."""
    values = {key: getattr(settings, name) for name, key in MODEL.items()}
    return {key: value for key, value in values.items() if value != -1.0}


def read_parameters(path: Path) -> dict[str, Any]:
    """Return the parameters in a YAML file.

    The file contains a mapping of names to values, or the key `ros__parameters` as in a parameter file of a ROS node.
    """
    from plow_twin.scene_file.yaml_text import read_yaml

    document, problems_found = read_yaml(path, "parameter", "a mapping of names to values")
    if problems_found:
        raise ParameterError(problems_found, str(path))
    nodes = [document] if isinstance(document, dict) else []
    nodes += [node for node in nodes[0].values() if isinstance(node, dict)] if nodes else []
    values = next((node["ros__parameters"] for node in nodes if "ros__parameters" in node), document)
    if not isinstance(values, dict):
        raise ParameterError([Problem("file", type(values).__name__, "a mapping of names to values")], str(path))
    return {str(name): value for name, value in values.items()}


def read_value(text: str) -> Any:
    """Return the value of a YAML text, or the text itself if it is not valid YAML."""
    from plow_twin.scene_file.yaml_text import load_yaml

    value, problems_found = load_yaml(text, "value", "a value")
    return text if problems_found else value


def unknown(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield each unknown name with the most similar parameter, or with an empty string if no parameter is similar."""
    for name in names:
        if name not in SPECS and name not in _FOREIGN and not name.startswith("qos_overrides."):
            yield name, next(iter(difflib.get_close_matches(name[:100], SPECS, 1)), "")


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml_value, value))}]"
    if isinstance(value, float):
        # in YAML 1.1, a number with an exponent needs a decimal point
        return f"{value!r}" if "e" not in repr(value) else f"{value:.1e}"
    return f'"{value}"' if isinstance(value, str) else str(value)


def yaml_text() -> str:
    """Return the text of a parameter file with the descriptions and defaults of all parameters."""
    lines = ["# Parameters of the node plow_twin, all at their defaults.", "/**:", "  ros__parameters:"]
    for spec in SPECS.values():
        doc, effect = spec.metadata["doc"], spec.metadata["effect"].value
        lines += [
            f"    # {doc}",
            f"    # {expected(spec)}; takes effect {effect}",
            f"    {spec.name}: {_yaml_value(spec.default)}",
        ]
    return "\n".join(lines) + "\n"
