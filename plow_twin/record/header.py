"""The header of a recording, which contains the scene and the settings that a replay needs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final

from plow_twin.build import build_fingerprint, package_version
from plow_twin.errors import RecordingError, SceneError
from plow_twin.model.scene import Scene
from plow_twin.solve.compiled_scene import TOLERANCE_RANGE
from plow_twin.stream.journal import ParameterValue

#: Name of the MCAP metadata record that contains the header.
HEADER_RECORD: Final = "plow_twin"
#: Name of the MCAP metadata record that contains the numbers of lost messages. It is written when the file is closed.
LOSS_RECORD: Final = "plow_twin_loss"
#: Key in the loss record under which the reason of an early end is written. Every key except this key is a topic.
STOPPED_EARLY_KEY: Final = "stopped_early"
#: Key in the loss record of the number of lost journal entries.
JOURNAL: Final = "journal"
#: Version of the file layout, which `docs/recording.md` describes.
LAYOUT_VERSION: Final = 4


@dataclass(frozen=True)
class RunHeader:
    """Scene and settings of a run."""

    #: scene in YAML, without references to other files
    scene_yaml: str
    tol: float = 1e-9
    excitation_source: str = "excitation"
    node: str = "/plow_twin"
    #: topic name of each output in the run, by base name of the output
    topics: Mapping[str, str] = field(default_factory=dict)
    frame_id: str = "slide_frame"
    child_frame_id: str = "head_frame"
    #: clock of the receive times: `system`, or `ros` for the time from `/clock` or from the stamps of a file
    clock: str = "system"
    #: first stamp [ns], or None if it was not known at the start
    origin_ns: int | None = None
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    build: Mapping[str, str] = field(default_factory=build_fingerprint)
    package_version: str = field(default_factory=package_version)
    #: recorded outputs: `all`, `decimated` or `none`
    record_outputs: str = "all"
    #: number of this file in the run
    part: int = 0
    #: random identifier of the run, which is the same in all files of the run
    run_id: str = ""

    @property
    def follow(self) -> str:
        """How the twin followed measurements: `off`, `parameters` or `full`."""
        return str(self.parameters.get("follow", "off")) if self.parameters.get("estimate") else "off"

    @property
    def samples_topic(self) -> str:
        """Topic of the journal's samples."""
        return f"{self.node}/journal/samples"

    @property
    def digests_topic(self) -> str:
        """Topic of the journal's digests."""
        return f"{self.node}/journal/digests"

    @property
    def entries_topic(self) -> str:
        """Topic of the journal entries that are neither samples nor digests."""
        return f"{self.node}/journal/entries"

    def topic(self, base_name: str) -> str:
        """Return the name of the topic on which an output was sent."""
        return self.topics.get(base_name, f"{self.node.rpartition('/')[0]}/{base_name}")

    def scene(self, source: object) -> Scene:
        """Return the scene of the run; an error message names the recording by `source`.

        Raise `RecordingError` if the recording is damaged, or this version of plow_twin does not have the contact law
        of the scene.
        """
        from plow_twin.scene_file import loads_scene

        try:
            return loads_scene(self.scene_yaml, None, source=f"scene in {source}")
        except SceneError as error:
            raise RecordingError(str(error)) from error

    def to_record(self) -> dict[str, str]:
        """Return the content of the MCAP metadata record, in which values that are not strings are written as JSON."""
        record = {"layout_version": str(LAYOUT_VERSION)}
        for spec in fields(self):
            value = getattr(self, spec.name)
            text = value if isinstance(value, str) else json.dumps(dict(value) if isinstance(value, Mapping) else value)
            record[spec.name] = text
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, str], source: str) -> RunHeader:
        """Return the header from the content of the MCAP metadata record. Unknown keys are ignored.

        Raise `RecordingError` if a key is missing or has an invalid value. The message begins with `source`.
        """
        layout = record.get("layout_version", "")
        if layout != str(LAYOUT_VERSION):
            raise RecordingError(f"{source}: layout_version: got {layout!r}, expected '{LAYOUT_VERSION}'")
        values: dict[str, Any] = {}
        for spec in fields(cls):
            text = record.get(spec.name)
            if text is None:
                raise RecordingError(f"{source}: metadata {HEADER_RECORD!r}: {spec.name} is missing")
            try:
                values[spec.name] = text if spec.type == "str" else json.loads(text)
            except (ValueError, RecursionError) as error:
                raise RecordingError(f"{source}: {spec.name}: got {text[:120]!r}, expected JSON ({error})") from error
            if not _fits(values[spec.name], str(spec.type)):
                raise RecordingError(f"{source}: {spec.name}: got {text[:120]!r}, expected {spec.type}")
        low, high = TOLERANCE_RANGE
        if not isinstance(values["tol"], float) or not low <= values["tol"] <= high:
            raise RecordingError(f"{source}: tol: got {record['tol']}, expected a number from {low:g} to {high:g}")
        return cls(**values)


def _fits(value: Any, kind: str) -> bool:
    """Return whether a value has the type with the name `kind`; an integer must fit in 64 bits."""
    if kind.startswith("Mapping"):
        kinds = str | bool | int | float | list if "ParameterValue" in kind else str
        return isinstance(value, dict) and all(isinstance(item, kinds) for item in value.values())
    if kind.startswith("int"):
        return (value is None and "None" in kind) or (type(value) is int and abs(value) < 2**63)
    return isinstance(value, float if kind == "float" else str)
