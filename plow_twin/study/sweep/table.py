"""A sweep computes statistics of the motion for each value of one parameter, or each combination of two parameters.

A *member* of a sweep is one run, with one value of each parameter.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import SceneError
from plow_twin.model.scene import Scene
from plow_twin.run.ensemble import simulate_many
from plow_twin.scene_file import loads_scene
from plow_twin.solve.state import Status
from plow_twin.study.parameters import WORDS, StudyError, Value, check_path, check_word, usable_scenes, with_parameters
from plow_twin.study.statistics import statistic, statistics_of

Array = NDArray[np.float64]

#: Status of a member whose parameters give an unusable scene.
UNUSABLE: Final = -1
#: Largest number of members, because the table and the list of chunks are kept in memory.
_MOST_MEMBERS: Final = 1_000_000


@dataclass(frozen=True)
class Axis:
    """A parameter and its values."""

    path: str
    values: tuple[Value, ...]
    log: bool = False


def parse_axis(text: str, scene: Scene) -> Axis:
    """Parse `PATH=LOW:HIGH:COUNT[:log]` or `PATH=VALUE,VALUE..`, or raise a `StudyError` that names the axis."""
    path, _, rest = text.partition("=")
    check_path(scene, path)
    expected = f"{path}=LOW:HIGH:COUNT[:log] or {path}=VALUE,VALUE.."
    if path in WORDS:
        words = tuple(check_word(path, word.strip()) for word in rest.split(",") if word.strip())
        if not words or len(set(words)) < len(words):
            raise StudyError(f"axis: got {text!r}, expected {path}=WORD,WORD.. with distinct words")
        return Axis(path, words)
    try:
        if ":" not in rest:
            values = tuple(float(item) for item in rest.split(","))
            log = False
        else:
            low, high, count, *scale = rest.split(":")
            log = scale == ["log"]
            if scale not in ([], ["lin"], ["log"]) or (log and min(float(low), float(high)) <= 0.0) or int(count) < 1:
                raise ValueError
            if int(count) > _MOST_MEMBERS:
                raise StudyError(f"axis: got {int(count)} values of {path}, expected at most {_MOST_MEMBERS}")
            spaced = (np.geomspace if log else np.linspace)(float(low), float(high), int(count))
            values = tuple(map(float, spaced))
    except StudyError:
        raise
    except ValueError:
        raise StudyError(f"axis: got {text!r}, expected {expected} (log: bounds > 0)") from None
    if not values or not all(math.isfinite(value) for value in values) or len(set(values)) < len(values):
        raise StudyError(f"axis: got {text!r}, expected {expected} with finite, distinct numbers")
    return Axis(path, values, log)


@dataclass(frozen=True)
class Sweep:
    """The arguments of a sweep as plain data. The text `scene_yaml` is self-contained, so it refers to no file."""

    scene_yaml: str
    axes: tuple[Axis, ...]
    statistics: tuple[str, ...]
    t_end_s: float
    tol: float = 1e-9

    def __post_init__(self) -> None:
        scene = self.scene()
        paths = [axis.path for axis in self.axes]
        if not 1 <= len(paths) <= 2 or len(set(paths)) < len(paths):
            raise StudyError(f"axes: got {paths}, expected one parameter, or two different parameters")
        if self.size > _MOST_MEMBERS:
            raise StudyError(f"axes: got {self.size} members, expected at most {_MOST_MEMBERS}")
        if not self.statistics or len(set(self.statistics)) < len(self.statistics):
            raise StudyError(f"statistics: got {list(self.statistics)}, expected one or more distinct statistics")
        for name in self.statistics:
            statistic(scene, name)

    def scene(self) -> Scene:
        """Return the scene, parsed from `scene_yaml`."""
        return loads_scene(self.scene_yaml)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values of each axis. The last axis varies fastest."""
        return tuple(len(axis.values) for axis in self.axes)

    @property
    def size(self) -> int:
        """The number of members."""
        return math.prod(self.shape)

    def values(self, member: int) -> dict[str, Value]:
        """Return the value of each parameter in a member, by path."""
        places = np.unravel_index(member, self.shape)
        return {axis.path: axis.values[int(place)] for axis, place in zip(self.axes, places, strict=True)}

    def arguments(self) -> dict[str, Any]:
        """Return all arguments that determine the result, as plain data for JSON."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain


@dataclass(frozen=True)
class Table:
    """Results of a sweep, with one row for each of m members."""

    sweep: Sweep
    #: Status of each member: `plow_twin.solve.state.Status` or `UNUSABLE`, shape (m,).
    status: NDArray[np.int64]
    #: Statistics, shape (m, statistics); NaN for a member whose status is not 0.
    numbers: Array
    #: Versions, processor and platform of each build that computed members.
    builds: tuple[str, ...] = ()

    @property
    def failed(self) -> list[int]:
        """The indices of the members without a result."""
        return [int(member) for member in np.flatnonzero(self.status)]

    def reason(self, member: int) -> str:
        """Return the status of a member in words."""
        status = int(self.status[member])
        if status != UNUSABLE:
            return Status(status).text
        try:
            with_parameters(self.sweep.scene(), self.sweep.values(member))
        except (SceneError, StudyError) as error:
            return " ".join(str(error).split())
        return "no usable scene"


def run_members_of(
    sweep: Sweep, members: Sequence[int], workers: int | None = None, on_done: Callable[[int], None] | None = None
) -> Array:
    """Compute the members with the given indices. Return status and statistics, shape (k, 1 + statistics).

    A member gives bit-identical results in any chunk, in any thread, and on any machine with the same build.
    """
    scene = replace(sweep.scene(), marks={})
    table = np.full((len(members), 1 + len(sweep.statistics)), np.nan)
    table[:, 0] = UNUSABLE
    scenes, rows = usable_scenes(scene, map(sweep.values, members))
    if not scenes:
        return table
    result = simulate_many(scenes, sweep.t_end_s, sweep.t_end_s, sweep.tol, workers, on_done)
    table[rows, 0] = result.status
    table[rows, 1:] = statistics_of(result, scenes, sweep.statistics)
    return table
