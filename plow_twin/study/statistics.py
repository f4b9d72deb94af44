"""Statistics of a run, each named by a path.

    max.top_left_top          largest force of one pair
    max.ccw.a                 largest force of the pair at corner a that stops a counter-clockwise swing
    max.a                     largest force of the two pairs at corner a
    max.ccw                   largest force of the four pairs that stop a counter-clockwise swing
    max                       largest force of all pairs
    contact_sets.ccw.ad       share of the contact time of `ccw` in which exactly corners a and d carry force
    contact_set_time.ccw.ad   time [s] in which exactly corners a and d carry force against a counter-clockwise swing
    contact_points.ccw.2      share of the contact time of `ccw` in which exactly two corners carry force
    events, steps             number of contact changes; number of steps of the solver

In place of `max` [N], a path may begin with `mean_in_contact` [N], `mean_over_time` [N], `impulse` [N s],
`time_in_contact` [s], `makes` (number of touches) or `wear_depth` [m]. For a group of pairs, `max` and `wear_depth` are
the largest value, impulses, times and touches are sums, and means are computed from the sums. `cw` selects the pairs
that stop a clockwise swing. A corner is named by its letter or by its place, such as `top_left`. A set is written as
letters (`ad`), or as places joined by `+`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import CORNER_NAMES, PAIR_NAMES, STOPS_COUNTER_CLOCKWISE
from plow_twin.model.scene import Scene
from plow_twin.run.ensemble import Ensemble
from plow_twin.solve.state import Status
from plow_twin.study.parameters import StudyError, nearest_of

Array = NDArray[np.float64]
Statistic = Callable[[Ensemble], Array]  # shape (m,) for m runs

SENSES: Final = ("ccw", "cw")


def _sum(array: Array, columns: list[int]) -> Array:
    """Add columns one by one, because the rounding of numpy's sum depends on the number of rows."""
    total = np.zeros(len(array))
    for column in columns:
        total = total + array[:, column]
    return total


def _mean_in_contact(members: Ensemble, pairs: list[int]) -> Array:
    impulse, time = _sum(members.impulse, pairs), _sum(members.time_in_contact, pairs)
    return np.asarray(np.divide(impulse, time, out=np.zeros_like(impulse), where=time > 0.0))


_OF_PAIRS: Final[Mapping[str, Callable[..., Array]]] = {
    "max": lambda members, pairs: np.asarray(members.peak[:, pairs].max(axis=1)),
    "mean_in_contact": _mean_in_contact,
    "mean_over_time": lambda members, pairs: np.asarray(_sum(members.impulse, pairs) / members.t[-1]),
    "impulse": lambda members, pairs: _sum(members.impulse, pairs),
    "time_in_contact": lambda members, pairs: _sum(members.time_in_contact, pairs),
    "makes": lambda members, pairs: _sum(members.makes.astype(np.float64), pairs),
    "wear_depth": lambda members, pairs: np.asarray(members.wear_depth[:, pairs].max(axis=1)),
}
UNITS: Final[Mapping[str, str]] = {
    "max": "N", "mean_in_contact": "N", "mean_over_time": "N", "impulse": "N s", "time_in_contact": "s", "makes": "1",
    "wear_depth": "m", "contact_sets": "1", "contact_set_time": "s", "contact_points": "1", "events": "1", "steps": "1",
}  # fmt: skip


def statistics_of(members: Ensemble, scenes: Sequence[Scene], paths: Sequence[str]) -> Array:
    """Return the statistics of m runs, shape (m, paths). The row of a failed run is NaN."""
    result = np.full((len(scenes), len(paths)), np.nan)
    names = [spec.name for spec in fields(Ensemble) if spec.name != "t"]
    groups: dict[tuple[tuple[str, str], ...], list[int]] = {}
    for index in np.flatnonzero(members.status == Status.OK).tolist():
        groups.setdefault(tuple(sorted(scenes[index].frame.labels.items())), []).append(index)
    for rows in groups.values():
        part = replace(members, **{name: getattr(members, name)[rows] for name in names})
        by_path = _statistics_of_scene(scenes[rows[0]])
        for column, path in enumerate(paths):
            result[rows, column] = (by_path.get(path) or statistic(scenes[rows[0]], path))(part)
    return result


