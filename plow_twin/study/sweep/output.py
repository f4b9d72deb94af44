"""Output of a sweep as a Parquet file and as a picture."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin.build import package_version
from plow_twin.record.durable import whole_file
from plow_twin.study.statistics import unit_of
from plow_twin.study.sweep.table import Axis, Table
from plow_twin.study.words import parameter_words, statistic_words
from plow_twin.view.figures import write_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

METADATA_KEY: Final = "plow_twin"
#: Statistics that are integers.
_COUNTS: Final = ("makes", "events", "steps")


def write_parquet(table: Table, path: Path) -> None:
    """Write one row for each member: parameters, status (0 if computed), status in words, and statistics.

    The metadata key `plow_twin` contains a JSON text with the arguments, the units, the package version and the builds.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    sweep = table.sweep
    values = [sweep.values(member) for member in range(sweep.size)]
    failed = set(table.failed)
    columns: dict[str, Any] = {axis.path: [combination[axis.path] for combination in values] for axis in sweep.axes}
    columns["status"] = table.status
    columns["ended"] = [table.reason(member) if member in failed else "done" for member in range(sweep.size)]
    columns |= {name: table.numbers[:, index] for index, name in enumerate(sweep.statistics)}
    facts = {
        "arguments": sweep.arguments(),
        "units": {name: unit_of(name) for name in sweep.statistics},
        "package_version": package_version(),
        "builds": [json.loads(build) for build in table.builds],
    }
    # with sorted keys, equal tables give identical files
    arrow = pa.table(columns).replace_schema_metadata({METADATA_KEY: json.dumps(facts, sort_keys=True)})
    with whole_file(path) as stream:
        pq.write_table(arrow, stream)


def draw(table: Table, path: Path, title: str) -> None:
    """Draw each statistic as a curve (one parameter) or a heat map (two parameters), and mark failed members."""
    from matplotlib.figure import Figure

    count = len(table.sweep.statistics)
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(4.6 * columns + 0.8, 3.8 * rows + 0.4), layout="constrained", dpi=150)
    figure.suptitle(title, fontsize=11)
    for index, name in enumerate(table.sweep.statistics):
        axes = figure.add_subplot(rows, columns, index + 1)
        if len(table.sweep.axes) == 1:
            _curve(axes, table, index)
        else:
            _heat_map(axes, table, index)
        axes.set_title("\n".join(wrap(statistic_words(name)[0], 52)), fontsize=10)
    write_png(figure, path)


def _scaled(table: Table, index: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray(table.numbers[:, index] * statistic_words(table.sweep.statistics[index])[1])


def _curve(axes: Axes, table: Table, index: int) -> None:
    from matplotlib.ticker import MaxNLocator

    (axis,) = table.sweep.axes
    numbers, places = _scaled(table, index), _places(axis)
    # words have no values between them, so no line is drawn
    style = "none" if isinstance(axis.values[0], str) else "-"
    axes.plot(places, numbers, marker="o", markersize=3 if style == "-" else 6, linestyle=style)
    for member in table.failed:
        axes.axvline(
            places[member], color="tab:red", linestyle=":", label="failed" if member == table.failed[0] else ""
        )
    if table.failed:
        _legend(axes)
    _label(axes, axis, "x")
    name = table.sweep.statistics[index]
    axes.set_ylabel(statistic_words(name)[0].split(",")[0] + _bracketed(name))
    if name.split(".")[0] in _COUNTS:
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)


def _bracketed(name: str) -> str:
    words = statistic_words(name)[0]
    return words[words.index(" [") :] if "," in words and " [" in words else ""


def _legend(axes: Axes) -> None:
    axes.legend(fontsize=8, loc="upper right", bbox_to_anchor=(1.0, -0.16))


def _heat_map(axes: Axes, table: Table, index: int) -> None:
    first, second = table.sweep.axes
    grid = _scaled(table, index).reshape(table.sweep.shape).T
    mesh = axes.pcolormesh(_edges(first), _edges(second), np.ma.masked_invalid(grid), shading="flat")
    for axis, which in ((first, "x"), (second, "y")):
        _label(axes, axis, which)
    if table.failed:
        x, y = np.unravel_index(table.failed, table.sweep.shape)
        axes.plot(_places(first)[x], _places(second)[y], "x", color="tab:red", label="failed")
        _legend(axes)
    axes.figure.colorbar(mesh, ax=axes)


def _places(axis: Axis) -> np.ndarray[Any, np.dtype[np.float64]]:
    if isinstance(axis.values[0], str):
        return np.arange(len(axis.values), dtype=np.float64)
    return np.array(axis.values, dtype=np.float64) * parameter_words(axis.path)[1]


def _edges(axis: Axis) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the edges of the cells of a heat map, halfway between neighbouring values or their logarithms."""
    places = np.log(_places(axis)) if axis.log else _places(axis)
    if len(places) == 1:
        half = 0.5 * abs(places[0]) or 0.5
        edges = np.array([places[0] - half, places[0] + half])
    else:
        middle = 0.5 * (places[1:] + places[:-1])
        edges = np.concatenate([[2.0 * places[0] - middle[0]], middle, [2.0 * places[-1] - middle[-1]]])
    return np.asarray(np.exp(edges) if axis.log else edges)


def _label(axes: Axes, axis: Axis, which: str) -> None:
    getattr(axes, f"set_{which}label")(parameter_words(axis.path)[0])
    if axis.log:
        getattr(axes, f"set_{which}scale")("log")
    if isinstance(axis.values[0], str):
        getattr(axes, f"set_{which}ticks")(range(len(axis.values)), axis.values)
        if which == "x" and len(axis.values) > 3:
            axes.tick_params("x", labelsize=8, labelrotation=40)
