"""Files of a comparison: a self-contained HTML page, `compare.json`, and the windows as Parquet."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.durable import whole_file
from plow_twin.study.comparison.compare import Comparison
from plow_twin.study.comparison.windows import QUANTITIES
from plow_twin.study.report import embedded_figure, write_html, write_json
from plow_twin.view.figures import date_text, legend_beside
from plow_twin.view.section import PAIR_RGB

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_BOXES: Final = 6  # largest number of groups for which box plots are drawn
_MOST_LABELS: Final = 12  # largest number of labels on an axis
_WIDEST: Final = 10  # length of a label's longest line above which labels are slanted


def write_comparison(comparison: Comparison, lost: dict[str, Any], out: Path) -> None:
    """Write `compare.html`, `compare.json` and `windows.parquet` to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    facts = comparison.facts()
    write_json(out / "compare.json", {**facts, "lost": lost})
    context = {
        "facts": facts,
        "lost": lost,
        "picture": embedded_figure(_figure(comparison)),
        "pairs": PAIR_NAMES,
        "units": QUANTITIES,
    }
    write_html(out / "compare.html", "compare.html.j2", context)
    _write_windows(comparison, out / "windows.parquet")


def _figure(comparison: Comparison) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axis = figure.add_subplot()
    count = len(comparison.groups)
    axis.set_ylabel("largest force in a window [kN]")
    if count > _MOST_BOXES:
        _lines(axis, comparison)
        return figure
    for number, (name, windows) in enumerate(comparison.groups.items()):
        places = np.arange(len(PAIR_NAMES)) + (number - 0.5 * (count - 1)) * 0.8 / count
        drawn = axis.boxplot(
            windows.pairs["peak"] / 1e3, positions=places, widths=0.7 / count, whis=(5.0, 95.0), showfliers=False,
            patch_artist=True, medianprops={"color": "k"}, manage_ticks=False,
        )  # fmt: skip
        for box in drawn["boxes"]:
            box.set_facecolor(f"C{number % 10}")
        axis.plot([], [], color=f"C{number % 10}", lw=6, label=name)
    axis.set_xticks(range(len(PAIR_NAMES)), [name.replace("_", "\n") for name in PAIR_NAMES])
    figure.suptitle(
        f"{_title(comparison)}\nBox: quartiles and median of the windows; whiskers: 5 % and 95 %", fontsize=10
    )
    legend_beside(axis)
    return figure


def _lines(axis: Any, comparison: Comparison) -> None:
    """Draw the median and the 95 % point of each pair's peaks as lines, because box plots of many groups overlap."""
    peaks = [windows.pairs["peak"] / 1e3 for windows in comparison.groups.values()]
    places = np.arange(len(peaks))
    median, high = (np.array([np.percentile(values, point, axis=0) for values in peaks]) for point in (50.0, 95.0))
    for pair, name in enumerate(PAIR_NAMES):
        axis.plot(places, median[:, pair], color=PAIR_RGB[pair], label=name)
        axis.plot(places, high[:, pair], color=PAIR_RGB[pair], ls=":", lw=1.0)
    shown = places[:: 1 + len(places) // _MOST_LABELS]
    # a line break puts the time of a shift below its date
    names = [list(comparison.groups)[place].replace(" ", "\n") for place in shown]
    slanted = max(len(line) for name in names for line in name.split("\n")) > _WIDEST
    axis.set_xticks(shown, names, rotation=30 if slanted else 0, ha="right" if slanted else "center", fontsize=8)
    axis.set_ylim(bottom=0.0)
    axis.figure.suptitle(f"{_title(comparison)}\nLine: median of the windows; dotted: 95 %", fontsize=10)
    legend_beside(axis)


def _title(comparison: Comparison) -> str:
    starts = np.concatenate([windows.start_ns for windows in comparison.groups.values()])
    first, last = date_text(int(starts.min())), date_text(int(starts.max()))
    span = f"{first} to {last}" if first else f"drawn {datetime.now(UTC):%Y-%m-%d}"
    scenes = f"scene {', '.join(comparison.scenes)}; " if comparison.scenes else ""
    return f"Largest contact forces; {scenes}{span}"


def _write_windows(comparison: Comparison, path: Path) -> None:
    """Write one row group for each group of windows, so that at most one group is copied in memory."""
    import pyarrow as pa
    import pyarrow.parquet

    writer = None
    with whole_file(path) as stream, ExitStack() as opened:
        for name, windows in comparison.groups.items():
            columns: dict[str, Any] = {
                "group": [name] * len(windows.start_ns),
                "start": pa.array(windows.start_ns.view("datetime64[ns]"), pa.timestamp("ns", "UTC")),
                "length": windows.length_ns * 1e-9,
                "samples_a_second": windows.rate_hz,
                "load/force_rms": windows.load[:, 0],
                "load/moment_rms": windows.load[:, 1],
                "clearance/horizontal": windows.clearance[:, 0],
                "clearance/vertical": windows.clearance[:, 1],
            }
            for place, pair in enumerate(PAIR_NAMES):
                for quantity, values in windows.pairs.items():
                    columns[f"{pair}/{quantity}"] = values[:, place]
            table = pa.table({key: pa.array(values) for key, values in columns.items()})
            if writer is None:
                writer = opened.enter_context(pyarrow.parquet.ParquetWriter(stream, table.schema))
            writer.write_table(table)
