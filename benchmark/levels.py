"""Run time of each solver at a given error, from its runs with different settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from cases import Row
from work_precision import LOCATED, OURS, OURS_BARE, OURS_CALL, OURS_RK4, SECTION

LEVELS = (1e-2, 1e-3, 1e-6, 1e-9)
OUTPUTS = (0.1, 1e-3)
Member = Callable[[str], bool]

PEERS: dict[str, Member] = {
    "CVODE from C": lambda solver: solver.startswith("CVODE") and solver.endswith("(C)"),
    "CVODE from C, rootfinding": lambda solver: "rootfinding" in solver,
    "heyoka": lambda solver: solver.startswith("heyoka"),
    "compiled DOP853, events located": lambda solver: solver == LOCATED,
    "best of SciPy and scikit-sundae": lambda solver: "SciPy" in solver or "scikit-sundae" in solver,
    "best multibody engine": lambda solver: solver.startswith(("MuJoCo", "Exudyn")),
    "lean jitted RK4": lambda solver: solver.startswith("lean"),
    "our RK4": lambda solver: solver == OURS_RK4,
}
OWN: dict[str, Member] = {name: name.__eq__ for name in (OURS_BARE, OURS, OURS_CALL)}
#: Solvers and settings that are slower than the fastest of their group or solver by this ratio are not measured again.
_NEAR = 1.4


@dataclass(frozen=True)
class Reached:
    """The time [ms] in which a solver reaches an error, and its setting, or two settings for an interpolated time."""

    wall_ms: float
    solver: str
    setting: str


def ladders(rows: Sequence[Row], scene: str, output_s: float, member: Member) -> list[list[Row]]:
    by_solver: dict[str, list[Row]] = {}
    for row in rows:
        if row.section == SECTION and row.scene == scene and row.output_s == output_s and member(row.solver):
            by_solver.setdefault(row.solver, []).append(row)
    return list(by_solver.values())


def reach(ladder: Sequence[Row], level: float) -> Reached | None:
    """Return the shortest time for an error of at most `level`.

    The time is that of a setting, or is interpolated between a setting that misses the level and the next tighter
    setting, linearly in the logarithms of time and error.
    """
    done = [row for row in ladder if row.status == "ok" and row.error is not None and row.wall_ms is not None]
    times = [Reached(_wall(row), row.solver, row.setting) for row in done if _error(row) <= level]
    for loose, tight in pairwise(done):
        if level < _error(loose) < math.inf and _error(tight) <= level and _wall(loose) < _wall(tight):
            share = math.log(_error(loose) / level) / math.log(_error(loose) / max(_error(tight), 1e-17))
            wall = _wall(loose) * (_wall(tight) / _wall(loose)) ** share
            times.append(Reached(wall, loose.solver, f"between {loose.setting} and {tight.setting}"))
    return min(times, key=lambda reached: reached.wall_ms, default=None)


def fastest(rows: Sequence[Row], scene: str, output_s: float, level: float, member: Member) -> Reached | None:
    times = [reach(ladder, level) for ladder in ladders(rows, scene, output_s, member)]
    return min((time for time in times if time is not None), key=lambda time: time.wall_ms, default=None)


def contenders(rows: Sequence[Row]) -> set[int]:
    """Return the indices of the rows that can change a figure of the tables, according to one run of each row."""
    picked: list[Row] = []
    for scene in {row.scene for row in rows}:
        for output_s in OUTPUTS:
            for member in (*PEERS.values(), *OWN.values()):
                group = ladders(rows, scene, output_s, member)
                for level in LEVELS:
                    picked += _contenders_at(group, level)
    identities = {id(row) for row in picked}
    return {index for index, row in enumerate(rows) if id(row) in identities}


def _contenders_at(group: Sequence[Sequence[Row]], level: float) -> list[Row]:
    times = [reach(ladder, level) for ladder in group]
    least = min((time.wall_ms for time in times if time is not None), default=math.inf)
    picked: list[Row] = []
    for ladder, time in zip(group, times, strict=True):
        if time is None or time.wall_ms > _NEAR * least:
            continue
        for before, row in zip([None, *ladder[:-1]], ladder, strict=True):
            crossing = before is not None and _error(before) > level
            if _error(row) <= level and (crossing or _wall(row) <= _NEAR * time.wall_ms):
                picked += [row] if before is None else [before, row]
    return picked


def _error(row: Row) -> float:
    return math.inf if row.error is None else row.error


def _wall(row: Row) -> float:
    return math.inf if row.wall_ms is None else row.wall_ms
