"""Read many lines of a CSV file at a time, as arrays."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from plow_twin.live.bridge.source import Rows
from plow_twin.record.mapping import Role
from plow_twin.record.sources import Arrived
from plow_twin.record.times import OF_NUMBERS, TIMES, times_ns


class Table:
    """Lines of a file, which can be read as messages or as arrays of numbers. A line that is too long is None."""

    def __init__(self, topic: str, lines: Sequence[bytes | None], rows: Rows) -> None:
        self.topic, self._lines, self._rows = topic, lines, rows
        self._cells: list[tuple[bytes, ...]] | None = None

    def __len__(self) -> int:
        return len(self._lines)

    def __iter__(self) -> Iterator[Arrived]:
        now_ns = time.time_ns()
        for line in self._lines:
            content = self._rows.read(line)
            if content is not False:
                yield Arrived(self.topic, now_ns, content)

    def read(self, role: Role) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return the stamps and numbers of a role in all lines, which are equal to the results of `Role.read`.

        Returns
        -------
        stamp_ns : ndarray of int64, shape (n,)
            Stamps [ns].
        values : ndarray, shape (n, k)
            Numbers of the fields of the role.

        None is returned if a line is not a row, or if a number is missing or not a decimal number. If None is returned,
        the lines must be read as messages.
        """
        names = self._rows.columns or []
        stamp = next((name for name in TIMES if name in names), None) if role.stamp == "header" else role.stamp
        columns = self._columns()
        if columns is None or stamp not in names or not set(role.fields.values()) <= set(names):
            return None
        numbers = [self._numbers(columns[names.index(column)]) for column in role.fields.values()]
        stamps = times_ns(columns[names.index(stamp)], role.stamp_unit)
        numbers_found = [number for number in numbers if number is not None]
        if stamps is None or len(numbers_found) < len(numbers):
            return None
        with np.errstate(all="ignore"):  # a number that overflows becomes infinite, and the intake drops the sample
            values = np.stack(
                [role.in_si(name, number) for name, number in zip(role.fields, numbers_found, strict=True)], 1
            )
        return stamps + role.clock_offset_ns, values

    def _columns(self) -> list[tuple[bytes, ...]] | None:
        """Return the cells of each column, or None if the lines must be parsed singly."""
        if self._cells is None:
            comma = self._rows.delimiter.encode()
            whole = [line for line in self._lines if line is not None]
            text = b"\n".join(whole)
            if len(whole) < len(self._lines) or b'"' in text or b"#" in text:
                return None
            if b"\r" in text:
                whole = [line.rstrip(b"\r") for line in whole]
            count = len(self._rows.columns or ())
            cells = [line.split(comma) for line in whole]
            if any(len(row) != count for row in cells):
                return None
            self._cells = list(zip(*cells, strict=True))
        return self._cells

    def _numbers(self, cells: Sequence[bytes]) -> NDArray[np.float64] | None:
        if self._rows.delimiter != ",":  # if the delimiter is not a comma, a comma is a decimal sign
            cells = b"\n".join(cells).replace(b",", b".").split(b"\n")
        if b"".join(cells).translate(None, OF_NUMBERS):
            return None
        try:
            return np.array(list(map(float, cells)))
        except ValueError:
            return None
