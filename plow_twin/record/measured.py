"""Read measured loads and motions, which an estimate needs.

The measurements are read from a folder of tables, from a run of the twin, or from a recording of another program. A
folder of tables contains these files:

- scene.yaml
- load.csv with the columns t, fx, fy and m, which may be missing
- pose.csv with the columns t, x, y and theta, which may be missing if gaps.csv exists
- gaps.csv with the column t and columns that are named after pairs of contacts, which may be missing
- contact_forces.csv with the columns of gaps.csv, which may be missing

Each CSV file may be replaced by a Parquet file, such as load.parquet.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import UNSTATED, Deviation, without_uncertain
from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.bag import readable_beside
from plow_twin.record.entries import Holes
from plow_twin.record.estimated import stated
from plow_twin.record.map_file import ROLES
from plow_twin.record.mapping import UNFIT, messages_of, readings, roles_by_source
from plow_twin.record.reader import RunReader, own_run
from plow_twin.record.sources import open_source, read_table
from plow_twin.record.times import EPOCH_S, time_ns
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.parquet_lines import SUFFIX
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Gaps, PartOfPose, Pose, Reset, SetWear, Spread, whole_pose

Array = NDArray[np.float64]

SCENE_FILE, LOAD_FILE, POSE_FILE, GAPS_FILE = "scene.yaml", "load.csv", "pose.csv", "gaps.csv"
FORCES_FILE = "contact_forces.csv"
_LOAD_COLUMNS: Final = ("t", "fx", "fy", "m")
_POSE_COLUMNS: Final = ("t", "x", "y", "theta")
_NOT_STATED: Final = (math.nan,) * 3
#: Largest number of rows of a table in memory. At 1 kHz, a load with this number of rows covers almost three hours.
MOST_ROWS: Final = 10_000_000
#: Key under which the losses contain the number of rows that were dropped because of `MOST_ROWS`.
OLDER_ROWS: Final = "older_rows"


class _Rows:
    """Table of the newest `MOST_ROWS` rows. Older rows are dropped when they are more than a quarter of `MOST_ROWS`."""

    def __init__(self, columns: int) -> None:
        self._columns, self._values = columns, array("d")
        self.dropped = 0

    @property
    def came(self) -> int:
        return self.dropped + len(self._values) // self._columns

    def add(self, values: Iterable[float] | Array) -> None:
        """Append the numbers of one row, or an array of rows with shape (n, columns)."""
        if isinstance(values, np.ndarray):
            self._values.frombytes(values.tobytes())
        else:
            self._values.extend(values)
        if len(self._values) > MOST_ROWS * 5 // 4 * self._columns:
            self._cut()

    def table(self) -> Array:
        """Return the rows, shape (n, columns). After this call, no row may be added."""
        self._cut()
        return np.asarray(self._values, dtype=np.float64).reshape(-1, self._columns)

    def _cut(self) -> None:
        beyond = max(len(self._values) // self._columns - MOST_ROWS, 0)
        del self._values[: beyond * self._columns]
        self.dropped += beyond


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of one run."""

    scene: Scene
    #: t [s] and the measured load Fx, Fy [N], M [N m], shape (n, 4)
    load: Array
    #: t [s] and x, y [m], theta [rad], shape (k, 4); an empty cell is NaN
    poses: Array
    #: number of rows and messages that could not be read or used
    unreadable: int
    #: standard deviations of x, y [m] and theta [rad] that the run contains; a missing value is 0
    pose_deviation: Deviation = UNSTATED
    #: standard deviations of Fx, Fy [N] and M [N m] that the run contains; a missing value is 0
    load_deviation: Deviation = UNSTATED
    #: t [s] and the gaps of the eight pairs [m], shape (m, 9); the gap of a pair without a sensor is NaN
    gaps: Array = field(default_factory=lambda: np.zeros((0, 1 + PAIR_COUNT)))
    #: standard deviation of the gaps that the run contains [m]; a missing value is 0
    gaps_deviation: float = 0.0
    #: counts of the losses by reason; the sum of the counts is `unreadable`
    lost: Mapping[str, int] = field(default_factory=dict)
    #: t [s] and the contact forces of the eight pairs [N], shape (m, 9)
    forces: Array = field(default_factory=lambda: np.zeros((0, 1 + PAIR_COUNT)))


