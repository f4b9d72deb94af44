"""Sensitivity of the estimate to each tuned number, at half and twice its value, on a few truths.

    python benchmark/tuning_sensitivity.py                     # runs that results/tuning.jsonl lacks
    python benchmark/tuning_sensitivity.py --number HUBER

For each truth, only the numbers that its estimate reads are varied. The truths have four load periods, and their seeds
were not used for tuning. `tools/pages.py` makes the table of `benchmark/results/tuning.md`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import click
import numpy as np
from estimate import RESULTS, load_rows
from estimate_truths import GROUPS, Truth, draw

from plow_twin.estimate import tuning
from plow_twin.estimate.estimate import estimate, warm_up
from plow_twin.estimate.result import NORMAL_P95, State

CASES = ("plain", "shift", "exponent", "forces", "hard", "firm")
SEED, PERIODS = 990100, 4.0
FACTORS = (0.5, 2.0)
FILE = RESULTS / "tuning.jsonl"


class _Watched(ModuleType):
    """A module that records which of its names are read."""

    read: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str) -> Any:
        _Watched.read.add(name)
        return super().__getattribute__(name)


def scaled(value: tuning.Value, factor: float, unit: str) -> tuning.Value:
    """Return a number, or all numbers of a tuple, times a factor. For a quantile, its distance from 1 is multiplied."""
    if isinstance(value, tuple):
        return tuple(scaled(part, factor, unit) for part in value)
    if unit == "quantiles":
        return max(1.0 - factor * (1.0 - float(value)), 0.0)
    return max(round(factor * value), 1) if isinstance(value, int) else factor * value


@contextmanager
def varied(name: str, value: tuning.Value) -> Iterator[None]:
    """Change the value of a tuned number within a context."""
    before = getattr(tuning, name)
    setattr(tuning, name, value)
    try:
        yield
    finally:
        setattr(tuning, name, before)


def run(truth: Truth) -> dict[str, Any]:
    """Return errors, intervals and states of one estimate, or its error as `failed`."""
    try:
        result = estimate(truth.nominal, truth.load, truth.poses, forces=truth.forces)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return {"failed": f"{type(error).__name__}: {error}"}
    row: dict[str, Any] = {"model": result.model, "sensor": result.sensor}
    pairs = ((result.horizontal, result.horizontal_state), (result.vertical, result.vertical_state))
    for axis, (value, state), true in zip("hv", pairs, truth.clearance.tolist(), strict=True):
        row[axis] = [value.mean - true, value.p05 - true, value.p95 - true, state.value]
    return row


def known(row: dict[str, Any], axis: str) -> bool:
    return axis in row and row[axis][3] in (State.ESTIMATED.value, State.ROUGH.value)


def verdict(row: dict[str, Any]) -> list[Any]:
    """Return the verdicts of an estimate without its figures."""
    return [row.get("failed"), row.get("model"), row.get("sensor"), *(row[axis][3] for axis in "hv" if axis in row)]


def summary(name: str, factor: float, rows: list[dict[str, Any]]) -> str:
    """Return a summary of the effect of one variation on the clearances and verdicts.

    It consists of the largest change of a clearance in standard deviations, the ratios of RMSE and width to those with
    the chosen value, the number of intervals that contain the truth, and the number of changed verdicts.
    """
    base = {row["group"]: row for row in rows if row["name"] == ""}
    own = [row for row in rows if row["name"] == name and row["factor"] == factor]
    if not own:
        return "not run" if not base or any(name in row["read"] for row in base.values()) else "not read"
    pairs = np.array([
        [row[axis][:3], base[row["group"]][axis][:3]]
        for row in own
        for axis in "hv"
        if known(row, axis) and known(base[row["group"]], axis)
    ])  # fmt: skip
    changed = sum(verdict(row) != verdict(base[row["group"]]) for row in own)
    verdicts = f"; {changed} of {len(own)} verdicts change" if changed else ""
    if not len(pairs):
        return f"no clearance known{verdicts}"
    other, chosen = pairs[:, 0], pairs[:, 1]
    if (other == chosen).all():
        return f"same{verdicts}"
    deviation = (chosen[:, 2] - chosen[:, 1]) / (2.0 * NORMAL_P95)
    shift = float((np.abs(other[:, 0] - chosen[:, 0]) / deviation).max())
    ratio = float(np.sqrt((other[:, 0] ** 2).sum() / (chosen[:, 0] ** 2).sum()))
    width = float(np.median((other[:, 2] - other[:, 1]) / (chosen[:, 2] - chosen[:, 1])))
    inside = int(((other[:, 1] <= 0.0) & (other[:, 2] >= 0.0)).sum())
    return f"{shift:.2f}; {ratio:.2f}; {width:.2f}; {inside} of {len(pairs)}{verdicts}"


def table() -> str:
    rows = load_rows(FILE)
    count = {group: sum(row["group"] == group and row["name"] != "" for row in rows) for group in CASES}
    varied_in = ", ".join(f"`{group}` {number}" for group, number in count.items() if number)
    lines = [f"Estimates with a varied number, by group of the truth: {varied_in or 'none yet'}.", ""]
    lines += ["| number | value | where it acts | set on | half of it | twice |", "|---|---|---|---|---|---|"]
    for entry in tuning.entries():
        half, twice = (summary(entry.name, factor, rows) for factor in FACTORS)
        value = _short(entry.value) if entry.unit == "1" else f"{_short(entry.value)} {entry.unit}"
        cells = (f"`{entry.name}`", value, entry.meaning, entry.basis, half, twice)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _short(value: tuning.Value) -> str:
    if isinstance(value, (tuple, np.ndarray)):
        return ", ".join(_short(part) for part in value)
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


@click.command()
@click.option("--number", "numbers", multiple=True, help="Only these numbers.")
@click.option("--case", "cases", multiple=True, type=click.Choice(CASES), help="Only these truths.")
@click.option("--out", type=click.Path(path_type=Path), default=FILE, show_default=True)
def main(numbers: tuple[str, ...], cases: tuple[str, ...], out: Path) -> None:
    done = {(row["group"], row["name"], row["factor"]) for row in load_rows(out)}
    warm_up(draw(replace(GROUPS["plain"], periods=1.0), 0).nominal)
    for group in cases or CASES:
        truth = draw(replace(GROUPS[group], periods=PERIODS), SEED)
        base, read = watched(truth)
        if (group, "", 1.0) not in done:
            write(out, {"group": group, "name": "", "factor": 1.0, "read": read, **base})
        for entry in tuning.entries():
            if entry.name not in read or (numbers and entry.name not in numbers):
                continue
            for factor in FACTORS:
                if (group, entry.name, factor) not in done:
                    with varied(entry.name, scaled(entry.value, factor, entry.unit)):
                        row = run(truth)
                    write(out, {"group": group, "name": entry.name, "factor": factor, **row})


def watched(truth: Truth) -> tuple[dict[str, Any], list[str]]:
    """Run the estimate with the chosen values. Return its row and the names of the numbers that it read."""
    _Watched.read.clear()
    before, tuning.__class__ = tuning.__class__, _Watched
    try:
        row = run(truth)
    finally:
        tuning.__class__ = before
    return row, sorted(_Watched.read & {entry.name for entry in tuning.entries()})


def write(out: Path, row: dict[str, Any]) -> None:
    with out.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
