"""Guess the meaning and units of the columns in an unknown CSV file, from their names and magnitudes."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError, UnitError
from plow_twin.model.scene import Scene
from plow_twin.record.column_names import TIME_NAMES, plain_name, unit_of
from plow_twin.record.map_file import QUANTITIES, ROLES, UNITS
from plow_twin.record.sources import columns_of
from plow_twin.record.times import NUMBER, STAMP_UNITS, time_ns
from plow_twin.record.unit_check import CHECKED, unit_doubts
from plow_twin.scene_file.csv_rows import csv_rows, delimiter_of, open_csv
from plow_twin.scene_file.yaml_text import dump_yaml

Array = NDArray[np.float64]

#: Pattern of the column names of each quantity, by role and quantity. It is matched with the result of `plain_name`.
_NAMES: Final = {
    ("excitation", "fx"): r"fx|(force|load|kraft|last)x|x(force|load|kraft)|fhor(izontal)?|horizontalforce",
    ("excitation", "fy"): r"fy|(force|load|kraft|last)y|y(force|load|kraft)|fver(tical)?|verticalforce",
    ("excitation", "m"): r"mz?|moment[xyz]?|torque[xyz]?|drehmoment|mtheta",
    ("head_pose", "x"): r"x|(pos|position|weg|displacement)x|x(pos|position|weg)",
    ("head_pose", "y"): r"y|(pos|position|weg|displacement)y|y(pos|position|weg)",
    ("head_pose", "theta"): r"theta|angle|winkel|phi|rot(ation)?|tilt",
    ("travel", "speed"): r"speed|v|velocity|geschwindigkeit|ploughspeed",
}
#: Smallest time that is read as a date, for each unit of time. The same date in 2001 is written in each unit.
_DATES: Final = (("ns", 1e18), ("us", 1e15), ("ms", 1e12), ("s", 1e9))
#: Largest number of table cells that are examined. The more columns a file has, the fewer rows are examined.
_MOST_CELLS: Final = 2_000_000
#: The components of the load. A file without a column for each component cannot be used.
_NEEDED: Final = tuple(("excitation", name) for name in ROLES["excitation"])


@dataclass
class Guess:
    """The guessed meaning of a file's columns.

    `columns` contains the column of each quantity, by role and name, and `units` the units that are not SI. `time_unit`
    is empty if the time column contains dates. `because` states how each column was found. `open` contains the columns
    or units from which the user must choose, for each undecided quantity (`t` for the time).
    """

    path: Path
    delimiter: str
    decimal_comma: bool
    names: tuple[str, ...]
    columns: dict[tuple[str, str], str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    time: str = ""
    time_unit: str = ""
    because: dict[str, str] = field(default_factory=dict)
    open: dict[str, tuple[str, ...]] = field(default_factory=dict)
    stamps_s: Array = field(default_factory=lambda: np.zeros(0))
    #: values of the columns in SI, by role and quantity
    values: dict[tuple[str, str], Array] = field(default_factory=dict)

    def unit(self, role: str, name: str) -> str:
        """Return the unit of a quantity in the file, which may be the SI unit."""
        return self.units.get(name) or next(iter(UNITS[QUANTITIES[role, name]]))

    def mapping(self) -> dict[str, Any]:
        """Return the content of a mapping file."""
        roles: dict[str, Any] = {}
        for (role, name), column in self.columns.items():
            entry = roles.setdefault(role, {"topic": self.path.stem, "fields": {}})
            entry["fields"][name] = column
            entry.setdefault("unit", {})[name] = self.unit(role, name)
        for entry in roles.values():
            entry["stamp"] = self.time
            if self.time_unit:
                entry["stamp_unit"] = self.time_unit
        return roles

    def mapping_text(self) -> str:
        """Return the content of a mapping file as YAML."""
        return dump_yaml(self.mapping(), flow=False)


#: Time zone at the end of a date with time.
_ZONE: Final = re.compile(r"([Zz]|:\d\d([.,]\d+)?[+-]\d\d(:?\d\d)?)$")


def guess_columns(path: Path, scene: Scene, columns: Mapping[str, str], units: Mapping[str, str]) -> Guess:
    """Guess the meanings of the columns of a CSV file.

    The magnitudes of the numbers, in at most 20,000 rows and two million cells, are compared with the loads and sizes
    of the scene. The user states `columns` and `units` by name of the quantity (`t` for the time). Raise
    `RecordingError` if the file cannot be read, the header or the rows are missing, or the file has no column with a
    stated name.
    """
    guess, rows = _read(path)
    for name, column in columns.items():
        if column not in guess.names:
            raise RecordingError(f"column of {name}: got {column!r}, expected one of {', '.join(guess.names)}")
    quantities = {key[1]: key for key in _NAMES}
    unknown = [name for name in (*columns, *units) if name not in quantities and name != "t"]
    if unknown:
        raise UnitError(f"column or unit of {unknown[0]}: expected one of t, {', '.join(quantities)}")
    numbers = {
        name: np.array([_number(row[index]) for row in rows])
        for index, name in enumerate(guess.names)
    }  # fmt: skip
    _find_time(guess, rows, numbers, columns.get("t", ""), units.get("t", ""))
    for key, pattern in _NAMES.items():
        if key[1] in columns:
            guess.columns[key], guess.because[key[1]] = columns[key[1]], "as stated"
            continue
        alike = [name for name in guess.names if name != guess.time and re.fullmatch(pattern, plain_name(name))]
        if len(alike) == 1:
            guess.columns[key], guess.because[key[1]] = alike[0], "by its name"
        elif alike:
            guess.open[key[1]] = tuple(alike)
    for (_, name), column in guess.columns.items():
        cells = [row[guess.names.index(column)].strip() for row in rows]
        texts = [cell for cell in cells if cell and not NUMBER.fullmatch(cell)]
        if 2 * len(texts) > len(cells):
            raise RecordingError(
                f"{path}: {name}: got {texts[0]!r} in the column {column}, expected numbers such as -1199.7"
            )
        if missing := int(np.isnan(numbers[column]).sum()):
            guess.because[name] += f"; {missing} of {len(cells)} cells have no number"
    undecided = [name for name in guess.names if name not in guess.columns.values() and name != guess.time]
    for _, name in _NEEDED:
        if ("excitation", name) not in guess.columns:
            guess.open.setdefault(name, tuple(name for name in undecided if np.isfinite(numbers[name]).any()))
    guess.open = {name: choices for name, choices in guess.open.items() if name == "t" or quantities[name] in _NEEDED}
    _find_units(guess, numbers, scene, units)
    return guess


def _read(path: Path) -> tuple[Guess, list[list[str]]]:
    try:
        with open_csv(path) as stream:
            read = csv_rows(stream, "#")
            header = next(read, (0, []))[1]
            rows = [header, *(cells for _, cells in islice(read, min(CHECKED, _MOST_CELLS // max(1, len(header)))))]
        with open_csv(path) as stream:
            first = [line for line in islice(stream, 100) if line.strip() and not line.startswith("#")]
    except (OSError, csv.Error) as error:
        raise RecordingError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    if len(rows) < 2 or all(NUMBER.fullmatch(cell.strip()) for cell in rows[0] if cell.strip()):
        raise RecordingError(f"{path}: got no header row or no rows, expected names of columns and numbers under them")
    names = columns_of(path, tuple(name.strip() for name in rows[0])).names
    delimiter = delimiter_of(first[0])
    comma = delimiter != "," and any("," in line for line in first[1:])
    fit = [row for row in rows[1:] if len(row) == len(names)]
    if 2 * len(fit) < len(rows) - 1:
        other = next(len(row) for row in rows[1:] if len(row) != len(names))
        raise RecordingError(
            f"{path}: got {other} cells in a row, expected the {len(names)} of its header (if commas are decimal "
            "signs, semicolons or tabs must separate the columns)"
        )
    return Guess(path, delimiter, comma, names), fit


def _find_time(
    guess: Guess, rows: Sequence[Sequence[str]], numbers: Mapping[str, Array], given: str, unit: str
) -> None:
    alike = [name for name in guess.names if re.fullmatch(TIME_NAMES, plain_name(name))]
    rising = [name for name, values in numbers.items() if len(values) > 2 and (np.diff(values) > 0.0).all()]
    choices = [given] if given else alike or rising
    if len(choices) != 1:
        guess.open["t"] = tuple(choices or guess.names)
        return
    guess.time = choices[0]
    guess.because["t"] = "as stated" if given else "by its name" if alike else "as the only rising column"
    column = numbers[guess.time]
    if not np.isfinite(column).any():
        index = guess.names.index(guess.time)
        stamps = [time_ns(row[index]) for row in rows]
        # time is counted from the first stamp, because a float resolves the time since 1970 only to 0.2 us
        first = next((stamp for stamp in stamps if stamp is not None), 0)
        guess.stamps_s = np.array([np.nan if stamp is None else (stamp - first) * 1e-9 for stamp in stamps])
        if stamps and np.isnan(guess.stamps_s).all():
            got = f"{rows[0][index]!r} in the column {guess.time}"
            expected = "a number or a date such as 2026-01-02T03:04:05.678Z"
            raise RecordingError(f"{guess.path}: t: got {got}, expected {expected}")
        if not all(_ZONE.search(row[index].strip()) for row in rows):
            guess.because["t"] += "; dates without a zone are UTC"
        return
    header = unit_of(guess.time)
    newest = float(np.nanmax(np.abs(column)))
    dates = next((name for name, least in _DATES if newest > least), "")
    guess.time_unit = unit or (header if header in STAMP_UNITS else "") or dates or "s"
    guess.stamps_s = column * STAMP_UNITS[guess.time_unit] * 1e-9 if guess.time_unit in STAMP_UNITS else column
    if not (unit or header in STAMP_UNITS or dates):
        guess.because["t"] += "; its unit by the rate of the samples"


def _find_units(guess: Guess, numbers: Mapping[str, Array], scene: Scene, units: Mapping[str, str]) -> None:
    for key, column in guess.columns.items():
        unit = units.get(key[1]) or unit_of(column)
        units_of_quantity = UNITS[QUANTITIES[key]]
        if units.get(key[1]) and unit not in units_of_quantity:
            raise UnitError(f"unit of {key[1]}: got {unit!r}, expected one of {', '.join(units_of_quantity)}")
        if unit in units_of_quantity:
            guess.units[key[1]] = unit
            guess.because[key[1]] += f", {unit} as stated" if key[1] in units else f", {unit} in its name"
        guess.values[key] = numbers[column] * units_of_quantity.get(unit or "", 1.0)
    stated = set(guess.units)
    for doubt in unit_doubts(guess.values, guess.stamps_s[np.isfinite(guess.stamps_s)], scene):
        if doubt.advice:
            raise UnitError(f"{guess.path}: {doubt}: {doubt.advice}")
        for name in set(doubt.names) - stated:
            if name == "t":
                if "its unit by" in guess.because.get("t", ""):
                    guess.time_unit = doubt.likely
                    guess.stamps_s = guess.stamps_s * STAMP_UNITS[doubt.likely] / STAMP_UNITS["s"]
                continue
            guess.units[name] = doubt.likely
            guess.because[name] += f", {doubt.likely} by its size"
            guess.values[doubt.role, name] *= UNITS[QUANTITIES[doubt.role, name]][doubt.likely]
    # the two forces have the same unit
    both = [name for name in ("fx", "fy") if ("excitation", name) in guess.columns]
    for name in both:
        other = next((guess.units[force] for force in both if force in guess.units), "")
        if other and name not in guess.units:
            guess.units[name] = other
            guess.because[name] += f", {other} like the other force"
            guess.values["excitation", name] *= UNITS["force"][other]
    # the unit of a moment cannot be guessed from its magnitude
    if guess.units.get("fx") == "kN" and "m" not in guess.units and ("excitation", "m") in guess.columns:
        guess.units["m"] = "kN m"
        guess.because["m"] += ", kN m because the forces are in kN"
        guess.values["excitation", "m"] *= 1e3


def _number(cell: str) -> float:
    cell = cell.strip()
    return float(cell) if NUMBER.fullmatch(cell) else np.nan
