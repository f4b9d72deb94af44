"""Samples of a load table, from a CSV file or from the scene file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import Problem, SceneError
from plow_twin.scene_file.csv_rows import csv_rows, open_csv
from plow_twin.scene_file.schema import TABLE_COLUMNS
from plow_twin.scene_file.validation import is_number

Samples = tuple[NDArray[np.float64], NDArray[np.float64]]


def read_table(path: Path, columns: Sequence[str] | None = None, key: str = "file") -> Samples:
    """Read times [s], shape (n,), and wrenches [N, N, N m], shape (n, 3), from a CSV file with a header line.

    `columns` are the names of the columns of time, Fx, Fy and M. The default names are `t` (or `time`), `fx`, `fy` and
    `m`. Lines that start with `#` are skipped. `key` is the name of the file in error messages. Raise `SceneError` if
    the file, a column or a number is missing. The error lists all bad lines.
    """
    names = tuple(columns or TABLE_COLUMNS)
    try:
        with open_csv(path) as file:
            rows = list(csv_rows(file, "#"))
    except (OSError, csv.Error) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise SceneError([Problem(key, str(path), f"a readable csv file ({reason})")]) from None
    header = [name.strip() for name in rows[0][1]] if rows else []
    if columns is None and "t" not in header:
        header = ["t" if name == "time" else name for name in header]
    if any(header.count(name) != 1 for name in names):
        raise SceneError([Problem(key, header, f"a header line with {', '.join(names)}, each name once")])
    return _parse(rows[1:], [header.index(name) for name in names], key)


def _parse(rows: list[tuple[int, list[str]]], places: list[int], key: str) -> Samples:
    samples = np.empty((len(rows), 4))
    problems = []
    for index, (line, row) in enumerate(rows):
        try:
            samples[index] = [float(row[place]) for place in places]
        except (ValueError, IndexError):
            problems.append(Problem(f"{key} line {line}", ",".join(row), "a number in each of the 4 columns"))
    if problems:
        raise SceneError(problems)
    return samples[:, 0].copy(), samples[:, 1:].copy()


def sample_table(t: list[Any], wrench: list[Any], key: str) -> Samples:
    """Convert samples of a scene file to arrays, or raise a `SceneError` that names each bad row."""
    problems = [
        Problem(f"{key}.t[{index}]", value, "a number [s]") for index, value in enumerate(t) if not is_number(value)
    ]
    problems += [
        Problem(f"{key}.wrench[{index}]", row, "3 numbers: Fx, Fy, M [N, N, N m]")
        for index, row in enumerate(wrench)
        if not isinstance(row, list) or len(row) != 3 or not all(map(is_number, row))
    ]
    if problems:
        raise SceneError(problems)
    flat = np.fromiter(chain.from_iterable(wrench), dtype=float, count=3 * len(wrench))
    return np.array(t, dtype=float), flat.reshape(-1, 3)
