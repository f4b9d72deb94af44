"""A comparison as files: one HTML page that needs no other file, `compare.json`, and the windows as Parquet."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.durable import whole_file
from plow_twin.study.comparison.compare import Comparison
from plow_twin.study.comparison.windows import QUANTITIES
from plow_twin.study.report import embedded_figure, write_html, write_json
from plow_twin.view.figures import date_text


def write_comparison(found: Comparison, lost: dict[str, Any], out: Path) -> None:
    """Write `compare.html`, `compare.json` and `windows.parquet` to a folder.

    Raises
    ------
    ModuleNotFoundError
        jinja2, matplotlib or pyarrow (extra `study`) is not installed.
    """
    out.mkdir(parents=True, exist_ok=True)
    facts = found.facts()
    write_json(out / "compare.json", {**facts, "lost": lost})
    context = {"facts": facts, "lost": lost, "picture": _picture(found), "pairs": PAIR_NAMES, "units": QUANTITIES}
    write_html(out / "compare.html", "compare.html.j2", context)
    _write_windows(found, out / "windows.parquet")


def _picture(found: Comparison) -> str:
    """Return the distributions of the peaks by pair and group as an embedded PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axis = figure.add_subplot()
    count = len(found.groups)
    for number, (name, windows) in enumerate(found.groups.items()):
        places = np.arange(len(PAIR_NAMES)) + (number - 0.5 * (count - 1)) * 0.8 / count
        drawn = axis.boxplot(
            windows.pairs["peak"] / 1e3, positions=places, widths=0.7 / count, whis=(5.0, 95.0), showfliers=False,
            patch_artist=True, medianprops={"color": "k"}, manage_ticks=False,
        )  # fmt: skip
        for box in drawn["boxes"]:
            box.set_facecolor(f"C{number % 10}")
        axis.plot([], [], color=f"C{number % 10}", lw=6, label=name)
    axis.set_xticks(range(len(PAIR_NAMES)), PAIR_NAMES, rotation=20, ha="right")
    axis.set_ylabel("largest force in a window [kN]")
    axis.set_title(f"{_title(found)}\nBox: quartiles and median of the windows; whiskers: 5 % and 95 %", fontsize=10)
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return embedded_figure(figure)


def _title(found: Comparison) -> str:
    """Return the scenes, and the dates of the first and the last window where their stamps are dates."""
    starts = np.concatenate([windows.start_ns for windows in found.groups.values()])
    first, last = date_text(int(starts.min())), date_text(int(starts.max()))
    span = f"{first} to {last}" if first else f"drawn {datetime.now(UTC):%Y-%m-%d}"
    scenes = f"scene {', '.join(found.scenes)}; " if found.scenes else ""
    return f"Largest contact forces; {scenes}{span}"


def _write_windows(found: Comparison, path: Path) -> None:
    """Write a row group for each group, so that only one group is in memory twice."""
    import pyarrow as pa
    import pyarrow.parquet

    writer = None
    with whole_file(path) as stream, ExitStack() as opened:
        for name, windows in found.groups.items():
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
