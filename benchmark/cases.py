"""Measurement of cases in alternating order, and the rows of the result table."""

from __future__ import annotations

import csv
import os
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from native import NotInstalled
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sample:
    """Result of one run; `q` contains the poses, shape (rows, 3)."""

    wall_s: float
    q: Array | None = None
    steps: int | None = None
    evaluations: int | None = None
    events: int | None = None


@dataclass
class Row:
    """One row of the result table: the median and the shortest time of `runs` runs [ms], and other figures or None."""

    section: str
    scene: str
    solver: str
    setting: str
    output_s: float | None = None
    simulated_s: float | None = None
    wall_ms: float | None = None
    wall_min_ms: float | None = None
    runs: int = 0
    error: float | None = None
    steps: int | None = None
    evaluations: int | None = None
    events: int | None = None
    #: Figure that is specific to the section: members beyond the listed error, multiple of real time, share of a core,
    #: error in tolerances, ratio of times, or number of compiled kernels.
    value: float | None = None
    #: Factor by which a small displacement at t = 0 grows, for random scenes and the ensemble.
    amplification: float | None = None
    status: str = "ok"

    def time(self, walls_s: Sequence[float]) -> None:
        """Set the median and the shortest of several run times [s]."""
        self.wall_ms, self.wall_min_ms, self.runs = 1e3 * median(walls_s), 1e3 * min(walls_s), len(walls_s)


@dataclass
class Case:
    """A row to be measured. `prepare` builds and compiles the work, and returns the function to be timed."""

    row: Row
    prepare: Callable[[], Callable[[], Sample]]
    error: Callable[[Array], float] | None = None
    samples: list[Sample] = field(default_factory=list)


#: A case is repeated until the sum of its run times reaches this value [s].
TIME_PER_CASE_S = 0.3
#: A first run that is shorter than this [s] is a warm-up and is not counted.
WARM_UP_BELOW_S = 0.05
#: Cases with a first run shorter than this [s] are repeated even if they were not chosen.
SHORT_S = 0.02
Choose = Callable[[Sequence[Row]], set[int]]


def measure(
    cases: Sequence[Case], repeats: int, advance: Callable[[str], None], choose: Choose | None = None
) -> list[Row]:
    """Run all cases once, then run the chosen cases in alternating order, up to `repeats` times each.

    In alternating order, a change of the machine's speed affects all cases. `choose` returns the indices of the cases
    that determine a figure. Without `choose`, all cases are chosen.
    """
    rows = [case.row for case in cases]
    ready: dict[int, Callable[[], Sample]] = {}
    for index, case in enumerate(cases):
        advance(f"{case.row.solver} {case.row.setting}")
        run = _first_run(case)
        if run is not None:
            ready[index] = run
    chosen = set(ready) if choose is None else choose(rows)
    for _ in range(repeats - 1):
        for index, run in ready.items():
            samples = cases[index].samples
            spent = sum(sample.wall_s for sample in samples)
            if spent < TIME_PER_CASE_S and (index in chosen or samples[0].wall_s < SHORT_S):
                advance(f"{rows[index].solver} {rows[index].setting} again")
                samples.append(run())
    for index in ready:
        _summarise(cases[index])
    return rows


def _first_run(case: Case) -> Callable[[], Sample] | None:
    try:
        run = case.prepare()
        first = run()
        if first.wall_s < WARM_UP_BELOW_S:
            first = run()
    except Exception as problem:
        missing = isinstance(problem, NotInstalled | ImportError)
        case.row.status = f"{'not run' if missing else 'failed'}: {problem}"
        return None
    if case.error is not None and first.q is not None:
        case.row.error = case.error(first.q)
    case.samples = [first]
    _summarise(case)
    return run


def _summarise(case: Case) -> None:
    row, last = case.row, case.samples[-1]
    row.time([sample.wall_s for sample in case.samples])
    row.steps, row.evaluations, row.events = last.steps, last.evaluations, last.events


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return the duration [s] of a call, and its result."""
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


def pose_error(reference: Array, scale: Sequence[float]) -> Callable[[Array], float]:
    """Return a function of poses q that computes the largest |q - reference| / `scale`, with `scale` of shape (3,).

    The function returns infinity if q has another shape or is not finite.
    """

    def error(q: Array) -> float:
        if q.shape != reference.shape or not np.isfinite(q).all():
            return float("inf")
        return float((np.abs(q - reference) / np.asarray(scale)).max())

    return error


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    body = ["| " + " | ".join(line) + " |" for line in (head, *lines)]
    return "\n".join([body[0], "|" + "---|" * len(head), *body[1:]])


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        names = [spec.name for spec in fields(Row)]
        writer.writerow(names)
        for row in rows:
            writer.writerow([_text(getattr(row, name)) for name in names])


def read_rows(path: Path) -> list[Row]:
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    return [Row(**{spec.name: _value(spec, line[spec.name]) for spec in fields(Row)}) for line in lines]


def _value(spec: Field[Any], text: str) -> Any:
    kind = str(spec.type)
    if not text and "None" in kind:
        return None
    return int(text) if kind.startswith("int") else float(text) if kind.startswith("float") else text


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def machine_name() -> str:
    """Return a name of this machine: the CPU model and the number of cores."""
    facts: dict[str, str] = {}
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines():
            key, _, value = line.partition(":")
            facts[key.strip()] = value.strip()
    except OSError:
        pass
    name = facts.get("model name", "unknown cpu")
    # virtual machines often hide the model number of the CPU
    model = name if re.search(r"\d", name) else f"{name} f{facts.get('cpu family', 0)}m{facts.get('model', 0)}"
    return re.sub(r"[^a-z0-9]+", "_", f"{model} {os.cpu_count()}core".lower()).strip("_")