def read_measured(folder: Path, scene: Path | None = None) -> Measured:
    """Return the measurements in a folder of tables. If the file `scene` is given, it replaces scene.yaml.

    Raise `RecordingError` if a file or a column is missing or all tables are empty, and `SceneError` if the scene is
    invalid.
    """
    lost, load = Counter[str](), np.zeros((0, 4))
    if (file := _table(folder, LOAD_FILE)).is_file():
        load = _read(file, lost, _LOAD_COLUMNS)
    gaps = forces = np.zeros((0, 1 + PAIR_COUNT))
    if (file := _table(folder, GAPS_FILE)).is_file():
        gaps = _read(file, lost, ("t",), PAIR_NAMES)
    if (file := _table(folder, FORCES_FILE)).is_file():
        forces = _read(file, lost, ("t",), PAIR_NAMES)
    poses = np.zeros((0, 4))
    if (file := _table(folder, POSE_FILE)).is_file() or not len(gaps):
        poses = _read(file, lost, _POSE_COLUMNS)
    if not (len(load) or len(poses) or len(gaps)):
        raise RecordingError(f"{folder}: got no load and no measured pose, expected at least one row")
    model = load_scene(scene_path(str(scene)) if scene else folder / SCENE_FILE)
    first = next((table[0, 0] for table in (load, poses, gaps) if len(table)), 0.0)
    if first >= EPOCH_S:
        # times count from the first sample of the load; if there is no load, they count from the first pose or gap
        for table in (poses, gaps, forces, load):
            table[:, 0] -= first
    return Measured(model, load, poses, lost.total(), gaps=gaps, lost=dict(lost), forces=forces)


def is_measured(folder: Path) -> bool:
    """Return whether a folder has a table of the load or of the poses."""
    return any(_table(folder, name).is_file() for name in (LOAD_FILE, POSE_FILE))


def _table(folder: Path, name: str) -> Path:
    """Return the path of a table: the CSV file or, if it is missing, the Parquet file."""
    file = folder / name
    other = file.with_suffix(SUFFIX)
    return other if other.is_file() and not file.is_file() else file