def _statistics_of_scene(scene: Scene) -> Mapping[str, Statistic]:
    by_path: dict[str, Statistic] = {}
    for kind, reduce in _OF_PAIRS.items():
        for suffix, pairs in _groups(scene).items():
            by_path[f"{kind}{suffix}"] = partial(reduce, pairs=pairs)
    for row, sense in enumerate(SENSES):
        for name, mask in _sets(scene).items():
            by_path[f"contact_sets.{sense}.{name}"] = partial(_share, row=row, masks=[mask])
            by_path[f"contact_set_time.{sense}.{name}"] = partial(_set_time, row=row, mask=mask)
        for count in (1, 2, 3, 4):
            masks = [mask for mask in range(1, 16) if mask.bit_count() == count]
            by_path[f"contact_points.{sense}.{count}"] = partial(_share, row=row, masks=masks)
    by_path["events"] = lambda members: members.events.astype(np.float64)
    by_path["steps"] = lambda members: members.steps.astype(np.float64)
    return by_path


def statistic(scene: Scene, path: str) -> Statistic:
    """Return the statistic at a path; raise a `StudyError` with the most similar paths if the path is unknown."""
    by_path = _statistics_of_scene(scene)
    # a user may write the letters of a set in any order
    head, _, last = path.rpartition(".")
    key = path if path in by_path else f"{head}.{''.join(sorted(last))}"
    if key not in by_path:
        kinds = ", ".join(f"{name}.ccw.{scene.frame.corner_labels[CORNER_NAMES[0]]}" for name in _OF_PAIRS)
        raise StudyError(
            f"statistic: got {path!r}, expected e.g. {kinds}, max.{PAIR_NAMES[0]}, contact_sets.ccw.<corners>, "
            f"contact_set_time.ccw.<corners>, contact_points.ccw.2, events, steps{nearest_of(path, by_path)}"
        )
    return by_path[key]


def unit_of(path: str) -> str:
    """Return the unit of a statistic, given its path."""
    return UNITS[path.partition(".")[0]]


def _groups(scene: Scene) -> dict[str, list[int]]:
    """Return the pairs of each group. The key is the end of a path: empty for all pairs, or e.g. `.ccw`, `.ccw.a`."""
    ccw = [pair for pair in range(8) if STOPS_COUNTER_CLOCKWISE[pair]]
    cw = [pair for pair in range(8) if not STOPS_COUNTER_CLOCKWISE[pair]]
    groups: dict[str, list[int]] = {"": list(range(8)), ".ccw": ccw, ".cw": cw}
    groups |= {f".{name}": [pair] for pair, name in enumerate(PAIR_NAMES)}
    for corner, label in enumerate(scene.frame.corner_labels.values()):
        both = [2 * corner, 2 * corner + 1]
        for name in {label, CORNER_NAMES[corner]}:
            groups[f".{name}"] = both
            groups[f".ccw.{name}"] = [pair for pair in both if pair in ccw]
            groups[f".cw.{name}"] = [pair for pair in both if pair in cw]
    return groups


def _sets(scene: Scene) -> dict[str, int]:
    labels = list(scene.frame.corner_labels.values())
    joint = "" if scene.frame.labels else "+"
    return {
        joint.join(sorted(labels[i] for i in corners)): sum(1 << i for i in corners)
        for size in (1, 2, 3, 4)
        for corners in combinations(range(4), size)
    }


def _set_time(members: Ensemble, row: int, mask: int) -> Array:
    return np.asarray(members.set_time[:, row, mask])


def _share(members: Ensemble, row: int, masks: list[int]) -> Array:
    times = members.set_time[:, row]
    total, part = _sum(times, list(range(16))), _sum(times, masks)
    return np.asarray(np.divide(part, total, out=np.zeros_like(part), where=total > 0.0))