def read_recording(path: Path, scene: Path | None = None, mapping: Path | None = None) -> Measured:
    """Return the measurements in a recording, in which time is counted from the first sample of the load.

    The measurements of a run are read from the journal of the run. If the journal contains no pose, the poses are read
    from the topics in the folder of the run and in its subfolders `beside`, `beside_2`, .... A recording of another
    program is read with the help of the mapping. If there is no load, time is counted from the first pose or gap. Raise
    `RecordingError` if a recording cannot be read, has no pose, or has a load that does not fit its role, and
    `SceneError` if the scene is invalid.
    """
    own, deviations = own_run(path), (UNSTATED, UNSTATED)
    if own is None:
        file = scene or (path / SCENE_FILE if path.is_dir() else path.with_name(SCENE_FILE))
        if scene is None and not file.is_file():
            raise RecordingError(f"{path}: not a run of plow_twin: a scene is needed, expected --scene or {file}")
        model = load_scene(scene_path(str(file)))
        rows, begins, lost, reason = _collect([path], mapping, ("excitation", "head_pose", "gaps", "forces"), "")
        loads, gaps, gaps_deviation = rows["excitation"], rows["gaps"], 0.0
    else:
        other_scene = scene is not None
        model = load_scene(scene_path(str(scene))) if other_scene else own.header.scene(own.path)
        lost = Counter[str]()
        loads, begins, journalled, gaps, spread, deviations_of_poses = _journal(own, lost)
        gaps_deviation = float(own.header.parameters.get("gaps_deviation", 0.0))
        of_poses, of_load = stated(own.header.parameters)
        journalled[:, 1:], of_poses = without_uncertain(of_poses, journalled[:, 1:], deviations_of_poses)
        deviations = of_poses, tuple(np.maximum(of_load, spread).tolist())
        rows, reason = {"head_pose": journalled}, ""
        if mapping is not None or not (len(journalled) or len(gaps)):
            folder = path if path.is_dir() else path.parent
            places = [folder, *readable_beside(folder, lost)]
            rows, _, unread, reason = _collect(places, mapping, ("head_pose", "forces"), own.header.node)
            unread.pop("missing_parts", 0)  # missing parts are counted below, in `own.lost_parts`
            lost.update(unread)
        lost.update(own.lost, damaged_chunks=own.damaged_chunks, **own.lost_parts)
    poses = rows["head_pose"]
    measured = len(poses) + len(gaps)
    # a load that does not fit its role is an error of the mapping
    for name, found in (("load", len(loads) or (measured and not reason)), ("measured pose", measured)):
        if not found:
            raise RecordingError(f"{path}: got no {name}, expected at least one row{reason}")
    origin, count = next(table[0, 0] for table in (loads, poses, gaps) if len(table)), len(loads)
    loads = _longest(loads, begins)
    lost["samples_of_other_stretches"] = count - len(loads)
    forces = rows.get("forces", np.zeros((0, 1 + PAIR_COUNT)))
    for table in (loads, poses, gaps, forces):
        table[:, 0] = (table[:, 0] - origin) * 1e-9
    counted = {name: count for name, count in lost.items() if count}
    return Measured(model, loads, poses, sum(counted.values()), *deviations, gaps, gaps_deviation, counted, forces)


def _journal(reader: RunReader, lost: Counter[str]) -> tuple[Array, list[int], Array, Array, Array, Array]:
    """Return the measurements in the journal of a run, without data before a change of the pads or a step of the clock.

    The results are the loads with their stamps [ns], shape (n, 4); the rows of the loads before which samples are
    missing; the poses, shape (k, 4), and gaps, shape (m, 9), with their stamps [ns]; the largest standard deviation of
    the load, shape (3,); and the standard deviation of each pose, shape (k, 3), NaN if the journal has none.
    """
    loads, poses, gaps = _Rows(4), _Rows(7), _Rows(1 + PAIR_COUNT)
    holes, begins, spread = Holes(), list[int](), np.zeros(3)
    for batch in reader.batches(outputs=False):
        entries = batch.entries
        rows, since = np.column_stack([entries.stamp_ns, entries.wrench]), 0
        for index, entry in sorted(entries.others.items()):
            if isinstance(entry, Reset | SetWear):
                loads, poses, gaps = _Rows(4), _Rows(7), _Rows(1 + PAIR_COUNT)
                since, begins = index, []
            elif isinstance(entry, Pose):
                poses.add((entry.stamp_ns, *entry.pose, *(entry.deviation or _NOT_STATED)))
            elif isinstance(entry, PartOfPose):
                poses.add((entry.stamp_ns, *whole_pose(entry), *_NOT_STATED))
            elif isinstance(entry, Gaps):
                row = np.full(1 + PAIR_COUNT, np.nan)
                row[0], row[1 + np.array(entry.pairs)] = entry.stamp_ns, entry.gaps
                gaps.add(row)
            elif isinstance(entry, Spread):
                spread = np.maximum(spread, entry.deviation)
        places = [place for place in holes.find(entries) if place >= since]
        begins += [loads.came + int(entries.sample[since:place].sum()) for place in places]
        loads.add(rows[since:][entries.sample[since:]])
    tables = [_counted(signal_rows, lost) for signal_rows in (loads, poses, gaps)]
    begins = [row - loads.dropped for row in begins]
    return tables[0], begins, tables[1][:, :4], tables[2], spread, tables[1][:, 4:]


def _longest(rows: Array, begins: list[int]) -> Array:
    """Return the longest part of a load without missing samples.

    Samples are missing before each row in `begins`, where the load is split if the time without samples is long.
    """
    if len(rows) < 2:
        return rows
    apart = np.diff(rows[:, 0])
    longest = tuning.LONGEST_GAP[1] * float(np.median(apart))
    bounds = [0, *(row for row in begins if 0 < row < len(rows) and apart[row - 1] > longest), len(rows)]
    first, end = max(pairwise(bounds), key=lambda ends: rows[ends[1] - 1, 0] - rows[ends[0], 0])
    return rows[first:end]


def _collect(
    places: list[Path], mapping: Path | None, role_names: tuple[str, ...], node: str
) -> tuple[dict[str, Array], list[int], Counter[str], str]:
    """Return the messages of the wanted roles in several recordings.

    The results are the stamps [ns] and values of the messages of each role, the rows of the load before which messages
    are missing, the losses by reason, and, for an error message, the reasons why messages do not fit their roles.
    """
    rows = {name: _Rows(1 + len(ROLES[name])) for name in role_names}
    lost, begins = Counter[str](), list[int]()
    for source, roles in roles_by_source([*map(open_source, places)], mapping, f"{node}/" if node else ""):
        roles = {name: role for name, role in roles.items() if name in role_names}
        for name, arrived, found in readings(messages_of(source, roles), roles):
            if arrived.after_hole:
                begins.append(rows["excitation"].came if "excitation" in rows else 0)
            if found is None:
                lost[f"{UNFIT}{name}: {roles[name].why_unfit(arrived)}"] += 1
            else:
                stamp_ns, values = found
                rows[name].add((float(stamp_ns), *(values.get(key, math.nan) for key in ROLES[name])))
        lost.update(source.losses.counts)
    tables = {name: _counted(found, lost) for name, found in rows.items()}
    if "excitation" in rows:
        begins = [row - rows["excitation"].dropped for row in begins]
    reasons = "".join(f"; {reason.removeprefix(UNFIT)}" for reason in lost if reason.startswith(UNFIT))
    return tables, begins, lost, reasons


def _read(path: Path, lost: Counter[str], columns: tuple[str, ...], some: tuple[str, ...] = ()) -> Array:
    """Return the rows of a table; an empty cell is NaN, and invalid rows are counted in `lost`.

    The table must have all columns in `columns` and at least one of the columns in `some`. A missing column of `some`
    is filled with NaN.
    """
    header, rows = read_table(path)
    names = list(header.names)
    if "t" not in names and "time" in names:
        names[names.index("time")] = "t"
    missing = [name for name in columns if name not in names]
    if missing:
        empty = " (the cells of a coordinate that was not measured are empty)" if "x" in columns else ""
        raise RecordingError(f"{path}: got the {header}, expected {', '.join(columns)}{empty}")
    if some and not set(some) & set(names):
        raise RecordingError(f"{path}: got the {header}, expected t and some of {', '.join(some)}")
    places = [names.index(name) if name in names else len(names) for name in (*columns, *some)]
    found = _Rows(len(places))
    for row in rows:
        numbers = [_number(row[place]) if place < len(row) else math.nan for place in places]
        if numbers[0] is None:
            stamp_ns = time_ns(row[places[0]])
            numbers[0] = None if stamp_ns is None else 1e-9 * stamp_ns
        whole = [number for number in numbers if number is not None]
        if len(whole) < len(numbers):
            lost["unreadable_rows"] += 1
        else:
            found.add(whole)
    return _counted(found, lost)


def _counted(rows: _Rows, lost: Counter[str]) -> Array:
    """Return the table of the rows, and add the number of dropped rows to `lost`."""
    table = rows.table()
    if rows.dropped:
        lost[OLDER_ROWS] += rows.dropped
    return table


def _number(cell: str) -> float | None:
    if not cell.strip():
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return None
